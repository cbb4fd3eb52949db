"""The file of a study of filter sets: what is combined, and which figures of each combination."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from hesim_render.specs.files import InFolder, Strict, text_means
from hesim_render.specs.spectrum import SpectrumSpec

#: Groups of figures.
Figures = Literal["colour", "noise", "events", "demosaic"]
#: What is equal between sensors and filter sets.
Equal = Literal["exposure", "light", "white"]
Method = Literal["least_squares_xyz", "least_delta_e_2000", "least_delta_e_ab"]
_Lux = Annotated[float, Field(gt=0, le=1e9)]
_Exposure = Annotated[int, Field(ge=1, le=10**9)]


class NamesFiles(InFolder):
    """A part of a file that names shipped things, or files relative to it."""

    def beside(self, name: str, shipped: bool = True) -> str:
        """A shipped name as it is, and a path relative to the file."""
        is_path = Path(name).suffix != "" or len(Path(name).parts) > 1
        return str(self.folder / name) if is_path or not shipped else name


class TaskFile(NamesFiles):
    """What the files of runs, studies, designs and sweeps begin with."""

    schema_version: Literal[1]
    name: str = Field(min_length=1)
    description: str = ""


class SurfacesSpec(NamesFiles):
    """What is looked at: a set of reflectances, a hyperspectral cube, or a scene that is rendered into one."""

    reflectances: str | None = Field(None, description="name of a set, or a CSV file of patches")
    cube: str | None = Field(None, description="file of a hyperspectral cube")
    scene: str | None = Field(None, description="name or file of a scene; its cube holds radiance")
    size_px: tuple[Annotated[int, Field(ge=2, le=4096)], Annotated[int, Field(ge=2, le=4096)]] = Field(
        (96, 64), description="width and height of the rendered cube"
    )
    bands_nm: tuple[float, float, float] = Field((380.0, 780.0, 10.0), description="first, last and step of its bands")
    samples: int = Field(64, ge=2, le=65_536, description="rays per pixel and four bands")
    quantity: Literal["reflectance", "radiance"] = Field("reflectance", description="what the cube holds")
    wavelength_nm: list[float] | None = Field(None, min_length=2, description="of a cube whose file has none")
    beyond: Literal["refuse", "hold"] = Field("refuse", description="outside the wavelengths of the cube")
    scale: float = Field(1.0, gt=0, le=1e9, description="multiplies the values of the cube")
    name: str | None = Field(None, description="default: the name of the set or of the file")

    _shorthand = text_means("reflectances")

    @model_validator(mode="after")
    def _one(self) -> "SurfacesSpec":
        if sum(given is not None for given in (self.reflectances, self.cube, self.scene)) != 1:
            raise ValueError("surfaces are either 'reflectances', a 'cube' or a 'scene'")
        first, last, step = self.bands_nm
        if not (360 <= first < last <= 830 and step > 0 and (last - first) / step < 1000):
            raise ValueError("bands_nm: expected first, last and step within 360 to 830 nm")
        return self

    @property
    def is_reflectance(self) -> bool:
        """True if a cube holds reflectances; a rendered one never does."""
        return self.scene is None and self.quantity == "reflectance"

    @property
    def label(self) -> str:
        """Name in the results."""
        return self.name or Path(self.reflectances or self.scene or self.cube or "").stem


class NamedLight(Strict):
    """An illuminant with the name it has in the results."""

    name: str = Field(min_length=1)
    spectrum: SpectrumSpec

    _shorthand = text_means("name", "spectrum")

    @model_validator(mode="after")
    def _check(self) -> "NamedLight":
        if self.spectrum.load().values.min() < 0:
            raise ValueError("spectrum: a light's spectrum must not be negative")
        return self


class SetUseSpec(NamesFiles):
    """A filter set with its palette."""

    set: str = Field(description="name of a shipped filter set, or a file")
    palette: str | None = Field(None, description="name of a shipped palette, or a file; default that of the study")
    name: str | None = Field(None, description="default: the name of the set, and of a palette of its own")

    _shorthand = text_means("set")


class NoiseStudySpec(Strict):
    """Full simulation with noise, beside the closed forms."""

    repeats: int = Field(0, ge=0, le=1000, description="noisy frames of the surfaces; 0: closed forms alone")
    patch_px: int = Field(24, ge=4, le=512, description="side of a surface in pixels of the mosaic, about")
    seed: int = Field(1, ge=0, lt=2**63)


class StudySpec(TaskFile):
    """A study of filter sets."""

    sensors: list[str] = Field(min_length=1, description="names or files; their pixels, lens and noise")
    sensor_keys: dict[str, Any] = Field({}, description="keys of the sensor files to change, as aps.read_noise_e: 1.5")
    palette: str = "dyes"
    filter_sets: list[SetUseSpec] = Field([], description="none: the sensors' own filters")
    surfaces: list[SurfacesSpec] = [SurfacesSpec(reflectances="colorchecker")]
    illuminants: list[NamedLight] = [NamedLight(name="D65", spectrum=SpectrumSpec(illuminant="D65"))]
    illuminance_lux: list[_Lux] = [100.0]
    exposures_us: list[_Exposure] = Field([], description="none: that of each sensor file")
    equal: list[Equal] = Field(["exposure"], min_length=1)
    white_fill: float = Field(0.9, gt=0, le=1, description="part of saturation that white reaches where it is equal")
    crosstalk: list[Annotated[float, Field(ge=0, le=0.5)]] = Field([], description="none: that of each sensor file")
    figures: list[Figures] = Field(["colour", "noise", "events"], min_length=1)
    matrix: Method = "least_delta_e_2000"
    area_px: float = Field(4.0, gt=0, le=1e6, description="pixels of the mosaic that share one output pixel")
    noise: NoiseStudySpec = NoiseStudySpec()

    @field_validator("equal", "figures", "illuminance_lux", "exposures_us", "crosstalk", "sensors")
    @classmethod
    def _different(cls, value: list[Any]) -> list[Any]:
        if len(set(value)) != len(value):
            raise ValueError("an entry is there twice")
        return value

    @model_validator(mode="after")
    def _names(self) -> "StudySpec":
        for key, names in (
            ("surfaces", [item.label for item in self.surfaces]),
            ("illuminants", [item.name for item in self.illuminants]),
            ("filter_sets", [set_label(item, self.palette) for item in self.filter_sets]),
        ):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"{key}: two have the name {twice!r}; give one of them a 'name'")
        return self


def set_label(use: SetUseSpec, palette: str) -> str:
    """Name of a filter set in the results."""
    own = f" ({Path(use.palette).stem})" if use.palette not in (None, palette) else ""
    return use.name or Path(use.set).stem + own


def surfaces_of(text: str) -> dict[str, str]:
    """The surfaces that a text names: a scene, a CSV file of patches, a cube, or a set of reflectances.

    Parameters
    ----------
    text : name of a shipped scene or of a set, or a path; paths are relative to the working folder.
    """
    from hesim_render.specs.files import list_names

    path = Path(text)
    if path.suffix == "" and len(path.parts) == 1 and not path.exists():
        return {"scene" if text in list_names("scenes") and text != "colorchecker" else "reflectances": text}
    kind = {".yaml": "scene", ".yml": "scene", ".csv": "reflectances"}.get(path.suffix.lower(), "cube")
    return {kind: str(path.resolve())}

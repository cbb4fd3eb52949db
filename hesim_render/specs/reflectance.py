"""Reflectances, pictures of them, and the common part of all targets: place, tilt and bend.

Surfaces of objects: pictures on them, and materials of Mitsuba by name.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from hesim_render.specs.files import InFolder, Strict
from hesim_render.specs.geometry import Direction, Size, Vector
from hesim_render.specs.spectrum import SpectrumSpec


def _diffuse(spec: SpectrumSpec) -> SpectrumSpec:
    values = spec.load().values
    if values.min() < 0 or values.max() > 1:
        raise ValueError(f"a reflectance must lie in [0, 1]; this one runs from {values.min():g} to {values.max():g}")
    return spec


ReflectanceSpec = Annotated[SpectrumSpec, AfterValidator(_diffuse)]


class PictureFile(InFolder):
    """A picture: sRGB colours (PNG, JPEG, TIFF), linear sRGB (EXR), or a reflectance at each wavelength.

    Colours of an sRGB picture become the smooth reflectances of Mitsuba's own model [jakob2019]. A cube is an NPY file
    [row, col, wavelength] with `wavelength_nm`, or a spectral EXR file [fichet2021].
    """

    file: str = Field(description="picture or cube, relative to this file")
    wavelength_nm: list[float] | None = Field(None, min_length=2, description="of the planes of an NPY cube")
    beyond: Literal["refuse", "hold"] = Field(
        "refuse", description="outside the wavelengths of a cube: an error, or its first and last plane"
    )
    scale: float = Field(1.0, gt=0, le=1e9, description="multiplies the values of a cube or an EXR picture")
    interpolation: Literal["bilinear", "nearest"] = "bilinear"

    @model_validator(mode="after")
    def _is_a_file(self) -> "PictureFile":
        if not (self.folder / self.file).is_file():
            raise ValueError(f"no such file: {self.folder / self.file}")
        return self


class PlacedTarget(Strict):
    """Place of a target. It is bent first, then turned about its centre, then moved.

    `camera.fit: target` ignores all three: the camera stays where it would see the flat target at the origin.
    """

    position_m: Vector = Field((0.0, 0.0, 0.0), description="of the centre")
    rotation_axis: Direction = (0.0, 1.0, 0.0)
    rotation_deg: float = Field(0.0, ge=-1e9, le=1e9, description="tilt about the centre")
    bend_radius_m: float | None = Field(
        None, description="radius of a cylinder about a vertical axis; above 0 the sides come nearer to the camera"
    )


class SizedTarget(PlacedTarget):
    """A target of stated size."""

    width_m: Size = 0.3
    height_m: Size = 0.2


class TwoToneTarget(SizedTarget):
    """A target of two reflectances."""

    light: ReflectanceSpec = SpectrumSpec(flat=0.8)
    dark: ReflectanceSpec = SpectrumSpec(flat=0.05)


#: Number of repetitions.
Count = Annotated[int, Field(ge=1, le=100_000)]
#: Depth of materials inside materials.
_DEEPEST = 8


class TextureSpec(PictureFile):
    """A picture over the u and v of a surface."""

    repeat: tuple[Count, Count] = Field((1, 1), description="how often it is seen along u and v")


def _material(value: Any, info: ValidationInfo) -> Any:
    """A description of a material: its spectra and pictures are read, the rest stays as it is."""
    if isinstance(value, str):
        value = {"type": value}
    if not isinstance(value, Mapping) or "type" not in value:
        raise ValueError("expected the name of a material of Mitsuba, or a mapping with its 'type' and its keys")
    return _plugin(value, info, 0)


def _plugin(node: Mapping[str, Any], info: ValidationInfo, depth: int) -> dict[str, Any]:
    if depth > _DEEPEST:
        raise ValueError(f"materials lie inside each other more than {_DEEPEST} deep")
    return {str(key): _value(str(key), value, info, depth) for key, value in node.items()}


def _value(key: str, value: Any, info: ValidationInfo, depth: int) -> Any:
    if isinstance(value, Mapping):
        if "type" in value:
            return _plugin(value, info, depth + 1)
        kind = TextureSpec if "file" in value else SpectrumSpec
        return kind.model_validate(dict(value), context=info.context)
    if isinstance(value, str) and value.endswith(".csv"):
        return SpectrumSpec.model_validate(value, context=info.context)
    if value is None or isinstance(value, bool | int | float | str | list | SpectrumSpec | TextureSpec):
        return value
    raise ValueError(f"{key}: expected a number, a text, a spectrum, a picture or a mapping with a 'type'")


#: A BSDF of Mitsuba by its plugin's name and keys. Its spectra are those of scene files, its pictures `TextureSpec`.
MaterialSpec = Annotated[dict[str, Any], BeforeValidator(_material)]


def leaves_of(material: Mapping[str, Any], kind: type) -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of a material that are of a kind, such as `SpectrumSpec`."""
    for key, value in material.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{inside}", result) for inside, result in leaves_of(value, kind))
        elif isinstance(value, kind):
            yield key, value

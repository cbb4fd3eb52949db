"""Reflectances, pictures of them, and the common part of all targets: place, tilt and bend."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Direction, Size, Vector
from hesim_render.specs.spectrum import SpectrumSpec


def _diffuse(spec: SpectrumSpec) -> SpectrumSpec:
    values = spec.load().values
    if values.min() < 0 or values.max() > 1:
        raise ValueError(f"a reflectance must lie in [0, 1]; this one runs from {values.min():g} to {values.max():g}")
    return spec


ReflectanceSpec = Annotated[SpectrumSpec, AfterValidator(_diffuse)]


class InFolder(Strict):
    """Content that names files relative to the folder of the scene file."""

    folder: Path = Field(Path(), exclude=True)

    @model_validator(mode="before")
    @classmethod
    def _where_it_lies(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, dict) and info.context:
            if "folder" in data:
                raise ValueError("unknown key 'folder'")
            data = {**data, "folder": info.context["folder"]}
        return data


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
    def _is_a_file(self) -> PictureFile:
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

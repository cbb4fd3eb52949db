"""Reflectances, and the common part of all targets: place, tilt and bend."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Direction, Size, Vector
from hesim_render.specs.spectrum import SpectrumSpec


def _diffuse(spec: SpectrumSpec) -> SpectrumSpec:
    values = spec.load().values
    if values.min() < 0 or values.max() > 1:
        raise ValueError(f"a reflectance must lie in [0, 1]; this one runs from {values.min():g} to {values.max():g}")
    return spec


ReflectanceSpec = Annotated[SpectrumSpec, AfterValidator(_diffuse)]


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

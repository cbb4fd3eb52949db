"""Calibration targets of a scene file: flat, in the plane z = 0, centred on the origin, facing +z."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Size
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.spectrum import colorchecker


def _diffuse(spec: SpectrumSpec) -> SpectrumSpec:
    values = spec.load().values
    if values.min() < 0 or values.max() > 1:
        raise ValueError(f"a reflectance must lie in [0, 1]; this one runs from {values.min():g} to {values.max():g}")
    return spec


ReflectanceSpec = Annotated[SpectrumSpec, AfterValidator(_diffuse)]


class _Target(Strict):
    width_m: Size = 0.3
    height_m: Size = 0.2


class FlatTarget(_Target):
    """A uniform diffuse field."""

    type: Literal["flat"]
    reflectance: ReflectanceSpec = SpectrumSpec(flat=0.18)


class ColorCheckerTarget(_Target):
    """24 measured patches, 4 rows of 6, on a dark surround."""

    type: Literal["colorchecker"]
    width_m: Size = 0.279
    height_m: Size = 0.186
    dataset: str = Field("ISO 17321-1", description="measured reflectances of colour-science")
    patch_fill: float = Field(0.86, gt=0, le=1, description="patch width over patch pitch")
    surround: ReflectanceSpec = SpectrumSpec(flat=0.035)

    @field_validator("dataset")
    @classmethod
    def _known(cls, value: str) -> str:
        colorchecker(value)
        return value


class StepWedgeTarget(_Target):
    """Grey steps from dark to light, equally spaced in density."""

    type: Literal["step-wedge"]
    steps: int = Field(20, ge=2, le=256)
    reflectance_min: float = Field(0.01, gt=0, le=1)
    reflectance_max: float = Field(0.9, gt=0, le=1)

    @model_validator(mode="after")
    def _order(self) -> StepWedgeTarget:
        if self.reflectance_min >= self.reflectance_max:
            raise ValueError("reflectance_min must be below reflectance_max")
        return self


class CheckerboardTarget(_Target):
    """Squares of two reflectances; the top-left one is light."""

    type: Literal["checkerboard"]
    rows: int = Field(8, ge=1, le=10_000)
    cols: int = Field(12, ge=1, le=10_000)
    light: ReflectanceSpec = SpectrumSpec(flat=0.8)
    dark: ReflectanceSpec = SpectrumSpec(flat=0.05)


class SlantedEdgeTarget(_Target):
    """One straight edge through the centre, tilted from the vertical (ISO 12233); dark on the left."""

    type: Literal["slanted-edge"]
    angle_deg: float = Field(5.0, gt=-45, lt=45, description="clockwise from the vertical, as seen")
    light: ReflectanceSpec = SpectrumSpec(flat=0.8)
    dark: ReflectanceSpec = SpectrumSpec(flat=0.2)


class SiemensStarTarget(_Target):
    """Dark sectors on a light field, as many as `spokes`."""

    type: Literal["siemens-star"]
    width_m: Size = 0.2
    spokes: int = Field(36, ge=2, le=720)
    light: ReflectanceSpec = SpectrumSpec(flat=0.8)
    dark: ReflectanceSpec = SpectrumSpec(flat=0.05)


TargetSpec = Annotated[
    FlatTarget | ColorCheckerTarget | StepWedgeTarget | CheckerboardTarget | SlantedEdgeTarget | SiemensStarTarget,
    Field(discriminator="type"),
]

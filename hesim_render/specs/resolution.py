"""Targets of a scene file for resolution."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hesim_render.specs.geometry import Size
from hesim_render.specs.reflectance import ReflectanceSpec, SizedTarget, TwoToneTarget
from hesim_render.specs.spectrum import SpectrumSpec


class SlantedEdgeTarget(TwoToneTarget):
    """One straight edge through the centre, tilted from the vertical (ISO 12233); dark on the left."""

    type: Literal["slanted-edge"]
    angle_deg: float = Field(5.0, gt=-45, lt=45, description="clockwise from the vertical, as seen")
    dark: ReflectanceSpec = SpectrumSpec(flat=0.2)


class EdgeFieldTarget(TwoToneTarget):
    """Dark squares on a light field, each turned by an angle: four slanted edges at every place of the field.

    The default contrast of 4 : 1 is that of the e-SFR chart of ISO 12233.
    """

    type: Literal["edge-field"]
    rows: int = Field(3, ge=1, le=1000)
    cols: int = Field(5, ge=1, le=1000)
    angle_deg: Annotated[list[Annotated[float, Field(gt=-45, lt=45)]], Field(min_length=1)] = Field(
        [5.0], description="of the squares, clockwise; row by row from the top left, and again from the first"
    )
    fill: float = Field(0.55, gt=0, lt=0.7, description="side of a square over the smaller pitch")
    dark: ReflectanceSpec = SpectrumSpec(flat=0.2)


class SiemensStarTarget(TwoToneTarget):
    """Dark sectors on a light field, as many as `spokes`."""

    type: Literal["siemens-star"]
    width_m: Size = 0.2
    spokes: int = Field(36, ge=2, le=720)


class ResolutionWedgesTarget(TwoToneTarget):
    """Two wedges of dark lines that become narrower: upright lines upwards (left), level lines to the right (right).

    The width of the lines changes linearly along a wedge, from `line_wide_m` to `line_narrow_m`.
    """

    type: Literal["resolution-wedges"]
    lines: int = Field(5, ge=1, le=1000, description="dark lines of each wedge; gaps are as wide as lines")
    line_wide_m: Size = 0.008
    line_narrow_m: Size = 0.0008


class ZonePlateTarget(SizedTarget):
    """Rings whose frequency grows with the radius: reflectance (max + min)/2 + (max − min)/2 · cos(2π·F·r²/w²).

    The frequency at radius r is 2·F·r/w cycles per width w: F = `cycles` at the middle of the left and right sides.
    """

    type: Literal["zone-plate"]
    width_m: Size = 0.2
    cycles: float = Field(100.0, gt=0, le=300, description="frequency at the middle of the sides, cycles per width")
    reflectance_min: float = Field(0.05, ge=0, le=1)
    reflectance_max: float = Field(0.8, ge=0, le=1)

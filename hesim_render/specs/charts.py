"""Targets of a scene file for tone, colour and uniformity.

Targets of a scene file for resolution.
"""

from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from hesim_render.specs.files import InFolder
from hesim_render.specs.geometry import Size, below
from hesim_render.specs.light import LampSpec
from hesim_render.specs.reflectance import PictureFile, PlacedTarget, ReflectanceSpec, SizedTarget, TwoToneTarget
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.spectral.patches import read_patches
from hesim_render.spectral.spectrum import Spectrum, colorchecker_reflectances


class FlatTarget(SizedTarget):
    """A uniform diffuse field."""

    type: Literal["flat"]
    reflectance: ReflectanceSpec = SpectrumSpec(flat=0.18)


class ColorCheckerTarget(SizedTarget):
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
        colorchecker_reflectances(value)
        return value


class PatchChartTarget(SizedTarget, InFolder):
    """Patches from a CSV file, row by row from the top left, on a surround.

    The file has one line per patch. Its header is ``name`` and wavelengths in nm (reflectances, 0 to 1), or ``name, L,
    a, b`` (CIELAB under D50, 2° observer).
    """

    type: Literal["patch-chart"]
    patches: str | None = Field(None, description="CSV file, relative to this file")
    spectra: dict[str, ReflectanceSpec] | None = Field(None, description="the patches themselves, in place of a file")
    rows: int = Field(ge=1, le=1000)
    cols: int = Field(ge=1, le=1000)
    patch_fill: float = Field(0.86, gt=0, le=1, description="patch width over patch pitch")
    surround: ReflectanceSpec = SpectrumSpec(flat=0.035)

    @model_validator(mode="after")
    def _one_source(self) -> "PatchChartTarget":
        if (self.patches is None) == (self.spectra is None):
            raise ValueError("give patches or spectra, exactly one of them")
        if self.patches is not None and not (self.folder / self.patches).is_file():
            raise ValueError(f"no such file: {self.folder / self.patches}")
        count = len(self.load())
        if count != self.rows * self.cols:
            raise ValueError(f"there are {count} patches; rows times cols is {self.rows * self.cols}")
        return self

    @model_serializer(mode="wrap")
    def _self_contained(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A dump (and so a hash) holds the numbers of the file, not its name."""
        data = handler(self)
        if self.patches is not None:
            result = self.load().items()
            data["patches"] = None
            data["spectra"] = {
                name: {"wavelength_nm": s.wavelength_nm.tolist(), "value": s.values.tolist()} for name, s in result
            }
        return data

    def load(self) -> dict[str, Spectrum]:
        """Reflectances of the patches by name, in order."""
        if self.spectra is not None:
            return {name: source.load() for name, source in self.spectra.items()}
        assert self.patches is not None
        return read_patches(self.folder / self.patches)


class StepWedgeTarget(SizedTarget):
    """Grey steps from dark to light, equally spaced in density."""

    type: Literal["step-wedge"]
    steps: int = Field(20, ge=2, le=256)
    reflectance_min: float = Field(0.01, gt=0, le=1)
    reflectance_max: float = Field(0.9, gt=0, le=1)

    _order = below("reflectance_min", "reflectance_max")


class GreyRampTarget(SizedTarget):
    """Reflectance that rises linearly from the left side to the right one."""

    type: Literal["grey-ramp"]
    reflectance_min: float = Field(0.0, ge=0, le=1)
    reflectance_max: float = Field(0.9, gt=0, le=1)

    _order = below("reflectance_min", "reflectance_max")


class DeadLeavesTarget(SizedTarget):
    """Discs of random place, radius and grey that occlude each other, a scale-invariant texture [cao2010].

    Radii have a density proportional to r⁻³ between the two limits, greys are uniform between the two reflectances.
    The texture is drawn with `texels_across` texels, so that an edge is off by up to half a texel.
    """

    type: Literal["dead-leaves"]
    width_m: Size = 0.2
    radius_min_m: Size = 5e-4
    radius_max_m: Size = 0.02
    reflectance_min: float = Field(0.05, ge=0, le=1)
    reflectance_max: float = Field(0.8, ge=0, le=1)
    texels_across: int = Field(2048, ge=16, le=16384)
    seed: int = Field(1, ge=0, lt=2**63)

    _radii = below("radius_min_m", "radius_max_m")
    _order = below("reflectance_min", "reflectance_max")

    @model_validator(mode="after")
    def _visible(self) -> "DeadLeavesTarget":
        if self.radius_min_m < self.width_m / self.texels_across:
            raise ValueError("texels_across: the smallest leaves must have a radius of a texel or more")
        return self


class ImageTarget(SizedTarget, PictureFile):
    """A picture or a hyperspectral cube, from edge to edge."""

    type: Literal["image"]


class IntegratingSphereTarget(PlacedTarget, LampSpec):
    """The round port of an integrating sphere, of the same radiance everywhere and in all directions, in a black
    plate.
    """

    type: Literal["integrating-sphere"]
    port_diameter_m: Size = 0.1
    plate_m: Size = Field(0.15, description="side of the square plate around the port")
    luminance_cd_m2: float = Field(1000.0, ge=0, le=1e9, description="of the port, time mean")

    _inside = below("port_diameter_m", "plate_m")

    @property
    def width_m(self) -> float:
        """Width of the plate, m."""
        return self.plate_m

    @property
    def height_m(self) -> float:
        """Height of the plate, m."""
        return self.plate_m


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

"""Targets of a scene file for geometric calibration."""

from abc import ABC, abstractmethod
from typing import Literal

from pydantic import Field

from hesim_render.specs.geometry import Size, below
from hesim_render.specs.light import LampSpec
from hesim_render.specs.reflectance import PlacedTarget, ReflectanceSpec, TwoToneTarget
from hesim_render.specs.spectrum import SpectrumSpec


class CheckerboardTarget(TwoToneTarget):
    """Squares of two reflectances; the top-left one is light."""

    type: Literal["checkerboard"]
    rows: int = Field(8, ge=1, le=10_000)
    cols: int = Field(12, ge=1, le=10_000)


class _Board(PlacedTarget, ABC):
    """A board whose size follows from its parts, with a light margin around them."""

    rows: int = Field(ge=1, le=200)
    cols: int = Field(ge=1, le=200)
    margin_m: float = Field(0.01, ge=0, le=1e9, description="light border around the pattern")
    light: ReflectanceSpec = SpectrumSpec(flat=0.8)
    dark: ReflectanceSpec = SpectrumSpec(flat=0.05)

    @property
    @abstractmethod
    def pattern_m(self) -> tuple[float, float]:
        """Width and height of the pattern without its margin, m."""

    @property
    def width_m(self) -> float:
        """Width of the board, m."""
        return self.pattern_m[0] + 2 * self.margin_m

    @property
    def height_m(self) -> float:
        """Height of the board, m."""
        return self.pattern_m[1] + 2 * self.margin_m


class CharucoTarget(_Board):
    """A chessboard with ArUco markers in its light squares, as OpenCV draws it.

    Markers have the numbers from `first_id` on, row by row from the top left.
    """

    type: Literal["charuco"]
    rows: int = Field(8, ge=2, le=200)
    cols: int = Field(11, ge=2, le=200)
    square_m: Size = 0.025
    marker_m: Size = 0.018
    dictionary: str = Field("DICT_5X5_250", description="name of a dictionary of OpenCV")
    first_id: int = Field(0, ge=0, le=100_000)

    _inside = below("marker_m", "square_m")

    @property
    def pattern_m(self) -> tuple[float, float]:
        """Width and height of the pattern without its margin, m."""
        return self.cols * self.square_m, self.rows * self.square_m


class AprilGridTarget(_Board):
    """Tags of the family 36h11 with dark squares at their corners, as Kalibr defines its grid.

    Tags have the numbers from `first_id` on, row by row from the bottom left.
    """

    type: Literal["aprilgrid"]
    rows: int = Field(6, ge=1, le=200)
    cols: int = Field(6, ge=1, le=200)
    tag_m: Size = Field(0.03, description="side of a tag with its black border (Kalibr's tagSize)")
    spacing: float = Field(0.3, gt=0, le=10, description="gap between tags over tag_m (Kalibr's tagSpacing)")
    border_bits: Literal[1, 2] = Field(1, description="width of the black border, bits; Kalibr's own PDF has 2")
    first_id: int = Field(0, ge=0, le=100_000)

    @property
    def pattern_m(self) -> tuple[float, float]:
        """Width and height of the pattern without its margin, m."""
        gap = self.spacing * self.tag_m
        return (self.cols * (self.tag_m + gap) + gap, self.rows * (self.tag_m + gap) + gap)


class CircleGridTarget(_Board):
    """Dark discs in rows and columns, or in the asymmetric pattern of OpenCV, whose odd rows are shifted.

    In the asymmetric pattern rows are `pitch_m` apart, and discs of a row 2 · `pitch_m`.
    """

    type: Literal["circle-grid"]
    rows: int = Field(7, ge=1, le=200)
    cols: int = Field(10, ge=1, le=200)
    pitch_m: Size = 0.025
    diameter_m: Size = 0.015
    asymmetric: bool = False

    _apart = below("diameter_m", "pitch_m")

    @property
    def pattern_m(self) -> tuple[float, float]:
        """Width and height of the cells of all discs, m."""
        across = 2 * self.cols + (self.rows > 1) if self.asymmetric else self.cols
        return across * self.pitch_m, self.rows * self.pitch_m


class DotGridTarget(CircleGridTarget):
    """Many small dark dots in rows and columns, to map a distortion over the field."""

    type: Literal["dot-grid"]  # type: ignore[assignment]
    rows: int = Field(21, ge=1, le=200)
    cols: int = Field(31, ge=1, le=200)
    pitch_m: Size = 0.01
    diameter_m: Size = 0.004
    asymmetric: Literal[False] = False


class LedGridTarget(_Board, LampSpec):
    """Round lamps in rows and columns on a dark board, which shine together; with a waveform they blink.

    All lamps have the same luminance in all directions.
    """

    type: Literal["led-grid"]
    rows: int = Field(7, ge=1, le=200)
    cols: int = Field(10, ge=1, le=200)
    pitch_m: Size = 0.025
    diameter_m: Size = 0.012
    luminance_cd_m2: float = Field(500.0, ge=0, le=1e9, description="of the lamps, time mean")
    light: ReflectanceSpec = SpectrumSpec(flat=0.05)

    _apart = below("diameter_m", "pitch_m")

    @property
    def pattern_m(self) -> tuple[float, float]:
        """Width and height of the cells of all lamps, m."""
        return self.cols * self.pitch_m, self.rows * self.pitch_m

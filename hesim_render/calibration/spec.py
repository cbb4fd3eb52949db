"""The model of ``calibration.yaml``; a file is validated before any part of it is used.

`calibrate` writes the file, and a person may change it. The model names every key that a sensor, the report, the ISP or
a later calibration reads. Sections hold further keys for human readers.
"""

import math
from enum import IntEnum
from typing import Annotated, Any, Literal

from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Tag,
    field_validator,
    model_validator,
)

from hesim_render.core.names import FileName
from hesim_render.core.units import S_PER_US
from hesim_render.specs.capture import CaptureSpec
from hesim_render.specs.files import Strict

SCHEMA_VERSION = 1
SECTIONS = ("aps", "evs")

_Beta = Annotated[list[float | None], Field(min_length=6, max_length=6)]


class Defect(IntEnum):
    """What a pixel does; values are those of the map ``defect`` of a calibration."""

    NONE = 0
    STUCK = 1  # gives no event at all
    HOT = 2  # gives events at a steady rate of its own
    FLICKERING = 3  # gives events at a rate that comes and goes
    OTHER = 4  # its counts are unlike those of any threshold; nothing more is known


class _Section(Strict):
    """A part that holds more keys than the program reads."""

    model_config = ConfigDict(extra="allow")


class EstimateSpec(_Section):
    """A parameter: a number with its standard error, or null and the reason why it is not known."""

    value: float | None
    standard_error: float | None = Field(None, ge=0)
    interval_95: tuple[float, float] | None = None
    unit: str = ""
    reason: str | None = None
    note: str = ""

    @model_validator(mode="after")
    def _check(self) -> "EstimateSpec":
        if self.value is None and self.reason is None:
            raise ValueError("value: null needs a reason beside it")
        return self

    @property
    def error(self) -> float:
        """The standard error; infinite where it is not stated."""
        return math.inf if self.standard_error is None else self.standard_error


class FullWell(EstimateSpec):
    """Saturation capacity."""

    limited_by: Literal["ADC full scale", "full well"] | None = None
    cut_off_e: float | None = Field(
        None, gt=0, description="where pixels are cut off; `value` is a level that the full well leaves whole"
    )


class FindingSpec(_Section):
    """A deviation of the captures from the assumptions of the noise model."""

    check: str
    text: str
    p_value: float | None


class MapsFile(_Section):
    """The map file of a section, beside the calibration, identified by its hash."""

    file: FileName
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")


class FrameGoodness(_Section):
    """χ² of the variance polynomials, [tile_row][tile_col]; null for positions without a frame pixel."""

    chi2_per_dof: list[list[float | None]]


class FrameSection(_Section):
    """``aps``: results from dark and lit frames."""

    beta: list[list[_Beta]] = Field(min_length=1)
    goodness: FrameGoodness
    black_dn: float
    n_row_std_dn: float = Field(ge=0)
    row_noise_dn: EstimateSpec | None = Field(None, description="temporal noise of rows")
    column_noise_dn: EstimateSpec | None = Field(None, description="of captures of EMVA 1288 alone, as the next six")
    column_offset_std_dn: float | None = Field(None, ge=0)
    nonlinearity: list[float] | None = Field(None, min_length=3, max_length=3)
    read_noise_correlation: EstimateSpec | None = None
    interference: list[dict[str, float]] | None = None
    responsivity: EstimateSpec | None = None
    quantum_efficiency: EstimateSpec | None = None
    bad_pixels: NonNegativeInt
    telegraph_pixels: NonNegativeInt | None = Field(None, description="where the captures tell it")
    K: EstimateSpec
    read_noise_e: EstimateSpec
    dark_current_e_per_s: EstimateSpec
    full_well_e: FullWell
    dsnu_e: EstimateSpec
    prnu_percent: EstimateSpec
    linearity_error_percent: EstimateSpec
    findings: list[FindingSpec] = []
    maps: MapsFile
    frame_rate_hz: PositiveFloat | None = Field(None, description="of the captures, where it is known")

    @property
    def interval_s(self) -> float | None:
        """From one frame to the next, s; None where it is not known."""
        return None if self.frame_rate_hz is None else 1.0 / self.frame_rate_hz


class EventParameters(_Section):
    """A, B, C and D of all event pixels together, or of a tile position."""

    A: EstimateSpec
    B: EstimateSpec
    C: EstimateSpec
    D: EstimateSpec


class PositionParameters(EventParameters):
    """Parameters of one tile position (row, col)."""

    tile_position: tuple[NonNegativeInt, NonNegativeInt]


class EventGoodness(_Section):
    """χ² of the counts."""

    chi2_per_dof: float | None


class EventSection(EventParameters):
    """``evs``: results from event counts and contrast steps."""

    theta_hardware_v: PositiveFloat | EstimateSpec
    shot_law: Literal["linear", "sqrt"]
    positions: list[PositionParameters] = Field(min_length=1)
    theta: EstimateSpec
    theta_on: EstimateSpec
    theta_off: EstimateSpec
    threshold_mismatch_rel: EstimateSpec
    asymmetry: EstimateSpec
    leak_per_trial: EstimateSpec
    leak_rate_hz: EstimateSpec | None = Field(
        None, description="missing where the period of the comparisons is not known"
    )
    tick_us: PositiveFloat | None = Field(
        None, description="period of the comparisons of the captures, µs, where it is known"
    )
    goodness: EventGoodness
    trials: PositiveInt
    bad_pixels: NonNegativeInt
    defects: dict[Literal["stuck", "hot", "flickering", "other"], NonNegativeInt] | None = Field(
        None, description="bad pixels by what they do"
    )
    findings: list[FindingSpec] = []
    maps: MapsFile

    @property
    def interval_s(self) -> float | None:
        """From one comparison to the next, s; None where it is not known."""
        return None if self.tick_us is None else self.tick_us * S_PER_US


class NoiseInLight(EstimateSpec):
    """σ of ln x in one light."""

    signal_dn: float = Field(ge=0)


class AsynchronousGoodness(EventGoodness):
    """χ² of first events after a reset, together and by kind."""

    dof: int
    p_value: float | None
    steps_p_value: float | None
    times_p_value: float | None
    steady_p_value: float | None


class AsynchronousSection(_Section):
    """``evs`` of a sensor without fixed comparisons: from trials after a reset."""

    reference: Literal["last_event"]
    shot_law: Literal["linear", "sqrt"]
    beta: list[_Beta] = Field(min_length=1)
    theta: EstimateSpec
    theta_on: EstimateSpec
    theta_off: EstimateSpec
    threshold_mismatch_rel: EstimateSpec
    threshold_mismatch_on_rel: EstimateSpec
    threshold_mismatch_off_rel: EstimateSpec
    noise_cutoff_hz: EstimateSpec
    leak_rate_hz: EstimateSpec
    noise: list[NoiseInLight] = []
    goodness: AsynchronousGoodness
    bad_pixels: NonNegativeInt
    findings: list[FindingSpec] = []
    maps: MapsFile

    @property
    def interval_s(self) -> None:
        """None: there are no comparisons at fixed times."""
        return None


def _kind_of_events(section: Any) -> str:
    is_asynchronous = isinstance(section, dict) and section.get("reference") == "last_event"
    return "asynchronous" if is_asynchronous else "fixed comparisons"


class CalibrationSpec(Strict):
    """``calibration.yaml``; `capture` is the ``capture.yaml`` of the captures."""

    schema_version: int
    capture: CaptureSpec
    aps: FrameSection | None = None
    evs: (
        Annotated[
            Annotated[EventSection, Tag("fixed comparisons")] | Annotated[AsynchronousSection, Tag("asynchronous")],
            Discriminator(_kind_of_events),
        ]
        | None
    ) = None

    @field_validator("schema_version", mode="before")
    @classmethod
    def _version(cls, value: Any) -> Any:
        if type(value) is not int or value != SCHEMA_VERSION:
            raise ValueError(f"expected {SCHEMA_VERSION}, a calibration of this version")
        return value

    @model_validator(mode="after")
    def _check(self) -> "CalibrationSpec":
        tile = self.capture.tile_rows, self.capture.tile_cols
        for name in ("beta", "goodness.chi2_per_dof"):
            if self.aps is None:
                break
            table = self.aps.beta if name == "beta" else self.aps.goodness.chi2_per_dof
            if len(table) != tile[0] or any(len(row) != tile[1] for row in table):
                raise ValueError(f"aps.{name}: expected a table of {tile[0]}×{tile[1]}, one entry a tile position")
        return self

    @property
    def sections(self) -> dict[str, FrameSection | EventSection | AsynchronousSection]:
        """The sections that the file has, by name."""
        result = {"aps": self.aps, "evs": self.evs}
        return {name: section for name, section in result.items() if section is not None}

"""The model of ``recording.json``; a manifest is validated before any part of it is used."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    field_validator,
    model_validator,
)

from hesim_render.core.guard import MOST_PIXELS
from hesim_render.core.names import PathBelow
from hesim_render.mosaic.description import Mosaic
from hesim_render.specs.files import Strict
from hesim_render.specs.geometry import Region

_LATEST_US = 2**53  # 285 years


class _OpenSection(BaseModel):
    """A part to which a run may add any keys; the keys that are read are validated."""

    model_config = ConfigDict(extra="allow")


class _StatedError(_OpenSection):
    rms: float
    p95: float
    p99: float


class _AuditedPart(_OpenSection):
    off: float
    off_at_most: float
    true_events: int | None = None
    found_events: int | None = None
    missed: float | None = None
    missed_at_most: float | None = None
    extra: float | None = None
    extra_at_most: float | None = None

    @model_validator(mode="after")
    def _check(self) -> "_AuditedPart":
        shares = (self.missed, self.missed_at_most, self.extra, self.extra_at_most)
        if (self.true_events or self.found_events) and any(share is None for share in shares):
            raise ValueError("true_events, found_events: need missed, extra and their _at_most beside them")
        return self


class _Audit(_OpenSection):
    tolerance_noise: float
    verdict: Literal["met", "not shown", "not met"]
    quality_needed: float | None = None
    samples_needed: int | None = None
    short_of_rays: float | None = None
    events: _AuditedPart | None = None
    frames: _AuditedPart | None = None

    @model_validator(mode="after")
    def _check(self) -> "_Audit":
        reasons = self.quality_needed, self.samples_needed, self.short_of_rays
        if self.verdict == "not met" and all(reason is None for reason in reasons):
            raise ValueError(
                "quality_needed, samples_needed or short_of_rays is required where the verdict is 'not met'"
            )
        return self


class _Render(_OpenSection):
    error_noise: dict[str, _StatedError | None]
    quality: float | None = None
    audit: _Audit | None = None


class _Video(_OpenSection):
    source: str
    notes: list[str] = []


class _Settings(_OpenSection):
    clean: bool = False
    without: list[str] = []
    render: _Render | None = None
    video: _Video | None = None


class _Time(Strict):
    begin_us: int = Field(ge=0, le=_LATEST_US)
    end_us: int = Field(ge=0, le=_LATEST_US)

    @model_validator(mode="after")
    def _check(self) -> "_Time":
        if self.end_us < self.begin_us:
            raise ValueError("end_us: lies before begin_us")
        return self


class _Grid(Strict):
    width: int = Field(ge=0, le=65536)
    height: int = Field(ge=0, le=65536)


class _Lens(Strict):
    f_number: PositiveFloat
    focal_length_mm: PositiveFloat
    magnification: NonNegativeFloat
    axis_mm: tuple[float, float] = Field((0.0, 0.0), description="default of recordings that lack it")
    effects: dict[str, Any] = Field({}, description="aberrations that are on, as in the sensor file")


class _Source(Strict):
    """A file from which the recording was made."""

    name: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    spec: dict[str, Any]

    @field_validator("spec")
    @classmethod
    def _self_contained(cls, spec: dict[str, Any]) -> dict[str, Any]:
        if _names_a_table(spec):
            raise ValueError("names a CSV file; the numbers must stand here")
        return spec


class _SensorFile(_Source):
    file: str

    @field_validator("spec")
    @classmethod
    def _has_its_kernels(cls, spec: dict[str, Any]) -> dict[str, Any]:
        lens = spec.get("lens")
        psf = lens.get("psf") if isinstance(lens, Mapping) else None
        if isinstance(psf, Mapping) and psf.get("file") is not None:
            raise ValueError("names a file of a PSF; the numbers must stand here")
        return spec


class _SceneFile(_Source):
    files_sha256: dict[str, str] = {}


class _Counts(Strict):
    frames: NonNegativeInt
    events: NonNegativeInt
    events_on: NonNegativeInt
    events_off: NonNegativeInt
    events_dropped: NonNegativeInt = 0

    @model_validator(mode="after")
    def _check(self) -> "_Counts":
        if self.events != self.events_on + self.events_off:
            raise ValueError("events: must be events_on and events_off together")
        return self


class _FrameEntry(Strict):
    index: int = Field(ge=0, lt=10**9)
    t_us: int = Field(ge=0, le=2 * _LATEST_US)
    exposure_start_us: int = Field(ge=0, le=_LATEST_US)
    exposure_us: int = Field(gt=0, le=_LATEST_US)
    line_time_us: NonNegativeFloat
    file: PathBelow
    truth: PathBelow


class RecordingSpec(Strict):
    """``recording.json``."""

    schema_version: Literal[1]
    software: dict[str, str]
    seed: int = Field(ge=0, lt=2**64)
    settings: _Settings
    time: _Time
    roi: Region
    event_grid: _Grid
    mosaic: Mosaic
    lens: _Lens
    sensor: _SensorFile
    scene: _SceneFile | None
    counts: _Counts
    frames: list[_FrameEntry]
    units: dict[str, str]
    masks: dict[str, str]

    @model_validator(mode="after")
    def _check(self) -> "RecordingSpec":
        if self.counts.frames != len(self.frames):
            raise ValueError(f"counts.frames: is {self.counts.frames}, but frames lists {len(self.frames)}")
        if (self.event_grid.width == 0) != (self.event_grid.height == 0):
            raise ValueError("event_grid: width and height are both 0 or neither")
        if self.event_grid.width * self.event_grid.height > MOST_PIXELS:
            raise ValueError(f"event_grid: more than {MOST_PIXELS} pixels, as no sensor has")
        if len({frame.index for frame in self.frames}) != len(self.frames):
            raise ValueError("frames: two have the same index")
        times = [frame.t_us for frame in self.frames]
        if any(later < earlier for earlier, later in pairwise(times)):
            raise ValueError("frames: are not in order of time")
        return self


def _names_a_table(node: Any) -> bool:
    """True if a dumped spec names a CSV file, which would be read relative to the recording."""
    if isinstance(node, Mapping):
        return any((key == "csv" and value is not None) or _names_a_table(value) for key, value in node.items())
    if isinstance(node, list):
        return any(map(_names_a_table, node))
    return isinstance(node, str) and node.endswith(".csv")

"""The file of a sweep: keys that vary, seeds, and what is tabulated of every run."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from hesim_render.core.errors import did_you_mean
from hesim_render.specs.files import Strict
from hesim_render.specs.study import TaskFile

#: Most runs of a sweep.
MOST_RUNS = 100_000
_Scalar = str | float | int | bool
#: Figures of a recording; those that begin with picture are of its first frame after the ISP.
METRICS = (
    "frames", "electrons", "raw_mean", "raw_variance", "snr", "events", "event_rate", "on_share", "mtf50", "mtf10",
    "mtf_nyquist", "picture_mean", "picture_psnr", "picture_ssim", "picture_delta_e", "picture_mtf50", "isp_report",
)  # fmt: skip


class RangeSpec(Strict):
    """Evenly spaced values, on a linear or logarithmic scale; `whole` numbers where the key takes no others."""

    first: float
    last: float
    count: int = Field(ge=2, le=10_000)
    scale: Literal["linear", "log"] = "linear"
    whole: bool = Field(False, description="rounded to whole numbers, each once")

    @model_validator(mode="after")
    def _check(self) -> "RangeSpec":
        if self.scale == "log" and (self.first <= 0 or self.last <= 0):
            raise ValueError("a logarithmic range needs ends above 0")
        return self

    def values(self) -> Sequence[float]:
        """The values, both ends included."""
        import numpy as np

        space = np.geomspace if self.scale == "log" else np.linspace
        values = space(self.first, self.last, self.count)
        if self.whole:
            return list(dict.fromkeys(int(value) for value in np.rint(values)))
        return [float(f"{value:.12g}") for value in values]


class SweepSpec(TaskFile):
    """A sweep over keys of scenes, sensors and ISP steps, or over keys of a study of filter sets."""

    study: str | None = Field(None, description="name or file of a study, in place of scenes and sensors")
    scenes: list[str] = []
    sensors: list[str] = []
    roi: str | None = Field(None, description="part of the sensor: WIDTHxHEIGHT, px")
    duration_s: float = Field(0.1, gt=0, le=1e6)
    vary: dict[str, list[Any] | RangeSpec] = Field(
        {}, description="keys as in --set (light.illuminance_lux, sensor.aps.exposure_us, isp.demosaic.method)"
    )
    seeds: list[Annotated[int, Field(ge=0, lt=2**64)]] = Field([7], min_length=1)
    isp: str | None = Field(None, description="file of a pipeline; default: the ISP's own without noise reduction")
    options: dict[str, _Scalar] = Field({}, description="quality, samples, exact or clean, as for simulate")
    metrics: list[str] = Field([], description="of recordings, or columns of a study; default: three, or all")
    keep: bool = Field(False, description="keep the recordings, not only their figures")

    @field_validator("vary", mode="before")
    @classmethod
    def _values(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        result = {}
        for key, values in value.items():
            if isinstance(values, dict):
                try:
                    values = RangeSpec.model_validate(values)
                except ValidationError as error:
                    problem = error.errors(include_url=False)[0]
                    place = ".".join(map(str, (key, *problem["loc"])))
                    raise ValueError(f"{place}: {problem['msg'].removeprefix('Value error, ')}") from None
            elif isinstance(values, list) and not values:
                raise ValueError(f"{key}: a list of values is empty")
            result[key] = values
        return result

    @field_validator("options")
    @classmethod
    def _known(cls, value: dict[str, Any]) -> dict[str, Any]:
        for key in value:
            if key not in ("quality", "samples", "exact", "clean"):
                raise ValueError(f"{key}: expected quality, samples, exact or clean")
        return value

    @model_validator(mode="after")
    def _kind(self) -> "SweepSpec":
        if self.study is None:
            if not self.scenes or not self.sensors:
                raise ValueError("a sweep needs 'scenes' and 'sensors', or a 'study'")
            for name in self.metrics:
                if name not in METRICS:
                    raise ValueError(f"metrics: unknown {name!r}{did_you_mean(name, METRICS)}; {', '.join(METRICS)}")
            return self
        given = {"scenes", "sensors", "roi", "duration_s", "isp", "options", "keep"} & self.model_fields_set
        if given:
            raise ValueError(f"{', '.join(sorted(given))}: not in a sweep of a study, whose file says these things")
        return self

    @property
    def wanted(self) -> list[str]:
        """The metrics of a sweep of recordings."""
        return self.metrics or ["electrons", "snr", "event_rate"]

    @model_validator(mode="after")
    def _countable(self) -> "SweepSpec":
        total = max(1, len(self.scenes)) * max(1, len(self.sensors)) * len(self.seeds)
        for values in self.vary.values():
            total *= values.count if isinstance(values, RangeSpec) else len(values)
        if total > MOST_RUNS:
            raise ValueError(f"vary: makes {total} runs, more than {MOST_RUNS}")
        return self

"""``bench.yaml``: recordings that were made of event pixels on a bench, and the light of each."""

from typing import Literal

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict


class BenchRecording(Strict):
    """A recording of even light.

    Its file is named relative to the folder of ``bench.yaml``.
    """

    file: str = Field(min_length=1)
    lux: float = Field(ge=0, le=1e7, description="illuminance on the sensor, lx; of steps, that of the lower level")
    temperature_c: float | None = Field(None, ge=-100, le=200, description="of the sensor; default that of the bench")
    interval_us: tuple[int, int] | None = Field(
        None, description="begin and end of the recording, µs; default the times of its first and last event"
    )

    @model_validator(mode="after")
    def _check_interval(self) -> "BenchRecording":
        if self.interval_us is not None and not 0 <= self.interval_us[0] < self.interval_us[1]:
            raise ValueError("interval_us: expected a begin of 0 or more and a later end")
        return self


class Steady(BenchRecording):
    """Light that stays."""


class LightSteps(BenchRecording):
    """Light that jumps between `lux` and `lux`·(1 + contrast), and stays at each level for half a period."""

    lux: float = Field(gt=0, le=1e7)
    contrast: float = Field(gt=0, le=1e4, description="(L₁ − L₀)/L₀")
    begin_us: int | None = Field(None, ge=0, le=10**15, description="time of the first rise, µs")
    period_us: int | None = Field(None, ge=4, le=10**12, description="from one rise to the next, µs")
    trigger: int | None = Field(None, ge=0, le=255, description="line whose rising edges are rises of the light")
    window_us: int | None = Field(None, ge=2, description="time in which an answer counts; default until the next jump")
    reset: bool = Field(False, description="before each jump, all pixels were reset to the level from which it starts")

    @model_validator(mode="after")
    def _check(self) -> "LightSteps":
        if (self.begin_us is None) != (self.period_us is None) or (self.begin_us is None) == (self.trigger is None):
            raise ValueError("give begin_us and period_us, or trigger, to say when the light jumps")
        return self


class Bursts(Strict):
    """Modulation that comes in bursts. Before each, the light stays at its mean.

    In a burst, ln(L/lux) is A/2·sin²(π·t/length_us)·sin(2π·hz·t), with A = ln((1 + depth)/(1 − depth)).
    """

    begin_us: int = Field(ge=0, le=10**15, description="begin of the first burst, µs")
    length_us: int = Field(ge=4, le=10**12, description="of a burst, µs; four cycles or more")
    period_us: int = Field(ge=5, le=10**12, description="from the begin of a burst to that of the next, µs")


class Modulation(BenchRecording):
    """Light lux·(1 + depth·sin(2π·hz·t)), always or in bursts."""

    lux: float = Field(gt=0, le=1e7, description="mean illuminance on the sensor, lx")
    hz: float = Field(gt=0, le=1e6)
    depth: float = Field(gt=0, lt=1, description="(L_max − L_min)/(L_max + L_min)")
    bursts: Bursts | None = Field(None, description="for pixels whose dead time is not short against a cycle")

    @model_validator(mode="after")
    def _check(self) -> "Modulation":
        if self.bursts is not None:
            if self.bursts.length_us * self.hz < 4e6 * (1 - 1e-9):
                raise ValueError("bursts.length_us: expected four cycles of hz or more")
            if self.bursts.period_us <= self.bursts.length_us:
                raise ValueError("bursts.period_us: expected more than length_us")
        return self


class EventBenchSpec(Strict):
    """``bench.yaml``."""

    schema_version: Literal[1] = 1
    sensor: str = Field(min_length=1, max_length=200, description="its name, for the title of the report")
    notes: str = ""
    simulated: bool = Field(False, description="of a sensor whose model does not know its temperature")
    rows: int | None = Field(None, ge=1, le=65536, description="of the event grid, where files do not state it")
    cols: int | None = Field(None, ge=1, le=65536)
    temperature_c: float | None = Field(None, ge=-100, le=200, description="of the sensor during all recordings")
    steady: list[Steady] = Field(default_factory=list, max_length=1000)
    steps: list[LightSteps] = Field(default_factory=list, max_length=1000)
    modulation: list[Modulation] = Field(default_factory=list, max_length=1000)
    busy: list[str] = Field(
        default_factory=list, max_length=1000, description="recordings of more events than the read-out takes"
    )
    frames: str | None = Field(None, description="folder of EMVA 1288 captures of the same sensor")

    @model_validator(mode="after")
    def _check(self) -> "EventBenchSpec":
        if (self.rows is None) != (self.cols is None):
            raise ValueError("rows and cols are given together or not at all")
        if not (self.steady or self.steps or self.modulation or self.busy or self.frames):
            raise ValueError("names no recording: expected steady, steps, modulation, busy or frames")
        return self

"""The waveform of a flickering light in a scene file."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict
from hesim_render.spectral import waveform

#: Times are whole µs in the sensor, where a faster light would be steady.
_Frequency = Annotated[float, Field(gt=0, le=100_000)]


class MainsSpec(Strict):
    """w(t) = 1 + depth · cos(2π · 2 · frequency_hz · t + phase): power at twice the mains frequency."""

    type: Literal["mains"]
    frequency_hz: _Frequency = Field(description="of the mains, 50 or 60; the light has twice that")
    depth: float = Field(ge=0, le=1, description="(max − min)/(max + min) of the light")
    phase_deg: float = 0.0

    def load(self) -> waveform.Waveform:
        return waveform.Mains(self.frequency_hz, self.depth, self.phase_deg)


class PwmSpec(Strict):
    """On (1/duty of the mean) while frac(frequency_hz · t + phase/360°) < duty, else off."""

    type: Literal["pwm"]
    frequency_hz: _Frequency
    duty: float = Field(gt=0, le=1, description="part of each period in which the light is on")
    phase_deg: float = Field(0.0, description="0: switched on at t = 0")

    def load(self) -> waveform.Waveform:
        return waveform.Pwm(self.frequency_hz, self.duty, self.phase_deg)


class TableWaveformSpec(Strict):
    """Measured power, linear between its samples; its unit does not matter."""

    type: Literal["table"]
    t_us: tuple[float, ...] = Field(min_length=2, description="times of `value`, µs, increasing")
    value: tuple[Annotated[float, Field(ge=0)], ...] = Field(description="power, 0 or more")
    repeat: bool = Field(False, description="start over after the last sample; else the end values hold")

    @model_validator(mode="after")
    def _check(self) -> TableWaveformSpec:
        if len(self.value) != len(self.t_us):
            raise ValueError(f"value: {len(self.value)} values for {len(self.t_us)} times")
        for earlier, later in pairwise(self.t_us):
            if later - earlier < 1e-3:
                raise ValueError(f"t_us: times must increase by 0.001 µs or more: {later:g} µs follows {earlier:g} µs")
        if not any(self.value):
            raise ValueError("value: a light that is always off has no waveform; its level is given in lux or watts")
        return self

    def load(self) -> waveform.Waveform:
        return waveform.TableWaveform(self.t_us, self.value, self.repeat)


WaveformSpec = Annotated[MainsSpec | PwmSpec | TableWaveformSpec, Field(discriminator="type")]

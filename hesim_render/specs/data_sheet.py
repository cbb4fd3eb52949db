"""Event pixels in the terms of data sheets, and in those of v2e, as a sensor file has them."""

from typing import Annotated

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict
from hesim_render.specs.spectrum import SpectrumSpec

_Lux = Annotated[float, Field(ge=0, le=1e7, description="illuminance on the sensor, in the light of `light`, lx")]
_Percent = Annotated[float, Field(ge=0.01, le=1000)]


class BackgroundSpec(Strict):
    """Background activity of a pixel in steady light: all events, noise and leak together, mean over pixels."""

    lux: _Lux
    rate_hz: float = Field(gt=0, le=1e6, description="ON and OFF events of one pixel, 1/s")


class SpeedSpec(Strict):
    """Speed of a pixel at an illuminance: the latency of an event after a step, or the bandwidth."""

    lux: Annotated[float, Field(ge=1e-6, le=1e7, description="illuminance on the sensor before the step, lx")]
    latency_us: float | None = Field(None, ge=0.1, le=1e9, description="from a step of contrast to the event, µs")
    bandwidth_hz: float | None = Field(None, ge=1e-2, le=1e6, description="-3 dB frequency of the photoreceptor, Hz")

    @model_validator(mode="after")
    def _one(self) -> "SpeedSpec":
        if (self.latency_us is None) == (self.bandwidth_hz is None):
            raise ValueError("speed needs latency_us or bandwidth_hz, and not both")
        return self


class DataSheetSpec(Strict):
    """Figures of a data sheet. A contrast is (L_max − L_min)/L_min for both signs, so that θ = ln(1 + c)."""

    light: SpectrumSpec = Field(SpectrumSpec(illuminant="LED-B2"), description="light of all illuminances")
    threshold_on_percent: _Percent = Field(description="contrast that gives an ON event in half of the pixels, %")
    threshold_off_percent: _Percent = Field(description="the same for OFF events, %")
    threshold_mismatch_percent: float = Field(0.0, ge=0, le=300, description="std of it over pixels, % of contrast")
    background: list[BackgroundSpec] = Field([], max_length=2, description="none: ln x has no noise")
    dark_lux: float | None = Field(
        None, ge=1e-6, le=1e6, description="illuminance with as much photocurrent as the dark current; from two "
        "background rates otherwise"
    )  # fmt: skip
    noise_cutoff_hz: float | None = Field(
        None, ge=1e-2, le=1e6, description="-3 dB frequency of the noise in bright light; default that of the speed. "
        "In dim light the speed limits it"
    )  # fmt: skip
    leak_hz: float = Field(0.0, ge=0, le=1e6, description="ON events of the leak, per pixel, 1/s")
    speed: list[SpeedSpec] = Field([], max_length=2, description="at one or two illuminances; none: unlimited")
    speed_step_percent: _Percent = Field(100.0, description="contrast of the step that latencies are stated for")
    refractory_us: int | None = Field(None, ge=1, le=10**9, description="dead time after an event")

    @model_validator(mode="after")
    def _check(self) -> "DataSheetSpec":
        if len(self.background) == 2 and self.dark_lux is not None:
            raise ValueError("dark_lux follows from two background rates: leave one of them out")
        if len(self.background) == 1 and self.dark_lux is None:
            raise ValueError("background at one illuminance needs dark_lux, or a second illuminance")
        if self.speed and self.dark_lux is None:
            raise ValueError("speed needs dark_lux: the pixel's speed in the dark is that of its dark current")
        if self.noise_cutoff_hz is None and not self.speed:
            raise ValueError("noise_cutoff_hz is needed where no speed is given")
        if self.speed and len(self.background) == 2:
            raise ValueError("background at two illuminances does not go with speed, which tells how the noise follows "
                             "the light: leave one of them out, or the speed")  # fmt: skip
        for name, levels in (("background", self.background), ("speed", self.speed)):
            if len(levels) == 2 and levels[0].lux == levels[1].lux:  # type: ignore[attr-defined]
                raise ValueError(f"{name} is stated twice for {levels[0].lux:g} lx")  # type: ignore[attr-defined]
        for level in self.background:
            if level.rate_hz <= self.leak_hz:
                raise ValueError(
                    f"background of {level.rate_hz:g} Hz at {level.lux:g} lx is not above leak_hz {self.leak_hz:g}: "
                    "the background includes the leak"
                )
        return self


class V2eSpec(Strict):
    """Options of v2e with its names, units and meanings; `white_lux` puts its grey levels in absolute light."""

    pos_thres: float = Field(ge=0.01, le=10, description="θ₊, ln units")
    neg_thres: float = Field(ge=0.01, le=10, description="θ₋, ln units")
    sigma_thres: float = Field(0.0, ge=0, le=10, description="std of both over pixels, ln units")
    cutoff_hz: float = Field(0.0, ge=0, le=1e6, description="photoreceptor at white; 0: unlimited")
    leak_rate_hz: float = Field(0.0, ge=0, le=1e6, description="ON events per pixel, 1/s")
    shot_noise_rate_hz: float = Field(
        0.0, ge=0, le=1e6, description="ON and OFF events in the dark; a quarter at white"
    )
    refractory_period_s: float = Field(0.0, ge=0, le=1000, description="dead time; 0: none")
    white_lux: float = Field(ge=1e-3, le=1e7, description="illuminance on the sensor that is white (255) in v2e")
    light: SpectrumSpec = Field(SpectrumSpec(illuminant="D65"), description="light of that illuminance")

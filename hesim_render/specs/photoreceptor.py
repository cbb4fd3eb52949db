"""The photoreceptor of event pixels, as a sensor file describes it."""

from __future__ import annotations

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict


class PhotoreceptorSpec(Strict):
    """Second-order low-pass of ln x before it is compared: two equal poles, −3 dB together at the corner."""

    cutoff_hz: float = Field(
        ge=1e-3, le=1e6, description="corner at signal_dn and above, where the bias current limits it"
    )
    follows_light: bool = Field(True, description="below signal_dn the corner falls with the signal")
    signal_dn: float | None = Field(None, ge=1e-9, le=1e9, description="signal of which the corner is cutoff_hz")
    min_cutoff_hz: float | None = Field(
        None, ge=1e-3, le=1e6, description="corner in the dark; up to signal_dn it rises on a straight line"
    )
    filters_noise: bool = Field(
        False, description="the noise (last_event) passes it too: below photoreceptor_cutoff_hz its bandwidth is the "
        "corner, and its variance falls with it"
    )  # fmt: skip

    @model_validator(mode="after")
    def _check(self) -> PhotoreceptorSpec:
        if self.follows_light:
            if self.signal_dn is None or self.min_cutoff_hz is None:
                raise ValueError("a corner that follows the light needs signal_dn and min_cutoff_hz")
            if self.min_cutoff_hz > self.cutoff_hz:
                raise ValueError(f"min_cutoff_hz {self.min_cutoff_hz:g} is above cutoff_hz {self.cutoff_hz:g}")
        elif self.signal_dn is not None or self.min_cutoff_hz is not None:
            raise ValueError("without follows_light the corner is cutoff_hz: leave signal_dn and min_cutoff_hz out")
        elif self.filters_noise:
            raise ValueError("filters_noise needs follows_light; otherwise photoreceptor_cutoff_hz says the same")
        return self

"""Pixels that misbehave, as a sensor file describes them: events that are not the scene's, values of two levels."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict

#: Largest part of the pixels that may have a defect: beyond, it is what pixels do.
_MOST = 0.5


class EventDefectSpec(Strict):
    """Event pixels that are stuck, hot or flickering; the device seed says which, and a pixel has one defect."""

    stuck_share: float = Field(0.0, ge=0, le=_MOST, description="part of the pixels that never give an event")
    hot_share: float = Field(
        0.0, ge=0, le=_MOST, description="part that gives ON events of its own, whatever the light"
    )
    hot_rate_hz: float | None = Field(None, ge=1e-6, le=1e5, description="of those events, median over hot pixels")
    hot_rate_spread_decades: float = Field(0.0, ge=0, le=2, description="std over hot pixels of log10 of that rate")
    flickering_share: float = Field(0.0, ge=0, le=_MOST, description="part that does so now and then")
    flickering_rate_hz: float | None = Field(None, ge=1e-6, le=1e5, description="of ON events while it fires")
    flickering_firing_s: float | None = Field(None, ge=1e-5, le=1e6, description="mean time for which it fires")
    flickering_quiet_s: float | None = Field(None, ge=1e-5, le=1e6, description="mean time for which it does not")

    @model_validator(mode="after")
    def _check(self) -> EventDefectSpec:
        if self.hot_share > 0 and self.hot_rate_hz is None:
            raise ValueError("hot_share needs hot_rate_hz")
        timing = (self.flickering_rate_hz, self.flickering_firing_s, self.flickering_quiet_s)
        if self.flickering_share > 0 and None in timing:
            raise ValueError("flickering_share needs flickering_rate_hz, flickering_firing_s and flickering_quiet_s")
        if self.stuck_share + self.hot_share + self.flickering_share > _MOST:
            raise ValueError(f"the shares add up to more than {_MOST:g}")
        return self


class TelegraphSpec(Strict):
    """Frame pixels with random telegraph noise: two levels `amplitude` apart, about the pixel's own mean."""

    share: float = Field(ge=0, le=_MOST, description="part of the pixels; which ones follows from the device seed")
    amplitude_e: float = Field(ge=0, le=1e6, description="high level less low one, mean over these pixels")
    amplitude_law: Literal["exponential", "equal"] = Field("exponential", description="over these pixels")
    high_s: float = Field(ge=1e-5, le=1e6, description="mean time at the high level")
    low_s: float = Field(ge=1e-5, le=1e6, description="mean time at the low level")

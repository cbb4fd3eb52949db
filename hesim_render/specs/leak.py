"""The leak of event pixels, as a sensor file describes it."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from hesim_render.specs.files import Strict

#: Fastest leak of the pixels in the tail, Hz.
MOST_TAIL_HZ = 1000.0


class LeakSpec(Strict):
    """ON events in still light: a Poisson process, or a reference level that drifts."""

    process: Literal["drift", "poisson"] = Field(
        description="drift: the reference drifts down, towards ON events; poisson: events at random times"
    )
    rate_hz: float = Field(ge=0, le=1e6, description="ON events of a pixel of nominal threshold, in the dark, 1/s")
    rate_hz_per_dn: float = Field(0.0, ge=0, le=1e9, description="growth of that rate with the signal (drift)")
    spread: float = Field(0.0, ge=0, lt=1, description="std over pixels of both together, relative (drift)")
    tail_hz: float = Field(
        0.0, ge=0, lt=MOST_TAIL_HZ, description="a share tail_hz/(tail_hz + r) of the pixels leaks faster by more than "
        "r (drift)"
    )  # fmt: skip

    @model_validator(mode="after")
    def _check(self) -> LeakSpec:
        if self.process == "poisson" and (self.rate_hz_per_dn or self.spread or self.tail_hz):
            raise ValueError(
                "rate_hz_per_dn, spread and tail_hz belong to process 'drift'; 'poisson' has rate_hz alone"
            )
        return self

    def mean_rate_hz(self, signal_dn: float) -> float:
        """Rate of the leak of pixels of nominal threshold, mean over pixels, Hz.

        Parameters
        ----------
        signal_dn : signal, DN.
        """
        if self.tail_hz == 0:
            return self.rate_hz + self.rate_hz_per_dn * signal_dn
        most = MOST_TAIL_HZ / (self.tail_hz + MOST_TAIL_HZ)
        tail_hz = self.tail_hz * (-math.log1p(-most) - most) / most
        return self.rate_hz + self.rate_hz_per_dn * signal_dn + tail_hz

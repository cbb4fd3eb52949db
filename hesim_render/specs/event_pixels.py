"""The ``evs`` section of a sensor file: event pixels, their thresholds and their noise.

Pixels that misbehave, as a sensor file describes them: events that are not the scene's, values of two levels.

The leak of event pixels, as a sensor file describes it.

The photoreceptor of event pixels, as a sensor file describes it.
"""

import math
from typing import Literal

from pydantic import Field, model_validator

from hesim_render.specs.data_sheet import DataSheetSpec, V2eSpec
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
    def _check(self) -> "EventDefectSpec":
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
        False, description="the noise (last_event) passes it too: below noise_cutoff_hz its bandwidth is the "
        "corner, and its variance falls with it"
    )  # fmt: skip
    approach: Literal["abrupt", "gradual"] = Field(
        "abrupt", description="how the corner comes to cutoff_hz: a line up to it, or time constants of light and bias "
        "add up, which takes a decade of light"
    )  # fmt: skip

    @model_validator(mode="after")
    def _check(self) -> "PhotoreceptorSpec":
        if self.follows_light:
            if self.signal_dn is None or self.min_cutoff_hz is None:
                raise ValueError("a corner that follows the light needs signal_dn and min_cutoff_hz")
            if self.min_cutoff_hz > self.cutoff_hz:
                raise ValueError(f"min_cutoff_hz {self.min_cutoff_hz:g} is above cutoff_hz {self.cutoff_hz:g}")
        elif self.signal_dn is not None or self.min_cutoff_hz is not None:
            raise ValueError("without follows_light the corner is cutoff_hz: leave signal_dn and min_cutoff_hz out")
        elif self.filters_noise:
            raise ValueError("filters_noise needs follows_light; otherwise noise_cutoff_hz says the same")
        elif self.approach == "gradual":
            raise ValueError("approach 'gradual' needs follows_light; a corner that is the same in any light has none")
        return self

    def series_hz(self, limit_hz: float) -> float | None:
        """Corner in series with that of the light, Hz; None where the approach is abrupt.

        Parameters
        ----------
        limit_hz : that corner; 0: cutoff_hz.
        """
        return (limit_hz or self.cutoff_hz) if self.approach == "gradual" else None


#: Fastest leak of the pixels in the tail, Hz.
MOST_TAIL_HZ = 1000.0


class LeakSpec(Strict):
    """ON events in still light: a Poisson process, or a reference level that drifts."""

    process: Literal["drift", "poisson"] = Field(
        description="drift: the reference drifts down, towards ON events; poisson: events at random times"
    )
    rate_hz: float = Field(ge=0, le=1e6, description="ON events of a pixel of nominal threshold, in the dark, 1/s")
    rate_hz_per_dn: float = Field(0.0, ge=0, le=1e9, description="growth of that rate with the signal (drift)")
    spread_rel: float = Field(0.0, ge=0, lt=1, description="std over pixels of both together, relative (drift)")
    tail_hz: float = Field(
        0.0, ge=0, lt=MOST_TAIL_HZ, description="a share tail_hz/(tail_hz + r) of the pixels leaks faster by more than "
        "r (drift)"
    )  # fmt: skip

    @model_validator(mode="after")
    def _check(self) -> "LeakSpec":
        if self.process == "poisson" and (self.rate_hz_per_dn or self.spread_rel or self.tail_hz):
            raise ValueError(
                "rate_hz_per_dn, spread and tail_hz belong to process 'drift'; 'poisson' has rate_hz alone"
            )
        return self

    def mean_rate_hz(self, signal_dn: float) -> float:
        """Rate of the leak of pixels of nominal threshold in a signal, DN, mean over pixels, Hz."""
        if self.tail_hz == 0:
            return self.rate_hz + self.rate_hz_per_dn * signal_dn
        most = MOST_TAIL_HZ / (self.tail_hz + MOST_TAIL_HZ)
        tail_hz = self.tail_hz * (-math.log1p(-most) - most) / most
        return self.rate_hz + self.rate_hz_per_dn * signal_dn + tail_hz


class NoiseSpreadSpec(Strict):
    """Bandwidth of the noise (last_event) that differs from pixel to pixel, about noise_cutoff_hz."""

    bandwidth_rel: float = Field(0.0, ge=0, le=1, description="std over pixels of its natural logarithm")
    odd_rows_rel: float = Field(
        0.0,
        gt=-1,
        lt=1,
        description="relative: rows 1, 3, 5 … of the event grid have so much more, the others so much less",
    )
    odd_cols_rel: float = Field(0.0, gt=-1, lt=1, description="the same of columns")

    @property
    def most(self) -> float:
        """Largest bandwidth of a pixel over noise_cutoff_hz: three deviations above the others of its kind."""
        return (1 + abs(self.odd_rows_rel)) * (1 + abs(self.odd_cols_rel)) * math.exp(3 * self.bandwidth_rel)


class ComparatorNoiseSpec(Strict):
    """Events of the comparators' own noise: a Poisson process of each polarity, whatever the light."""

    on_hz: float = Field(0.0, ge=0, le=1e6, description="ON events per pixel")
    off_hz: float = Field(0.0, ge=0, le=1e6, description="OFF events per pixel")


#: Smallest threshold if a change gives one event per threshold that it contains.
_LEAST_THRESHOLD = 1e-4


class SignalReferenceSpec(Strict):
    """Unit of the EVS signal: I = k · Φ · t_ref, in DN of this exposure seen through `filter`."""

    k_dn_per_e: float = Field(ge=1e-9, le=1e6)
    t_ref_us: float = Field(ge=1e-3, le=1e9)
    filter: str = Field(
        "own",
        description="'own', or a filter: Φ is then scaled by the ratio of responses to an equal-energy light",
    )


class EvsCoefficients(Strict):
    """Noise of one event position: x = β1 I + β2, s² from β3 (shot), β4 (dark), β5 (their correlation)."""

    beta1: float = Field(ge=0, le=1e9, description="V/DN, slope of the voltage map")
    beta2: float = Field(ge=1e-12, le=1e9, description="V, V_PD: the photodiode's baseline voltage")
    beta3: float = Field(ge=0, le=1e9, description="shot noise: V/DN for the linear law, V/√DN for the sqrt law")
    beta4: float = Field(ge=0, le=1e9, description="V, dark-current shot noise")
    beta5: float = Field(0.0, ge=-1, le=1, description="correlation of the two")


class SheetEvsSpec(Strict):
    """Event pixels whose thresholds and noise follow from a data sheet or from v2e's options: what a file then has."""

    reference: Literal["previous_sample", "last_event"]
    tick_us: int | None = Field(None, ge=1, le=10**9, description="period of the fixed comparisons (previous_sample)")
    window_us: int = Field(ge=1, le=10**9, description="integration window that ends at each sample")
    threshold_hardware_v: float | None = Field(None, ge=1e-9, le=1e6, description="Θ; β0 = θ/Θ where it is known")
    noise_mode: Literal["per_instant", "independent"] = "per_instant"
    data_sheet: DataSheetSpec | None = Field(None, description="figures that the values above follow from")
    v2e: V2eSpec | None = Field(None, description="options of v2e that they follow from")
    leak: LeakSpec | None = Field(None, description="in place of leak_rate_hz: which process the leak is")
    comparator_noise: ComparatorNoiseSpec | None = Field(
        None, description="events of both polarities at random times, whatever the light; default none"
    )
    noise_spread: NoiseSpreadSpec | None = Field(
        None, description="bandwidth of the noise over pixels (last_event); default the same in all"
    )
    defects: EventDefectSpec | None = Field(None, description="stuck, hot and flickering pixels; default none")
    readout_max_events_per_s: float | None = Field(
        None, ge=1e-3, le=1e12, description="events beyond are lost; default no limit"
    )
    readout_buffer_events: int | None = Field(
        None, ge=1, le=10**12, description="that can wait for the read-out; default what it takes in tick_us or 1 ms"
    )

    @model_validator(mode="after")
    def _check_sheet(self) -> "SheetEvsSpec":
        if self.data_sheet is not None and self.v2e is not None:
            raise ValueError("data_sheet and v2e say the same in two ways: leave one of them out")
        if self.leak is not None and self.leak.process == "drift" and self.reference != "last_event":
            raise ValueError(
                "leak.process 'drift' moves the reference of asynchronous pixels, reference 'last_event'; a fixed tick "
                "has process 'poisson'"
            )
        if self.noise_spread is not None and self.reference != "last_event":
            raise ValueError("noise_spread belongs to reference 'last_event'; noise of a fixed tick has no bandwidth")
        if (self.data_sheet or self.v2e) is not None and self.reference != "last_event":
            raise ValueError("data_sheet and v2e describe asynchronous pixels: they need reference 'last_event'")
        return self


#: The two sections that say the same as the keys which only `EvsSpec` has.
SHEETS = ("data_sheet", "v2e")


class EvsSpec(SheetEvsSpec):
    """Events: compare ΔV = ln x₁/x₀ + noise with θ₊ and θ₋ (ln units)."""

    contrast_threshold_on: float = Field(ge=1e-9, le=100)
    contrast_threshold_off: float = Field(ge=1e-9, le=100)
    threshold_mismatch_rel: float = Field(0.0, ge=0, lt=0.5, description="std over pixels of θ, relative")
    signal_reference: SignalReferenceSpec
    coefficients: list[EvsCoefficients] = Field(min_length=1, description="one for all, or one per event position")
    shot_law: Literal["linear", "sqrt"]
    leak_rate_hz: float = Field(0.0, ge=0, le=1e6, description="Poisson process of ON events, per pixel")
    noise_cutoff_hz: float | None = Field(
        None, ge=1e-3, le=1e6, description="-3 dB frequency of the noise (last_event)"
    )
    photoreceptor: PhotoreceptorSpec | None = Field(None, description="bandwidth of the signal; default unlimited")
    refractory_period_us: int | None = Field(
        None, ge=1, le=10**9, description="no event so long after a pixel's last one"
    )

    @model_validator(mode="after")
    def _check(self) -> "EvsSpec":
        if self.reference == "previous_sample":
            if self.tick_us is None:
                raise ValueError("reference 'previous_sample' needs tick_us")
            if self.window_us > self.tick_us:
                raise ValueError(f"window_us {self.window_us} is longer than tick_us {self.tick_us}")
        elif self.noise_cutoff_hz is None:
            raise ValueError("reference 'last_event' needs noise_cutoff_hz, the bandwidth of its noise")
        for key in ("contrast_threshold_on", "contrast_threshold_off"):
            # a change of several thresholds gives as many events in this mode
            if self.reference == "last_event" and getattr(self, key) < _LEAST_THRESHOLD:
                raise ValueError(f"{key} must be at least {_LEAST_THRESHOLD:g} with reference 'last_event'")
        if self.refractory_period_us is not None and self.reference != "last_event":
            raise ValueError("refractory_period_us belongs to reference 'last_event'; a fixed tick has none")
        if self.photoreceptor is not None and self.photoreceptor.filters_noise:
            if self.reference != "last_event":
                raise ValueError("photoreceptor.filters_noise belongs to reference 'last_event'")
            if self.noise_spread is not None:
                raise ValueError("noise_spread and photoreceptor.filters_noise both set bandwidths: leave one out")
            if (self.noise_cutoff_hz or 0.0) > self.photoreceptor.cutoff_hz:
                raise ValueError("noise_cutoff_hz is above photoreceptor.cutoff_hz, which filters the noise")
        if self.leak is not None and self.leak_rate_hz > 0:
            raise ValueError("leak and leak_rate_hz (or leak_hz of a data sheet) say the same: leave one of them out")
        if self.readout_buffer_events is not None and self.readout_max_events_per_s is None:
            raise ValueError("readout_buffer_events needs readout_max_events_per_s")
        follows_light = self.photoreceptor is not None and self.photoreceptor.follows_light
        if follows_light and any(entry.beta1 == 0 for entry in self.coefficients):
            raise ValueError("photoreceptor.follows_light needs beta1 above 0: without it there is no signal")
        return self


#: Keys of `evs` that follow from a data sheet.
DERIVED = tuple(set(EvsSpec.model_fields) - set(SheetEvsSpec.model_fields))

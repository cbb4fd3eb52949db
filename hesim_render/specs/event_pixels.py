"""The ``evs`` section of a sensor file: event pixels, their thresholds and their noise."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from hesim_render.specs.data_sheet import DataSheetSpec, V2eSpec
from hesim_render.specs.defects import EventDefectSpec
from hesim_render.specs.files import Strict
from hesim_render.specs.leak import LeakSpec
from hesim_render.specs.photoreceptor import PhotoreceptorSpec

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
    defects: EventDefectSpec | None = Field(None, description="stuck, hot and flickering pixels; default none")
    readout_max_events_per_s: float | None = Field(
        None, ge=1e-3, le=1e12, description="events beyond are lost; default no limit"
    )
    readout_buffer_events: int | None = Field(
        None, ge=1, le=10**12, description="that can wait for the read-out; default what it takes in tick_us or 1 ms"
    )

    @model_validator(mode="after")
    def _check_sheet(self) -> SheetEvsSpec:
        if self.data_sheet is not None and self.v2e is not None:
            raise ValueError("data_sheet and v2e say the same in two ways: leave one of them out")
        if self.leak is not None and self.leak.process == "drift" and self.reference != "last_event":
            raise ValueError(
                "leak.process 'drift' moves the reference of asynchronous pixels, reference 'last_event'; a fixed tick "
                "has process 'poisson'"
            )
        if (self.data_sheet or self.v2e) is not None and self.reference != "last_event":
            raise ValueError("data_sheet and v2e describe asynchronous pixels: they need reference 'last_event'")
        return self


#: The two sections that say the same as the keys which only `EvsSpec` has.
SHEETS = ("data_sheet", "v2e")


class EvsSpec(SheetEvsSpec):
    """Events: compare ΔV = ln x₁/x₀ + noise with θ₊ and θ₋ (ln units)."""

    contrast_threshold_on: float = Field(ge=1e-9, le=100)
    contrast_threshold_off: float = Field(ge=1e-9, le=100)
    threshold_mismatch_std: float = Field(0.0, ge=0, lt=0.5, description="std over pixels of θ, relative")
    signal_reference: SignalReferenceSpec
    coefficients: list[EvsCoefficients] = Field(min_length=1, description="one for all, or one per event position")
    shot_law: Literal["linear", "sqrt"]
    leak_rate_hz: float = Field(0.0, ge=0, le=1e6, description="Poisson process of ON events, per pixel")
    photoreceptor_cutoff_hz: float | None = Field(None, ge=1e-3, le=1e6, description="noise bandwidth (last_event)")
    photoreceptor: PhotoreceptorSpec | None = Field(None, description="bandwidth of the signal; default unlimited")
    refractory_period_us: int | None = Field(
        None, ge=1, le=10**9, description="no event so long after a pixel's last one"
    )

    @model_validator(mode="after")
    def _check(self) -> EvsSpec:
        if self.reference == "previous_sample":
            if self.tick_us is None:
                raise ValueError("reference 'previous_sample' needs tick_us")
            if self.window_us > self.tick_us:
                raise ValueError(f"window_us {self.window_us} is longer than tick_us {self.tick_us}")
        elif self.photoreceptor_cutoff_hz is None:
            raise ValueError("reference 'last_event' needs photoreceptor_cutoff_hz, the bandwidth of its noise")
        for key in ("contrast_threshold_on", "contrast_threshold_off"):
            # a change of several thresholds gives as many events in this mode
            if self.reference == "last_event" and getattr(self, key) < _LEAST_THRESHOLD:
                raise ValueError(f"{key} must be at least {_LEAST_THRESHOLD:g} with reference 'last_event'")
        if self.refractory_period_us is not None and self.reference != "last_event":
            raise ValueError("refractory_period_us belongs to reference 'last_event'; a fixed tick has none")
        if self.photoreceptor is not None and self.photoreceptor.filters_noise:
            if self.reference != "last_event":
                raise ValueError("photoreceptor.filters_noise belongs to reference 'last_event'")
            if (self.photoreceptor_cutoff_hz or 0.0) > self.photoreceptor.cutoff_hz:
                raise ValueError("photoreceptor_cutoff_hz is above photoreceptor.cutoff_hz, which filters the noise")
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

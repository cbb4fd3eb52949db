"""What a virtual session should find: the sensor's own values, by the names that calibrations give them."""

from __future__ import annotations

import math

import numpy as np

from hesim_render.capture.bench import Bench
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.evs.model import EvsNoise

#: Most charge of the dark current in the longest exposure, as a part of saturation, at which that is compared.
_DARK_PART = 2e-3


def truth_of(bench: Bench, longest_us: float) -> dict[str, dict[str, float]]:
    """Values by section (``aps``, ``evs``) and name.

    A value is left out where a calibration finds a mixture of several: positions with other coefficients, noise that
    rows, columns or patterns share, a sensor that is calibrated itself. Spreads are those of the law that the device's
    maps are drawn from.

    Parameters
    ----------
    bench : of the session, whose noise terms may be off.
    longest_us : longest exposure of the lit frames, µs.
    """
    result = {}
    if bench.aps is not None:
        result["aps"] = _frames(bench.aps, longest_us)
    if bench.evs is not None:
        result["evs"] = _events(bench.evs)
    return result


def _frames(aps: ApsNoise, longest_us: float) -> dict[str, float]:
    spec, off = aps.spec, aps.off
    gain = spec.system_gain_dn_per_e
    if spec.beta is not None:
        return {"K": gain}
    span_e = (aps.full_scale_dn - spec.black_level_dn) / gain
    dark_e_per_s = 0.0 if "dark_current" in off else spec.dark_current_now_e_per_s
    result = {
        "K": gain,
        "dark_current_e_per_s": dark_e_per_s,
        "dsnu_e": 0.0 if "dsnu" in off else spec.dsnu_e,
        "prnu_percent": 0.0 if "prnu" in off else 100 * spec.prnu_rel,
        "row_noise_dn": aps.row_noise_dn,
    }
    # the capacity that is found is that for light: dark current takes a part of it
    full_e = min(spec.full_well_e, span_e)
    if spec.nonlinearity is None and dark_e_per_s * longest_us * S_PER_US < _DARK_PART * full_e:
        result["full_well_e"] = full_e
    if not (aps.interference or aps.column_noise_dn or aps.row_noise_dn):
        read = 0.0 if "read" in off else spec.read_noise_e
        result["read_noise_e"] = math.hypot(read, 0.0 if "residual" in off else spec.residual_noise_dn / gain)
    return result


def _events(evs: EvsNoise) -> dict[str, float]:
    spec, off = evs.spec, evs.off
    theta_on, theta_off = spec.contrast_threshold_on, spec.contrast_threshold_off
    result = {
        "theta_on": theta_on, "theta_off": theta_off,
        "threshold_mismatch_rel": 0.0 if "mismatch" in off else spec.threshold_mismatch_rel,
    }  # fmt: skip
    if spec.leak is None:
        rate_hz = 0.0 if "leak" in off else spec.leak_rate_hz
        result["leak_rate_hz"] = rate_hz
        if spec.tick_us is not None:
            result["leak_per_trial"] = -math.expm1(-rate_hz * spec.tick_us * S_PER_US)
    if spec.reference == "last_event":
        if spec.photoreceptor is None or not spec.photoreceptor.filters_noise:
            result["photoreceptor_cutoff_hz"] = float(spec.photoreceptor_cutoff_hz or 0.0)
        return result
    every = {(c.beta1, c.beta2, c.beta3, c.beta4, c.beta5) for c in spec.coefficients}
    if len(every) == 1 and not off & {"shot", "dark_current"}:
        beta1, beta2, beta3, beta4, beta5 = every.pop()
        if beta4 > 0:
            beta0 = float(np.mean([theta_on, theta_off])) / (spec.threshold_hardware_v or 1.0)
            result |= {"A": beta0 * beta1 / beta4, "B": beta0 * beta2 / beta4, "C": beta3 / beta4, "D": beta5}
    return result

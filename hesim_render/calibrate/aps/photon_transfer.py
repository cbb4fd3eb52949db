"""Photon transfer in the terms of EMVA 1288 [emva2021], beside the polynomial of the paper."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.composite import Composite
from hesim_render.calibrate.aps.dark import DarkModel
from hesim_render.calibrate.aps.variance import Pooled, VarianceFit
from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.specs.capture import CaptureSpec

_FLAT_SPREAD = 0.1


def system_gain(bins: Pooled, top_dn: float) -> tuple[float, float]:
    """K in DN/e⁻ and its standard error: slope through the origin of the lit minus the dark variance against the light.

    EMVA 1288 fits from 0 to 70 % of saturation. The dark variance is that of the same exposure where there is one.

    Parameters
    ----------
    bins : pooled variances.
    top_dn : upper limit of the fit, DN.

    Returns
    -------
    K and its standard error, DN/e⁻; NaN where no lit data lie below the limit.
    """
    lit = bins.lit & (bins.signal_dn <= top_dn)
    dark = {t: i for i, t in enumerate(bins.exposure_s) if not bins.lit[i]}
    lit &= np.isin(bins.exposure_s, list(dark))
    if not np.any(lit):
        return float("nan"), float("nan")
    base = np.array([dark[t] for t in bins.exposure_s[lit]])
    # sums over the bins of signal² and of signal · variance above the dark; the noise of the signal itself adds to
    # its square, and is taken off
    x2 = bins.powers[lit, 2] - bins.noise[lit] * bins.pixels[lit]
    above = bins.products[lit, 1] - bins.variance_dn2[base] * bins.powers[lit, 1]
    gain = float(above.sum()) / max(float(x2.sum()), 1e-30)
    for _ in range(4):
        # Weights follow from the line. Weights from the bins' own variances would favour low variances.
        expected = bins.variance_dn2[base] + gain * bins.signal_dn[lit]
        expected = np.maximum(expected, 0.1)
        weight = bins.freedom[lit] / (2 * (expected**2 + 2 * expected * bins.row_variance[lit]))
        bottom = float(weight @ x2)
        if bottom <= 0:
            return float("nan"), float("nan")
        gain = float(weight @ above) / bottom
    # Errors come from the lit variances and from the dark ones; all lit bins of an exposure share a dark variance.
    shared = np.bincount(base, weights=weight * bins.powers[lit, 1], minlength=bins.pixels.size)
    dark_error = 2 * bins.variance_dn2**2 / (bins.freedom * bins.pixels)
    return gain, float(np.sqrt(bottom + np.sum(shared**2 * dark_error)) / bottom)


def linearity(
    lit: FrameMoments, signals: NDArray, usable: NDArray[np.bool_], composite: Composite, top_dn: float
) -> dict[str, Any]:
    """Deviation of each exposure from proportionality, over pixels between 5 and 95 % of saturation."""
    deviations = []
    for k, t in enumerate(lit.exposures_s):
        # what a pixel would show if its signal were proportional to time, [row, col]
        expected = composite.rate_dn_per_s * t
        use = usable[k] & (expected > 0.05 * top_dn) & (expected < 0.95 * top_dn)
        if use.sum() >= 20:
            deviations.append((int(lit.exposures_us[k]), float(signals[k][use].sum() / expected[use].sum() - 1)))
    if len(deviations) < 2:
        return not_identifiable("fewer than two exposures have pixels between 5 and 95 % of saturation")
    size = [abs(d) for _, d in deviations]
    return {
        "value": 100 * float(np.mean(size)),
        "unit": "%",
        "largest": 100 * max(size),
        "per_exposure": {us: 100 * d for us, d in deviations},
    }


def photon_transfer(
    spec: CaptureSpec,
    dark: DarkModel,
    composite: Composite,
    fits: dict[tuple[int, int], VarianceFit],
    bins: dict[tuple[int, int], Pooled],
    saturation: float | None,
    reached: bool,
    linear: dict[str, Any],
) -> dict[str, Any]:
    """Every photon-transfer quantity, or the reason why it cannot be determined.

    Parameters
    ----------
    spec : description of the captures.
    dark : parameters of the dark frames.
    composite : signal of the scene.
    fits, bins : fit and pooled variances of each tile position that has an APS value.
    saturation : light signal of a full well below full scale, DN, if one was seen.
    reached : whether any exposure saturates anywhere.
    linear : result of `linearity`.
    """
    range_dn = spec.full_scale_dn - dark.black if saturation is None else saturation
    # K of each tile position, from signals below 70 % of the range, where the response is straight
    gains = {p: system_gain(b, 0.7 * range_dn) for p, b in bins.items()}
    good = {p: g for p, g in gains.items() if np.isfinite(g[0]) and g[0] > 5 * g[1]}
    if not good:
        reason = "lit variance does not rise with light enough (capture brighter frames at the dark exposures too)"
        names = ("K", "read_noise_e", "dark_current_e_per_s", "full_well_e", "dsnu_e", "prnu_percent")
        return {name: not_identifiable(reason) for name in names} | {"linearity_error_percent": linear}
    value, error = np.array(list(good.values())).T
    weight = 1 / error**2
    k = float(weight @ value / weight.sum())
    # positions that differ by more than their errors widen that of the mean
    chi2 = float(weight @ (value - k) ** 2) / max(len(good) - 1, 1)
    k_error = float(np.sqrt(max(chi2, 1.0) / weight.sum()))
    cell = [[gains.get((i, j), (np.nan, np.nan)) for j in range(spec.tile_cols)] for i in range(spec.tile_rows)]
    result: dict[str, Any] = {"K": estimated(k, k_error, "DN/e-")}
    result["K"]["per_position"] = [[_number(c[0]) for c in row] for row in cell]
    result["K"]["per_position_standard_error"] = [[_number(c[1]) for c in row] for row in cell]
    result["K"]["positions_chi2_per_dof"] = chi2
    relative = k_error / k
    result["read_noise_e"] = _read_noise(fits, k, relative)
    result["dark_current_e_per_s"] = _dark_current(dark, fits, k, relative)
    if reached:
        result["full_well_e"] = estimated(range_dn / k, range_dn / k * relative, "e-")
        result["full_well_e"]["limited_by"] = "ADC full scale" if saturation is None else "full well"
    else:
        result["full_well_e"] = not_identifiable(
            f"no exposure saturates: it is at least {_largest(bins) / k:.0f} e-; capture a longer exposure"
        )
    result["dsnu_e"] = _dsnu(dark, k, relative)
    result["prnu_percent"] = _prnu(composite, dark, spec)
    result["linearity_error_percent"] = linear
    return result


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _largest(bins: dict[tuple[int, int], Pooled]) -> float:
    return max(float(b.signal_dn.max()) for b in bins.values())


def _read_noise(fits: dict[tuple[int, int], VarianceFit], k: float, relative: float) -> dict[str, Any]:
    known = [f for f in fits.values() if f.identified[0] and f.beta[0] > 0]
    if not known:
        return not_identifiable("the variance at zero light and zero exposure is not above zero")
    variance = np.array([f.beta[0] for f in known])
    # in DN², as the variance itself
    error = np.sqrt([f.covariance[0, 0] for f in known])
    noise = float(np.sqrt(variance.mean()))
    # error of a mean, and of a root: σ(√v) = σ(v)/(2√v)
    noise_error = float(np.sqrt(np.sum(error**2)) / len(known) / (2 * noise))
    result = estimated(noise / k, noise / k * float(np.hypot(noise_error / noise, relative)), "e-")
    return result | {"value_dn": noise}


def _dark_current(
    dark: DarkModel, fits: dict[tuple[int, int], VarianceFit], k: float, relative: float
) -> dict[str, Any]:
    good = ~dark.bad & ~dark.hot
    rates = dark.n_dp[good]
    mean = float(rates.mean(dtype=np.float64))
    error = float(np.sqrt(rates.var(dtype=np.float64) / rates.size))
    result = estimated(mean / k, float(np.hypot(error / k, mean / k * relative)), "e-/s")
    slopes = [f.beta[2] for f in fits.values() if f.identified[2]]
    result["from_variance"] = float(np.mean(slopes)) / k**2 if slopes else None
    result["value_dn_per_s"] = mean
    return result


def _dsnu(dark: DarkModel, k: float, relative: float) -> dict[str, Any]:
    """Spatial standard deviation of N_FP without row offsets and without the noise of the estimate."""
    values = dark.n_blc[~dark.bad].astype(np.float64)
    # the spread over pixels holds the noise of each estimate as well
    variance = float(values.var()) - float(dark.covariance[0, 0])
    if variance <= 0:
        return not_identifiable("the fixed pattern is below the noise of its estimate; capture more dark frames")
    dsnu = float(np.sqrt(variance))
    error = float(values.var()) * np.sqrt(2 / values.size) / (2 * dsnu)
    return estimated(dsnu / k, dsnu / k * float(np.hypot(error / dsnu, relative)), "e-") | {
        "value_dn": dsnu,
        "rows_dn": float(dark.n_row.std()),
    }


def _prnu(composite: Composite, dark: DarkModel, spec: CaptureSpec) -> dict[str, Any]:
    """Spatial spread of the light rate per tile position; only a flat field gives it."""
    parts = []
    for i in range(spec.tile_rows):
        for j in range(spec.tile_cols):
            cut = np.s_[i :: spec.tile_rows, j :: spec.tile_cols]
            use = np.isfinite(composite.rate_dn_per_s[cut]) & ~dark.bad[cut] & ~dark.hot[cut]
            rate = composite.rate_dn_per_s[cut][use].astype(np.float64)
            if rate.size > 100 and rate.mean() > 0:
                noise = float(np.mean(composite.standard_error_dn_per_s[cut][use].astype(np.float64) ** 2))
                parts.append((rate.var() / rate.mean() ** 2, noise / rate.mean() ** 2, rate.size))
    # a picture of something would count as non-uniformity: each position must be nearly uniform
    flat = parts and all(np.sqrt(total) < _FLAT_SPREAD for total, _, _ in parts)
    if not flat:
        return not_identifiable("the lit scene is not a flat field; capture a uniform light to get PRNU")
    variance = float(np.mean([total - noise for total, noise, _ in parts]))
    if variance <= 0:
        return not_identifiable("the spread over pixels is below the noise of the means; capture more lit frames")
    prnu = 100 * float(np.sqrt(variance))
    # a variance over n pixels is off by √(2/n) of itself; the positions are averaged
    scatter = float(np.sqrt(np.sum([2 * total**2 / size for total, _, size in parts]))) / len(parts)
    return estimated(prnu, 100 * scatter / (2 * np.sqrt(variance)), "%") | {"note": "shading of the light is included"}

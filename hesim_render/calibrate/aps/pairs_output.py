"""Output of a calibration from EMVA 1288 captures: its section of ``calibration.yaml`` and its maps."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from hesim_render.calibrate.aps.long_series import Long, stuck_pixels
from hesim_render.calibrate.aps.pair_levels import WELL_SHARE
from hesim_render.calibrate.aps.pairs import DARK_NOISE_LIMIT_DN, PairCalibration, evaluate
from hesim_render.calibrate.aps.pairs_findings import SIGNIFICANT, findings
from hesim_render.calibrate.aps.rounded_noise import levels_of
from hesim_render.calibrate.aps.variance import TERMS
from hesim_render.calibrate.estimate import Z_95, estimated, not_identifiable
from hesim_render.calibrate.moments import Progress
from hesim_render.calibrate.report.page import write_report
from hesim_render.calibrate.result import check_calibration, check_report, write_section
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, polynomial
from hesim_render.recording.pair_set import PairSet, read_pair_set

_FIGURE_PX = 320
#: Relative error of a noise that rounding hides, up to which it has a value.
_LEAST_KNOWN = 0.25


def calibrate_pairs(
    captures: str | Path | PairSet,
    out: str | Path,
    report: str | Path | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> PairCalibration:
    """Calibrate the frames of EMVA 1288 captures and write (or update) a ``calibration.yaml``.

    Parameters
    ----------
    captures : folder with ``EMVA1288_Data.txt`` or with pairs by name, or a set that was opened.
    out : the calibration; its section ``aps`` is written, others are kept.
    report : HTML file, if wanted.
    progress : called with a text that names the current work and the fraction done.
    overwrite : replace a report of another calibration.

    Raises
    ------
    SpecError
        If the captures cannot be used; the message names file and line.
    OutputError
        If a result cannot be written.
    """
    pairs = captures if isinstance(captures, PairSet) else read_pair_set(captures)
    about = pairs.spec.model_dump(exclude_none=True, mode="json")
    check_calibration(out, about)
    if report is not None:
        check_report(out, report, overwrite)
    result = evaluate(pairs, progress)
    write_section(out, "aps", about, content(result), maps(result))
    if report is not None:
        write_report(out, report, overwrite)
    return result


def content(result: PairCalibration) -> dict[str, Any]:
    """The section ``aps``."""
    fit, curve = result.fit, result.curve
    k, relative = result.gain.slope, result.gain.error / result.gain.slope
    row, col = (np.sqrt(max(value, 0.0)) for value, _ in (result.row, result.col))
    beta = [float(b) if ok else None for b, ok in zip(fit.beta, fit.identified, strict=True)]
    if beta[0] is not None:
        beta[0] -= result.lines_dn2
    errors = [float(e) if ok else None for e, ok in zip(np.sqrt(np.diag(fit.covariance)), fit.identified, strict=True)]
    return {
        "method": "EMVA 1288 R4.0 linear, from pairs of frames and two long series",
        "findings": [finding.described() for finding in findings(result)],
        "terms": list(TERMS),
        "units": "DN (light above black) and seconds; the ADC's 1/12 DN², rows, columns and interference are taken out",
        "beta": [[beta]],
        "beta_standard_error": [[errors]],
        "goodness": {
            "chi2_per_dof": [[fit.chi2_per_dof]],
            "p_value": [[None]],
            "cubic_per_dn": [[None if fit.cubic is None else list(fit.cubic)]],
            "dof": [[fit.dof]],
            "levels_chi2_per_dof": result.level_chi2,
            "level_rms_rel": result.level_rms,
            "light_rms_rel": curve.light_rms,
        },
        "range": {
            "exposures_us": [1e6 * t for t in (result.lit.exposure_s.min(), result.lit.exposure_s.max())],
            "signal_dn": [0.0, float(result.signal[result.clear].max())],
        },
        "black_dn": result.black.value,
        "n_row_std_dn": float(result.dark_pattern.row.std()),
        "column_offset_std_dn": float(result.dark_pattern.col.std()),
        "row_noise_dn": _shared(*result.row, row),
        "column_noise_dn": _shared(*result.col, col),
        "read_noise_correlation": _correlation(result),
        "interference": [asdict(line) for line in result.noise_spectrum.lines],
        "nonlinearity": curve.nonlinearity(result.responsivity.slope, result.pairs.spec.full_scale_dn),
        "light_offset": {
            **estimated(curve.offset, curve.offset_error, "photons" if result.pairs.has_photons else "s"),
            "note": "light beyond that of the stated exposures",
        },
        "hot_pixels": 0,
        "bad_pixels": int(result.defects.sum()),
        "K": estimated(k, result.gain.error, "DN/e-", result.gain.groups),
        "responsivity": estimated(
            result.responsivity.slope,
            result.responsivity.error,
            "DN/photon" if result.pairs.has_photons else "DN/s",
            result.responsivity.groups,
        ),
        "quantum_efficiency": _quantum_efficiency(result, relative),
        "read_noise_e": _read_noise(result, k, relative),
        "temporal_dark_noise_e": _dark_noise(result, k, relative),
        "dark_current_e_per_s": _dark_current(result, k, relative),
        "full_well_e": _full_well(result, k, relative),
        "dsnu_e": _dsnu(result, k, relative),
        "prnu_percent": _prnu(result),
        "linearity_error_percent": _linearity(result),
        "notes": [],
    }


def _shared(variance: float, error: float, std: float) -> dict[str, Any]:
    """Temporal noise of rows or columns; 0 with a limit where it is not significant."""
    if variance > SIGNIFICANT * error and std > 0:
        return estimated(std, error / (2 * std), "DN")
    limit = float(np.sqrt(max(variance, 0.0) + Z_95 * error))
    return {"value": 0.0, "upper_limit": limit, "unit": "DN", "note": "they share no more than chance makes them"}


def _correlation(result: PairCalibration) -> dict[str, Any]:
    spectrum = result.noise_spectrum
    if spectrum.correlated:
        return estimated(spectrum.correlation, spectrum.correlation_error)
    limit = abs(spectrum.correlation) + Z_95 * spectrum.correlation_error
    return {"value": 0.0, "upper_limit": limit, "unit": "", "note": "no more than chance makes it"}


def _quantum_efficiency(result: PairCalibration, relative: float) -> dict[str, Any]:
    if not result.pairs.has_photons:
        return not_identifiable("the captures do not state photons per pixel")
    value = result.responsivity.slope / result.gain.slope
    error = value * float(np.hypot(relative, result.responsivity.error / result.responsivity.slope))
    return estimated(value, error, "e-/photon", result.gain.groups)


def _read_noise(result: PairCalibration, k: float, relative: float) -> dict[str, Any]:
    """Of pixels alone, at no exposure: without the ADC and without what rows, columns and lines share."""
    if result.dark_noise_is_rounded_off:
        shared = sum(max(value, 0.0) for value, _ in (result.row, result.col)) + result.lines_dn2
        current = max(result.black.slope, 0.0) * k * result.pairs.spatial_dark.exposure_s
        return _rounded(result, k, relative, shared + current)
    variance = result.noise.value - result.lines_dn2 - ADC_VARIANCE_DN2
    noise = float(np.sqrt(variance))
    error = float(np.hypot(result.noise.error / (2 * variance), relative))
    return estimated(noise / k, noise / k * error, "e-", result.noise.groups) | {"value_dn": noise}


def _rounded(result: PairCalibration, k: float, relative: float, other_dn2: float) -> dict[str, Any]:
    """Noise without a variance of its own, by the grey values of the long dark series; else its limit.

    Parameters
    ----------
    result : of the captures.
    k, relative : gain, DN/e⁻, and its relative error.
    other_dn2 : variance of that series that is not of this noise, DN².
    """
    noise = result.rounded_noise
    limit = DARK_NOISE_LIMIT_DN if noise is None else min(DARK_NOISE_LIMIT_DN, noise.high)
    if noise is not None and noise.low**2 > other_dn2:
        low, value, high = (float(np.sqrt(v**2 - other_dn2)) for v in (noise.low, noise.value, noise.high))
        error = (high - low) / (2 * Z_95)
        if error < _LEAST_KNOWN * value:
            entry = estimated(value / k, value / k * float(np.hypot(error / value, relative)), "e-")
            low, high = (v / k * (1 + sign * Z_95 * relative) for sign, v in ((-1, low), (1, high)))
            note = "by the probabilities of grey values, as rounding hides its variance"
            return entry | {"interval_95": [low, high], "value_dn": value, "note": note}
    return not_identifiable(
        f"rounding to whole grey values hides it: it is at most {limit:.2g} DN; capture with more bits or a higher gain"
    ) | {"upper_limit": limit / k, "unit": "e-"}  # fmt: skip


def _dark_noise(result: PairCalibration, k: float, relative: float) -> dict[str, Any]:
    """The standard's σ_d, with what rows and columns share."""
    if result.dark_noise_is_rounded_off:
        current = max(result.black.slope, 0.0) * k * result.pairs.spatial_dark.exposure_s
        return _rounded(result, k, relative, current)
    variance = result.noise.value - ADC_VARIANCE_DN2 + max(result.row[0], 0.0) + max(result.col[0], 0.0)
    error = float(np.sqrt(result.noise.error**2 + result.row[1] ** 2 + result.col[1] ** 2)) / (2 * variance)
    noise = float(np.sqrt(variance)) / k
    return estimated(noise, noise * float(np.hypot(error, relative)), "e-")


def _dark_current(result: PairCalibration, k: float, relative: float) -> dict[str, Any]:
    if not np.isfinite(result.black.slope_error):
        return not_identifiable("one exposure tells no dark current; capture dark pairs at several exposures")
    value = result.black.slope / k
    outcome = estimated(
        value, float(np.hypot(result.black.slope_error / k, value * relative)), "e-/s", result.black.groups
    )
    outcome["from_variance"] = result.noise.slope / k**2
    outcome["value_dn_per_s"] = result.black.slope
    return outcome


def _full_well(result: PairCalibration, k: float, relative: float) -> dict[str, Any]:
    """Electrons at the largest variance, and where the signal may end: beyond the level below, and before the one above
    the last whose variance is as large but for its error, or the brightest signal, or the end of the ADC's range.
    """
    if result.saturation >= result.signal.size:
        return not_identifiable(
            f"no level saturates: it is at least {result.signal.max() / k:.0f} e-; capture more light"
        )
    here = result.saturation
    light = result.light
    electrons = result.responsivity.slope * light[here] / k
    whole = result.lit.variance + np.maximum(result.lit.row, 0.0)
    near = whole >= whole[here] - Z_95 * np.hypot(result.lit.error, result.lit.error[here])
    last = here + int(np.argmin(np.append(near[here:], False))) - 1
    per_photon = result.responsivity.slope / k
    ends = per_photon * np.array([light[here - 1], light[min(last + 1, light.size - 1)]])
    adc = result.lit.high[here:].max() > WELL_SHARE
    # the brightest level may be cut off as a whole: its mean is then the end itself
    most = result.pairs.spec.full_scale_dn - result.black.value if adc else result.signal.max()
    ends[1] = max(ends[1], most / k)
    low, high = ends * (1 + Z_95 * relative * np.array([-1, 1]))
    return estimated(float(electrons), float(high - low) / (2 * Z_95), "e-") | {
        "interval_95": [float(low), float(high)], "limited_by": "ADC full scale" if adc else "full well",
        "photons": float(light[here]), **({} if adc else {"cut_off_e": result.brightest_dn / k}),
    }  # fmt: skip


def _std(variance: float, error: float) -> tuple[float, float]:
    """Standard deviation and its error; NaN where the variance is not above 0."""
    if variance <= 0:
        return float("nan"), float("nan")
    return float(np.sqrt(variance)), error / (2 * float(np.sqrt(variance)))


def _dsnu(result: PairCalibration, k: float, relative: float) -> dict[str, Any]:
    spatial = result.long_dark.spatial
    errors = spatial.errors(fixed=False)
    value, error = _std(spatial.total, float(errors[3]))
    parts = {
        f"{name}_e": max(0.0, part) ** 0.5 / k
        for name, part in zip(("row", "column", "pixel"), spatial.parts, strict=True)
    }
    if not np.isfinite(value) or spatial.total < Z_95 * errors[3]:
        limit = float(np.sqrt(max(spatial.total, 0.0) + Z_95 * errors[3])) / k
        return {"value": 0.0, "upper_limit": limit, "unit": "e-", "note": "below the noise of the mean"} | parts
    return estimated(value / k, value / k * float(np.hypot(error / value, relative)), "e-") | parts


def _prnu(result: PairCalibration) -> dict[str, Any]:
    lit, dark = result.long_lit, result.long_dark
    level = float(lit.mean.mean() - dark.mean.mean())
    differences = [a - b for a, b in zip(lit.spatial.parts, dark.spatial.parts, strict=True)]
    errors = np.hypot(lit.spatial.errors(fixed=False), dark.spatial.errors(fixed=False))
    value, error = _std(sum(differences), float(errors[3]))
    if not np.isfinite(value):
        return not_identifiable("the spread over pixels is below the noise of the means; capture a longer series")
    names = ("row_percent", "column_percent", "pixel_percent")
    parts = {name: 100 * max(0.0, part) ** 0.5 / level for name, part in zip(names, differences, strict=True)}
    return (
        estimated(100 * value / level, 100 * error / level, "%") | parts | {"note": "shading of the light is included"}
    )


def _linearity(result: PairCalibration) -> dict[str, Any]:
    used, deviations = result.linearity
    if deviations.size < 3:
        return not_identifiable("fewer than three levels lie between 5 and 95 % of saturation")
    light, signal = result.light[result.clear][used], result.signal[result.clear][used]
    scatter = 100 * np.mean(np.abs(signal / result.curve.at(light) - 1))
    return {
        "value": float(np.mean(np.abs(deviations))), "unit": "%", "largest": float(np.abs(deviations).max()),
        "levels": int(used.sum()), "note": f"the levels scatter by {scatter:.2g} % about a smooth curve",
    }  # fmt: skip


def maps(result: PairCalibration) -> dict[str, NDArray]:
    """Fixed maps without the noise of their estimate, and what the report draws."""
    shape = result.pairs.shape
    shading = result.light_pattern.shading()
    step = max(1, -(-max(shape) // _FIGURE_PX))
    offset = result.dark_pattern.col + result.dark_pattern.pixel
    if result.rounded_noise is not None:
        spread = result.rounded_noise.spread
        offset = levels_of(result.long_dark.mean, ~result.defects, spread) - np.reshape(
            result.dark_pattern.row, (-1, 1)
        )
    response = np.maximum((1 + result.light_pattern.whole) / (1 + shading), 0.0)
    full = result.pairs.spec.full_scale_dn
    # beyond the range, so that no noise leads out of its ends
    white, black = stuck_pixels(full, result.long_dark, result.long_lit)
    offset[white] += full
    offset[black] -= full
    response[black] = 0.0
    lit, dark = result.lit, result.dark
    points = [
        (0, 0, t, is_lit, x, v - ADC_VARIANCE_DN2 - result.lines_dn2, shape[0] * shape[1])
        for is_lit, levels, light in (
            (0.0, dark, np.zeros(dark.mean.size)), (1.0, lit, np.where(result.clear, result.signal, np.nan)),
        )
        for t, x, v in zip(np.full(light.size, np.median(lit.exposure_s)), light, levels.variance, strict=True)
        if np.isfinite(x)
    ]  # fmt: skip
    return {
        "n_row": result.dark_pattern.row,
        "n_blc": offset.astype(np.float32),
        "n_dp": np.full(shape, max(result.black.slope, 0.0), np.float32),
        "response": response.astype(np.float32),
        "light_rel": (1 + shading).astype(np.float32),
        "bad_pixels": result.defects,
        "figure_variance_map": result.long_lit.variance[::step, ::step],
        "figure_variance_exposure_us": np.array(1e6 * result.pairs.spatial_lit.exposure_s),
        "figure_variance_points": np.array(points),
        "figure_noise_dark": _histogram(result, result.long_dark, 0.0),
        "figure_noise_lit": _histogram(
            result, result.long_lit, float(result.long_lit.mean.mean()) - result.black.value
        ),
    }


def _histogram(result: PairCalibration, series: Long, signal: float) -> NDArray[np.float64]:
    """Distribution of single values about their mean: rows of (deviation DN, measured, predicted density)."""
    deviation = (series.first - series.mean) * np.sqrt(series.frames / (series.frames - 1))
    exposure_s = result.pairs.spatial_lit.exposure_s
    variance = float(polynomial(result.fit.beta, signal, exposure_s)) + ADC_VARIANCE_DN2 + max(result.row[0], 0.0)
    reach = 5 * float(np.sqrt(variance))
    edges = np.linspace(-reach, reach, 2 * min(60, max(12, int(reach))) + 1)
    counts = np.histogram(deviation, edges)[0] / (deviation.size * np.diff(edges))
    predicted = np.diff(ndtr(edges / np.sqrt(variance))) / np.diff(edges)
    return np.stack([(edges[1:] + edges[:-1]) / 2, counts, predicted], axis=1)

"""Checks whether frames follow their noise model: one light, one black level, a variance of second degree.

Each check gives a finding with the probability `finding.ALARM` for frames that follow the model. A deviation that is
significant but changes a parameter by less than half its standard error, or the variance by less than a thousandth, is
not reported.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_law
from scipy.stats import norm

from hesim_render.calibrate.aps.common_mode import FrameDrift, Shared, frame_drift
from hesim_render.calibrate.aps.fitted import ApsCalibration
from hesim_render.calibrate.estimate import ALARM, Finding
from hesim_render.calibrate.moments import FrameMoments
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2, polynomial

#: Fractions of the temporal variance and of a parameter's standard error below which a drift is harmless.
_LEAST_PART, _LEAST_ERRORS = 1e-3, 0.5
#: Shift of the black level between captures, in standard deviations of the dark noise, and deviation of the light from
#: proportionality, from which they are reported.
_LEAST_SHIFT, _LEAST_DEVIATION = 0.05, 3e-3
#: χ²/dof of the sample variances above which they scatter more than under Gaussian noise.
_WIDE = 1.05
_FEWEST = 50
#: Number of pixels from which the weights of an exposure are taken.
_SAMPLE = 20_000


@dataclass(frozen=True)
class Proportion:
    """Deviation of the lit frames of an exposure from rate · exposure, with standard errors.

    Attributes
    ----------
    shift_dn : part that is the same for all pixels, DN: a shift of the black level.
    deviation : part in proportion to the signal: a deviation of the light, the exposure time or the response.
    """

    exposure_us: int
    shift_dn: float
    shift_error: float
    deviation: float
    deviation_error: float


@dataclass(frozen=True)
class FrameChecks:
    """Results of the checks for the calibration's file, and the findings."""

    dark: list[FrameDrift]
    lit: list[FrameDrift]
    proportions: list[Proportion]
    findings: list[Finding]


def check_frames(result: ApsCalibration, dark: FrameMoments, lit: FrameMoments) -> FrameChecks:
    """Every check of the frames.

    Parameters
    ----------
    result : the calibration.
    dark, lit : moments of the frames without temporal row noise.
    """
    rows = result.rows.variance if result.rows.significant else 0.0
    in_dark = [frame_drift(dark, k, rows, None) for k in range(dark.exposures_us.size)]
    in_light = [frame_drift(lit, k, rows, result.signals[k]) for k in range(lit.exposures_us.size)]
    proportions = _proportions(result, lit, rows)
    outcome = [
        _rows(result),
        _black(result, in_dark, "black level, dark"),
        _line(result, dark, rows),
        _black(result, [d for d in in_light if d.light is not None], "black level, lit"),
        _light(result, in_light),
        _shift(result, proportions),
        _deviation(proportions),
        _curvature(result),
        _scatter(result),
    ]
    return FrameChecks(in_dark, in_light, proportions, [f for f in outcome if f is not None])


def _dark_variance(result: ApsCalibration) -> float:
    """Variance of a pixel in the dark at the shortest exposure, DN², typical of all."""
    values = [float(b.variance_dn2[~b.lit][0]) for b in result.bins.values() if np.any(~b.lit)]
    return float(np.median(values)) + ADC_VARIANCE_DN2 if values else ADC_VARIANCE_DN2


def _rows(result: ApsCalibration) -> Finding | None:
    rows = result.rows
    if not rows.significant:
        return None
    return Finding(
        "row noise",
        f"the pixels of a row move together by {rows.rms:.3g} DN rms from frame to frame (temporal row noise). It is "
        "taken out of β and given as row_noise_dn. If the sensor has none by itself, look at its supply.",
        rows.p_value,
    )


def _black(result: ApsCalibration, drifts: list[FrameDrift], check: str) -> Finding | None:
    """Black level that moves from frame to frame of one exposure."""
    known = [f.covariance[0, 0] for f in result.fits.values() if f.identified[0]]
    least = min(_LEAST_PART * _dark_variance(result), _LEAST_ERRORS * float(np.sqrt(min(known, default=np.inf))))
    worst = _worst([(d, d.black) for d in drifts], least)
    if worst is None:
        return None
    drift, p_value = worst
    return Finding(
        check,
        f"the level of all pixels moves by {drift.black.rms:.3g} DN rms ({drift.black_range_dn:.3g} DN from lowest to "
        f"highest frame) within the frames of {drift.exposure_us / 1000:g} ms. It adds to the variance and shifts "
        "offsets and dark current. Look at the sensor's temperature and black clamp; let it warm up, capture again.",
        p_value,
    )


def _light(result: ApsCalibration, drifts: list[FrameDrift]) -> Finding | None:
    """Light that moves from frame to frame of one exposure: it adds its relative variance to β3."""
    known = [f.covariance[3, 3] for f in result.fits.values() if f.identified[3]]
    top = max(float(b.signal_dn.max()) for b in result.bins.values())
    variance = max(float(b.variance_dn2.max()) for b in result.bins.values())
    least = min(
        _LEAST_PART * variance / max(top, 1e-9) ** 2, _LEAST_ERRORS * float(np.sqrt(min(known, default=np.inf)))
    )
    worst = _worst([(d, d.light) for d in drifts if d.light is not None], least)
    if worst is None or worst[0].light is None:
        return None
    drift, p_value = worst
    return Finding(
        "light",
        f"the light moves by {100 * worst[0].light.rms:.3g} % rms ({100 * drift.light_range:.3g} % from lowest to "
        f"highest frame) within the frames of {drift.exposure_us / 1000:g} ms. It adds to β3 and what follows from it. "
        "Steady the lamp, let it warm up, avoid mains flicker, and capture again.",
        p_value,
    )


def _worst(drifts: list[tuple[FrameDrift, Shared]], least: float) -> tuple[FrameDrift, float] | None:
    """The exposure with the most significant variance above `least`, and its p-value among all exposures."""
    result = [
        (shared.ratio, drift, min(1.0, shared.p_value * len(drifts)))
        for drift, shared in drifts
        if shared.variance > least and shared.p_value * len(drifts) < ALARM
    ]
    if not result:
        return None
    _, drift, p_value = max(result, key=lambda item: item[0])
    return drift, p_value


def _line(result: ApsCalibration, dark: FrameMoments, rows: float) -> Finding | None:
    """Dark means that do not lie on a straight line of exposure, all pixels together."""
    t = dark.exposures_s
    good = ~result.bad & ~result.dark.bad & ~result.dark.hot
    if t.size < 3 or good.sum() < _FEWEST:
        return None
    # mean level of all good pixels at each exposure, and its variance: rows that move together average less
    mean = np.array([float(m[good].mean(dtype=np.float64)) for m in dark.mean])
    noise = np.array([float(v[good].mean(dtype=np.float64)) / good.sum() for v in dark.variance])
    variance = (noise + rows / dark.mean.shape[1]) / dark.frames
    design = np.stack([np.ones_like(t), t]) / np.sqrt(variance)
    residual = mean - np.linalg.lstsq(design.T, mean / np.sqrt(variance), rcond=None)[0] @ np.stack(
        [np.ones_like(t), t]
    )
    p_value = float(chi2_law.sf(np.sum(residual**2 / variance), t.size - 2))
    largest = int(np.argmax(np.abs(residual)))
    if p_value > ALARM or abs(residual[largest]) < _LEAST_SHIFT * np.sqrt(_dark_variance(result)):
        return None
    return Finding(
        "dark line",
        f"the dark level is no straight line of the exposure: {residual[largest]:+.3g} DN at {1000 * t[largest]:g} ms. "
        "Offsets and dark current are off. The black level or the temperature drifted between the exposures: let the "
        "sensor warm up, and capture the exposures in turn.",
        p_value,
    )


def _proportions(result: ApsCalibration, lit: FrameMoments, rows: float) -> list[Proportion]:
    """Least squares of signal − rate · exposure over the usable pixels of each exposure: a shift and a proportional
    part.

    Parameters
    ----------
    result : the calibration.
    lit : moments of the lit frames.
    rows : variance of the temporal row noise, DN².
    """
    outcome = []
    good = ~result.bad & ~result.dark.bad & ~result.dark.hot
    for k, t in enumerate(lit.exposures_s):
        use = result.usable[k] & good & np.isfinite(result.composite.rate_dn_per_s)
        if use.sum() < _FEWEST:
            continue
        expected = result.composite.rate_dn_per_s[use].astype(np.float64) * t
        residual = result.signals[k][use] - expected
        noise = np.maximum(lit.variance[k][use].astype(np.float64), ADC_VARIANCE_DN2) / lit.frames
        noise += result.dark.mean_variance(t)
        # the weight follows from the light, not from a pixel's own sample
        few = slice(None, None, max(1, expected.size // _SAMPLE))
        line = np.polynomial.Polynomial.fit(expected[few], noise[few], 1)
        weight = 1 / line(expected).clip(min=0.1 * noise.mean())
        design = np.stack([np.ones_like(expected), expected])
        matrix = (design * weight) @ design.T
        if np.linalg.det(matrix) <= 1e-9 * matrix[0, 0] * matrix[1, 1]:
            continue
        inverse = np.linalg.inv(matrix)
        value = inverse @ ((design * weight) @ residual)
        # the row noise in the lit mean and in the subtracted dark mean is the same for all pixels of a row
        row = np.nonzero(use)[0]
        scores = np.stack([np.bincount(row, weight * x) for x in design])
        shared = rows / lit.frames + result.dark.mean_variance(t) * rows / (_dark_variance(result) + rows)
        error = np.sqrt(np.diag(inverse + shared * inverse @ (scores @ scores.T) @ inverse))
        outcome.append(
            Proportion(int(lit.exposures_us[k]), float(value[0]), float(error[0]), float(value[1]), float(error[1]))
        )
    return outcome


def _shift(result: ApsCalibration, proportions: list[Proportion]) -> Finding | None:
    least = _LEAST_SHIFT * np.sqrt(_dark_variance(result))
    return _largest(
        [(p.shift_dn, p.shift_error, p.exposure_us) for p in proportions],
        float(least),
        "black level between",
        "dim pixels of the lit frames are {:+.3g} DN off a signal in proportion to the exposure, at {:g} ms: the black "
        "level of the lit frames is not that of the dark ones. Capture dark and lit frames in turn, the sensor warm.",
        1.0,
    )


def _deviation(proportions: list[Proportion]) -> Finding | None:
    if len(proportions) < 2:
        return None
    return _largest(
        [(p.deviation, p.deviation_error, p.exposure_us) for p in proportions],
        _LEAST_DEVIATION,
        "light between",
        "the signal deviates by {:+.3g} % from proportion to the exposure, at {:g} ms: the light drifted between the "
        "exposures, the exposure times are not what they say, or the response is not linear. K, the composite and the "
        "signal of the event pixels are off by as much.",
        100.0,
    )


def _largest(
    values: list[tuple[float, float, int]], least: float, check: str, text: str, scale: float
) -> Finding | None:
    """The largest of the values that are significant and above `least`."""
    result = []
    for value, error, exposure_us in values:
        p_value = 2 * float(norm.sf(abs(value) / error)) * len(values)
        if p_value < ALARM and abs(value) > least:
            result.append((abs(value), Finding(check, text.format(scale * value, exposure_us / 1000), p_value)))
    return max(result, key=lambda item: item[0])[1] if result else None


def _curvature(result: ApsCalibration) -> Finding | None:
    """Finding of a significant term in I³, all positions together."""
    known = {p: f.cubic for p, f in result.fits.items() if f.cubic is not None}
    if not known:
        return None
    # one test for all positions: the sum of squares of their z-scores is χ²
    z = {p: value / error for p, (value, error) in known.items()}
    p_value = float(chi2_law.sf(sum(v * v for v in z.values()), len(z)))
    if p_value > ALARM:
        return None
    worst = max(z, key=lambda p: abs(z[p]))
    fit, bins = result.fits[worst], result.bins[worst]
    top = int(np.argmax(bins.signal_dn))
    curve = float(polynomial(fit.beta, bins.signal_dn[top], bins.exposure_s[top]))
    part = known[worst][0] * float(bins.signal_dn[top]) ** 3 / max(curve, 1e-9)
    return Finding(
        "curvature",
        f"the variance bends more than a polynomial of second degree: at position {worst} a term in I³ is "
        f"{known[worst][0]:.3g} ± {known[worst][1]:.2g} DN⁻¹, {100 * part:+.2g} % of the variance of the brightest. "
        "β and the read noise are off. Look at the residuals and the linearity error; capture a smaller range of "
        "brightness, further from saturation.",
        p_value,
    )


def _scatter(result: ApsCalibration) -> Finding | None:
    """Finding of sample variances that scatter more than those of an electron count with Gaussian noise."""
    wide = {p: f for p, f in result.fits.items() if f.chi2_per_dof > _WIDE * f.expected_chi2}
    if not wide:
        return None
    worst = min(wide, key=lambda p: wide[p].p_value)
    p_value = min(1.0, wide[worst].p_value * len(result.fits))
    if p_value > ALARM:
        return None
    return Finding(
        "scatter",
        f"the variances of pixels of one brightness scatter more than they should, χ²/dof "
        f"{wide[worst].chi2_per_dof:.3f} at position {worst}: pixels with noise of their own (random telegraph noise), "
        "or a light that flickers. Standard errors are widened by it.",
        p_value,
    )

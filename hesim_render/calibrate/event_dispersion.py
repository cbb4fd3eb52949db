"""How much more event counts scatter than counting makes them: over pixels (thresholds), and in time (noise)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, ndtri

from hesim_render.calibrate.event_cells import PixelCounts
from hesim_render.calibrate.event_estimate import EventFit
from hesim_render.calibrate.event_model import log_probability, probability_variance, threshold_over_noise

#: Largest scatter of thresholds, as a part of that of counting, beside which the scatter in time is seen.
_CLEAR = 0.3
#: Counts looked at for the mismatch, and groups of pixels left out in turn for its error.
_MOST_COUNTS, _GROUPS = 12_000, 16
#: Thresholds of the mixture, in standard deviations; between them the counts' own law is smooth.
_NODES = np.linspace(-6.0, 6.0, 241)
_LARGEST_MISMATCH = 0.6
#: Twice the gain of ln L from which a mismatch is significant (a chance of 6e-5).
_SIGNIFICANT = 16.0


@dataclass(frozen=True)
class Dispersion:
    """Variance of a pixel's counts in time over the trinomial one, with standard errors; NaN where thresholds hide it.

    Attributes
    ----------
    total, total_error : of ON + OFF. Noise drawn once a tick and differenced makes an ON the likelier after an OFF,
        so it is above 1 there ...
    difference, difference_error : ... and below 1 for ON − OFF.
    """

    total: float
    total_error: float
    difference: float
    difference_error: float


def dispersion_in_time(pixels: PixelCounts, fit: EventFit, theta_v: float) -> Dispersion:
    """Mean squares about the fit, less what thresholds add, over counting; never below 0."""
    cells = pixels.cells
    p = np.exp(log_probability(fit.parameters, cells, theta_v, fit.law)[0])
    u, _ = threshold_over_noise(fit.parameters, cells.signal_dn, theta_v, fit.law)
    between = cells.trials**2 * probability_variance(
        u * (1 - cells.polarity * fit.parameters[4]), cells.spread, cells.relative
    )
    columns: list[list[NDArray]] = [[] for _ in range(5)]
    for session in np.unique(pixels.is_dark):
        on, off = np.flatnonzero(pixels.is_dark == session)
        p_on, p_off = p[pixels.cell[on]], p[pixels.cell[off]]
        thresholds = between[pixels.cell[on]] + between[pixels.cell[off]]
        n = cells.trials
        e_on, e_off = pixels.counts[on] - n * p_on, pixels.counts[off] - n * p_off
        both, apart = n * (p_on + p_off) * (1 - p_on - p_off), n * (p_on + p_off - (p_on - p_off) ** 2)
        clear = (thresholds < _CLEAR * both) & (both > 0)
        for column, values in zip(columns, (e_on + e_off, e_on - e_off, both, apart, thresholds), strict=True):
            column.append(values[clear])
    total, difference, both, apart, thresholds = (np.concatenate(column) for column in columns)
    return Dispersion(*_ratio(total, both, thresholds), *_ratio(difference, apart, thresholds))


def _ratio(residual: NDArray, counting: NDArray, thresholds: NDArray) -> tuple[float, float]:
    """(Σ residual² − thresholds)/counting with weights of a variance's own scatter, and its standard error."""
    if residual.size < 100:
        return float("nan"), float("nan")
    weight = 1 / (2 + 1 / counting)
    values = (residual**2 - thresholds) / counting
    mean = float(weight @ values / weight.sum())
    error = float(np.sqrt(np.sum((weight * (values - mean)) ** 2)) / weight.sum())
    return max(mean, 0.0), error


def static_mismatch(pixels: PixelCounts, fit: EventFit, theta_v: float) -> tuple[float, float, float]:
    """Relative spread of thresholds from how counts of pixels of one brightness are distributed.

    Maximum likelihood over the mixture of binomial laws that normal thresholds give, with the mean rate held at that
    of the fit: u = v/√(1 − m² v²), v = −Q⁻¹ of the mean rate. The error is that of a jackknife over groups of pixels.

    Returns
    -------
    m, its standard error, and an upper limit of 95 %; 0, NaN and the limit where it is not significant.
    """
    cells = pixels.cells
    rate = np.exp(log_probability(fit.parameters, cells, theta_v, fit.law)[0])
    events, cell, coarse, group = _sample(pixels, cells.trials * rate)
    if events.size < 200:
        return 0.0, float("nan"), float("nan")
    mean = np.bincount(coarse, cells.trials * rate[cell])
    found = np.bincount(coarse, events)
    ratio = found / np.maximum(mean, 1e-30)
    v = -ndtri(np.minimum(rate, 0.499))
    largest = min(_LARGEST_MISMATCH, 0.97 / float(v[cell].max()))
    key, row = np.unique(np.stack([cell, events.astype(np.intp)]), axis=1, return_inverse=True)
    weight = np.bincount(row).astype(np.float64)

    def log_likelihood(m: float, scale: NDArray, counted: NDArray) -> float:
        at = key[0]
        here = -ndtri(np.minimum(np.bincount(row, scale[coarse]) / np.bincount(row) * rate[at], 0.499))
        u = here / np.sqrt(np.maximum(1 - (m * here) ** 2, 1e-3))
        p = np.clip(ndtr(-u[:, None] * (1 + m * _NODES)), 1e-300, 1 - 1e-15)
        exponent = key[1][:, None] * np.log(p) + (cells.trials - key[1])[:, None] * np.log1p(-p)
        top = exponent.max(axis=1)
        mixed = np.exp(exponent - top[:, None]) @ np.exp(-0.5 * _NODES**2)
        return float(counted @ (top + np.log(mixed)))

    def best(scale: NDArray, counted: NDArray, bracket: tuple[float, float]) -> float:
        return float(
            minimize_scalar(
                lambda m: -log_likelihood(m, scale, counted), bounds=bracket, method="bounded", options={"xatol": 1e-4}
            ).x
        )

    m = best(ratio, weight, (0.0, largest))
    top = log_likelihood(m, ratio, weight)
    if 2 * (top - log_likelihood(0.0, ratio, weight)) < _SIGNIFICANT:
        line = np.linspace(m, largest, 40)
        over = [top - log_likelihood(x, ratio, weight) > 1.92 for x in line]
        return 0.0, float("nan"), float(line[int(np.argmax(over))] if any(over) else largest)
    left = []
    for k in range(_GROUPS):
        out = group == k
        counted = weight - np.bincount(row[out], minlength=weight.size)
        scale = (found - np.bincount(coarse[out], events[out], ratio.size)) / np.maximum(
            mean - np.bincount(coarse[out], cells.trials * rate[cell[out]], ratio.size), 1e-30
        )
        left.append(best(scale, counted, (0.7 * m, min(1.4 * m, largest))))
    error = float(np.sqrt((_GROUPS - 1) * np.var(left)))
    return m, error, m + 2 * error


def _sample(
    pixels: PixelCounts, expected: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Counts of a sample of pixels: the count, its cell, its place among coarse groups of rate, and its group."""
    rows, pixel = np.nonzero(expected[pixels.cell] >= 1.0)
    step = 1 + rows.size // _MOST_COUNTS
    order = np.random.default_rng(0).permutation(rows.size)[:: step]
    rows, pixel = rows[order], pixel[order]
    cell = pixels.cell[rows, pixel]
    level = np.floor(2 * np.log2(np.maximum(expected[cell], 1e-3))).astype(np.intp)
    _, coarse = np.unique(np.stack([rows, level]), axis=1, return_inverse=True)
    return pixels.counts[rows, pixel], cell, coarse, pixel % _GROUPS

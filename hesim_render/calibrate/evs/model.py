"""Event probability against brightness, as the calibration fits it (Eqs. 9–12 of the paper, corrected).

    u(I) = Θ (A I + B) / √(2 g),   g = 1 + 2 D y + y²,   y = C I ("linear") or C √I ("sqrt" shot law)
    P₊ = Q(r u₊ / √(1 + m² u₊²)) + λ,  u₊ = (1 − ρ) u,     P₋ = Q(r u₋ / √(1 + m² u₋²)),  u₋ = (1 + ρ) u

A = β0β1/β4, B = β0β2/β4, C = β3/β4, D = β5; u = θ/σ_n, ρ = (θ₋ − θ₊)/(θ₋ + θ₊), λ leak events per trial.
r is the known threshold of a pixel relative to the mean of its polarity, and m the standard deviation of the unknown
part, relative to the same mean: the mean of Q(u (r + m z)) over a normal z is exactly Q(r u / √(1 + m² u²)).

Whether it describes the counts is tested by χ² by brightness, with the scatter measured over pixels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.evs.cells import Cells, PixelCounts
from hesim_render.core.device_types import NUMPY
from hesim_render.pixels.evs.formulas import (
    Coefficients,
    ShotLaw,
    exceedance,
    over_thresholds,
    shot_root,
    static_threshold_over_noise,
    voltage,
    voltage_variance,
)

Law = ShotLaw
#: Order of the parameters of the fit, with C and D as w = C² (1 − D²) and e = C D: g = (1 + e y)² + w y² has neither
#: the singularity of (C, D) at C = 0 nor, as C √(1 − D²) would, a slope that vanishes at |D| = 1 and traps a search.
PARAMETERS = ("A", "ln B", "w", "e", "rho", "leak")
_SMALLEST = 1e-300
#: Least g, so that a search far from the maximum has no division by 0.
_LEAST_VARIANCE = 1e-12
_LARGEST_U = 1e6
_HALF_LOG_2PI = 0.5 * np.log(2 * np.pi)
#: Least events of a polarity and least pixels in a group, so that its mean has a normal law; with few events the
#: first is lowered to give this many groups.
_LEAST_EVENTS, _LEAST_PIXELS, _GROUPS = 100.0, 200, 20
_FEWEST_EVENTS = 10.0


def threshold_over_noise(parameters: NDArray, signal_dn: NDArray, theta_v: float, law: Law) -> tuple[NDArray, NDArray]:
    """u [..., bin] and ∂ ln u / ∂ (A, ln B, w, e) [..., bin, 4]; `parameters` [..., 6] as `PARAMETERS`."""
    k = coefficients(parameters)
    shot, e = shot_root(signal_dn, law, NUMPY), parameters[..., 3, None]
    x, g = voltage(k, signal_dn), relative_variance(k, signal_dn, law)
    # limit for a search far from the maximum; above it, P is 0 in double precision
    u = np.minimum(static_threshold_over_noise(theta_v, x, g, NUMPY), _LARGEST_U)
    slopes = np.stack([signal_dn / x, k.base / x, -0.5 * shot**2 / g, -shot * (1 + e * shot) / g], axis=-1)
    return u, slopes


def coefficients(parameters: NDArray) -> Coefficients:
    """The pixel model's coefficients [..., 1] in the gauge β0 = β4 = 1: β1 = A, β2 = B, β3 = C, β5 = D."""
    a, b, w, e = (parameters[..., k, None] for k in range(4))
    return Coefficients(slope=a, base=np.exp(b), light=w + e * e, cross=2 * e, dark=1.0)


def relative_variance(k: Coefficients, signal_dn: NDArray, law: Law) -> NDArray[np.float64]:
    """g = s²/β4² at the signals [bin]."""
    return np.maximum(voltage_variance(k, shot_root(signal_dn, law, NUMPY), NUMPY), _LEAST_VARIANCE)


def natural(parameters: NDArray, covariance: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(A, B, C, D, ρ, λ) [..., 6] and their covariance [..., 6, 6] from the fit's parameters."""
    w, e = parameters[..., 2], parameters[..., 3]
    c = np.sqrt(e * e + w)
    safe = np.maximum(c, 1e-30)
    values = parameters.copy()
    values[..., 1], values[..., 2], values[..., 3] = np.exp(parameters[..., 1]), c, e / safe
    slope = np.zeros((*parameters.shape, 6))
    slope[..., range(6), range(6)] = 1.0
    slope[..., 1, 1] = values[..., 1]
    slope[..., 2, 2], slope[..., 2, 3] = 0.5 / safe, e / safe
    slope[..., 3, 2], slope[..., 3, 3] = -0.5 * e / safe**3, w / safe**3
    return values, slope @ covariance @ slope.swapaxes(-1, -2)


def from_natural(values: NDArray) -> NDArray[np.float64]:
    """The fit's parameters from (A, B, C, D, ρ, λ) [..., 6]."""
    parameters = values.copy()
    parameters[..., 1] = np.log(values[..., 1])
    parameters[..., 2] = values[..., 2] ** 2 * (1 - values[..., 3] ** 2)
    parameters[..., 3] = values[..., 2] * values[..., 3]
    return parameters


def log_probability(parameters: NDArray, cells: Cells, theta_v: float, law: Law) -> tuple[NDArray, NDArray]:
    """ln P [..., cell] and its derivatives [..., cell, 6], finite however small P is."""
    u, slopes = threshold_over_noise(parameters, cells.signal_dn, theta_v, law)
    rho, leak = parameters[..., 4, None], parameters[..., 5, None]
    on = cells.polarity > 0
    # the spread of thresholds is relative to the mean of the polarity, so that ρ comes before the mean over it
    own = (1 - cells.polarity * rho) * u
    v = over_thresholds(own, cells.relative, cells.spread, NUMPY)
    flatter = 1 + (cells.spread * own) ** 2
    logarithm = log_ndtr(-v)
    hazard = np.exp(-0.5 * v * v - _HALF_LOG_2PI - logarithm)
    jacobian = np.zeros((*v.shape, 6))
    jacobian[..., :4] = (-hazard * v / flatter)[..., None] * slopes
    jacobian[..., 4] = hazard * cells.polarity * cells.relative * u / flatter**1.5
    with np.errstate(divide="ignore"):
        both = np.where(on, np.logaddexp(logarithm, np.log(leak)), logarithm)
    jacobian *= np.exp(logarithm - both)[..., None]
    jacobian[..., 5] = np.where(on, np.exp(-np.maximum(both, -300.0)), 0.0)
    return both, jacobian


def probability(parameters: NDArray, cells: Cells, theta_v: float, law: Law) -> NDArray:
    """P [..., cell] of the cell's polarity."""
    return np.exp(log_probability(parameters, cells, theta_v, law)[0])


def both_probabilities(
    parameters: NDArray, signal_dn: NDArray, theta_v: float, law: Law, mismatch: float
) -> tuple[NDArray, NDArray]:
    """P₊, P₋ [bin], means over the pixels' thresholds."""
    one, none = np.ones(signal_dn.shape), np.zeros(signal_dn.shape)
    results = []
    for polarity in (1.0, -1.0):
        line = Cells(signal_dn, polarity * one, one, mismatch * one, one, none, 1)
        results.append(probability(parameters, line, theta_v, law))
    return results[0], results[1]


def probability_variance(u: NDArray, mismatch: NDArray | float, relative: NDArray | float = 1.0) -> NDArray:
    """Variance over pixels of Q(u (r + m z)), z standard normal (Gauss–Hermite, 40 points)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = weights / weights.sum()
    mean, square = np.zeros(u.shape), np.zeros(u.shape)
    for z, weight in zip(nodes, weights, strict=True):
        p = exceedance(u * (relative + mismatch * z), 1.0)
        mean += weight * p
        square += weight * p * p
    return np.maximum(square - mean * mean, 0.0)


def log_likelihood(cells: Cells, log_p: NDArray) -> NDArray:
    """Binomial log-likelihood of the events of each polarity without the constant, summed over cells [...]."""
    rest = np.log(np.maximum(-np.expm1(np.minimum(log_p, -1e-12)), _SMALLEST))
    return np.sum(cells.events * log_p + (cells.total - cells.events) * rest, axis=-1)


@dataclass(frozen=True)
class Goodness:
    """χ² of the groups' residuals (ON, OFF), and the probability of a larger one."""

    chi2: float
    dof: int

    @property
    def per_dof(self) -> float:
        """1 where there are not more groups than parameters, and nothing is left to judge by."""
        return self.chi2 / self.dof if self.dof > 0 else 1.0

    @property
    def p_value(self) -> float:
        return float(chi2_law.sf(self.chi2, self.dof)) if self.dof > 0 else 1.0


def goodness(pixels: PixelCounts, parameters: NDArray, theta_v: float, law: Law, fitted: int) -> Goodness:
    """Residuals of pixels alike in brightness, ON and OFF, against their own scatter over those pixels.

    That scatter includes every cause of variation or correlation (thresholds, noise from tick to tick), so
    that the sum of squares has a χ² law of two degrees of freedom a group, less the parameters `fitted`.
    """
    chi2, groups = 0.0, 0
    for session in np.unique(pixels.is_dark):
        on, off = np.flatnonzero(pixels.is_dark == session)
        means = [pixels.cells.trials * probability(parameters, pixels.single(int(k)), theta_v, law) for k in (on, off)]
        residual = [pixels.counts[k] - mean for k, mean in zip((on, off), means, strict=True)]
        # counts that scatter more than by counting have the information of fewer counts
        effect = max(
            1.0, *(float(r @ r) / max(float(mean.sum()), 1e-9) for r, mean in zip(residual, means, strict=True))
        )
        group = np.zeros(pixels.signal_dn.size, np.intp)
        if not session:
            group = _groups(pixels.signal_dn, np.minimum(*means) / effect)

        def total(values: NDArray, group: NDArray = group) -> NDArray[np.float64]:
            return np.bincount(group, values).astype(np.float64)

        expected = [np.maximum(total(mean), 1e-9) for mean in means]
        # the scatter relative to counting is that of several groups together: a few events do not determine it
        wide = _wider(np.minimum(*expected) / effect)
        squares = [
            np.bincount(wide, total(x * y))[wide] / np.sqrt(np.bincount(wide, p)[wide] * np.bincount(wide, q)[wide])
            for x, y, p, q in (
                (residual[0], residual[0], expected[0], expected[0]),
                (residual[1], residual[1], expected[1], expected[1]),
                (*residual, *expected),
            )
        ]
        # a correlation matrix that can be inverted, whatever few counts say
        aa, bb = np.maximum(squares[0], 0.1), np.maximum(squares[1], 0.1)
        ab = np.clip(squares[2], -0.99 * np.sqrt(aa * bb), 0.99 * np.sqrt(aa * bb))
        # residuals of ON and OFF in units of counting, and their quadratic form with the measured scatter
        a, b = (total(r) / np.sqrt(e) for r, e in zip(residual, expected, strict=True))
        chi2 += float(np.sum((a * a * bb - 2 * a * b * ab + b * b * aa) / (aa * bb - ab * ab)))
        groups += a.size
    return Goodness(chi2, 2 * groups - fitted)


def _wider(events: NDArray[np.float64]) -> NDArray[np.intp]:
    """Neighbouring groups together until they hold enough events: the number of each group's wider one."""
    number = np.floor(np.cumsum(events) / _LEAST_EVENTS - 1e-9).astype(np.intp)
    _, number = np.unique(np.minimum(number, max(int(number[-1]) - 1, 0)), return_inverse=True)
    return number


def _groups(signal_dn: NDArray, events: NDArray) -> NDArray[np.intp]:
    """Pixels in order of brightness, in groups that hold enough of them and of their events."""
    order = np.argsort(signal_dn, kind="stable")
    events = np.cumsum(events[order])
    # events that a group needs
    enough = float(np.clip(events[-1] / _GROUPS, _FEWEST_EVENTS, _LEAST_EVENTS))
    ends: list[int] = []
    start, before = 0, 0.0
    while start < order.size:
        # enough events and enough pixels
        end = max(int(np.searchsorted(events, before + enough)) + 1, start + _LEAST_PIXELS)
        if end > order.size:
            break
        ends.append(end)
        start, before = end, float(events[end - 1])
    # the rest at the end joins the previous group
    group = np.empty(order.size, np.intp)
    group[order] = np.searchsorted(np.array(ends[:-1], np.intp), np.arange(order.size), side="right")
    return group

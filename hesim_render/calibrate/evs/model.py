"""Event probability against brightness, as the calibration fits it (Eqs. 9–12 of the paper, corrected).

    u(I) = Θ (A I + B) / √(2 g),   g = 1 + 2 D y + y²,   y = C I ("linear") or C √I ("sqrt" shot law)
    P₊ = Q(r u₊ / √(1 + m² u₊²)) + λ,  u₊ = (1 − ρ) u,     P₋ = Q(r u₋ / √(1 + m² u₋²)),  u₋ = (1 + ρ) u

A = β0β1/β4, B = β0β2/β4, C = β3/β4, D = β5; u = θ/σ_n, ρ = (θ₋ − θ₊)/(θ₋ + θ₊), λ leak events per trial.
r is the known threshold of a pixel relative to the mean of its polarity, and m the standard deviation of the unknown
part, relative to the same mean: the mean of Q(u (r + m z)) over a normal z is exactly Q(r u / √(1 + m² u²)).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from hesim_render.calibrate.evs.cells import Cells
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

"""Event probability against brightness, as the calibration fits it (Eqs. 9–12 of the paper, corrected).

    u(I) = Θ (A I + B) / √(2 g),   g = 1 + 2 D y + y²,   y = C I ("linear") or C √I ("sqrt" shot law)
    P₊ = Q((1 − ρ) u / √(1 + m² u²)) + λ,     P₋ = Q((1 + ρ) u / √(1 + m² u²))

A = β0β1/β4, B = β0β2/β4, C = β3/β4, D = β5; u = θ/σ_n, ρ = (θ₋ − θ₊)/(θ₋ + θ₊), m the relative
standard deviation of the thresholds over pixels, λ leak events per trial. The mean of Q(u (1 + m z)) over
a normal z is exactly Q(u / √(1 + m² u²)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

Law = Literal["linear", "sqrt"]
#: Order of the parameters of the fit, with C and D as w = C² (1 − D²) and e = C D: g = (1 + e y)² + w y² has neither
#: the singularity of (C, D) at C = 0 nor, as C √(1 − D²) would, a slope that vanishes at |D| = 1 and traps a search.
PARAMETERS = ("A", "ln B", "w", "e", "rho", "leak")
_SMALLEST = 1e-300
_LARGEST_U = 1e6
_HALF_LOG_2PI = 0.5 * np.log(2 * np.pi)


@dataclass(frozen=True)
class EventCounts:
    """Counts pooled by brightness; all arrays [..., bin].

    Attributes
    ----------
    signal_dn : mean signal of a bin. trials : trials of all its pixels together. on, off : its events.
    """

    signal_dn: NDArray[np.float64]
    trials: NDArray[np.float64]
    on: NDArray[np.float64]
    off: NDArray[np.float64]


def threshold_over_noise(
    parameters: NDArray, signal_dn: NDArray, theta_v: float | NDArray, law: Law
) -> tuple[NDArray, NDArray]:
    """u [..., bin] and ∂ ln u / ∂ (A, ln B, w, e) [..., bin, 4]; `parameters` [..., 6] as `PARAMETERS`."""
    a, b, w, e = (parameters[..., k, None] for k in range(4))
    b = np.exp(b)
    shot = signal_dn if law == "linear" else np.sqrt(signal_dn)
    x = a * signal_dn + b
    g = np.maximum((1 + e * shot) ** 2 + w * shot**2, 1e-12)
    # a search may run far off; beyond this, P is 0 in double precision all the same
    u = np.minimum(theta_v * x / np.sqrt(2 * g), _LARGEST_U)
    slopes = np.stack([signal_dn / x, b / x, -0.5 * shot**2 / g, -shot * (1 + e * shot) / g], axis=-1)
    return u, slopes


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


def log_probabilities(
    parameters: NDArray, signal_dn: NDArray, theta_v: float | NDArray, law: Law, mismatch: float
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """ln P₊, ln P₋ [..., bin] and their derivatives [..., bin, 6], finite however small P is."""
    u, slopes = threshold_over_noise(parameters, signal_dn, theta_v, law)
    rho, leak = parameters[..., 4, None], parameters[..., 5, None]
    widened = np.sqrt(1 + (mismatch * u) ** 2)
    results = []
    for sign in (-1.0, 1.0):
        v = (1 + sign * rho) * u / widened
        logarithm = log_ndtr(-v)
        hazard = np.exp(-0.5 * v * v - _HALF_LOG_2PI - logarithm)
        jacobian = np.zeros((*v.shape, 6))
        jacobian[..., :4] = (-hazard * v / widened**2)[..., None] * slopes
        jacobian[..., 4] = -hazard * sign * u / widened
        if sign < 0:
            with np.errstate(divide="ignore"):
                both = np.logaddexp(logarithm, np.log(leak))
            jacobian *= np.exp(logarithm - both)[..., None]
            jacobian[..., 5] = np.exp(-np.maximum(both, -300.0))
            logarithm = both
        results.append((logarithm, jacobian))
    (on, on_slope), (off, off_slope) = results
    return on, off, on_slope, off_slope


def probabilities(
    parameters: NDArray, signal_dn: NDArray, theta_v: float | NDArray, law: Law, mismatch: float
) -> tuple[NDArray, NDArray]:
    """P₊, P₋ [..., bin]."""
    on, off, _, _ = log_probabilities(parameters, signal_dn, theta_v, law, mismatch)
    return np.exp(on), np.exp(off)


def mean_probability(u: NDArray, mismatch: float) -> NDArray:
    """Mean of Q over the pixels' thresholds."""
    return ndtr(-u / np.sqrt(1 + (mismatch * u) ** 2))


def probability_variance(u: NDArray, mismatch: float) -> NDArray:
    """Variance over pixels of Q(u (1 + m z)), z standard normal (Gauss–Hermite, 40 points)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = weights / weights.sum()
    p = ndtr(-u[..., None] * (1 + mismatch * nodes))
    mean = p @ weights
    return np.maximum((p * p) @ weights - mean * mean, 0.0)


def log_likelihood(counts: EventCounts, log_on: NDArray, log_off: NDArray) -> NDArray:
    """Trinomial log-likelihood (ON, OFF, none) without the constant, summed over bins [...]."""
    none = np.maximum(1 - np.exp(log_on) - np.exp(log_off), _SMALLEST)
    rest = counts.trials - counts.on - counts.off
    return np.sum(counts.on * log_on + counts.off * log_off + rest * np.log(none), axis=-1)

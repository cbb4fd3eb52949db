"""Noise of event pixels as formulas: what the simulator samples and the calibration fits.

With I the signal in DN of the signal reference, per event position::

    x  = β1 I + β2                        voltage, the photodiode's baseline included
    s² = (β3 I)² + β4² + 2 β5 β3 β4 I     "linear" shot law
    s² = β3² I + β4² + 2 β5 β3 β4 √I      "sqrt" shot law
    S  = ln x₁/x₀,  σ_n² = s₀²/x₀² + s₁²/x₁²,  ΔV = S + σ_n·z
    P₊ = Q((θ₊ − S)/σ_n),  P₋ = Q((θ₋ + S)/σ_n)

θ are natural-log thresholds; each pixel's own is θ·(1 + m·z). In a static scene S = 0 and σ_n² = 2 s²/x², and the
mean of Q(u (r + m z)) over a normal z, u = θ/σ_n, is exactly Q(r u/√(1 + m² u²)).

Arrays are NumPy's or Dr.Jit's (`hesim_render.core.namespace`), probabilities NumPy's alone; nothing here draws a
random number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from hesim_render.core.device_types import Values
from hesim_render.core.namespace import Namespace

ShotLaw = Literal["linear", "sqrt"]


@dataclass(frozen=True)
class Coefficients:
    """x and s² as functions of a signal: x = slope·I + base, s² = light·y² + cross·y + dark with y of `shot_root`.

    Numbers, or arrays over positions, pixels or fits. The signal is in DN, or in electrons of the window where the
    coefficients were made with `dn_per_signal`.
    """

    slope: Values
    base: Values
    light: Values
    cross: Values
    dark: Values

    @classmethod
    def of(cls, beta: tuple[Values, ...], dn_per_signal: Values, law: ShotLaw, xp: Namespace) -> Coefficients:
        """From β1 … β5 and the DN of one unit of the signal."""
        beta1, beta2, beta3, beta4, beta5 = beta
        linear = law == "linear"
        return cls(
            slope=beta1 * dn_per_signal,
            base=beta2,
            light=beta3**2 * (dn_per_signal**2 if linear else dn_per_signal),
            cross=2 * beta5 * beta3 * beta4 * (dn_per_signal if linear else xp.sqrt(dn_per_signal)),
            dark=beta4**2,
        )

    def each(self, change: Callable[[Values], Values]) -> Coefficients:
        """With `change` applied to each: entries taken, another type, or a copy on the device."""
        return Coefficients(*(change(values) for values in (self.slope, self.base, self.light, self.cross, self.dark)))


def shot_root(signal: Values, law: ShotLaw, xp: Namespace) -> Values:
    """y, with which the noise of the light grows: I ("linear" law) or √I ("sqrt" law)."""
    return signal if law == "linear" else xp.sqrt(signal)


def voltage(k: Coefficients, signal: Values) -> Values:
    """x, in the unit of β2."""
    return k.slope * signal + k.base


def voltage_variance(k: Coefficients, root: Values, xp: Namespace) -> Values:
    """s² at y = `root`, in the unit of β2²."""
    # with full anticorrelation s² is a square that can be 0: rounding must not take it below
    return xp.maximum((k.light * root + k.cross) * root + k.dark, 0.0)


def log_level(k: Coefficients, signal: Values, law: ShotLaw, xp: Namespace) -> tuple[Values, Values]:
    """ln x, and its noise variance s²/x²."""
    x = voltage(k, signal)
    return xp.log(x), voltage_variance(k, shot_root(signal, law, xp), xp) / (x * x)


def noise_equivalent(k: Coefficients, signal: Values, least_change: Values, law: ShotLaw, xp: Namespace) -> Values:
    """The change of the signal that equals s, or `least_change` of ln x where that is more."""
    noise = xp.sqrt(voltage_variance(k, shot_root(signal, law, xp), xp))
    return xp.maximum(noise, least_change * voltage(k, signal)) / k.slope


def corner_hz(
    k: Coefficients, log: Values, reference_level: Values, least_hz: float, largest_hz: float, xp: Namespace
) -> Values:
    """Corner of a photoreceptor that follows the light, at ln x: proportional to the signal, between two limits.

    Parameters
    ----------
    reference_level : β1 times the signal at which the corner is `largest_hz`.
    """
    return xp.clip(largest_hz * ((xp.exp(log) - k.base) / reference_level), least_hz, largest_hz)


def exceedance(margin: ArrayLike, sigma: ArrayLike) -> NDArray[np.float64]:
    """P(σ·z > margin) = Q(margin/σ) of a normal z; without noise 1 where the margin is negative, else 0."""
    margin, sigma = np.asarray(margin), np.asarray(sigma)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0, special.ndtr(-margin / sigma), np.where(margin < 0, 1.0, 0.0))


def event_probabilities(
    theta_on: ArrayLike, theta_off: ArrayLike, change: NDArray, sigma: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """P₊ and P₋ of a comparison.

    Parameters
    ----------
    theta_on, theta_off : thresholds, ln units, positive.
    change : S = ln x₁/x₀. sigma : σ_n; thresholds that spread by m θ count as noise: √(σ_n² + m² θ²).
    """
    return exceedance(np.asarray(theta_on) - change, sigma), exceedance(np.asarray(theta_off) + change, sigma)


def static_threshold_over_noise(theta: Values, x: Values, variance: Values, xp: Namespace) -> Values:
    """u = θ/σ_n of a static scene, θ·x/√(2 s²)."""
    return theta * x / xp.sqrt(2 * variance)


def over_thresholds(u: Values, relative: Values, spread: Values, xp: Namespace) -> Values:
    """v with Q(v) the mean of Q(u (r + m z)) over a normal z.

    Parameters
    ----------
    relative : r, what is known of a threshold, relative to the mean of all.
    spread : m, the relative standard deviation of what is not known.
    """
    return relative * u / xp.sqrt(1 + (spread * u) ** 2)


def leak_probability(rate_hz: float, interval_s: float) -> float:
    """Chance of a leak event, a Poisson process, in an interval: 1 − exp(−rate·Δt)."""
    return -math.expm1(-rate_hz * interval_s)


def rate_hz(probability: ArrayLike, interval_s: float) -> NDArray[np.float64]:
    """Rate of the Poisson process that gives an event in an interval with such a chance; `leak_probability` turned
    round. A chance of 1 counts as one less 1e-9."""
    return -np.log1p(-np.clip(probability, 0.0, 1.0 - 1e-9)) / interval_s


def own_events(counted: ArrayLike, own_on: ArrayLike, own_off: ArrayLike, polarity: ArrayLike) -> NDArray[np.float64]:
    """Chance of an event of a defect in a comparison, from all events: it shows where the comparison gave none.

    Parameters
    ----------
    counted : events per comparison, of the polarity. own_on, own_off : those of a good pixel's comparisons.
    polarity : +1 or −1.
    """
    on, off = np.asarray(own_on), np.asarray(own_off)
    own = np.where(np.asarray(polarity) > 0, on, off)
    return np.clip((np.asarray(counted) - own) / np.maximum(1.0 - on - off, 1e-9), 0.0, 1.0)


def firing_share(firing_s: Values, quiet_s: Values) -> Values:
    """Part of the time in which a flickering pixel fires, from the mean times of both states."""
    return firing_s / (firing_s + quiet_s)


def change_rate_hz(firing_s: Values, quiet_s: Values) -> Values:
    """Rate at which a flickering pixel forgets its state: its states correlate as exp(−rate·Δt)."""
    return 1.0 / firing_s + 1.0 / quiet_s


def flicker_moments(
    rate_per_trial: Values, share: Values, correlation: Values, trials: int
) -> tuple[Values, Values, Values]:
    """Of the counts of a flickering pixel in stretches of `trials` comparisons, one after the other.

    Parameters
    ----------
    rate_per_trial : r, chance of an event while it fires. share : p, of the time. correlation : of its state from one
        comparison to the next, c.

    Returns
    -------
    mean, variance, covariance of neighbours : n r p; n r p (1 − r p) + r² p (1 − p) Σ_{i≠j} c^|i−j|; and
        r² p (1 − p) Σ_i Σ_j c^(n + j − i) = r² p (1 − p) c ((1 − cⁿ)/(1 − c))².
    """
    n, c = trials, correlation
    power = c**n
    spread = rate_per_trial**2 * share * (1 - share)
    pairs = 2 * c / (1 - c) * (n - (1 - power) / (1 - c))
    own = n * rate_per_trial * share * (1 - rate_per_trial * share)
    return n * rate_per_trial * share, own + spread * pairs, spread * c * ((1 - power) / (1 - c)) ** 2

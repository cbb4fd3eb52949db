"""Noise of event pixels as formulas: what the simulator samples and the calibration fits.

With I the signal in DN of the signal reference, per event position::

    x  = β1 I + β2                        voltage, the photodiode's baseline included
    s² = (β3 I)² + β4² + 2 β5 β3 β4 I     "linear" shot law
    s² = β3² I + β4² + 2 β5 β3 β4 √I      "sqrt" shot law
    S  = ln x₁/x₀,  σ_n² = s₀²/x₀² + s₁²/x₁²,  ΔV = S + σ_n·z
    P₊ = Q((θ₊ − S)/σ_n),  P₋ = Q((θ₋ + S)/σ_n)

θ are natural-log thresholds; the threshold of a pixel is θ·(1 + m·z). In a static scene S = 0 and σ_n² = 2 s²/x². The
mean of Q(u (r + m z)) over a normal z, u = θ/σ_n, is exactly Q(r u/√(1 + m² u²)).

Arrays are NumPy's or Dr.Jit's (`hesim_render.core.device_types`), probabilities NumPy's alone; nothing here draws a
random number.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from hesim_render.core.device_types import Namespace, Values

ShotLaw = Literal["linear", "sqrt"]

#: Two equal poles that are −3 dB together at f: the rate of each over f, a = 2π f/√(√2 − 1), and its frequency over f.
POLE = math.tau / math.sqrt(math.sqrt(2.0) - 1.0)
POLE_HZ = 1 / math.sqrt(math.sqrt(2.0) - 1.0)


@dataclass(frozen=True)
class Coefficients:
    """x and s² as functions of a signal: x = slope·I + base, s² = light·y² + cross·y + dark with y from `shot_root`.

    The coefficients are numbers, or arrays over positions, pixels or fits. The signal is in DN, or in electrons of the
    window if the coefficients were made with `dn_per_signal`.
    """

    slope: Values
    base: Values
    light: Values
    cross: Values
    dark: Values

    @classmethod
    def of(cls, beta: tuple[Values, ...], dn_per_signal: Values, law: ShotLaw, xp: Namespace) -> "Coefficients":
        """Coefficients from β1 … β5.

        Parameters
        ----------
        beta : β1 … β5.
        dn_per_signal : DN per unit of the signal.
        law : shot law.
        xp : functions of the arrays' library.
        """
        beta1, beta2, beta3, beta4, beta5 = beta
        linear = law == "linear"
        return cls(
            slope=beta1 * dn_per_signal,
            base=beta2,
            light=beta3**2 * (dn_per_signal**2 if linear else dn_per_signal),
            cross=2 * beta5 * beta3 * beta4 * (dn_per_signal if linear else xp.sqrt(dn_per_signal)),
            dark=beta4**2,
        )

    def each(self, change: Callable[[Values], Values]) -> "Coefficients":
        """The same with `change` applied to each coefficient: to select entries, convert the type or copy to the
        device.
        """
        return Coefficients(*(change(values) for values in (self.slope, self.base, self.light, self.cross, self.dark)))


def shot_root(signal: Values, law: ShotLaw, xp: Namespace) -> Values:
    """y, to which the noise of the light is proportional: I ("linear" law) or √I ("sqrt" law).

    Parameters
    ----------
    signal : I, in the unit of the coefficients.
    law : shot law.
    xp : functions of the arrays' library.
    """
    return signal if law == "linear" else xp.sqrt(signal)


def voltage(k: Coefficients, signal: Values) -> Values:
    """x, in the unit of β2."""
    return k.slope * signal + k.base


def voltage_variance(k: Coefficients, root: Values, xp: Namespace) -> Values:
    """Variance s² at y = `root`, in the square of the unit of β2."""
    # with full anticorrelation s² is a square that can be 0: rounding must not make it negative
    return xp.maximum((k.light * root + k.cross) * root + k.dark, 0.0)


def log_level(k: Coefficients, signal: Values, law: ShotLaw, xp: Namespace) -> tuple[Values, Values]:
    """ln x and its noise variance s²/x².

    Parameters
    ----------
    k : coefficients.
    signal : I, in the unit of the coefficients.
    law : shot law.
    xp : functions of the arrays' library.
    """
    x = voltage(k, signal)
    return xp.log(x), voltage_variance(k, shot_root(signal, law, xp), xp) / (x * x)


def noise_equivalent(
    k: Coefficients, signal: Values, least_change: Values, law: ShotLaw, xp: Namespace, share: Values = 1.0
) -> Values:
    """Change of the signal that equals s, or `least_change` of ln x if that is larger.

    Parameters
    ----------
    k : coefficients.
    signal : I, in the unit of the coefficients.
    least_change : least change of ln x.
    law : shot law.
    xp : functions of the arrays' library.
    share : part of the variance s² that the photoreceptor leaves.
    """
    noise = xp.sqrt(voltage_variance(k, shot_root(signal, law, xp), xp) * share)
    return xp.maximum(noise, least_change * voltage(k, signal)) / k.slope


def corner_line(part: Values, least_hz: float, largest_hz: float) -> Values:
    """Corner frequency at a part of the signal at which it is `largest_hz`; limits as for `corner_hz`."""
    return least_hz + (largest_hz - least_hz) * part


def in_series(first_hz: Values, second_hz: Values) -> Values:
    """Corner of two stages whose time constants add up, f₁f₂/(f₁ + f₂)."""
    return first_hz * second_hz / (first_hz + second_hz)


def corner_hz(
    k: Coefficients,
    log: Values,
    reference_level: Values,
    least_hz: float,
    largest_hz: float,
    xp: Namespace,
    series_hz: float | None = None,
) -> Values:
    """Corner frequency of a photoreceptor that follows the light: a straight line from the dark to a largest value.

    The corner is proportional to the photocurrent, of which the dark current is a part. White noise before the
    photoreceptor has a variance behind it that is proportional to the corner.

    Two poles of the time constants τ₁, τ₂ leave white noise of the spectral density S (two-sided) the variance
    S/(2 (τ₁ + τ₂)), and delay a step by τ₁ + τ₂ on average [elmore1948]. Two equal poles of the mean time constant
    do both as well: so light and bias go on as one corner, in series.

    Parameters
    ----------
    k : coefficients.
    log : ln x.
    reference_level : β1 times the signal at which the corner is `largest_hz`.
    least_hz : corner in the dark, Hz.
    largest_hz : corner that the bias current sets, Hz.
    xp : functions of the arrays' library.
    series_hz : corner of the bias current, in series with that of the light, whose line goes on beyond `largest_hz`;
        None: the line ends there.
    """
    line = corner_line((xp.exp(log) - k.base) / reference_level, least_hz, largest_hz)
    if series_hz is not None:
        return in_series(xp.maximum(line, least_hz), series_hz)
    return xp.clip(line, least_hz, largest_hz)  # the lower limit is for rounding: no light is below 0


def exceedance(margin: ArrayLike, sigma: ArrayLike) -> NDArray[np.float64]:
    """P(σ·z > margin) = Q(margin/σ) for a normal z. Without noise it is 1 where the margin is negative, else 0."""
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
    change : S = ln x₁/x₀.
    sigma : σ_n. Thresholds with the relative spread m are included as noise: √(σ_n² + m² θ²).
    """
    return exceedance(np.asarray(theta_on) - change, sigma), exceedance(np.asarray(theta_off) + change, sigma)


def static_threshold_over_noise(theta: Values, x: Values, variance: Values, xp: Namespace) -> Values:
    """u = θ/σ_n in a static scene, θ·x/√(2 s²).

    Parameters
    ----------
    theta : θ, ln units.
    x : voltage, in the unit of β2.
    variance : s², in the square of that unit.
    xp : functions of the arrays' library.
    """
    return theta * x / xp.sqrt(2 * variance)


def over_thresholds(u: Values, relative: Values, spread: Values, xp: Namespace) -> Values:
    """v such that Q(v) is the mean of Q(u (r + m z)) over a normal z.

    Parameters
    ----------
    u : mean threshold over noise, θ/σ_n.
    relative : r, the known threshold relative to the mean of all pixels.
    spread : m, the relative standard deviation of the unknown part.
    xp : functions of the arrays' library.
    """
    return relative * u / xp.sqrt(1 + (spread * u) ** 2)


def leak_probability(rate_hz: float, interval_s: float) -> float:
    """Probability of a leak event in an interval, 1 − exp(−rate·Δt); leak events are a Poisson process.

    Parameters
    ----------
    rate_hz : rate, Hz.
    interval_s : Δt, s.
    """
    return -math.expm1(-rate_hz * interval_s)


def own_events(counted: ArrayLike, own_on: ArrayLike, own_off: ArrayLike, polarity: ArrayLike) -> NDArray[np.float64]:
    """Probability of an event of a defect in a comparison, from all events. It shows only where the comparison gave
    none.

    Parameters
    ----------
    counted : events per comparison of this polarity.
    own_on, own_off : ON and OFF events per comparison of a good pixel.
    polarity : +1 or −1.
    """
    on, off = np.asarray(own_on), np.asarray(own_off)
    own = np.where(np.asarray(polarity) > 0, on, off)
    return np.clip((np.asarray(counted) - own) / np.maximum(1.0 - on - off, 1e-9), 0.0, 1.0)


def firing_share(firing_s: Values, quiet_s: Values) -> Values:
    """Fraction of the time in which a flickering pixel fires, from the mean times in both states, s."""
    return firing_s / (firing_s + quiet_s)


def change_rate_hz(firing_s: Values, quiet_s: Values) -> Values:
    """Rate in Hz at which a flickering pixel forgets its state: the correlation of its state is exp(−rate·Δt)."""
    return 1.0 / firing_s + 1.0 / quiet_s


def flicker_moments(
    rate_per_trial: Values, share: Values, correlation: Values, trials: int
) -> tuple[Values, Values, Values]:
    """Moments of the counts of a flickering pixel in successive stretches of `trials` comparisons.

    Parameters
    ----------
    rate_per_trial : r, probability of an event in a comparison while the pixel fires.
    share : p, fraction of the time in which it fires.
    correlation : c, correlation of its state from one comparison to the next.
    trials : n, comparisons of a stretch.

    Returns
    -------
    mean : n r p.
    variance : n r p (1 − r p) + r² p (1 − p) Σ_{i≠j} c^|i−j|.
    covariance of neighbours : r² p (1 − p) Σ_i Σ_j c^(n + j − i) = r² p (1 − p) c ((1 − cⁿ)/(1 − c))².
    """
    n, c = trials, correlation
    power = c**n
    spread = rate_per_trial**2 * share * (1 - share)
    pairs = 2 * c / (1 - c) * (n - (1 - power) / (1 - c))
    own = n * rate_per_trial * share * (1 - rate_per_trial * share)
    return n * rate_per_trial * share, own + spread * pairs, spread * c * ((1 - power) / (1 - c)) ** 2

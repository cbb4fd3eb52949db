"""Likelihood of asynchronous pixels' first events, each pixel's own thresholds integrated out.

With I the light, x = β1 I + β2 and r = β1/β2, in the gauge β2 = 1 V::

    S = ln((1 + r I₁)/(1 + r I₀)),   σ² = (β3² Iᵖ + β4²)/(1 + r I)²,   p = 1 ("sqrt") or 2 ("linear")

θ of a pixel is N(θ̄, (m θ̄)²), ON and OFF apart. Each polarity is judged in steady light and after steps towards it. In
the chances of ON the other threshold is taken at its mean, and trials that an event of the other polarity ended are
left out: chances are those among the trials that go on.

A reset sets the pixel's reference to the level of that instant, including its noise σ₀ z. After the settling time the
light steps by S (0 in steady light). From then on the first event is ON where S + σ₁ ν − σ₀ z passes θ₊ before it
passes −θ₋. The state before the reset and the behaviour after that event have no influence.

ν is white noise through two equal poles, −3 dB together at the cut-off f_c: correlation (1 + a τ) exp(−a τ),
a = 2π f_c/√(√2 − 1). At the step it is above h with the probability Q(h); for a calm pixel, noise that would have
passed the threshold before is excluded. It stays below h for a time w after the step with the probability

    Φ(h) exp(−λ(h) w),   λ(h) = (a/2π) exp(−h²/2) · κ(h)

(a/2π) exp(−h²/2) is the rate of its crossings [rice1945]. κ corrects for crossings in clumps, for high probabilities
and for the noise as the event stage generates it: 16 nodes per period of the cut-off, straight lines between them, and
the same variance on average. A simulated sensor therefore has the measured rates. κ was counted on
1.2 million such paths of length 1.25/f_c up to h = 3.5. Above, it is the closed form of such a line's crossings, a
bivariate normal probability. Noise without nodes passes h = 0 to 2 by 5 % more often and h = 4 by 10 % less often. For
a sensor with such noise, the fitted f_c differs from its own f_c accordingly: it gives the right rates in a simulation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr

from hesim_render.calibrate.asynchronous.trials import Trials
from hesim_render.pixels.evs.formulas import POLE_HZ

Law = Literal["linear", "sqrt"]
#: Order of the parameters: means and relative spreads of the thresholds, r, β3², β4², f_c and leak.
NAMES = ("theta_on", "theta_off", "mismatch_on", "mismatch_off", "response", "shot", "dark", "cutoff_hz", "leak_hz")
THETA, MISMATCH, RESPONSE, SHOT, DARK, CUTOFF, LEAK = (0, 1), (2, 3), 4, 5, 6, 7, 8
#: Grid of thresholds: number of nodes, reach in spreads, and least reach as a fraction of the mean.
_NODES, _SPREADS, _LEAST_REACH = 97, 6.0, 0.05
#: Least probability of an outcome, so that no single trial excludes a threshold, and least noise in thresholds.
_LEAST_CHANCE, _LEAST_NOISE = 1e-9, 1e-3
#: ln κ against the level h in standard deviations, highest power first, between two ends of h; 0.4 % off the counts.
_LOG_KAPPA = (-3.1165e-05, 3.6215e-04, -4.6413e-04, -4.4709e-03, -0.027395, 0.34284, -0.92856, 0.61716)
_LOWEST, _HIGHEST, _SLOPE = -1.5, 6.0, -2.112  # below, ln κ goes on along its slope there
#: Fraction of a period of the cut-off in which the noise stays as at the reset and cannot pass a threshold.
_REMEMBERED = 0.15
#: Gauss–Hermite nodes and weights of the noise at the reset, in standard deviations.
_Z, _Z_WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_Z_WEIGHTS = _Z_WEIGHTS / _Z_WEIGHTS.sum()
#: Level that noise never reaches, in standard deviations.
_FAR = 30.0


def threshold_grid(theta: float, mismatch: float) -> NDArray[np.float64]:
    """Evenly spaced thresholds, ln units, at which the likelihood of a pixel is computed."""
    reach = max(_SPREADS * mismatch, _LEAST_REACH)
    return theta * np.linspace(max(1 - reach, 0.03), 1 + reach, _NODES)


def noise_of(values: NDArray, signal_dn: NDArray, law: Law) -> NDArray[np.float64]:
    """Standard deviation σ of ln x in a light of `signal_dn`, DN."""
    power = signal_dn if law == "sqrt" else signal_dn**2
    own = (values[SHOT] * power + values[DARK]) / (1 + values[RESPONSE] * signal_dn) ** 2
    return np.sqrt(own + (_LEAST_NOISE * values[0]) ** 2)


def step_of(values: NDArray, trials: Trials) -> NDArray[np.float64]:
    """S [kind] of the steps."""
    r = values[RESPONSE]
    return np.log1p(r * trials.signal_dn * np.exp(trials.contrast)) - np.log1p(r * trials.signal_dn)


def chances(values: NDArray, trials: Trials, polarity: int, thresholds: NDArray, law: Law) -> NDArray[np.float64]:
    """Probability [kind, bin, threshold] of a first event of one polarity, among trials that the other has not ended.

    Parameters
    ----------
    values : parameters in the order of `NAMES`.
    trials : kinds of trial.
    polarity : +1 or −1.
    thresholds : [threshold], ln units.
    law : shot law.
    """
    other = THETA[1] if polarity > 0 else THETA[0]
    step = polarity * step_of(values, trials)[:, None]
    after_dn = trials.signal_dn * np.exp(trials.contrast)
    noise = noise_of(values, trials.signal_dn, law)[:, None], noise_of(values, after_dn, law)[:, None]
    leak = (values[LEAK], 0.0) if polarity > 0 else (0.0, values[LEAK])
    events, others = first_event(
        thresholds[None, :], values[other], step, noise, values[CUTOFF], trials.settle_s, trials.edges_s, leak
    )
    # of the trials that go on: those that the other polarity has not ended
    left = np.maximum(1.0 - others.sum(axis=0), _LEAST_CHANCE)
    return np.moveaxis(np.clip(events / left, 0.0, 1.0), 0, 1)


@dataclass(frozen=True)
class TrialCounts:
    """Outcomes of one polarity; rows are pixels.

    Attributes
    ----------
    sets : the trials used for this polarity.
    events : [pixel, column], first events of this polarity; a column is a bin of a kind of trial.
    silent : [pixel, kind], trials with no event at all.
    """

    polarity: int
    sets: Sequence[Trials]
    events: NDArray[np.float64]
    silent: NDArray[np.float64]

    @classmethod
    def of(cls, sets: Sequence[Trials], polarity: int) -> "TrialCounts":
        sets = [t.towards(polarity) for t in sets]
        own = [t.events(polarity).reshape(-1, t.calm.shape[1]) for t in sets]
        silent = [t.calm - t.on.sum(axis=1, dtype=np.int64) - t.off.sum(axis=1, dtype=np.int64) for t in sets]
        return cls(
            polarity, sets, np.concatenate(own).T.astype(np.float64), np.concatenate(silent).T.astype(np.float64)
        )

    def log_likelihood(self, values: NDArray, grid: NDArray, law: Law) -> NDArray[np.float64]:
        """ln L [pixel, threshold]."""
        # ln of the chance of each outcome, by threshold: one product of matrices for all pixels
        result = [chances(values, t, self.polarity, grid, law) for t in self.sets]
        events = np.concatenate([np.log(np.maximum(c, _LEAST_CHANCE)).reshape(-1, grid.size) for c in result])
        none = np.concatenate([np.log(np.maximum(1.0 - c.sum(axis=1), _LEAST_CHANCE)) for c in result])
        return self.events @ events + self.silent @ none


def log_prior(theta: float, mismatch: float, grid: NDArray) -> NDArray[np.float64]:
    """Log of the prior probability of each threshold of the grid.

    Parameters
    ----------
    theta : mean threshold, ln units.
    mismatch : relative spread.
    grid : [threshold], ln units.
    """
    # never narrower than the grid, so that the mean is determined where thresholds hardly spread
    spread = np.hypot(mismatch, (grid[1] - grid[0]) / theta)
    weight = -0.5 * ((grid / theta - 1) / spread) ** 2
    return weight - logsumexp(weight)


@dataclass(frozen=True)
class Likelihood:
    """ln L of all pixels as a function of the parameters."""

    law: Law
    counts: tuple[TrialCounts, TrialCounts]
    grids: tuple[NDArray[np.float64], NDArray[np.float64]]

    @classmethod
    def of(cls, sets: Sequence[Trials], law: Law, grids: tuple[NDArray, NDArray]) -> "Likelihood":
        return cls(law, (TrialCounts.of(sets, 1), TrialCounts.of(sets, -1)), grids)

    def given_thresholds(self, values: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """ln L [pixel, threshold] of ON and of OFF."""
        on, off = (
            counts.log_likelihood(values, grid, self.law) for counts, grid in zip(self.counts, self.grids, strict=True)
        )
        return on, off

    def of_pixels(self, values: NDArray, given: tuple[NDArray, NDArray] | None = None) -> NDArray[np.float64]:
        """ln L [pixel]. `given` holds the terms that do not depend on the spread and the mean of thresholds."""
        given = self.given_thresholds(values) if given is None else given
        return sum(
            logsumexp(g + log_prior(values[THETA[k]], values[MISMATCH[k]], self.grids[k]), axis=1)
            for k, g in enumerate(given)
        )  # type: ignore[return-value]


def passage_rate(level: NDArray) -> NDArray[np.float64]:
    """Rate λ/f_c at which unit noise passes a level, in standard deviations."""
    h = np.clip(level, -_FAR, _FAR)
    inside = np.clip(h, _LOWEST, _HIGHEST)
    log_kappa = np.full(np.shape(h), _LOG_KAPPA[0])
    for factor in _LOG_KAPPA[1:]:
        log_kappa = log_kappa * inside + factor
    log_kappa += _SLOPE * np.minimum(h - _LOWEST, 0.0)
    return POLE_HZ * np.exp(np.minimum(log_kappa - 0.5 * h * h, 50.0))


def correlation(cutoff_hz: float, elapsed_s: float) -> float:
    """Autocorrelation of the noise.

    Parameters
    ----------
    cutoff_hz : cut-off frequency, Hz.
    elapsed_s : time difference, s.
    """
    h = math.tau * POLE_HZ * cutoff_hz * elapsed_s
    return (1.0 + h) * math.exp(-h)


def first_event(
    theta: NDArray | float,
    theta_other: NDArray | float,
    step: NDArray,
    noise: tuple[NDArray, NDArray],
    cutoff_hz: float,
    settle_s: float,
    edges_s: NDArray,
    leak_hz: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probability that the first event falls in each time bin with one polarity, given no event while settling.

    Thresholds, step and noise are broadcast against each other to a shape (…).

    Parameters
    ----------
    theta, theta_other : thresholds of this polarity and of the other, ln units.
    step : change of ln x towards this polarity (S for ON, −S for OFF); 0 in steady light.
    noise : σ₀ and σ₁ before and after the step, ln units, above 0.
    cutoff_hz : cut-off frequency of the noise, Hz.
    settle_s : time from the reset to the step, s.
    edges_s : [bin + 1], bounds of the time bins, s; the first is 0, the time of the step.
    leak_hz : rates of spontaneous events of this polarity and of the other, Hz.

    Returns
    -------
    own : [bin, …], probability of this polarity.
    other : [bin, …], probability of the other.
    """
    before, after = noise
    shape = np.broadcast_shapes(*(np.shape(v) for v in (theta, theta_other, step, before, after)))
    own, other = np.zeros((2, len(edges_s) - 1, *shape))
    # chance of trials that are calm until the step, of which the result is the share
    total = np.zeros(shape)
    # how much of the noise at the reset is left at the step, and the amplitude of what is new
    rho = correlation(cutoff_hz, settle_s)
    fresh = math.sqrt(max(1.0 - rho * rho, 1e-12))
    settling = max(settle_s - _REMEMBERED / cutoff_hz, 0.0)
    for z, weight in zip(_Z, _Z_WEIGHTS, strict=True):
        # chance of no event while settling, for noise that was z standard deviations high at the reset
        high, low = theta / before + z, theta_other / before - z
        lost = cutoff_hz * (passage_rate(high) + passage_rate(low)) + sum(leak_hz)
        kept = weight * np.exp(-np.minimum(lost * settling, 500.0))
        # distances to both thresholds after the step
        up, down = theta - step + before * z, theta_other + step - before * z
        # at the step a calm pixel's noise lies within both thresholds and still correlates with that at the reset
        within, below = ndtr((high - rho * z) / fresh), ndtr((low + rho * z) / fresh)
        calm = np.maximum(within + below - 1.0, 1e-12)
        at_once = np.maximum(within - ndtr((up / after - rho * z) / fresh), 0.0) / calm
        at_once_other = np.maximum(below - ndtr((down / after + rho * z) / fresh), 0.0) / calm
        at_once, at_once_other = np.minimum(at_once, 1.0), np.minimum(at_once_other, 1.0 - np.minimum(at_once, 1.0))
        # after the step: rates at which noise passes either threshold, with leaks; the first passage wins
        rate = cutoff_hz * passage_rate(up / after) + leak_hz[0]
        rate_other = cutoff_hz * passage_rate(down / after) + leak_hz[1]
        both = np.maximum(rate + rate_other, 1e-300)
        waiting = np.maximum(kept * (1.0 - at_once - at_once_other), 0.0)
        alive = np.exp(-np.minimum(both * np.reshape(edges_s, (-1, *[1] * len(shape))), 700.0))
        # chance that the first passage lies in each bin, shared between both polarities by their rates
        later = waiting * (alive[:-1] - alive[1:])
        own += later * (rate / both)
        other += later * (rate_other / both)
        # what passes with the step itself belongs to the first bin
        own[0] += kept * at_once
        other[0] += kept * at_once_other
        total += kept
    total = np.maximum(total, 1e-300)
    return own / total, other / total

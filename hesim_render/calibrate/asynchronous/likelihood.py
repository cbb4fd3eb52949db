"""Likelihood of asynchronous pixels' first events, each pixel's own thresholds integrated out.

With I the light, x = β1 I + β2 and r = β1/β2, in the gauge β2 = 1 V::

    S = ln((1 + r I₁)/(1 + r I₀)),   σ² = (β3² Iᵖ + β4²)/(1 + r I)²,   p = 1 ("sqrt") or 2 ("linear")

θ of a pixel is N(θ̄, (m θ̄)²), ON and OFF apart. Each polarity is judged in steady light and after steps towards it. In
the chances of ON the other threshold is taken at its mean, and trials that an event of the other polarity ended are
left out: chances are those among the trials that go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from hesim_render.calibrate.asynchronous.first_event import first_event
from hesim_render.calibrate.asynchronous.trials import Trials

Law = Literal["linear", "sqrt"]
#: Order of the parameters: means and relative spreads of the thresholds, r, β3², β4², f_c and leak.
NAMES = ("theta_on", "theta_off", "mismatch_on", "mismatch_off", "response", "shot", "dark", "cutoff_hz", "leak_hz")
THETA, MISMATCH, RESPONSE, SHOT, DARK, CUTOFF, LEAK = (0, 1), (2, 3), 4, 5, 6, 7, 8
#: Grid of thresholds: number of nodes, reach in spreads, and least reach as a fraction of the mean.
_NODES, _SPREADS, _LEAST_REACH = 97, 6.0, 0.05
#: Least probability of an outcome, so that no single trial excludes a threshold, and least noise in thresholds.
_LEAST_CHANCE, _LEAST_NOISE = 1e-9, 1e-3


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
    def of(cls, sets: Sequence[Trials], polarity: int) -> TrialCounts:
        sets = [t.towards(polarity) for t in sets]
        own = [t.events(polarity).reshape(-1, t.calm.shape[1]) for t in sets]
        silent = [t.calm - t.on.sum(axis=1, dtype=np.int64) - t.off.sum(axis=1, dtype=np.int64) for t in sets]
        return cls(
            polarity, sets, np.concatenate(own).T.astype(np.float64), np.concatenate(silent).T.astype(np.float64)
        )

    def log_likelihood(self, values: NDArray, grid: NDArray, law: Law) -> NDArray[np.float64]:
        """ln L [pixel, threshold]."""
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
    def of(cls, sets: Sequence[Trials], law: Law, grids: tuple[NDArray, NDArray]) -> Likelihood:
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

"""Event pixels that fire intermittently: their mean times, from counts of successive parts of a capture.

A trial is a comparison of a sensor with fixed ticks, or the time after a reset of an asynchronous sensor.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from hesim_render.pixels.evs.formulas import flicker_moments

#: Probability that the counts of a steady pixel are called unsteady.
_CHANCE = 1e-6
#: Correlations of the state from trial to trial that are tried, as mean times of 1/8 trial up to 1e7 trials.
_TIMES = np.geomspace(0.125, 1e7, 400)


def unsteady(parts: NDArray, trials: int) -> NDArray[np.bool_]:
    """Pixels whose scatter of events from part to part has a probability below 1e-6 under a constant rate.

    Parameters
    ----------
    parts : [part, pixel], events of successive parts of equal length.
    trials : trials of a part.
    """
    mean = parts.mean(axis=0, dtype=np.float64)
    own = np.maximum(mean * (1 - mean / trials), 1e-12)
    scatter = np.sum((parts - mean) ** 2, axis=0) / own
    # few events per part make the χ² law's tail heavier, by a relative variance of 1/(2 mean) and less
    heavier = np.sqrt(1 + 1 / np.maximum(2 * mean, 1e-12))
    freedom = parts.shape[0] - 1
    return (mean * parts.shape[0] >= 10) & (chi2.sf(freedom + (scatter - freedom) / heavier, freedom) < _CHANCE)


def dynamics(
    parts: NDArray, trials: int, usual: NDArray | float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Part of the trials in which pixels fire, and how its state correlates from trial to trial, by moments.

    Of the counts the mean is n r p. Their excess of variance over one rate's is r² p (1 − p) times a sum that depends
    on the correlation alone, and so is the covariance of neighbours: their ratio tells the correlation, and then the
    excess over the square of the mean tells (1 − p)/p. A pixel that does not flicker measurably has 1 and 0.

    Parameters
    ----------
    parts : [part, pixel], as of `unsteady`. trials : of a part.
    usual : [pixel], events per trial of a good pixel's comparisons, which are in the mean as well.
    """
    count = parts.shape[0]
    mean = parts.mean(axis=0, dtype=np.float64)
    off = parts - mean
    variance = np.sum(off**2, axis=0) / (count - 1)
    neighbour = np.sum(off[1:] * off[:-1], axis=0) / (count - 1)
    excess = variance - mean * (1 - mean / trials)
    own = mean / trials - usual
    correlation = np.exp(-1 / _TIMES)
    # at r = 1 and p = ½: spread·pairs and spread·product of `flicker_moments`, whose ratio holds for all r and p
    _, total, product = flicker_moments(1.0, 0.5, correlation, trials)
    pairs = total - 0.25 * trials
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.clip(neighbour / excess, 0.0, 1.0)
    chosen = np.minimum(np.searchsorted(product / pairs, ratio), _TIMES.size - 1)
    sums = 4 * pairs[chosen]  # Σ_{i≠j} c^|i−j|
    with np.errstate(divide="ignore", invalid="ignore"):
        odds = (excess / sums) / own**2  # (1 − p)/p
    flickers = (excess > 0) & (own > 0) & np.isfinite(odds)
    share = np.where(flickers, 1 / (1 + np.where(flickers, odds, 0.0)), 1.0)
    return np.maximum(share, 1 / (count * trials)), np.where(flickers, correlation[chosen], 0.0)

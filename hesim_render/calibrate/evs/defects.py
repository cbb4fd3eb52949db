"""Outlying event pixels: detected where no threshold within the spread explains the counts, then classified."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import binom, poisson

from hesim_render.calibrate.evs.counts import StaticCapture
from hesim_render.calibrate.evs.medians import (
    LEAST_EVENTS,
    by_group,
    density,
    like_brightness,
    middle_and_spread,
    spread_of_thresholds,
)
from hesim_render.calibrate.evs.steps import Steps
from hesim_render.calibrate.evs.thresholds import Thresholds, totals_of
from hesim_render.calibrate.flicker import dynamics, unsteady
from hesim_render.calibration.spec import Defect
from hesim_render.pixels.evs.formulas import own_events

#: Probability that a good pixel's count is called bad, number of spreads allowed, and least allowance.
_CHANCE, _SPREADS, _LEAST_REACH = 1e-7, 6.0, 0.06
#: Least number of pixels for an estimate of the spread of a difference.
_FEWEST = 200
#: Difference in standard errors above which the counts of one pixel are not constant.
_SIGMAS = 6.0


@dataclass(frozen=True)
class EventDefects:
    """Bad event pixels; maps [row, col].

    Attributes
    ----------
    bad : all bad pixels.
    kind : uint8, `Defect`.
    on, off : events per trial of hot and flickering pixels beyond those of a good pixel, 0 elsewhere. For a flickering
        pixel it is the value while it fires where that is known, else the mean.
    firing_share, correlation : for flickering pixels, the fraction of the trials in which they fire and the correlation
        of that state from trial to trial; 1 and 0 elsewhere, and where they are not known.
    """

    bad: NDArray[np.bool_]
    kind: NDArray[np.uint8]
    on: NDArray[np.float32]
    off: NDArray[np.float32]
    firing_share: NDArray[np.float32]
    correlation: NDArray[np.float32]

    def count(self, kind: Defect) -> int:
        return int(np.sum(self.kind == kind))


def bad_event_pixels(static: StaticCapture) -> NDArray[np.bool_]:
    """Pixels [row, col] whose counts no threshold within the spread of the others explains.

    Pixels are compared with those of similar brightness. The spread of thresholds is taken from quartiles, so that bad
    pixels do not widen it. A pixel is bad where a threshold 6 spreads (6 % at least) away would give its count with
    a chance below 1e-7, or where its two thresholds differ by so much.
    """
    known = np.isfinite(static.signal_dn)
    bad = ~known
    spread = spread_of_thresholds(static, known)
    reach = max(_LEAST_REACH, _SPREADS * spread)
    for signal, *both in static.sessions:
        group = like_brightness(signal[known])
        middle, _ = middle_and_spread([counts[known] for counts in both], group, static.trials, spread)
        for u, counts in zip(middle, both, strict=True):
            bad[known] |= _out_of_reach(counts[known], group, static.trials, u, reach)
        bad[known] |= _apart([counts[known] for counts in both], group, static.trials, middle)
    return bad


def _out_of_reach(counts: NDArray, group: NDArray, trials: int, u: NDArray, reach: float) -> NDArray[np.bool_]:
    # chances of an event with the lowest and the highest threshold that may be, [group]
    high, low = ndtr(-u * max(1 - reach, 0.0)), ndtr(-u * (1 + reach))
    # Only counts far off need the exact tail.
    margin = 4.0
    far = [margin * np.sqrt(trials * p * (1 - p)) for p in (high, low)]
    result = np.zeros(counts.shape, bool)
    over, under = counts > (trials * high + far[0])[group], counts < (trials * low - far[1])[group]
    result[over] = binom.sf(counts[over] - 1, trials, high[group[over]]) < _CHANCE
    result[under] = binom.cdf(counts[under], trials, low[group[under]]) < _CHANCE
    return result


def _apart(both: list[NDArray], group: NDArray, trials: int, middle: list[NDArray]) -> NDArray[np.bool_]:
    """Pixels whose ON and OFF thresholds differ by more than those of the other pixels."""
    result = np.zeros(group.shape, bool)
    enough = np.all([counts >= LEAST_EVENTS for counts in both], axis=0)
    # threshold over noise from the rate of each pixel, and its variance by counting, for either polarity
    rate = [(counts[enough] + 0.5) / (trials + 1) for counts in both]
    t = [-ndtri(r) for r in rate]
    noise = sum(r * (1 - r) / trials / np.maximum(density(x), 1e-12) ** 2 for r, x in zip(rate, t, strict=True))
    u = (middle[0] + middle[1])[group[enough]] / 2
    usable = u > 0.3
    if usable.sum() < _FEWEST:
        return result
    difference = (t[0] - t[1] - (middle[0] - middle[1])[group[enough]])[usable] / u[usable]
    own = np.sqrt(noise[usable]) / u[usable]
    # how far the two thresholds of good pixels differ: the quartile-like spread, less what counting makes
    low, centre, high = np.quantile(difference, [0.16, 0.5, 0.84])
    spread = np.sqrt(max(((high - low) / 2) ** 2 - float(np.median(own**2)), 0.0))
    limit = max(_LEAST_REACH, _SPREADS * spread) + _SIGMAS * own
    result[np.flatnonzero(enough)[usable]] = np.abs(difference - centre) > limit
    return result


def bad_in_steps(steps: Steps, thresholds: Thresholds, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Good pixels [row, col] whose events over all steps no threshold within the spread explains."""
    result = np.zeros(good.shape, bool)
    for polarity, total, mismatch in (
        (1.0, steps.on_total, thresholds.mismatch_on), (-1.0, steps.off_total, thresholds.mismatch_off),
    ):  # fmt: skip
        reach = max(_LEAST_REACH, _SPREADS * mismatch)
        # the sum of binomial counts scatters less than a Poisson count with the same mean
        most, least = totals_of(thresholds, polarity, np.array([1 - reach, 1 + reach]), steps.trials)
        result |= good & ((poisson.sf(total - 1, most) < _CHANCE) | (poisson.cdf(total, least) < _CHANCE))
    apart = (thresholds.pixel_on - thresholds.pixel_off).astype(np.float64)
    noise = np.hypot(thresholds.noise_on, thresholds.noise_off).astype(np.float64)
    low, centre, high = np.quantile(apart[good], [0.16, 0.5, 0.84])
    spread = np.sqrt(max(((high - low) / 2) ** 2 - float(np.median(noise[good] ** 2)), 0.0))
    return result | (good & (np.abs(apart - centre) > max(_LEAST_REACH, _SPREADS * spread) + _SIGMAS * noise))


def classify(static: StaticCapture, bad: NDArray[np.bool_], steps: Steps | None) -> EventDefects:
    """Classify the bad pixels: stuck, hot, flickering or other.

    A stuck pixel gives no event in any capture. A hot or flickering pixel gives more events than all but a thousandth
    of the good pixels of its brightness. A hot pixel gives equal numbers of its own events per trial in the dark and in
    the light and, where counts of parts of a capture are known, in each part.
    """
    kind = np.where(bad, np.uint8(Defect.OTHER), np.uint8(Defect.NONE))
    own_chance = np.zeros((2, *bad.shape), np.float32)
    firing_share, correlation = np.ones(bad.shape, np.float32), np.zeros(bad.shape, np.float32)
    if not bad.any():
        return EventDefects(bad, kind, own_chance[0], own_chance[1], firing_share, correlation)
    silent = np.ones(int(bad.sum()), bool)
    own, excess, significant = [], [], []
    for signal, on, off in static.sessions:
        # counts of the bad pixels against those of good pixels in the same light, [polarity, pixel]
        both = np.stack([on[bad], off[bad]]).astype(np.float64)
        usual, most = _of_like(signal, bad, (on, off), static.trials)
        beyond = both > most + _SIGMAS * np.sqrt(most + 1)
        excess.append(beyond.any(axis=0))
        significant.append(beyond)
        own.append([own_events(both[k] / static.trials, usual[0], usual[1], 1 - 2 * k) for k in (0, 1)])
        silent &= both.sum(axis=0) == 0
    if steps is not None:
        silent &= (steps.on_total[bad] + steps.off_total[bad]) == 0
    rates = np.array(own)  # [session, polarity, pixel]
    over, steady = np.any(excess, axis=0), np.all(excess, axis=0)
    if len(rates) > 1:
        apart = np.abs(rates[0] - rates[1]).sum(axis=0)
        counting = np.sqrt((rates[0] + rates[1]).sum(axis=0) / static.trials)
        # what is taken for the comparisons' own events is as good as a tenth
        steady &= apart < _SIGMAS * counting + 0.1 * np.minimum(rates[0], rates[1]).sum(axis=0)
    if static.parts is not None:
        steady &= ~unsteady(static.parts[:, bad], static.part_trials)
    named = np.full(silent.shape, np.uint8(Defect.OTHER))
    named[over] = np.where(steady[over], np.uint8(Defect.HOT), np.uint8(Defect.FLICKERING))
    named[silent] = Defect.STUCK
    kind[bad] = named
    # a polarity with no more events than good pixels have does not count: its threshold may be low
    chance = np.where(np.any(significant, axis=0), rates.mean(axis=0), 0.0)
    flickers = np.flatnonzero(named == Defect.FLICKERING)
    if static.parts is not None and flickers.size:
        which = tuple(axis[flickers] for axis in np.nonzero(bad))
        share, correlation[which] = dynamics(
            static.parts[:, bad][:, flickers], static.part_trials, (usual[0] + usual[1])[flickers]
        )
        firing_share[which] = share
        chance[:, flickers] = np.minimum(chance[:, flickers] / share, 1.0)
    own_chance[:, bad] = chance
    return EventDefects(bad, kind, own_chance[0], own_chance[1], firing_share, correlation)


def _of_like(
    signal: NDArray, bad: NDArray[np.bool_], both: tuple[NDArray, NDArray], trials: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For each bad pixel, statistics of the good pixels of its brightness.

    Returns
    -------
    mean, limit : [polarity, pixel], mean probability of ON and of OFF, and the count that only a thousandth exceed.
    """
    # groups of good pixels of like brightness, in order; each bad pixel takes the group of its own
    good = ~bad & np.isfinite(signal)
    group = like_brightness(signal[good])
    light = np.array([part.max() for part in by_group(signal[good], group)])
    # a pixel of unknown brightness is compared with the pixels that have the most events
    here = np.where(np.isfinite(signal[bad]), signal[bad], np.inf)
    place = np.minimum(np.searchsorted(light, here), light.size - 1)
    result = []
    for reduce in (lambda part: part.mean() / trials, lambda part: np.quantile(part, 0.999)):
        usual = np.array([[reduce(part) for part in by_group(counts[good], group)] for counts in both])
        result.append(np.where(np.isfinite(here), usual[:, place], usual.max(axis=1)[:, None]))
    return result[0], result[1]

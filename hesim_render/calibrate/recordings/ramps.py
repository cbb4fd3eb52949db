"""Noise in the ramps of a moving target's light: how unevenly the events of a pixel follow one another there.

A pixel whose light rises at s thresholds a second has an event every 1/s; noise n, in thresholds, moves each of them by
n/s. Of four events in a row with the intervals I₁, I₂, I₃, D = ln I₁ − 2 ln I₂ + ln I₃ is 0 without noise where the
logarithm of the light, or the light itself, is a straight line. With noise of deviation σ through two equal poles p,
whose correlation is r(t) = (1 + p t) e^(−p t), the variance of D is::

    V = σ² (20 − 30 r(I) + 12 r(2 I) − 2 r(3 I))

Slow noise moves neighbours alike, so that V has the bandwidth in it, which late events at the rests hardly have. Noise
that is fast beside the ramp reaches each threshold early, with a smaller scatter. What the light itself has of D is the
same in each cycle: half of the variance of the difference between successive cycles is taken, from its median size.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.calibrate.recordings.tally import GROUPS, EventTally
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs.formulas import POLE

#: Events at either end of a run that do not count, as the light may turn there, and most others of a run that do.
_ENDS, _MOST = 1, 24
#: Logarithm of the longest over the shortest interval of both cycles: longer ones hold a turn of the light.
_UNEVEN = np.log(4.0)
#: Relative difference of the times between a pixel's runs from the period.
_ONE_PERIOD = 0.2
#: Intervals are taken together within such a factor, where there are so many, and so many of all.
_STEP, _LEAST, _LEAST_SHARE = np.sqrt(2.0), 100, 0.1
#: Median size of a normal deviate, over its standard deviation.
_OF_NORMAL = 0.674490
#: Largest part of V that the steps of the clock may have.
_OF_CLOCK = 0.3
#: Part of V that is left where noise is fast beside the ramp, by σ p I: counted on simulated noise of σ from 0.01 to
#: 0.2 and p I from 0.25 to 128, with an error of 5 %; larger σ are not known from V.
_SPEED = np.array([0.6, 1.28, 1.92, 3.2, 3.84, 6.4, 9.0, 12.8, 18.0, 25.0])
_LEFT = np.array([1.0, 0.89, 0.81, 0.735, 0.67, 0.555, 0.5, 0.46, 0.39, 0.35])
_MOST_NOISE = 0.25
#: Largest V that tells: events of strong noise leave intervals that count no longer, those with the largest D.
_MOST_VARIANCE = 0.2
#: Error of ln V, one for all intervals of both polarities, and what unlike noise in bright and dark light adds to it,
#: over the logarithm of their variances' ratio. Measured on 18 sensors written in NumPy (33 to 1512 Hz, poles 1 to 7
#: apart): 0.15 rms, −0.11 in the mean; on one of 27 Hz and the smallest noise −0.65.
_LAW_ERROR, _OF_LIGHT = 0.15, 0.25
#: By how much both likelihoods may be below their maxima together; beyond, something else scatters the events.
_LIKELY = 4.5


class Jitter(NamedTuple):
    """Scatter of a pixel's events in the ramps.

    Parameters
    ----------
    is_on : of rises or falls, [k].
    interval_s : mean interval, s [k].
    variance : V, [k].
    error : of ln V, by its scatter over groups of pixels, [k].
    """

    is_on: NDArray[np.bool_]
    interval_s: NDArray[np.float64]
    variance: NDArray[np.float64]
    error: NDArray[np.float64]


def jitter(tally: EventTally) -> Jitter | None:
    """Of the pixels whose events the tally keeps; None where they have too few of them in a ramp."""
    period_s = tally.period_s()
    pixel, t_us, on = tally.kept()
    if period_s is None or pixel.size < _LEAST:
        return None
    clock_us = max(int(np.gcd.reduce(t_us - t_us[0])), 1)
    turn = (np.diff(pixel, prepend=-1) != 0) | (np.diff(on.astype(np.int8), prepend=0) != 0)
    start = np.flatnonzero(turn)
    size = np.diff(np.append(start, pixel.size)) - 2 * _ENDS
    rows = []
    for is_on in (True, False):
        runs = (on[start] == is_on) & (size >= 4)
        begin, length = start[runs] + _ENDS, np.minimum(size[runs], _MOST)
        # the same ramp one period later
        away = np.diff(t_us[begin]) / (period_s / S_PER_US)
        next_one = (np.diff(pixel[begin]) == 0) & (np.abs(away - 1) < _ONE_PERIOD)
        both = np.stack([begin[:-1], begin[1:]])[:, next_one]
        fours = np.minimum(length[:-1], length[1:])[next_one] - 3
        rows += _by_interval(is_on, tally.group[pixel].astype(np.int64), t_us, both, fours, clock_us)
    return Jitter(*(np.array(values) for values in zip(*rows, strict=True))) if rows else None


def _by_interval(
    is_on: bool,
    group: NDArray[np.int64],
    t_us: NDArray[np.int64],
    both: NDArray[np.int64],
    fours: NDArray[np.int64],
    clock_us: int,
) -> list[tuple[bool, float, float, float]]:
    """V of runs that begin at two cycles' events [cycle, run], with so many fours of events in a row [run], as the
    values of `Jitter` for each range of intervals.
    """
    logs, differences, groups = [], [], []
    for k in range(int(fours.max(initial=0))):
        events = both[:, fours > k] + k
        times = t_us[events[:, None] + np.arange(4)[:, None]]  # [cycle, four, run]
        interval = np.log(np.maximum(np.diff(times, axis=1), 1) * S_PER_US)
        even = np.ptp(interval, axis=(0, 1)) < _UNEVEN
        second = interval[:, 0] - 2 * interval[:, 1] + interval[:, 2]
        logs.append(interval.mean(axis=(0, 1))[even])
        differences.append(np.abs(second[1] - second[0])[even])
        groups.append(group[events[0]][even])
    log, difference, own = (np.concatenate(one) if one else np.empty(0) for one in (logs, differences, groups))
    # shorter intervals have a smaller V, in which the light's own bends count for more
    longer = log >= np.median(log) if log.size else np.zeros(0, np.bool_)
    log, difference, own = log[longer], difference[longer], own[longer]
    steps, place = np.unique(np.floor(log / np.log(_STEP)), return_inverse=True)
    rows = []
    for k in range(steps.size):
        mine = place == k
        if np.count_nonzero(mine) < max(_LEAST, _LEAST_SHARE * log.size):
            continue
        size = difference[mine]
        of_group = np.array([_of_median(size[own[mine] == g]) for g in range(GROUPS)])
        interval_s, whole = float(np.exp(log[mine].mean())), _of_median(size)
        # what steps of the clock add: 20 times the variance of an even law
        of_clock = 20 / 12 * (clock_us * S_PER_US / interval_s) ** 2
        if of_group.min() > 0 and of_clock < _OF_CLOCK * whole and whole < _MOST_VARIANCE:
            error = float(np.log(of_group).std(ddof=1)) / np.sqrt(GROUPS)
            rows.append((is_on, interval_s, whole - of_clock, error))
    return rows


def _of_median(difference: NDArray[np.float64]) -> float:
    """Variance of one of two normal values, by the median size of their difference; 0 without any."""
    return 0.5 * (float(np.median(difference)) / _OF_NORMAL) ** 2 if difference.size else 0.0


def variance(noise: NDArray, cutoff_hz: NDArray, interval_s: NDArray) -> NDArray[np.float64]:
    """V of noise, in thresholds, of a corner in Hz, where events come at an interval, s."""
    sigma = np.minimum(noise, _MOST_NOISE)
    turns = cutoff_hz * POLE * interval_s

    def alike(t: NDArray) -> NDArray:
        return (1 + t) * np.exp(-t)

    still = 20 - 30 * alike(turns) + 12 * alike(2 * turns) - 2 * alike(3 * turns)
    return np.asarray(sigma**2 * still * np.interp(np.log(sigma * turns), np.log(_SPEED), _LEFT))


def likelihoods(
    top: NDArray[np.float64],
    bottom: NDArray[np.float64],
    noise: NDArray[np.float64],
    cutoff_hz: NDArray[np.float64],
    of_ramps: Jitter | None,
    ratio: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Logarithm of the likelihood that all but its own late events give to the values of each rest, [cut-off, noise],
    and that of the ramps alone, [cut-off, noise at the top, at the bottom].

    Parameters
    ----------
    top, bottom : logarithm of the likelihood by late events of each rest, [cut-off, noise].
    noise, cutoff_hz : values of the last axis, in thresholds of the rest's own polarity, and of the first.
    of_ramps : None where only the late events count.
    ratio : θ₋/θ₊.
    """
    own = np.zeros((cutoff_hz.size, noise.size, noise.size))
    if of_ramps is not None:
        own = _of_ramps(noise, cutoff_hz, of_ramps, ratio)
        if (own + top[:, :, None] + bottom[:, None, :]).max() < top.max() + bottom.max() + own.max() - _LIKELY:
            own = np.zeros_like(own)
    return (
        np.asarray(special.logsumexp(own + bottom[:, None, :], axis=2)),
        np.asarray(special.logsumexp(own + top[:, :, None], axis=1)),
        own,
    )


def _of_ramps(
    noise: NDArray[np.float64], cutoff_hz: NDArray[np.float64], of: Jitter, ratio: float
) -> NDArray[np.float64]:
    """Logarithm of the chance of V, [cut-off, noise at the top, at the bottom], mean over the level of the ramp."""
    bright, dark = noise[:, None], noise * ratio  # in θ₊
    mean = np.sqrt((bright**2 + bright * dark + dark**2) / 3)
    of_light = _OF_LIGHT * 2 * np.abs(np.log(bright / dark))
    result = np.zeros((cutoff_hz.size, noise.size, noise.size))
    corner = cutoff_hz[:, None, None]
    for k in range(of.variance.size):
        expected = variance(mean if of.is_on[k] else mean / ratio, corner, of.interval_s[k])
        # the law's error is common to all intervals: so many of them tell no more than one
        spread = np.sqrt(of.error[k] ** 2 + of.variance.size * (_LAW_ERROR**2 + of_light**2))
        result -= 0.5 * (np.log(of.variance[k] / expected) / spread) ** 2 + np.log(spread)
    return result

"""Dead time of pixels and limit of the read-out, from the shortest intervals and the busiest windows of recordings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from hesim_render.calibrate.estimate import Z_95, not_identifiable
from hesim_render.calibrate.recordings.tally import LONG_US, WINDOW_US, EventTally
from hesim_render.core.units import US_PER_S

#: Intervals within a factor of two of the dead time that are needed to see it.
_LEAST_INTERVALS = 100
#: Largest density of intervals below 0.8 of the dead time, over that above: strays of the read-out.
_STRAY = 0.03
#: Intervals in a step of the clock, over those of the fullest one, from which it is none of strays.
_OF_CLOCK = 0.01
#: Intervals from which a density is read: of the rise, of the counts at the edge, of each part after it, and the least
#: steps of the clock in such a part.
_OF_RISE, _OF_STEP, _OF_LEVEL, _LEAST_PART = 30, 8, 400, 4
#: Relative error of a density that is read from parts next to it: real ones have waves.
_UNEVEN = 0.02
#: A density whose logarithm falls by more than this within the counts after the edge is not known there; chance of a
#: count that is too large for the density.
_FALLS, _CHANCE = 0.25, 1e-4
#: Where pixels start anew after the dead time, noise comes to a threshold late: at most so many times of its rise from
#: 10 to 90 % lie between both (0.7 to 3.7 in noise of 60 to 1500 Hz written in NumPy, θ/σ of 0.7 to 3.5; 2.1 of
#: simulated `dvxplorer` at 3 lx; chosen on these, judged on those of the test).
_SLOW = 5.0
#: Steps from 0 to the edge, over the counts that are read about it, from which these bound a step whose density falls.
#: Chosen on a recording of modulated light with a dead time of 2.7 ms, judged on the hundred sensors of the tests.
_FEW_STEPS = 8
#: Windows that must be equally full, and part of all windows of the same recording above which it is saturated.
_LEAST_WINDOWS, _SATURATED = 20, 0.1
#: Fullest windows differ by no more than this part, and than this part of what chance makes of as many events: those
#: of a lamp that flickers are as full as one another, but for chance.
_SAME, _OF_CHANCE = 0.01, 0.5
#: Windows are full of pixels if they hold so many events of each, but for this part of the pixels.
_SILENT = 0.02


def dead_time(tallies: Sequence[EventTally]) -> dict[str, Any]:
    """Dead time in µs: the place of a sharp step of the density of a pixel's intervals that takes as much away.

    Times that are whole numbers of the clock's steps, and a read-out that delays events at random, make the step a
    gradual one, from which as many intervals are missing. Their number over the density after the step is the place.
    Where the density rises over more than two steps of the clock, the interval holds the whole rise, and the time
    before it: recovery, unlike pixels, delays, and noise that comes to a threshold late after the dead time look alike.
    """
    counts = np.sum([one.intervals for one in tallies], axis=0)[:LONG_US].astype(np.float64)
    if counts.sum() < _LEAST_INTERVALS:
        reason = f"{int(counts.sum())} intervals are shorter than {LONG_US / 1000:g} ms; {_LEAST_INTERVALS} are needed"
        return not_identifiable(reason)
    clock_us = _clock_us(counts)
    counts = counts[::clock_us]
    edge = _steepest(counts)
    after = counts[edge : 2 * edge + 2]
    # the density close to the edge: fast pixels have no long intervals
    part = max(_LEAST_PART, int(np.searchsorted(np.cumsum(after), _OF_LEVEL)) + 1)
    each = max(after[k : k + part].mean() for k in (0, min(part, after.size - 1)))
    shorter = counts[: max(1, round(0.8 * edge))]
    if edge * clock_us < 2 or after.sum() < _LEAST_INTERVALS or shorter.mean() > _STRAY * each:
        clock = f" (times are whole numbers of {clock_us} µs)" if clock_us > 1 else ""
        return not_identifiable(
            f"the density of the intervals has no step: short intervals are as frequent as longer ones{clock}"
        )
    wide = int(np.ceil(_OF_RISE / each))
    rise = counts[: (2 * edge + 2) // wide * wide].reshape(-1, wide).sum(axis=1) / (wide * each)
    begin, end = (int(np.argmax(rise >= part)) * wide for part in (0.1, 0.9))
    margin = max(2, int(np.ceil(_OF_STEP / each)), end - edge + 1)
    place, error, most = _place(counts, edge, margin, part)
    if counts[edge : edge + margin + 1].max() > stats.poisson.isf(_CHANCE / margin, most):
        if edge < _FEW_STEPS * margin or begin < edge - margin:
            return not_identifiable(
                f"the density of the intervals falls at once after its step at {edge * clock_us} µs: its course within "
                f"the clock's steps of {clock_us} µs is not known"
            )
        # a course that is not known moves a sharp step by no more than the counts that are read about it
        place, error = float(edge), margin / Z_95
    place, error = place * clock_us, error * clock_us
    low, high = place - Z_95 * error, place + Z_95 * error
    if end - begin > 2 * wide:
        before = 1 + _SLOW * (end - begin)
        low, high = min(low, (begin - before) * clock_us), max(high, (end + 1.0) * clock_us)
        if low <= 0:
            return not_identifiable(
                f"the density of the intervals rises slowly, from 10 % of what it is later at {begin * clock_us} µs to "
                f"90 % at {end * clock_us} µs, as noise does that comes to a threshold late; at most {high:.0f} µs"
            )
    return {
        "value": place, "standard_error": (high - low) / (2 * Z_95), "interval_95": [low, high], "unit": "µs",
        "note": f"the density reaches 10 % of what it is later at {begin * clock_us} µs and 90 % at "
        f"{end * clock_us} µs; {int(counts[:begin].sum())} intervals are shorter",
    }  # fmt: skip


def _clock_us(counts: NDArray[np.float64]) -> int:
    """Step of the times, µs: what all intervals but a few strays are multiples of."""
    return max(int(np.gcd.reduce(np.flatnonzero(counts > _OF_CLOCK * counts.max()))), 1)


def _steepest(counts: NDArray[np.float64]) -> int:
    """Place d of the most significant rise of the density, from [0, d) to [d, 2 d]; 0 if there is none."""
    total = np.append(0.0, np.cumsum(counts))
    place = np.arange(1, counts.size // 2)
    below, upper = total[place], total[2 * place + 1] - total[place]
    gain = special.xlogy(below, below / place) + special.xlogy(upper, upper / (place + 1))
    both = below + upper
    gain -= special.xlogy(both, both / (2 * place + 1))
    rises = (upper >= _LEAST_INTERVALS) & (upper / (place + 1) > below / place)
    return int(place[np.argmax(np.where(rises, gain, -np.inf))]) if rises.any() else 0


def _place(counts: NDArray[np.float64], edge: int, margin: int, part: int) -> tuple[float, float, float]:
    """Place of the sharp step and its standard error, in steps of the clock, from `margin` counts around the edge;
    the largest density there that goes with the one after it.

    A pair of times of steps of the clock has the interval k with the weight 1 − |x − k|, so that a sharp step at x lets
    the counts k ≤ K be short of x + ½ whole ones. The density is read from two parts after them, each of `part`
    counts, and goes on towards the edge as from one to the other.
    """
    first, last = max(edge - margin, edge // 2), edge + margin
    near, far = (counts[last + 1 + k * part :][:part].sum() for k in range(2))
    # from the middle of the nearer part to that of the counts in between, in parts
    way = 0.5 + (0.5 * (margin + 1)) / part
    fall = np.log(max(near, 1.0) / max(far, 1.0))
    level = near / part * np.exp(way * fall)
    stray = counts[:first].mean() if first else 0.0
    inside = counts[first : last + 1].sum()
    if level <= 2 * stray or near == 0:
        return float(edge), np.inf, 0.0  # nothing comes after the counts at the edge
    beyond = (inside - stray * (last + 1 - first)) / (level - stray)
    of_level = np.sqrt((1 + way) ** 2 / max(near, 1.0) + way**2 / max(far, 1.0) + _UNEVEN**2)
    error = np.hypot(np.sqrt(max(inside, 1.0)) / level, beyond * of_level)
    most = level * np.exp(0.5 * margin / part * fall) * (1 + 4 * of_level) if way * fall < _FALLS else 0.0
    return float(last + 0.5 - beyond), float(error), float(most)


def readout_limit(tallies: Sequence[EventTally]) -> tuple[dict[str, Any], list[EventTally]]:
    """Events a second that the read-out takes, and the recordings that it limits for more than a tenth of the time.

    A read-out at its limit passes equally many events in every window. Where the fullest windows are not equally full,
    to 1 %, the limit has not been reached; nor where they hold a whole number of events of each pixel, since then the
    pixels or the light are the limit. The interval is half of that, at least one event a window.
    """
    most = max(one.windows.size - 1 for one in tallies)
    slack = max(2, round(min(_SAME * most, _OF_CHANCE * np.sqrt(most))))
    windows = [np.pad(one.windows, (0, most + 1 - one.windows.size)) for one in tallies]
    every = np.sum(windows, axis=0)
    full, below = every[most - slack :], every[max(most - 2 * slack - 1, 0) : most - slack]
    rate = US_PER_S / WINDOW_US
    least = f"{float(f'{most * rate:.4g}'):,.0f}"
    # windows of a few events have no less full ones beside them to compare with
    if most <= 2 * slack + 1 or full.sum() < _LEAST_WINDOWS or full.sum() < 5 * below.sum():
        return not_identifiable(f"no two of the fullest windows are equally full; it is at least {least} events/s"), []
    each = most / tallies[0].pixels
    if 0 <= np.ceil(each) - each <= _SILENT * np.ceil(each):
        return not_identifiable(
            f"the fullest windows hold {np.ceil(each):g} events of every pixel, so that the pixels or the light limit "
            f"them; it is at least {least} events/s"
        ), []
    value = float(np.sum(full * np.arange(most - slack, most + 1)) / full.sum())
    error = max(slack / 2, 1.0) / 2
    limited = [
        one for one, of in zip(tallies, windows, strict=True) if of[most - slack :].sum() > _SATURATED * of.sum()
    ]
    return {
        "value": value * rate, "standard_error": error * rate,
        "interval_95": [(value - 2 * error) * rate, (value + 2 * error) * rate], "unit": "events/s",
        "note": f"{int(full.sum())} windows of 1 ms hold {most - slack} to {most} events",
    }, limited  # fmt: skip

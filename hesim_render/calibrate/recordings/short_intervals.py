"""Dead time of pixels and limit of the read-out, from the shortest intervals and the busiest windows of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.calibrate.estimate import not_identifiable
from hesim_render.calibrate.recordings.tally import LONG_US, WINDOW_US, EventTally
from hesim_render.core.units import US_PER_S

#: Intervals within a factor of two of the dead time that are needed to see it.
_LEAST_INTERVALS = 100
#: Largest density of intervals below 0.8 of the dead time, over that above: strays of the read-out.
_STRAY = 0.03
#: Windows that must be equally full, and part of all windows of the same recording above which it is saturated.
_LEAST_WINDOWS, _SATURATED = 20, 0.1
#: Fullest windows differ by no more than this part, and than this part of what chance makes of as many events: those
#: of a lamp that flickers are as full as one another, but for chance.
_SAME, _OF_CHANCE = 0.01, 0.5
#: Windows are full of pixels if they hold so many events of each, but for this part of the pixels.
_SILENT = 0.02


def dead_time(tallies: Sequence[EventTally]) -> dict[str, Any]:
    """Dead time in µs: where the density of the intervals of a pixel steps up.

    The likelihood of a step from one density to another, over the whole µs; its place has a flat prior, both densities
    are those of the counts on either side. The interval holds 95 % of the posterior, and half a µs on either side for
    the times, which are whole.
    """
    counts = np.sum([one.intervals for one in tallies], axis=0)[:LONG_US].astype(np.float64)
    if counts.sum() < _LEAST_INTERVALS:
        reason = f"{int(counts.sum())} intervals are shorter than {LONG_US / 1000:g} ms; {_LEAST_INTERVALS} are needed"
        return not_identifiable(reason)
    place, chance = _step(counts)
    end = int(place[np.argmax(chance)])
    after = counts[end : 2 * end + 2]
    shorter = counts[: max(1, round(0.8 * end))]
    if end < 2 or after.sum() < _LEAST_INTERVALS or shorter.mean() > _STRAY * after.mean():
        return not_identifiable(
            "the density of the intervals has no step: short intervals are as frequent as longer ones"
        )
    whole = np.cumsum(chance)
    low, high = (float(place[np.searchsorted(whole, part)]) for part in (0.025, 0.975))
    mean = float(np.sum(place * chance))
    level = np.cumsum(after)[-1] / after.size
    smooth = counts[: 2 * end + 2] / level
    reached = [int(np.argmax(smooth >= part)) for part in (0.1, 0.9)]
    return {
        "value": mean, "standard_error": float(np.sqrt(np.sum((place - mean) ** 2 * chance) + 1 / 6)),
        "interval_95": [low - 0.5, high + 0.5], "unit": "µs",
        "note": f"the density reaches 10 % of what it is later at {reached[0]} µs and 90 % at {reached[1]} µs; "
        f"{int(counts[:end].sum())} intervals are shorter",
    }  # fmt: skip


def _step(counts: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Places of a step of the density, whole µs, and their chances. A place d compares [0, d) with [d, 2 d]."""
    total = np.append(0.0, np.cumsum(counts))
    place = np.arange(1, counts.size // 2)
    below, upper = total[place], total[2 * place + 1] - total[place]
    enough = upper >= _LEAST_INTERVALS
    if not enough.any():
        return place, np.full(place.size, 1 / place.size)
    # the step is that of the largest ratio of the densities, by its significance
    gain = special.xlogy(below, below / place) + special.xlogy(upper, upper / (place + 1))
    both = below + upper
    gain -= special.xlogy(both, both / (2 * place + 1))
    best = int(place[np.argmax(np.where(enough & (upper / (place + 1) > below / place), gain, -np.inf))])
    window = np.arange(2 * best + 1)
    inside = counts[: window.size]
    sums = np.append(0.0, np.cumsum(inside))
    d = np.arange(1, window.size)
    low = (sums[d] + 0.5) / d
    high = (sums[-1] - sums[d] + 0.5) / (window.size - d)
    log = special.xlogy(sums[d], low) - low * d + special.xlogy(sums[-1] - sums[d], high) - high * (window.size - d)
    chance = np.exp(log - log.max())
    return d, chance / chance.sum()


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

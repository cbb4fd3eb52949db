"""Events of pixels whose levels go on paths of straight lines, on the host; one round has the next event of each."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

#: Times in µs, pixels and origins of events that come whatever the level.
DueEvents: TypeAlias = tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]]
#: Least time of an event after the begin of its line, µs: rounding may have moved it out of the line before.
_SOON_US = 1e-3


def events_on_paths(
    pixel: NDArray[np.uint32],
    levels: NDArray[np.floating],
    times_us: NDArray[np.float64],
    reference: NDArray[np.float64],
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    due: DueEvents,
    ready_us: NDArray[np.float64],
    period_us: float | None,
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Events of some pixels, each of which has none before the end of its dead time.

    Without a dead time the reference of a pixel moves by a threshold at each crossing. With one it stays until the end
    of the dead time, and then is the level of that instant.

    Parameters
    ----------
    pixel : [n], numbers, in rising order.
    levels : [nodes, n], levels at the ends of the lines.
    times_us : [nodes], their times, µs.
    reference : [n], levels with which the pixels compare; of those that are released on the way, that of the release.
    thresholds : θ₊, θ₋, [n] each.
    due : any number of each pixel, of other pixels as well; without a dead time there are none.
    ready_us : [n], ends of the dead times, µs.
    period_us : dead time, µs; None for none.

    Returns
    -------
    reference, ready_us : [n], at the end of the paths.
    t_us, pixel, polarity : of the events, unsorted; the polarity times their `Origin`.
    """
    # due events by pixel, then by time; a sentinel that never comes at the end
    order = np.lexsort(due[:2])
    due_us, due_origin = np.append(due[0][order], np.inf), np.append(due[2][order], 0.0)
    # range of each pixel's due events in that list
    turn, last = (np.searchsorted(due[1][order], pixel, side=side) for side in ("left", "right"))
    own, ready = reference, ready_us
    ends_us, lengths_us = times_us[1:, None], np.diff(times_us)
    line_of, result = np.zeros(pixel.size, np.int64), list[tuple[NDArray, NDArray, NDArray]]()
    here = np.arange(pixel.size)
    while here.size:
        # [lines, pixels left]: lines that end beyond a threshold, not before the dead time ends
        distance = levels[1:, here] - own[here]
        beyond = (distance >= thresholds[0][here]) | (distance <= -thresholds[1][here])
        beyond &= (ends_us >= ready[here]) & (np.arange(len(lengths_us))[:, None] >= line_of[here])
        line = np.argmax(beyond, axis=0)
        # where that line reaches the threshold
        low, high = levels[line, here].astype(np.float64), levels[line + 1, here].astype(np.float64)
        sign = np.where(high > own[here], 1.0, -1.0)
        theta = np.where(sign > 0, thresholds[0][here], thresholds[1][here])
        part = (own[here] + sign * theta - low) / np.where(high == low, np.inf, high - low)
        since_us = np.maximum(np.clip(part, 0.0, 1.0) * lengths_us[line], _SOON_US)
        crossing_us = np.maximum(times_us[line] + since_us, ready[here])
        crossing_us[~beyond.any(axis=0)] = np.inf
        # what comes first, a due event or a crossing
        next_due = np.where(turn[here] < last[here], turn[here], -1)
        is_due = due_us[next_due] < crossing_us
        t_us = np.where(is_due, due_us[next_due], crossing_us)
        # a due event in the dead time is lost
        fires = np.isfinite(t_us) & ~(is_due & (t_us < ready[here]))
        turn[here[is_due]] += 1
        firing = here[fires]
        result.append((t_us[fires], pixel[firing], np.where(is_due, due_origin[next_due], sign)[fires]))
        if period_us is None:
            own[firing] += (sign * theta)[fires]
            line_of[firing] = line[fires]
        else:
            ready[firing] = t_us[fires] + period_us
            # a pixel that is released on the way compares with the level of that moment
            released = firing[ready[firing] <= times_us[-1]]
            own[released] = level_at(released, ready[released], levels, times_us)
        # pixels with neither kind left are done
        here = here[np.isfinite(t_us)]
    t_us, fired, polarity = (np.concatenate(values) for values in zip(*result, strict=True))
    return own, ready, t_us, fired, polarity


def level_at(
    which: NDArray[np.integer], t_us: NDArray[np.float64], levels: NDArray, times_us: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Levels of paths `which` at times between their first and their last node; see `events_on_paths`."""
    line = np.clip(np.searchsorted(times_us, t_us) - 1, 0, len(times_us) - 2)
    low, high = levels[line, which].astype(np.float64), levels[line + 1, which]
    return np.asarray(low + (t_us - times_us[line]) / np.diff(times_us)[line] * (high - low))


def listed(needed: NDArray[np.bool_], due: DueEvents) -> NDArray[np.uint32]:
    """Numbers of the pixels that are needed or have a due event, in rising order; `needed` is changed in place."""
    needed[due[1]] = True
    return np.flatnonzero(needed).astype(np.uint32)

"""Event double integral: sharp images from a blurred one and the events of its exposure [pan2019].

The log intensity at a time t differs from that at a reference time f by the signed number of events between, times the
threshold: L(t) = L(f) · exp(c · E(f, t)). The blurred image is the mean of L over the exposure, so

    L(f) = B / mean over t of exp(c · E(f, t))

for every pixel. E is a step function of time: its mean is a sum over the events, without a loop over pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Largest factor between the blurred and a sharp value; noise may give pixels hundreds of events.
_MOST = 100.0


def log_steps(events: NDArray, threshold_on: float, threshold_off: float) -> NDArray[np.float64]:
    """Change of log intensity that each event stands for, [event]."""
    return np.where(events["polarity"] > 0, threshold_on, -threshold_off)


def sharp_over_blurred(
    events: NDArray,
    shape: tuple[int, int],
    begin_us: ArrayLike,
    exposure_us: float,
    times_us: Sequence[float],
    thresholds: tuple[float, float],
) -> NDArray[np.float64]:
    """Ratio of the sharp image at each time to the blurred one.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, any time, in order of time.
    shape : rows and columns of the event grid.
    begin_us : begin of the exposure, a scalar or [row] of the event grid, µs.
    exposure_us : length of the exposure, µs.
    times_us : times of the sharp images, before, within or after the exposure. With a begin for each row, times are
        those of row 0, and a later row is taken so much later.
    thresholds : contrast thresholds ON and OFF, in ln units.

    Returns
    -------
    [time, y, x]; between 0.01 and 100.
    """
    rows, cols = shape
    row_begin = np.broadcast_to(np.asarray(begin_us, dtype=np.float64), rows)
    delay = row_begin - row_begin[0]
    place = events["y"].astype(np.int64) * cols + events["x"]
    time = events["t_us"] - delay[events["y"]]  # as if all rows were those of row 0
    begin, end = row_begin[0], row_begin[0] + exposure_us
    step = log_steps(events, *thresholds)
    size = rows * cols

    # log intensity relative to that at the begin of the exposure: a step function between the events within
    within = (time > begin) & (time < end)
    order = np.lexsort((time[within], place[within]))
    where, when, jump = place[within][order], time[within][order], step[within][order]
    level = np.cumsum(jump)
    first = np.searchsorted(where, where)  # index of the pixel's first event
    before = np.where(first > 0, level[first - 1], 0.0) if len(where) else level
    level = level - before
    last_of_pixel = np.append(where[1:] != where[:-1], True) if len(where) else np.zeros(0, bool)
    until = np.where(last_of_pixel, end, np.append(when[1:], end))[: len(when)]
    most = np.log(_MOST)
    held = np.exp(np.clip(level, -most, most)) * (until - when)
    lead = np.full(size, exposure_us, dtype=np.float64)
    firsts = np.flatnonzero(first == np.arange(len(where)))
    lead[where[firsts]] = when[firsts] - begin
    mean = (lead + np.bincount(where, held, size)) / exposure_us

    found = []
    for t in times_us:
        if t >= begin:
            part = (time > begin) & (time <= t)
            change = np.bincount(place[part], step[part], size)
        else:
            part = (time > t) & (time <= begin)
            change = -np.bincount(place[part], step[part], size)
        found.append(np.clip(np.exp(np.clip(change, -most, most)) / mean, 1 / _MOST, _MOST))
    return np.array(found).reshape(len(found), rows, cols)

"""Filters that keep events with neighbours and drop lone ones: baselines of event denoising."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

#: Default time within which a neighbour supports an event, µs.
SUPPORT_US = 5000
_LONG_AGO = np.iinfo(np.int64).min // 2


def last_before(
    events: NDArray, shape: tuple[int, int], step_row: int, step_col: int, among: NDArray | None = None
) -> NDArray[np.int64]:
    """Time of the last earlier event of the pixel at an offset from each event's own, µs; a far past where none is.

    An event counts as earlier if it comes before in the array, or at the same time: pixels of a fixed tick give their
    events at the same instant. At an offset of 0 the event itself does not count.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.
    step_row, step_col : the offset, px.
    among : the events that are looked for, in order of time; default all.

    Returns
    -------
    [event], µs.
    """
    rows, cols = shape
    given = events if among is None else among
    if len(given) == 0:
        return np.full(len(events), _LONG_AGO)
    place = given["y"].astype(np.int64) * cols + given["x"]
    y, x = events["y"].astype(np.int64) + step_row, events["x"].astype(np.int64) + step_col
    inside = (y >= 0) & (y < rows) & (x >= 0) & (x < cols)
    asked = np.where(inside, y * cols + x, -1)
    first = int(events["t_us"][0])
    span = int(events["t_us"][-1]) - first + 1
    keys = np.sort(place * span + (given["t_us"].astype(np.int64) - first))  # by pixel, then by time
    wanted = asked * span + (events["t_us"].astype(np.int64) - first)
    result = np.searchsorted(keys, wanted, side="left" if step_row == step_col == 0 else "right") - 1
    last = keys[np.maximum(result, 0)]
    same = (result >= 0) & inside & (last // span == asked)
    return np.where(same, last % span + first, _LONG_AGO)


def _newest(events: NDArray, shape: tuple[int, int], steps: list[tuple[int, int]]) -> NDArray[np.int64]:
    newest = np.full(len(events), _LONG_AGO)
    for row, col in steps:
        newest = np.maximum(newest, last_before(events, shape, row, col))
    return newest


def nearest_neighbour(events: NDArray, shape: tuple[int, int], support_us: int = SUPPORT_US) -> NDArray[np.bool_]:
    """Keep an event [event] if one of its 4 neighbours had an event of any polarity within the support time.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, in order of time.
    shape : rows and columns of the event grid.
    support_us : the support time, µs.
    """
    steps = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    return events["t_us"] - _newest(events, shape, steps) <= support_us


def background_activity(events: NDArray, shape: tuple[int, int], support_us: int = SUPPORT_US) -> NDArray[np.bool_]:
    """Keep an event if one of its 8 neighbours had an event of any polarity within the support time [delbruck2008].

    Parameters
    ----------
    events, shape, support_us : as for `nearest_neighbour`.

    Returns
    -------
    [event], True for the kept ones.
    """
    steps = [(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1) if (row, col) != (0, 0)]
    return events["t_us"] - _newest(events, shape, steps) <= support_us


FILTERS: dict[str, Callable[[NDArray, tuple[int, int]], NDArray[np.bool_]]] = {
    "nearest-neighbour": nearest_neighbour,
    "background-activity": background_activity,
}

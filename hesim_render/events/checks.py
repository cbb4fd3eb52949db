"""Checks of event arrays and of intervals of time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.pixels.evs.events import EVENT_DTYPE


def check_form(events: NDArray, shape: tuple[int, int]) -> None:
    """Check that these are events and the size of a grid; places are not looked at.

    Raises
    ------
    RangeError
        If the array lacks a field of `EVENT_DTYPE`, or the grid is empty.
    """
    if not isinstance(events, np.ndarray):
        raise RangeError("events", events, "an array of events, such as the events of a recording")
    names = events.dtype.names or ()
    if events.ndim != 1 or not set(EVENT_DTYPE.names or ()) <= set(names):
        raise RangeError(
            "events", f"fields {', '.join(names) or 'none'}", f"a list of {', '.join(EVENT_DTYPE.names or ())}"
        )
    rows, cols = shape
    if not (rows >= 1 and cols >= 1):
        raise RangeError("shape", shape, "rows and columns of the event grid, 1 or more")


def checked(events: NDArray, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Places of events on the grid, row-major.

    Raises
    ------
    RangeError
        If the array lacks a field of `EVENT_DTYPE`, or an event is outside the grid.
    """
    check_form(events, shape)
    rows, cols = shape
    if events.size and (int(events["y"].max()) >= rows or int(events["x"].max()) >= cols):
        raise RangeError(
            "shape", shape, f"at least {int(events['y'].max()) + 1} rows and {int(events['x'].max()) + 1} columns, "
            "where these events are"
        )  # fmt: skip
    return events["y"].astype(np.intp) * cols + events["x"]


def interval(events: NDArray, begin_us: float | None, end_us: float | None) -> tuple[float, float]:
    """Begin and end of an interval, µs; by default that of the events, the last one included.

    Raises
    ------
    RangeError
        If the interval is empty.
    """
    times = events["t_us"]
    begin = float(begin_us) if begin_us is not None else float(times.min()) if events.size else 0.0
    end = float(end_us) if end_us is not None else float(times.max()) + 1.0 if events.size else begin + 1.0
    if not (np.isfinite(begin) and np.isfinite(end) and end > begin):
        raise RangeError("end_us", end, f"a time after the begin, {begin:g} µs")
    return begin, end


def within(events: NDArray, begin_us: float, end_us: float) -> NDArray:
    """Events with begin_us <= t_us < end_us."""
    times = events["t_us"]
    inside = (times >= begin_us) & (times < end_us)
    return events if inside.all() else events[inside]

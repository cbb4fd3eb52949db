"""Statistics of a stream of events, each for successive parts of its time, so that they can be drawn anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import US_PER_S
from hesim_render.exchange.stream import EventStream
from hesim_render.pixels.evs.events import no_events

#: Parts of the time.
PARTS = 20
#: Bounds of the intervals between events of a pixel, µs: twenty bins a decade.
INTERVALS_US = 10 ** np.linspace(0.0, 8.0, 161)
#: Windows of the rate, µs, and lags of its autocorrelation, windows.
WINDOW_US, LAGS = 1000, (1, 2, 4, 8, 16, 32)
#: Windows in which pixels count as active, µs, and the neighbours whose activity is compared: rows and columns away.
ACTIVE_US, NEIGHBOURS = 5000, ((0, 1), (1, 0), (0, 2), (2, 0))
#: Longest gap within a burst, µs, and longest burst that is told apart.
GAP_US, LONGEST = 1000, 64
_LEAST_EVENTS, _LEAST_PART_US = 100 * PARTS, 2 * WINDOW_US


@dataclass(frozen=True, eq=False)
class EventStatistics:
    """Sums over the events of each part.

    Parameters
    ----------
    source : name of the stream.
    shape : rows and columns, px.
    seconds : time of a part.
    polarity : [part, 2], ON and OFF events.
    intervals : [part, bin], intervals between events of a pixel, of any polarity.
    series : [part, window], events of windows of `WINDOW_US`.
    active : [part, 1 + neighbour], active pixels of windows of `ACTIVE_US`, and those with an active neighbour.
    windows : windows of `ACTIVE_US` in a part.
    bursts : [part, length], bursts of so many events of a pixel.
    pixels : [part, pixel], events.
    """

    source: str
    shape: tuple[int, int]
    seconds: float
    polarity: NDArray[np.int64]
    intervals: NDArray[np.int64]
    series: NDArray[np.int64]
    active: NDArray[np.int64]
    windows: int
    bursts: NDArray[np.int64]
    pixels: NDArray[np.uint32]


def event_statistics(stream: EventStream) -> EventStatistics:
    """Statistics of a stream, which is read twice; one part of its time is held at once.

    Raises
    ------
    SpecError
        If it has too few events, or lasts for less than 2 ms a part.
    """
    begin_us, end_us = stream.span_us()
    part_us = -(-(end_us + 1 - begin_us) // PARTS)
    if part_us < _LEAST_PART_US:
        problem = f"lasts {end_us - begin_us} µs; expected {_LEAST_PART_US * PARTS} µs at least"
        raise SpecError(problem, file=stream.source)
    rows, cols = stream.shape
    found: list[tuple[NDArray, ...]] = []
    held, last_us = [no_events()], np.full(rows * cols, -1, np.int64)
    for events in (*stream, no_events()):
        held.append(events)
        done = begin_us + (len(found) + 1) * part_us
        while len(found) < PARTS and (events.size == 0 or events["t_us"][-1] >= done):
            every = np.concatenate(held)
            inside = np.searchsorted(every["t_us"], done)
            found.append(_part(every[:inside], begin_us + len(found) * part_us, part_us, last_us, rows, cols))
            held = [every[inside:]]
            done += part_us
    columns = [np.stack(values) for values in zip(*found, strict=True)]
    if columns[0].sum() < _LEAST_EVENTS:
        raise SpecError(f"has {columns[0].sum()} events; expected {_LEAST_EVENTS} at least", file=stream.source)
    polarity, intervals, series, active, bursts, pixels = columns
    return EventStatistics(
        str(stream.source), (rows, cols), part_us / US_PER_S, polarity, intervals, series, active,
        max(1, part_us // ACTIVE_US), bursts, pixels,
    )  # fmt: skip


def _part(
    events: NDArray[np.void], begin_us: int, part_us: int, last_us: NDArray[np.int64], rows: int, cols: int
) -> tuple[NDArray, ...]:
    """Sums over a part; `last_us` [pixel], time of the last event of each pixel or −1, goes on."""
    t_us, x, y = events["t_us"] - begin_us, events["x"].astype(np.int64), events["y"].astype(np.int64)
    pixel = y * cols + x
    on = np.count_nonzero(events["polarity"] > 0)
    count = np.bincount(pixel, minlength=rows * cols).astype(np.uint32)
    series = np.bincount(t_us // WINDOW_US, minlength=part_us // WINDOW_US)[: part_us // WINDOW_US]
    order = np.argsort(pixel, kind="stable")
    own, times = pixel[order], t_us[order] + begin_us
    first = np.diff(own, prepend=-1) != 0
    before_us = np.where(first, last_us[own], np.append(0, times[:-1])[: own.size])
    gap = (times - before_us)[before_us >= 0]
    intervals = np.histogram(np.maximum(gap, 1), INTERVALS_US)[0]
    ends = np.append(first[1:], True)[: own.size]
    last_us[own[ends]] = times[ends]
    starts = np.flatnonzero(first | (times - before_us > GAP_US))
    length = np.diff(np.append(starts, own.size))
    bursts = np.bincount(np.minimum(length, LONGEST), minlength=LONGEST + 1)
    key = np.unique((t_us // ACTIVE_US) * (rows * cols) + pixel)
    row, col = np.divmod(key % (rows * cols), cols)
    active = [int(key.size)]
    for down, right in NEIGHBOURS:
        fits = (row + down < rows) & (col + right < cols)
        active.append(int(np.count_nonzero(np.isin(key[fits] + down * cols + right, key, assume_unique=True))))
    return np.array([on, events.size - on]), intervals, series, np.array(active), bursts, count

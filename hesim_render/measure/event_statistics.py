"""Statistics of a stream of events, each for successive parts of its time, so that they can be drawn anew."""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import US_PER_S
from hesim_render.exchange.stream import EventStream
from hesim_render.pixels.evs.events import no_events

#: Parts of the time.
PARTS = 20
#: Bounds of the intervals between events of a pixel, µs: twenty bins a decade, and one for all longer ones.
INTERVALS_US = np.append(10 ** np.linspace(0.0, 8.0, 161), np.inf)
#: Windows of the rate, µs, and lags of its autocorrelation, windows.
WINDOW_US, LAGS = 1000, (1, 2, 4, 8, 16, 32)
#: Windows in which pixels count as active, µs, and the neighbours whose activity is compared: rows and columns away.
ACTIVE_US, NEIGHBOURS = 5000, ((0, 1), (1, 0), (0, 2), (2, 0))
#: Longest gap within a burst, µs, and longest burst that is distinguished.
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
    intervals : [part, bin], intervals between events of a pixel, of any polarity, which end in the part.
    at_risk : [part, bin], intervals that could have ended so: those of a pixel whose last event was so long ago.
    series : [part, window], events of windows of `WINDOW_US`.
    active : [part, 1 + neighbour], active pixels of windows of `ACTIVE_US`, and those with an active neighbour.
    windows : windows of `ACTIVE_US` in a part.
    bursts : [part, length], bursts of so many events of a pixel, each in the part that shows its end.
    pixels : [part, pixel], events.
    """

    source: str
    shape: tuple[int, int]
    seconds: float
    polarity: NDArray[np.int64]
    intervals: NDArray[np.int64]
    at_risk: NDArray[np.float64]
    series: NDArray[np.int64]
    active: NDArray[np.int64]
    windows: int
    bursts: NDArray[np.int64]
    pixels: NDArray[np.uint32]


def of_equal_time(first: EventStream, second: EventStream) -> tuple[EventStream, EventStream]:
    """Two streams, each as long as the shorter one, from its begin.

    Of one law, the longer one has other hot pixels, as fewer are hot by chance, and less scatter.
    """
    spans = [_long_span_us(stream) for stream in (first, second)]
    least_us = min(end_us - begin_us for begin_us, end_us in spans)
    one, other = (
        replace(stream, interval_us=(begin_us, begin_us + least_us))
        for stream, (begin_us, _) in zip((first, second), spans, strict=True)
    )
    return one, other


def _long_span_us(stream: EventStream) -> tuple[int, int]:
    """Begin and end of a stream; one that is too short is refused by its own name, before the other is cut to it."""
    begin_us, end_us = stream.span_us()
    if end_us + 1 - begin_us <= PARTS * (_LEAST_PART_US - 1):
        problem = f"lasts {end_us - begin_us} µs; expected {_LEAST_PART_US * PARTS} µs at least"
        raise SpecError(problem, file=stream.source)
    return begin_us, end_us


def event_statistics(stream: EventStream) -> EventStatistics:
    """Statistics of a stream, which is read twice; one part of its time is held at once.

    Events after its end, where it has one of its own, are left out.

    Raises
    ------
    SpecError
        If it has too few events, or lasts for less than 2 ms a part.
    """
    begin_us, end_us = _long_span_us(stream)
    part_us = -(-(end_us + 1 - begin_us) // PARTS)
    rows, cols = stream.shape
    result: list[tuple[NDArray, ...]] = []
    # blocks of the file are cut at the ends of parts: only what belongs to the next part is held
    held, last_us, running = [no_events()], np.full(rows * cols, -1, np.int64), np.zeros(rows * cols, np.int64)
    for events in chain(stream, (no_events(),)):
        held.append(events)
        done = begin_us + (len(result) + 1) * part_us
        while len(result) < PARTS and (events.size == 0 or events["t_us"][-1] >= done):
            every = np.concatenate(held)
            inside = np.searchsorted(every["t_us"], done)
            at_us = begin_us + len(result) * part_us
            result.append(_part(every[:inside], at_us, part_us, last_us, running, rows, cols))
            held = [every[inside:]]
            done += part_us
        if len(result) == PARTS:
            break
    columns = [np.stack(values) for values in zip(*result, strict=True)]
    if columns[0].sum() < _LEAST_EVENTS:
        problem = f"has {columns[0].sum()} events in {(end_us - begin_us) / US_PER_S:.4g} s"
        raise SpecError(f"{problem}; expected {_LEAST_EVENTS} at least", file=stream.source)
    polarity, intervals, ages, series, active, bursts, pixels = columns
    bursts[-1] += _lengths(running[running > 0])  # those that the end of the stream cuts
    # intervals go on from the part before, and into the next one: of their own bin, a part has half of either
    left = np.diff(ages, axis=0, prepend=0)
    at_risk = np.cumsum((intervals + left)[:, ::-1], axis=1)[:, ::-1] - left / 2
    return EventStatistics(
        str(stream.source), (rows, cols), part_us / US_PER_S, polarity, intervals, at_risk, series, active,
        _active_windows(part_us), bursts, pixels,
    )  # fmt: skip


def _active_windows(part_us: int) -> int:
    """Windows of `ACTIVE_US` that are whole in a part; a shorter part is one."""
    return max(1, part_us // ACTIVE_US)


def _part(
    events: NDArray[np.void],
    begin_us: int,
    part_us: int,
    last_us: NDArray[np.int64],
    running: NDArray[np.int64],
    rows: int,
    cols: int,
) -> tuple[NDArray, ...]:
    """Sums over a part.

    What goes on: `last_us` [pixel], time of the last event of each pixel or −1, and `running` [pixel], length of the
    burst that may go on, or 0.
    """
    t_us, x, y = events["t_us"] - begin_us, events["x"].astype(np.int64), events["y"].astype(np.int64)
    pixel = y * cols + x
    on = np.count_nonzero(events["polarity"] > 0)
    count = np.bincount(pixel, minlength=rows * cols).astype(np.uint32)
    # events in successive windows; the rest of the part after the last whole one is left out
    series = np.bincount(t_us // WINDOW_US, minlength=part_us // WINDOW_US)[: part_us // WINDOW_US]
    # by pixel, then by time: the interval before each event, for the first one of a pixel from the part before
    order = np.argsort(pixel, kind="stable")
    own, times = pixel[order], t_us[order] + begin_us
    first = np.diff(own, prepend=-1) != 0
    before_us = np.where(first, last_us[own], np.append(0, times[:-1])[: own.size])
    gap = (times - before_us)[before_us >= 0]
    intervals = np.histogram(np.maximum(gap, 1), INTERVALS_US)[0]
    # the last event of each pixel, for the next part
    ends = np.append(first[1:], True)[: own.size]
    last_us[own[ends]] = times[ends]
    ages = np.histogram(begin_us + part_us - last_us[last_us >= 0], INTERVALS_US)[0]
    # bursts: successive events of a pixel without a long gap. Each counts as a whole in the part that shows its end:
    # pieces of those cut between two parts would make both vary alike, and draws of parts scatter too little
    is_new = times - before_us > GAP_US
    starts = np.flatnonzero(first | is_new)
    length, pixels, is_new = np.diff(np.append(starts, own.size)), own[starts], is_new[starts]
    length += np.where(is_new, 0, running[pixels])
    running[pixels[~is_new]] = 0
    may_go_on = np.append(first[starts[1:]], True)[: starts.size] & (last_us[pixels] + GAP_US >= begin_us + part_us)
    # those that came into this part and did not go on are over, as a part is longer than a gap
    bursts = _lengths(length[~may_go_on]) + _lengths(running[running > 0])
    running[:] = 0
    running[pixels[may_go_on]] = length[may_go_on]
    # pixels active in a whole window, each once; with each neighbour, the windows in which both are
    whole = t_us // ACTIVE_US < _active_windows(part_us)
    key = np.unique((t_us[whole] // ACTIVE_US) * (rows * cols) + pixel[whole])
    row, col = np.divmod(key % (rows * cols), cols)
    active = [int(key.size)]
    for down, right in NEIGHBOURS:
        fits = (row + down < rows) & (col + right < cols)
        active.append(int(np.count_nonzero(np.isin(key[fits] + down * cols + right, key, assume_unique=True))))
    return np.array([on, events.size - on]), intervals, ages, series, np.array(active), bursts, count


def _lengths(length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of bursts of each length, the longest ones together."""
    return np.bincount(np.minimum(length, LONGEST), minlength=LONGEST + 1)

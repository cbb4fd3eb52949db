"""How far two streams of events of like scenes are from one another, figure by figure, with intervals.

The time of each stream is cut into 20 parts, which are drawn anew with replacement, those of both streams
independently. A distance of samples is never 0: each figure also has the distance of two such draws of the first
stream, at most in 95 of 100 cases. A difference below that is none that these recordings show.

Statistics of a stream of events, each for successive parts of its time, so that they can be drawn anew.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student

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


def of_equal_time(first: EventStream, second: EventStream) -> tuple[EventStream, EventStream]:
    """Two streams, each as long as the shorter one, from its begin.

    Of one law, the longer one has longer intervals, other hot pixels and less scatter.
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
    held, last_us = [no_events()], np.full(rows * cols, -1, np.int64)
    for events in chain(stream, (no_events(),)):
        held.append(events)
        done = begin_us + (len(result) + 1) * part_us
        while len(result) < PARTS and (events.size == 0 or events["t_us"][-1] >= done):
            every = np.concatenate(held)
            inside = np.searchsorted(every["t_us"], done)
            result.append(_part(every[:inside], begin_us + len(result) * part_us, part_us, last_us, rows, cols))
            held = [every[inside:]]
            done += part_us
        if len(result) == PARTS:
            break
    columns = [np.stack(values) for values in zip(*result, strict=True)]
    if columns[0].sum() < _LEAST_EVENTS:
        problem = f"has {columns[0].sum()} events in {(end_us - begin_us) / US_PER_S:.4g} s"
        raise SpecError(f"{problem}; expected {_LEAST_EVENTS} at least", file=stream.source)
    polarity, intervals, series, active, bursts, pixels = columns
    return EventStatistics(
        str(stream.source), (rows, cols), part_us / US_PER_S, polarity, intervals, series, active,
        _active_windows(part_us), bursts, pixels,
    )  # fmt: skip


def _active_windows(part_us: int) -> int:
    """Windows of `ACTIVE_US` that are whole in a part; a shorter part is one."""
    return max(1, part_us // ACTIVE_US)


def _part(
    events: NDArray[np.void], begin_us: int, part_us: int, last_us: NDArray[np.int64], rows: int, cols: int
) -> tuple[NDArray, ...]:
    """Sums over a part; `last_us` [pixel], time of the last event of each pixel or −1, goes on."""
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
    # bursts: successive events of a pixel without a long gap, counted by their lengths
    starts = np.flatnonzero(first | (times - before_us > GAP_US))
    length = np.diff(np.append(starts, own.size))
    bursts = np.bincount(np.minimum(length, LONGEST), minlength=LONGEST + 1)
    # pixels active in a whole window, each once; with each neighbour, the windows in which both are
    whole = t_us // ACTIVE_US < _active_windows(part_us)
    key = np.unique((t_us[whole] // ACTIVE_US) * (rows * cols) + pixel[whole])
    row, col = np.divmod(key % (rows * cols), cols)
    active = [int(key.size)]
    for down, right in NEIGHBOURS:
        fits = (row + down < rows) & (col + right < cols)
        active.append(int(np.count_nonzero(np.isin(key[fits] + down * cols + right, key, assume_unique=True))))
    return np.array([on, events.size - on]), intervals, series, np.array(active), bursts, count


#: Draws of the bootstrap, and hot pixels: so many times the usual rate.
_DRAWS, _SEED, _HOT = 200, 1, 10.0
#: Draws of 20 parts scatter less than their means do: Student's factor of 19 degrees of freedom, and √(20/19).
_WIDER = float(student.ppf(0.975, PARTS - 1) / norm.ppf(0.975) * np.sqrt(PARTS / (PARTS - 1)))
_Draw = NDArray[np.intp]


@dataclass(frozen=True)
class EventDistance:
    """A distance of two streams.

    Parameters
    ----------
    name, definition : what it is, and how it is defined.
    value : distance, 0 for equal streams.
    interval_95 : of the true distance, by the bootstrap; from 0 where the streams do not differ.
    within : distance of two draws of the first stream, of which 95 of 100 are below.
    first, second : what it is the distance of, where that is a number.
    """

    name: str
    definition: str
    value: float
    interval_95: tuple[float, float]
    within: float
    first: float | None = None
    second: float | None = None

    @property
    def differs(self) -> bool:
        """Whether the streams differ by more than parts of the first one do."""
        return self.value > self.within

    def described(self) -> dict[str, Any]:
        return {
            "name": self.name, "definition": self.definition, "value": self.value,
            "interval_95": list(self.interval_95), "within": self.within, "differs": self.differs,
            "first": self.first, "second": self.second,
        }  # fmt: skip


def event_distances(first: EventStatistics, second: EventStatistics) -> list[EventDistance]:
    """All distances of two streams, which may be of sensors of different sizes: figures are those of a pixel.

    Parameters
    ----------
    first, second : statistics of the streams, from `event_statistics`.
    """
    rng = np.random.default_rng(_SEED)
    # the parts of a stream, drawn with replacement: twice of the first, once of the second
    draws = rng.integers(0, PARTS, (3, _DRAWS, PARTS))
    whole = np.arange(PARTS)
    result = []
    for name, definition, figure, distance, is_number, number in _FIGURES:
        a, b = figure(first, whole), figure(second, whole)
        ours, again = ([figure(first, draw) for draw in part] for part in draws[:2])
        theirs = [figure(second, draw) for draw in draws[2]]
        spread = [distance(x, y) for x, y in zip(ours, theirs, strict=True)]
        own = [distance(x, y) for x, y in zip(ours, again, strict=True)]
        # what is in none of n has a share of 3/n at most
        rare = 0.0 if number is None else 3.0 / max(float(min(number(first), number(second))), 1.0)
        value, within = float(distance(a, b)), max(_WIDER * float(np.percentile(own, 95)), rare)
        # noise makes distances larger, those of drawn parts once more: the lower end has that taken off
        middle, top = np.percentile(spread, (50, 97.5))
        low = max(value - _WIDER * float(top - min(middle, value)), 0.0) if value > within else 0.0
        high = value + max(_WIDER * float(top - middle), rare)
        numbers = (float(a[0]), float(b[0])) if is_number else (None, None)
        result.append(EventDistance(name, definition, value, (low, high), within, *numbers))
    return result


def _rate(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    return np.array([one.polarity[draw].sum() / (len(draw) * one.seconds * one.pixels.shape[1])])


def _asymmetry(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    on, off = one.polarity[draw].sum(axis=0)
    return np.array([(on - off) / max(on + off, 1)])


def _cumulative(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.cumsum(counts) / max(int(counts.sum()), 1)


def _intervals(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    return _cumulative(one.intervals[draw].sum(axis=0))


def _bursts(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    return _cumulative(one.bursts[draw].sum(axis=0))


def _over_time(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    series = one.series[draw].astype(np.float64)
    series = series - series.mean()
    variance = np.mean(series**2)
    # within a part only; lags longer than one have no correlation
    lags = [lag for lag in LAGS if lag < series.shape[1]]
    result = [np.mean(series[:, lag:] * series[:, :-lag]) / max(variance, 1e-300) for lag in lags]
    return np.array(result + [0.0] * (len(LAGS) - len(lags)))


def _over_space(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    active = one.active[draw].sum(axis=0).astype(np.float64)
    rows, cols = one.shape
    windows = one.windows * len(draw)
    # correlation of the activity of two pixels: joint share less the product of both, over the variance of one
    share = active[0] / (windows * rows * cols)
    pairs = np.array([(rows - down) * (cols - right) for down, right in NEIGHBOURS], np.float64)
    both = active[1:] / (windows * np.maximum(pairs, 1.0))
    return np.asarray((both - share**2) / max(share * (1 - share), 1e-300))


def _hot(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    count = one.pixels[draw].sum(axis=0)
    # the mean of nine tenths of the pixels, which hot ones do not raise
    usual = np.sort(count)[: max(1, round(0.9 * count.size))].mean() + 1 / count.size
    return np.array([np.mean(count > np.maximum(_HOT * usual, 3.0))])


def _difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.abs(a - b).max())


def _ratio(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.abs(np.log(np.maximum(a, 1e-300) / np.maximum(b, 1e-300))).max())


def _rms(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


_Figure = tuple[
    str,
    str,
    Callable[[EventStatistics, _Draw], NDArray[np.float64]],
    Callable[[NDArray[np.float64], NDArray[np.float64]], float],
    bool,
    Callable[[EventStatistics], float] | None,
]
#: Name, definition, figure, distance, whether it is a number, and what shares are of.
_FIGURES: Sequence[_Figure] = (
    ("rate", "|ln| of the ratio of the events a pixel and second", _rate, _ratio, True, None),
    (
        "intervals", "Kolmogorov-Smirnov distance of the intervals between events of a pixel",
        _intervals, _difference, False, lambda one: one.intervals.sum(),
    ),
    ("polarity", "difference of (ON - OFF)/(ON + OFF)", _asymmetry, _difference, True, None),
    (
        "time", "rms difference of the autocorrelation of the rate at lags of 1 to 32 ms",
        _over_time, _rms, False, None,
    ),
    (
        "space", "rms difference of the correlation of active pixels in 5 ms, 1 and 2 px apart",
        _over_space, _rms, False, None,
    ),
    (
        "hot pixels", "difference of the shares of pixels above ten times the usual rate",
        _hot, _difference, True, lambda one: one.pixels.shape[1],
    ),
    (
        "bursts", "Kolmogorov-Smirnov distance of the lengths of bursts, gaps up to 1 ms",
        _bursts, _difference, False, lambda one: one.bursts.sum(),
    ),
)  # fmt: skip

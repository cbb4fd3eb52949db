"""How far two streams of events of like scenes are from one another, figure by figure, with intervals.

The time of each stream is cut into 20 parts, which are drawn anew with replacement, those of both streams
independently. A distance of samples is never 0: each figure also has the distance of two such draws of the first
stream, at most in 95 of 100 cases. A difference below that is none that these recordings show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.measure.event_statistics import LAGS, NEIGHBOURS, PARTS, EventStatistics

#: Draws of the bootstrap, and hot pixels: so many times the usual rate.
_DRAWS, _HOT = 200, 10.0
_Draw = NDArray[np.intp]


@dataclass(frozen=True)
class EventDistance:
    """A distance of two streams.

    Parameters
    ----------
    name, definition : what it is, and how it is defined.
    value : distance, 0 for equal streams.
    interval_95 : of the bootstrap.
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


def event_distances(first: EventStatistics, second: EventStatistics, seed: int = 1) -> list[EventDistance]:
    """All distances of two streams.

    Parameters
    ----------
    first, second : statistics of the streams, from `event_statistics`.
    seed : of the bootstrap.

    Raises
    ------
    SpecError
        If the streams are of different sensors.
    """
    if first.shape != second.shape:
        (rows, cols), (own_rows, own_cols) = second.shape, first.shape
        raise SpecError(
            f"is of {cols}x{rows} px; expected {own_cols}x{own_rows}, as {first.source}", file=second.source
        )
    rng = np.random.default_rng(seed)
    draws = rng.integers(0, PARTS, (3, _DRAWS, PARTS))
    whole = np.arange(PARTS)
    found = []
    for name, definition, figure, distance, is_number in _FIGURES:
        a, b = figure(first, whole), figure(second, whole)
        ours, again = ([figure(first, draw) for draw in part] for part in draws[:2])
        theirs = [figure(second, draw) for draw in draws[2]]
        spread = [distance(x, y) for x, y in zip(ours, theirs, strict=True)]
        own = [distance(x, y) for x, y in zip(ours, again, strict=True)]
        low, high = np.percentile(spread, (2.5, 97.5))
        numbers = (float(a[0]), float(b[0])) if is_number else (None, None)
        found.append(
            EventDistance(
                name,
                definition,
                float(distance(a, b)),
                (float(low), float(high)),
                float(np.percentile(own, 95)),
                *numbers,
            )
        )
    return found


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
    lags = [lag for lag in LAGS if lag < series.shape[1]]
    found = [np.mean(series[:, lag:] * series[:, :-lag]) / max(variance, 1e-300) for lag in lags]
    return np.array(found + [0.0] * (len(LAGS) - len(lags)))


def _over_space(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    active = one.active[draw].sum(axis=0).astype(np.float64)
    rows, cols = one.shape
    windows = one.windows * len(draw)
    share = active[0] / (windows * rows * cols)
    pairs = np.array([(rows - down) * (cols - right) for down, right in NEIGHBOURS], np.float64)
    both = active[1:] / (windows * np.maximum(pairs, 1.0))
    return np.asarray((both - share**2) / max(share * (1 - share), 1e-300))


def _hot(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    count = one.pixels[draw].sum(axis=0)
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
]
_FIGURES: Sequence[_Figure] = (
    ("rate", "|ln| of the ratio of the events a pixel and second", _rate, _ratio, True),
    (
        "intervals",
        "Kolmogorov-Smirnov distance of the intervals between events of a pixel",
        _intervals,
        _difference,
        False,
    ),
    ("polarity", "difference of (ON - OFF)/(ON + OFF)", _asymmetry, _difference, True),
    ("time", "rms difference of the autocorrelation of the rate at lags of 1 to 32 ms", _over_time, _rms, False),
    ("space", "rms difference of the correlation of active pixels in 5 ms, 1 and 2 px apart", _over_space, _rms, False),
    ("hot pixels", "difference of the shares of pixels above ten times the usual rate", _hot, _difference, True),
    ("bursts", "Kolmogorov-Smirnov distance of the lengths of bursts, gaps up to 1 ms", _bursts, _difference, False),
)

"""How far two streams of events of like scenes are from one another, figure by figure, with intervals.

The time of each stream is cut into 20 parts, which are drawn anew with replacement, those of both streams
independently: an interval holds what longer streams of the same pixels would show. A distance of samples is never 0:
each figure also has the distance of two such draws of the first stream, at most in 95 of 100 cases. A difference below
that is none that these recordings show.

Hot pixels are few, and another sensor of a kind has others: their shares are those of pixels drawn at random.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law
from scipy.stats import norm
from scipy.stats import t as student

from hesim_render.core.units import US_PER_S
from hesim_render.measure.event_statistics import INTERVALS_US, LAGS, NEIGHBOURS, PARTS, EventStatistics

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
    within : distance of two draws of the first stream, of which 95 of 100 are below; of shares of pixels, of
        such shares of equal sensors.
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
        value, numbers = float(distance(a, b)), (float(a[0]), float(b[0])) if is_number else (None, None)
        if figure is _hot:
            below, above = _margins(float(a[0]), float(b[0]), first.pixels.shape[1], second.pixels.shape[1])
            interval = (max(value - below, 0.0), max(value + above, below - value))
            result.append(EventDistance(name, definition, value, interval, below, *numbers))
            continue
        ours, again = ([figure(first, draw) for draw in part] for part in draws[:2])
        theirs = [figure(second, draw) for draw in draws[2]]
        spread = [distance(x, y) for x, y in zip(ours, theirs, strict=True)]
        own = np.square([distance(x, y) for x, y in zip(ours, again, strict=True)])
        # what is in none of n has a share of 3/n at most
        rare = 0.0 if number is None else 3.0 / max(float(min(number(first), number(second))), 1.0)
        within = max(_limit(own, len(a)), rare)
        # noise makes distances larger, those of drawn parts once more: the lower end has that taken off
        middle, top = np.percentile(spread, (50, 97.5))
        least = min(float(middle), value)
        low = max(value - _WIDER * float(top - least), 0.0) if value > within else 0.0
        # draws of a single number near 0 fold back at it, which brings the median of their distances nearer to the top
        high = value + max(_WIDER * float(top - (least if len(a) == 1 else middle)), rare)
        result.append(EventDistance(name, definition, value, (low, high), within, *numbers))
    return result


def _limit(squares: NDArray[np.float64], length: int) -> float:
    """Distance that 95 of 100 draws keep below, from the squares of distances of figures of so many numbers.

    A square is like a sum of the squares of m normal numbers, where mean and variance tell m [satterthwaite1946]. By
    chance 20 parts make numbers vary alike, and show m / (1 + (m + 1)/19) of them. Each is known by 19 degrees of
    freedom.
    """
    free, mean = PARTS - 1, float(np.mean(squares))
    shown = float(np.clip(2 * mean**2 / max(float(np.var(squares)), 1e-300), 1.0, free / 2))
    count = min(shown * PARTS / (free - shown), float(length))
    return float(np.sqrt(mean * PARTS / free * f_law.ppf(0.95, count, count * free)))


def _margins(one: float, other: float, one_of: int, other_of: int) -> tuple[float, float]:
    """How far the difference of two shares may lie below and above that of their laws, in 95 of 100 cases.

    Parameters
    ----------
    one, other : shares of pixels, each of which is one of `one_of` or `other_of` drawn at random.
    """
    # bounds of each share [wilson1927], and of the difference of the larger and the smaller one [newcombe1998]
    ends = []
    for share, number in sorted(((one, one_of), (other, other_of))):
        z2 = float(norm.ppf(0.975)) ** 2 / number
        half = np.sqrt(z2 * (share * (1 - share) + z2 / 4))
        ends.append((share - (share + z2 / 2 - half) / (1 + z2), (share + z2 / 2 + half) / (1 + z2) - share))
    (small_down, small_up), (large_down, large_up) = ends
    return float(np.hypot(large_down, small_up)), float(np.hypot(large_up, small_down))


def _rate(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    return np.array([one.polarity[draw].sum() / (len(draw) * one.seconds * one.pixels.shape[1])])


def _asymmetry(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    on, off = one.polarity[draw].sum(axis=0)
    return np.array([(on - off) / max(on + off, 1)])


def _cumulative(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.cumsum(counts) / max(int(counts.sum()), 1)


def _intervals(one: EventStatistics, draw: _Draw) -> NDArray[np.float64]:
    # of the intervals that reach an age, the share that ends at it [kaplan1958]: each part tells it without bias, while
    # of those that end in the first parts more are short; ages beyond half of the time have few parts
    ended, at_risk = one.intervals[draw].sum(axis=0), one.at_risk[draw].sum(axis=0)
    seen = INTERVALS_US[1:] <= PARTS / 2 * one.seconds * US_PER_S
    return np.asarray(1 - np.cumprod(1 - ended / np.maximum(np.maximum(at_risk, ended), 1e-300))[seen])


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


def _difference_of_both(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Of ages that both streams show, if one of them is longer."""
    count = min(len(a), len(b))
    return _difference(a[:count], b[:count])


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
        "intervals", "Kolmogorov-Smirnov distance of intervals between events of a pixel, up to half of the time",
        _intervals, _difference_of_both, False, lambda one: one.intervals.sum(),
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
        _hot, _difference, True, None,
    ),
    (
        "bursts", "Kolmogorov-Smirnov distance of the lengths of bursts, gaps up to 1 ms",
        _bursts, _difference, False, lambda one: one.bursts.sum(),
    ),
)  # fmt: skip

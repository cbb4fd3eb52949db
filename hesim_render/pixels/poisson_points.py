"""Points of a Poisson process, and a random telegraph signal made from them, as pure functions of time.

Time is cut into cells in which a process has 4 points on average. In each cell the waiting times begin anew, which does
not change a process without memory. The points of any stretch of time are therefore known without earlier points: they
do not depend on the start of a run, on how it is split or on how often it is asked.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream, random_words, uniform
from hesim_render.core.units import US_PER_S

_PER_CELL = 4.0
#: Draws of one block of words, and the first counter of the words that decide what a point does.
_BLOCK, _MARK = 4, np.uint32(1 << 31)


class PoissonPoints:
    """A Poisson process for each of a few pixels.

    Parameters
    ----------
    seed, stream : the points are a pure function of `seed`, `stream`, the pixel and time.
    pixel : uint32 [n], index on the full sensor.
    rate_hz : [n], above 0.
    """

    def __init__(self, seed: int, stream: Stream, pixel: NDArray[np.uint32], rate_hz: NDArray[np.float64]) -> None:
        self._seed, self._stream, self._pixel = seed, stream, pixel
        self._mean_us = US_PER_S / np.asarray(rate_hz, np.float64)
        self._cell_us = _PER_CELL * self._mean_us

    def between(
        self, begin_us: float, end_us: float
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """All points after `begin_us` and up to `end_us`, in no order.

        Parameters
        ----------
        begin_us, end_us : bounds, µs.

        Returns
        -------
        place, t_us, mark : [point], index into `pixel`, time in µs, and a number in (0, 1) that belongs to the point.
        """
        # all cells [cell] that the interval meets; the points of a cell depend on its number alone
        first, last = (np.floor(t / self._cell_us).astype(np.int64) for t in (begin_us, end_us))
        count = last - first + 1
        which = np.repeat(np.arange(count.size), count)
        cell = np.arange(which.size) - np.repeat(np.cumsum(count) - count, count) + first[which]
        result = [(np.empty(0, np.intp), np.empty(0, np.int64), np.empty(0))]
        for here, order, offset_us in self._points(which, cell):
            t_us = cell[here] * self._cell_us[which[here]] + offset_us
            inside = (t_us > begin_us) & (t_us <= end_us)
            result.append((here[inside], order[inside], t_us[inside]))
        here, order, t_us = (np.concatenate(values) for values in zip(*result, strict=True))
        return which[here], t_us, self._mark(which[here], cell[here], order)

    def last_mark(self, which: NDArray[np.intp], t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Number in (0, 1) that belongs to the last point of the processes `which` [m] at or before `t_us` [m], µs."""
        cell = np.floor(t_us / self._cell_us[which]).astype(np.int64)
        until = np.asarray(t_us, np.float64)
        # from the cell of the time back to the first one with a point before it
        number, open_ = np.full(which.size, -1, np.int64), np.arange(which.size)
        while open_.size:
            begin_us = cell[open_] * self._cell_us[which[open_]]
            for here, order, offset_us in self._points(which[open_], cell[open_]):
                before = begin_us[here] + offset_us <= until[open_[here]]
                number[open_[here[before]]] = order[before]  # later ones come later
            open_ = open_[number[open_] < 0]
            cell[open_] -= 1
        return self._mark(which, cell, number)

    def _mark(self, which: NDArray[np.intp], cell: NDArray[np.int64], number: NDArray[np.int64]) -> NDArray[np.float64]:
        if which.size == 0:
            return np.empty(0)
        draw = number.astype(np.uint32) + _MARK
        return uniform(random_words(self._seed, self._stream, self._pixel[which], _counter(cell), draw)[0])

    def _points(
        self, which: NDArray[np.intp], cell: NDArray[np.int64]
    ) -> Iterator[tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.float64]]]:
        """Points of cells in order of time, one round at a time.

        Yields
        ------
        Entries of `which`, number of the point in its cell, and time after the begin of the cell, µs.
        """
        here, elapsed, block = np.arange(which.size), np.zeros(which.size), 0
        while here.size:
            # exponential gaps from one point to the next, a block of random words at a time, until the cell ends
            draw = np.full(here.size, block, np.uint32)
            result = random_words(self._seed, self._stream, self._pixel[which[here]], _counter(cell[here]), draw)
            for k in range(_BLOCK):
                elapsed = elapsed - np.log(uniform(result[k])) * self._mean_us[which[here]]
                inside = elapsed < self._cell_us[which[here]]
                here, elapsed, result = here[inside], elapsed[inside], result[:, inside]
                if here.size:
                    yield here, np.full(here.size, _BLOCK * block + k), elapsed
            block += 1


class Telegraph:
    """A random telegraph signal for each of a few pixels: a Markov process that is high or low [machlup1954].

    The state is drawn anew, high with the stationary share, at the points of a Poisson process whose rate is the sum of
    both rates of change. This is the same Markov process, with correlation exp(−rate·Δt).

    Parameters
    ----------
    seed, stream, pixel : as in `PoissonPoints`.
    rate_hz : [n], 1/(mean time high) + 1/(mean time low).
    high_share : [n], part of the time at the high level.
    """

    def __init__(
        self,
        seed: int,
        stream: Stream,
        pixel: NDArray[np.uint32],
        rate_hz: NDArray[np.float64],
        high_share: NDArray[np.float64],
    ) -> None:
        self._points = PoissonPoints(seed, stream, pixel, rate_hz)
        self._share = np.asarray(high_share, np.float64)

    def is_high(self, which: NDArray[np.intp], t_us: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the processes `which` [m] (indices into `pixel`) are at their high level at `t_us` [m], µs."""
        return self._points.last_mark(which, t_us) < self._share[which]


def _counter(cell: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Cell numbers as counters; cells before time 0 are the last counters."""
    return (cell & 0xFFFFFFFF).astype(np.uint32)

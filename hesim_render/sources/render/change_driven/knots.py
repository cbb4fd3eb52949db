"""Knots: the rendered windows of each pixel in a block, between which its flux is interpolated linearly.

Most pixels have two of them, at both ends of the block. Only knots are held, so that a block of a large sensor may have
many windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.estimates import Flux


@dataclass(frozen=True)
class Knots:
    """Knots of n pixels, one pixel after the other, each in order of time; arrays [k].

    Parameters
    ----------
    first : [n + 1], place of the first knot of each pixel, and the number of all knots.
    window : window of each knot; that of the first knot of a pixel is 0.
    values : half A, half B and error, e⁻/s.
    centre_us : [window], middles of the windows, µs.
    """

    first: NDArray[np.int64]
    window: NDArray[np.int16]
    values: tuple[NDArray[np.float32], ...]
    centre_us: NDArray[np.float64]

    @classmethod
    def of(cls, flux: Flux, known: NDArray[np.bool_], centre_us: NDArray[np.float64]) -> Knots:
        """The known windows [window, pixel] of some pixels; the first window is among them."""
        pixel, window = np.nonzero(known.T)
        first = np.append(0, np.cumsum(np.count_nonzero(known, axis=0)))
        values = tuple(values[window, pixel] for values in flux.arrays)
        return cls(first, window.astype(np.int16), values, centre_us)

    def places(self, window: int, before: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Last knot of each pixel up to a window, [n].

        Parameters
        ----------
        window : number of the window.
        before : the same of the window before it, if it is known.
        """
        if before is not None:
            following = np.minimum(before + 1, self.window.size - 1)
            moves = (before + 1 < self.first[1:]) & (self.window[following] <= window)
            return before + moves
        # knots in order of pixel and window; one before the first knot that is later
        count = self.centre_us.size
        key = np.repeat(np.arange(self.first.size - 1), np.diff(self.first)) * count + self.window
        return np.searchsorted(key, np.arange(self.first.size - 1) * count + window, side="right") - 1

    def at(self, window: int, low: NDArray[np.int64]) -> Flux:
        """Flux in one window, [1, n]; 0 where no knot is at or after it.

        Parameters
        ----------
        window : number of the window.
        low : last knot of each pixel up to it.
        """
        is_knot = self.window[low] == window
        has_next = low + 1 < self.first[1:]
        high = np.where(has_next & ~is_knot, low + 1, low)
        # how far the window is on the way from one knot to the next
        begin, end = self.centre_us[self.window[low]], self.centre_us[self.window[high]]
        part = ((self.centre_us[window] - begin) / np.where(high > low, end - begin, 1)).astype(np.float32)
        part[high == low] = 0
        found = []
        for values in self.values:
            start = values[low]
            value = start + part * (values[high] - start)
            value[~is_knot & ~has_next] = 0
            found.append(value[None])
        return Flux(*found)


class BlockFlux:
    """Flux of pixels in the windows of a block.

    Parameters
    ----------
    size : number of pixels.
    parts : places of some pixels, and their knots.
    """

    def __init__(self, size: int, parts: list[tuple[NDArray[np.int64], Knots]]) -> None:
        self._size, self._parts = size, parts
        self._window, self._low = -2, [np.empty(0, np.int64)] * len(parts)

    def at(self, window: int) -> Flux:
        """Flux in one window, [1, size]; quick for windows one after the other."""
        out, follows = Flux.zeros(1, self._size), window == self._window + 1
        for number, (place, knots) in enumerate(self._parts):
            low = knots.places(window, self._low[number] if follows else None)
            out.put(place, knots.at(window, low))
            self._low[number] = low
        self._window = window
        return out

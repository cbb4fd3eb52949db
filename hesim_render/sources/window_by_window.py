"""Event samples of sources that compute one window after another."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import Float, Halves
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.protocol import Sample


class WindowByWindow(ABC):
    """Implements `sample_blocks` and `flux_of_blocks` of `FluxSource` by means of its other three calls."""

    @abstractmethod
    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """See `FluxSource.slice_edges_us`."""

    @abstractmethod
    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """See `FluxSource.sample_times_us`."""

    @abstractmethod
    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`."""

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`: a window that ends at each of the source's times, and at the run's end."""
        inner = np.rint(self.sample_times_us(begin_us, end_us)).astype(np.int64)
        first = begin_us + window_us
        times = np.unique(np.concatenate([[first], inner, [end_us]]))
        for t_us in times[(times >= first) & (times <= end_us)]:
            yield Block(np.array([t_us - window_us], np.float64), np.array([t_us], np.float64), np.ones(1, np.bool_))

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`; a window may straddle several slices."""
        for block in blocks:
            for begin, end in zip(block.begin_us[block.wanted], block.end_us[block.wanted], strict=True):
                bounds = [begin, *self.slice_edges_us(begin, end), end]
                total_a: Float = 0.0
                total_b: Float = 0.0
                for low, high in pairwise(bounds):
                    half_a, half_b = self.mean_flux(pixel, low, high)
                    share = (high - low) / (end - begin) if end > begin else 1.0
                    total_a, total_b = total_a + half_a * share, total_b + half_b * share
                yield Sample(total_a, total_b)

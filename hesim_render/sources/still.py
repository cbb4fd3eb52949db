"""A static source: it is rendered once and serves all times.

Event samples of sources that compute one window after another.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Halves
from hesim_render.core.distinct import distinct_pixels
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.protocol import FluxSource, Sample


def checked_windows(
    pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike, count: int
) -> tuple[NDArray[np.uint32], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels and the ends of their intervals as arrays.

    Parameters
    ----------
    pixel : [n], mosaic indices.
    begin_us, end_us : [n] or one for all, µs.
    count : pixels of the region.

    Raises
    ------
    RangeError
        If a pixel lies outside the region or an interval ends before it begins.
    """
    pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
    if pixels.size and pixels.max() >= count:
        raise RangeError("pixel", int(pixels.max()), f"0 to {count - 1}")
    begin, end = (np.asarray(value, dtype=np.float64) for value in (begin_us, end_us))
    if not np.all(end >= begin):
        raise RangeError("interval", "an end before its begin", "begin_us <= end_us")
    return pixels, begin, end


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
                # the mean over the window: slices weighted by the time they have in it
                bounds = [begin, *self.slice_edges_us(begin, end), end]
                total_a: Float = 0.0
                total_b: Float = 0.0
                for low, high in pairwise(bounds):
                    half_a, half_b = self.mean_flux(pixel, low, high)
                    share = (high - low) / (end - begin) if end > begin else 1.0
                    total_a, total_b = total_a + half_a * share, total_b + half_b * share
                yield Sample(total_a, total_b)


class Kept:
    """Flux of static sources: every pixel is rendered once, when it is first asked for.

    Parameters
    ----------
    sources : static sources; all are asked for the same pixels.
    """

    def __init__(self, sources: Sequence[FluxSource]) -> None:
        self._sources = sources
        self._known = np.zeros(0, dtype=np.bool_)
        self._kept: list[list[Float]] = [[] for _ in sources]  # both halves of each source, by mosaic index

    def halves(self, pixel: NDArray[np.uint32]) -> list[Halves]:
        """Both halves of each source, Dr.Jit Float [n] each."""
        types = jit()
        self._reach(int(pixel.max()) + 1 if pixel.size else 0)
        if not self._known[pixel].all():
            # a static source shows the same at all times, so any interval will do
            fresh = distinct_pixels(pixel[~self._known[pixel]])
            where = from_host(types.UInt32, fresh)
            for source, kept in zip(self._sources, self._kept, strict=True):
                for whole, half in zip(kept, source.mean_flux(fresh, 0.0, 1.0), strict=True):
                    dr.scatter(whole, half, where)
                dr.eval(kept)
            self._known[fresh] = True
        index = from_host(types.UInt32, pixel)
        result = [(dr.gather(types.Float, a, index), dr.gather(types.Float, b, index)) for a, b in self._kept]
        dr.eval(result)
        return result

    def _reach(self, size: int) -> None:
        """Make room for mosaic indices below `size`."""
        missing = size - self._known.size
        if missing <= 0:
            return
        types = jit()
        self._known = np.concatenate([self._known, np.zeros(missing, dtype=np.bool_)])
        for kept in self._kept:
            room = [from_host(types.Float, np.zeros(missing, np.float32)) for _ in range(2)]
            kept[:] = [dr.concat([*old]) for old in zip(kept, room, strict=True)] if kept else room


class StillFlux(WindowByWindow):
    """A static source. All its pixels are rendered together when one of them is first asked for.

    Parameters
    ----------
    source : a source that does not change.
    pixel : [n], mosaic indices of all pixels that will be asked for.
    """

    is_static = True

    def __init__(self, source: FluxSource, pixel: NDArray[np.uint32]) -> None:
        self._kept, self._pixel = Kept([source]), pixel
        self._is_rendered = False

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No edges."""
        return np.empty(0)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No times."""
        return np.empty(0)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`."""
        if not self._is_rendered:
            self._kept.halves(self._pixel)
            self._is_rendered = True
        return self._kept.halves(pixel)[0]

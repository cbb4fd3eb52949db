"""A static source: it is rendered once and serves all times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, Halves
from hesim_render.core.distinct import distinct_pixels
from hesim_render.sources.protocol import FluxSource
from hesim_render.sources.window_by_window import WindowByWindow


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
        import drjit as dr

        types = jit()
        self._reach(int(pixel.max()) + 1 if pixel.size else 0)
        if not self._known[pixel].all():
            fresh = distinct_pixels(pixel[~self._known[pixel]])
            where = types.UInt32(fresh)
            for source, kept in zip(self._sources, self._kept, strict=True):
                for whole, half in zip(kept, source.mean_flux(fresh, 0.0, 1.0), strict=True):
                    dr.scatter(whole, half, where)
                dr.eval(kept)
            self._known[fresh] = True
        index = types.UInt32(pixel)
        found = [(dr.gather(types.Float, a, index), dr.gather(types.Float, b, index)) for a, b in self._kept]
        dr.eval(found)
        return found

    def _reach(self, size: int) -> None:
        """Make room for mosaic indices below `size`."""
        import drjit as dr

        missing = size - self._known.size
        if missing <= 0:
            return
        types = jit()
        self._known = np.concatenate([self._known, np.zeros(missing, dtype=np.bool_)])
        for kept in self._kept:
            room = [types.Float(np.zeros(missing, np.float32)) for _ in range(2)]
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

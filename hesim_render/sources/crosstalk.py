"""Crosstalk: the four neighbours of a pixel collect a part of its electrons, whatever their roles.

Charge that is generated under one pixel diffuses to its neighbours before read-out. With c the part that leaves a
pixel, Φ' = (1 − c)·Φ + c/4·(Φ above + Φ below + Φ left + Φ right). The kernel is symmetric, so no electron is
lost. At the border of the region, a pixel keeps the share of a missing neighbour. The charge that a pixel receives
counts for its own exposure, also with a rolling shutter.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Halves, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.protocol import FluxSource, Sample


def mixed(image: NDArray, part: float) -> NDArray:
    """Apply crosstalk to an image [row, col] of electrons or of electron rates; returns Φ' [row, col]."""
    if part == 0:
        return image
    padded = np.pad(image, 1, mode="edge")
    around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
    return (1.0 - part) * image + part / 4 * around


def with_crosstalk(flux: FluxSource, shape: tuple[int, int], part: float) -> FluxSource:
    """A source with crosstalk over a region [row, col]; the source itself if `part` is 0."""
    return flux if part <= 0 else CrosstalkFlux(flux, shape, part)


class CrosstalkFlux:
    """A source of flux with crosstalk; implements `FluxSource`.

    It also asks its source for the neighbours of the listed pixels, each over the listed pixel's interval. Where
    intervals differ from row to row, a pixel is asked for up to three times.

    Parameters
    ----------
    flux : the source without crosstalk.
    shape : rows and columns of the read-out region.
    part : c, 0 to 1.
    """

    def __init__(self, flux: FluxSource, shape: tuple[int, int], part: float) -> None:
        self._flux, self._shape, self._part = flux, shape, part
        self.is_static = flux.is_static

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        return self._flux.slice_edges_us(begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        return self._flux.sample_times_us(begin_us, end_us)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """See `FluxSource.mean_flux`; both halves are mixed alike."""
        types = jit()
        own = np.asarray(pixel, dtype=np.int64).ravel()
        sites = self._sites(own)
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        if begin.ndim == end.ndim == 0:
            asked, place = np.unique(sites, return_inverse=True)
        else:
            # each pixel in each of its intervals once, as two listed pixels may share a neighbour; an interval is a
            # complex number, so that one sort serves both ends
            interval = np.broadcast_to(begin + 1j * end, own.shape)
            intervals, number = np.unique(interval, return_inverse=True)
            asked, place = np.unique(sites * intervals.size + number, return_inverse=True)
            asked, number = np.divmod(asked, intervals.size)
            begin, end = intervals.real[number], intervals.imag[number]
        halves = self._flux.mean_flux(asked.astype(np.uint32), begin, end)
        return self._mix(halves, [from_host(types.UInt32, where) for where in place.reshape(sites.shape)])

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`."""
        return self._flux.sample_blocks(window_us, begin_us, end_us)

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`."""
        types = jit()
        sites = self._sites(np.asarray(pixel, dtype=np.int64).ravel())
        asked, place = np.unique(sites, return_inverse=True)
        index = [from_host(types.UInt32, where) for where in place.reshape(sites.shape)]
        for sample in self._flux.flux_of_blocks(asked.astype(np.uint32), blocks):
            yield Sample(*self._mix((sample.half_a, sample.half_b), index))

    def _sites(self, own: NDArray[np.int64]) -> NDArray[np.int64]:
        """Each pixel and its four neighbours, [5, n]; the pixel itself in place of a missing neighbour."""
        rows, cols = self._shape
        row, col = np.divmod(own, cols)
        return np.stack(
            [
                own,
                own - cols * (row > 0),
                own + cols * (row < rows - 1),
                own - (col > 0),
                own + (col < cols - 1),
            ]
        )

    def _mix(self, halves: Halves, index: list[UInt32]) -> Halves:
        types = jit()
        result = []
        for half in halves:
            # (1 − c) of its own electrons, and a quarter of c from each neighbour
            centre, *around = (dr.gather(types.Float, half, where) for where in index)
            result.append(
                (1.0 - self._part) * centre + self._part / 4 * (around[0] + around[1] + around[2] + around[3])
            )
        dr.eval(result)
        return result[0], result[1]

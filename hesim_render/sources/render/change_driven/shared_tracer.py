"""Flux of pairs whose paths share what they find with those of the pixels around; see `SharedPaths`.

Pixels lie in tiles of the full sensor. A pair is traced with all pixels of its tile, in the same window and with the
same number of rays, so that its flux does not depend on which others are asked for.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import UInt64
from hesim_render.core.distinct import distinct_columns
from hesim_render.core.host_arrays import spread_out
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.neighbours import Lattice
from hesim_render.sources.render.change_driven.packet_tracer import PACKET, pair_of_rays
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, flux_inputs, remembered
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.windows import Moments, Windows
from hesim_render.sources.render.transport.shared_paths import Groups, SharedPaths

#: Rows and columns of a tile, pixels of a lattice.
SIDE = 4
#: Rays of a pixel and repetitions of a trial.
TRIAL_RAYS, _REPEATS = 16, 4
#: Part of the rays that are traced at a time: each of these has a density for each pixel of its tile.
_PART = 4


@dataclass(frozen=True)
class Tiles:
    """Squares of `SIDE` pixels of a lattice; those at its far edges overlap the ones before.

    Parameters
    ----------
    lattice : the pixels, `SIDE` rows and columns at least.
    """

    lattice: Lattice

    def of(self, pixel: NDArray[np.uint32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Number of the tile of each pixel, and of the pixel in its tile."""
        row, col = self.lattice.place(pixel)
        tile = row // SIDE * self._across + col // SIDE
        top, left = self._begin(tile)
        return tile, (row - top) * SIDE + col - left

    def pixels(self, tile: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Numbers on the full sensor of all pixels of some tiles, [tile, pixel]."""
        top, left = self._begin(tile)
        row, col = np.divmod(np.arange(SIDE * SIDE), SIDE)
        return self.lattice.index(top[:, None] + row, left[:, None] + col)

    @property
    def _across(self) -> int:
        return -(-self.lattice.cols // SIDE)

    def _begin(self, tile: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of the first pixel of each tile."""
        row, col = np.divmod(tile, self._across)
        return np.minimum(row * SIDE, self.lattice.rows - SIDE), np.minimum(col * SIDE, self.lattice.cols - SIDE)


class SharedTracer(PairTracer):
    """Traces pairs by themselves, or with the other pixels of their tiles; see `PairTracer`."""

    def may_share(self, lattice: Lattice | None) -> bool:
        """True if the pixels of a lattice may share: they have one filter, and see paths of more than two segments."""
        if lattice is None or min(lattice.rows, lattice.cols) < SIDE or self.paths is None:
            return False
        return self.paths.may_share and self._has_one_filter(lattice)

    def trial(self, tile: NDArray[np.int64], lattice: Lattice) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What all pixels of some tiles of a lattice show with `TRIAL_RAYS` rays, with sharing and without.

        This depends on scene, sensor and seed alone.

        Returns
        -------
        flux : [tile, pixel], e⁻/s.
        square : [2, tile, pixel], variances of the flux of shared paths and of the same paths alone, (e⁻/s)².
        """
        tiles = Tiles(lattice)
        pixel = tiles.pixels(tile).ravel()
        given = pixel, np.zeros(pixel.size, np.int64), Windows(np.array([-1000.0]), np.array([0.0]))
        rays, stream = np.full(pixel.size, TRIAL_RAYS), Stream.RENDER_SHARING
        # [repetition, shared or alone, pixel]
        means = np.array([
            [flux.mean for flux in self._of_tiles(*given, rays, tiles, stream, None, repeat)]
            for repeat in range(_REPEATS)
        ], np.float64)  # fmt: skip
        shape = tile.size, SIDE * SIDE
        return means[:, 0].mean(axis=0).reshape(shape), means.var(axis=0, ddof=1).reshape(2, *shape)

    def shared(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: NDArray[np.integer],
        lattice: Lattice,
        stream: Stream = Stream.RENDER,
        span_us: tuple[float, float] | None = None,
    ) -> PairFlux:
        """Flux of every listed pair, with what the other pixels of its tile find.

        Parameters
        ----------
        pixel, window, windows, samples, stream, span_us : see `trace`; the pixels are of one lattice and one filter.
        lattice : the pixels that share.

        Returns
        -------
        Flux of the pairs, [n].
        """
        return self._of_tiles(pixel, window, windows, samples, Tiles(lattice), stream, span_us, 0)[0]

    def _has_one_filter(self, lattice: Lattice) -> bool:
        """True if all pixels of a lattice have the same filter."""
        layout = self.sensor.layout
        filters = layout.filter_index[: layout.tile_shape[0], : layout.tile_shape[1]]
        row, col = (
            (first + step * np.arange(size)) % size
            for first, step, size in zip(lattice.first, lattice.step, filters.shape, strict=True)
        )
        return np.unique(filters[np.ix_(row, col)]).size == 1

    def _of_tiles(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: NDArray[np.integer],
        tiles: Tiles,
        stream: Stream,
        span_us: tuple[float, float] | None,
        repeat: int,
    ) -> tuple[PairFlux, PairFlux]:
        """Flux of pairs that share, and of the same paths where they do not; see `shared`."""
        tile, member = tiles.of(pixel)
        # each tile once, in each window, with each number of rays
        (tile, window, rays), place = distinct_columns(np.stack([tile, window, samples]).astype(np.int64))
        size, pixels = SIDE * SIDE, tiles.pixels(tile).ravel()
        lane_window, packets = np.repeat(window, size).astype(np.uint32), np.repeat(rays // PACKET, size)
        out = PairFlux.empty(pixels.size), PairFlux.empty(pixels.size)
        moments, key = self._moments(windows, span_us), self._key(stream)
        # rays up to the end of each tile; at a time as many tiles as a part of a block holds, or a single one
        upto, begin = np.cumsum(rays * size), 0
        while begin < tile.size:
            room = self._block_rays // _PART + (upto[begin - 1] if begin else 0)
            end = max(begin + 1, int(np.searchsorted(upto, room, side="right")))
            part = slice(begin * size, end * size)
            lanes = pixels[part], lane_window[part], np.full(pixels[part].size, repeat, np.uint32)
            trace = partial(self._tiles_block, lanes, packets[part], moments, key, out, part)
            inputs = (*self._run_part, "shared", *lanes, packets[part], stream, *flux_inputs(windows, span_us, None))
            if stream == Stream.RENDER:
                remembered(self._journal, inputs, out[0], part, trace)
            else:
                trace()
            self._report(int(rays[begin:end].sum()) * size)
            begin = end
        scale, listed = self.axis_factor(pixel), place * size + member
        # what comes near one path of a tile changes the flux of all its pixels
        near = np.repeat(out[0].met.reshape(-1, size).any(axis=1), size)
        shared, alone = (
            PairFlux(flux.half_a[listed] * scale, flux.half_b[listed] * scale, near[listed]) for flux in out
        )
        return shared, alone

    def _tiles_block(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        packets: NDArray[np.int64],
        moments: Moments,
        key: UInt64,
        out: tuple[PairFlux, PairFlux],
        part: slice,
    ) -> None:
        """Flux of all pixels of some tiles, each with some packets of rays."""
        assert self.paths is not None
        self.traces += 1
        types, rays_of_pair = jit(), packets * PACKET
        pair = pair_of_rays(packets)
        groups = Groups.of(SIDE * SIDE, pair, spread_out(types.UInt32, rays_of_pair.astype(np.uint32), pair))
        dr.eval(groups.own, groups.first, groups.stride)
        footprint = dr.opaque(types.Float, 1.0)
        rays, _ = self._started(lanes, packets, rays_of_pair // 2, moments, key, footprint, None, groups)
        *fluxes, met = SharedPaths(self.paths).flux(self._sampler, rays.ray, rays.now, rays.filter, groups)
        bits = dr.select(met, types.UInt32(1), dr.zeros(types.UInt32, int(rays_of_pair.sum())))
        dr.eval(fluxes, bits)
        self._sampler.rest()
        for flux, values in zip(out, fluxes, strict=True):
            flux.put(part, values if rays.weight is None else values * rays.weight, bits, packets, PACKET)

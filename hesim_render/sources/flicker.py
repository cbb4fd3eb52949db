"""Flicker: lights whose power follows a waveform, exactly, at the cost of one render per waveform.

Light adds up: Φ(t) = Σ w(t)·Φ_w. Φ_w is the flux with only the lights of waveform w on, at their mean level, and w has
the time mean 1. In a static scene each Φ_w is rendered once, and the mean over an interval is exact: Φ_w times the
mean of w, in closed form. In a moving scene the change-driven renderer draws the instants of its rays with density w
(`change_driven.light_times`). Its mean over an interval, times the mean of w, is the mean of the product.

Sources whose instants have an even density are asked for pieces of time, and the mean of the product is replaced by the
product of the means. Within a piece either the image hardly moves, or ln w departs from a straight line by 0.002 or
less; in each cell of time (`schedule.CELL_US`) the kind with fewer pieces is used.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Halves
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import CELL_US, Block, blocks_of_run
from hesim_render.sources.protocol import AuditableFlux, FluxSource, Sample, WeightedFlux
from hesim_render.sources.still import Kept
from hesim_render.spectral.waveform import Waveform

#: Largest number of samples while an event window passes over a jump of the light.
_WINDOW_STEPS = 8


class FlickerFlux:
    """Sum of sources under the different lights of one scene, each times its waveform; implements `FluxSource`.

    Parameters
    ----------
    waveforms : waveform of each source; None is steady.
    sources : sources with the same geometry and camera. A `WeightedFlux` of its waveform weights its means over
        intervals itself.
    window_us : length of the window in which event pixels integrate, µs.

    Attributes
    ----------
    sources : as given.
    is_static : False.
    """

    def __init__(
        self, waveforms: Sequence[Waveform | None], sources: Sequence[FluxSource], window_us: float = 1.0
    ) -> None:
        self.sources, self._waveforms, self._window_us = tuple(sources), tuple(waveforms), window_us
        first = self.sources[0]
        self.is_static = False
        self._still = Kept(self.sources) if first.is_static else None
        self._is_whole = all(
            waveform is None or (isinstance(source, WeightedFlux) and source.light is waveform)
            for waveform, source in zip(self._waveforms, self.sources, strict=True)
        )

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Slice edges of the scene's motion, µs."""
        return self.sources[0].slice_edges_us(begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow motion and light, µs.

        Around a jump of the light they are whole µs: the last one before the jump, and some more until a window that
        begins after the jump has passed.
        """
        times = [self.sources[0].sample_times_us(begin_us, end_us), self._follow_us(begin_us, end_us)]
        steps = max(1, min(_WINDOW_STEPS, round(self._window_us)))
        after = np.ceil(self._window_us * np.arange(steps + 1) / steps)
        for waveform in self._waveforms:
            if waveform is not None:
                jumps = waveform.jumps_us(begin_us, end_us)
                times += [np.floor(jumps), (np.ceil(jumps)[:, None] + after).ravel()]
        every = np.unique(np.concatenate(times))
        return every[(every > begin_us) & (every < end_us)]

    def _follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        lists = [waveform.follow_us(begin_us, end_us) for waveform in self._waveforms if waveform is not None]
        return np.unique(np.concatenate(lists))

    def _weights(self, begin_us: ArrayLike, end_us: ArrayLike) -> list[NDArray[np.float64]]:
        """Mean of each source's waveform over the intervals."""
        shape = np.broadcast_shapes(np.shape(begin_us), np.shape(end_us))
        return [np.ones(shape) if w is None else w.mean(begin_us, end_us) for w in self._waveforms]

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval; see `FluxSource.mean_flux`."""
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        if pixels.size == 0:
            return self.sources[0].mean_flux(pixels, begin, end)
        if self._still is not None:
            return _weighted(self._still.halves(pixels), self._weights(begin, end))
        low, high = float(begin.min()), float(end.max())
        cuts = self._cuts_us(low, high)
        if cuts.size == 0:
            return self._piece(pixels, begin, end, self._weights(begin, end))
        return self._pieces(pixels, begin, end, np.concatenate([[low], cuts, [high]]))

    def _cuts_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval between which the image, or the light, hardly changes; none if all sources
        weight their means themselves. See the module docstring.
        """
        if self._is_whole:
            return np.empty(0)
        light = self._follow_us(begin_us, end_us)
        if light.size == 0:
            return light
        cuts = [np.empty(0)]
        for number in range(int(begin_us // CELL_US), -(-int(np.ceil(end_us)) // CELL_US)):
            low, high = number * CELL_US, (number + 1) * CELL_US
            # computed for whole cells, so that the result does not depend on the interval
            bright = self._follow_us(low, high)
            motion = self.sources[0].sample_times_us(low, high) if bright.size else bright
            # between cuts of either kind one of both hardly changes: the product of means holds. The fewer are taken
            cuts += [min(bright, motion, key=len), np.array([high], np.float64)]
        every = np.unique(np.concatenate(cuts))
        return every[(every > begin_us) & (every < end_us)]

    def _piece(
        self, pixel: NDArray[np.uint32], begin: NDArray, end: NDArray, weights: list[NDArray[np.float64]]
    ) -> Halves:
        """Sum of each source's mean times the mean of its waveform. Sources without power in the interval are not
        asked.
        """
        powered = [number for number, weight in enumerate(weights) if np.any(weight)]
        halves = [self.sources[number].mean_flux(pixel, begin, end) for number in powered]
        if not powered:
            types = jit()
            return dr.zeros(types.Float, pixel.size), dr.zeros(types.Float, pixel.size)
        return _weighted(halves, [weights[number] for number in powered])

    def _pieces(self, pixel: NDArray[np.uint32], begin: NDArray, end: NDArray, bounds: NDArray[np.float64]) -> Halves:
        """As `_piece`, piece by piece. A pixel takes part in the pieces that overlap its interval."""
        types = jit()
        begin, end = (np.broadcast_to(times, pixel.shape) for times in (begin, end))
        length = end - begin
        totals = [from_host(types.Float, np.zeros(pixel.size, np.float32)) for _ in range(2)]
        for number, (low, high) in enumerate(zip(bounds[:-1], bounds[1:], strict=True)):
            first, last = np.clip(begin, low, high), np.clip(end, low, high)
            # an empty interval belongs to the piece that begins there; at the very end, to the last piece
            instant = (length == 0) & (begin >= low) & ((begin < high) | (number == bounds.size - 2))
            share = np.divide(last - first, length, out=instant.astype(np.float64), where=length > 0)
            where = np.flatnonzero(share)
            if where.size == 0:
                continue
            weights = [weight * share[where] for weight in self._weights(first[where], last[where])]
            index = from_host(types.UInt32, where)
            for total, half in zip(totals, self._piece(pixel[where], first[where], last[where], weights), strict=True):
                # every index occurs once, so this is no race and the sum's order is that of time
                dr.scatter(total, dr.gather(types.Float, total, index) + half, index)
            dr.eval(totals)
        return totals[0], totals[1]

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`."""
        return blocks_of_run(self.instants_us, window_us, begin_us, end_us)

    def instants_us(self, begin_us: float, end_us: float) -> NDArray[np.int64]:
        """Whole µs from `begin_us` to `end_us`, both included, that follow motion and light; with multiples of
        `CELL_US`.
        """
        inner = np.rint(self.sample_times_us(begin_us - 1, end_us + 1)).astype(np.int64)
        cells = np.arange(begin_us // CELL_US, end_us // CELL_US + 1, dtype=np.int64) * CELL_US
        every = np.unique(np.concatenate([np.rint([begin_us, end_us]).astype(np.int64), inner, cells]))
        return every[(every >= begin_us) & (every <= end_us)]

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`.

        Windows in which both light and image change are cut into pieces, which are windows of their own.
        """
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        if self._still is not None:
            halves = self._still.halves(pixels)
            for block in blocks:
                begin, end = block.begin_us[block.wanted], block.end_us[block.wanted]
                for weights in np.stack(self._weights(begin, end), axis=1):
                    yield Sample(*_weighted(halves, list(weights)), np.zeros(pixels.size, np.float32))
            return
        # each source is asked for the pieces of all windows in one stream; the sums take them up in the same order
        mine, *others = itertools.tee(map(self._cut, blocks), 1 + len(self.sources))
        streams = []
        for source, cut in zip(self.sources, others, strict=True):
            streams.append(source.flux_of_blocks(pixels, (pieces for pieces, _ in cut)))
        samples = zip(*streams, strict=True)
        for pieces, counts in mine:
            begin, end = pieces.begin_us[pieces.wanted], pieces.end_us[pieces.wanted]
            weights = np.stack(self._weights(begin, end), axis=1)
            for first, count in zip(np.cumsum(counts) - counts, counts, strict=True):
                # weight of a piece: mean power in it, times its share of the window
                length = end[first + count - 1] - begin[first]
                share = (end - begin)[first : first + count] / length if length > 0 else np.ones(1)
                yield self._sum([next(samples) for _ in range(count)], weights[first : first + count] * share[:, None])

    def _cut(self, block: Block) -> tuple[Block, NDArray[np.int64]]:
        """Cut the windows of a block into pieces. Returns the pieces, and the number of pieces of each wanted window.

        The first window belongs to the previous block. Only its last piece is kept, which ends where the window ends.
        """
        begin, end, wanted, counts = [], [], [], []
        for number, (low, high, asked) in enumerate(zip(block.begin_us, block.end_us, block.wanted, strict=True)):
            bounds = np.concatenate([[low], self._cuts_us(low, high), [high]])
            if number == 0 and not asked:
                bounds = bounds[-2:]
            begin.append(bounds[:-1])
            end.append(bounds[1:])
            wanted.append(np.full(bounds.size - 1, asked))
            if asked:
                counts.append(bounds.size - 1)
        return Block(*map(np.concatenate, (begin, end, wanted))), np.array(counts, np.int64)

    def _sum(self, samples: Sequence[tuple[Sample, ...]], weights: NDArray[np.float64]) -> Sample:
        """Weighted sum over all sources, [source] each, and over the pieces of a window; `weights` [piece, source]."""
        every = [sample for piece in samples for sample in piece]
        half_a, half_b = _weighted([(one.half_a, one.half_b) for one in every], list(weights.ravel()))
        # all pieces use the same random numbers, so their errors add linearly; errors of two sources are independent
        of_sources = np.zeros((len(self.sources), len(every[0].error) if every[0].error is not None else 0), np.float32)
        for number, total in enumerate(of_sources):
            for piece, weight in zip(samples, weights[:, number], strict=True):
                error = piece[number].error
                if error is not None:
                    total += np.float32(weight) * error
        return Sample(half_a, half_b, np.sqrt(np.sum(of_sources**2, axis=0)))

    # ---- for the audit, if the sources are auditable -----------------------------------------------

    @property
    def _auditable(self) -> list[AuditableFlux]:
        return [source for source in self.sources if isinstance(source, AuditableFlux)]

    @property
    def rays_traced(self) -> int:
        """Rays traced so far by all sources."""
        return sum(source.rays_traced for source in self._auditable)

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """No pixel is still, because the light changes everywhere."""
        return np.zeros(pixel.size, np.bool_)

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """See `ChangeDrivenFlux.noise_unit`."""
        return self._auditable[0].noise_unit(pixel, flux, events)

    def reference_flux(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        events: bool,
    ) -> NDArray[np.float64]:
        """See `ChangeDrivenFlux.reference_flux`."""
        if self._still is not None:
            asked, place = np.unique(pixel, return_inverse=True)
            zero = np.zeros(asked.size)
            parts = [
                source.reference_flux(asked, zero, zero + 1.0, quality, events)[:, place] for source in self._auditable
            ]
            return np.sum([w * part for w, part in zip(self._weights(begin_us, end_us), parts, strict=True)], axis=0)
        assert self._is_whole
        total = np.zeros((2, pixel.size))
        for source, weight in zip(self._auditable, self._weights(begin_us, end_us), strict=True):
            powered = np.flatnonzero(weight)
            result = source.reference_flux(pixel[powered], begin_us[powered], end_us[powered], quality, events)
            total[:, powered] += weight[powered] * result
        return total

    def reference_changes(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        needed: NDArray[np.bool_],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """See `AuditableFlux.reference_changes`. Each value has the error that `reference_flux` asks for, as lamps have
        other powers in other windows.
        """
        values = np.zeros((2, *needed.shape))
        of = np.broadcast_to(pixel, needed.shape)[needed], begin_us[needed], end_us[needed]
        values[:, needed] = self.reference_flux(*of, quality, events=True)
        return values


def _weighted(halves: Sequence[Halves], weights: Sequence[ArrayLike]) -> Halves:
    """Σ weight · half, for both halves; a weight is a number, or one number per pixel."""
    types = jit()
    # opaque: a literal number would make a new kernel at every time
    factors = [
        dr.opaque(types.Float, float(np.asarray(w))) if np.ndim(w) == 0 else from_host(types.Float, w) for w in weights
    ]
    total_a, total_b = (
        sum((pair[k] * factor for pair, factor in zip(halves, factors, strict=True)), types.Float(0.0)) for k in (0, 1)
    )
    dr.eval(total_a, total_b)
    return total_a, total_b

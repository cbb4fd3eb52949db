"""Decision rays: what a pair of a pixel and a window shows, by rays that are no part of its picture."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt64
from hesim_render.core.host_arrays import spread_out
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.aim import in_blocks
from hesim_render.sources.render.change_driven.edges import EdgeFit, PairEdges, joined_rays
from hesim_render.sources.render.change_driven.packet_tracer import PACKET, PacketTracer, pair_of_rays
from hesim_render.sources.render.change_driven.pair_flux import flux_inputs, remembered
from hesim_render.sources.render.change_driven.windows import Moments, Windows
from hesim_render.sources.render.transport.occluded_lamps import most_frequent

#: Rays that say which shapes hide lamps from a pair, and their repetition in the stream of the pilot, which has 0.
_SHADOW_RAYS, _SHADOW_REPEAT = 16, 3


class DecisionRays(PacketTracer):
    """Lines of edges in pairs, and shapes that hide lamps from them; see `PacketTracer`."""

    @property
    def knows_shadows(self) -> bool:
        """True if there are shapes whose shadows have a closed form."""
        return self._direct is not None and self._direct.knows_shadows

    def edges(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: int,
        footprint_px: float,
        controlled: NDArray[np.bool_],
        least: NDArray[np.float32],
        stream: Stream = Stream.RENDER_EDGE,
        moves: bool = False,
        shadows: NDArray[np.uint32] | None = None,
    ) -> EdgeFit:
        """Lines fitted to a few rays of every listed pair, with random numbers of their own.

        Parameters
        ----------
        pixel, window, windows, controlled, stream, shadows : see `trace`.
        samples : rays per pair, a power of two, at least twice `LEAST_SAMPLES`; half as many where the first half shows
            little contrast, and twice as many where there is a line.
        footprint_px : width of the area in which these rays start, pixels.
        least : [n], contrast below which it is little, e⁻/s on the optical axis.
        moves : True where lines may move within the windows.

        Returns
        -------
        Fits of the pairs, [n].
        """
        out, moments, key = EdgeFit.empty(pixel.size), self._moments(windows, None), self._key(stream)
        footprint, packets = dr.opaque(jit().Float, footprint_px), np.full(pixel.size, samples // PACKET)
        # where there is a line, as many rays again are traced, and the values of all of them are held at once
        for part, _, known in in_blocks(packets, self._block_rays // (2 * PACKET), None, None, shadows):
            lanes = pixel[part], window[part].astype(np.uint32), np.zeros(pixel[part].size, np.uint32)
            inputs = (
                "edges",
                *lanes,
                controlled[part],
                least[part],
                samples,
                footprint_px,
                stream,
                moves,
                *flux_inputs(windows, None, None),
                known,
            )
            given = lanes, controlled[part], least[part], known, moments, key, samples, footprint, out, part, moves
            trace = partial(self._edge_block, *given)
            remembered(self._journal, self._run_part + inputs, out, part, trace)
            self._report(int(out.rays[part].sum(dtype=np.int64)))
        return out

    def shadows(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        footprint_px: float,
        stream: Stream = Stream.RENDER_PILOT,
    ) -> NDArray[np.uint32]:
        """Shapes that hide lamps from every listed pair, by a few rays of each: codes of `LampShadows`, [n].

        Parameters
        ----------
        pixel, window, windows, footprint_px, stream : see `pilot`.
        """
        assert self._direct is not None
        out, packets = np.zeros(pixel.size, np.uint32), np.full(pixel.size, _SHADOW_RAYS // PACKET)
        moments, key = self._moments(windows, None), self._key(stream)
        footprint = dr.opaque(jit().Float, footprint_px)
        for part, *_ in in_blocks(packets, self._block_rays // PACKET, None, None):
            repeat = np.full(pixel[part].size, _SHADOW_REPEAT, np.uint32)
            lanes = pixel[part], window[part].astype(np.uint32), repeat
            own = packets[part]
            rays, _ = self._started(lanes, own, own * PACKET, moments, key, footprint, None)
            # codes of the shapes, [pair · ray]; the most frequent one among the rays of a pair counts
            met = np.array(self._direct.shadows_of(self._sampler, rays.ray, rays.now))
            self._sampler.rest()
            out[part] = most_frequent(met.reshape(repeat.size, _SHADOW_RAYS))
            self._report(repeat.size * _SHADOW_RAYS)
        return out

    def _edge_block(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        controlled: NDArray[np.bool_],
        least: NDArray[np.float32],
        shadows: NDArray[np.uint32] | None,
        moments: Moments,
        key: UInt64,
        samples: int,
        footprint: Float,
        out: EdgeFit,
        part: slice | NDArray[np.int64],
        moves: bool,
    ) -> None:
        """Lines of some pairs: of rays all over the pixel, as many more where these show contrast, and twice as many
        about a line, where there is one.
        """

        def decision_rays(
            some: NDArray[np.int64], rays: int, repeat: int, about: PairEdges | None = None
        ) -> list[Float]:
            """Place, time and flux of the rays of some pairs."""
            packets = np.full(some.size, rays // PACKET)
            chosen = [values[some] for values in lanes[:2]] + [np.full(some.size, repeat, np.uint32)]
            width = footprint if about is None else dr.opaque(jit().Float, 1.0)
            given = chosen, packets, packets * PACKET, moments, key, width, about
            known = None if shadows is None else shadows[some]
            traced = self._packets_of(*given, is_weighted=False, shadows=known)
            types = jit()
            by_control = spread_out(types.UInt32, controlled[some].astype(np.uint32), pair_of_rays(packets))
            # place in the pixel, instant from the middle of the window, and flux by the estimator of the pair
            values = [*traced.place, traced.share - 0.5, dr.select(by_control != 0, traced.fluxes[0], traced.fluxes[1])]
            dr.eval(values)
            return values

        every, half = np.arange(lanes[0].size), samples // 2
        # half of the rays of every pair: most show little contrast, and have nothing to fit a line to
        first, fit = decision_rays(every, half, 0), EdgeFit.empty(every.size)
        fit.put(slice(None), first, half, moves)
        uneven = np.flatnonzero(fit.high - fit.low >= least)
        if uneven.size:
            # the other half, where there is contrast: a line needs more rays on both sides
            both = joined_rays(first, uneven, decision_rays(uneven, half, 1), half)
            better = EdgeFit.empty(uneven.size)
            better.put(slice(None), both, samples, moves)
            lines = np.flatnonzero(better.is_line)
            if lines.size:
                refined = EdgeFit.empty(lines.size)
                # about this line, in a strip that holds all lines which these rays allow: rays elsewhere say nothing
                # of its place
                more = decision_rays(uneven[lines], samples, 2, better.models(lines, wider=True))
                refined.put(slice(None), joined_rays(both, lines, more, samples), 2 * samples, moves)
                better.replace(lines, refined)
            fit.replace(uneven, better)
        out.replace(part, fit)

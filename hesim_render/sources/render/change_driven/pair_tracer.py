"""Flux of (pixel, time window) pairs in any order. Each ray has its own instant inside the window of its pixel."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt64
from hesim_render.core.host_arrays import spread_out
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.aim import PairAims, in_blocks
from hesim_render.sources.render.change_driven.decision_rays import DecisionRays
from hesim_render.sources.render.change_driven.edges import PairEdges
from hesim_render.sources.render.change_driven.packet_tracer import PACKET, pair_of_rays
from hesim_render.sources.render.change_driven.pair_flux import (
    PairFlux,
    PilotFlux,
    PilotRays,
    flux_inputs,
    not_negative,
    remembered,
)
from hesim_render.sources.render.change_driven.windows import Moments, Windows


class PairTracer(DecisionRays):
    """Flux and pilots of pairs; see `PacketTracer`."""

    def trace(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: NDArray[np.integer],
        controlled: NDArray[np.bool_],
        stream: Stream = Stream.RENDER,
        span_us: tuple[float, float] | None = None,
        repeat: NDArray[np.integer] | int = 0,
        aims: PairAims | None = None,
        edges: PairEdges | None = None,
        signed: bool = False,
        shadows: NDArray[np.uint32] | None = None,
    ) -> PairFlux:
        """Flux of every listed pair.

        Parameters
        ----------
        pixel : [n], number on the full sensor.
        window : [n], number of the window among `windows`.
        windows : the windows.
        samples : [n], rays per pair, a power of two from `LEAST_SAMPLES` to `MOST_SAMPLES`.
        controlled : [n], True takes the estimator with a control variate, False the plain one, see `DiffuseIntegrator`.
        stream : stream of random numbers.
        span_us : interval in which `PairFlux.met` tests for moving objects, µs; default: the windows themselves.
        repeat : [n] or one number, the repetition; each has random numbers of its own.
        aims : small objects at which half of the rays are aimed, where a pair has any.
        edges : models of edges, about which half of the rays start, where a pair has one; such a pair has 16 rays or
            more, so that each half has both kinds.
        signed : leave negative means as they are, for fluxes of which differences are taken.
        shadows : [n], codes of `LampShadows`: these shadows are taken in closed form; 0, or None, for none. They are
            a control variate, whatever `controlled` says.

        Returns
        -------
        Flux of the pairs, [n].
        """
        out = PairFlux.empty(pixel.size)
        packets = (samples // PACKET).astype(np.int64)
        moments = self._moments(windows, span_us)
        key, times = self._key(stream), np.broadcast_to(np.asarray(repeat, np.uint32), pixel.shape)
        for part, aimed, known in in_blocks(packets, self._block_rays // PACKET, aims, edges, shadows):
            lanes = pixel[part], window[part].astype(np.uint32), times[part]
            others = *flux_inputs(windows, span_us, aimed), known
            inputs = "flux", *lanes, controlled[part], packets[part], stream, *others
            given = lanes, controlled[part], packets[part], moments, key, aimed, known, out, part
            trace = partial(self._trace_block, *given)
            remembered(self._journal, self._run_part + inputs, out, part, trace)
            self._report(int(packets[part].sum()) * PACKET)
        # the mean of the model is known in closed form, and rays had its difference to the scene only
        if edges is not None:
            there = np.flatnonzero(edges.is_there)
            model = edges.part(there).mean
            out.half_a[there] += model
            out.half_b[there] += model
        # a control variate can bring a mean below 0
        if not signed:
            not_negative(out)
        scale = self.axis_factor(pixel)
        out.half_a[:] *= scale
        out.half_b[:] *= scale
        return out

    def pilot(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: int,
        footprint_px: float,
        stream: Stream = Stream.RENDER_PILOT,
        span_us: tuple[float, float] | None = None,
        aims: PairAims | None = None,
        before: tuple[PilotRays, NDArray[np.integer]] | None = None,
        kept: Sequence[Float] | None = None,
        repeat: int = 0,
        mild: bool = False,
        shadows: NDArray[np.uint32] | None = None,
    ) -> PilotFlux:
        """Statistics of a few rays of every listed pair, with random numbers of their own.

        Decisions may depend on these rays without bias, because the final render uses other random numbers [kirk1991].

        Parameters
        ----------
        pixel, window, windows, stream, span_us : see `trace`.
        samples : rays per pair, a power of two, at least `LEAST_SAMPLES`.
        footprint_px : width of the area in which the rays start, pixels.
        aims : small objects at which half of the rays of each pair are aimed; each pair has one or more.
        before : rays of other windows, and [n] the place among them of the same rays as those of each pair: the
            statistics then include the differences.
        kept : [n · samples] each, where the fluxes of single rays are put, by both estimators, e⁻/s on the optical
            axis. They are large, so the journal keeps nothing of such a pass.
        repeat : number of the set of random numbers.
        mild : take the mild scatter, see `PilotFlux`.
        shadows : see `trace`; no pair has any where rays are kept.

        Returns
        -------
        Statistics of the pairs, [n].
        """
        out, packets = PilotFlux.empty(pixel.size, self.has_bounced), np.full(pixel.size, samples // PACKET)
        moments, key = self._moments(windows, span_us), self._key(stream)
        footprint = dr.opaque(jit().Float, footprint_px)
        for part, aimed, known in in_blocks(packets, self._block_rays // PACKET, aims, None, shadows):
            lanes = pixel[part], window[part].astype(np.uint32), np.full(pixel[part].size, repeat, np.uint32)
            compared = None if before is None else (before[0], before[1][part])
            others = () if compared is None else (compared[0].spans_us, compared[1])
            inputs = (
                "pilot",
                *lanes,
                samples,
                footprint_px,
                stream,
                mild,
                *flux_inputs(windows, span_us, aimed),
                *others,
                known,
            )
            given = lanes, moments, key, samples, footprint, aimed, known, out, part, compared, kept, mild
            trace = partial(self._pilot_block, *given)
            remembered(self._journal if kept is None else None, self._run_part + inputs, out, part, trace)
            self._report(lanes[0].size * samples)
        scale = self.axis_factor(pixel)
        for name, values in out.tables.items():
            if name != "met":
                values[:] *= scale
        return out

    def pilot_rays(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: int,
        footprint_px: float,
        span_us: tuple[float, float] | None = None,
        before: tuple[PilotRays, NDArray[np.integer]] | None = None,
        mild: bool = False,
        stream: Stream = Stream.RENDER_PILOT,
    ) -> tuple[PilotFlux, PilotRays]:
        """As `pilot`, and the fluxes of the single rays, to compare the same rays in other windows with."""
        kept, used = [dr.empty(jit().Float, pixel.size * samples) for _ in range(2)], np.unique(window)
        given = pixel, window, windows, samples, footprint_px, stream
        out = self.pilot(*given, span_us=span_us, before=before, kept=kept, mild=mild)
        spans_us = *windows.begin_us[used].tolist(), *windows.end_us[used].tolist()
        return out, PilotRays(kept[0], kept[1], samples, spans_us)

    def _trace_block(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        controlled: NDArray[np.bool_],
        packets: NDArray[np.int64],
        moments: Moments,
        key: UInt64,
        aims: PairAims | PairEdges | None,
        shadows: NDArray[np.uint32] | None,
        out: PairFlux,
        part: slice | NDArray[np.int64],
    ) -> None:
        """Flux of some pairs, each with some packets of rays."""
        types = jit()
        rays = packets * PACKET
        footprint = dr.opaque(types.Float, 1.0)
        controlled_flux, plain_flux, _, met = self._packets_of(
            lanes, packets, rays // 2, moments, key, footprint, aims, shadows=shadows
        ).fluxes
        is_controlled = spread_out(types.UInt32, controlled.astype(np.uint32), pair_of_rays(packets))
        out.put(part, dr.select(is_controlled != 0, controlled_flux, plain_flux), met, packets, PACKET)

    def _pilot_block(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        moments: Moments,
        key: UInt64,
        samples: int,
        footprint: Float,
        aims: PairAims | PairEdges | None,
        shadows: NDArray[np.uint32] | None,
        out: PilotFlux,
        part: slice | NDArray[np.int64],
        before: tuple[PilotRays, NDArray[np.integer]] | None,
        kept: Sequence[Float] | None,
        mild: bool,
    ) -> None:
        """Statistics of some pairs, each with the same number of rays, and their single rays where they are kept."""
        packets = np.full(lanes[0].size, samples // PACKET)
        # all rays belong to the first half
        given = lanes, packets, packets * PACKET, moments, key, footprint, aims
        of_rays = self._packets_of(*given, shadows=shadows)
        traced, alike = of_rays.fluxes, samples if aims is None else samples // 2
        # rays that are aimed are a kind of their own: their mean differs from that of the others
        out.put(part, *traced, samples, alike, before, mild, of_rays.bounced)
        if kept is not None and isinstance(part, slice):
            types = jit()
            place = dr.opaque(types.UInt32, part.start * samples) + dr.arange(types.UInt32, len(traced[0]))
            for values, flux in zip(kept, traced[:2], strict=True):
                dr.scatter(values, flux, place)
            dr.eval(kept)

"""Flux of (pixel, time window) pairs in any order. Each ray has its own instant inside the window of its pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, Mask, MitsubaObject, UInt32, UInt64
from hesim_render.core.rng import Stream, stream_key
from hesim_render.core.tables import spread_out
from hesim_render.sensor import lens as optics
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, PilotFlux
from hesim_render.sources.render.change_driven.windows import Moments, Windows
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.tracer import BLOCK_RAYS, Tracer
from hesim_render.sources.render.transport.matt import MattIntegrator
from hesim_render.sources.render.transport.motion_bounds import stays_in
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.paths import PathIntegrator
from hesim_render.sources.scene import Scene
from hesim_render.spectral.spectrum import Spectrum

#: Least and largest number of rays of a pair; one kernel serves all numbers at once.
LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
_PACKET = LEAST_SAMPLES


class PairTracer(Tracer):
    """Traces paths from mosaic pixels into a `MovingScene`.

    Random numbers are a pure function of (seed, stream, pixel on the full sensor, half, sample), the same in every
    window, so a pixel whose paths no object crosses is exactly constant. Pixels are identified by their number on the
    full sensor, so a crop has the values of the full sensor to the bit.

    Parameters
    ----------
    scene, sensor, responses, progress, block_rays : see `Tracer`.
    seed : seed of the run.

    Raises
    ------
    SpecError
        If the scene cannot be loaded, does not cover a response, or needs the exact mode.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        seed: int,
        responses: dict[str, Spectrum],
        progress: Callable[[int], None] | None = None,
        block_rays: int = BLOCK_RAYS,
    ) -> None:
        super().__init__(scene, sensor, responses, progress, block_rays)
        import drjit as dr

        types = jit()
        self._seed = seed
        self.parts = MovingScene(self.built)
        self._integrator: MattIntegrator | PathIntegrator
        if self.built.paints is not None:
            self._integrator = MattIntegrator(self.parts, self.built.paints, scene.spec.lights, self.sensor.responses)
        else:
            depth, roulette = (_told(self.built.integrator, name) for name in ("max_depth", "rr_depth"))
            self._integrator = PathIntegrator(self.parts, depth, roulette, WavelengthSampler(self.sensor.responses))
        self._boxes = lru_cache(maxsize=8)(self._boxes_in)
        layout = self.sensor.layout
        tile = np.array(layout.filter_index[: layout.tile_shape[0], : layout.tile_shape[1]], np.uint32)
        self._filter_tile = types.UInt32(tile.ravel())
        self._tile_rows, self._tile_cols = (dr.opaque(types.UInt32, count) for count in layout.tile_shape)
        dr.make_opaque(self._filter_tile)

    @property
    def is_matt(self) -> bool:
        """True if all visible light is direct light on matt surfaces."""
        return isinstance(self._integrator, MattIntegrator)

    def trace(
        self,
        pixel: NDArray[np.uint32],
        window: NDArray[np.integer],
        windows: Windows,
        samples: NDArray[np.integer],
        lit: NDArray[np.bool_],
        stream: Stream = Stream.RENDER,
        span_us: tuple[float, float] | None = None,
        repeat: int = 0,
    ) -> PairFlux:
        """Flux of every listed pair.

        Parameters
        ----------
        pixel : [n], number on the full sensor.
        window : [n], number of the window among `windows`.
        windows : the windows.
        samples : [n], rays per pair, a power of two from `LEAST_SAMPLES` to `MOST_SAMPLES`.
        lit : [n], True takes the lit estimator, False the hidden one, see `MattIntegrator`.
        stream : stream of random numbers.
        span_us : interval in which `PairFlux.met` tests for moving objects, µs; default: the windows themselves.
        repeat : number of the repetition; each has its own random numbers.

        Returns
        -------
        Flux of the pairs, [n].
        """
        out = PairFlux(
            np.empty(pixel.size, np.float32), np.empty(pixel.size, np.float32), np.empty(pixel.size, np.bool_)
        )
        packets = (samples // _PACKET).astype(np.int64)
        ends = np.cumsum(packets)
        moments = self._moments(windows, span_us)
        key = self._key(stream, repeat)
        first = 0
        while first < pixel.size:
            done = int(ends[first - 1]) if first else 0
            last = int(np.searchsorted(ends, done + self._block_rays // _PACKET, side="right"))
            part = slice(first, last)
            lanes = [pixel[part], window[part].astype(np.uint32), lit[part].astype(np.uint32)]
            self._trace_block(lanes, packets[part], moments, key, out, part)
            self._report((int(ends[last - 1]) - done) * _PACKET)
            first = last
        # the lit estimate of a dark pixel may be negative; a flux is not
        below = np.minimum(out.mean, 0)
        scale = self._scale(pixel)
        half_a = out.half_a - below
        out.half_b[:] = scale * np.maximum(out.half_b - below, -half_a)
        out.half_a[:] = scale * half_a
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
    ) -> PilotFlux:
        """Statistics of a few rays of every listed pair, with random numbers of their own.

        Decisions may depend on these rays without bias, because the final render uses other random numbers [kirk1991].

        Parameters
        ----------
        pixel, window, windows, stream, span_us : see `trace`.
        samples : rays per pair, a power of two.
        footprint_px : width of the area in which the rays start, pixels.

        Returns
        -------
        Statistics of the pairs, [n].
        """
        import drjit as dr

        count = pixel.size
        lit, hidden, unshadowed, *scatters = (np.empty(count, np.float32) for _ in range(5))
        out = PilotFlux(lit, hidden, unshadowed, scatters[0], scatters[1], np.empty(count, np.bool_))
        moments, key = self._moments(windows, span_us), self._key(stream)
        footprint = dr.opaque(jit().Float, footprint_px)
        room = max(1, self._block_rays // samples)
        for first in range(0, count, room):
            part = slice(first, min(count, first + room))
            self._pilot_block(pixel[part], window[part].astype(np.uint32), moments, key, samples, footprint, out, part)
            self._report((part.stop - first) * samples)
        scale = self._scale(pixel)
        for values in (out.lit, out.hidden, out.unshadowed, out.lit_scatter, out.hidden_scatter):
            values *= scale
        return out

    def least_distance_m(self, t_us: float, grid: tuple[int, int] = (24, 32)) -> float:
        """Least depth of the resting surfaces in view, over an even grid of the picture, m.

        Depth is measured along the camera's axis. It is infinite where nothing is seen.
        """
        import drjit as dr

        mitsuba()
        mi, types, geometry = self.built.mi, jit(), self.sensor.spec.geometry
        left, right, top, bottom = self.view.followed_mm
        x = left + (np.arange(grid[1]) + 0.5) / grid[1] * (right - left)
        y = top + (np.arange(grid[0]) + 0.5) / grid[0] * (bottom - top)
        pitch_mm = geometry.pitch_um * 1e-3
        row = np.repeat(y / pitch_mm + (geometry.rows - 1) / 2, grid[1])
        col = np.tile(x / pitch_mm + (geometry.cols - 1) / 2, grid[0])
        middle = types.Float(0.5), types.Float(0.5)
        rows, cols = (types.Float(values.astype(np.float32)) for values in (row, col))
        origin, direction = self._rays.rays(rows, cols, middle, None)
        axis = -self.view.camera_to_world[:3, 2]
        if self.camera is not None:
            matrix = self.camera.matrix(t_us)
            axis = matrix[:3, :3] @ axis
            pose = self.camera.pose_at(types.Float(float(self.camera.local_us(t_us))))
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
        far = self.parts.resting_distance(ray)
        return float(dr.min(far * dr.dot(ray.d, mi.Vector3f(axis)))[0])

    def _key(self, stream: Stream, repeat: int = 0) -> UInt64:
        import drjit as dr

        mitsuba()  # the variant may have been changed by other code
        key = stream_key(self._seed, stream)
        return dr.opaque(jit().UInt64, stream_key(key + repeat, stream) if repeat else key)

    def _scale(self, pixel: NDArray[np.uint32]) -> NDArray[np.float32]:
        """Factor from the flux on the optical axis to that of each pixel."""
        row, col = np.divmod(pixel.astype(np.int64), self.sensor.spec.geometry.cols)
        return optics.relative_illumination_at(self.sensor.spec, self.sensor.lens, row, col) * np.float32(
            self.radiance_scale
        )

    def _moments(self, windows: Windows, span_us: tuple[float, float] | None) -> Moments:
        """Windows on the device, with the boxes that contain each object during each window, or during all of
        `span_us`.
        """
        groups = self.parts.groups
        tracks = [group.trajectory for group in groups] + ([self.camera] if self.camera else [])
        return Moments.of(windows, span_us, tracks, len(groups), self._boxes)

    def _boxes_in(self, spans_us: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
        """Boxes that contain each group during some intervals, [interval, group, 2, 3], m."""
        found = [stays_in(group.corners, group.trajectory, spans_us) for group in self.parts.groups]
        return np.stack(found, axis=1) if found else np.empty((len(spans_us), 0, 2, 3))

    def _trace_block(
        self,
        lanes: Sequence[NDArray[np.uint32]],
        packets: NDArray[np.int64],
        moments: Moments,
        key: UInt64,
        out: PairFlux,
        part: slice,
    ) -> None:
        """Trace some pairs in packets of `_PACKET` rays."""
        import drjit as dr

        types = jit()
        used = int(packets.sum())
        starts = np.cumsum(packets) - packets
        pair = np.repeat(np.arange(packets.size, dtype=np.uint32), packets)
        within = (np.arange(used) - np.repeat(starts, packets)).astype(np.uint32)
        half_rays = np.repeat((packets * (_PACKET // 2)).astype(np.uint32), packets)

        ray_index = dr.arange(types.UInt32, used * _PACKET)
        packet = ray_index // _PACKET
        sample = spread_out(types.UInt32, within, packet) * _PACKET + ray_index - packet * _PACKET
        per_half = spread_out(types.UInt32, half_rays, packet)
        half = dr.select(sample >= per_half, types.UInt32(1), types.UInt32(0))
        pixel, window, lit = (spread_out(types.UInt32, values[pair], packet) for values in lanes)
        self._sampler.setup(key, pixel, half, sample - half * per_half, per_half, MOST_SAMPLES // 2)
        if_lit, if_hidden, _, met = self._rays_of(pixel, window, moments, types.Float(1.0))
        flux = dr.select(lit != 0, if_lit, if_hidden)
        met = _bits(types.UInt32, met, used * _PACKET)
        dr.eval(flux, met)
        self._sampler.rest()
        # sums over half packets: a half of a pair is never smaller
        sums = np.array(dr.block_sum(flux, _PACKET // 2))
        bits = np.array(dr.block_reduce(dr.ReduceOp.Or, met, _PACKET))
        rays = packets * _PACKET
        # a pair of one packet is half a then half b; longer ones have their first packets in half a
        halves = np.add.reduceat(sums.astype(np.float64), np.stack([2 * starts, 2 * starts + packets], axis=1).ravel())
        halves = halves.reshape(-1, 2) / (rays / 2)[:, None]
        out.half_a[part], out.half_b[part] = halves[:, 0], halves[:, 1]
        out.met[part] = np.bitwise_or.reduceat(bits, starts)

    def _pilot_block(
        self,
        pixels: NDArray[np.uint32],
        window: NDArray[np.uint32],
        moments: Moments,
        key: UInt64,
        samples: int,
        footprint: Float,
        out: PilotFlux,
        part: slice,
    ) -> None:
        import drjit as dr

        types = jit()
        rays = dr.opaque(types.UInt32, samples)
        ray_index = dr.arange(types.UInt32, pixels.size * samples)
        lane = ray_index // rays
        pixel, number = spread_out(types.UInt32, pixels, lane), spread_out(types.UInt32, window, lane)
        self._sampler.setup(key, pixel, types.UInt32(0), ray_index - lane * rays, rays, MOST_SAMPLES // 2)
        lit, hidden, unshadowed, met = self._rays_of(pixel, number, moments, footprint)
        bits = _bits(types.UInt32, met, pixels.size * samples)
        dr.eval(lit, hidden, unshadowed, bits)
        self._sampler.rest()
        share, unbiased = dr.opaque(types.Float, 1 / samples), dr.opaque(types.Float, samples / (samples - 1))
        for values, name in ((lit, "lit"), (hidden, "hidden")):
            mean = dr.block_sum(values, samples) * share
            square = dr.square(values - dr.gather(types.Float, mean, lane))
            fourth, second = dr.block_sum(square * square, samples), dr.block_sum(square, samples)
            # these rays are a sample of the scatter in the scene
            scatter = dr.sqrt(dr.select(second > 0, fourth / second, 0.0) * unbiased)
            dr.eval(mean, scatter)
            getattr(out, name)[part], getattr(out, f"{name}_scatter")[part] = np.array(mean), np.array(scatter)
        out.unshadowed[part] = np.array(dr.block_sum(unshadowed, samples) * share)
        out.met[part] = np.array(dr.block_reduce(dr.ReduceOp.Or, bits, samples))

    def _rays_of(
        self, pixel: UInt32, window: UInt32, moments: Moments, footprint: Float
    ) -> tuple[Float, Float, Float, Mask]:
        """The integrator's `flux` of one ray per lane, with the scale of the optical axis."""
        import drjit as dr

        mi, types = self.built.mi, jit()
        row, col = self._row_and_col(pixel)
        sampler = self._sampler
        aperture, moment = sampler.next_3d()
        aperture = (aperture - 0.5) * footprint + 0.5
        blur = sampler.next_2d() if self._rays.has_psf else None
        origin, direction = self._rays.rays(types.Float(row), types.Float(col), aperture, blur)
        now = moments.at(window, moment)
        if self.camera is not None:
            pose = self.camera.pose_at(now.local_us(len(self.parts.groups)))
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        tile_row = row - row // self._tile_rows * self._tile_rows
        tile_col = col - col // self._tile_cols * self._tile_cols
        which = dr.gather(types.UInt32, self._filter_tile, tile_row * self._tile_cols + tile_col)
        primary = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
        return self._integrator.flux(sampler, primary, now, which)


def _bits(kind: type[UInt32], condition: Mask, count: int) -> UInt32:
    """1 where a condition holds, one entry a lane even if it is a single one."""
    import drjit as dr

    return dr.select(condition, kind(1), dr.zeros(kind, count))


def _told(integrator: MitsubaObject, property_name: str) -> int:
    """A depth limit of an integrator, -1 for none. Mitsuba gives it only in the text of the integrator."""
    for line in str(integrator).splitlines():
        name, _, value = line.strip().rstrip(",").partition(" = ")
        if name == property_name:
            depth = int(value)
            return -1 if depth >= 2**31 else depth
    raise AssertionError(f"a path integrator has a {property_name}")

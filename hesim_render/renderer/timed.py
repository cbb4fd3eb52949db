"""Flux of (pixel, time window) pairs in any order: each ray has its own instant inside its pixel's window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.backend import jit
from hesim_render.renderer._mitsuba import mitsuba
from hesim_render.renderer.moving import MovingScene
from hesim_render.renderer.paths import Boxes, PathIntegrator
from hesim_render.renderer.tracer import BLOCK_RAYS, Tracer, spread_out
from hesim_render.renderer.wavelengths import WavelengthSampler
from hesim_render.rng import Stream, stream_key
from hesim_render.scene import Scene
from hesim_render.sensor import Sensor
from hesim_render.spectra import Spectrum

#: Rays of a pair; one kernel serves all their numbers at once.
LEAST_SAMPLES, MOST_SAMPLES = 8, 4096
_PACKET = LEAST_SAMPLES
#: Width of the area in which a pilot's rays start, in pixels: it sees what comes before the pixel does.
PILOT_FOOTPRINT = 1.25


@dataclass(frozen=True)
class PairFlux:
    """What tracing a list of pairs gives, one entry a pair.

    Parameters
    ----------
    half_a, half_b : two independent estimates of the mean flux, e⁻/s, float32.
    scatter : standard deviation of single rays, e⁻/s, float32.
    met : bits of the boxes that any path came near; 0 where none were asked for.
    """

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    scatter: NDArray[np.float32]
    met: NDArray[np.uint32]

    @property
    def mean(self) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a + self.half_b)


@dataclass(frozen=True)
class SweptBoxes:
    """Boxes that hold each group of a scene during some intervals.

    Parameters
    ----------
    swept, present : [intervals, groups, 2, 3], metres: during the interval, and in the windows traced.
    told : [intervals, groups] bool, whether `MET_PASSING` is wanted beside `MET_SWEPT`.
    """

    swept: NDArray[np.float64]
    present: NDArray[np.float64]
    told: NDArray[np.bool_]


class TimedTracer(Tracer):
    """Paths from mosaic pixels into a `MovingScene`.

    Random numbers are a pure function of (seed, pixel on the full sensor, half, sample), the same in
    every window: a pixel whose paths nothing crosses is exactly constant.

    Parameters
    ----------
    scene, sensor, responses, progress, block_rays : see `Tracer`.
    seed : of the run.

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
        import drjit as dr

        super().__init__(scene, sensor, responses, progress, block_rays)
        types = jit()
        self.parts = MovingScene(self.built)
        depths = (_told(self.built.integrator, name) for name in ("max_depth", "rr_depth"))
        self._integrator = PathIntegrator(self.parts, *depths)
        self._keys = [
            dr.opaque(types.UInt64, stream_key(seed, stream)) for stream in (Stream.RENDER, Stream.RENDER_PILOT)
        ]
        self._footprints = [dr.opaque(types.Float, width) for width in (1.0, PILOT_FOOTPRINT)]
        self._wavelengths = WavelengthSampler(self.sensor.responses)
        self._filter = types.UInt32(self.sensor.layout.filter_index.ravel().astype(np.uint32))
        illumination = self.sensor.relative_illumination.ravel() * np.float32(self.radiance_scale)
        self._illumination = types.Float(illumination)

    def trace(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        samples: NDArray[np.integer],
        swept: SweptBoxes | None = None,
        interval: NDArray[np.uint32] | None = None,
        pilot: bool = False,
    ) -> PairFlux:
        """Flux of every listed pair.

        Parameters
        ----------
        pixel, begin_us, end_us : [n], mosaic index and time window.
        samples : [n], rays of each pair, a power of two from `LEAST_SAMPLES` to `MOST_SAMPLES`.
        swept : boxes whose meeting by any path is to be told, and `interval` [n], which set each pair has.
        pilot : take other random numbers and a somewhat larger area, so that what they show may decide about the
            pair.
        """
        import drjit as dr

        self._key, self._footprint = self._keys[pilot], self._footprints[pilot]
        mitsuba()  # the variant may have been changed by other code
        tracks = [group.trajectory for group in self.parts.groups] + ([self.camera] if self.camera else [])
        # wrapped on the host in double precision: float32 µs would lose their fractions within seconds
        lanes = [pixel, (end_us - begin_us).astype(np.float32)]
        for track in tracks:
            local = track.local_us(begin_us) if track.repeat else begin_us - track.knots_us[0]
            lanes.append(local.astype(np.float32))
        tables = None
        if swept is not None and self.parts.groups:
            assert interval is not None
            types = jit()
            corners = np.concatenate([swept.swept, swept.present], axis=2)
            # never one entry, which would be a constant in the kernel
            told = np.append(swept.told.ravel(), False).astype(np.uint32)
            tables = types.Float(corners.astype(np.float32).ravel()), types.UInt32(told)
            dr.make_opaque(*tables)
            lanes.append(interval)
        out = PairFlux(*(np.empty(pixel.size, dtype) for dtype in (np.float32, np.float32, np.float32, np.uint32)))
        packets = (samples // _PACKET).astype(np.int64)
        ends = np.cumsum(packets)
        first = 0
        while first < pixel.size:
            done = int(ends[first - 1]) if first else 0
            last = int(np.searchsorted(ends, done + self._block_rays // _PACKET, side="right"))
            part = slice(first, last)
            self._block([table[part] for table in lanes], packets[part], tables, out, part)
            self._report((int(ends[last - 1]) - done) * _PACKET)
            first = last
        return out

    def motion_px(
        self, pixel: NDArray[np.uint32], begin_us: float, end_us: float
    ) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """How far in the image what each pixel sees at the end of an interval was at its begin, [n] pixels.

        Along the straight line; from the ray through the middle of each pixel. 0 where it sees nothing. And what
        that is: 0 for anything at rest, else the number of the group, from 1.
        """
        import drjit as dr

        mi, types = mitsuba(), jit()
        out, who = np.zeros(pixel.size, np.float32), np.zeros(pixel.size, np.uint32)
        tracks = [group.trajectory for group in self.parts.groups] + ([self.camera] if self.camera else [])
        local = [[types.Float(np.float32(track.local_us(t))) for track in tracks] for t in (begin_us, end_us)]
        for values in local:
            dr.make_opaque(*values)
        count = len(self.parts.groups)
        for first in range(0, pixel.size, self._block_rays):
            part = pixel[first : first + self._block_rays]
            listed = spread_out(types.UInt32, part, dr.arange(types.UInt32, part.size))
            row, column = self._row_and_col(listed)
            col = types.Float(column)
            middle = types.Float(0.5), types.Float(0.5)
            origin, direction = self._rays.rays(types.Float(row), col, middle, None)
            then, now = ([track.pose_at(t) for track, t in zip(tracks, times, strict=True)] for times in local)
            if self.camera is not None:
                origin, direction = now[count].to_world(origin), now[count].turn_to_world(direction)
            ray = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction))
            point, seen, group = self.parts.place_before(ray, now[:count], then[:count])
            if self.camera is not None:
                point = then[count].to_rest(point)
            place = self._rays.project(point)
            far = dr.sqrt(dr.square(place[0] - col) + dr.square(place[1] - types.Float(row)))
            far = dr.select(seen & dr.isfinite(far), far, 0.0)
            dr.eval(far, group)
            out[first : first + part.size] = np.array(far)
            who[first : first + part.size] = np.array(group)
        return out, who

    def _block(self, lanes: list[NDArray], packets: NDArray[np.int64], tables: Any, out: PairFlux, part: slice) -> None:
        """Trace some pairs, packet after packet of `_PACKET` rays."""
        import drjit as dr

        types = jit()
        used = int(packets.sum())
        starts = np.cumsum(packets) - packets
        pair = np.repeat(np.arange(packets.size, dtype=np.uint32), packets)
        within = (np.arange(used) - np.repeat(starts, packets)).astype(np.uint32)
        half_rays = np.repeat((packets * (_PACKET // 2)).astype(np.uint32), packets)

        def by_ray(table: NDArray) -> Any:
            return spread_out(types.UInt32 if table.dtype == np.uint32 else types.Float, table, packet)

        ray_index = dr.arange(types.UInt32, used * _PACKET)
        packet = ray_index // _PACKET
        sample = by_ray(within) * _PACKET + ray_index - packet * _PACKET
        per_half = by_ray(half_rays)
        half = dr.select(sample >= per_half, types.UInt32(1), types.UInt32(0))
        pixel, span, *rest = (by_ray(table[pair]) for table in lanes)
        flux, met = self._rays_of(pixel, half, sample - half * per_half, per_half, span, rest, tables)
        squares = flux * flux
        # the rays first, in one kernel; then sums within halves of packets, the smallest half there is
        dr.eval(flux, squares, met)
        sums = np.array(dr.block_sum(flux, _PACKET // 2))
        squares = np.array(dr.block_sum(squares, _PACKET))
        bits = np.array(dr.block_reduce(dr.ReduceOp.Or, met, _PACKET))
        rays = packets * _PACKET
        # a pair of one packet is half a then half b; longer ones have their first packets in half a
        halves = np.add.reduceat(sums.astype(np.float64), np.stack([2 * starts, 2 * starts + packets], axis=1).ravel())
        halves = halves.reshape(-1, 2) / (rays / 2)[:, None]
        out.half_a[part], out.half_b[part] = halves[:, 0], halves[:, 1]
        mean = halves.mean(axis=1)
        variance = np.maximum(np.add.reduceat(squares.astype(np.float64), starts) / rays - mean * mean, 0.0)
        out.scatter[part] = np.sqrt(variance * (rays / (rays - 1)))
        out.met[part] = np.bitwise_or.reduceat(bits, starts)

    def _rays_of(
        self, pixel: Any, half: Any, sample: Any, per_half: Any, span: Any, rest: list[Any], tables: Any
    ) -> tuple[Any, Any]:
        """Flux and bits of one ray per lane."""
        import drjit as dr

        mi, types = self.built.mi, jit()
        row, col = self._row_and_col(pixel)
        sampler = self._sampler
        sampler.setup(self._key, self._index(row, col), half, sample, per_half, MOST_SAMPLES // 2)
        (aperture, moment), choice = sampler.next_3d(), sampler.next_1d()
        aperture = (aperture - 0.5) * self._footprint + 0.5
        blur = sampler.next_2d() if self._rays.has_psf else None
        origin, direction = self._rays.rays(types.Float(row), types.Float(col), aperture, blur)
        instant = moment * span
        groups = self.parts.groups
        poses = [group.trajectory.pose_at(t + instant) for group, t in zip(groups, rest, strict=False)]
        if self.camera is not None:
            pose = self.camera.pose_at(rest[len(groups)] + instant)
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        boxes = _boxes_of(mi, tables, rest[-1], len(groups)) if tables is not None else None
        which = dr.gather(types.UInt32, self._filter, pixel)
        bands = mi.UnpolarizedSpectrum(*self._wavelengths.sample(which, choice))
        primary = mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction), mi.Float(0.0), bands)
        radiance, met = self._integrator.sample(sampler, primary, poses, boxes)
        scale = self._wavelengths.total(which) * dr.gather(types.Float, self._illumination, pixel)
        # not dr.mean, which has the number of lanes in the kernel: each new one would compile
        return dr.sum(radiance) / len(radiance) * scale, met


def _boxes_of(mi: Any, tables: Any, interval: Any, groups: int) -> Boxes:
    import drjit as dr

    corners, told = tables

    def corner(place: Any, number: int) -> Any:
        return mi.Vector3f(*(dr.gather(mi.Float, corners, place * 12 + number * 3 + k) for k in range(3)))

    places = [interval * groups + number for number in range(groups)]
    swept = [(corner(place, 0), corner(place, 1)) for place in places]
    present = [(corner(place, 2), corner(place, 3)) for place in places]
    return Boxes(swept, present, [dr.gather(mi.UInt32, told, place) != 0 for place in places])


def _told(integrator: Any, property_name: str) -> int:
    """A depth that an integrator was given, -1 for none; Mitsuba tells it only in words."""
    for line in str(integrator).splitlines():
        name, _, value = line.strip().rstrip(",").partition(" = ")
        if name == property_name:
            depth = int(value)
            return -1 if depth >= 2**31 else depth
    raise AssertionError(f"a path integrator has a {property_name}")

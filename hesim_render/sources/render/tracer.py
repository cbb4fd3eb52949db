"""Paths from mosaic pixels into the scene, in blocks that bound memory."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit, select
from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Halves, UInt32, UInt64
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host, spread_out
from hesim_render.core.journal import Journal, key_of
from hesim_render.core.rng import Stream, stream_key
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.render.primary_rays import RayFactory
from hesim_render.sources.render.sampling.sampler import sampler_class
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.scene.parents import camera_trajectory
from hesim_render.sources.scene import Scene
from hesim_render.spectral.spectrum import Spectrum

#: Number of rays traced at a time on the CPU, to bound memory.
BLOCK_RAYS = 1 << 20
#: The same on a GPU, which a million rays keep busy for less time than the host takes to launch them.
_GPU_BLOCK_RAYS = 1 << 22


def rays_at_once() -> int:
    """Number of rays that are traced at a time on the selected backend. No value depends on it."""
    return _GPU_BLOCK_RAYS if select().backend == "cuda" else BLOCK_RAYS


#: (mosaic index, u in [0, 1)) → the four wavelengths of a ray, nm.
Wavelengths = Callable[[UInt32, Float], list[Float]]
#: (mosaic index, radiance at those four) → the quantities to average.
Values = Callable[[UInt32, Bands], list[Float]]


class Tracer:
    """A scene, a placed camera and the pixels of its sensor: the common part of the tracers of both modes.

    Parameters
    ----------
    scene, sensor : the scene and the sensor that sees it.
    responses : spectra that the scene must cover.
    progress : called with the number of rays traced so far, after each block.
    block_rays : largest number of rays traced at a time; None takes `rays_at_once`.

    Attributes
    ----------
    built, view : the scene in Mitsuba, the placed camera.
    sensor : the sensor, with the lens in use.
    camera : trajectory of the camera, None if it rests.
    radiance_scale : factor from the scene's own radiance to W m⁻² sr⁻¹ nm⁻¹.
    rays_done : number of rays traced so far.

    Raises
    ------
    SpecError
        If the scene cannot be loaded or does not cover a response.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        responses: Mapping[str, Spectrum],
        progress: Callable[[int], None] | None,
        block_rays: int | None,
    ) -> None:
        mi, types = mitsuba(), jit()
        self.progress, self._block_rays, self.rays_done = progress, block_rays or rays_at_once(), 0
        self._journal: Journal | None = None
        self._run_part: tuple[object, ...] = ()
        scene, _ = in_absolute_light(scene)
        self.built = build(mi, scene.spec, responses)
        self.view = place_camera(scene.spec, sensor, self.built.mitsuba_sensor())
        self.sensor = self.view.sensor
        self.camera = camera_trajectory(scene.spec)
        mitsuba_scene = scene.spec.mitsuba
        self.radiance_scale = 1.0 if mitsuba_scene is None else mitsuba_scene.radiance_scale
        self.rays = RayFactory(self.view)
        self._sampler = sampler_class(mi.variant())()
        self._full_cols = dr.opaque(types.UInt32, self.sensor.spec.geometry.cols)

    def _row_and_col(self, index: UInt32) -> tuple[UInt32, UInt32]:
        """Row and column of a pixel's number on the full sensor, which also keys its random numbers."""
        row = index // self._full_cols
        return row, index - row * self._full_cols

    def go_on(self, journal: Journal, part: int) -> None:
        """Keep what is traced in a journal, and take from it what an interrupted run has traced.

        Parameters
        ----------
        journal : of this run.
        part : number of this tracer among those of the run.
        """
        self._journal, self._run_part = journal, (part,)

    def _report(self, rays: int) -> None:
        self.rays_done += rays
        if self.progress is not None:
            self.progress(self.rays_done)


class PixelTracer(Tracer):
    """Averages over the rays of each pixel. Every pixel has the same number of rays, and objects are at rest.

    Parameters
    ----------
    scene, sensor, responses, progress, block_rays : see `Tracer`.
    samples : rays per pixel, even; one half for each of two independent estimates.
    seed : seed of the run.

    Raises
    ------
    SpecError
        If the scene cannot be loaded or does not cover a response.
    RangeError
        If `samples` is odd, below 2 or larger than a block.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        samples: int,
        seed: int,
        responses: Mapping[str, Spectrum],
        progress: Callable[[int], None] | None = None,
        block_rays: int | None = None,
    ) -> None:
        if samples < 2 or samples % 2:
            raise RangeError("samples", samples, "an even number of rays per pixel, 2 or more")
        most = block_rays or rays_at_once()
        if samples > most:
            raise RangeError("samples", samples, f"at most {most} rays per pixel")
        super().__init__(scene, sensor, responses, progress, most)
        self.samples = samples
        self._full_index = self.sensor.layout.full_index.ravel()
        self._posed_us: float | None = None
        self._key, self._elsewhere_key = (
            dr.opaque(jit().UInt64, stream_key(seed, stream)) for stream in (Stream.RENDER, Stream.RENDER_GLARE)
        )

    @property
    def pixel_count(self) -> int:
        return self.view.sensor.rows * self.view.sensor.cols

    def pose(self, t_us: float) -> None:
        """Put moving objects at their poses of `t_us`."""
        if self.built.moves and t_us != self._posed_us:
            self.built.pose(t_us)
            self._posed_us = t_us

    def trace(
        self,
        pixel: NDArray[np.uint32],
        begin_us: ArrayLike,
        end_us: ArrayLike,
        wavelengths: Wavelengths,
        values: Values,
        elsewhere: NDArray[np.uint32] | None = None,
        name: str = "",
    ) -> list[Halves]:
        """Averages over the rays of each listed pixel. The camera moves through the pixel's own interval.

        Parameters
        ----------
        pixel : [n], mosaic indices.
        begin_us, end_us : [n] or scalar, µs.
        wavelengths : draws the wavelengths of a ray.
        values : map radiance to the quantities to average.
        elsewhere : [n], numbers of pixels on the full sensor, with random numbers of their own, instead of those of the
            region; `pixel` then is their number in this list.
        name : of these averages. The same pixels with other `wavelengths` or `values` need another name, by which the
            journal tells them apart.

        Returns
        -------
        For each of `values`: half_a, half_b, Dr.Jit Float [n] each.

        Raises
        ------
        RangeError
            If a pixel lies outside the region or an interval ends before it begins.
        """
        mitsuba()  # the variant may have been changed by other code
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        full, key = (self._full_index, self._key) if elsewhere is None else (elsewhere, self._elsewhere_key)
        if pixel.size and int(pixel.max()) >= full.size:
            raise RangeError("pixel", int(pixel.max()), f"0 to {full.size - 1}, inside the region")
        if not np.all(end >= begin):
            raise RangeError("end_us - begin_us", float(np.min(end - begin)), "0 or more")
        times = None
        if self.camera is not None:
            # repeated tracks are wrapped on the host in float64, per pixel, so that rounding does not depend on others
            local = self.camera.local_us(begin) if self.camera.repeat else begin - self.camera.knots_us[0]
            times = [np.broadcast_to(v, pixel.shape).astype(np.float32) for v in (local, end - begin)]
        parts: list[list[Halves]] = []
        room = self._block_rays // self.samples
        for first in range(0, pixel.size, room):
            part = slice(first, first + room)
            spread = None if times is None else [values[part] for values in times]
            inputs = name, self._posed_us, elsewhere is None, pixel[part], full[pixel[part]], *(spread or ())
            trace = partial(self._block, pixel[part], full[pixel[part]], key, spread, wavelengths, values)
            parts.append(self._remembered(inputs, trace))
            self._report(pixel[part].size * self.samples)
        if len(parts) == 1:
            return parts[0]
        channels = range(len(parts[0]))
        return [(dr.concat([p[k][0] for p in parts]), dr.concat([p[k][1] for p in parts])) for k in channels]

    def _remembered(self, inputs: tuple[object, ...], trace: Callable[[], list[Halves]]) -> list[Halves]:
        """Both halves of a few pixels: those of an interrupted run, or new ones, which the journal keeps."""
        if self._journal is None:
            return trace()
        key, kind = key_of(*self._run_part, self.samples, *inputs), jit().Float
        pixels = next(given.size for given in inputs if isinstance(given, np.ndarray))
        known = np.empty((1, 2, pixels), np.float32)
        if self._journal.recall(key, [known]):
            return [(from_host(kind, half_a), from_host(kind, half_b)) for half_a, half_b in known]
        traced = trace()
        self._journal.keep(key, [np.array(half) for halves in traced for half in halves])
        return traced

    def _block(
        self,
        pixels: NDArray[np.uint32],
        full_index: NDArray[np.uint32],
        key: UInt64,
        times: list[NDArray[np.float32]] | None,
        wavelengths: Wavelengths,
        values: Values,
    ) -> list[Halves]:
        """Both halves of a few pixels."""
        types = jit()
        count, per_half = pixels.size, self.samples // 2

        ray = dr.arange(types.UInt32, count * self.samples)
        lane = ray // self.samples
        place = ray - lane * self.samples
        half = dr.select(place >= per_half, types.UInt32(1), types.UInt32(0))
        pixel = spread_out(types.UInt32, pixels, lane)
        index = spread_out(types.UInt32, full_index, lane)
        spread = None if times is None else [spread_out(types.Float, table, lane) for table in times]
        sample = place - half * per_half
        quantities = self._rays_of(pixel, index, half, sample, key, spread, wavelengths, values)
        sums = [dr.block_sum(quantity, per_half) * (1 / per_half) for quantity in quantities]
        dr.eval(*sums)
        self._sampler.rest()
        first = dr.arange(types.UInt32, count) * 2
        halves = [(dr.gather(types.Float, s, first), dr.gather(types.Float, s, first + 1)) for s in sums]
        dr.eval(halves)
        return halves

    def _rays_of(
        self,
        pixel: UInt32,
        index: UInt32,
        half: UInt32,
        sample: UInt32,
        key: UInt64,
        spread: list[Float] | None,
        wavelengths: Wavelengths,
        values: Values,
    ) -> list[Float]:
        """The wanted quantities of one ray per lane."""
        mi, types = self.built.mi, jit()
        row, col = self._row_and_col(index)
        sampler = self._sampler
        sampler.setup(key, index, half, sample, self.samples // 2)
        aperture, moment = sampler.start_3d()
        blur = self.rays.blur_numbers(sampler)
        choice, single = sampler.next_1d(), None
        place = types.Float(col), types.Float(row)
        offset = self.rays.offset(aperture, blur, place)
        if self.rays.is_dispersive:
            # a single wavelength from the law of all four: the k-th one belongs to the k-th quarter of the numbers
            quarter = types.UInt32(choice * 4)
            four = wavelengths(pixel, choice * 4 - types.Float(quarter))
            single = four[3]
            for k in range(3):
                single = dr.select(quarter == k, four[k], single)
            offset = self.rays.diffracted(sampler, *offset, single)
        origin, direction, weight = self.rays.through_lens(place, offset, sampler, single)
        if spread is not None:
            assert self.camera is not None
            pose = self.camera.pose_at(spread[0] + moment * spread[1])
            origin, direction = pose.to_world(origin), pose.turn_to_world(direction)
        bands = mi.UnpolarizedSpectrum(*(wavelengths(pixel, choice) if single is None else [single] * 4))
        primary = mi.RayDifferential3f(mi.Point3f(*origin), mi.Vector3f(*direction), mi.Float(0.0), bands)
        radiance, _, _ = self.built.integrator.sample(self.built.scene, sampler, primary)
        if weight is not None:
            radiance = radiance * weight
        return values(pixel, radiance)

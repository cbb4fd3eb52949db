"""The exact mode of the renderer as a source of flux: Φ of any mosaic pixels over any time slice."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Halves, UInt32
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress
from hesim_render.mosaic.layout import Layout
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.render.glare import VeilingGlare
from hesim_render.sources.render.renderer import reported
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.timeline import Timeline
from hesim_render.sources.render.tracer import PixelTracer
from hesim_render.sources.renderer import Demand, Estimate
from hesim_render.sources.scene import Scene
from hesim_render.sources.still import WindowByWindow
from hesim_render.spectral.spectrum import Spectrum

#: Largest motion of an object within a slice, pixels.
MAX_MOTION_PX = 0.5
#: Exposures whose slices are counted for the estimate; pixels that are rendered to find the speed, at most.
_EXPOSURES, _PIXELS = 16, 16384
#: Memory of the program with its kernels, and per pixel of the mosaic, bytes.
_BASE_BYTES, _PIXEL_BYTES = 0.6e9, 110


def used_responses(sensor: Sensor) -> dict[str, Spectrum]:
    """Responses of the filters that occur in the tile, by name."""
    spec = sensor.spec
    used = {spec.pixels[letter].filter for letter in "".join(spec.tile_rows)}
    return {name: response for name, response in sensor.responses.items() if name in used}


def require_finite(half_a: Float, half_b: Float, scene: Scene, layout: Layout, pixel: NDArray[np.uint32]) -> None:
    """Refuse flux that is NaN or infinite.

    Parameters
    ----------
    half_a, half_b : Dr.Jit Float [n], flux, e⁻/s.
    scene : for the error message.
    layout, pixel : the region, and [n] mosaic indices in it.

    Raises
    ------
    SpecError
        Names the scene file and the first such pixel.
    """
    if np.isfinite(dr.sum(half_a)[0]) and np.isfinite(dr.sum(half_b)[0]):
        return  # transfers one number to the host, not one per pixel
    both = np.array(half_a) + np.array(half_b)
    wrong = np.flatnonzero(~np.isfinite(both))
    if wrong.size:
        row, col = divmod(int(pixel[wrong[0]]), layout.cols)
        raise SpecError(
            f"scene {scene.name!r} has a radiance that is not finite ({both[wrong[0]]}), seen by {wrong.size} of "
            f"{both.size} pixels, the first in row {row}, column {col} of the region: check its emitters and materials",
            file=scene.spec.file,
        )


def timeline_of(tracer: PixelTracer, max_motion_px: float = MAX_MOTION_PX) -> Timeline:
    """Slices of the scene of a tracer, in each of which objects stand still."""
    built = tracer.built
    corners = {name: np.concatenate([s.corners for s in built.groups[name]]) for name in built.trajectories}
    return Timeline(
        tracer.view, tracer.camera, built.trajectories, corners, built.corners, max_motion_px,
        deformations=built.deformations,
    )  # fmt: skip


class RenderedFlux(WindowByWindow):
    """Φ = V(x) · ∫ L(x, t, λ) R(λ) dλ in e⁻/s, by path tracing; implements `FluxSource`.

    R = A_pix·FF·G·τ_lens·C_f·η·λ/(hc) with G = π/(1 + 4N²(1 + |m|)²) is the pixel's own response. L is
    averaged over the whole pixel pitch (a box) after the lens, and over the time interval if the camera moves; a part
    of the light may be spread over the sensor (`VeilingGlare`). Objects stand still within a slice
    (`slice_edges_us`), at the pose of its middle.

    Where the lens has no depth of field, it is a pinhole at the entrance pupil. Random numbers are a pure
    function of (seed, pixel on the full sensor, sample). They do not depend on chunks, order, crop or time.

    Parameters
    ----------
    scene, sensor : the scene and the sensor that sees it; a scene may replace focal length, f-number and focus.
    samples : rays per pixel and call, even; one half of them makes `half_a`, the other `half_b`.
        Powers of two stratify best.
    seed : seed of the run.
    max_motion_px : largest motion of an object within a slice, pixels.
    progress : called with the number of rays traced so far, after each block.
    block_rays : largest number of rays that are traced at a time; None takes `rays_at_once`.
    because : why the scene needs this mode, where nobody asked for it.

    Attributes
    ----------
    sensor : the sensor, with the lens in use.
    view : the placed camera.
    is_static : True where nothing moves.

    Raises
    ------
    SpecError
        If the scene cannot be loaded or does not cover a filter's response; later, if its radiance is not finite.
    RangeError
        If `samples` is odd or below 2, or `max_motion_px` is not above 0.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        samples: int = 16,
        seed: int = 0,
        *,
        max_motion_px: float = MAX_MOTION_PX,
        progress: Callable[[int], None] | None = None,
        block_rays: int | None = None,
        because: str | None = None,
    ) -> None:
        if not max_motion_px > 0:
            raise RangeError("max_motion_px", max_motion_px, "a distance above 0")
        self.scene, self.samples, self.seed, self._because = scene, samples, seed, because
        self._tracer = PixelTracer(scene, sensor, samples, seed, used_responses(sensor), progress, block_rays)
        self.view = self._tracer.view
        self.sensor = self.view.sensor
        self._timeline = timeline_of(self._tracer, max_motion_px)
        self.is_static = not self._tracer.built.moves and self._tracer.camera is None
        types = jit()
        self._wavelengths = WavelengthSampler(self.sensor.responses)
        self._filter = from_host(types.UInt32, self.sensor.layout.filter_index)
        illumination = self.sensor.relative_illumination.ravel() * np.float32(self._tracer.radiance_scale)
        self._illumination = from_host(types.Float, illumination)
        self._glare: VeilingGlare | None = None
        if self.sensor.optics.veiling_glare > 0 and not self._tracer.built.is_dark:
            filters = np.unique(self.sensor.layout.filter_index).tolist()
            self._glare = VeilingGlare(self._tracer, self._wavelengths, filters, seed)

    # ---- as a `SceneRenderer` ---------------------------------------------------------------------

    #: All pixels get the same number of rays, whatever error that has; nothing is rendered again.
    quality: None = None
    auditable: None = None

    @property
    def settings(self) -> dict[str, object]:
        """See `Renderer.settings`."""
        because = {} if self._because is None else {"exact_because": self._because}
        return {**because, "mode": "exact", "samples": self.samples}

    @property
    def work(self) -> dict[str, float]:
        """Nothing: the work follows from the number of rays."""
        return {}

    def estimate(self, demand: Demand, progress: Progress | None = None) -> Estimate:
        """Rays by count, their speed from a few of them; see `Renderer.estimate`."""
        events, exposures = demand.event_pixel.size, demand.exposures
        if self.is_static:
            values = float(demand.pixels.size)
        else:
            values = events * demand.blocks.windows
            if exposures:
                some = [exposures[k] for k in np.unique(np.linspace(0, len(exposures) - 1, _EXPOSURES).astype(int))]
                # a rolling shutter exposes a row in only some of the slices of its frame
                slices = [
                    1 + len(self.slice_edges_us(e.start_us, e.end_us)) * e.exposure_us / (e.end_us - e.start_us)
                    for e in some
                ]
                values += demand.frame_pixel.size * len(exposures) * float(np.mean(slices))
        rays, ray_s = values * self.samples, 1 / self._rays_per_second(demand.pixels)
        return Estimate(
            seconds=rays * ray_s,
            peak_bytes=_BASE_BYTES + _PIXEL_BYTES * (demand.frame_pixel.size + events),
            rays=rays,
            ray_s=ray_s,
        )

    def _rays_per_second(self, every: NDArray[np.uint32]) -> float:
        """Speed of a small picture; a first one compiles the kernels, which the run needs as well."""
        count = min(every.size, max(1, _PIXELS // max(1, self.samples // 16)))
        if count == 0:
            return float("inf")
        pixel = every[np.linspace(0, every.size - 1, count).astype(int)]
        begin, end = np.zeros(count), np.full(count, 1.0)
        seconds = 1.0
        for _ in range(2):
            start = time.perf_counter()
            dr.eval(*self.mean_flux(pixel, begin, end))
            dr.sync_thread()
            seconds = time.perf_counter() - start
        return count * self.samples / max(seconds, 1e-6)

    def report(self, demand: Demand, expected: Estimate | None, progress: Progress) -> None:
        """See `Renderer.report`."""
        if self.is_static:
            self._tracer.progress = reported(progress, float(demand.pixels.size * self.samples))

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """See `Tracer.go_on`."""
        self._tracer.go_on(journal, part)

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval at which moving objects take their next pose, µs."""
        return self._timeline.edges_us(begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow all motion, including that of the camera, µs."""
        return self._timeline.sample_times_us(begin_us, end_us)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval; see `FluxSource.mean_flux`.

        Raises
        ------
        RangeError
            If a pixel lies outside the region or an interval ends before it begins.
        """
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        if pixels.size == 0 or self._tracer.built.is_dark:
            zeros = dr.zeros(jit().Float, pixels.size)
            return zeros, dr.zeros(jit().Float, pixels.size)
        pose_us = self._timeline.pose_time_us(float(np.min(begin_us)), float(np.max(end_us)))
        self._tracer.pose(pose_us)
        ((half_a, half_b),) = self._tracer.trace(pixels, begin_us, end_us, self._choose, self._weigh)
        if self._glare is not None:
            part = self.sensor.optics.veiling_glare
            begin, end = (np.broadcast_to(np.asarray(v, dtype=np.float64), pixels.shape) for v in (begin_us, end_us))
            more = self._glare.added(pixels, begin, end, pose_us)
            half_a, half_b = (
                dr.fma(jit().Float(1 - part), own, dr.opaque(jit().Float, part) * even)
                for own, even in zip((half_a, half_b), more, strict=True)
            )
        require_finite(half_a, half_b, self.scene, self.sensor.layout, pixels)
        return half_a, half_b

    def _choose(self, pixel: UInt32, u: Float) -> list[Float]:
        return self._wavelengths.sample(dr.gather(jit().UInt32, self._filter, pixel), u)

    def _weigh(self, pixel: UInt32, radiance: Bands) -> list[Float]:
        """Mean of L times V · ∫R dλ, because wavelengths are distributed as R."""
        types = jit()
        total = self._wavelengths.total(dr.gather(types.UInt32, self._filter, pixel))
        # not dr.mean: it puts the number of lanes into the kernel, so that each new number would compile again
        return [dr.sum(radiance) / len(radiance) * total * dr.gather(types.Float, self._illumination, pixel)]

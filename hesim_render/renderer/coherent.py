"""The renderer as a source of flux whose cost follows what changes, and whose error follows the sensor's noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.backend import jit
from hesim_render.errors import RangeError
from hesim_render.renderer.adaptive import AdaptiveTracer, NoiseUnit, Pairs, Reached
from hesim_render.renderer.audit import Audit
from hesim_render.renderer.flux import require_finite, used_responses
from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.refinement import Refinement
from hesim_render.renderer.timed import LEAST_SAMPLES, TimedTracer
from hesim_render.renderer.timeline import Timeline
from hesim_render.scene import Scene
from hesim_render.sensor import Sensor
from hesim_render.units import S_PER_US

#: Error of the render over the sensor's noise, unless asked for otherwise.
QUALITY = 0.5
#: A filled-in flux may be off by this many times the wanted error of a rendered one.
TOLERANCE_PER_QUALITY = 3.0
#: Motion between two samples of a sensor without a tick of its own, pixels. ln x is taken as straight between them:
#: the threshold crossings of an edge of contrast 4 are then off by less than 2 % of the time of a tenth of a pixel.
_STEP_PX = 0.05
#: Pixels of a frame that are held at a time.
_PIXELS_AT_ONCE = 1 << 20


class CoherentFlux:
    """Φ in e⁻/s where only what changes is rendered; implements `SampledFlux`.

    The same integral as `RenderedFlux`, with two differences: objects and camera move through every window,
    ray by ray, and each pixel gets as many rays as its own noise asks for. Random numbers are a pure function of
    (seed, pixel on the full sensor, ray), so a pixel near which nothing moves is exactly constant.

    Parameters
    ----------
    scene, sensor : what and through what.
    quality : wanted error of the render over the sensor's noise (temporal; PRNU included for frames; at least
        θ/20 for events).
    seed : of the run.
    progress : called with the number of rays traced so far, after each block.

    Attributes
    ----------
    sensor : with the lens in use.
    view : the placed camera.
    is_static : True where nothing moves.
    audit : what filling in has cost so far.
    adaptive : its `reached` tells the error reached so far.

    Raises
    ------
    SpecError
        If the scene cannot be loaded, does not cover a response, or needs the exact mode.
    RangeError
        If `quality` is not above 0.
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor,
        quality: float = QUALITY,
        seed: int = 0,
        *,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        if not 0 < quality < float("inf"):
            raise RangeError("quality", quality, "a part of the sensor's noise, above 0")
        self.quality, self.seed, self._scene = quality, seed, scene
        self._tracer = TimedTracer(scene, sensor, seed, used_responses(sensor), progress)
        self.view, self.sensor = self._tracer.view, self._tracer.sensor
        self.adaptive = AdaptiveTracer(self._tracer, quality)
        self.audit = Audit(TOLERANCE_PER_QUALITY * quality)
        built, groups = self._tracer.built, self._tracer.parts.groups
        corners = {group.name: group.corners for group in groups}
        self._timeline = Timeline(self.view, self._tracer.camera, built.trajectories, corners, built.corners, _STEP_PX)
        self.is_static = not groups and self._tracer.camera is None
        layout = self.sensor.layout
        self._event_noise = self.sensor.evs if self.sensor.spec.evs is not None else None
        self._frame_noise = self.sensor.aps if self.sensor.spec.aps is not None else None
        self._is_frame = layout.aps_mask.ravel() if self._frame_noise is not None else None
        #: Place on the event grid of each mosaic pixel; of others, the first: crosstalk asks for those.
        self._event_place = np.zeros(layout.rows * layout.cols, dtype=np.int64)
        self._event_place[layout.evs_pixel.ravel()] = np.arange(layout.evs_pixel.size)

    @property
    def progress(self) -> Callable[[int], None] | None:
        """Called with the number of rays traced so far, after each block."""
        return self._tracer.progress

    @progress.setter
    def progress(self, progress: Callable[[int], None] | None) -> None:
        self._tracer.progress = progress

    @property
    def rays_traced(self) -> int:
        return self._tracer.rays_done

    @property
    def _is_dark(self) -> bool:
        return self._tracer.built.is_dark

    def change_of_note(self, pixel: NDArray[np.uint32], flux: NDArray) -> NDArray[np.float64]:
        """Change of a mean flux that has time refined, e⁻/s [n]: the tolerance of the audit, about."""
        return self.audit.tolerance * self._unit(pixel)(flux.astype(np.float64), np.arange(pixel.size))

    def forget(self) -> None:
        """Begin the figures of `adaptive.reached` anew."""
        self.adaptive.reached = Reached()

    def report(self) -> dict[str, Any]:
        """What was reached, for the manifest; plain values."""
        reached = self.adaptive.reached
        return {
            "quality": self.quality,
            "error_rms_noise": reached.rms,
            "pairs_rendered": reached.pairs,
            "pairs_over_quality": reached.over,
            "rays": self.rays_traced,
            "audit": self.audit.as_dict(),
        }

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """None: motion is followed ray by ray."""
        return np.empty(0)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow all motion, the camera's too, µs."""
        return self._timeline.sample_times_us(begin_us, end_us)

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> tuple[Any, Any]:
        """Mean Φ of each listed pixel over its own interval, however long; see `FluxSource.mean_flux`."""
        types = jit()
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        if pixels.size and int(pixels.max()) >= self._event_place.size:
            raise RangeError("pixel", int(pixels.max()), f"0 to {self._event_place.size - 1}, inside the region")
        begin = np.broadcast_to(np.asarray(begin_us, dtype=np.float64), pixels.shape)
        end = np.broadcast_to(np.asarray(end_us, dtype=np.float64), pixels.shape)
        if not np.all(end >= begin):
            raise RangeError("end_us - begin_us", float(np.min(end - begin)), "0 or more")
        halves = np.zeros((2, pixels.size), np.float32)
        if not self._is_dark:
            for first in range(0, pixels.size, _PIXELS_AT_ONCE):
                part = slice(first, first + _PIXELS_AT_ONCE)
                listed = pixels[part]
                pairs = Pairs(listed, begin[part], end[part], np.full(listed.size, LEAST_SAMPLES))
                near = Neighbours(listed, self.sensor.layout.shape)
                result = self.adaptive.render_all(pairs, self._unit(listed), near)
                halves[0, part], halves[1, part] = result.half_a, result.half_b
        half_a, half_b = types.Float(halves[0]), types.Float(halves[1])
        require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
        return half_a, half_b

    def flux_of_windows(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
    ) -> Iterator[tuple[Any, Any]]:
        """Mean Φ of the same pixels in one window after another; see `SampledFlux.flux_of_windows`."""
        types = jit()
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        if pixels.size == 0 or begin.size == 0 or self._is_dark:
            zero = types.Float(np.zeros(pixels.size, np.float32))
            yield from ((zero, zero) for _ in begin)
            return
        unit = self._event_unit(pixels) if self._event_noise is not None else self._unit(pixels)
        work = Refinement(self.adaptive, self._timeline, self.audit, pixels, begin, end, unit, self.seed)
        for halves in work.run():
            half_a, half_b = (types.Float(half) for half in halves)
            require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
            yield half_a, half_b

    def _event_unit(self, pixel: NDArray[np.uint32]) -> NoiseUnit:
        noise = self._event_noise
        assert noise is not None
        place, seconds = self._event_place[pixel], noise.spec.window_us * S_PER_US
        return lambda flux, which: noise.noise_equivalent_e(flux * seconds, place[which]) / seconds

    def _unit(self, pixel: NDArray[np.uint32]) -> NoiseUnit:
        """Noise of frame pixels in a whole exposure, and of event pixels in a window; the smaller, where both."""
        frame, is_frame = self._frame_noise, self._is_frame
        if frame is None or is_frame is None:
            return self._event_unit(pixel)
        framed, microseconds = is_frame[pixel], frame.spec.exposure_us
        seconds = microseconds * S_PER_US
        events = self._event_unit(pixel) if self._event_noise is not None and not framed.all() else None

        def unit(flux: NDArray[np.float64], which: NDArray[np.integer]) -> NDArray[np.float64]:
            noise = frame.noise_equivalent_e(flux * seconds, microseconds) / seconds
            return noise if events is None else np.where(framed[which], noise, events(flux, which))

        return unit

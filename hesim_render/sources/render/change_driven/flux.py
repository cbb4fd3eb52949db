"""Change-driven rendering as a source of flux: its cost follows the changes, its error follows the sensor's noise.

Every decision is a pure function of scene, sensor, seed, quality, window and the pixel's place on the full sensor. A
pilot pass with random numbers of its own (`pilot`) decides how many rays a pair of a pixel and a window gets, and
which windows of a pixel are interpolated (`plan`). Values that were rendered before decide nothing. Cached values save
time only: they would come out the same again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Halves
from hesim_render.core.errors import RangeError
from hesim_render.mosaic.schedule import Block, blocks_of_run
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.protocol import Sample
from hesim_render.sources.render.change_driven.error_target import Noise, Role
from hesim_render.sources.render.change_driven.estimates import Band, Counts, Flux, Still
from hesim_render.sources.render.change_driven.neighbours import REACH, Sites, of_own_row, turns
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.pilot import Pilot, take_pilot
from hesim_render.sources.render.change_driven.plan import Plan, fill_in, plan
from hesim_render.sources.render.change_driven.retrace import traced_again
from hesim_render.sources.render.change_driven.sample_instants import MotionClock
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import require_finite, used_responses
from hesim_render.sources.scene import Scene

#: Default error of the render, as a fraction of the sensor's noise.
QUALITY = 0.5
#: Pixels that are processed at a time, to bound memory.
_BAND_PIXELS = 1 << 17
_ALWAYS_US = (-np.inf, np.inf)


class ChangeDrivenFlux:
    """Φ in e⁻/s, where only changes are rendered; implements `FluxSource`.

    It computes the same integral as `RenderedFlux`, with two differences. Objects and camera move within every window,
    with a time of its own for each ray. Each pixel gets as many rays as its own noise requires. Random numbers are a
    pure function of (seed, pixel on the full sensor, ray), so a pixel near which nothing moves is exactly constant.

    Parameters
    ----------
    scene, sensor : the scene and the sensor that sees it.
    quality : wanted error of the render over the sensor's noise (temporal; with PRNU for frames; at least
        θ/20 for events).
    seed : seed of the run.
    most_power : largest factor by which the flux is multiplied later (largest over mean power of a flickering light).
    progress : called with the number of rays traced so far, after each block.
    tuning : constants of the method.

    Attributes
    ----------
    sensor : the sensor, with the lens in use.
    view : the placed camera.
    is_static : True where nothing moves.
    counts : work done so far.

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
        most_power: float = 1.0,
        progress: Callable[[int], None] | None = None,
        tuning: Tuning = TUNING,
    ) -> None:
        if not 0 < quality < float("inf"):
            raise RangeError("quality", quality, "a part of the sensor's noise, above 0")
        self.quality, self.seed, self._scene, self._tuning = quality, seed, scene, tuning
        self._tracer = PairTracer(scene, sensor, seed, used_responses(sensor), progress)
        self.view, self.sensor = self._tracer.view, self._tracer.sensor
        self._noise = Noise(self.sensor, most_power)
        tracer = self._tracer
        self._clock = MotionClock(self.view, tracer.camera, tracer.parts.groups, tracer.least_distance_m)
        self._zoom = Zoom(self.view, tracer.camera, tracer.parts.groups, tracer.is_matt, tuning)
        self._gain = Gain(*(tuning.matt_gain if tracer.is_matt else tuning.path_gain))
        self.is_static = not self._tracer.parts.groups and self._tracer.camera is None
        self.counts = Counts()
        self._index = self.sensor.layout.full_index.ravel()
        self._kept: dict[Role, Still] = {}

    @property
    def progress(self) -> Callable[[int], None] | None:
        """Called with the number of rays traced so far, after each block."""
        return self._tracer.progress

    @progress.setter
    def progress(self, progress: Callable[[int], None] | None) -> None:
        self._tracer.progress = progress

    @property
    def rays_traced(self) -> int:
        """Number of rays traced so far, pilot passes included."""
        return self._tracer.rays_done

    @property
    def _is_dark(self) -> bool:
        return self._tracer.built.is_dark

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No edges: each ray follows the motion at its own time."""
        return np.empty(0)

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`."""
        return blocks_of_run(self._clock.instants_us, window_us, begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow all motion, including that of the camera, µs."""
        times = self._clock.instants_us(begin_us, end_us).astype(np.float64)
        return times[(times > begin_us) & (times < end_us)]

    # ---- one window of each pixel -----------------------------------------------------------------

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval, however long; see `FluxSource.mean_flux`."""
        types = jit()
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        if pixels.size and int(pixels.max()) >= self._index.size:
            raise RangeError("pixel", int(pixels.max()), f"0 to {self._index.size - 1}, inside the region")
        begin = np.broadcast_to(np.asarray(begin_us, dtype=np.float64), pixels.shape)
        end = np.broadcast_to(np.asarray(end_us, dtype=np.float64), pixels.shape)
        if not np.all(end >= begin):
            raise RangeError("end_us - begin_us", float(np.min(end - begin)), "0 or more")
        flux = Flux.zeros(1, pixels.size)
        if not self._is_dark and pixels.size:
            self._alone(pixels, begin, end, "any", flux)
        half_a, half_b = types.Float(flux.half_a[0]), types.Float(flux.half_b[0])
        require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
        return half_a, half_b

    def _alone(
        self, pixel: NDArray[np.uint32], begin: NDArray[np.float64], end: NDArray[np.float64], role: Role, out: Flux
    ) -> None:
        """Put the flux of listed pixels, each in its own window, into `out` [1, n]. Constant pixels are rendered
        once.
        """
        self.counts.values += pixel.size
        still = self._still_pixels(role)
        known = still.known[pixel]
        out.put(known, still.flux.at(pixel[known]))
        waiting = np.flatnonzero(~known)
        span, number = np.unique(np.stack([begin[waiting], end[waiting]]), axis=1, return_inverse=True)
        windows, number = Windows(span[0], span[1]), number.ravel()
        # neighbours use the window of their own row; a row with several windows is rendered once for each
        turn = turns(pixel[waiting] // self.sensor.cols, number)
        for k in range(int(turn.max(initial=-1)) + 1):
            listed, window = waiting[turn == k], number[turn == k]
            for band in self._bands(pixel[listed], role):
                place, own = listed[band.place], window[band.place]
                numbers = of_own_row(band.sites, own, self.sensor.spec.geometry.cols)[None]
                pilot, near = self._pilot(band, windows, numbers, still.span_us)
                what = plan(
                    pilot, band.sites, band.unit, band.quality, self._gain, self._tuning, is_knot=role == "events"
                )
                flux, met = self._render(band, windows, own[None], what, still.span_us)
                out.put(place, flux)
                if still.span_us is not None:
                    fixed = ~(band.sites.most(near, REACH) | met[0])
                    still.known[pixel[place[fixed]]] = True
                    still.flux.put(pixel[place[fixed]], flux.at(fixed))

    # ---- for the forecast -------------------------------------------------------------------------

    def foretell(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64], role: Role
    ) -> float:
        """Rays per listed pixel for a block of windows without its first one, or for a single window."""
        if self._is_dark or pixel.size == 0:
            return 0.0
        counts, done, windows, rays = replace(self.counts), self._tracer.rays_done, Windows(begin_us, end_us), 0
        later = max(1, windows.size - 1)
        for band in self._bands(pixel, role):
            numbers = np.repeat(np.arange(windows.size)[:, None], band.sites.size, axis=1)
            pilot, near = self._pilot(band, windows, numbers, windows.span_us)
            what = plan(pilot, band.sites, band.unit, band.quality, self._gain, self._tuning, is_knot=role == "events")
            changing = near[band.sites.listed] if windows.size > 1 else np.ones(band.place.size, np.bool_)
            rays += int(np.sum(np.where(what.rendered, what.rays, 0)[-later:], dtype=np.int64))
            rays += band.pilot_rays * later * int(np.count_nonzero(changing))
        self.counts, self._tracer.rays_done = counts, done
        return rays / pixel.size

    def rays_per_second(self) -> float:
        """Measured speed of the tracer on this machine, over pixels from the whole region, rays/s."""
        if self._is_dark:
            return float("inf")
        done = self._tracer.rays_done
        index = self._index[np.linspace(0, self._index.size - 1, min(self._index.size, 8192)).astype(np.int64)]
        window, seconds = Windows(np.zeros(1), np.full(1, 1000.0)), np.inf
        for _ in range(2):  # the first pass compiles the kernel
            start = time.perf_counter()
            where = np.zeros(index.size, np.int64)
            self._tracer.trace(index, where, window, np.full(index.size, 64), np.ones(index.size, np.bool_))
            seconds = time.perf_counter() - start
        self._tracer.rays_done = done
        return 64 * index.size / seconds

    # ---- for the audit ----------------------------------------------------------------------------

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Event pixels [n] that are known to be constant: no moving object can come near them at any time."""
        return self._still_pixels("events").known[pixel]

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """Change of flux equal to one standard deviation of each pixel's noise, at a flux [..., n], e⁻/s."""
        unit = Noise(self.sensor).of("events" if events else "any", self._index[pixel])
        return unit(flux.astype(np.float32)).astype(np.float64)

    def reference_flux(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        events: bool,
    ) -> NDArray[np.float64]:
        """Mean Φ of each listed pixel in its own window, e⁻/s, with a stream of random numbers of its own.

        Parameters
        ----------
        pixel : [n], mosaic indices.
        begin_us, end_us : [n], the windows, µs.
        quality : wanted error over the sensor's noise.
        events : True for the noise of events, False for that of exposures.

        Returns
        -------
        [n], e⁻/s.
        """
        if self._is_dark or pixel.size == 0:
            return np.zeros(pixel.size)
        tuning, index = self._tuning, self._index[pixel]
        unit = self._noise.of("events" if events else "any", index)
        wanted = quality if events else quality / tuning.frame_margin
        return traced_again(self._tracer, index, begin_us, end_us, unit, wanted, self._gain, tuning)

    def _still_pixels(self, role: Role) -> Still:
        if role not in self._kept:
            may_rest = bool(self._tracer.parts.groups) and self._tracer.camera is None
            count = self._index.size
            self._kept[role] = Still(
                _ALWAYS_US if may_rest else None,
                np.zeros(count, np.bool_),
                Flux.zeros(1, count if may_rest else 0),
            )
        return self._kept[role]

    def _bands(self, pixel: NDArray[np.uint32], role: Role) -> Iterator[Band]:
        """The listed pixels in bands of successive rows."""
        index, geometry = self._index[pixel], self.sensor.spec.geometry
        order, apart, tuning = np.argsort(index, kind="stable"), self._noise.is_apart(role), self._tuning
        rays = tuning.lone_pilot_rays if apart else tuning.pilot_rays
        quality = self.quality
        if role == "any":
            rays, quality = tuning.frame_pilot_rays, quality / tuning.frame_margin
        for first in range(0, order.size, _BAND_PIXELS):
            place = order[first : first + _BAND_PIXELS]
            sites = Sites.alone(index[place]) if apart else Sites.around(index[place], geometry.rows, geometry.cols)
            yield Band(place, sites, self._noise.of(role, sites.index), apart, rays, quality)

    def _pilot(
        self,
        band: Band,
        windows: Windows,
        numbers: NDArray[np.int64],
        span_us: tuple[float, float] | None,
    ) -> tuple[Pilot, NDArray[np.bool_]]:
        before, cols = self._tracer.rays_done, self.sensor.spec.geometry.cols
        width = self._tuning.lone_footprint_px if band.apart else self._tuning.footprint_px
        row, col = np.divmod(band.sites.index.astype(np.int64), cols)
        closer = self._zoom.sites(row, col, windows, numbers)
        found = take_pilot(self._tracer, band.sites, windows, numbers, band.pilot_rays, width, span_us, closer)
        self.counts.pilot_rays += self._tracer.rays_done - before
        return found

    def _render(
        self,
        band: Band,
        windows: Windows,
        numbers: NDArray[np.int64],
        what: Plan,
        span_us: tuple[float, float] | None = None,
        first: Flux | None = None,
    ) -> tuple[Flux, NDArray[np.bool_]]:
        """Render the pairs that a plan names.

        Parameters
        ----------
        numbers : [w, n], window number of each pair.
        first : [1, n], flux in the first window, if it is already known.

        Returns
        -------
        flux : [w, n], 0 where nothing was rendered.
        met : [w, n], True if a path came near a moving object in `span_us`; False where nothing was rendered.
        """
        out, met = Flux.zeros(*what.rendered.shape), np.zeros(what.rendered.shape, np.bool_)
        todo = what.rendered.copy()
        if first is not None:
            todo[0] = False
        place = np.nonzero(todo)[1]
        before = self._tracer.rays_done
        got = self._tracer.trace(
            band.index[place], numbers[todo], windows, what.rays[todo], what.lit[todo], span_us=span_us
        )
        self.counts.rays += self._tracer.rays_done - before
        self.counts.pairs += place.size
        out.half_a[todo], out.half_b[todo], met[todo] = got.half_a, got.half_b, got.met
        np.copyto(out.error, what.error)
        if first is not None:
            for values, known in zip(out.arrays, first.arrays, strict=True):
                values[0] = known[0]
        return out, met

    # ---- many windows -----------------------------------------------------------------------------

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`."""
        types = jit()
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        work: _Blocks | None = None
        for block in blocks:
            if pixels.size == 0 or self._is_dark:
                flux = Flux.zeros(block.wanted.size, pixels.size)
                alive = np.arange(pixels.size)
                base = Flux.zeros(1, pixels.size)
            else:
                work = work or _Blocks(self, pixels, block)
                flux, alive, base = work.take(block), work.alive, work.base
            for window in np.flatnonzero(block.wanted):
                self.counts.values += pixels.size
                values = [part[0].copy() for part in base.arrays]
                for whole, part in zip(values, flux.arrays, strict=True):
                    whole[alive] = part[window]
                half_a, half_b = types.Float(values[0]), types.Float(values[1])
                require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
                yield Sample(half_a, half_b, values[2])


class _Blocks:
    """A list of event pixels over successive blocks.

    Parameters
    ----------
    source : source of their flux.
    pixel : [n], mosaic indices.
    first : the first block.

    Attributes
    ----------
    alive : places of the pixels that may change.
    base : [1, n], flux of all pixels in the first window.
    """

    def __init__(self, source: ChangeDrivenFlux, pixel: NDArray[np.uint32], first: Block) -> None:
        self._source = source
        self.base = Flux.zeros(1, pixel.size)
        begin, end = (np.full(pixel.size, times[0]) for times in (first.begin_us, first.end_us))
        source._alone(pixel, begin, end, "events", self.base)
        source.counts.values -= pixel.size
        self.alive = np.flatnonzero(~source._still_pixels("events").known[pixel])
        self._bands = list(source._bands(pixel[self.alive], "events"))
        self._time = float(first.begin_us[0]), float(first.end_us[0])
        self._last = self.base.at(self.alive)

    def take(self, block: Block) -> Flux:
        """Flux of the pixels that may change, [window, alive pixel]."""
        source, windows = self._source, Windows(block.begin_us, block.end_us)
        is_next = self._time == (block.begin_us[0], block.end_us[0])
        out = Flux.zeros(windows.size, self.alive.size)
        centre = 0.5 * (block.begin_us + block.end_us)
        for band in self._bands:
            first = self._last.at(band.place) if is_next else None
            if first is not None and windows.size == 1:
                out.put(band.place, first)
                continue
            numbers = np.repeat(np.arange(windows.size)[:, None], band.sites.size, axis=1)
            pilot, _ = source._pilot(band, windows, numbers, windows.span_us)
            what = plan(pilot, band.sites, band.unit, band.quality, source._gain, source._tuning, is_knot=True)
            numbers = np.repeat(np.arange(windows.size)[:, None], band.place.size, axis=1)
            flux, _ = source._render(band, windows, numbers, what, first=first)
            for values in flux.arrays[:2]:
                fill_in(values, what.rendered, centre)
            fill_in(flux.error, what.rendered, centre)
            out.put(band.place, flux)
        self._time = float(block.begin_us[-1]), float(block.end_us[-1])
        self._last = Flux(*(values[-1:].copy() for values in out.arrays))
        return out

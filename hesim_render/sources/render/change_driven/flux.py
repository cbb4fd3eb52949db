"""The renderer as a source of flux whose cost follows what changes, and whose error follows the sensor's noise.

Every decision is a pure function of scene, sensor, seed, quality, the pixel's place on the full sensor and the window:
a pilot pass with random numbers of its own (`pilot`) says how many rays a pair of a pixel and a window gets, and where
a pixel may be filled in between two windows (`plan`). Nothing that was rendered before decides about anything. What
is kept because it would come out the same again is kept for speed only.
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

#: Error of the render over the sensor's noise, unless asked for otherwise.
QUALITY = 0.5
#: Pixels that are worked on at a time, for bounded memory.
_BAND_PIXELS = 1 << 17
_ALWAYS_US = (-np.inf, np.inf)


class ChangeDrivenFlux:
    """Φ in e⁻/s where only what changes is rendered; implements `FluxSource`.

    The same integral as `RenderedFlux`, with two differences: objects and camera move through every window,
    ray by ray, and each pixel gets as many rays as its own noise asks for. Random numbers are a pure function of
    (seed, pixel on the full sensor, ray), so a pixel near which nothing moves is exactly constant.

    Parameters
    ----------
    scene, sensor : what and through what.
    quality : wanted error of the render over the sensor's noise (temporal; PRNU included for frames; at least
        θ/20 for events).
    seed : of the run.
    most_power : largest factor by which the flux is multiplied afterwards (a flickering light's power over its mean).
    progress : called with the number of rays traced so far, after each block.
    tuning : constants.

    Attributes
    ----------
    sensor : with the lens in use.
    view : the placed camera.
    is_static : True where nothing moves.
    counts : of what was done so far.

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
        return self._tracer.rays_done

    @property
    def _is_dark(self) -> bool:
        return self._tracer.built.is_dark

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """None: motion is followed ray by ray."""
        return np.empty(0)

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`."""
        return blocks_of_run(self._clock.instants_us, window_us, begin_us, end_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside the interval that follow all motion, the camera's too, µs."""
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
        """Each listed pixel in a window of its own, into `out` [1, n]; what never changes is rendered once."""
        self.counts.values += pixel.size
        still = self._still_pixels(role)
        known = still.known[pixel]
        out.put(known, still.flux.at(pixel[known]))
        waiting = np.flatnonzero(~known)
        span, number = np.unique(np.stack([begin[waiting], end[waiting]]), axis=1, return_inverse=True)
        windows, number = Windows(span[0], span[1]), number.ravel()
        # a pixel's neighbours have the window of their own row: where a row has several, one after the other
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
        """Rays that each listed pixel takes in a block of windows, the first one apart, or in a single window."""
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
        """Speed of the tracer here and now, on pixels from all over the region."""
        if self._is_dark:
            return float("inf")
        done = self._tracer.rays_done
        index = self._index[np.linspace(0, self._index.size - 1, min(self._index.size, 8192)).astype(np.int64)]
        window, seconds = Windows(np.zeros(1), np.full(1, 1000.0)), np.inf
        for _ in range(2):  # the first time compiles
            start = time.perf_counter()
            where = np.zeros(index.size, np.int64)
            self._tracer.trace(index, where, window, np.full(index.size, 64), np.ones(index.size, np.bool_))
            seconds = time.perf_counter() - start
        self._tracer.rays_done = done
        return 64 * index.size / seconds

    # ---- for the audit ----------------------------------------------------------------------------

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Which event pixels nothing that moves can come near at any time, [n], as far as that is known."""
        return self._still_pixels("events").known[pixel]

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """What one standard deviation of each pixel's noise is worth at a flux [..., n], e⁻/s."""
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
        """Mean Φ of each listed pixel in its own window, e⁻/s, by random numbers that nothing else has.

        Parameters
        ----------
        quality : wanted error over the sensor's noise, that of events or of exposures.
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
        """The listed pixels, some rows at a time."""
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
        """The pairs that a plan names.

        Parameters
        ----------
        numbers : of each pair's window, [w, n].
        first : flux in the first window, [1, n], where that is known.

        Returns
        -------
        flux : [w, n], 0 where nothing was rendered.
        met : [w, n], whether a path came near what moves in `span_us`; False where nothing was rendered.
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
    """One list of event pixels through successive blocks.

    Parameters
    ----------
    source : whose pixels they are.
    pixel : mosaic indices.
    first : the first block.

    Attributes
    ----------
    alive : places of the pixels that may change; `base`, [1, n], flux of all in the first window.
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

"""Change-driven rendering as a source of flux: its cost follows the changes, its error follows the sensor's noise.

Every decision is a pure function of scene, sensor, seed, quality, window and the pixel's place on the full sensor. A
pilot pass with random numbers of its own (`pilot`) decides how many rays a pair of a pixel and a window gets, and
which windows of a pixel are interpolated (`plan`). Values that were rendered before decide nothing. Cached values save
time only: they would come out the same again.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Halves
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.journal import Journal
from hesim_render.core.progress import Progress
from hesim_render.core.workers import Workers
from hesim_render.mosaic.schedule import Block, blocks_of_run
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.protocol import AuditableFlux, Sample
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.error_target import Noise, Role
from hesim_render.sources.render.change_driven.estimates import Counts, Flux
from hesim_render.sources.render.change_driven.event_blocks import INTERVALS, BlockFlux, Blocks
from hesim_render.sources.render.change_driven.forecast import forecast
from hesim_render.sources.render.change_driven.foresight import Foresight
from hesim_render.sources.render.change_driven.one_window import render_one_window
from hesim_render.sources.render.change_driven.references import References
from hesim_render.sources.render.change_driven.resting_depth import least_depth_m
from hesim_render.sources.render.change_driven.row_shares import RowShares, SharedBlocks
from hesim_render.sources.render.change_driven.sample_instants import MotionClock
from hesim_render.sources.render.change_driven.shared_tracer import SharedTracer
from hesim_render.sources.render.change_driven.tuning import TUNING, Tuning
from hesim_render.sources.render.exact import require_finite, used_responses
from hesim_render.sources.render.renderer import reported
from hesim_render.sources.renderer import Demand, Estimate
from hesim_render.sources.scene import Scene
from hesim_render.spectral.waveform import Waveform

_NONE = np.empty(0, np.int64)
#: Default error of the render, as a fraction of the sensor's noise.
QUALITY = 0.5


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
    light : waveform of all lights of the scene, None if they are steady. Φ is the flux at their mean level; means over
        windows are weighted with the waveform. The flux under the flickering light is this mean times the waveform's.
    progress : called with the number of rays traced so far, after each block.
    tuning : constants of the method.
    workers : processes that render, from `part_worker.start`; None renders here.
    part : number of this part of the light, by which workers know it.

    Attributes
    ----------
    light : as given.
    sensor : the sensor, with the lens in use.
    view : the placed camera.
    is_static : True where nothing moves.
    foresight : looks ahead at a run.

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
        light: Waveform | None = None,
        progress: Callable[[int], None] | None = None,
        tuning: Tuning = TUNING,
        workers: Workers | None = None,
        part: int = 0,
    ) -> None:
        if not 0 < quality < float("inf"):
            raise RangeError("quality", quality, "a part of the sensor's noise, above 0")
        self.quality, self.seed, self.light, self._scene = quality, seed, light, scene
        tracer = self._tracer = SharedTracer(scene, sensor, seed, used_responses(sensor), progress, light=light)
        self.view, self.sensor = tracer.view, tracer.sensor
        self.is_static = not tracer.parts.groups and tracer.camera is None
        noise = Noise(self.sensor, 1.0 if light is None else light.highest, rests=self.is_static)
        self._clock = MotionClock(self.view, tracer.camera, tracer.parts.groups, partial(least_depth_m, tracer))
        self._renderer = AdaptiveRenderer(tracer, noise, quality, tuning.at(quality), self._clock)
        self._index, self._references = self._renderer.index, References(self._renderer)
        self.foresight = Foresight(self._renderer, self._is_dark)
        self._shares: RowShares | None = None
        if workers is not None and not self._is_dark:
            given = {"quality": quality, "seed": seed, "light": light, "tuning": tuning}
            self._shares = RowShares(
                workers, part, self.sensor, self._report, {"scene": scene, "sensor": sensor, **given}
            )

    # ---- as a `SceneRenderer` ---------------------------------------------------------------------

    @property
    def settings(self) -> dict[str, object]:
        """See `Renderer.settings`."""
        return {"mode": "change-driven", "quality": self.quality}

    #: Each pixel gets as many rays as its error takes.
    samples: None = None

    @property
    def auditable(self) -> AuditableFlux:
        """See `Renderer.auditable`."""
        return self

    @property
    def work(self) -> dict[str, float]:
        """See `Renderer.work`."""
        return {"quality": self.quality, "renders": 1, **vars(self.counts)}

    def estimate(self, demand: Demand, progress: Progress | None = None) -> Estimate:
        """See `Renderer.estimate`."""
        if progress is not None:
            progress(0, 1, "estimate")
        return forecast(self, demand)

    def report(self, demand: Demand, expected: Estimate | None, progress: Progress) -> None:
        """See `Renderer.report`."""
        if self.is_static and expected is not None and expected.rays > 0:
            self._tracer.progress = reported(progress, expected.rays)

    def go_on(self, journal: Journal, part: int = 0) -> None:
        """See `Tracer.go_on`."""
        self._tracer.go_on(journal, part)
        if self._shares is not None:
            self._shares.go_on(journal, part)

    @property
    def counts(self) -> Counts:
        """Work done so far."""
        own = self._renderer.counts
        return own if self._shares is None else Counts.sum([own, self._shares.counts])

    @property
    def rays_traced(self) -> int:
        """Number of rays traced so far, pilot passes included."""
        return self._tracer.rays_done + (0 if self._shares is None else self._shares.rays_done)

    @property
    def _is_dark(self) -> bool:
        return self._tracer.built.is_dark

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No edges: each ray follows the motion at its own time."""
        return np.empty(0)

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """See `FluxSource.sample_blocks`."""
        return blocks_of_run(self._clock.instants_us, window_us, begin_us, end_us, INTERVALS)

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
        begin, end = (np.broadcast_to(np.asarray(t, dtype=np.float64), pixels.shape) for t in (begin_us, end_us))
        if not np.all(end >= begin):
            raise RangeError("end_us - begin_us", float(np.min(end - begin)), "0 or more")
        halves = np.zeros((2, pixels.size), np.float32)
        if not self._is_dark and pixels.size:
            given = pixels, begin, end
            halves = self.halves(*given) if self._shares is None else self._shares.of_pixels("halves", *given)
        half_a, half_b = (from_host(types.Float, half) for half in halves)
        require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
        return half_a, half_b

    def halves(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """As `mean_flux`, on the host, [2, n]; rendered here."""
        flux = Flux.zeros(1, pixel.size)
        render_one_window(self._renderer, pixel, begin_us, end_us, "any", flux)
        return np.concatenate([flux.half_a, flux.half_b])

    # ---- for the forecast -------------------------------------------------------------------------

    @property
    def has_ticks(self) -> bool:
        """True if event pixels compare at a fixed tick."""
        return self._renderer.has_ticks

    @property
    def kept_rays(self) -> int:
        """See `AdaptiveRenderer.kept_rays`."""
        return self._renderer.kept_rays

    @property
    def sees_paths(self) -> bool:
        """True if not all visible light is direct light on diffuse surfaces."""
        return not self._tracer.is_diffuse

    def is_apart(self, role: Role) -> bool:
        """True if pixels of a role have no direct neighbours of that role."""
        return self._renderer.noise.is_apart(role)

    # ---- for the audit ----------------------------------------------------------------------------

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Event pixels [n] that are known to be constant: no moving object can come near them at any time."""
        return self._renderer.still("events").known[pixel]

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
        """See `AuditableFlux.reference_flux`: a stream of random numbers of its own."""
        if self._is_dark or pixel.size == 0:
            return np.zeros((2, pixel.size))
        if self._shares is not None:
            others = {"quality": quality, "events": events}
            return self._shares.of_pixels("reference_flux", pixel, begin_us, end_us, **others)
        return self._references.values(self._index[pixel], begin_us, end_us, quality, "events" if events else "any")

    def reference_changes(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        needed: NDArray[np.bool_],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """See `AuditableFlux.reference_changes`."""
        if self._is_dark or pixel.size == 0:
            return np.zeros((2, *needed.shape))
        if self._shares is not None:
            others = {"base": base, "quality": quality}
            return self._shares.of_pixels("reference_changes", pixel, begin_us, end_us, needed, **others)
        return self._references.changes(self._index[pixel], begin_us, end_us, needed, base, quality)

    # ---- many windows -----------------------------------------------------------------------------

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """See `FluxSource.flux_of_blocks`."""
        types = jit()
        pixels = np.ascontiguousarray(pixel, dtype=np.uint32).ravel()
        every = iter(blocks)
        if (first := next(every, None)) is None:
            return
        every, alive, own, base = chain([first], every), _NONE, _NONE, Flux.zeros(1, pixels.size)
        rendered: Iterator[tuple[Block, BlockFlux]]
        if pixels.size == 0 or self._is_dark:
            rendered = ((block, BlockFlux(0, [])) for block in every)
        else:
            work = self._blocks(pixels, first)
            rendered, alive, own, base = work.through(every), work.alive, work.own, work.base
        for block, flux in rendered:
            for window in np.flatnonzero(block.wanted):
                self._renderer.counts.values += pixels.size
                # constant pixels keep the flux of the anchor; those that may change have that of this window
                values = [part[0].copy() for part in base.arrays]
                for whole, part in zip(values, flux.at(int(window)).arrays, strict=True):
                    whole[alive] = part[0, own]
                half_a, half_b = from_host(types.Float, values[0]), from_host(types.Float, values[1])
                require_finite(half_a, half_b, self._scene, self.sensor.layout, pixels)
                yield Sample(half_a, half_b, values[2])
            # the next block is rendered without this one's knots in memory
            del flux

    def blocks(self, pixel: NDArray[np.uint32], first: Block) -> Blocks:
        """Event pixels [n] through blocks that follow a first one; rendered here."""
        return Blocks(self._renderer, pixel, first)

    def _blocks(self, pixel: NDArray[np.uint32], first: Block) -> Blocks | SharedBlocks:
        """See `blocks`; by the workers, where there are any."""
        if self._shares is None:
            return self.blocks(pixel, first)
        work, still = SharedBlocks(self._shares, pixel, first), self._renderer.still("events")
        # the workers know which pixels are constant; the audit asks here
        place = np.setdiff1d(np.arange(pixel.size), work.alive, assume_unique=True)
        still.put(pixel[place], work.base.at(place))
        return work

    def _report(self) -> None:
        """Report the rays of all processes."""
        if self._tracer.progress is not None:
            self._tracer.progress(self.rays_traced)

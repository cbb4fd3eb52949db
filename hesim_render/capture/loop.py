"""One run: a source of flux, a sensor, a stretch of time; out come frames, events and their truth."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.error_meter import ErrorMeter
from hesim_render.capture.event_flux import EventFlux, Window
from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, Halves
from hesim_render.core.errors import RangeError, did_you_mean
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.schedule import CELL_US, Block, Exposure, exposures, instant_blocks, tick_blocks, ticks_us
from hesim_render.pixels.aps.model import APS_TERMS, ApsNoise
from hesim_render.pixels.evs.model import EVS_TERMS, EvsNoise
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.recording.frame import Frame
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.protocol import FluxSource, SampledFlux

if TYPE_CHECKING:
    from hesim_render.recording.recording import RecordingWriter

#: Names of all noise terms that can be switched off.
NOISE_TERMS = (*(f"aps.{term}" for term in APS_TERMS), *(f"evs.{term}" for term in EVS_TERMS))


def noise_models(
    sensor: Sensor, clean: bool = False, without: Sequence[str] = ()
) -> tuple[ApsNoise | None, EvsNoise | None]:
    """Both noise models with terms switched off.

    Parameters
    ----------
    clean : all terms off.
    without : names such as ``aps.read`` or ``evs.leak``; see `NOISE_TERMS`.

    Raises
    ------
    RangeError
        For a name that is not a term.
    """
    for name in without:
        if name not in NOISE_TERMS:
            raise RangeError("noise term", name, f"one of {', '.join(NOISE_TERMS)}{did_you_mean(name, NOISE_TERMS)}")
    aps = sensor.aps if sensor.spec.aps is not None else None
    evs = sensor.evs if sensor.spec.evs is not None else None
    if aps is not None:
        aps = aps.clean() if clean else aps.without(*[n[4:] for n in without if n.startswith("aps.")])
    if evs is not None:
        evs = evs.clean() if clean else evs.without(*[n[4:] for n in without if n.startswith("evs.")])
    return aps, evs


@dataclass
class _OpenFrame:
    """A frame being exposed: both halves of its electrons, one entry per frame pixel."""

    exposure: Exposure
    half_a: Float
    half_b: Float


class Capture:
    """Drives the stages over time, holding one slice of flux and the frames in exposure.

    Parameters
    ----------
    flux : where Φ comes from.
    sensor : region and lens as `flux` uses them.
    aps, evs : noise models, from `noise_models`.
    duration_us : end of the run.
    seed : of all temporal noise.
    begin_us : begin of the run. Frames and comparisons are at the same times whenever it begins; frames belong to the
        run in which they end.
    pixels : what the event pixels remember of the run before, its `pixel_state`: together both are one run.

    Attributes
    ----------
    errors : of the render, for frames and for events.
    """

    def __init__(
        self,
        flux: FluxSource,
        sensor: Sensor,
        aps: ApsNoise | None,
        evs: EvsNoise | None,
        duration_us: int,
        seed: int,
        begin_us: int = 0,
        pixels: dict[str, Any] | None = None,
    ) -> None:
        self._flux, self._sensor, self._aps, self._seed = flux, sensor, aps, seed
        self._begin_us, self._duration_us = begin_us, duration_us
        layout = sensor.layout
        # the source as frame and as event pixels see it: one, but where crosstalk is off for one of them
        sources = {n.crosstalk: with_crosstalk(flux, layout.shape, n.crosstalk) for n in (aps, evs) if n is not None}
        self._frame_source, self._event_source = (
            sources[noise.crosstalk] if noise is not None else next(iter(sources.values()), flux)
            for noise in (aps, evs)
        )
        none = np.empty(0, np.uint32)
        self._aps_pixel = np.flatnonzero(layout.aps_mask).astype(np.uint32) if aps is not None else none
        self._aps_row = self._aps_pixel // layout.cols
        self._evs_pixel = layout.evs_pixel.ravel() if evs is not None else none
        every = exposures(aps.spec, layout.rows, duration_us) if aps is not None else []
        self._exposures = [exposure for exposure in every if exposure.end_us > begin_us]
        self._stage = EvsStage(evs, seed) if evs is not None else None
        if self._stage is not None and pixels is not None:
            self._stage.resume(pixels)
        self._pixel_state: dict[str, Any] = {}
        self._event_flux = EventFlux(self._evs_pixel.size)
        self.errors = {"frames": ErrorMeter(), "events": ErrorMeter()}

    @property
    def event_pixels(self) -> NDArray[np.uint32]:
        """Mosaic indices in the order of the event grid."""
        return self._evs_pixel

    @property
    def pixel_state(self) -> dict[str, Any]:
        """What the event pixels remember at the end of the run, for one that goes on; plain values, NumPy arrays."""
        return self._pixel_state

    def event_blocks(self) -> Iterator[Block]:
        """Windows in which a source that implements `SampledFlux` is asked for event pixels."""
        if self._stage is None:
            return
        spec = self._stage.noise.spec
        if spec.reference == "previous_sample":
            yield from tick_blocks(spec, self._begin_us, self._duration_us)
            return
        source, begin = self._event_source, self._stage.t_us
        assert isinstance(source, SampledFlux)
        if begin is None:
            begin = self._begin_us + spec.window_us
            start, end = np.array([[self._begin_us], [begin]], np.float64)
            yield Block(start, end, np.ones(1, np.bool_))
        # up to the first instant that is not before the end: events before the end come with it
        cell = self._duration_us // CELL_US * CELL_US
        instants = source.instants_us(cell, cell + CELL_US)
        beyond = int(instants[np.searchsorted(instants, self._duration_us)])
        yield from instant_blocks(source.instants_us, spec.window_us, begin, beyond)

    @property
    def frame_exposures(self) -> tuple[NDArray[np.uint32], list[Exposure]]:
        """Frame pixels and all exposures of the run."""
        return self._aps_pixel, list(self._exposures)

    @property
    def event_flux(self) -> EventFlux:
        """Mean noise-free flux of the event pixels over all samples taken so far."""
        return self._event_flux

    @property
    def events_dropped(self) -> int:
        """Events lost in the sensor's read-out so far."""
        return self._stage.dropped if self._stage is not None else 0

    def _slice_samples(self) -> NDArray[np.int64]:
        """Times at which event pixels are sampled where the source is not asked for blocks: ticks, or its own pace."""
        if self._stage is None:
            return np.empty(0, np.int64)
        spec = self._stage.noise.spec
        if spec.reference == "previous_sample":
            times = ticks_us(spec, self._duration_us)
            return times[times > self._begin_us]
        inner = np.rint(self._flux.sample_times_us(self._begin_us, self._duration_us)).astype(np.int64)
        first = self._begin_us + spec.window_us
        times = np.unique(np.concatenate([[first], inner, [self._duration_us]]))
        return times[(times >= first) & (times <= self._duration_us)]

    def run(self, progress: Progress | None = None) -> Iterator[Frame | NDArray]:
        """Frames and blocks of events (`EVENT_DTYPE`), each kind in order of time."""
        if self._flux.is_static:
            yield from self._run_static(progress)
            return
        if isinstance(self._event_source, SampledFlux):
            yield from self._run_sampled(self._event_source, progress)
            return
        begin = min([float(self._begin_us), *(float(exposure.start_us) for exposure in self._exposures)])
        edges = self._flux.slice_edges_us(begin, self._duration_us)
        bounds = np.concatenate([[begin], edges, [float(self._duration_us)]])
        waiting, open_frames = list(self._exposures), []
        window = Window(self._slice_samples())
        for begin, end in zip(bounds[:-1], bounds[1:], strict=True):
            while waiting and waiting[0].start_us < end:
                open_frames.append(self._open(waiting.pop(0)))
            for frame in open_frames:
                self._expose(frame, begin, end)
            while open_frames and open_frames[0].exposure.end_us <= end:
                yield self._read_out(open_frames.pop(0))
            yield from self._sample_events(window, begin, end)
            if progress is not None:
                progress(end, self._duration_us, "simulated µs")

    def record(self, writer: RecordingWriter, progress: Progress | None = None) -> None:
        """Run, and write frames, events and the truth of the event pixels as they come."""
        for item in self.run(progress):
            if isinstance(item, np.ndarray):
                writer.add_events(item)
            else:
                writer.add_frame(item)
        if self._stage is not None:
            truth = self.event_flux
            writer.set_event_truth(truth.mean_e_per_s(), truth.stderr_e_per_s())
            writer.set_events_dropped(self.events_dropped)

    def _run_static(self, progress: Progress | None) -> Iterator[Frame | NDArray]:
        """A scene that stands still: its flux is rendered once and serves all times."""
        frame_pixel = self._aps_pixel if self._exposures else np.empty(0, np.uint32)
        if self._frame_source is self._event_source:
            (frame_a, frame_b), (event_a, event_b) = self._static_flux(self._frame_source, frame_pixel, self._evs_pixel)
        else:
            ((frame_a, frame_b),) = self._static_flux(self._frame_source, frame_pixel)
            ((event_a, event_b),) = self._static_flux(self._event_source, self._evs_pixel)
        for exposure in self._exposures:
            seconds = exposure.exposure_us * S_PER_US
            yield self._read_out(_OpenFrame(exposure, frame_a * seconds, frame_b * seconds))
        if self._stage is None:
            return
        self._event_flux.add(event_a, event_b)
        for t_us in self._slice_samples():
            yield self._step(event_a, event_b, int(t_us))
            if progress is not None:
                progress(float(t_us), self._duration_us, "simulated µs")

    def _run_sampled(self, source: SampledFlux, progress: Progress | None) -> Iterator[Frame | NDArray]:
        """A source without slices: all event samples in one go, each frame in one piece when its time has come."""
        waiting = list(self._exposures)
        if self._stage is not None:
            times: deque[int] = deque()
            samples = source.flux_of_blocks(self._evs_pixel, _noting(self.event_blocks(), times))
            for sample in samples:
                t_us = times.popleft()
                while waiting and waiting[0].end_us <= t_us:
                    yield self._whole_frame(waiting.pop(0))
                if t_us > self._duration_us:
                    self._pixel_state = self._stage.state()
                else:
                    self._event_flux.add(sample.half_a, sample.half_b)
                events = self._step(sample.half_a, sample.half_b, t_us)
                yield events[(events["t_us"] > self._begin_us) & (events["t_us"] <= self._duration_us)]
                if progress is not None:
                    progress(min(t_us, self._duration_us), self._duration_us, "simulated µs")
            self._pixel_state = self._pixel_state or self._stage.state()
        for exposure in waiting:
            yield self._whole_frame(exposure)
            if progress is not None and self._stage is None:
                progress(exposure.end_us, self._duration_us, "simulated µs")

    def _whole_frame(self, exposure: Exposure) -> Frame:
        frame = self._open(exposure)
        self._expose(frame, -np.inf, np.inf)
        return self._read_out(frame)

    def _static_flux(self, source: FluxSource, *lists: NDArray[np.uint32]) -> Iterator[Halves]:
        """Both halves of the flux of each list of pixels, from one render of all of them."""
        wanted = np.zeros(self._sensor.rows * self._sensor.cols, dtype=bool)
        for pixels in lists:
            wanted[pixels] = True
        place = np.cumsum(wanted) - 1  # of each mosaic pixel among the wanted
        halves = source.mean_flux(np.flatnonzero(wanted).astype(np.uint32), 0.0, float(self._duration_us))
        for pixels in lists:
            yield _take(halves[0], place[pixels]), _take(halves[1], place[pixels])

    def _open(self, exposure: Exposure) -> _OpenFrame:
        import drjit as dr

        types = jit()
        count = self._aps_pixel.size
        return _OpenFrame(exposure, dr.zeros(types.Float, count), dr.zeros(types.Float, count))

    def _expose(self, frame: _OpenFrame, begin_us: float, end_us: float) -> None:
        """Add the part of each row's exposure that lies in one slice."""
        import drjit as dr

        starts = frame.exposure.row_begin_us(np.arange(self._sensor.rows))
        first = np.maximum(starts, begin_us)
        last = np.minimum(starts + frame.exposure.exposure_us, end_us)
        where = np.flatnonzero((last > first)[self._aps_row])
        if where.size == 0:
            return
        rows = self._aps_row[where]
        half_a, half_b = self._frame_source.mean_flux(self._aps_pixel[where], first[rows], last[rows])
        types = jit()
        seconds = types.Float(((last - first)[rows] * S_PER_US).astype(np.float32))
        index = types.UInt32(where.astype(np.uint32))
        for total, half in ((frame.half_a, half_a), (frame.half_b, half_b)):
            # every index occurs once, so this is no race and the sum's order is that of time
            dr.scatter(total, dr.gather(types.Float, total, index) + half * seconds, index)
        dr.eval(frame.half_a, frame.half_b)

    def _sample_events(self, window: Window, begin_us: float, end_us: float) -> Iterator[NDArray]:
        """Event samples whose windows meet one slice; a window may straddle several slices."""
        if self._stage is None:
            return
        length = self._stage.noise.spec.window_us
        while window.next < len(window.ends_us):
            t_us = int(window.ends_us[window.next])
            first, last = max(t_us - length, begin_us), min(t_us, end_us)
            if t_us - length >= end_us:
                return
            if last > first:
                half_a, half_b = self._event_source.mean_flux(self._evs_pixel, first, last)
                window.add(half_a, half_b, (last - first) / length)
            if t_us > end_us:
                return
            self._event_flux.add(window.half_a, window.half_b)
            yield self._step(window.half_a, window.half_b, t_us)
            window.reset()

    def _step(self, half_a: Float, half_b: Float, t_us: int) -> NDArray:
        assert self._stage is not None
        seconds = self._stage.noise.spec.window_us * S_PER_US
        noise = self._sensor.evs
        self.errors["events"].add(
            half_a * seconds,
            half_b * seconds,
            lambda electrons, which: noise.noise_equivalent_e(electrons, noise.layout.evs_position.ravel()[which]),
        )
        return self._stage.step((half_a + half_b) * (0.5 * seconds), t_us)

    def _read_out(self, frame: _OpenFrame) -> Frame:
        """Noise once per frame, then everything back on the mosaic."""
        import drjit as dr

        assert self._aps is not None
        types = jit()
        layout = self._sensor.layout
        exposure = frame.exposure
        count = layout.rows * layout.cols
        index = types.UInt32(self._aps_pixel)
        noise = self._sensor.aps
        self.errors["frames"].add(
            frame.half_a, frame.half_b, lambda signal, _: noise.noise_equivalent_e(signal, exposure.exposure_us)
        )
        mean = 0.5 * (frame.half_a + frame.half_b)
        signal = dr.zeros(types.Float, count)
        dr.scatter(signal, mean, index)
        raw = self._aps.sample_dn(signal, exposure.exposure_us, self._seed, exposure.index).numpy()
        electrons = np.full(count, np.nan, dtype=np.float32)
        stderr = np.full(count, np.nan, dtype=np.float32)
        electrons[self._aps_pixel] = np.array(mean)
        stderr[self._aps_pixel] = np.array(dr.abs(frame.half_a - frame.half_b) * 0.5)
        valid = layout.aps_mask
        return Frame(
            raw=np.where(valid, raw.reshape(layout.shape), 0).astype(np.uint16),
            valid=valid,
            electrons_mean=electrons.reshape(layout.shape),
            electrons_stderr=stderr.reshape(layout.shape),
            t_us=exposure.t_us,
            exposure_start_us=exposure.start_us,
            exposure_us=exposure.exposure_us,
            line_time_us=exposure.line_time_us,
            index=exposure.index,
        )


def _noting(blocks: Iterable[Block], times: deque[int]) -> Iterator[Block]:
    """The same blocks; the ends of their wanted windows are appended to `times`."""
    for block in blocks:
        times.extend(np.rint(block.end_us[block.wanted]).astype(np.int64).tolist())
        yield block


def _take(array: Float, index: NDArray) -> Float:
    import drjit as dr

    types = jit()
    taken = dr.gather(types.Float, array, types.UInt32(index.astype(np.uint32)))
    dr.eval(taken)
    return taken

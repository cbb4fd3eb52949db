"""The capture loop: from a source of flux and a sensor to frames, events and their truth."""

from collections.abc import Callable, Iterator
from itertools import tee

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.error_meter import ErrorMeter, EventFlux
from hesim_render.capture.open_frames import OpenFrames, frame_pixels
from hesim_render.core.device_types import Float
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.schedule import (
    BLOCK_CELLS,
    BLOCK_INTERVALS,
    CELL_US,
    Block,
    BlockSample,
    Exposure,
    exposures,
    sample_of_blocks,
    tick_blocks,
    wanted_windows,
    without_first,
)
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.arrays import SavedState, restore, saved
from hesim_render.pixels.evs.labels import Labeller
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.recording.frame import Frame
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import with_crosstalk
from hesim_render.sources.protocol import FluxSource, Sample
from hesim_render.sources.renderer import Demand
from hesim_render.sources.still import StillFlux


class Capture:
    """Runs the sensor over time. It holds one slice of flux and the frames in exposure.

    Parameters
    ----------
    flux : source of Φ, e⁻/s.
    sensor : with the region and lens that `flux` uses.
    aps, evs : noise models, from `noise_models`.
    duration_us : end of the run, µs.
    seed : seed of all temporal noise.
    labels : label each event with its cause.

    Attributes
    ----------
    errors, labeller : error of the render, for frames and for events; what labels the events, or None.
    """

    def __init__(
        self,
        flux: FluxSource,
        sensor: Sensor,
        aps: ApsNoise | None,
        evs: EvsNoise | None,
        duration_us: int,
        seed: int,
        labels: bool = False,
    ) -> None:
        self._sensor, self._seed, self._duration_us = sensor, seed, duration_us
        layout = sensor.layout
        # frame pixels and event pixels share one source, unless crosstalk is switched off for one of the two
        sources = {n.crosstalk: with_crosstalk(flux, layout.shape, n.crosstalk) for n in (aps, evs) if n is not None}
        frame_source, self._event_source = (
            sources[noise.crosstalk] if noise is not None else next(iter(sources.values()), flux)
            for noise in (aps, evs)
        )
        self._aps_pixel = frame_pixels(sensor, aps)
        self._evs_pixel = layout.evs_pixel.ravel() if evs is not None else np.empty(0, np.uint32)
        self._exposures = exposures(aps.spec, layout.rows, duration_us) if aps is not None else []
        self._is_static = flux.is_static
        if flux.is_static:
            frame_source, self._event_source = self._still(frame_source)
        self._frames = OpenFrames(sensor, aps, self._exposures, frame_source, seed)
        self.labeller = Labeller(evs, seed, duration_us) if labels and evs is not None else None
        self._stage = EvsStage(evs, seed, labels=self.labeller) if evs is not None else None
        #: Number of event samples taken, and time that has been simulated, µs.
        self._samples, self._t_us = 0, 0
        self._event_flux = EventFlux(self._evs_pixel.size)
        self.errors = {"frames": self._frames.errors, "events": ErrorMeter()}

    def _still(self, frame_source: FluxSource) -> tuple[FluxSource, FluxSource]:
        """Sources of frames and of events of a static scene: each pixel that is asked for is rendered once."""
        frame_pixel = self._aps_pixel if self._exposures else self._aps_pixel[:0]
        if frame_source is self._event_source:
            still = StillFlux(frame_source, np.concatenate([frame_pixel, self._evs_pixel]))
            return still, still
        return StillFlux(frame_source, frame_pixel), StillFlux(self._event_source, self._evs_pixel)

    @property
    def event_pixels(self) -> NDArray[np.uint32]:
        """Mosaic indices of the event pixels, [n], in the order of the event grid."""
        return self._evs_pixel

    def event_blocks(self) -> Iterator[Block]:
        """Blocks of windows for which the source is asked for the flux of event pixels."""
        if self._stage is not None:
            yield from self._blocks_between(0, self._duration_us)

    def _blocks_between(self, begin_us: float, end_us: float) -> Iterator[Block]:
        """Blocks of windows of a run between two times."""
        assert self._stage is not None
        spec = self._stage.noise.spec
        if spec.reference == "previous_sample":
            return tick_blocks(spec, begin_us, end_us)
        return self._event_source.sample_blocks(spec.window_us, int(begin_us), int(end_us))

    def sample_of_event_blocks(self) -> BlockSample:
        """Some of `event_blocks`, which stand for all of them; a long run has millions."""
        if self._stage is None:
            return BlockSample([], 1.0)
        tick_us = self._stage.noise.spec.tick_us
        stretch_us = BLOCK_INTERVALS * tick_us if tick_us is not None else BLOCK_CELLS * CELL_US
        return sample_of_blocks(self._blocks_between, stretch_us, 0, self._duration_us, self._seed)

    @property
    def frame_exposures(self) -> tuple[NDArray[np.uint32], list[Exposure]]:
        """Mosaic indices of the frame pixels, [n], and all exposures of the run."""
        return self._aps_pixel, list(self._exposures)

    @property
    def demand(self) -> Demand:
        """What the run asks of its source, for an estimate; blocks of a source that rests cost nothing."""
        blocks = BlockSample([], 1.0) if self._is_static else self.sample_of_event_blocks()
        return Demand(self._duration_us, self._evs_pixel, blocks, *self.frame_exposures)

    @property
    def event_flux(self) -> EventFlux:
        """Mean noise-free flux of the event pixels over all samples so far, e⁻/s."""
        return self._event_flux

    @property
    def events_dropped(self) -> int:
        """Number of events that the sensor's read-out has lost so far."""
        return self._stage.dropped if self._stage is not None else 0

    @property
    def frame_mask(self) -> NDArray[np.bool_]:
        """Which pixels give frame values, [row, col]."""
        return self._sensor.layout.aps_mask

    @property
    def progress(self) -> tuple[int, int]:
        """Time that has been simulated, and end of the run, µs."""
        return self._t_us, self._duration_us

    def state(self) -> SavedState:
        """State between two items of `run`: plain values, NumPy arrays. Not of labels and errors of a render."""
        return {
            "samples": self._samples,
            "t_us": self._t_us,
            "frames": self._frames.state(),
            "stage": None if self._stage is None else self._stage.state(),
            "flux": saved(self._event_flux),
        }

    def go_on(self, state: SavedState) -> None:
        """Let `run` yield what comes after a `state` of the same run. The source is asked for nothing before it.

        Parameters
        ----------
        state : from `state`.
        """
        self._samples, self._t_us = state["samples"], state["t_us"]
        self._frames.go_on(state["frames"])
        if self._stage is not None:
            self._stage.resume(state["stage"])
        restore(self._event_flux, state["flux"])

    def run(self, progress: Progress | None = None) -> Iterator[Frame | NDArray]:
        """Run the capture.

        Parameters
        ----------
        progress : called with (done, total, what).

        Yields
        ------
        Frames, and blocks of events (structured arrays of `EVENT_DTYPE`); each kind in order of time.
        """
        pieces = self._frames.pieces()
        piece = next(pieces, None)
        blocks, asked = tee(without_first(self.event_blocks(), self._samples))
        samples = self._event_source.flux_of_blocks(self._evs_pixel, asked)
        for begin_us, end_us in wanted_windows(blocks):
            # expose whatever ends before a window first: a source may drop its data of the past
            while piece is not None and piece.end_us <= begin_us:
                yield from self._frames.expose(piece)
                piece = next(pieces, None)
            yield self._compare(next(samples), int(end_us))
            if progress is not None:
                progress(min(end_us, self._duration_us), self._duration_us, "simulated µs")
        while piece is not None:
            yield from self._frames.expose(piece)
            if progress is not None and self._stage is None:
                progress(piece.end_us, self._duration_us, "simulated µs")
            piece = next(pieces, None)

    def render(self, begin_us: float, end_us: float) -> None:
        """Ask the source for what `run` asks it for between two times, by the same calls; nothing is captured.

        The first frame and the first window are asked for as well, because a renderer finds in them what rests. With a
        journal (`hesim_render.core.journal`) it answers these calls of a later run from there.

        Parameters
        ----------
        begin_us, end_us : the times, µs; a frame lies where its exposure begins.
        """
        for piece in self._frames.pieces():
            exposure = piece.frame.exposure
            if exposure is self._exposures[0] or begin_us <= exposure.start_us < end_us:
                for _ in self._frames.expose(piece):
                    pass
        if self._stage is not None:
            blocks = self._blocks_of_span(begin_us, end_us)
            for _ in self._event_source.flux_of_blocks(self._evs_pixel, blocks):
                pass

    def _blocks_of_span(self, begin_us: float, end_us: float) -> Iterator[Block]:
        """The first window of the run, and the blocks that begin between two times."""
        for number, block in enumerate(self.event_blocks()):
            if number == 0:
                yield Block(block.begin_us[:1], block.end_us[:1], block.wanted[:1])
            if begin_us <= block.end_us[0] < end_us and (number > 0 or block.wanted.size > 1):
                yield block

    def record(
        self,
        writer: RecordingWriter,
        progress: Progress | None = None,
        keep: Callable[[Frame | NDArray], None] | None = None,
    ) -> None:
        """Run the capture, and write frames, events and the truth of the event pixels as they come.

        Parameters
        ----------
        writer, progress : takes frames and events; called with (done, total, what).
        keep : called with each frame and block of events as well; it may ask for the `state`.
        """
        for item in self.run(progress):
            match item:
                case Frame():
                    writer.add_frame(item)
                case events:
                    writer.add_events(events)
                    if self.labeller is not None:
                        writer.add_event_labels(self.labeller.taken())
            if keep is not None:
                keep(item)
        if self._stage is not None:
            writer.set_event_truth(self.event_flux.mean_e_per_s(), self.event_flux.stderr_e_per_s())
            writer.set_events_dropped(self.events_dropped)
        if self.labeller is not None:
            writer.add_event_labels(self.labeller.taken())

    def _compare(self, sample: Sample, t_us: int) -> NDArray:
        """Events up to a sample."""
        assert self._stage is not None
        if t_us <= self._duration_us:
            self._event_flux.add(sample.half_a, sample.half_b)
        events = self._step(sample.half_a, sample.half_b, t_us)
        self._samples, self._t_us = self._samples + 1, min(t_us, self._duration_us)
        return events[(events["t_us"] > 0) & (events["t_us"] <= self._duration_us)]

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

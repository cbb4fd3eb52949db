"""Frames during their exposure: exposed piece by piece, then read out."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.error_meter import ErrorMeter
from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.schedule import Exposure
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.arrays import SavedState, restore, saved
from hesim_render.recording.frame import Frame
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.protocol import FluxSource


@dataclass
class OpenFrame:
    """A frame during its exposure: both halves of its electrons, per frame pixel; None before the first piece."""

    STATE = ("half_a", "half_b")

    exposure: Exposure
    half_a: Float = None
    half_b: Float = None


@dataclass(frozen=True)
class ExposurePart:
    """Part of an exposure during which the source is in one state."""

    frame: OpenFrame
    begin_us: float
    end_us: float


class OpenFrames:
    """The frame pixels of a run.

    Parameters
    ----------
    sensor, aps : with the region and lens that `source` uses; noise model, None if there are no frames.
    exposures : of the run, in order of time.
    source : source of Φ, e⁻/s.
    seed : seed of the temporal noise.

    Attributes
    ----------
    errors : error of the render.
    """

    def __init__(
        self, sensor: Sensor, aps: ApsNoise | None, exposures: Sequence[Exposure], source: FluxSource, seed: int
    ) -> None:
        self._sensor, self._aps, self._exposures = sensor, aps, exposures
        self._source, self._seed = source, seed
        self._pixel = frame_pixels(sensor, aps)
        #: Number of pieces that are exposed, and frames in exposure, by their index.
        self._exposed, self._open = 0, dict[int, OpenFrame]()
        self.errors = ErrorMeter()

    def state(self) -> SavedState:
        """State between two pieces: plain values and NumPy arrays; not of the errors."""
        return {"exposed": self._exposed, "open": {str(index): saved(frame) for index, frame in self._open.items()}}

    def go_on(self, state: SavedState) -> None:
        """Go on after a `state` of the same run."""
        self._exposed = state["exposed"]
        self._open = {e.index: OpenFrame(e) for e in self._exposures if str(e.index) in state["open"]}
        for index, frame in self._open.items():
            restore(frame, state["open"][str(index)])

    def pieces(self) -> Iterator[ExposurePart]:
        """Exposures, cut where the source changes its state, in order of their ends, after those that are exposed."""
        return islice(self._pieces(), self._exposed, None)

    def _pieces(self) -> Iterator[ExposurePart]:
        waiting: list[tuple[float, int, ExposurePart]] = []
        for exposure in self._exposures:
            # no piece of this exposure ends before the exposure begins
            while waiting and waiting[0][0] <= exposure.start_us:
                yield heappop(waiting)[2]
            frame = self._open.get(exposure.index) or OpenFrame(exposure)
            edges = self._source.slice_edges_us(exposure.start_us, exposure.end_us)
            for begin, end in pairwise([float(exposure.start_us), *edges, exposure.end_us]):
                heappush(waiting, (end, exposure.index, ExposurePart(frame, begin, end)))
        while waiting:
            yield heappop(waiting)[2]

    def expose(self, piece: ExposurePart) -> Iterator[Frame]:
        """Add to each row the part of its exposure that lies in a piece. Yield the frame after its last piece."""
        frame = piece.frame
        if frame.half_a is None:
            frame.half_a, frame.half_b = (dr.zeros(jit().Float, self._pixel.size) for _ in range(2))
            self._open[frame.exposure.index] = frame
        self._add(frame, piece.begin_us, piece.end_us)
        self._exposed += 1
        if piece.end_us >= frame.exposure.end_us:
            del self._open[frame.exposure.index]
            yield self._read_out(frame)

    def _add(self, frame: OpenFrame, begin_us: float, end_us: float) -> None:
        # the part of each row's exposure that lies in the piece, [row]; with a rolling shutter some rows have none
        starts = frame.exposure.row_begin_us(np.arange(self._sensor.rows))
        first = np.maximum(starts, begin_us)
        last = np.minimum(starts + frame.exposure.exposure_us, end_us)
        row = self._pixel // self._sensor.layout.cols
        where = np.flatnonzero((last > first)[row])
        if where.size == 0:
            return
        rows = row[where]
        half_a, half_b = self._source.mean_flux(self._pixel[where], first[rows], last[rows])
        types = jit()
        seconds = from_host(types.Float, (last - first)[rows] * S_PER_US)
        index = from_host(types.UInt32, where)
        for total, half in ((frame.half_a, half_a), (frame.half_b, half_b)):
            # every index occurs once, so this is no race and the sum's order is that of time
            dr.scatter(total, dr.gather(types.Float, total, index) + half * seconds, index)
        dr.eval(frame.half_a, frame.half_b)

    def _read_out(self, frame: OpenFrame) -> Frame:
        """Draw the noise of a frame once, then put all values back on the mosaic."""
        assert self._aps is not None
        types = jit()
        layout = self._sensor.layout
        exposure = frame.exposure
        count = layout.rows * layout.cols
        index = from_host(types.UInt32, self._pixel)
        noise = self._sensor.aps
        self.errors.add(
            frame.half_a, frame.half_b, lambda signal, _: noise.noise_equivalent_e(signal, exposure.exposure_us)
        )
        mean = 0.5 * (frame.half_a + frame.half_b)
        signal = dr.zeros(types.Float, count)
        dr.scatter(signal, mean, index)
        raw = self._aps.sample_dn(signal, exposure.exposure_us, self._seed, exposure.index).numpy()
        electrons = np.full(count, np.nan, dtype=np.float32)
        stderr = np.full(count, np.nan, dtype=np.float32)
        electrons[self._pixel] = np.array(mean)
        stderr[self._pixel] = np.array(dr.abs(frame.half_a - frame.half_b) * 0.5)
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


def frame_pixels(sensor: Sensor, aps: ApsNoise | None) -> NDArray[np.uint32]:
    """Mosaic indices of the pixels that give frame values, [n]; none without a noise model."""
    return sensor.layout.aps_pixel if aps is not None else np.empty(0, np.uint32)

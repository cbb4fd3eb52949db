"""Windows of time, on the host and on the device."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.change_driven.light_times import LightTimes
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.transport.swept_boxes import Moment
from hesim_render.spectral.waveform import Waveform

#: Largest number of intervals for which one call finds the boxes of moving objects.
_MOST_BINS = 64


@dataclass(frozen=True)
class Windows:
    """Windows of time.

    Parameters
    ----------
    begin_us, end_us : [w], µs.
    """

    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]

    @property
    def size(self) -> int:
        """Number of windows."""
        return self.begin_us.size

    @property
    def span_us(self) -> tuple[float, float]:
        """Begin of the first and end of the last window, µs."""
        return float(self.begin_us.min()), float(self.end_us.max())


@dataclass(frozen=True)
class Moments:
    """Windows on the device.

    Parameters
    ----------
    length_us : Float [window], length of each, µs.
    times, boxes : tables as in `Moment`.
    bins : UInt32 [window], number of the boxes of each window.
    tracks, rows : number of tracks, and of rows of boxes in a bin.
    light : distribution of the instants in each window; None where it is even.
    """

    length_us: Float
    times: Float
    boxes: Float
    bins: UInt32
    tracks: int
    rows: int
    light: LightTimes | None = None

    def at(self, window: UInt32, share: Float) -> Moment:
        """Instants in the window of each lane, before which a share of its light arrives."""
        if self.light is None:
            instant = share * dr.gather(type(self.length_us), self.length_us, window)
        else:
            instant = self.light.instant_us(window, share)
        where = dr.gather(type(self.bins), self.bins, window)
        return Moment(instant, self.times, self.tracks, window, self.boxes, self.rows, where)

    @classmethod
    def of(
        cls,
        windows: Windows,
        span_us: tuple[float, float] | None,
        tracks: Sequence[Trajectory],
        boxes_of: Callable[[tuple[tuple[float, float], ...]], NDArray[np.float32]],
        waveform: Waveform | None = None,
    ) -> "Moments":
        """Put windows on the device.

        Parameters
        ----------
        windows : the windows.
        span_us : interval for which boxes hold, µs; None: for each window, or for a few windows close in time.
        tracks : tracks of everything that moves, those of groups first.
        boxes_of : maps intervals, µs, to the boxes of moving objects, see `MovingScene.box_rows_in`.
        waveform : power of the light, None if it is steady.

        Returns
        -------
        The windows, evaluated on the device.
        """
        types = jit()
        # repeated tracks are wrapped on the host in float64: float32 loses fractions of a µs within seconds
        times = [
            track.local_us(windows.begin_us) if track.repeat else windows.begin_us - track.knots_us[0]
            for track in tracks
        ]
        bins, spans = _bins(windows) if span_us is None else (np.zeros(windows.size, np.uint32), (span_us,))
        boxes = boxes_of(spans)
        # padded, because a table of one entry becomes a constant in the kernel, and boxes are fetched four at a time
        lengths, local, sides = (
            from_host(types.Float, np.append(values.astype(np.float32).ravel(), np.zeros(8, np.float32)))
            for values in (
                windows.end_us - windows.begin_us,
                np.stack(times, axis=1) if times else np.empty(0),
                boxes,
            )
        )
        numbers = from_host(types.UInt32, np.append(bins, bins[-1:]))
        light = None if waveform is None else LightTimes.of(waveform, windows.begin_us, windows.end_us)
        moments = cls(lengths, local, sides, numbers, len(tracks), boxes.shape[1], light)
        dr.make_opaque(moments.length_us, moments.times, moments.boxes, moments.bins)
        return moments


def _bins(windows: Windows) -> tuple[NDArray[np.uint32], tuple[tuple[float, float], ...]]:
    """Group windows that are close in time: a group number for each window, and an interval for each group."""
    # groups of successive windows, as even in number as possible
    order = np.argsort(windows.begin_us, kind="stable")
    number = np.empty(windows.size, np.uint32)
    number[order] = np.arange(windows.size) * min(windows.size, _MOST_BINS) // windows.size
    count = int(number.max()) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    # the interval of a group goes from its earliest begin to its latest end
    np.minimum.at(low, number, windows.begin_us)
    np.maximum.at(high, number, windows.end_us)
    return number, tuple(zip(low.tolist(), high.tolist(), strict=True))

"""Times of the pictures of a video, in simulated µs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S
from hesim_render.sources.video.picture import Timing


class Clock:
    """Time stamps of a video as simulated time.

    Picture k is the mean of the scene over [t_k, t_k + duty·Δ_k], with t_0 = 0. A held picture stands for the time from
    the middle of the dark gap before it to the middle of the dark gap after it; with duty 1 there is no gap. With
    interpolation, the scene changes linearly from the middle of one exposure to the middle of the next.

    Parameters
    ----------
    timing : times of the video's own clock.
    slow_motion : ratio of the speed of the scene to that of the video's clock: a film of 3200 pictures/s stored at 25
        has 128.
    duty : part of the picture period in which the shutter was open, above 0 to 1.
    factor : number of pictures made from each one; they divide the time to the next middle evenly.
    """

    def __init__(self, timing: Timing, slow_motion: float = 1.0, duty: float = 1.0, factor: int = 1) -> None:
        unit = US_PER_S / slow_motion
        begin = np.asarray(timing.begin_s, dtype=np.float64) * unit
        self.end_us = float(timing.end_s) * unit
        period = np.diff(np.append(begin, self.end_us))
        #: Middle of each exposure.
        self.middle_us = begin + duty / 2 * period
        gap = (1 - duty) * period
        #: Begin of the time that each picture is held, and the end of the last one.
        self.hold_us = np.append(begin, self.end_us)
        self.hold_us[1:-1] -= gap[:-1] / 2
        if factor > 1:
            given = np.arange(begin.size)
            made = np.arange((begin.size - 1) * factor + 1) / factor
            self.middle_us = np.interp(made, given, self.middle_us)
            between = (self.middle_us[1:] + self.middle_us[:-1]) / 2
            self.hold_us = np.concatenate([self.hold_us[:1], between, self.hold_us[-1:]])

    @property
    def count(self) -> int:
        return self.middle_us.size

    @property
    def period_us(self) -> float:
        """The usual time from one picture to the next, µs."""
        edges = self.hold_us
        return float(np.median(np.diff(self.middle_us))) if self.count > 1 else float(edges[1] - edges[0])

    def inner(self, times_us: NDArray[np.float64], begin_us: float, end_us: float) -> NDArray[np.float64]:
        """The sorted `times_us` that lie strictly between two times, µs."""
        first, last = np.searchsorted(times_us, begin_us, side="right"), np.searchsorted(times_us, end_us, side="left")
        return times_us[first:last]

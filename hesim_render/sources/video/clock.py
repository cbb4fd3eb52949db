"""Times of the pictures of a video, in simulated µs."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S
from hesim_render.sources.video.picture_layout import Timing


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


def picture_weights(
    edges_us: NDArray[np.float64], is_held: bool, begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
) -> dict[int, NDArray[np.float64]]:
    """Weight of each picture in the means over intervals, in order of time.

    Parameters
    ----------
    edges_us : times at which the next picture takes over; with interpolation, the middles of the exposures.
    is_held : a picture stands still until the next one; otherwise the scene changes linearly between the middles.
    begin_us, end_us : the intervals: numbers, or one of each per pixel, [n].

    Returns
    -------
    Weights by the number of the picture: one, or one per pixel, [n].
    """
    # the stretches between edges that any interval reaches into
    first, last = float(begin_us.min()), float(end_us.max())
    cells = range(
        int(np.searchsorted(edges_us, first, side="right")), int(np.searchsorted(edges_us, last, side="left")) + 1
    )
    if len(cells) <= 1:  # a point in time on an edge belongs to the picture that begins there
        cells = range(cells.start, cells.start + 1)
    bounds = np.concatenate([[-np.inf], edges_us, [np.inf]])
    length = end_us - begin_us
    weights: dict[int, NDArray[np.float64]] = {}
    for cell in cells:
        # the part of each interval that lies in this stretch
        low, high = (np.clip(times, bounds[cell], bounds[cell + 1]) for times in (begin_us, end_us))
        share = np.where(length > 0, (high - low) / np.where(length > 0, length, 1.0), 1.0)
        if is_held:
            weights[cell] = share
            continue
        # stretch k extends from the middle of picture k - 1 to that of picture k; the mean of a straight line is its
        # value half-way
        before, after = max(cell - 1, 0), min(cell, edges_us.size - 1)
        part = np.zeros(())
        if after > before:
            part = ((low + high) / 2 - edges_us[before]) / (edges_us[after] - edges_us[before])
        weights[before] = weights.get(before, 0.0) + share * (1 - part)
        if after > before:
            weights[after] = weights.get(after, 0.0) + share * part
    return weights

"""What may come near a pixel within an interval: how far the picture moves there, and the boxes that objects sweep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.timed import SweptBoxes, TimedTracer
from hesim_render.renderer.timeline import Timeline

#: Farthest motion within an interval that can be followed from its ends, in listed pixels.
REACH = 6.0
#: Motion is measured along straight lines, from one ray a pixel.
_PACE_MARGIN = np.float32(1.1)
#: Part of its own extent that an object may move within an interval without passing something unseen.
_PASSING = 0.5
#: Part of its own extent below which the box swept by an object is about the box of an interval twice as long.
_SLOW = 0.1


class Surroundings:
    """Of a list of pixels.

    Parameters
    ----------
    tracer : follows single rays.
    timeline : how far objects move.
    pixel : [n], mosaic indices, about evenly spread over the region.
    t_us : when objects have the extent that counts.
    """

    def __init__(self, tracer: TimedTracer, timeline: Timeline, pixel: NDArray[np.uint32], t_us: float) -> None:
        self._tracer, self._timeline, self._pixel = tracer, timeline, pixel
        self._groups = tracer.parts.groups
        self.near = Neighbours(pixel, tracer.sensor.layout.shape)
        self._extent_px = np.array([timeline.extent_px(group.name, t_us) for group in self._groups])

    def spread(self, changed: NDArray[np.bool_], motion: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels that what changed another can reach, interval by interval, [intervals, n].

        Whatever passes over a pixel between two windows was within half its way of it in one of them. Shadows and
        reflections move at a pace of their own: the next pixels count in any case.

        Parameters
        ----------
        motion : around each pixel within each interval, [intervals, n], listed pixels.
        """
        spread = changed.copy()
        for row, far, out in zip(changed, motion, spread, strict=True):
            if not row.any():
                continue
            radius = np.clip(far / 2 + 0.25, 1, REACH).astype(np.int8)
            for size in range(1, int(radius.max()) + 1):
                there = radius == size
                if there.any():
                    out[there] = self.near.most(row.view(np.uint8), size)[there].view(np.bool_)
        return spread

    def pace(self, begin_us: float, end_us: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Motion around each pixel, listed pixels per µs: the most within reach of it; and which group it sees."""
        motion, group = self._tracer.motion_px(self._pixel, begin_us, end_us)
        most = self.near.most(motion / np.float32(self.near.cell_px), int(REACH))
        return _PACE_MARGIN * most / np.float32(max(end_us - begin_us, 1e-3)), group

    def motion(
        self, spans: list[tuple[float, float]], pace: NDArray[np.float32], seen: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """Motion around each pixel in each interval, listed pixels, [intervals, n]; the rest as `pace` gives it.

        A pixel that does not see an object now, but lies where it comes by within the interval, has the motion of
        that object.
        """
        length = np.array([[end - begin] for begin, end in spans], np.float32)
        motion = pace * length
        for number, group in enumerate(self._groups, start=1):
            for row, span in zip(motion, spans, strict=True):
                far = self._timeline.object_motion_px(group.name, *span) / self.near.cell_px
                if far > 0:
                    there = self.near.inside(self._timeline.outlines_px(group.name, *span)) & (seen != number)
                    row[there] = np.maximum(row[there], np.float32(far))
        return motion

    def swept(
        self, intervals: list[tuple[float, float]], windows: list[tuple[float, float]], parts: int
    ) -> SweptBoxes | None:
        """Boxes of every interval; an object that goes far in one of its `parts` may pass something unseen.

        None where all are so slow that nothing would be ruled out that the interval twice as long has not.
        """
        if not self._groups:
            return None
        names = [group.name for group in self._groups]
        own = np.array([[self._timeline.object_motion_px(n, *interval) for n in names] for interval in intervals])
        if parts > 1 and np.all(own / parts < _SLOW * self._extent_px):
            return None
        swept = np.array([[group.swept_box(*interval) for group in self._groups] for interval in intervals])
        present = np.array([[group.swept_box(*window) for group in self._groups] for window in windows])
        return SweptBoxes(swept, present, own / parts > _PASSING * self._extent_px)

"""Extra pilot rays for pixels that a small object may cross, because few rays could miss it.

Sixteen rays miss an object that covers a fiftieth of a pixel seven times out of ten, and a spark or a glint can be
hundreds of times as bright as its surroundings. Small objects therefore get more pilot rays, and their pixels are
rendered while they pass. Where surfaces may be glossy, large objects get extra rays too, but fewer, within a budget.
Outlines hold for every instant of a window (`motion_bounds`). The number of rays depends on the whole picture, not on
the read-out region.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from hesim_render.sources.render.camera import View
from hesim_render.sources.render.change_driven.tuning import Tuning
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.transport.motion_bounds import places, places_seen
from hesim_render.sources.render.transport.moving_scene import Group

#: Begin and end of a window are rounded outwards to this part of its length.
_PARTS = 8


@dataclass(frozen=True)
class Look:
    """Extra pilot rays at some places.

    Parameters
    ----------
    place : [k], places among the pixels that were asked about.
    rays : rays per pixel.
    is_small : True if a small object causes the look.
    """

    place: NDArray[np.int64]
    rays: int
    is_small: bool


@dataclass(frozen=True)
class Outline:
    """Convex outline of the area that an object sweeps within a window, on the full sensor.

    Parameters
    ----------
    low, high : [2] each, least and largest column and row, pixels.
    sides : [k, 3], (a, b, c) with a·col + b·row + c ≤ 0 inside, (a, b) of length 1; empty if the box is the outline.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    sides: NDArray[np.float64]

    def inside(self, col: NDArray[np.float64], row: NDArray[np.float64], margin_px: float) -> NDArray[np.bool_]:
        """True for points inside the outline or at most `margin_px` pixels outside it."""
        found = np.ones(np.broadcast(col, row).shape, np.bool_)
        for a, b, c in self.sides:
            found &= a * col + b * row + c <= margin_px
        return found


class Zoom:
    """Finds the pixels that get extra pilot rays because of moving objects.

    Parameters
    ----------
    view : the camera at rest.
    camera : track of the camera, None if it rests.
    groups : moving objects.
    is_matt : True if all surfaces are matt; large objects then need no extra rays.
    tuning : constants.
    """

    def __init__(
        self, view: View, camera: Trajectory | None, groups: list[Group], is_matt: bool, tuning: Tuning
    ) -> None:
        self._view, self._camera, self._groups = view, camera, groups
        self._is_matt, self._tuning = is_matt, tuning
        geometry = view.sensor.spec.geometry
        left, right, top, bottom = (edge / (geometry.pitch_um * 1e-3) for edge in view.followed_mm)
        middle = np.array([geometry.cols / 2, geometry.rows / 2])
        self._low, self._high = np.array([left, top]) + middle, np.array([right, bottom]) + middle

    def _outlines(self, begin_us: float, end_us: float) -> list[tuple[list[Outline], int, bool]]:
        """Outlines in one window, the number of pilot rays of a pixel inside any of them, and whether they are
        small.
        """
        found: dict[bool, list[tuple[float, Outline]]] = {True: [], False: []}
        margin, tuning = self._tuning.zoom_margin_px, self._tuning
        for group in self._groups:
            extent, outline = self._outline(group, begin_us, end_us)
            is_small = extent <= tuning.small_px
            if outline is None or (self._is_matt and not is_small):
                continue
            size = np.maximum(np.minimum(outline.high, self._high) - np.maximum(outline.low, self._low), 0) + 2 * margin
            found[is_small].append((float(np.prod(size)), outline))
        looks = []
        for is_small, entries in found.items():
            entries.sort(key=lambda entry: entry[0])
            room = (tuning.zoom_room if is_small else tuning.gloss_room) * float(np.prod(self._high - self._low))
            areas = np.cumsum([area for area, _ in entries])
            rays = tuning.zoom_rays
            while rays > 2 * tuning.pilot_rays and not (areas.size and areas[-1] * rays <= room):
                rays //= 2
            some = int(np.searchsorted(areas * rays, room, side="right"))
            if some:
                looks.append(([outline for _, outline in entries[:some]], rays, is_small))
        return looks

    def _outline(self, group: Group, begin_us: float, end_us: float) -> tuple[float, Outline | None]:
        """Least extent of an object in the image at any instant, pixels, and the area that it sweeps; None outside
        the view.
        """
        points, extents, wider = [], [], 0.0
        if self._camera is None:
            found = places(group.corners, group.trajectory, begin_us, end_us)
        else:
            found = places_seen(group.corners, group.trajectory, self._camera, begin_us, end_us)
        for corners, margin in found:
            rest = np.broadcast_to(self._view.camera_to_world, (len(corners), 4, 4))
            seen, px_per_m = self._view.project_on_sensor(corners, rest)
            points.append(seen.reshape(-1, 2))
            extents.append(np.ptp(seen, axis=1).min())
            wider = max(wider, margin * float(px_per_m.max()))
        every = np.concatenate(points)
        low, high = every.min(axis=0) - wider, every.max(axis=0) + wider
        if np.any(high < self._low) or np.any(low > self._high) or not np.all(np.isfinite(every)):
            return 0.0, None
        try:
            sides = ConvexHull(every).equations.copy()
            sides[:, 2] -= wider
        except QhullError:  # points on a line (an object seen edge-on): use their bounding box
            sides = np.empty((0, 3))
        return float(min(extents)), Outline(low, high, sides)

    def sites(
        self, row: NDArray[np.int64], col: NDArray[np.int64], windows: Windows, numbers: NDArray[np.int64]
    ) -> list[list[Look]]:
        """Pixels that get extra pilot rays, as a list of looks for each row of `numbers`.

        Parameters
        ----------
        row, col : [m], places on the full sensor.
        windows : all windows.
        numbers : [k, m], window number of each pixel.

        Returns
        -------
        k lists of looks.
        """
        if not self._groups or row.size == 0:
            return []
        return [self._sites_of(row, col, windows, each) for each in numbers]

    def _sites_of(
        self, row: NDArray[np.int64], col: NDArray[np.int64], windows: Windows, number: NDArray[np.int64]
    ) -> list[Look]:
        top, left = int(row.min()), int(col.min())
        shape = int(row.max()) - top + 1, int(col.max()) - left + 1
        begin, end = windows.begin_us[number], windows.end_us[number]
        # rows of a rolling shutter have different windows; rounded outwards, many of them share one look
        step = np.maximum((end - begin) / _PARTS, 1.0)
        times = np.stack([np.floor(begin / step) * step, np.ceil(end / step) * step])
        looks, which = np.unique(times, axis=1, return_inverse=True)
        found = []
        for look, (low, high) in enumerate(looks.T):
            for outlines, rays, is_small in self._outlines(float(low), float(high)):
                inside = self._image(outlines, top, left, shape)[row - top, col - left]
                found.append(Look(np.flatnonzero(inside & (which.ravel() == look)), rays, is_small))
        return found

    def _image(self, outlines: list[Outline], top: int, left: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Pixels inside any outline, within a rectangle that begins at row `top` and column `left`."""
        image, margin = np.zeros(shape, np.bool_), self._tuning.zoom_margin_px
        for outline in outlines:
            low = np.maximum(np.floor(outline.low - margin).astype(np.int64) - [left, top], 0)
            high = np.minimum(np.ceil(outline.high + margin).astype(np.int64) - [left, top], shape[::-1])
            if np.any(high <= low):
                continue
            x, y = np.arange(low[0], high[0])[None] + left + 0.5, np.arange(low[1], high[1])[:, None] + top + 0.5
            image[low[1] : high[1], low[0] : high[0]] |= outline.inside(x, y, margin)
        return image

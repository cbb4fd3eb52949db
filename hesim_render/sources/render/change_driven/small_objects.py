"""Extra pilot rays for pixels that a small object may cross, because few rays could miss it.

Sixteen rays miss an object that covers a fiftieth of a pixel seven times out of ten, and a spark or a glint can be
hundreds of times as bright as its surroundings. Small objects therefore get more pilot rays, and their pixels are
rendered while they pass. Large objects that may be glossy get extra rays too, but fewer, within a budget.
Outlines hold for every instant of a window (`motion_bounds`). The number of rays depends on the whole picture, not on
the read-out region.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from hesim_render.core.distinct import distinct_columns
from hesim_render.core.method_cache import method_cache
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.change_driven.tuning import Tuning
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.transport.motion_bounds import places, places_seen
from hesim_render.sources.render.transport.moving_scene import Group

#: Begin and end of a window are rounded outwards to this part of its length.
_PARTS = 8
#: Points along an edge that a lens with distortion images as a curve.
_ALONG = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
#: Period over which objects are sorted out that are never small, µs; instants at which their size is taken; and how
#: many times the limit it must be at keyframes.
_SORTED_US, _INSTANTS, _FAR_FROM_SMALL = 64_000, 65, 4.0


@dataclass(frozen=True)
class Look:
    """Extra pilot rays at some places.

    Parameters
    ----------
    place : [k], places among the pixels that were asked about.
    rays : rays per pixel.
    is_small : True if a small object causes the look.
    aims : numbers of the places at which rays are aimed, and of the moving groups at which they are, [m] each; None
        where no rays are.
    """

    place: NDArray[np.int64]
    rays: int
    is_small: bool
    aims: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None


@dataclass(frozen=True)
class SweptOutline:
    """Convex outline of the area that an object sweeps within a window, on the full sensor.

    Parameters
    ----------
    low, high : [2] each, least and largest column and row, pixels.
    sides : [k, 3], (a, b, c) with a·col + b·row + c ≤ 0 inside, (a, b) of length 1; empty if the box is the outline.
    is_small : True if few rays could miss the object.
    target : number of the moving group, if rays are aimed at it.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    sides: NDArray[np.float64]
    is_small: bool = True
    target: int | None = None

    def inside(self, col: NDArray[np.float64], row: NDArray[np.float64], margin_px: float) -> NDArray[np.bool_]:
        """True for points inside the outline or at most `margin_px` pixels outside it."""
        is_inside = np.ones(np.broadcast(col, row).shape, np.bool_)
        for a, b, c in self.sides:
            is_inside &= a * col + b * row + c <= margin_px
        return is_inside


class Zoom:
    """Finds the pixels that get extra pilot rays because of moving objects.

    Parameters
    ----------
    view : the camera at rest.
    camera : track of the camera, None if it rests.
    groups : moving objects; large ones that are diffuse need no extra rays.
    tuning : constants.
    can_aim : False if rays of this lens cannot be aimed.
    blur_px : radius of the PSF that holds nearly all of it, px.
    """

    def __init__(
        self,
        view: View,
        camera: Trajectory | None,
        groups: list[Group],
        tuning: Tuning,
        can_aim: bool = True,
        blur_px: float = 0.0,
    ) -> None:
        self._view, self._camera, self._groups = view, camera, groups
        self._tuning = tuning
        # bands of rows ask for the same windows one after another, and so does the audit
        self._outlines = method_cache(self._outlines_in, maxsize=64)
        self._large = method_cache(self._large_in, maxsize=64)
        geometry = view.sensor.spec.geometry
        left, right, top, bottom = (edge / (geometry.pitch_um * 1e-3) for edge in view.followed_mm)
        middle = np.array([geometry.cols / 2, geometry.rows / 2])
        self._low, self._high = np.array([left, top]) + middle, np.array([right, bottom]) + middle
        # from the centre of a pixel to its corners, and the blur
        self._aim_margin_px = 0.5**0.5 + blur_px
        self._aim_px = tuning.aim_px if can_aim else 0.0

    def _outlines_in(self, begin_us: float, end_us: float) -> list[tuple[list[SweptOutline], int, bool]]:
        """Outlines in one window, the number of pilot rays of a pixel inside any of them, and whether they are
        small.
        """
        by_size: dict[bool, list[tuple[float, SweptOutline]]] = {True: [], False: []}
        margin, tuning = self._tuning.zoom_margin_px, self._tuning
        large = self._large_within(begin_us, end_us)
        for number, group in enumerate(self._groups):
            # an asynchronous sensor and the audit ask for thousands of windows, and an outline takes a millisecond
            if number in large:
                continue
            outline = self._outline(number, group, begin_us, end_us)
            if outline is None or (group.is_diffuse and not outline.is_small):
                continue
            size = np.maximum(np.minimum(outline.high, self._high) - np.maximum(outline.low, self._low), 0) + 2 * margin
            by_size[outline.is_small].append((float(np.prod(size)), outline))
        looks = []
        for is_small, entries in by_size.items():
            entries.sort(key=lambda entry: entry[0])
            picture = float(np.prod(self._high - self._low))
            room = (tuning.zoom_room if is_small else tuning.gloss_room) * picture
            # outlines overlap where there are many
            areas = np.minimum(np.cumsum([area for area, _ in entries]), picture)
            rays = tuning.zoom_rays
            while rays > 2 * tuning.pilot_rays and not (areas.size and areas[-1] * rays <= room):
                rays //= 2
            some = int(np.searchsorted(areas * rays, room, side="right"))
            if some:
                looks.append(([outline for _, outline in entries[:some]], rays, is_small))
        return looks

    def _large_within(self, begin_us: float, end_us: float) -> frozenset[int]:
        """Numbers of objects that need no look in a window, because they are large throughout a longer period."""
        period = int(begin_us // _SORTED_US)
        if end_us > (period + 1) * _SORTED_US:
            return frozenset()
        return self._large(period)

    def _large_in(self, period: int) -> frozenset[int]:
        """Numbers of diffuse objects that are far from small at every instant of a period.

        Between two instants an extent may change further than at them. It must therefore also exceed the limit by twice
        its largest change from one instant to the next.
        """
        begin, end = period * _SORTED_US, (period + 1) * _SORTED_US
        times, limit = np.linspace(begin, end, _INSTANTS), self._tuning.small_px
        large = set()
        for number, group in enumerate(self._groups):
            if not group.is_diffuse:
                continue
            poses = group.trajectory.matrix(times)
            points = group.corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
            if self._camera is not None:  # in the frame of the camera, as the resting one would see it
                moved = self._camera.matrix(times)
                points = (points - moved[:, None, :3, 3]) @ moved[:, :3, :3]
            extent = self._extents(points)  # [instant, column and row]
            if not np.all(np.isfinite(extent)):
                continue
            room = extent.min() - 2 * np.abs(np.diff(extent, axis=0)).max()
            if room > limit:
                # instants of an even step could miss a vibration, but not the keyframes between which it happens
                seen = (self._extents(corners) for corners, _ in self._places(group, begin, end))
                if min(float(each.min()) for each in seen) > _FAR_FROM_SMALL * limit:
                    large.add(number)
        return frozenset(large)

    def _places(self, group: Group, begin_us: float, end_us: float) -> list[tuple[NDArray[np.float64], float]]:
        """Corners of an object at successive instants, as the resting camera would see them; see `places`."""
        if self._camera is None:
            return places(group.corners, group.trajectory, begin_us, end_us)
        return places_seen(group.corners, group.trajectory, self._camera, begin_us, end_us)

    def _extents(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Extent of corners [k, n, 3] in the image, [k, 2], pixels."""
        rest = np.broadcast_to(self._view.camera_to_world, (len(corners), 4, 4))
        return np.ptp(self._view.project_on_sensor(corners, rest)[0], axis=1)

    def _outline(self, number: int, group: Group, begin_us: float, end_us: float) -> SweptOutline | None:
        """The area that an object sweeps; None outside the view."""
        points, extents, wider = [], [], 0.0
        for corners, margin in self._places(group, begin_us, end_us):
            rest = np.broadcast_to(self._view.camera_to_world, (len(corners), 4, 4))
            seen, px_per_m = self._view.project_on_sensor(self._along_edges(corners), rest)
            points.append(seen.reshape(-1, 2))
            extents.append(np.ptp(seen, axis=1))
            wider = max(wider, margin * float(px_per_m.max()) + self._view.defocus_px(px_per_m))
        every = np.concatenate(points)
        low, high = every.min(axis=0) - wider, every.max(axis=0) + wider
        if np.any(high < self._low) or np.any(low > self._high) or not np.all(np.isfinite(every)):
            return None
        try:
            sides = ConvexHull(every).equations.copy()
            sides[:, 2] -= wider
        except QhullError:  # points on a line (an object seen edge-on): use their bounding box
            sides = np.empty((0, 3))
        extent = np.concatenate(extents)
        is_small = bool(extent.min() <= self._tuning.small_px)
        return SweptOutline(low, high, sides, is_small, number if extent.max() <= self._aim_px else None)

    def _along_edges(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Corners [k, n, 3], and points between each two of a box where the lens images straight edges as curves."""
        if self._view.projection.distortion is None or corners.shape[1] % 8:
            return corners
        boxes = corners.reshape(len(corners), -1, 8, 3)
        first, second = np.triu_indices(8, 1)
        between = [boxes[:, :, first] * (1 - share) + boxes[:, :, second] * share for share in _ALONG]
        return np.concatenate([boxes, *between], axis=2).reshape(len(corners), -1, 3)

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
        # the smallest rectangle around the pixels
        top, left = int(row.min()), int(col.min())
        shape = int(row.max()) - top + 1, int(col.max()) - left + 1
        return [self._sites_of(row - top, col - left, (top, left), shape, windows, each) for each in numbers]

    def _sites_of(
        self,
        row: NDArray[np.int64],
        col: NDArray[np.int64],
        corner: tuple[int, int],
        shape: tuple[int, int],
        windows: Windows,
        number: NDArray[np.int64],
    ) -> list[Look]:
        """Looks at pixels in their own windows; row and column are counted from a corner of a rectangle."""
        begin, end = windows.begin_us[number], windows.end_us[number]
        # rows of a rolling shutter have different windows; rounded outwards, many of them share one look
        step = np.maximum((end - begin) / _PARTS, 1.0)
        times = np.stack([np.floor(begin / step) * step, np.ceil(end / step) * step])
        looks, which = distinct_columns(times)
        chosen: list[Look] = []
        for look, (low, high) in enumerate(looks.T):
            kinds = self._outlines(float(low), float(high))
            if not kinds:
                continue
            mine = np.flatnonzero(which == look)
            places = np.full(shape, -1)
            places[row[mine], col[mine]] = mine
            for outlines, rays, is_small in kinds:
                chosen.extend(self._looks(outlines, rays, is_small, places, *corner))
        return chosen

    def _looks(
        self, outlines: list[SweptOutline], rays: int, is_small: bool, places: NDArray[np.int64], top: int, left: int
    ) -> Iterator[Look]:
        """Looks at the pixels inside any outline.

        Parameters
        ----------
        places : number of each pixel within a rectangle that begins at row `top` and column `left`; -1 for pixels that
            were not asked about.
        """
        inside, aimed = np.zeros(places.shape, np.bool_), np.zeros(places.shape, np.bool_)
        sites, targets = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for outline in outlines:
            image, part = self._image(outline, top, left, places.shape, self._tuning.zoom_margin_px)
            if outline.target is None:
                inside[part] |= image
                continue
            aimed[part] |= image
            image, part = self._image(outline, top, left, places.shape, self._aim_margin_px)
            own = places[part][image]
            sites.append(own[own >= 0])
            targets.append(np.full(sites[-1].size, outline.target))
        site, target = np.concatenate(sites), np.concatenate(targets)
        has_target = np.zeros(int(places.max()) + 1, np.bool_)
        has_target[site] = True
        asked = places >= 0
        for some, count in ((inside, rays), (aimed & ~inside, min(rays, self._tuning.aim_rays))):
            place = places[some & asked]
            at = has_target[place]
            if not at.all():
                yield Look(place[~at], count, is_small)
            if at.any():
                listed = np.isin(site, place[at])
                yield Look(place[at], count, is_small, (site[listed], target[listed]))

    def _image(
        self, outline: SweptOutline, top: int, left: int, shape: tuple[int, ...], margin_px: float
    ) -> tuple[NDArray[np.bool_], tuple[slice, slice]]:
        """Pixels inside an outline, in a part of a rectangle that begins at row `top` and column `left`."""
        low = np.maximum(np.floor(outline.low - margin_px).astype(np.int64) - [left, top], 0)
        high = np.minimum(np.ceil(outline.high + margin_px).astype(np.int64) - [left, top], shape[::-1])
        high = np.maximum(low, high)
        x, y = np.arange(low[0], high[0])[None] + left + 0.5, np.arange(low[1], high[1])[:, None] + top + 0.5
        return outline.inside(x, y, margin_px), (slice(low[1], high[1]), slice(low[0], high[0]))

"""Bounds of the motion in the image, and what follows: sample instants of asynchronous sensors, looks of others."""

from collections.abc import Callable
from math import ceil

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.method_cache import method_cache
from hesim_render.core.units import S_PER_US
from hesim_render.mosaic.schedule import CELL_US
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.transport.motion_bounds import fastest_m_per_s, fastest_turn_rad_per_s, places
from hesim_render.sources.render.transport.moving_scene import Group

#: Motion between two instants, pixels. ln x is interpolated linearly between them: the crossings of an edge of
#: contrast 4 are then off by less than 2 % of the time of a tenth of a pixel.
STEP_PX = 0.05
#: Least distance of two instants, µs; keyframes are exempt.
LEAST_US = 10
#: Cells for which distances are taken together, and the part of a distance that is relied on: between the rays that
#: measure how far the scene is, something may be nearer.
_CELLS, _SURE = 16, 0.5
#: Largest number of ticks from one look of few rays to the next. Chosen on the sweep at 800 Hz, judged on the star, for
#: which 8 would save another 4 % of the rays.
_MOST_WINDOWS = 4
#: Least depth of an object that is assumed, as a part of its distance from the camera.
_NEAREST = 0.05


class MotionClock:
    """Sample instants of a scene: a pure function of time, independent of the interval or region that is asked for.

    In every cell of time, the speed in the image is bounded from the speeds of the tracks and the least distances. The
    instants divide a cell evenly, so that nothing moves by more than `STEP_PX` between two of them. Keyframes are
    added.

    Parameters
    ----------
    view : the camera at rest.
    camera : track of the camera, None if it rests.
    groups : moving objects.
    distance_m : least depth, along the camera's axis, of the resting surfaces that are visible at a time in µs, m.
    """

    def __init__(
        self,
        view: View,
        camera: Trajectory | None,
        groups: list[Group],
        distance_m: Callable[[float], float],
    ) -> None:
        self._view, self._camera, self._groups, self._distance_m = view, camera, groups, distance_m
        self._tracks = [group.trajectory for group in groups] + ([camera] if camera else [])
        geometry, lens = view.sensor.spec.geometry, view.sensor.lens
        pitch_mm = geometry.pitch_um * 1e-3
        self._px_per_rad = lens.image_distance_mm / pitch_mm
        left, right, top, bottom = view.followed_mm
        axis_x, axis_y = lens.axis_mm
        reach = max(axis_x - left, right - axis_x), max(axis_y - top, bottom - axis_y)
        corner = np.array(reach) / lens.image_distance_mm
        #: Largest motion in the image, in units of the image distance, for a shift over the depth, and for a turn, rad:
        #: powers of 1/cos of the view angle of the farthest corner of the region.
        self._stretch = float(np.sqrt(1 + corner @ corner))
        self._turned = self._stretch**2
        if view.projection.distortion is not None:
            _, self._stretch, self._turned = view.projection.distortion.steepest
        self._speed_of = method_cache(self._per_metre, maxsize=1024)
        #: All bands of a block ask for the same.
        self.windows_of_a_pixel = method_cache(self._windows_of_a_pixel, maxsize=16)

    def instants_us(self, begin_us: float, end_us: float) -> NDArray[np.int64]:
        """Instants from `begin_us` to `end_us`, both included, in whole µs; multiples of `CELL_US` are among them."""
        cells = range(int(begin_us // CELL_US), -(-int(np.ceil(end_us)) // CELL_US))
        ends = np.rint([begin_us, end_us]).astype(np.int64)
        keyframes = (_keyframes(track, begin_us, end_us) for track in self._tracks)
        instants = np.unique(np.concatenate([ends, *(self._cell(k) for k in cells), *keyframes]))
        return instants[(instants >= ends[0]) & (instants <= ends[1])]

    def _cell(self, number: int) -> NDArray[np.int64]:
        begin, end = number * CELL_US, (number + 1) * CELL_US
        pieces = ceil(self.motion_px(begin, end) / STEP_PX - 1e-9)
        pieces = max(1, min(pieces, CELL_US // LEAST_US))
        return np.rint(np.linspace(begin, end, pieces + 1)).astype(np.int64)

    def _windows_of_a_pixel(self, begin_us: float, end_us: float, windows: int) -> int:
        """Number of windows within which nothing moves by more than a pixel, a power of two, where an interval has so
        many.
        """
        each_px, within = self.motion_px(begin_us, end_us) / max(1, windows), 1
        while within < _MOST_WINDOWS and 2 * within * each_px <= 1:
            within *= 2
        return within

    def motion_px(self, begin_us: float, end_us: float) -> float:
        """Upper bound of the motion of anything in the image within an interval, pixels."""
        turn, shift = 0.0, 0.0
        if self._camera is not None:
            turn = fastest_turn_rad_per_s(self._camera, begin_us, end_us)
            shift = fastest_m_per_s(self._view.camera_to_world[None, :3, 3], self._camera, begin_us, end_us)
        some_us = CELL_US * _CELLS
        first = int(begin_us // some_us)
        every = [self._speed_of(k) for k in range(first, max(first + 1, ceil(end_us / some_us)))]
        resting, nearest = max(one for one, _ in every), np.max([own for _, own in every], axis=0)
        fastest = turn * self._turned + shift * resting
        for group, per_metre in zip(self._groups, nearest, strict=True):
            own = fastest_m_per_s(group.corners, group.trajectory, begin_us, end_us)
            fastest = max(fastest, turn * self._turned + (shift + own) * per_metre)
        return fastest * self._px_per_rad * S_PER_US * (end_us - begin_us)

    def _per_metre(self, number: int) -> tuple[float, list[float]]:
        """Upper bounds within some cells: radians in the image per metre of motion, of resting surfaces and of each
        group.
        """
        begin, end = number * _CELLS * CELL_US, (number + 1) * _CELLS * CELL_US
        resting = 0.0
        if self._camera is not None:
            resting = self._stretch / (_SURE * min(self._distance_m(t) for t in (begin, 0.5 * (begin + end), end)))
        return resting, [self._stretch / self._depth_m(group, begin, end) for group in self._groups]

    def _depth_m(self, group: Group, begin_us: float, end_us: float) -> float:
        """Least depth of a group in front of the camera within an interval, at least a small part of its distance,
        m.
        """
        times = np.array([begin_us, 0.5 * (begin_us + end_us), end_us])
        poses = np.broadcast_to(self._view.camera_to_world, (3, 4, 4))
        moved = 0.0
        if self._camera is not None:
            poses = self._camera.matrix(times) @ poses
            seconds = S_PER_US * 0.25 * (end_us - begin_us)
            moved = seconds * fastest_m_per_s(self._view.camera_to_world[None, :3, 3], self._camera, begin_us, end_us)
        least = np.inf
        for points, margin in places(group.corners, group.trajectory, begin_us, end_us):
            for pose in poses:
                away = points - pose[:3, 3]
                depth = -(away @ pose[:3, 2]) - margin - moved
                floor = _NEAREST * np.linalg.norm(away, axis=-1)
                least = min(least, float(np.maximum(depth, floor).min()))
        return max(least, 1e-6)


def _keyframes(track: Trajectory, begin_us: float, end_us: float) -> NDArray[np.int64]:
    """Keyframes of a track within an interval, and 1 µs after each, because an object may jump there."""
    knots = track.knots_us
    if track.repeat:
        first, last = (np.floor((t - knots[0]) / track.period_us) for t in (begin_us, end_us))
        knots = (knots[:-1] + track.period_us * np.arange(first, last + 2)[:, None]).ravel()
    whole = np.rint(knots[(knots >= begin_us - 1) & (knots <= end_us)]).astype(np.int64)
    return np.concatenate([whole, whole + 1])

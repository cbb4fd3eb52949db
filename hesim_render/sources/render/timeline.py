"""Time slices of a moving scene, short enough that no object moves far within one."""

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.method_cache import method_cache
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.scene.deformation import Deformation
from hesim_render.sources.render.scene.trajectory import Trajectory

#: Least number of steps in which the path of an object's corners is measured between two keyframes.
_LEAST_STEPS = 16
#: Vertices of a mesh whose paths are measured at once.
_CHUNK = 1 << 15
#: Largest turn of one such step.
_STEP_RAD = np.radians(5.0)
#: Longest step in which the camera's motion is measured, µs.
_CAMERA_STEP_US = 2000.0


class Timeline:
    """Slices of an animated scene; a pure function of time, independent of the interval that is asked for.

    Between two keyframes of any object, time is cut evenly into slices. Within a slice, no corner of
    a moving object's bounding box moves more than `max_motion_px` in the image, and no vertex of a mesh that changes
    its shape.

    Parameters
    ----------
    view : the camera at rest.
    camera : track of the camera, None if it rests.
    trajectories : tracks of the moving objects.
    corners : bounding-box corners of each, at rest, [k, 3], m.
    scene_corners : corners of the whole scene's box at rest, [8, 3], m; they bound what a moving camera sees.
    max_motion_px : largest motion within a slice, pixels.
    min_slice_us : shortest slice, µs.
    deformations : shapes of the objects that change them, with or without a track.
    """

    def __init__(
        self,
        view: View,
        camera: Trajectory | None,
        trajectories: Mapping[str, Trajectory],
        corners: Mapping[str, NDArray[np.float64]],
        scene_corners: NDArray[np.float64],
        max_motion_px: float = 0.5,
        min_slice_us: float = 10.0,
        deformations: Mapping[str, Deformation] | None = None,
    ) -> None:
        self._view, self._camera = view, camera
        self._trajectories, self._corners = dict(trajectories), dict(corners)
        self._deformations = dict(deformations or {})
        self._moving: list[Trajectory | Deformation] = [*self._trajectories.values(), *self._deformations.values()]
        self._scene_corners = scene_corners
        self._max_motion_px, self._min_slice_us = max_motion_px, min_slice_us
        self._edges_between = method_cache(self._measure, maxsize=4096)

    def _knots(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """All keyframe times from the last at or before `begin_us` to the first at or after `end_us`."""
        knots: list[NDArray[np.float64]] = []
        for moving in self._moving:
            own = moving.knots_us
            if moving.repeat:
                period = moving.period_us
                first = np.floor((begin_us - own[0]) / period) - 1
                last = np.floor((end_us - own[0]) / period) + 1
                own = (own[None, :-1] + period * np.arange(first, last + 1)[:, None]).ravel()
            knots.append(own)
        every = np.unique(np.concatenate(knots))
        low = every[every <= begin_us]
        high = every[every >= end_us]
        inner = every[(every > begin_us) & (every < end_us)]
        return np.concatenate([low[-1:], inner, high[:1]])

    def _measure(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Slice edges strictly between two neighbouring keyframes."""
        path_px = 0.0
        for name in dict.fromkeys((*self._trajectories, *self._deformations)):
            trajectory = self._trajectories.get(name)
            turn = 0.0 if trajectory is None else float(np.max(np.abs(trajectory.arc_rad)))
            steps = _LEAST_STEPS + int(np.ceil(turn / _STEP_RAD))
            times = np.linspace(begin_us, end_us, steps + 1)
            # a repeating track jumps at the knot itself: use the pose before the jump
            times[-1] -= 1e-6 * (end_us - begin_us)
            poses = np.broadcast_to(np.eye(4), (times.size, 4, 4)) if trajectory is None else trajectory.matrix(times)
            camera = np.broadcast_to(self._view.camera_to_world, poses.shape)
            if self._camera is not None:
                camera = self._camera.matrix(times) @ camera
            for rest in self._points(name, times):
                points = rest @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
                # project both positions through the same camera, because each ray follows the camera's motion itself
                first = self._view.project(points[:-1], camera[:-1])
                second = self._view.project(points[1:], camera[:-1])
                step_px = np.linalg.norm(second - first, axis=-1).max(axis=-1)
                path_px = max(path_px, float(step_px.max()) * steps)
        pieces = int(np.ceil(path_px / self._max_motion_px - 1e-9))
        pieces = max(1, min(pieces, int((end_us - begin_us) / self._min_slice_us)))
        return np.linspace(begin_us, end_us, pieces + 1)[1:-1]

    def _points(self, name: str, times_us: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        """Points of an object whose paths bound its motion, before its track: corners of its box [n, 3], or the
        vertices of a mesh that changes its shape, [time, n, 3], some at a time.
        """
        deformation = self._deformations.get(name)
        if deformation is None:
            yield self._corners[name]
            return
        for first in range(0, deformation.vertices_m.shape[1], _CHUNK):
            yield deformation.part(slice(first, first + _CHUNK)).at(times_us)

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval between which the image moves by `max_motion_px` or less, µs.

        Motion of objects and of the camera counts. The times are the slice edges and, evenly between them, as many
        more as the camera's motion requires.
        """
        bounds = np.concatenate([[begin_us], self.edges_us(begin_us, end_us), [end_us]])
        if self._camera is None:
            return bounds[1:-1]
        pieces = [np.linspace(a, b, self._camera_pieces(a, b) + 1)[:-1] for a, b in pairwise(bounds)]
        return np.concatenate(pieces)[1:]

    def _camera_pieces(self, begin_us: float, end_us: float) -> int:
        """Number of parts of an interval that keeps the camera's own image motion below the limit."""
        pieces = int(np.ceil(self.camera_motion_px(begin_us, end_us) / self._max_motion_px - 1e-9))
        return max(1, min(pieces, int((end_us - begin_us) / self._min_slice_us)))

    def camera_motion_px(self, begin_us: float, end_us: float) -> float:
        """Upper bound of the image motion of resting surfaces during an interval, pixels.

        It is measured at the nearest and the farthest corner of the scene's box, at the speed of the fastest part.
        """
        if self._camera is None:
            return 0.0
        times = np.linspace(begin_us, end_us, max(_LEAST_STEPS, int((end_us - begin_us) / _CAMERA_STEP_US)) + 1)
        poses = self._camera.matrix(times) @ self._view.camera_to_world
        fastest_px = 0.0
        for now, then in zip(poses[:-1], poses[1:], strict=True):
            depth = (now[:3, 3] - self._scene_corners) @ now[:3, 2]
            farthest = max(float(depth.max()), 1e-3)
            nearest = max(float(depth.min()), 0.05 * farthest)
            seen = self._view.unproject(np.array([nearest, farthest]), now)
            moved = self._view.project(seen, then) - self._view.project(seen, now)
            fastest_px = max(fastest_px, float(np.linalg.norm(moved, axis=-1).max()))
        return fastest_px * (times.size - 1)

    def edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """All slice edges strictly inside an interval, increasing."""
        if not self._moving:
            return np.empty(0)
        knots = self._knots(begin_us, end_us)
        between = [self._edges_between(float(a), float(b)) for a, b in zip(knots[:-1], knots[1:], strict=True)]
        every = np.unique(np.concatenate([knots, *between]))
        return every[(every > begin_us) & (every < end_us)]

    def pose_time_us(self, begin_us: float, end_us: float) -> float:
        """Middle of the slice that contains an interval, µs: objects are drawn at their pose of this time."""
        middle = (begin_us + end_us) / 2
        if not self._moving:
            return middle
        knots = self._knots(middle, middle)
        if knots[0] > middle or knots[-1] < middle:  # the pose is held before the first and after the last keyframe
            return middle
        if knots[0] == knots[-1]:
            return float(knots[0])
        edges = np.concatenate([knots, self._edges_between(float(knots[0]), float(knots[-1]))])
        edges.sort()
        right = int(np.clip(np.searchsorted(edges, middle, side="right"), 1, edges.size - 1))
        return float(edges[right - 1] + edges[right]) / 2

"""What the camera of a scene has in its picture, before anything is rendered."""

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import HesimWarning
from hesim_render.core.units import MM_PER_M
from hesim_render.sources.render.camera import View
from hesim_render.sources.render.scene.parents import camera_trajectory, trajectories
from hesim_render.specs.scene import SceneSpec
from hesim_render.targets.points import placement, surface_points

#: Points across and along the target that are looked for in the picture, and times at which they are.
_POINTS, _TIMES = 33, 33


@dataclass(frozen=True)
class Framing:
    """The target in the picture at one time.

    Parameters
    ----------
    inside : share of the target's surface that is in the picture, 0 to 1; other objects do not count.
    is_seen : False if no part of it is in the picture, however small.
    fills : width and height of the target's image over those of the picture.
    from_behind : True if the camera looks at the back of the target, which is black.
    mm_per_px : size of a pixel on the target's centre, across the line of sight, mm.
    distance_m : from the entrance pupil to the target's centre.
    """

    inside: float
    is_seen: bool
    fills: tuple[float, float]
    from_behind: bool
    mm_per_px: float
    distance_m: float

    def __str__(self) -> str:
        width, height = self.fills
        inside = "under 1%" if self.is_seen and self.inside < 0.01 else f"{self.inside:.0%}"
        back = ", seen from behind" if self.from_behind else ""
        return (
            f"the target's image is {width:.0%} of the picture's width and {height:.0%} of its height; "
            f"{inside} of the target is in the picture{back}; "
            f"a pixel is {self.mm_per_px:.3g} mm on it, {self.distance_m:.4g} m away"
        )


def posed_view(spec: SceneSpec, view: View, t_us: float) -> View:
    """The view at a time, with the motion of the camera."""
    camera = camera_trajectory(spec)
    return view if camera is None else replace(view, camera_to_world=camera.matrix(t_us) @ view.camera_to_world)


def _target_pose(spec: SceneSpec, t_us: float) -> NDArray[np.float64]:
    """Pose [4, 4] of the target at a time."""
    assert spec.target is not None
    track = trajectories(spec).get("target")
    return placement(spec.target) if track is None else track.matrix(t_us) @ placement(spec.target)


def framing(spec: SceneSpec, view: View, t_us: float = 0.0) -> Framing | None:
    """How the target lies in the picture at a time; None if the scene has no target.

    Parameters
    ----------
    spec : content of the scene file.
    view : the placed camera at rest.
    t_us : time, µs.
    """
    if spec.target is None:
        return None
    pose = _target_pose(spec, t_us)
    points = surface_points(spec.target, _POINTS) @ pose[:3, :3].T + pose[:3, 3]
    at = posed_view(spec, view, t_us)
    camera = at.camera_to_world
    depth = -((points - camera[:3, 3]) @ camera[:3, :3])[:, 2]
    place = at.project(points, camera)
    cols, rows = view.sensor.cols, view.sensor.rows
    ahead = depth > max(view.near_m, 0.0)
    inside = ahead & np.all((place >= 0) & (place <= [cols, rows]), axis=1)
    size = np.ptp(place[ahead], axis=0) / [cols, rows] if ahead.any() else np.zeros(2)
    middle = pose[:3, 3]
    towards = camera[:3, 3] - middle
    pitch_mm = view.sensor.spec.geometry.pitch_um * 1e-3
    middle_depth = float(-((middle - camera[:3, 3]) @ camera[:3, :3])[2])
    return Framing(
        float(inside.mean()),
        bool(inside.any()) or _is_met(points - camera[:3, 3], at.unproject(np.ones(1), camera) - camera[:3, 3]),
        (float(size[0]), float(size[1])),
        bool(towards @ pose[:3, 2] <= 0),
        pitch_mm * MM_PER_M * abs(middle_depth) / view.sensor.lens.image_distance_mm,
        float(np.linalg.norm(towards)),
    )


def _is_met(points: NDArray[np.float64], rays: NDArray[np.float64]) -> bool:
    """True if one of the rays [n, 3] from the origin meets the target, whose grid of points is [m², 3]: so does the
    picture of a part of it that lies between the points.
    """
    grid = points.reshape(_POINTS, _POINTS, 3)
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]).reshape(4, -1, 3)
    # a ray is within the pyramid from the origin to a cell if it is on the same side of its four faces
    sides = np.cross(corners, np.roll(corners, -1, axis=0)) @ rays.T
    ahead = np.einsum("kni->ni", corners) @ rays.T > 0
    return bool((ahead & (np.all(sides >= 0, axis=0) | np.all(sides <= 0, axis=0))).any())


def warn_if_unseen(spec: SceneSpec, view: View, duration_us: float) -> None:
    """Warn if the target is never in the picture, or only from behind.

    Parameters
    ----------
    spec : content of the scene file.
    view : the placed camera at rest.
    duration_us : length of the run; the target is looked for at some times of it, µs.
    """
    moves = any(track.object in ("target", "camera") for track in spec.motion)
    times = np.linspace(0, duration_us, _TIMES) if moves else np.zeros(1)
    views = [seen for seen in (framing(spec, view, float(t)) for t in times) if seen is not None]
    if not views:
        return
    file = f"{spec.file}: " if spec.file is not None else ""
    if not any(seen.is_seen for seen in views):
        problem = "no part of the target is in the picture at any time of the run (see --framing)"
    elif all(seen.from_behind for seen in views if seen.is_seen):
        problem = "the camera sees the target from behind, where it is black (see --framing)"
    else:
        return
    warnings.warn(f"{file}{problem}", HesimWarning, stacklevel=3)


def outline(spec: SceneSpec, view: View) -> NDArray[np.float64] | None:
    """Column and row of points around the target at t = 0, [n, 2], px of the region; None if it has no target or is
    partly behind the camera.
    """
    if spec.target is None:
        return None
    pose = _target_pose(spec, 0.0)
    grid = surface_points(spec.target, _POINTS).reshape(_POINTS, _POINTS, 3)
    rim = np.concatenate([grid[0], grid[1:, -1], grid[-1, -2::-1], grid[-2::-1, 0]])
    points = rim @ pose[:3, :3].T + pose[:3, 3]
    at = posed_view(spec, view, 0.0)
    camera = at.camera_to_world
    if np.any(-((points - camera[:3, 3]) @ camera[:3, :3])[:, 2] <= 0):
        return None
    return at.project(points, camera)

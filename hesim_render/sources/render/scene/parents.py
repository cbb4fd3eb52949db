"""Trajectories of a scene's objects and camera, with the motion of their parents in them."""

import json
from functools import lru_cache
from math import lcm

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.specs.motion import TrackSpec
from hesim_render.specs.scene import SceneSpec

#: Largest deviation of a track from the product of its parent's motion and its own: of the pivot, m, and of the turn.
_FAR_M, _FAR_RAD = 1e-6, 1e-5
#: Largest turn between two keyframes, rad: the shorter arc must be the right one.
_MOST_TURN_RAD = 1.5
#: Most keyframes of a track with a parent.
_MOST_KEYFRAMES = 50_000
#: Shares of a segment at which the deviation is looked at.
_INSIDE = np.array([0.25, 0.5, 0.75])


def trajectories(spec: SceneSpec) -> dict[str, Trajectory]:
    """Trajectory of everything that has a track, by name (``camera`` among them).

    Raises
    ------
    SpecError
        If the motion of a parent and of its child cannot be made one track.
    """
    if not any(track.parent for track in spec.motion):
        return {track.object: Trajectory(track) for track in spec.motion}
    text = json.dumps([track.model_dump(mode="json") for track in spec.motion])
    try:
        return dict(_composed(text))
    except SpecError as error:
        raise SpecError(str(error), file=spec.file, key="motion") from None


def camera_trajectory(spec: SceneSpec) -> Trajectory | None:
    """Trajectory of the camera; None if it stands still."""
    track = trajectories(spec).get("camera")
    return track if track is not None and track.moves else None


@lru_cache(maxsize=8)
def _composed(text: str) -> dict[str, Trajectory]:
    tracks = {track.object: track for track in map(TrackSpec.model_validate, json.loads(text))}
    composed: dict[str, Trajectory] = {}

    def resolve(name: str) -> Trajectory:
        if name not in composed:
            own = tracks[name]
            composed[name] = Trajectory(own) if own.parent is None else _product(resolve(own.parent), own)
        return composed[name]

    return {name: resolve(name) for name in tracks}


def _product(parent: Trajectory, own: TrackSpec) -> Trajectory:
    """The track that moves as `own` on something that moves as `parent`; if one of them is at rest, the other.

    Keyframes are set where one of the two has them, and between them as densely as the tolerance asks for.
    """
    child = Trajectory(own)
    for still, other in ((child, parent), (parent, child)):
        if not still.moves and np.array_equal(still.matrix(0.0), np.eye(4)):
            return other
    begin, end, repeat = _span(parent, child, own.object)
    inner = [track.ends_us(begin, end) for track in (parent, child)]
    times = np.unique(np.concatenate([[begin, end], *inner])).astype(np.int64)
    done, waiting = [times[:1]], np.stack([times[:-1], times[1:]], axis=1)
    while waiting.size:
        enough = (waiting[:, 1] - waiting[:, 0] <= 1) | _is_enough(parent, child, waiting)
        done.append(waiting[enough, 1])
        first, last = waiting[~enough].T
        middle = (first + last) // 2
        waiting = np.concatenate([np.stack([first, middle], axis=1), np.stack([middle, last], axis=1)])
        if sum(map(len, done)) + len(waiting) > _MOST_KEYFRAMES:
            raise SpecError(
                f"{own.object!r} and its parent {own.parent!r} turn so often that their motion needs more than "
                f"{_MOST_KEYFRAMES} keyframes; shorten their tracks"
            )
    knots = np.sort(np.concatenate(done))
    poses = parent.matrix(knots) @ child.matrix(knots)
    if repeat:  # a repeating track jumps at its last keyframe: what counts is the pose before it
        poses[-1] = _before(parent, end) @ _before(child, end)
    frames = [{"t_us": t, "matrix": pose.tolist()} for t, pose in zip(knots.tolist(), poses, strict=True)]
    content = {"object": own.object, "pivot_m": own.pivot_m, "repeat": repeat, "keyframes": frames}
    return Trajectory(TrackSpec.model_validate(content))


def _span(parent: Trajectory, child: Trajectory, name: str) -> tuple[float, float, bool]:
    """First and last keyframe of the product, µs, and whether it repeats.

    Where only one of both moves, the product is as that one. Where one of both repeats, the product lasts from 0, or
    the other's first keyframe if that is earlier, to the other's last keyframe, and holds its pose then. Where both
    repeat it repeats with a period that contains both.
    """
    moving = [track for track in (parent, child) if track.moves] or [parent]
    if len(moving) == 1:
        return float(moving[0].knots_us[0]), float(moving[0].knots_us[-1]), moving[0].repeat
    ends = [track for track in (parent, child) if not track.repeat]
    if ends:
        low, high = min(track.knots_us[0] for track in ends), max(track.knots_us[-1] for track in ends)
        return (float(low) if len(ends) == 2 else float(min(low, 0.0))), float(high), False
    if parent.knots_us[0] != child.knots_us[0]:
        raise SpecError(f"{name!r} and its parent both repeat; their first keyframes must be at the same time")
    period = lcm(int(parent.period_us), int(child.period_us))
    return float(parent.knots_us[0]), float(parent.knots_us[0] + period), True


def _before(track: Trajectory, t_us: float) -> NDArray[np.float64]:
    """Pose at a time, before the jump of a repeating track there."""
    return np.asarray(track.throughout(np.array([t_us - 1.0, t_us]))[1][-1])


def _is_enough(parent: Trajectory, child: Trajectory, spans: NDArray[np.int64]) -> NDArray[np.bool_]:
    """True for intervals [n, 2], in which neither track has a keyframe, of which a keyframe at either end tells all."""
    shares = np.concatenate([[0.0], _INSIDE, [1.0]])
    times = spans[:, :1] + (spans[:, 1:] - spans[:, :1]) * shares
    (above_segment, above), (below_segment, below) = parent.throughout(times), child.throughout(times)
    turned = _turn(parent, above_segment, spans) + _turn(child, below_segment, spans)
    is_enough = turned <= _MOST_TURN_RAD
    poses = (above @ below)[is_enough]
    begin, inside, end = poses[:, 0], poses[:, 1:-1], poses[:, -1]
    turn = Rotation.from_matrix(end[:, :3, :3] @ begin[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    part = Rotation.from_rotvec((_INSIDE[:, None] * turn[:, None]).reshape(-1, 3)).as_matrix()
    rotation = part.reshape(-1, _INSIDE.size, 3, 3) @ begin[:, None, :3, :3]
    off = Rotation.from_matrix((inside[..., :3, :3] @ rotation.swapaxes(-1, -2)).reshape(-1, 3, 3)).magnitude()
    pivot = np.append(child.pivot_m, 1.0)
    straight = (begin @ pivot)[:, None] + _INSIDE[:, None] * (end @ pivot - begin @ pivot)[:, None]
    away = np.linalg.norm(inside @ pivot - straight, axis=-1)
    is_enough[is_enough] = (off.reshape(away.shape).max(axis=1) <= _FAR_RAD) & (away.max(axis=1) <= _FAR_M)
    return is_enough


def _turn(track: Trajectory, segment: NDArray[np.intp], spans: NDArray[np.int64]) -> NDArray[np.float64]:
    """Angle by which a track turns in intervals, rad, whole turns included."""
    length = np.diff(track.knots_us)[segment]
    return np.abs(track.arc_rad[segment]) * np.diff(spans, axis=1)[:, 0] / length

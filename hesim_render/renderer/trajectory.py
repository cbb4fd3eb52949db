"""Keyframed rigid poses: where an object or the camera is at any time."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, radians
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.backend import jit
from hesim_render.specs.scene import KeyframeSpec, TrackSpec

Quaternion = NDArray[np.float64]  # w, x, y, z
_EPSILON = 1e-12


def _axis_angle(axis: NDArray[np.float64], angle_rad: NDArray[np.float64]) -> Quaternion:
    """Quaternions [..., 4] of rotations about unit axes [..., 3]."""
    half = np.asarray(angle_rad, dtype=np.float64)[..., None] / 2
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def _multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """p · q: rotate by q, then by p."""
    w = p[..., :1] * q[..., :1] - np.sum(p[..., 1:] * q[..., 1:], axis=-1, keepdims=True)
    v = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([w, v], axis=-1)


def rotation_matrix(q: Quaternion) -> NDArray[np.float64]:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_about(axis: ArrayLike, angle_deg: float) -> NDArray[np.float64]:
    """Matrix [3, 3] of a right-handed turn by `angle_deg` about `axis` (any length but zero)."""
    direction = np.asarray(axis, dtype=np.float64)
    return rotation_matrix(_axis_angle(direction / np.linalg.norm(direction), np.array(radians(angle_deg))))


def _unit(axis: ArrayLike) -> NDArray[np.float64]:
    vector = np.asarray(axis, dtype=np.float64)
    return vector / np.linalg.norm(vector)


def _arc(start: KeyframeSpec, end: KeyframeSpec) -> tuple[NDArray[np.float64], float]:
    """Axis and angle (rad, any number of turns) of the rotation that leads from one keyframe to the next."""
    if start.rotation_deg == 0:
        return _unit(end.rotation_axis), radians(end.rotation_deg)
    if end.rotation_deg == 0:
        return _unit(start.rotation_axis), -radians(start.rotation_deg)
    a, b = _unit(start.rotation_axis), _unit(end.rotation_axis)
    if abs(abs(a @ b) - 1) < 1e-9:
        return a, radians(end.rotation_deg * np.sign(a @ b) - start.rotation_deg)
    first = _axis_angle(a, np.array(radians(start.rotation_deg)))
    second = _axis_angle(b, np.array(radians(end.rotation_deg)))
    step = _multiply(second, first * np.array([1, -1, -1, -1]))
    step = -step if step[0] < 0 else step  # the shorter of the two arcs
    sine = float(np.linalg.norm(step[1:]))
    if sine < _EPSILON:
        return a, 0.0
    return step[1:] / sine, 2 * float(np.arctan2(sine, step[0]))


@dataclass(frozen=True)
class DevicePose:
    """Rigid poses, one a lane: x → R x + shift; `columns` are those of R."""

    columns: tuple[Any, Any, Any]
    shift: Any

    @classmethod
    def about(cls, w: Any, v: Any, pivot: Any, shift: Any) -> DevicePose:
        """x → R (x − pivot) + pivot + shift, R from the unit quaternion (w, v)."""
        import drjit as dr

        x, y, z = v
        vector = type(v)
        rest = cls(
            (
                vector(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
                vector(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
                vector(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
            ),
            dr.zeros(vector),
        )
        return cls(rest.columns, shift + pivot - rest.turn_to_world(pivot))

    @classmethod
    def none(cls, vector: Any) -> DevicePose:
        """Of what stays where it is."""
        import drjit as dr

        return cls((vector(1, 0, 0), vector(0, 1, 0), vector(0, 0, 1)), dr.zeros(vector))

    def where(self, condition: Any, other: DevicePose) -> DevicePose:
        """This pose in lanes where a condition holds, another one in the rest."""
        import drjit as dr

        columns = (dr.select(condition, a, b) for a, b in zip(self.columns, other.columns, strict=True))
        return DevicePose(tuple(columns), dr.select(condition, self.shift, other.shift))

    def turn_to_world(self, direction: Any) -> Any:
        import drjit as dr

        (x, y, z), (first, second, third) = direction, self.columns
        return dr.fma(first, x, dr.fma(second, y, third * z))

    def to_world(self, point: Any) -> Any:
        import drjit as dr

        (x, y, z), (first, second, third) = point, self.columns
        return dr.fma(first, x, dr.fma(second, y, dr.fma(third, z, self.shift)))

    def turn_to_rest(self, direction: Any) -> Any:
        import drjit as dr

        vector = type(self.shift)
        return vector(*(dr.dot(column, vector(direction)) for column in self.columns))

    def to_rest(self, point: Any) -> Any:
        return self.turn_to_rest(type(self.shift)(point) - self.shift)


class Piece(NamedTuple):
    """Part of the segment between two keyframes.

    Parameters
    ----------
    segment : its number.
    first, last : shares of it, 0 to 1.
    length_us : of the part.
    """

    segment: int
    first: float
    last: float
    length_us: float


class Trajectory:
    """A track evaluated: pose(t) = translate(T(t)) · pivot + R(t) · (x − pivot).

    Between keyframes T is linear and R turns at constant angular speed: about the shared axis, any
    number of turns, where both keyframes name the same axis (a rotation of 0 shares every axis);
    along the shortest arc otherwise. Outside the keyframes the pose is held, or the track repeats
    with the period from its first to its last keyframe.

    Parameters
    ----------
    track : keyframes as written in the scene file, angles in degrees, lengths in metres.
    """

    def __init__(self, track: TrackSpec) -> None:
        frames = track.keyframes
        self.repeat = track.repeat
        self.pivot_m = np.array(track.pivot_m, dtype=np.float64)
        self.knots_us = np.array([frame.t_us for frame in frames], dtype=np.float64)
        self.translation_m = np.array([frame.translation_m for frame in frames], dtype=np.float64)
        arcs = [_arc(start, end) for start, end in zip(frames[:-1], frames[1:], strict=True)]
        self.arc_axis = np.array([axis for axis, _ in arcs])
        self.arc_rad = np.array([angle for _, angle in arcs])
        self.start_rotation = np.array(
            [_axis_angle(_unit(f.rotation_axis), np.array(radians(f.rotation_deg))) for f in frames[:-1]]
        )
        self._device: tuple[Any, ...] | None = None

    @property
    def period_us(self) -> float:
        """From the first keyframe to the last."""
        return float(self.knots_us[-1] - self.knots_us[0])

    @property
    def moves(self) -> bool:
        """Whether the pose changes at all."""
        return bool(np.any(np.ptp(self.translation_m, axis=0) > 0) or np.any(np.abs(self.arc_rad) > 0))

    def local_us(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Time since the first keyframe, wrapped where the track repeats, else held to its ends."""
        local = np.asarray(t_us, dtype=np.float64) - self.knots_us[0]
        return np.mod(local, self.period_us) if self.repeat else np.clip(local, 0.0, self.period_us)

    def matrix(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Pose at one or many times: 4×4 rigid matrices, shape [..., 4, 4] for times of shape [...]."""
        local = self.local_us(t_us)
        knots = self.knots_us - self.knots_us[0]
        segment = np.clip(np.searchsorted(knots, local, side="right") - 1, 0, knots.size - 2)
        return self.within(segment, (local - knots[segment]) / (knots[segment + 1] - knots[segment]))

    def within(self, segment: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pose in the segments between two keyframes at a share of each, 0 to 1 with both ends; [..., 4, 4]."""
        turn = _axis_angle(self.arc_axis[segment], share * self.arc_rad[segment])
        rotation = rotation_matrix(_multiply(turn, self.start_rotation[segment]))
        start = self.translation_m[segment]
        translation = start + share[..., None] * (self.translation_m[segment + 1] - start)
        pose = np.zeros((*share.shape, 4, 4))
        pose[..., :3, :3] = rotation
        pose[..., :3, 3] = translation + self.pivot_m - rotation @ self.pivot_m
        pose[..., 3, 3] = 1.0
        return pose

    def pieces(self, begin_us: float, end_us: float) -> list[Piece]:
        """What an interval has of the segments between keyframes, in order of time; no pose is left out.

        A track that repeats jumps at its last keyframe, which is therefore the end of one piece and the begin of the
        next. Of an interval of a period or more each segment comes once.
        """
        knots = self.knots_us - self.knots_us[0]
        period = float(knots[-1])
        if not self.repeat:
            spans = [tuple(np.clip([begin_us, end_us], *self.knots_us[[0, -1]]) - self.knots_us[0])]
        elif end_us - begin_us >= period:
            spans = [(0.0, period)]
        else:
            first = float(self.local_us(begin_us))
            last = first + end_us - begin_us
            spans = [(first, last)] if last <= period else [(first, period), (0.0, last - period)]
        found = []
        for low, high in spans:
            for segment in range(knots.size - 1):
                a, b = max(low, knots[segment]), min(high, knots[segment + 1])
                if a <= b:
                    length = knots[segment + 1] - knots[segment]
                    found.append(Piece(segment, (a - knots[segment]) / length, (b - knots[segment]) / length, b - a))
        return found

    def pose_at(self, local_us: Any) -> DevicePose:
        """Pose of every lane at its own time.

        Parameters
        ----------
        local_us : Dr.Jit Float, time since the first keyframe as from `local_us`; it may run past the
            end of the track by less than a period.
        """
        import drjit as dr

        types = jit()
        floats, vector = types.Float, types.Array3f
        if self._device is None:
            knots = self.knots_us - self.knots_us[0]
            # one row a segment, fetched as four packets of four: gathers of single numbers cost more than the poses
            rows = [
                *(knots[:-1, None], 1 / np.diff(knots)[:, None], self.arc_rad[:, None] / 2, self.arc_axis),
                *(self.start_rotation, self.translation_m[:-1], np.diff(self.translation_m, axis=0)),
            ]
            tables = np.hstack(rows), knots, knots[-1:]
            segments, times, period = (floats(table.astype(np.float32).ravel()) for table in tables)
            self._device = segments, times, period, vector(*(floats(float(x)) for x in self.pivot_m))
            dr.make_opaque(*self._device)
        segments, times, period, pivot = self._device
        if self.repeat:
            local_us = dr.select(local_us >= period, local_us - period * dr.floor(local_us / period), local_us)
        local_us = dr.clip(local_us, 0, period)
        last = self.knots_us.size - 1
        after = dr.binary_search(1, last, lambda i: dr.gather(floats, times, types.UInt32(i)) <= local_us)
        first = 4 * (types.UInt32(after) - 1)
        row = [x for k in range(4) for x in dr.gather(types.Array4f, segments, first + k)]
        share = (local_us - row[0]) * row[1]
        sine, cosine = dr.sincos(share * row[2])
        turn_v = vector(*row[3:6]) * sine
        base_w, base_v = row[6], vector(*row[7:10])
        return DevicePose.about(
            w=cosine * base_w - dr.dot(turn_v, base_v),
            v=cosine * base_v + base_w * turn_v + dr.cross(turn_v, base_v),
            pivot=pivot,
            shift=dr.fma(vector(*row[13:16]), share, vector(*row[10:13])),
        )

    def __repr__(self) -> str:
        turns = degrees(float(np.sum(np.abs(self.arc_rad))))
        return f"Trajectory({self.knots_us.size} keyframes, {self.period_us:g} µs, {turns:g}° in all)"

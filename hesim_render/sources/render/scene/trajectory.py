"""Keyframed rigid poses: the pose of an object or of the camera at any time."""

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from math import degrees, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from hesim_render.core.device_types import Float
from hesim_render.sources.render.scene.tracks import DevicePose, Tracks
from hesim_render.specs.motion import KeyframeSpec, TrackSpec

_EPSILON = 1e-12


def _unit(axis: ArrayLike) -> NDArray[np.float64]:
    vector = np.asarray(axis, dtype=np.float64)
    return vector / np.linalg.norm(vector)


def _arcs(frames: Sequence[KeyframeSpec]) -> list[tuple[NDArray[np.float64], float]]:
    """Axis and angle (rad, any number of turns) of the rotation from each keyframe to the next."""
    arcs = [_about_one_axis(start, end) for start, end in pairwise(frames)]
    shortest = [number for number, arc in enumerate(arcs) if arc is None]
    if shortest:
        vectors = np.array([radians(frame.rotation_deg) * _unit(frame.rotation_axis) for frame in frames])
        every = Rotation.from_rotvec(vectors)
        first, second = every[shortest], every[[number + 1 for number in shortest]]
        for number, turn in zip(shortest, (second * first.inv()).as_rotvec(), strict=True):
            angle = float(np.linalg.norm(turn))
            axis = _unit(frames[number].rotation_axis)
            arcs[number] = (axis, 0.0) if angle < _EPSILON else (turn / angle, angle)
    return [arc for arc in arcs if arc is not None]


def _about_one_axis(start: KeyframeSpec, end: KeyframeSpec) -> tuple[NDArray[np.float64], float] | None:
    """Axis and angle where both keyframes turn about one axis; None where the rotation takes the shorter arc."""
    if start.rotation_deg == 0:
        return _unit(end.rotation_axis), radians(end.rotation_deg)
    if end.rotation_deg == 0:
        return _unit(start.rotation_axis), -radians(start.rotation_deg)
    a, b = _unit(start.rotation_axis), _unit(end.rotation_axis)
    if abs(abs(a @ b) - 1) < 1e-9:
        return a, radians(end.rotation_deg * np.sign(a @ b) - start.rotation_deg)
    return None


class Piece(NamedTuple):
    """Part of the segment between two keyframes.

    Parameters
    ----------
    segment : number of the segment.
    first, last : begin and end of the part as shares of the segment, 0 to 1.
    length_us : length of the part, µs.
    """

    segment: int
    first: float
    last: float
    length_us: float


class Trajectory:
    """A track evaluated: pose(t) = translate(T(t)) · pivot + R(t) · (x − pivot).

    Between keyframes T is linear and R turns at constant angular speed. If both keyframes name the same axis, R turns
    about that axis, by any number of turns (a rotation of 0 shares every axis); otherwise it takes the shortest arc.
    Outside the keyframes the pose is held, or the track repeats with the period from its first to its last keyframe.

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
        arcs = _arcs(frames)
        self.arc_axis = np.array([axis for axis, _ in arcs])
        self.arc_rad = np.array([angle for _, angle in arcs])
        turns = [radians(frame.rotation_deg) * _unit(frame.rotation_axis) for frame in frames[:-1]]
        self._starts = Rotation.from_rotvec(np.array(turns))
        #: Quaternions [segment, 4], scalar first.
        self.start_rotation = self._starts.as_quat(scalar_first=True)

    @property
    def period_us(self) -> float:
        """Time from the first keyframe to the last, µs."""
        return float(self.knots_us[-1] - self.knots_us[0])

    @property
    def moves(self) -> bool:
        """True if the pose changes at all."""
        return bool(np.any(np.ptp(self.translation_m, axis=0) > 0) or np.any(np.abs(self.arc_rad) > 0))

    def local_us(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Time since the first keyframe, µs, wrapped if the track repeats, otherwise clipped to its ends."""
        local = np.asarray(t_us, dtype=np.float64) - self.knots_us[0]
        return np.mod(local, self.period_us) if self.repeat else np.clip(local, 0.0, self.period_us)

    def matrix(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Pose at one or many times: 4×4 rigid matrices, shape [..., 4, 4] for times of shape [...]."""
        return self.within(*self.segments(self.local_us(t_us))[:2])

    def segments(
        self, local_us: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """Segment of times since the first keyframe, the share of it that has passed, and its length, µs."""
        knots = self.knots_us - self.knots_us[0]
        segment = np.clip(np.searchsorted(knots, local_us, side="right") - 1, 0, knots.size - 2)
        length = knots[segment + 1] - knots[segment]
        return segment, (local_us - knots[segment]) / length, length

    def throughout(self, times_us: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Segments of time intervals [...], and poses at times of each, [..., k, 4, 4], for times of shape [..., k].

        No time of `ends_us` may lie inside an interval. At its end the pose is the one before the jump of a repeating
        track.
        """
        # the middle of an interval tells its segment; its ends may be keyframes, which belong to two
        middle = 0.5 * (times_us[..., 0] + times_us[..., -1])
        knots, local = self.knots_us - self.knots_us[0], self.local_us(middle)
        segment, _, length = self.segments(local)
        if not self.repeat:  # the pose is held before and after
            local = middle - self.knots_us[0]
        share = (local[..., None] + times_us - middle[..., None] - knots[segment][..., None]) / length[..., None]
        return segment, self.within(np.broadcast_to(segment[..., None], share.shape), np.clip(share, 0.0, 1.0))

    def within(self, segment: NDArray[np.integer], share: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pose in segments at a share of each, 0 to 1 with both ends included; [..., 4, 4]."""
        each = np.ravel(segment)
        turn = Rotation.from_rotvec((np.ravel(share) * self.arc_rad[each])[:, None] * self.arc_axis[each])
        rotation = (turn * self._starts[each]).as_matrix().reshape(*share.shape, 3, 3)
        start = self.translation_m[segment]
        translation = start + share[..., None] * (self.translation_m[segment + 1] - start)
        pose = np.zeros((*share.shape, 4, 4))
        pose[..., :3, :3] = rotation
        # translate · pivot + R (x − pivot), as one matrix
        pose[..., :3, 3] = translation + self.pivot_m - rotation @ self.pivot_m
        pose[..., 3, 3] = 1.0
        return pose

    def pieces(self, begin_us: float, end_us: float) -> list[Piece]:
        """The parts of segments that lie in an interval, in order of time; together they contain all poses.

        A repeating track jumps at its last keyframe, so that keyframe ends one piece and begins the next. In an
        interval of a period or more each segment occurs once.
        """
        knots = self.knots_us - self.knots_us[0]
        period = float(knots[-1])
        if not self.repeat:
            spans = [tuple(np.clip([begin_us, end_us], *self.knots_us[[0, -1]]) - self.knots_us[0])]
        elif end_us - begin_us >= period:
            spans = [(0.0, period)]
        else:
            # an interval that passes the last keyframe goes on from the first
            first = float(self.local_us(begin_us))
            last = first + end_us - begin_us
            spans = [(first, last)] if last <= period else [(first, period), (0.0, last - period)]
        pieces = []
        for low, high in spans:
            # only segments that end at or after its begin, and begin at or before its end: tracks have many
            first_segment = max(0, int(np.searchsorted(knots, low, side="left")) - 1)
            for segment in range(first_segment, min(knots.size - 1, int(np.searchsorted(knots, high, side="right")))):
                a, b = max(low, knots[segment]), min(high, knots[segment + 1])
                length = knots[segment + 1] - knots[segment]
                pieces.append(Piece(segment, (a - knots[segment]) / length, (b - knots[segment]) / length, b - a))
        return pieces

    def ends_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval at which a segment between two keyframes begins or ends, µs, in order."""
        knots, first = self.knots_us, np.zeros(1)
        if self.repeat:
            first = np.arange(
                np.floor((begin_us - knots[0]) / self.period_us), np.ceil((end_us - knots[0]) / self.period_us)
            )
        times = np.unique((knots + self.period_us * first[:, None]).ravel())
        return times[(times > begin_us) & (times < end_us)]

    def pose_at(self, local_us: Float) -> DevicePose:
        """Pose of every lane at its own time.

        Parameters
        ----------
        local_us : Dr.Jit Float, time since the first keyframe, µs, as from `local_us`; it may exceed the
            end of the track by less than a period.
        """
        return self._on_device.pose(0, local_us)

    @cached_property
    def _on_device(self) -> Tracks:
        return Tracks([self])

    def __repr__(self) -> str:
        turns = degrees(float(np.sum(np.abs(self.arc_rad))))
        return f"Trajectory({self.knots_us.size} keyframes, {self.period_us:g} µs, {turns:g}° in all)"

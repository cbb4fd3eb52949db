"""Bounds of moving objects: boxes and outlines that hold at every instant of an interval, not only at samples of it.

Between two keyframes an object's translation is linear and its angular speed is constant, so each of its points moves
along a straight line plus an arc of a circle. A chord is at most ρ (1 − cos δ/2) away from its arc, with the radius ρ
and the angle δ. A box around a point's positions at two instants, widened by that much, therefore contains the point
at all instants in between.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import ceil, cos, pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import S_PER_US
from hesim_render.sources.render.scene.trajectory import Piece, Trajectory

#: Largest rotation between two instants at which the position of an object is computed, and most instants in a piece.
_STEP_RAD, _MOST_STEPS = np.radians(5.0), 1024


def places(
    corners: NDArray[np.float64], trajectory: Trajectory, begin_us: float, end_us: float
) -> list[tuple[NDArray[np.float64], float]]:
    """Corners of an object at successive instants of an interval, piece by piece.

    Parameters
    ----------
    corners : corners of a box around the object at rest, [n, 3], m.
    trajectory : its motion.
    begin_us, end_us : the interval, µs.

    Returns
    -------
    For each piece of the track between keyframes: the corners at its ends and at some instants between, [k, n, 3], m;
    and the largest distance of any point from the straight line between two of these positions, m.
    """
    pieces, radius = [], float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
    for piece in trajectory.pieces(begin_us, end_us):
        share, margin = _instants(trajectory, piece, radius)
        poses = trajectory.within(np.full(share.size, piece.segment), share)
        pieces.append((corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3], margin))
    return pieces


def places_seen(
    corners: NDArray[np.float64], trajectory: Trajectory, camera: Trajectory, begin_us: float, end_us: float
) -> list[tuple[NDArray[np.float64], float]]:
    """As `places`, in the frame of a moving camera, expressed as positions that the resting camera would see.

    A point at q from the pivot of a camera that turns at ω_c has an acceleration of at most ω_c²|q| + 2 ω_c|q̇| + |q̈|
    in the camera's frame. A path of acceleration a is at most a h²/8 away from its chord, with h the time between its
    ends.

    Parameters
    ----------
    corners, trajectory, begin_us, end_us : see `places`.
    camera : motion of the camera, relative to its pose at rest.
    """
    radius = float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
    inner = np.union1d(trajectory.ends_us(begin_us, end_us), camera.ends_us(begin_us, end_us))
    # between these times both tracks have constant speeds
    cuts, pieces = np.concatenate([[begin_us], inner, [end_us]]), []
    for low, high in pairwise(cuts):
        speed, turn = _speed_and_turn(trajectory, low, high)
        own_speed, own_turn = _speed_and_turn(camera, low, high)
        # steps of few degrees, so that arcs are short against their radius
        steps = min(_MOST_STEPS, max(1, ceil((turn + own_turn) * (high - low) * S_PER_US / _STEP_RAD)))
        times = np.linspace(low, high, steps + 1)
        (_, poses), (_, views) = trajectory.throughout(times), camera.throughout(times)
        points = corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        step_s = (high - low) * S_PER_US / steps
        # bounds of |q̇|, and of |q| between two instants
        fastest = speed + turn * radius + own_speed
        pivots = views[:, :3, :3] @ camera.pivot_m + views[:, :3, 3]
        far = float(np.linalg.norm(points - pivots[:, None], axis=2).max()) + fastest * step_s / 2
        acceleration = own_turn * own_turn * far + 2 * own_turn * fastest + turn * turn * radius
        # positions as the resting camera would see them, and a h²/8
        pieces.append(((points - views[:, None, :3, 3]) @ views[:, :3, :3], acceleration * step_s * step_s / 8))
    return pieces


def stays_in(
    corners: NDArray[np.float64], trajectory: Trajectory, spans_us: Sequence[tuple[float, float]]
) -> NDArray[np.float64]:
    """Axis-parallel boxes [k, 2, 3], m, that contain an object during each of k intervals; see `places`."""
    radius = float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
    # instants of all intervals in one list, so that the poses are computed in one call
    segments: list[NDArray[np.int64]] = []
    shares: list[NDArray[np.float64]] = []
    margins: list[NDArray[np.float64]] = []
    starts: list[int] = []
    for begin, end in spans_us:
        starts.append(len(segments))
        for piece in trajectory.pieces(begin, end):
            share, margin = _instants(trajectory, piece, radius)
            segments.append(np.full(share.size, piece.segment))
            shares.append(share)
            margins.append(np.full(share.size, margin))
    poses = trajectory.within(np.concatenate(segments), np.concatenate(shares))
    points = corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    # arcs leave the chords by their margins at most; then one box over the instants of each interval
    wider = np.concatenate(margins)[:, None]
    first = np.cumsum([0, *(share.size for share in shares)])[starts]
    low = np.minimum.reduceat(points.min(axis=1) - wider, first, axis=0)
    high = np.maximum.reduceat(points.max(axis=1) + wider, first, axis=0)
    return np.stack([low, high], axis=1)


def _instants(trajectory: Trajectory, piece: Piece, radius_m: float) -> tuple[NDArray[np.float64], float]:
    """Shares of a piece at which an object's position is computed, and a bound of its distance from the chords, m."""
    # so many steps that none turns further than `_STEP_RAD`; the bound is ρ (1 − cos δ/2)
    turn = abs(float(trajectory.arc_rad[piece.segment])) * (piece.last - piece.first)
    steps = min(_MOST_STEPS, max(1, ceil(turn / _STEP_RAD)))
    return np.linspace(piece.first, piece.last, steps + 1), radius_m * (1 - cos(min(turn / steps / 2, pi)))


def _speed_and_turn(trajectory: Trajectory, begin_us: float, end_us: float) -> tuple[float, float]:
    """Speed of the pivot, m/s, and angular speed, rad/s, during a part of one segment; 0 where the pose is held."""
    local = 0.5 * (begin_us + end_us) - trajectory.knots_us[0]
    if not trajectory.repeat and not 0 <= local <= trajectory.period_us:
        return 0.0, 0.0
    segment, _ = trajectory.throughout(np.array([begin_us, end_us]))
    seconds = S_PER_US * float(np.diff(trajectory.knots_us)[segment])
    way = float(np.linalg.norm(np.diff(trajectory.translation_m, axis=0)[segment]))
    return way / seconds, abs(float(trajectory.arc_rad[segment])) / seconds


def fastest_m_per_s(corners: NDArray[np.float64], trajectory: Trajectory, begin_us: float, end_us: float) -> float:
    """Upper bound of the speed of any point of an object within an interval, m/s: |v| + ωρ of the fastest piece."""
    radius = float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
    fastest = 0.0
    for segment in {piece.segment for piece in trajectory.pieces(begin_us, end_us) if piece.length_us > 0}:
        seconds = S_PER_US * float(np.diff(trajectory.knots_us)[segment])
        way = float(np.linalg.norm(np.diff(trajectory.translation_m, axis=0)[segment]))
        fastest = max(fastest, (way + abs(float(trajectory.arc_rad[segment])) * radius) / seconds)
    return fastest


def fastest_turn_rad_per_s(trajectory: Trajectory, begin_us: float, end_us: float) -> float:
    """Highest angular speed within an interval, rad/s."""
    turns = [0.0]
    for segment in {piece.segment for piece in trajectory.pieces(begin_us, end_us) if piece.length_us > 0}:
        turns.append(
            abs(float(trajectory.arc_rad[segment])) / (S_PER_US * float(np.diff(trajectory.knots_us)[segment]))
        )
    return max(turns)

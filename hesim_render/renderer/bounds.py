"""Where moving objects are at most: boxes and outlines that hold for every instant of an interval, not for samples of it.

Between two keyframes an object's translation is linear and it turns at a constant speed, so that each of its points
goes along a straight line plus an arc of a circle. A chord is off its arc by ρ (1 − cos δ/2) at most, ρ the radius and
δ the angle; what holds a point at some instants therefore holds it in between when it is widened by that much.
"""

from __future__ import annotations

from math import ceil, cos, pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.trajectory import Trajectory
from hesim_render.units import S_PER_US

#: Largest turn between two instants at which an object's place is taken, and most of these in a piece.
_STEP_RAD, _MOST_STEPS = np.radians(5.0), 1024


def places(
    corners: NDArray[np.float64], trajectory: Trajectory, begin_us: float, end_us: float
) -> list[tuple[NDArray[np.float64], float]]:
    """Where the corners of an object are at successive instants of an interval, piece by piece.

    Parameters
    ----------
    corners : of a box around the object at rest, [n, 3], m.

    Returns
    -------
    For each piece of the track between keyframes, the corners at its ends and some instants between, [k, n, 3], and how
    far any point may be from the straight line between two of these, m.
    """
    found = []
    for piece in trajectory.pieces(begin_us, end_us):
        turn = abs(float(trajectory.arc_rad[piece.segment])) * (piece.last - piece.first)
        steps = min(_MOST_STEPS, max(1, ceil(turn / _STEP_RAD)))
        share = np.linspace(piece.first, piece.last, steps + 1)
        poses = trajectory.within(np.full(share.size, piece.segment), share)
        points = corners @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        radius = float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
        found.append((points, radius * (1 - cos(min(turn / steps / 2, pi)))))
    return found


def stays_in(
    corners: NDArray[np.float64], trajectory: Trajectory, begin_us: float, end_us: float
) -> NDArray[np.float64]:
    """Axis-parallel box [2, 3], m, in which an object stays during an interval; `corners` as in `places`."""
    low, high = [], []
    for points, margin in places(corners, trajectory, begin_us, end_us):
        low.append(points.min(axis=(0, 1)) - margin)
        high.append(points.max(axis=(0, 1)) + margin)
    return np.stack([np.min(low, axis=0), np.max(high, axis=0)])


def fastest_m_per_s(
    corners: NDArray[np.float64], trajectory: Trajectory, begin_us: float, end_us: float
) -> float:
    """Highest speed of any point of an object within an interval, m/s: |v| + ωρ of the fastest piece of its track."""
    radius = float(np.linalg.norm(corners - trajectory.pivot_m, axis=1).max())
    fastest = 0.0
    for segment in {piece.segment for piece in trajectory.pieces(begin_us, end_us) if piece.length_us > 0}:
        seconds = S_PER_US * float(np.diff(trajectory.knots_us)[segment])
        way = float(np.linalg.norm(np.diff(trajectory.translation_m, axis=0)[segment]))
        fastest = max(fastest, (way + abs(float(trajectory.arc_rad[segment])) * radius) / seconds)
    return fastest


def fastest_turn_rad_per_s(trajectory: Trajectory, begin_us: float, end_us: float) -> float:
    """Highest angular speed within an interval."""
    turns = [0.0]
    for segment in {piece.segment for piece in trajectory.pieces(begin_us, end_us) if piece.length_us > 0}:
        turns.append(abs(float(trajectory.arc_rad[segment])) / (S_PER_US * float(np.diff(trajectory.knots_us)[segment])))
    return max(turns)

"""Keyframed poses against SciPy's rotations, and the Dr.Jit evaluation against the NumPy one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.tracks import Tracks
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.truth.imu import _velocity
from hesim_render.specs.motion import TrackSpec


def track(*keyframes, **options):
    return Trajectory(TrackSpec.model_validate({"object": "x", "keyframes": list(keyframes), **options}))


def test_translation_is_linear_and_held_outside_the_keyframes():
    moving = track({"t_us": 1000, "translation_m": (1, 2, 3)}, {"t_us": 3000, "translation_m": (3, 2, -1)})
    times = [0, 1000, 1500, 2000, 3000, 9000]
    expected = [(1, 2, 3), (1, 2, 3), (1.5, 2, 2), (2, 2, 1), (3, 2, -1), (3, 2, -1)]
    poses = moving.matrix(times)
    np.testing.assert_allclose(poses[:, :3, 3], expected, atol=1e-12)
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(np.eye(3), (6, 3, 3)), atol=1e-12)


def test_shared_axis_turns_at_constant_speed_through_any_number_of_turns():
    axis = np.array([1.0, -2.0, 0.5])
    unit = axis / np.linalg.norm(axis)
    turning = track(
        {"t_us": 0, "rotation_axis": tuple(axis), "rotation_deg": 30},
        {"t_us": 10_000, "rotation_axis": tuple(axis), "rotation_deg": 30 + 3.25 * 360},
    )
    times = np.linspace(0, 10_000, 41)
    angle = np.radians(30 + 3.25 * 360 * times / 10_000)
    expected = Rotation.from_rotvec(angle[:, None] * unit).as_matrix()
    np.testing.assert_allclose(turning.matrix(times)[:, :3, :3], expected, atol=1e-12)


def test_zero_rotation_shares_every_axis():
    turning = track({"t_us": 0}, {"t_us": 1000, "rotation_axis": (0, 1, 0), "rotation_deg": 720})
    quarter = turning.matrix(125.0)[:3, :3]
    np.testing.assert_allclose(quarter, Rotation.from_euler("y", 90, degrees=True).as_matrix(), atol=1e-12)
    back = track({"t_us": 0, "rotation_axis": (0, 1, 0), "rotation_deg": 720}, {"t_us": 1000})
    np.testing.assert_allclose(back.matrix(875.0)[:3, :3], quarter, atol=1e-12)


def test_opposite_axes_are_the_same_axis_with_the_angle_negated():
    turning = track(
        {"t_us": 0, "rotation_axis": (0, 0, 1), "rotation_deg": 10},
        {"t_us": 100, "rotation_axis": (0, 0, -2), "rotation_deg": -50},
    )
    expected = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    np.testing.assert_allclose(turning.matrix(50.0)[:3, :3], expected, atol=1e-12)


def test_different_axes_follow_the_shortest_arc():
    turning = track(
        {"t_us": 0, "rotation_axis": (1, 0, 0), "rotation_deg": 80},
        {"t_us": 1000, "rotation_axis": (0, 1, 1), "rotation_deg": 110},
        {"t_us": 3000, "rotation_axis": (1, 1, 0), "rotation_deg": 200},
    )
    keys = Rotation.from_rotvec(
        [
            np.radians(80) * np.array([1, 0, 0]),
            np.radians(110) * np.array([0, 1, 1]) / np.sqrt(2),
            np.radians(200) * np.array([1, 1, 0]) / np.sqrt(2),
        ]
    )
    times = np.linspace(0, 3000, 31)
    expected = Slerp([0, 1000, 3000], keys)(times).as_matrix()
    np.testing.assert_allclose(turning.matrix(times)[:, :3, :3], expected, atol=1e-12)


def test_pivot_stays_where_it_is_and_repeat_wraps():
    turning = track(
        {"t_us": 100, "rotation_deg": 0},
        {"t_us": 1100, "rotation_deg": 90},
        pivot_m=(0.3, -0.2, 1.0),
        repeat=True,
    )
    for time in (100.0, 650.0, 1099.0):
        pose = turning.matrix(time)
        np.testing.assert_allclose(pose @ [0.3, -0.2, 1.0, 1], [0.3, -0.2, 1.0, 1], atol=1e-12)
        for periods in (-3, 2):
            np.testing.assert_allclose(turning.matrix(time + 1000 * periods), pose, atol=1e-12)


@pytest.mark.parametrize("repeat", [False, True])
def test_drjit_evaluation_equals_numpy(repeat):
    moving = track(
        {"t_us": 500, "translation_m": (0.1, 0, 0), "rotation_axis": (0, 1, 0), "rotation_deg": 400},
        {"t_us": 700, "translation_m": (0.4, 1, 0), "rotation_axis": (0, 1, 0), "rotation_deg": -20},
        {"t_us": 2500, "translation_m": (-0.3, 0.5, 2), "rotation_axis": (1, 0, 1), "rotation_deg": 75},
        pivot_m=(0.2, 0.1, -0.4),
        repeat=repeat,
    )
    types = jit()
    times = np.linspace(-800, 4400, 521)
    local = moving.local_us(times) if repeat else times - 500
    point, direction = np.array([0.7, -0.3, 0.9]), np.array([0.6, 0.0, -0.8])
    vectors = [types.Array3f(*map(float, vector)) for vector in (point, direction)]
    pose = moving.pose_at(from_host(types.Float, local))
    moved, turned = pose.to_world(vectors[0]), pose.turn_to_world(vectors[1])
    poses = moving.matrix(times)
    np.testing.assert_allclose(np.array(moved).T, poses[:, :3, :3] @ point + poses[:, :3, 3], atol=3e-6)
    np.testing.assert_allclose(np.array(turned).T, poses[:, :3, :3] @ direction, atol=3e-6)
    back, returned = pose.to_rest(moved), pose.turn_to_rest(turned)
    np.testing.assert_allclose(np.array(back).T, np.broadcast_to(point, (521, 3)), atol=6e-6)
    np.testing.assert_allclose(np.array(returned).T, np.broadcast_to(direction, (521, 3)), atol=3e-6)


def test_a_track_without_motion_does_not_move():
    still = {"translation_m": (1, 0, 0), "rotation_deg": 90}
    assert not track({"t_us": 0, **still}, {"t_us": 10, **still}).moves
    assert track({"t_us": 0, **still}, {"t_us": 10, "translation_m": (1, 0, 0), "rotation_deg": 450}).moves


@pytest.mark.parametrize("repeat", [False, True])
def test_the_velocity_of_a_point_is_the_slope_of_its_path(repeat):
    """Central differences over 2 µs; 0 before the first keyframe and from the last one on, where the pose is held."""
    keys = [{"t_us": 4000, "translation_m": [0.1, 0, 0]},
            {"t_us": 7000, "translation_m": [0.3, 0.2, 0], "rotation_axis": [0, 1, 0], "rotation_deg": 50},
            {"t_us": 12000, "translation_m": [0, -0.1, 0.4], "rotation_axis": [1, 0, 0], "rotation_deg": -20},
    ]  # fmt: skip
    moves = Trajectory(TrackSpec.model_validate(
        {"object": "camera", "pivot_m": [0.2, -0.1, 0.3], "keyframes": keys, "repeat": repeat}
    ))  # fmt: skip
    place = np.array([0.5, 0.7, -0.2])
    times = np.array([10.0, 3998.0, 4002.0, 6500.0, 7100.0, 11_990.0, 12_002.0, 12_500.0, 15_900.0])
    points = [(moves.matrix(times + step) @ np.append(place, 1.0))[:, :3] for step in (-1, 1)]
    slope = (points[1] - points[0]) / 2e-6
    np.testing.assert_allclose(_velocity(moves, place, times), slope, rtol=1e-5, atol=1e-4)
    assert np.all(slope.any(axis=1) == (repeat | ((times > 4000) & (times < 12_000))))
    edges = _velocity(moves, place, np.array([4000.0, 7000.0, 12_000.0]))  # just after each
    np.testing.assert_allclose(edges[:2], _velocity(moves, place, np.array([4000.5, 7000.5])), rtol=2e-3, atol=1e-2)
    assert edges[2].any() == repeat
    assert _velocity(None, place, times).shape == (9, 3) and not _velocity(None, place, times).any()


def test_many_tracks_of_uneven_keyframes_find_their_segments():
    """From 2 to 900 keyframes, 2 µs to 30 ms apart, so that some are close together; at all keyframes and between."""
    rng, tracks = np.random.default_rng(12), []
    for count in (2, 3, 40, 900):
        gaps = np.rint(10 ** rng.uniform(0.3, 4.5, count - 1)).astype(int)
        times = np.append(0, np.cumsum(gaps))
        keys = [
            {"t_us": int(t), "translation_m": [round(float(x), 3), 0.1, 0]}
            for t, x in zip(times, rng.uniform(-1, 1, count), strict=True)
        ]
        tracks.append(Trajectory(TrackSpec.model_validate({"object": "camera", "keyframes": keys})))
    together, types = Tracks(tracks), jit()
    for number, own in enumerate(tracks):
        knots = own.knots_us
        middles = 0.5 * (knots[1:] + knots[:-1])
        local = np.concatenate([knots, middles, rng.uniform(0, knots[-1], 3000)]).astype(np.float32)
        wanted = own.matrix(local.astype(np.float64))[:, :3, 3]
        # as a number of all lanes, and as one of each lane
        for which in (number, from_host(types.UInt32, np.full(local.size, number, np.uint32))):
            found = np.array(together.pose(which, from_host(types.Float, local)).shift).T
            np.testing.assert_allclose(found, wanted, atol=2e-4)

"""Tracks with parents against the product of both motions, each written out by hand."""

import numpy as np
import pytest
from rendering import make_scene, mono, pair_tracer, traced
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene.parents import camera_trajectory, trajectories

WALL = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "position_m": [0, 0, -0.5], "reflectance": 0.1}
CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}
LIGHT = {"type": "uniform", "illuminance_lux": 500}


def scene(motion, names=("car", "wheel", "cap"), **more):
    objects = [WALL, *({"name": name, "shape": "box", "size_m": [0.1] * 3} for name in names)]
    return make_scene(objects=objects, light=LIGHT, camera=CAMERA, motion=motion, **more)


def turn(axis, angle_rad, pivot=(0, 0, 0), shift=(0, 0, 0)):
    """Rotation about an axis through a pivot, then a translation, [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.array(axis, float) / np.linalg.norm(axis) * angle_rad).as_matrix()
    pose[:3, 3] = np.array(pivot) - pose[:3, :3] @ pivot + shift
    return pose


CAR = {"object": "car", "keyframes": [{"t_us": 0}, {"t_us": 100_000, "translation_m": [0.6, 0.1, 0]}]}
WHEEL = {
    "object": "wheel",
    "parent": "car",
    "pivot_m": [0.1, -0.2, 0],
    "repeat": True,
    "keyframes": [{"t_us": 0}, {"t_us": 7000, "rotation_axis": [0, 0, 1], "rotation_deg": -360}],
}


def close(track, t_us, expected):
    """Within the tolerance for a point half a metre from the pivot."""
    places = np.array([[0.5, 0.1, 0.2, 1], [-0.2, 0.4, -0.1, 1], [0, 0, 0, 1]])
    np.testing.assert_allclose(places @ track.matrix(t_us).T, places @ expected.T, atol=1e-5)


def test_a_wheel_turns_on_a_car_that_drives():
    found = trajectories(scene([CAR, WHEEL]).spec)["wheel"]
    for t_us in (0.0, 333.0, 6999.0, 7001.0, 52_345.0, 100_000.0):
        share = t_us / 100_000
        drive = turn((0, 0, 1), 0.0, shift=(0.6 * share, 0.1 * share, 0))
        close(found, t_us, drive @ turn((0, 0, 1), -2 * np.pi * (t_us / 7000 % 1), (0.1, -0.2, 0)))
    # after the parent's last keyframe both are held
    close(found, 150_000.0, found.matrix(100_000.0))


def test_turns_about_different_axes_in_a_chain():
    """Three links: shoulder, elbow and hand of an arm; nothing between two keyframes is a turn at constant speed."""
    shoulder = {
        "object": "car",
        "keyframes": [{"t_us": 0}, {"t_us": 20_000, "rotation_axis": [0, 0, 1], "rotation_deg": 200}],
    }
    elbow = {
        "object": "wheel",
        "parent": "car",
        "pivot_m": [0.3, 0, 0],
        "keyframes": [{"t_us": 5000}, {"t_us": 15_000, "rotation_axis": [1, 1, 0], "rotation_deg": -90}],
    }
    hand = {"object": "cap", "parent": "wheel"}
    found = trajectories(scene([hand, elbow, shoulder]).spec)
    for t_us in np.random.default_rng(3).uniform(-1000, 22_000, 40):
        upper = turn((0, 0, 1), np.radians(200) * np.clip(t_us / 20_000, 0, 1))
        lower = turn((1, 1, 0), -np.pi / 2 * np.clip((t_us - 5000) / 10_000, 0, 1), (0.3, 0, 0))
        close(found["wheel"], t_us, upper @ lower)
        close(found["cap"], t_us, upper @ lower)
    assert found["cap"].knots_us.size < 1500


def test_both_repeat():
    """A fan on a head that swings; their periods have a common multiple."""
    swing = [{"t_us": 0}, {"t_us": 3000, "rotation_deg": 40, "rotation_axis": [0, 1, 0]}, {"t_us": 6000}]
    head = {"object": "car", "repeat": True, "keyframes": swing}
    found = trajectories(scene([head, {**WHEEL, "keyframes": [{**WHEEL["keyframes"][1], "t_us": 4000}]} | {
        "keyframes": [{"t_us": 0}, {**WHEEL["keyframes"][1], "t_us": 4000}]}]).spec)["wheel"]  # fmt: skip
    assert found.repeat and found.period_us == 12_000
    for t_us in (0.0, 1234.0, 3999.0, 5000.0, 11_999.0, 12_001.0, 36_700.0):
        local = t_us % 6000
        above = turn((0, 1, 0), np.radians(40) * (local / 3000 if local < 3000 else 2 - local / 3000))
        close(found, t_us, above @ turn((0, 0, 1), -2 * np.pi * (t_us / 4000 % 1), (0.1, -0.2, 0)))


def test_what_only_rides_moves_as_its_parent():
    swing = [{"t_us": 0}, {"t_us": 3000, "rotation_deg": 40, "rotation_axis": [0, 1, 0]}, {"t_us": 6000}]
    head = {"object": "car", "repeat": True, "keyframes": swing}
    found = trajectories(scene([head, {"object": "wheel", "parent": "car"}]).spec)
    assert found["wheel"].repeat and found["wheel"].moves
    for t_us in (0.0, 2000.0, 4321.0, 6001.0, 44_444.0):
        close(found["wheel"], t_us, found["car"].matrix(t_us))


def test_a_camera_rides_on_what_it_looks_at():
    """The picture of the car stands still, and that of the wall moves."""
    motion = [CAR, {"object": "camera", "parent": "car"}]
    both = scene(motion, names=("car",))
    assert camera_trajectory(both.spec).moves
    tracer = pair_tracer(both, mono(16, 12))
    first, later = (traced(tracer, 512, at, at + 1.0) for at in (0.0, 60_000.0))
    image = [np.reshape(one.half_a + one.half_b, (12, 16)) for one in (first, later)]
    np.testing.assert_allclose(image[0][5:7, 7:9], image[1][5:7, 7:9], rtol=0.02)


@pytest.mark.parametrize(
    ("motion", "told"),
    [
        ([WHEEL], "'car', the parent of 'wheel', has no track"),
        ([{**CAR, "parent": "wheel"}, WHEEL], "rides on"),
        ([{**CAR, "parent": "car"}], "'?car'? rides on '?car"),
        ([{**CAR, "repeat": True, "keyframes": [{"t_us": 5}, {"t_us": 10, "rotation_deg": 9}]}, WHEEL], "both repeat"),
    ],
)
def test_wrong_parents_are_told(motion, told):
    with pytest.raises((SpecError, ValueError), match=told):
        trajectories(scene(motion).spec)


def test_too_many_turns_are_told():
    many = {**CAR, "keyframes": [{"t_us": 0}, {"t_us": 10**9, "rotation_deg": 1e8, "rotation_axis": [1, 0, 0]}]}
    with pytest.raises(SpecError, match="more than 50000 keyframes"):
        trajectories(scene([many, {**WHEEL, "repeat": False}]).spec)

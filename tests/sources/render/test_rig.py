"""Cameras that move together: their poses, and points seen by two of them."""

import numpy as np
import pytest
import rendering
from ruamel.yaml import YAML

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.recording.camera_files import write_kalibr_camchain

RIGHT = np.array([[0.99619470, 0, -0.08715574, 0.08], [0, 1, 0, 0.01], [0.08715574, 0, 0.99619470, 0.0], [0, 0, 0, 1]])


def moving(**camera):
    wall = {"name": "wall", "shape": "rectangle", "size_m": [9, 9, 0]}
    ball = {"name": "ball", "shape": "sphere", "size_m": [0.2, 0.2, 0.2], "position_m": [0.05, 0, 0.4]}
    track = [
        {"t_us": 0},
        {"t_us": 10_000, "translation_m": [0.1, 0, 0.2], "rotation_axis": [1, 1, 0], "rotation_deg": 9},
    ]
    return rendering.make_scene(
        objects=[wall, ball], light=rendering.D65_1000_LUX, motion=[{"object": "camera", "keyframes": track}],
        camera={"origin_m": [0.1, 0.2, 2], "target_m": [0, 0, 0], **camera},
    )  # fmt: skip


@pytest.mark.parametrize("camera", [{"horizontal_fov_deg": 30}, {"focal_length_mm": 8.0}, {"focus_distance_m": 1.0}])
def test_extrinsics_stay_and_points_are_seen_where_both_cameras_put_them(camera):
    sensor = rendering.mono(64, 48)
    scenes = hr.rig_scenes(moving(**camera), sensor, {"left": np.eye(4), "right": RIGHT})
    one = hr.SceneTruth(moving(**camera), sensor)
    left, right = (hr.SceneTruth(scenes[name], sensor) for name in ("left", "right"))
    for t_us in (0.0, 4_000.0, 10_000.0):
        np.testing.assert_allclose(left.camera_pose(t_us), one.camera_pose(t_us), atol=1e-9)
        between = np.linalg.inv(left.camera_pose(t_us)) @ right.camera_pose(t_us)
        np.testing.assert_allclose(between, RIGHT, atol=1e-7)
    np.testing.assert_allclose(left.camera().k, one.camera().k, rtol=1e-9)
    np.testing.assert_allclose(right.camera().k, one.camera().k, rtol=1e-9)
    # a point that the left camera sees, through K and the extrinsics, into the right one; its depth is there too
    row, col = 20, 40
    k, local = left.camera().k, np.array([col, row, 1.0])
    point = np.linalg.inv(k) @ local * left.depth(4_000.0)[row, col]
    there = RIGHT[:3, :3].T @ (point - RIGHT[:3, 3])
    seen = k @ there / there[2]
    np.testing.assert_allclose(right.project(left.position(4_000.0)[row, col], 4_000.0), seen[:2], atol=2e-3)


def test_kalibr_gets_the_extrinsics(tmp_path):
    sensor = rendering.mono(64, 48)
    scenes = hr.rig_scenes(moving(), sensor, {"left": np.eye(4), "right": RIGHT})
    truths = [hr.SceneTruth(scene, sensor) for scene in scenes.values()]
    chain = YAML(typ="safe").load(write_kalibr_camchain(tmp_path / "chain.yaml", truths, ["mosaic", "mosaic"]))
    np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], np.linalg.inv(RIGHT), atol=1e-7)
    np.testing.assert_allclose(chain["cam1"]["T_cam_imu"], np.linalg.inv(RIGHT), atol=1e-7)
    np.testing.assert_allclose(chain["cam0"]["T_cam_imu"], np.eye(4), atol=1e-9)
    # a lens without distortion has all four coefficients that Kalibr wants
    assert [chain[name]["distortion_coeffs"] for name in ("cam0", "cam1")] == [[0.0] * 4] * 2


def test_rigs_that_are_none_are_refused():
    sensor, skewed = rendering.mono(8, 8), np.eye(4)
    skewed[0, 1] = 0.1
    for poses, said in (({}, "one camera or more"), ({"a": skewed}, "a rigid 4×4 matrix"), ({"a": np.eye(3)}, "rigid")):
        with pytest.raises(RangeError, match=said):
            hr.rig_scenes(moving(), sensor, poses)
    with pytest.raises(SpecError, match="a rig needs a 'camera' section"):
        hr.rig_scenes(hr.load_scene("cornell-box"), sensor, {"a": np.eye(4)})

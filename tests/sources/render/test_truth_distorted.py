"""Geometric truth of lenses with distortion: pictures, flow, depth and the exported camera agree."""

import cv2
import numpy as np
import pytest
import rendering

from hesim_render.sources.render.truth.scene_truth import SceneTruth

COLS, ROWS = 160, 120
MODELS = {
    "opencv": {"model": "opencv", "k1": -0.3, "k2": 0.08, "p1": 2e-3, "p2": -1e-3},
    "fisheye": {"model": "fisheye", "k1": -0.05, "k2": 0.01},
}
FOV_DEG = {"opencv": 60, "fisheye": 100}
CARD_Z, END_US = -0.1, 20_000
WAY, CAMERA_WAY, CAMERA_DEG = np.array([0.05, -0.03, 0.06]), np.array([0.02, 0.01, -0.05]), 4.0


def scene(name, size=(0.5, 0.4), place=(-0.25, 0.22), camera_moves=True):
    """A white card before a black wall; both card and camera move."""
    motion = [{"object": "card", "keyframes": [{"t_us": 0}, {"t_us": END_US, "translation_m": WAY.tolist()}]}]
    if camera_moves:
        end = {"t_us": END_US, "translation_m": CAMERA_WAY.tolist(), "rotation_axis": [0, 1, 0],
               "rotation_deg": CAMERA_DEG}  # fmt: skip
        motion.append({"object": "camera", "pivot_m": [0, 0, 1], "keyframes": [{"t_us": 0}, end]})
    objects = [
        {"name": "card", "shape": "rectangle", "size_m": [*size, 0], "position_m": [*place, CARD_Z],
         "reflectance": 1.0},
        {"name": "wall", "shape": "rectangle", "size_m": [20, 20, 0], "position_m": [0, 0, -0.5], "reflectance": 0.0},
    ]  # fmt: skip
    camera = {"origin_m": [0, 0, 1], "horizontal_fov_deg": FOV_DEG[name]}
    return rendering.make_scene(objects=objects, light=rendering.FURNACE, camera=camera, motion=motion)


def by_opencv(truth, points, t_us):
    """Places of world points [n, 3] by OpenCV, from the exported camera and pose."""
    camera, pose = truth.camera(), np.linalg.inv(truth.camera_pose(t_us))
    local = (np.atleast_2d(points) @ pose[:3, :3].T + pose[:3, 3]).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if camera.distortion_model == "fisheye" else cv2.projectPoints
    place, _ = project(local, np.zeros(3), np.zeros(3), camera.k, np.array(camera.distortion))
    return place.reshape(-1, 2)


@pytest.mark.parametrize("name", MODELS)
def test_flow_depth_and_position_are_those_of_points_that_opencv_projects(name):
    truth = SceneTruth(scene(name), rendering.mono(COLS, ROWS, lens__distortion=MODELS[name]))
    times = 3_000.0, 15_000.0
    flow, ids = truth.flow(*times), truth.ids(times[0]).object
    position, depth = truth.position(times[0]), truth.depth(times[0])
    row, col = np.divmod(np.random.default_rng(1).choice(ROWS * COLS, 600, replace=False), COLS)
    points = position[row, col].astype(np.float64)
    assert {1, 2} <= set(ids[row, col])
    here = by_opencv(truth, points, times[0])
    np.testing.assert_allclose(here, np.column_stack([col, row]), atol=2e-3)
    pose = np.linalg.inv(truth.camera_pose(times[0]))
    np.testing.assert_allclose(depth[row, col], points @ pose[2, :3] + pose[2, 3], rtol=2e-6)
    on_card = (ids[row, col] == 1)[:, None]
    later = points + on_card * WAY * (times[1] - times[0]) / END_US
    moved = by_opencv(truth, later, times[1]) - np.column_stack([col, row])
    assert np.abs(moved - flow.flow_px[row, col]).max() < 5e-3  # asked for: 0.02 px
    assert np.abs(moved).max() > 3
    np.testing.assert_allclose(truth.project(points[7], times[0]), here[7], atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_the_picture_has_a_corner_where_depth_pose_and_camera_put_it(name):
    """Noise-free flux of the default mode: the rims of the card, straight in space, meet where its corner is seen.

    Each rim is fitted as the image of a straight line, shifted by a constant: its mean distance from the rim that
    OpenCV projects.
    """
    sensor = rendering.mono(COLS, ROWS, lens__distortion=MODELS[name], lens__relative_illumination="none")
    # the corner nearest to the middle is far off the axis, where the lens distorts
    reach = np.tan(np.radians(FOV_DEG[name] / 2)) * (1 - CARD_Z)
    corner = np.array([0.55 * reach, 0.4 * reach])
    still = scene(name, (2 * reach, 2 * reach), corner + np.array([reach, -reach]), camera_moves=False)
    truth = SceneTruth(still, sensor)
    t_us = 0.0
    flux = rendering.traced(rendering.pair_tracer(still, sensor), 1024, t_us, t_us, controlled=True)
    light = flux.mean.reshape(ROWS, COLS) / flux.mean.max()
    offsets = []
    for way in (np.array([0.0, -1.0]), np.array([1.0, 0.0])):  # left rim, top rim
        along = corner + way * np.linspace(0.03, 0.3, 400)[:, None] * reach
        place = by_opencv(truth, np.column_stack([along, np.full(400, CARD_Z)]), t_us)
        across = int(way[0] != 0)  # the left rim crosses rows, the top rim crosses columns
        lines = np.arange(int(np.ceil(place[:, 1 - across].min() + 2)), int(place[:, 1 - across].max() - 2))
        assert lines.size > 8
        order = np.argsort(place[:, 1 - across])
        expected = np.interp(lines, place[order, 1 - across], place[order, across])
        for line, at in zip(lines, expected, strict=True):
            profile = (light[:, line] if across else light[line])[int(at) - 4 : int(at) + 7].astype(np.float64)
            # white lies behind the rim, to the right or below: the dark part of the strip ends at the rim
            found = int(at) - 4 - 0.5 + (1 - profile).sum()
            offsets.append((across, found - at))
    offsets = np.array(offsets)
    for across in (0, 1):
        own = offsets[offsets[:, 0] == across, 1]
        # curvature within a row moves a rim by less than 0.002 px; 1024 rays make 0.003 px of noise in a row
        assert abs(own.mean()) < 0.005 and np.abs(own).max() < 0.02
    place = by_opencv(truth, [*corner, CARD_Z], t_us)[0]
    far = np.hypot(*(place - truth.camera().k[:2, 2]))
    assert far > 0.4 * COLS / 2

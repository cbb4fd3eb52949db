"""Outlines of moving objects and steps of motion hold for lenses with distortion and with a depth of field."""

import cv2
import numpy as np
import pytest
import rendering
from scipy.spatial.transform import Rotation

from hesim_render.mosaic.schedule import CELL_US
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.sample_instants import STEP_PX, MotionClock
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.specs.motion import TrackSpec

END_US = 8_000
TRACK = [{"t_us": 0}, {"t_us": END_US, "translation_m": [0.2, 0.1, 0.15], "rotation_deg": 35}]
SIZE, PLACE = np.array([0.9, 0.04, 0.3]), np.array([0.3, 0.55, -0.1])
LENSES = {
    "barrel": {"lens__distortion": {"model": "opencv", "k1": -0.28, "k2": 0.06, "p1": 2e-3}},
    "fisheye": {"lens__distortion": {"model": "fisheye"}},
    "pincushion, out of focus": {
        "lens__distortion": {"model": "opencv", "k1": 0.2}, "lens__depth_of_field": True, "lens__f_number": 0.12,
        "lens__magnification": "focus", "geometry__pitch_um": 100.0},
}  # fmt: skip


def scene():
    """A long bar near the upper border of a wide picture, which moves and turns."""
    bar = {"name": "bar", "shape": "box", "size_m": SIZE.tolist(), "position_m": PLACE.tolist(), "reflectance": 0.5}
    return rendering.make_scene(
        objects=[bar], light=rendering.FURNACE, motion=[{"object": "bar", "keyframes": TRACK}],
        camera={"origin_m": [0, 0, 1], "horizontal_fov_deg": 85, "focus_distance_m": 0.6},
    )  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_an_outline_contains_all_that_the_lens_shows_of_an_object(name):
    tracer = rendering.pair_tracer(scene(), rendering.mono(320, 240, **LENSES[name]))
    view, rng = tracer.view, np.random.default_rng(3)
    zoom = Zoom(view, None, tracer.parts.groups, False, TUNING)
    begin, end = 2_000.0, 3_000.0
    outline = zoom._outline(0, tracer.parts.groups[0], begin, end)
    assert outline is not None
    # points all over the bar's surface, at times of the window
    points = rng.uniform(-0.5, 0.5, (20_000, 3))
    points[np.arange(20_000), rng.integers(0, 3, 20_000)] = rng.choice([-0.5, 0.5], 20_000)
    share = rng.uniform(begin, end, 20_000) / END_US
    turn = Rotation.from_rotvec(np.outer(share * np.radians(35), [0, 0, 1]))
    world = turn.apply(points * SIZE + PLACE) + share[:, None] * TRACK[1]["translation_m"]
    local = (world - [0, 0, 1]) * [1, -1, -1]
    tangent = local[:, :2] / local[:, 2:]
    optics, lens = view.sensor.optics, view.sensor.lens
    if optics.depth_of_field:
        # through a point of the pupil, the point is seen where that ray meets the plane in focus
        around, out = rng.uniform(0, 2 * np.pi, 20_000), np.sqrt(rng.uniform(0, 1, 20_000)) * lens.pupil_radius_m
        pupil = out[:, None] * np.stack([np.cos(around), np.sin(around)], axis=1)
        tangent = tangent - pupil / local[:, 2:] + pupil / lens.focus_distance_m
        assert 4 < lens.pupil_radius_m * view.projection.focal_px * abs(1 / local[:, 2].max() - 1 / 0.6) < 20
    project = cv2.fisheye.projectPoints if optics.distortion.model == "fisheye" else cv2.projectPoints
    k = np.diag([view.projection.focal_px] * 2 + [1.0])
    k[:2, 2] = view.projection.centre_px
    direction = np.column_stack([tangent, np.ones(20_000)]).reshape(-1, 1, 3)
    place = project(direction, np.zeros(3), np.zeros(3), k, np.array(optics.distortion.coefficients))[0].reshape(-1, 2)
    place = place[np.hypot(*tangent.T) < view.projection.distortion.limit] + 0.5
    assert len(place) > 10_000
    assert outline.inside(*place.T, TUNING.zoom_margin_px).all()
    # and not by being everywhere: a straight outline of the corners alone is not much smaller
    assert np.ptp(place, axis=0).prod() > 0.5 * np.prod(outline.high - outline.low)


@pytest.mark.parametrize("name", ["barrel", "fisheye"])
def test_nothing_moves_farther_than_a_step_between_two_instants_of_a_turning_camera(name):
    sensor = rendering.mono(320, 240, **LENSES[name])
    view = place_camera(scene().spec, sensor)
    keys = [{"t_us": 0}, {"t_us": 1_000_000, "rotation_axis": [0.3, 1, 0.2], "rotation_deg": 50}]
    turn = Trajectory(TrackSpec.model_validate({"object": "camera", "pivot_m": [0, 0, 1], "keyframes": keys}))
    instants = MotionClock(view, turn, [], lambda t: 1.0).instants_us(0, 4 * CELL_US)
    left, right, top, bottom = view.region_mm
    x, y = np.meshgrid(np.linspace(left, right, 21) / 5e-3 + 511.5, np.linspace(top, bottom, 17) / 5e-3 + 511.5)
    rays = view.projection.unproject(np.stack([x.ravel(), y.ravel()], axis=-1))
    worst = 0.0
    for begin, end in zip(instants[:-1], instants[1:], strict=True):
        first, second = (turn.matrix(float(t))[:3, :3] @ view.camera_to_world[:3, :3] for t in (begin, end))
        moved = view.projection.project(rays @ first.T @ second) - view.projection.project(rays)
        worst = max(worst, np.abs(np.linalg.norm(moved, axis=1)).max())
    assert np.diff(instants).max() > 20  # 10 µs is the least
    assert 0.03 * STEP_PX < worst <= STEP_PX

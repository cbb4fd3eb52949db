"""Slices of moving scenes against the motion of cards that slide in front of a camera of 160 px focal length."""

import numpy as np
import pytest
from rendering import make_scene, mono

from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.render.timeline import Timeline
from hesim_render.specs.motion import TrackSpec

#: A card at z = 0, 2 m in front of the camera: 80 px/m.
CARD = np.array([[-0.1, -0.05, 0], [0.1, -0.05, 0], [0.1, 0.05, 0], [-0.1, 0.05, 0]])
FOCAL_PX = 160.0


def view():
    fov = 2 * np.degrees(np.arctan(32 / FOCAL_PX))
    scene = make_scene(
        objects=[{"name": "card", "shape": "rectangle", "size_m": [0.2, 0.1, 0]}],
        light={"type": "uniform", "illuminance_lux": 100},
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": fov},
    )
    return place_camera(scene.spec, mono(64, 48))


def track(*keys, repeat=False, name="card"):
    frames = [{"t_us": t_us, "translation_m": place} for t_us, place in keys]
    return Trajectory(TrackSpec.model_validate({"object": name, "keyframes": frames, "repeat": repeat}))


def slides(repeat=False, **more):
    """4 px to the right and 3 px down in 1 ms, and then 12 px to the left in 3 ms."""
    moves = track((1000, [0, 0, 0]), (2000, [0.05, -0.0375, 0]), (5000, [-0.1, -0.0375, 0]), repeat=repeat)
    return Timeline(view(), None, {"card": moves}, {"card": CARD}, np.zeros((8, 3)), **more)


@pytest.mark.parametrize(("most", "pieces"), [(0.7, (8, 18)), (0.5, (10, 24)), (0.09, (56, 134)), (40.0, (1, 1))])
def test_slices_cut_each_path_into_pieces_of_the_largest_motion(most, pieces):
    first, second = (np.linspace(a, b, n + 1) for (a, b), n in zip([(1000, 2000), (2000, 5000)], pieces, strict=True))
    found = slides(max_motion_px=most).edges_us(0, 9000)
    np.testing.assert_allclose(found, np.unique(np.concatenate([first, second])))
    inner = slides(max_motion_px=most).edges_us(1333.0, 2777.0)
    np.testing.assert_allclose(inner, found[(found > 1333) & (found < 2777)])


def test_no_slice_is_shorter_than_the_least():
    np.testing.assert_allclose(np.diff(slides(max_motion_px=0.09, min_slice_us=150.0).edges_us(0, 2000)), 1000 / 6)


def test_a_repeated_track_has_the_slices_of_each_turn():
    once = slides(max_motion_px=2.0).edges_us(0, 9000)
    found = slides(True, max_motion_px=2.0).edges_us(-4000, 13_000)
    expected = np.unique(np.concatenate([once + 4000 * k for k in (-2, -1, 0, 1, 2)]))
    np.testing.assert_allclose(found, expected[(expected > -4000) & (expected < 13_000)])


def test_objects_are_drawn_at_the_pose_of_the_middle_of_their_slice():
    """Slices of 250 µs from 1 to 2 ms, and of 300 µs to 5 ms; before and after, the pose is held."""
    timeline = slides(max_motion_px=1.25)
    begin = np.array([1000.0, 1130.0, 1260.0, 1999.0, 2000.0, 2610.0, 4600.0])
    found = [timeline.pose_time_us(t, t + 0.5) for t in begin]
    assert found == pytest.approx([1125, 1125, 1375, 1875, 2150, 2750, 4550])
    assert timeline.pose_time_us(300, 420) == 360 and timeline.pose_time_us(6000, 6001) == 6000.5
    assert timeline.pose_time_us(1900, 2100) == 2000  # at a keyframe


@pytest.mark.parametrize(("depths", "px"), [((1.0, 3.0), 16.0), ((0.01, 2.0), 160.0), ((2.0, 2.0), 8.0)])
def test_a_camera_that_slides_moves_what_is_nearest(depths, px):
    """0.08 and 0.06 m in 4 ms; nothing counts as nearer than a twentieth of the farthest."""
    camera = track((0, [0, 0, 0]), (4000, [0.08, 0.06, 0]), name="camera")
    corners = np.array([[0.1, 0.2, 2.0 - depth] for depth in depths for _ in range(4)])
    timeline = Timeline(view(), camera, {}, {}, corners, max_motion_px=0.5)
    assert timeline.camera_motion_px(0, 4000) == pytest.approx(px, rel=1e-6)
    assert timeline.camera_motion_px(500, 1500) == pytest.approx(px / 4, rel=1e-6)
    count = int(px / 4 / 0.5)
    np.testing.assert_allclose(timeline.sample_times_us(500, 1500), 500 + 1000 * np.arange(1, count) / count)
    both = Timeline(view(), camera, {"card": track((0, [0, 0, 0]), (4000, [0.05, 0, 0]))}, {"card": CARD}, corners, 0.8)
    slices = np.concatenate([[0], both.edges_us(0, 4000), [4000]])
    assert slices.size == 5 + 1
    pieces = int(np.ceil(px / 5 / 0.8 - 1e-9))
    np.testing.assert_allclose(both.sample_times_us(0, 4000), 4000 * np.arange(1, 5 * pieces) / (5 * pieces))

"""The least depth of what rests in view: of cards in a corner of the picture and outside of it."""

import pytest
from rendering import make_scene, mono, pair_tracer

from hesim_render.sources.render.change_driven.resting_depth import least_depth_m

#: At a depth of 1.3 m the picture of 40° is 0.473 m wide to each side, and 0.355 m high.
CAMERA = {"origin_m": [0.3, -0.2, 2.5], "target_m": [0.3, -0.2, 0], "horizontal_fov_deg": 40}
LIGHT = [{"type": "uniform", "illuminant": "D65", "illuminance_lux": 200}]


def depth(x, y, motion=(), t_us=0.0):
    objects = [
        {"name": "wall", "shape": "rectangle", "size_m": [9, 9, 0], "position_m": [0, 0, 0.1], "reflectance": 0.5},
        {"name": "card", "shape": "rectangle", "size_m": [0.1, 0.1, 0], "position_m": [0.3 + x, -0.2 + y, 1.2],
         "reflectance": 0.2},
    ]  # fmt: skip
    scene = make_scene(objects=objects, light=LIGHT, camera=CAMERA, motion=list(motion))
    return least_depth_m(pair_tracer(scene, mono(64, 48)), t_us)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize(("x", "y", "seen"), [(0.42, 0.3, 1.3), (0.42, -0.3, 1.3), (0.54, 0.3, 2.4), (0.42, 0.42, 2.4)])
def test_a_card_counts_where_it_is_in_the_picture(side, x, y, seen):
    assert depth(side * x, y) == pytest.approx(seen, rel=1e-5)


def test_depth_is_that_from_where_the_camera_is_at_the_time():
    """After 20 ms it has moved 0.4 m forward and 0.9 m aside, so that the card is out of the picture."""
    keys = [{"t_us": 0}, {"t_us": 40_000, "translation_m": [1.8, 0, -0.8]}]
    motion = [{"object": "camera", "keyframes": keys}]
    assert depth(0.1, 0.2, motion, 0.0) == pytest.approx(1.3, rel=1e-5)
    assert depth(0.1, 0.2, motion, 20_000.0) == pytest.approx(2.0, rel=1e-5)
    assert depth(0.9, 0.2, motion, 20_000.0) == pytest.approx(0.9, rel=1e-5)

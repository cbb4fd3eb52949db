"""Radiance does not depend on the scale of a scene: small ones are rendered as large ones."""

import warnings

import numpy as np
import pytest
from rendering import make_scene, mono, pair_tracer, traced

from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.transport.leaving import Leaving
from hesim_render.sources.render.transport.moving_scene import MovingScene

CAMERA = {"origin_m": [0, 0, 3], "target_m": [0, 0, 0], "horizontal_fov_deg": 20}
COLS, ROWS, RAYS = 24, 16, 64


def scene(scale, depth):
    """A box and a moving ball that touch a floor, 1.2 m from corner to corner, times a scale, and a lamp far away."""

    def size(*values):
        return [value * scale for value in values]

    floor = {"name": "floor", "shape": "rectangle", "size_m": size(0.9, 0.8, 0), "rotation_axis": [1, 0, 0],
             "rotation_deg": -90, "reflectance": 0.6}  # fmt: skip
    box = {"name": "box", "shape": "box", "size_m": size(0.2, 0.16, 0.18), "position_m": size(-0.1, 0.08, 0.02),
           "rotation_axis": [0, 1, 0], "rotation_deg": 25, "reflectance": 0.5}  # fmt: skip
    ball = {"name": "ball", "shape": "sphere", "size_m": size(0.12, 0.12, 0.12), "position_m": size(0.12, 0.06, 0.1),
            "reflectance": 0.7}  # fmt: skip
    plane = {"plane_point_m": [0, 0, 0], "plane_normal": [0, 1, 0]}
    light = [
        {"type": "directional", "direction": [-0.8, -1, 0.1], "illuminance_lux": 300, **plane},
        {"type": "area", "position_m": size(1.5, 2.5, 1.1), "size_m": size(0.5, 0.3), "illuminance_lux": 200, **plane},
        {"type": "uniform", "illuminance_lux": 150, **plane},
    ]
    track = [{"t_us": 0}, {"t_us": 1000, "translation_m": size(0.03, 0, 0.01)}]
    return make_scene(
        objects=[floor, box, ball], light=light, max_depth=depth, motion=[{"object": "ball", "keyframes": track}],
        camera={"origin_m": size(0.1, 0.6, 0.5), "target_m": size(0, 0, 0.05), "horizontal_fov_deg": 38},
    )  # fmt: skip


@pytest.mark.parametrize("depth", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_small_scenes_look_as_large_ones(depth):
    """Shadows begin at the objects that cast them, in a scene of 3 mm, too."""
    sensor = mono(COLS, ROWS, lens__magnification=0)
    large, small = (
        traced(pair_tracer(scene(scale, depth), sensor), RAYS).mean.astype(float) for scale in (1.0, 2.3e-3)
    )
    np.testing.assert_allclose(small.mean() / large.mean(), 1, atol=3e-4)
    assert np.sqrt(np.mean((small / large - 1) ** 2)) < 0.004


@pytest.mark.parametrize(("far_m", "is_told"), [(320, False), (450, True)])
def test_a_scene_far_from_the_origin_is_told(far_m, is_told):
    """At 450 m rays leave surfaces by 40 mm, a tenth of this scene."""
    card = {"name": "card", "shape": "rectangle", "size_m": [0.3, 0.24, 0], "position_m": [0, far_m, 1]}
    lamp = {"type": "area", "position_m": [0, 0, 2], "size_m": [1, 1], "illuminance_lux": 100}
    built = build(mitsuba(), make_scene(objects=[{**card, "reflectance": 0.5}], light=lamp, camera=CAMERA).spec)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        MovingScene(built)
    texts = [str(warning.message) for warning in caught]
    assert len(texts) == is_told
    assert all(
        f"0.384 m large, lies {far_m} m from the origin" in text and "begin 0.04 m off" in text for text in texts
    )


@pytest.mark.parametrize("scale", [1.0, 2.3e-3])
def test_rays_leave_by_a_gap_of_size_and_place(scale):
    """Mitsuba's own in a large scene. The floor is 0.9 by 0.8, the lamp far away does not count."""
    mi = mitsuba()
    leaving = Leaving(mi, build(mi, scene(scale, 2).spec).scene)
    size = min(1.0, scale * np.sqrt(0.9**2 + 0.8**2 + 0.16**2))
    place, normal = np.array([0.3, -0.7, 0.2]) * scale, np.array([0.48, 0.6, 0.64])
    aim, way = np.array([0.1, 0.5, 0.9]) * scale, np.array([-0.6, 0.0, -0.8])
    point = mi.Interaction3f(mi.Float(1), mi.Float(0), mi.Spectrum(500), mi.Point3f(place), mi.Normal3f(normal))
    gap = (size + 0.7 * scale) * 1500 * 2.0**-24
    along, to = leaving.along(point, mi.Vector3f(way)), leaving.to(point, mi.Point3f(aim))
    for ray, side in ((along, -1), (to, 1)):
        off = np.array(ray.o, np.float64).ravel() - place
        np.testing.assert_allclose(off, side * gap * normal, rtol=2e-3, atol=1e-7 * scale)
    np.testing.assert_allclose(np.array(along.d).ravel(), way, atol=1e-6)
    end = np.array(to.o).ravel() + np.array(to.d).ravel() * np.array(to.maxt) / (1 - 15000 * 2.0**-24)
    np.testing.assert_allclose(end, aim, atol=2e-6 * scale)

"""The picture of a framing: lamps are white, and surfaces are darker the more they are turned away."""

import numpy as np
from rendering import make_scene, mono

from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.framing import posed_view
from hesim_render.sources.render.look import _colours
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

CAMERA = {"origin_m": [0, 0, 1], "target_m": [0, 0, 0], "horizontal_fov_deg": 90}


def seen(places, **sections):
    """Colours at places of 40 × 30 px, which see 2 m × 1.5 m at z = 0."""
    scene = make_scene(camera=CAMERA, **sections)
    mi = mitsuba()
    built = build(mi, scene.spec)
    view = posed_view(scene.spec, place_camera(scene.spec, mono(40, 30)), 0.0)
    return _colours(mi, built.scene, view, *np.array(places, dtype=float).T)


def test_lamps_are_white_beside_what_they_light():
    """A lamp of 0.3 × 0.2 m, 1.5 m away about (0.4, 0.3): columns 23.3 to 27.3, rows 9.7 to 12.3; behind it 7 %."""
    wall = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.6], "reflectance": 0.07}
    lamp = {
        "type": "area", "illuminance_lux": 90, "position_m": [0.4, 0.3, -0.5], "size_m": [0.3, 0.2],
        "plane_point_m": [0.4, 0.3, 2], "plane_normal": [0, 0, -1],
    }  # fmt: skip
    found = seen([(25, 11), (23.5, 9.8), (27.2, 12.2), (23, 11), (27.6, 11), (25, 9.5), (25, 12.5)],
                 light=[lamp], objects=[wall])  # fmt: skip
    np.testing.assert_array_equal(found[:3], 1.0)
    assert np.all(found[3:] < 0.07 * (1 + 1e-6)) and np.all(found[3:] > 0.05)


def test_a_tilted_card_is_darker_by_its_cosine():
    """Linear in the cosine between the normal and the ray: 0.35 of the reflectance where it vanishes."""
    for degrees in (20, 65):
        card = {
            "name": "card", "shape": "rectangle", "size_m": [0.8, 0.6, 0], "rotation_axis": [0, 1, 0],
            "rotation_deg": degrees, "reflectance": 0.62,
        }  # fmt: skip
        (found,) = seen([(20, 15)], light=[{"type": "uniform", "illuminance_lux": 9}], objects=[card])
        np.testing.assert_allclose(found, 0.62 * (0.35 + 0.65 * np.cos(np.radians(degrees))), rtol=1e-3)

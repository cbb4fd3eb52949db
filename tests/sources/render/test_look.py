"""Pictures of a framing and of a motion: lamps are white, what is turned away is darker; all in their places."""

import numpy as np
import pytest
from rendering import D65_1000_LUX, make_scene, mono

import hesim_render as hr
from hesim_render.sources.render import look as framing_look
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.framing import framing, posed_view
from hesim_render.sources.render.look import _colours
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.truth import motion_look as motion

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


@pytest.mark.parametrize("stride", [1, 3])
def test_the_picture_of_a_motion_shows_every_few_pixels_of_the_region(monkeypatch, stride):
    """A card over columns 11.5 to 28.5 and rows 8 to 19 of 44 × 30 px, at a time when it has moved by 6 px."""
    monkeypatch.setattr(motion, "_LONGER_SIDE", -(-44 // stride))
    card = {"name": "card", "shape": "rectangle", "size_m": [0.17, 0.11, 0], "position_m": [-0.08, 0.015, 0.001],
            "reflectance": 0.12}  # fmt: skip
    wall = {"name": "wall", "shape": "rectangle", "size_m": [90, 90, 0], "reflectance": 0.52}
    track = [{"t_us": 0}, {"t_us": 50_000, "translation_m": [0.15, 0, 0]}]
    scene = make_scene(
        objects=[card, wall], light=D65_1000_LUX, motion=[{"object": "card", "keyframes": track}],
        camera={"origin_m": [0, 0, 12], "target_m": [0, 0, 0],
                "horizontal_fov_deg": 2 * np.degrees(np.arctan(0.01 * 44 / 2 / 12))},
    )  # fmt: skip
    found = motion.motion_look(scene, hr.load_sensor("imx250").crop(44, 30), 20_000.0, 50_000)
    # trails of points of the card, on a grid of the region at that time; 15 px in the run
    at = np.array([np.interp(20_000, found.times_us, trail[:, 0]) for trail in found.trails])
    assert at.size > 20 and np.all((at > 11.4) & (at < 28.1)) and at.min() < 13 and at.max() > 26.5
    assert np.all((found.trails[..., 1] > 7.4) & (found.trails[..., 1] < 19.1))
    apart = 44 / motion._POINTS
    grid = (at - apart / 2) / apart
    np.testing.assert_allclose(grid, np.rint(grid), atol=0.02)
    cols, rows = np.arange(stride // 2, 44, stride), np.arange(stride // 2, 30, stride)
    assert found.stride == stride and found.picture.shape == (rows.size, cols.size, 3)
    across, down = (cols > 11) & (cols < 28), (rows >= 8) & (rows < 19)
    edge = ((cols == 11) | (cols == 28))[None, :] & down[:, None]
    expected = np.where(down[:, None] & across[None, :], 0.12, 0.52)
    np.testing.assert_allclose(found.picture[~edge], np.repeat(expected[~edge][:, None], 3, axis=1), rtol=0.01)


def test_a_tall_picture_has_its_longer_side_and_both_outlines():
    """40 × 60 px in 427 × 640 of the picture: an eighth of 60 px lies beside it on all sides; the target in red."""
    target = {"type": "flat", "width_m": 0.3, "height_m": 0.2, "reflectance": 0.4}
    scene = make_scene(
        target=target, light={"type": "uniform", "illuminance_lux": 9}, camera={"fit": "target", "fit_margin": 0.8}
    )
    found = framing_look.look(scene, mono(40, 60))
    scale = 640 / 75
    assert found.picture.shape[:2] == (640, round(55 * scale))
    np.testing.assert_allclose(found.region, [7.5 * scale, 7.5 * scale, 47.5 * scale, 67.5 * scale])
    rgb = found.picture.astype(int)
    red = np.argwhere((rgb[..., 0] > 200) & (rgb[..., 1] < 90))
    # the target is 32 px wide, 21.3 px high, about the middle of the region
    half = np.array([0.8 * 40 / 1.5 / 2, 0.8 * 40 / 2]) * scale
    middle = np.array([37.5, 27.5]) * scale
    np.testing.assert_allclose([red.min(axis=0), red.max(axis=0)], [middle - half, middle + half], atol=2.5)
    white = np.argwhere(np.all(rgb == 255, axis=-1))
    np.testing.assert_allclose([white.min(axis=0), white.max(axis=0)],
                               [[7.5 * scale] * 2, [67.5 * scale, 47.5 * scale]], atol=2)  # fmt: skip


@pytest.mark.parametrize("size_px", [(60, 40), (40, 66)])
@pytest.mark.parametrize("size_m", [(0.3, 0.1), (0.2, 0.35)])
def test_a_target_fills_its_part_of_the_side_that_it_fills_more(size_px, size_m):
    """0.8 of one side; of the other by the ratio of both shapes."""
    target = {"type": "flat", "width_m": size_m[0], "height_m": size_m[1]}
    scene = make_scene(
        target=target, light={"type": "uniform", "illuminance_lux": 9}, camera={"fit": "target", "fit_margin": 0.8}
    )
    found = framing(scene.spec, place_camera(scene.spec, mono(*size_px)))
    ratio = (size_m[0] / size_px[0]) / (size_m[1] / size_px[1])
    np.testing.assert_allclose(found.fills, [0.8 * min(1, ratio), 0.8 * min(1, 1 / ratio)], rtol=1e-6)

"""Camera placement against the thin lens, orientation, and motion through a pixel."""

import numpy as np
import pytest
from mitsuba_specfilm import camera_at
from rendering import D65_1000_LUX, FURNACE, flux_image, make_scene, mono

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.camera import look_at, place_camera
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.framing import posed_view
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.scene import Scene


def spot(x, y, name="spot"):
    return {
        "name": name,
        "shape": "rectangle",
        "size_m": (0.04, 0.04, 0),
        "position_m": (x, y, 0.001),
        "reflectance": {"flat": 0.9},
    }


DARK_FIELD = {"type": "flat", "width_m": 0.4, "height_m": 0.3, "reflectance": {"flat": 0.0}}


def centroid(image):
    rows, cols = np.indices(image.shape)
    return (cols * image).sum() / image.sum(), (rows * image).sum() / image.sum()


def test_orientation_y_up_is_up_and_x_is_to_the_right():
    # a bright square at x = +0.1 m, y = +0.075 m on a black 0.4 × 0.3 m target that fills 64 × 48 pixels
    scene = make_scene(
        target=DARK_FIELD, objects=[spot(0.1, 0.075)], light=FURNACE, camera={"fit": "target", "fit_margin": 1.0}
    )
    a, b, _ = flux_image(scene, mono(), 16)
    col, row = centroid(a + b)
    assert abs(col - (0.75 * 64 - 0.5)) < 0.1  # pixel centres lie at half-integers
    assert abs(row - (0.25 * 48 - 0.5)) < 0.1


def test_look_at_camera_sees_its_target_in_the_middle_and_up_is_up():
    scene = make_scene(
        target=DARK_FIELD,
        objects=[spot(0.1, 0.075)],
        light=FURNACE,
        camera={"origin_m": (0.1, 0.075, 0.8), "target_m": (0.1, 0.075, 0), "up": (1, 0, 0), "horizontal_fov_deg": 40},
    )
    _, _, source = flux_image(scene, mono(), 2)
    corners = np.array([[0.1, 0.075, 0], [0.2, 0.075, 0], [0.1, 0.175, 0]])
    middle, upwards, left = source.view.project(corners)
    np.testing.assert_allclose(middle, [32, 24], atol=1e-9)
    assert upwards[1] < 24 - 5 and abs(upwards[0] - 32) < 1e-9  # up is +x: it rises in the image
    assert left[0] < 32 - 5 and abs(left[1] - 24) < 1e-9  # then +y is to the left
    scale = 32 / np.tan(np.radians(20)) / 0.8  # pixels per metre at 0.8 m
    np.testing.assert_allclose(24 - upwards[1], 0.1 * scale, rtol=1e-12)


@pytest.mark.parametrize(("width", "height", "offset"), [(256, 128, None), (128, 128, (0, 0)), (64, 128, (1400, 800))])
def test_fit_fills_the_region_exactly_for_a_thin_lens(width, height, offset):
    sensor = hr.load_sensor("reference-bayer").crop(width, height, *(offset or (None, None)))
    scene = make_scene(
        target={"type": "flat", "width_m": 0.3, "height_m": 0.2},
        light=D65_1000_LUX,
        camera={"fit": "target", "fit_margin": 0.9},
    )
    view = place_camera(scene.spec, sensor)
    lens = view.sensor.lens
    distance_mm = view.camera_to_world[2, 3] * 1e3
    expected_m = 0.9 * min(width * 0.004 / 300, height * 0.004 / 200)
    np.testing.assert_allclose(lens.magnification, expected_m, rtol=1e-9)
    # 1/f = 1/v + 1/d with the image at v = f (1 + m)
    np.testing.assert_allclose(1 / 16, 1 / (16 * (1 + expected_m)) + 1 / distance_mm, rtol=1e-9)
    corners = np.array([[-0.15, 0.1, 0], [0.15, -0.1, 0]])
    (left, top), (right, bottom) = view.project(corners)
    np.testing.assert_allclose([(left + right) / 2, (top + bottom) / 2], [width / 2, height / 2], atol=1e-6)
    np.testing.assert_allclose(max((right - left) / width, (bottom - top) / height), 0.9, rtol=1e-9)


def test_fit_with_a_field_of_view_or_a_fixed_magnification():
    sensor = mono(100, 50)  # magnification fixed at 0 in this sensor's file
    target = {"type": "flat", "width_m": 0.2, "height_m": 0.1}
    for camera in ({"horizontal_fov_deg": 30}, {}):
        scene = make_scene(target=target, light=D65_1000_LUX, camera={"fit": "target", **camera})
        view = place_camera(scene.spec, sensor)
        (left, top), (right, bottom) = view.project(np.array([[-0.1, 0.05, 0], [0.1, -0.05, 0]]))
        np.testing.assert_allclose([left, top, right, bottom], [0, 0, 100, 50], atol=1e-9)
        assert view.sensor.lens.magnification == 0
    assert view.sensor.lens.focal_length_mm == 16


@pytest.mark.parametrize("stated_m", [None, 0.7])
def test_fit_with_a_field_of_view_focuses_on_the_target(stated_m):
    """v from the field of view, d = v/m, and 1/f = 1/v + 1/d; or the distance that the file gives."""
    sensor = mono(100, 50, lens__magnification="focus")
    target = {"type": "flat", "width_m": 0.2, "height_m": 0.1}
    camera = {"fit": "target", "horizontal_fov_deg": 30, "fit_margin": 0.8, "focus_distance_m": stated_m}
    view = place_camera(make_scene(target=target, light=D65_1000_LUX, camera=camera).spec, sensor)
    width_mm = 100 * sensor.spec.geometry.pitch_um * 1e-3
    image_mm = width_mm / 2 / np.tan(np.radians(15))
    away_mm = image_mm / (0.8 * width_mm / 200)
    assert view.camera_to_world[2, 3] == pytest.approx(away_mm * 1e-3)
    focus_mm = away_mm if stated_m is None else 700
    lens = view.sensor.lens
    assert lens.focal_length_mm == pytest.approx(1 / (1 / image_mm + 1 / focus_mm))
    assert view.sensor.lens.image_distance_mm == pytest.approx(image_mm)


def test_a_crop_off_the_axis_sees_its_part_of_the_full_picture():
    scene = hr.load_scene("siemens-star", {"camera": {"origin_m": [0, 0, 0.9], "target_m": [0, 0, 0]}})
    full = hr.load_sensor("reference-bayer")
    part = full.crop(64, 48, 900, 400)
    point = np.array([[0.03, 0.02, 0.0]])
    whole_view, part_view = place_camera(scene.spec, full), place_camera(scene.spec, part)
    np.testing.assert_allclose(whole_view.project(point) - part_view.project(point), [[900, 400]], atol=1e-9)


def test_field_of_view_of_a_crop_off_the_axis_still_looks_at_the_target():
    camera = {"origin_m": [0, 0, 0.9], "target_m": [0.1, 0, 0], "horizontal_fov_deg": 20}
    scene = hr.load_scene("siemens-star", {"camera": camera})
    view = place_camera(scene.spec, hr.load_sensor("reference-bayer").crop(64, 48, 900, 400))
    np.testing.assert_allclose(view.project(np.array([[0.1, 0.0, 0.0]])), [[32, 24]], atol=1e-6)


def test_up_along_the_line_of_sight_is_an_error():
    with pytest.raises(SpecError, match="up"):
        look_at((0, 1, 0), (0, 0, 0), (0, 1, 0))


def test_scene_replaces_f_number_and_focal_length():
    camera = {"origin_m": (0, 0, 0.5), "focal_length_mm": 25, "f_number": 8}
    scene = make_scene(target=DARK_FIELD, light=FURNACE, camera=camera)
    lens = place_camera(scene.spec, hr.load_sensor("reference-bayer")).sensor.lens
    assert (lens.f_number, lens.focal_length_mm) == (8, 25)
    np.testing.assert_allclose(lens.magnification, 25 / (500 - 25), rtol=1e-12)


def edge_scene(**sections):
    """Half-plane of radiance 1: a white card whose left border is at x = 0; black behind it."""
    card = {"name": "card", "shape": "rectangle", "size_m": (0.4, 0.8, 0), "position_m": (0.2, 0, 0.0001)}
    return make_scene(
        target={"type": "flat", "width_m": 0.8, "height_m": 0.8, "reflectance": {"flat": 0.0}},
        objects=[{**card, "reflectance": {"flat": 1.0}}],
        light=FURNACE,
        camera={"origin_m": (0, 0, 0.5), "horizontal_fov_deg": 20},
        **sections,
    )


def test_camera_motion_is_integrated_over_each_pixels_own_interval():
    # the camera moves to +x at v: in the image the edge moves to the left, and the lit share of a pixel that
    # spans [x0, x0 + 1] averaged over [t0, t1] is the mean of clip(x0 + 1 − edge(t), 0, 1)
    pixels_per_m = 32 / np.tan(np.radians(10)) / 0.5
    speed_px_per_us = 10 / 1000
    end_m = speed_px_per_us * 4000 / pixels_per_m
    keys = [{"t_us": 0}, {"t_us": 4000, "translation_m": (end_m, 0, 0)}]
    scene = edge_scene(motion=[{"object": "camera", "keyframes": keys}])
    samples = 4096
    rows, cols = np.indices((8, 64))
    begin = 300.0 * rows.ravel()  # like a rolling shutter: each row has its own interval
    width = np.where(cols.ravel() % 2 == 0, 300.0, 900.0)
    a, b, source = flux_image(scene, mono(64, 8), samples, begin_us=begin, end_us=begin + width)
    measured = (a + b) / 2
    share = measured / measured[:, -4:].mean()
    # at pixel [32, 33) the edge stands at its left border at t = 0 and moves to the left
    time = begin[:, None] + width[:, None] * (np.arange(200) + 0.5) / 200
    edge = 32 - speed_px_per_us * time
    expected = np.clip(cols.ravel()[:, None] + 1 - edge, 0, 1).mean(axis=1).reshape(8, 64)
    assert not source.is_static and source.slice_edges_us(0, 4000).size == 0
    # a sample sees the card or not: at most binomial (strata only lower it), 5 σ with 512 pixels: false alarm 3e-4.
    # Beside it 1e-3 for the time steps of the expectation. Neighbours' intervals would be off by 0.3 and more.
    bound = 5 * np.sqrt(expected * (1 - expected) / samples) + 1e-3
    assert np.all(np.abs(share - expected) < bound)
    assert (np.abs(expected - np.roll(expected, 2, axis=1)) > bound).mean() > 0.1  # the test can tell


def test_a_camera_track_is_held_outside_its_keyframes():
    keys = [{"t_us": 1000, "translation_m": (0.01, 0, 0)}, {"t_us": 2000, "translation_m": (0.02, 0, 0)}]
    moving = edge_scene(motion=[{"object": "camera", "keyframes": keys}])
    before, _, source = flux_image(moving, mono(), 16, begin_us=0, end_us=900)
    pixels = np.arange(64 * 48)
    later = np.array(source.mean_flux(pixels, 2500, 2600)[0])
    again = np.array(source.mean_flux(pixels, 9500, 9600)[0])
    np.testing.assert_array_equal(later, again)
    assert not np.array_equal(before.ravel(), later)


@pytest.mark.parametrize("mode", ["exact", "change-driven"])
def test_a_camera_track_that_holds_one_pose_puts_the_camera_there(mode):
    # the edge at x = 0 leaves the middle of the picture by as much as the camera goes to +x
    shift_m = 10 / (32 / np.tan(np.radians(10)) / 0.5)
    keys = [{"t_us": t, "translation_m": (shift_m, 0, 0)} for t in (0, 1000)]
    scene = edge_scene(motion=[{"object": "camera", "keyframes": keys}])
    sensor = mono(64, 4)
    source = ChangeDrivenFlux(scene, sensor, 0.5) if mode == "change-driven" else RenderedFlux(scene, sensor, 16)
    a, b = source.mean_flux(np.arange(64 * 4, dtype=np.uint32), 0, 1000)
    share = (np.array(a) + np.array(b)).reshape(4, 64)
    share /= share[:, -1:]
    np.testing.assert_allclose(share, np.broadcast_to(np.arange(64) >= 22, (4, 64)), atol=0.02)
    assert posed_view(scene.spec, source.view, 500).camera_to_world[0, 3] == pytest.approx(shift_m)
    assert camera_at(scene, source.view, 500)[0, 3] == pytest.approx(shift_m)


def test_mitsuba_camera_is_followed():
    import mitsuba as mi

    mitsuba()  # sets the variant
    scene = Scene.from_mitsuba(mi.cornell_box())
    _, _, source = flux_image(scene, hr.load_sensor("reference-bayer").crop(96, 64), 2)
    # the box's front opening, 2 m wide and high, 2.9 m away, fov 39.3077°: square picture, height fits
    half = 32 * 1 / (2.9 * np.tan(np.radians(39.3077 / 2)))
    corner = source.view.project(np.array([[1.0, 1.0, 1.0]]))
    np.testing.assert_allclose(corner, [[48 + half, 32 - half]], atol=1e-3)
    assert source.sensor.lens.magnification == 0

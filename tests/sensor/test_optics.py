"""The lens against closed forms."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sensor import lens as optics
from hesim_render.sensor.lens import Lens


def test_solid_angle_states_its_formula():
    lens = Lens(f_number=4.0, focal_length_mm=16.0, magnification=0.25)
    assert lens.solid_angle_sr == pytest.approx(np.pi / (1 + 4 * 16 * 1.25**2), rel=1e-12)
    # the common π/4N² is 1.6 % higher at f/4 and m = 0
    far = Lens(4.0, 16.0, 0.0)
    assert np.pi / (4 * 16) / far.solid_angle_sr == pytest.approx(1 + 1 / 64, rel=1e-12)


def test_magnification_follows_focus_and_thin_lens():
    sensor = hr.load_sensor("eiger").with_lens(focus_distance_m=0.104)
    # 1/f = 1/d + 1/i with f = 4 mm, d = 104 mm: i = 4.16 mm = f (1 + |m|)
    assert sensor.lens.magnification == pytest.approx(0.04, rel=1e-12)
    assert sensor.lens.image_distance_mm == pytest.approx(4.16, rel=1e-12)
    assert hr.load_sensor("eiger").lens.magnification == 0.0  # no scene yet: focused at infinity


def test_cos4_at_the_chief_rays_angle():
    sensor = hr.load_sensor("eiger")
    pitch_mm = 1.4e-3
    for row, col in ((0, 0), (1224, 1632), (100, 3000)):
        x, y = (col + 0.5 - 1632) * pitch_mm, (row + 0.5 - 1224) * pitch_mm
        angle = np.arctan(np.hypot(x, y) / 4.0)
        assert sensor.relative_illumination[row, col] == pytest.approx(np.cos(angle) ** 4, rel=1e-6)


def test_crop_keeps_each_pixels_place_on_the_chip():
    full = hr.load_sensor("gen2")
    crop = full.crop(64, 32, x=400, y=1200)
    np.testing.assert_array_equal(crop.relative_illumination, full.relative_illumination[1200:1232, 400:464])


def test_vignetting_table_is_linear_in_image_height():
    table = {"image_height_mm": [0.0, 1.0, 2.0], "illumination_rel": [1.0, 0.9, 0.5]}
    sensor = hr.load_sensor("eiger", {"lens.relative_illumination": table})
    x, y = optics.pixel_centres_mm(sensor.layout)
    height = np.hypot(x[2000], y[1224])
    assert sensor.relative_illumination[1224, 2000] == pytest.approx(1 - 0.1 * height, rel=1e-5)
    assert sensor.relative_illumination[0, 0] == pytest.approx(0.5)

"""Spectral cubes and spectral EXR files."""

import os

import numpy as np
import OpenEXR
import pytest
from rendering import D65_1000_LUX, d65_irradiance, flux_image, make_scene

import hesim_render as hr
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.sources.render import read_spectral_exr, render_cube, write_spectral_exr

FLAT = {
    "target": {"type": "flat", "width_m": 5, "height_m": 5, "reflectance": {"flat": 0.4}},
    "light": D65_1000_LUX,
    "camera": {"origin_m": (0, 0, 1)},
}


def test_cube_of_a_flat_field_is_exact_at_every_band():
    bands = np.array([380.0, 401.5, 550.0, 555.0, 623.25, 779.0])
    _, radiance, stderr = render_cube(make_scene(**FLAT), (6, 10), bands, 4)
    grid, irradiance = d65_irradiance(1000)
    expected = 0.4 * np.interp(bands, grid, irradiance) / np.pi
    assert radiance.shape == stderr.shape == (6, 10, 6) and radiance.dtype == np.float32
    np.testing.assert_allclose(radiance, np.broadcast_to(expected, (6, 10, 6)), rtol=2e-5)
    assert stderr.max() < 1e-6 * expected.max()  # nothing varies over a flat field at one wavelength


def test_photocurrent_of_the_cube_is_the_rendered_flux():
    sensor = hr.load_sensor("reference-bayer").crop(48, 32)
    scene = hr.load_scene("colorchecker")
    a, b, source = flux_image(scene, sensor, 256)
    bands, radiance, _ = render_cube(scene, sensor, np.arange(380, 781, 5.0), 64)
    electrons = hr.photocurrent(radiance.astype(np.float64), bands, source.sensor, 1_000_000)
    ratio = electrons.sum() / ((a + b) / 2).sum()
    assert abs(ratio - 1) < 2e-3  # 64 rays at patch borders, 5 nm bands


def test_cube_follows_motion():
    scene = hr.load_scene("rotating-star")
    _, early, _ = render_cube(scene, (32, 32), [550], 16, 0.0)
    _, later, _ = render_cube(scene, (32, 32), [550], 16, 50_000.0)  # a spoke's width later (18° of 360° / 20)
    _, whole, _ = render_cube(scene, (32, 32), [550], 16, 2_000_000.0)
    assert np.abs(early - later).max() > 0.2 * early.max()
    np.testing.assert_array_equal(early, whole)


def test_exr_round_trip_and_the_openexr_library_itself(tmp_path):
    rng = np.random.default_rng(0)
    bands = np.array([400.0, 550.0, 550.25, 700.123456])
    cube = rng.gamma(2, 0.01, (5, 7, 4)).astype(np.float32)
    path = write_spectral_exr(tmp_path / "cube.exr", cube, bands)
    wavelength, radiance = read_spectral_exr(path)
    np.testing.assert_allclose(wavelength, bands, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(radiance, cube)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        layer = np.array(file.channels()["S0.550,000000nm"].pixels)
    assert sorted(channel.name for channel in header["channels"]) == [
        "S0.400,000000nm",
        "S0.550,000000nm",
        "S0.550,250000nm",
        "S0.700,123456nm",
    ]
    assert header["spectralLayoutVersion"] == "1.0"
    assert header["emissiveUnits"] == "W.m^-2.sr^-1.nm^-1"
    assert header["compression"] == OpenEXR.PIZ_COMPRESSION
    np.testing.assert_array_equal(layer, cube[:, :, 1])
    assert layer.dtype == np.float32
    assert os.listdir(tmp_path) == ["cube.exr"]


def test_bad_cubes_and_files_are_one_clear_error(tmp_path):
    cube = np.zeros((2, 3, 2), dtype=np.float32)
    with pytest.raises(OutputError, match="cannot be written"):
        write_spectral_exr(tmp_path / "missing" / "x.exr", cube, [500, 600])
    with pytest.raises(RangeError, match="shape"):
        write_spectral_exr(tmp_path / "x.exr", cube, [500, 600, 700])
    with pytest.raises(RangeError, match="different"):
        write_spectral_exr(tmp_path / "x.exr", cube, [500, 500])
    assert os.listdir(tmp_path) == []
    (tmp_path / "not.exr").write_text("hello")
    with pytest.raises(SpecError, match="not a readable EXR"):
        read_spectral_exr(tmp_path / "not.exr")
    with pytest.raises(SpecError, match="no such file"):
        read_spectral_exr(tmp_path / "none.exr")
    with OpenEXR.File({}, {"RGB": np.zeros((2, 2, 3), dtype=np.float32)}) as file:
        file.write(str(tmp_path / "rgb.exr"))
    with pytest.raises(SpecError, match="not a spectral EXR"):
        read_spectral_exr(tmp_path / "rgb.exr")
    for bands in ([], [600, 500], [300], [900]):
        with pytest.raises(RangeError, match="bands_nm"):
            render_cube(make_scene(**FLAT), (2, 2), bands, 2)
    with pytest.raises(SpecError, match=r"light\.illuminant"):
        narrow = {"light.illuminant": {"flat": 1.0, "band_nm": [450, 700]}}
        render_cube(hr.load_scene("flat-field", narrow), (2, 2), [440, 500], 2)

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


@pytest.mark.slow
def test_photocurrent_of_the_cube_is_the_rendered_flux():
    sensor = hr.load_sensor("reference-bayer").crop(48, 32)
    scene = hr.load_scene("colorchecker")
    a, b, source = flux_image(scene, sensor, 256)
    bands, radiance, _ = render_cube(scene, sensor, np.arange(380, 781, 5.0), 64)
    electrons = hr.photocurrent(radiance.astype(np.float64), bands, source.sensor, 1_000_000)
    ratio = electrons.sum() / ((a + b) / 2).sum()
    assert abs(ratio - 1) < 2e-3  # 64 rays at patch borders, 5 nm bands


@pytest.mark.slow
def test_cube_follows_motion():
    scene = hr.load_scene("rotating-star")
    _, early, _ = render_cube(scene, (32, 32), [550], 16, 0.0)
    _, later, _ = render_cube(scene, (32, 32), [550], 16, 50_000.0)  # a spoke's width later (18° of 360° / 20)
    _, whole, _ = render_cube(scene, (32, 32), [550], 16, 2_000_000.0)
    assert np.abs(early - later).max() > 0.2 * early.max()
    np.testing.assert_array_equal(early, whole)


@pytest.mark.slow
def test_cube_of_a_window_is_the_mean_of_the_motion_in_it():
    """A card that moves by 1.6 of the 25 mm pixels within the window, in front of nothing: its share of each pixel,
    averaged over the window, times ρE/π.
    """
    card = {"name": "card", "shape": "rectangle", "size_m": [0.4, 2, 0], "reflectance": {"flat": 0.8}}
    frames = [{"t_us": 0}, {"t_us": 10_000, "translation_m": [0.05, 0, 0]}]
    scene = make_scene(
        objects=[card], light={**D65_1000_LUX, "type": "directional", "direction": [0, 0, -1]},
        motion=[{"object": "card", "keyframes": frames}],
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 2 * np.degrees(np.arctan(0.2))},
    )  # fmt: skip
    _, window, stderr = render_cube(scene, (4, 32), [450, 650], 64, 1_000.0, end_us=9_000.0)
    edges = -0.4 + 0.025 * np.arange(33)
    shift = np.linspace(0.005, 0.045, 2001)[:, None]
    covered = np.clip(np.minimum(edges[1:], 0.2 + shift) - np.maximum(edges[:-1], -0.2 + shift), 0, None) / 0.025
    grid, irradiance = d65_irradiance(1000)
    expected = covered.mean(axis=0)[:, None] * 0.8 * np.interp([450, 650], grid, irradiance) / np.pi
    # objects stand still while they move by half a pixel, so a rim may be off by a sixteenth of its change
    np.testing.assert_allclose(window.mean(axis=0), expected, atol=0.07 * expected.max())
    np.testing.assert_allclose(window.mean(axis=0).sum(axis=0), expected.sum(axis=0), rtol=0.002)
    assert stderr.max() < 0.1 * expected.max()
    still, _ = render_cube(scene, (4, 32), [450, 650], 64, 1_000.0)[1:]
    assert np.abs(still.mean(axis=0) - expected).max() > 0.3 * expected.max()
    with pytest.raises(RangeError, match="a time after the begin of the window, 9000 µs"):
        render_cube(scene, (4, 32), [450], 4, 9_000.0, end_us=1_000.0)


def test_cube_has_the_power_of_a_flickering_light_at_its_instant_or_over_its_window():
    wave = {"type": "mains", "frequency_hz": 50, "depth": 0.5, "phase_deg": 0}
    scene = make_scene(**{**FLAT, "light": {**D65_1000_LUX, "waveform": wave}})
    steady = render_cube(make_scene(**FLAT), (2, 2), [550], 2)[1]
    for times, power in (((0.0, None), 1.5), ((5_000.0, None), 0.5), ((0.0, 10_000.0), 1.0),
                         ((0.0, 5_000.0), 1.0), ((0.0, 2_500.0), 1 + 0.5 * 2 / np.pi)):  # fmt: skip
        found = render_cube(scene, (2, 2), [550], 2, times[0], end_us=times[1])[1]
        np.testing.assert_allclose(found / steady, power, rtol=1e-5)


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
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputError, match="file"):
        write_spectral_exr(tmp_path / "file" / "x.exr", cube, [500, 600])
    with pytest.raises(RangeError, match="shape"):
        write_spectral_exr(tmp_path / "x.exr", cube, [500, 600, 700])
    with pytest.raises(RangeError, match="different"):
        write_spectral_exr(tmp_path / "x.exr", cube, [500, 500])
    assert os.listdir(tmp_path) == ["file"]
    (tmp_path / "not.exr").write_text("hello")
    with pytest.raises(SpecError, match="cannot be read as an EXR file"):
        read_spectral_exr(tmp_path / "not.exr")
    with pytest.raises(SpecError, match="no such file"):
        read_spectral_exr(tmp_path / "none.exr")
    with OpenEXR.File({}, {"S0.500nm": np.zeros((2, 2), dtype=np.float32)}) as file:
        file.write(str(tmp_path / "bare.exr"))
    with pytest.raises(SpecError, match="no spectralLayoutVersion"):
        read_spectral_exr(tmp_path / "bare.exr")
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

"""What lies below black is kept: dark frames have the mean of their light in loader, pictures and measures."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.benchmark.exposure_merge import flux_of, flux_scores, merged_exposures
from hesim_render.benchmark.torch_dataset import signal_of
from hesim_render.isp import Pipeline, demosaic, process
from hesim_render.isp.denoise import reduce_noise
from hesim_render.measure.pictures import delta_e, psnr, ssim
from hesim_render.mosaic.description import describe
from hesim_render.spectral.transfer import from_root, to_root

LINEAR = ["black_level", "white_balance", "demosaic", "colour_matrix"]


@pytest.fixture(scope="module")
def dark():
    """A dark frame of a hybrid sensor with 23 e⁻ of read noise, its mosaic, the pixels with a value, the sensor."""
    keys = {"aps.read_noise_e": 23.0, "aps.dark_current_e_per_s": 0.0}
    sensor = hr.load_sensor("gen2", keys).crop(160, 96)
    aps = sensor.aps.without("prnu", "dsnu", "row")
    raw = aps.sample(np.zeros((96, 160), np.float32), 9000, 5, 0)
    valid = sensor.layout.aps_mask
    return np.where(valid, raw, 0).astype(np.uint16), describe(sensor), valid, sensor


def test_the_loader_keeps_what_lies_below_black(dark):
    raw, mosaic, valid, _ = dark
    found = signal_of(raw, valid, mosaic)
    span = 2**mosaic.bit_depth - 1 - mosaic.black_level_dn
    sigma = 23 * mosaic.system_gain_dn_per_e / span
    count = valid.sum()
    assert np.all(found[~valid] == 0) and found[valid].min() < -3 * sigma
    # five standard errors; clipped at black the mean is 0.4 σ
    assert abs(found[valid].mean(dtype=float)) < 5 * sigma / np.sqrt(count)
    assert found[valid].std() == pytest.approx(sigma, rel=0.05)


def test_pictures_of_a_dark_frame_have_no_light(dark):
    raw, mosaic, _, _ = dark
    picture = process(raw, mosaic, Pipeline.of(*LINEAR))
    sigma = picture.std()
    # a pixel of the picture is a sum over some 20 of the mosaic: a tenth of σ is 5 standard errors and more
    assert picture.min() < -2 * sigma and np.all(np.abs(picture.mean(axis=(0, 1))) < 0.05 * sigma)
    smooth = reduce_noise(picture)
    assert abs(smooth.mean()) < 0.05 * sigma


@pytest.mark.parametrize("sigma", [0.004, 0.03])
@pytest.mark.parametrize("method", ["guided", "linear"])
def test_demosaicing_of_a_dark_frame_keeps_its_mean(sigma, method):
    noise = np.random.default_rng(3).normal(0, sigma, (192, 256)).astype(np.float32)
    tile = ((0, 0, 1, 1), (0, -1, 1, 1), (1, 1, 2, 2), (1, 1, 2, 2))
    found = demosaic(noise, tile, method)
    # 6000 samples of blue have a mean known to 0.013 σ
    assert np.all(np.abs(found.mean(axis=(0, 1))) < 0.06 * sigma)
    own = np.tile(np.array(tile) == 2, (48, 64))
    np.testing.assert_allclose(found[own, 2], noise[own], atol=1e-6)


def test_roots_are_odd_about_black_and_have_an_inverse():
    x = np.linspace(-0.3, 1.2, 151, dtype=np.float32)
    np.testing.assert_allclose(from_root(to_root(x)), x, atol=2e-7)
    np.testing.assert_array_equal(to_root(-x), -to_root(x))
    np.testing.assert_allclose(to_root(x[x > 0]), np.sqrt(x[x > 0] + 0.01) - 0.1, rtol=1e-5, atol=1e-7)


def test_measures_count_the_noise_on_both_sides_of_black():
    rng = np.random.default_rng(4)
    truth = np.zeros((40, 33, 3))
    noise = rng.normal(0, 0.02, truth.shape)
    assert psnr(noise, truth) == pytest.approx(-10 * np.log10(np.mean(noise**2)), rel=1e-12)
    assert psnr(-np.abs(noise), truth) == pytest.approx(psnr(np.abs(noise), truth), rel=1e-12)
    assert ssim(-np.abs(noise), truth) < 0.9
    # CIELAB is linear there; CIEDE2000 weights differences by the lightness itself
    below, above = (delta_e(np.full_like(truth, value), truth) for value in (-3e-3, 3e-3))
    assert below == pytest.approx(above, rel=0.05)
    flux = flux_scores(5.0 * noise[..., 0] + 2.0, np.full(truth.shape[:2], 2.0), np.ones(truth.shape[:2], bool))
    assert flux["psnr_linear_db"] > 20
    wide = np.ones(truth.shape[:2], bool)
    scene = np.zeros(truth.shape[:2])
    scene[0, 0] = 7.0  # white of the measure
    found = flux_scores(scene - 0.07 * wide, scene, wide), flux_scores(scene + 0.07 * wide, scene, wide)
    assert found[0]["psnr_linear_db"] == pytest.approx(-10 * np.log10(1e-4), abs=1e-9)
    assert found[1]["psnr_mu_db"] == pytest.approx(found[0]["psnr_mu_db"], abs=0.01)


def test_exposures_of_a_dark_scene_are_merged_without_bias(dark):
    """Flux of 20 and 30 ms: the weights must not follow the noise that they weigh."""
    _, mosaic, _, sensor = dark
    spec = sensor.spec.aps.model_copy(update={"read_noise_e": 2.3})
    noise = np.random.default_rng(8).normal(mosaic.black_level_dn, 2.3 * spec.system_gain_dn_per_e, (2, 200, 150))
    flux = merged_exposures([flux_of(raw, us, spec, mosaic) for raw, us in zip(noise, (20_000, 30_000), strict=True)])
    sigma = 2.3 / np.hypot(0.020, 0.030)
    assert abs(flux.mean()) < 5 * sigma / np.sqrt(flux.size) and flux.std() == pytest.approx(sigma, rel=0.05)

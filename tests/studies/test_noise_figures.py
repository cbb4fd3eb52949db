"""Noise after colour correction: hand calculations, and samples of the noise model."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import RangeError
from hesim_render.studies import ChannelNoise, channel_noise, chart_noise, dynamic_range_db, light_for_snr, output_noise
from hesim_render.studies.colour_noise import saturation_e

MATRIX = np.array([[1.7, -0.5, -0.2], [-0.3, 1.6, -0.3], [0.0, -0.7, 1.7]])


def photon_noise(channels, read_noise_e=0.0, count=1.0):
    """Shot noise and read noise alone."""
    ones = np.ones(channels)
    return ChannelNoise(read_noise_e**2 * ones, ones, 0 * ones, np.broadcast_to(np.asarray(count, float), channels))


def test_amplification_and_snr_by_hand():
    """Shot noise of unequal channels: every variance written out."""
    white = np.array([5000.0, 10000.0, 4000.0])
    noise = photon_noise(3, read_noise_e=3.0, count=[1, 2, 1])
    found = output_noise(MATRIX, white, noise, 0.18)
    var = [(0.18 * 5000 + 9) / 5000**2, (0.18 * 10000 + 9) / 2 / 10000**2, (0.18 * 4000 + 9) / 4000**2]
    red = 1.7**2 * var[0] + 0.5**2 * var[1] + 0.2**2 * var[2]
    green = 0.3**2 * var[0] + 1.6**2 * var[1] + 0.3**2 * var[2]
    blue = 0.7**2 * var[1] + 1.7**2 * var[2]
    np.testing.assert_allclose(np.diag(found.covariance), [red, green, blue], rtol=1e-12)
    assert found.amplification == pytest.approx(math.sqrt((red + green + blue) / sum(var)), rel=1e-12)
    weights = [
        0.299 * 1.7 - 0.587 * 0.3,
        -0.299 * 0.5 + 0.587 * 1.6 - 0.114 * 0.7,
        -0.299 * 0.2 - 0.587 * 0.3 + 0.114 * 1.7,
    ]
    sigma = math.sqrt(sum(w**2 * v for w, v in zip(weights, var, strict=True)))
    assert found.ysnr == pytest.approx(0.18 / sigma, rel=1e-12)  # rows sum to 1: grey stays grey
    np.testing.assert_allclose(found.rgb, 0.18, rtol=1e-12)


#: Tables 1.1 and 1.2 of [adams2010]: balance gains, sensitivity gain, colour matrix (rows sum to 1, which tells the
#: signs that the reprint lost), then S_C = M·S_B·Mᵀ in the lower triangle and the luminance noise before and after M.
PUBLISHED = {
    "RGB": ([1.518, 1.000, 1.257], 2.616,
            [[1.558, -0.531, -0.027], [-0.078, 1.477, -0.399], [0.039, -0.508, 1.469]],
            [10.38, -2.50, 6.25, 0.82, -3.90, 7.78], 1.24, 1.60),
    "red, panchromatic, blue": ([3.972, 1.000, 3.289], 1.000,
            [[2.000, -1.373, 0.373], [-1.062, 3.384, -1.322], [0.412, -1.248, 1.836]],
            [18.22, -14.70, 21.68, 7.24, -13.94, 13.32], 0.84, 2.51),
    "CMY": ([1.155, 1.081, 1.000], 1.752,
            [[-2.554, 2.021, 1.533], [0.941, -1.512, 1.571], [1.201, 1.783, -1.984]],
            [25.05, -6.43, 10.45, -4.71, -8.28, 15.84], 1.03, 1.90),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_comparison_with_clear_pixels_is_reproduced(name):
    """Noise of white-balanced and colour-corrected signals of RGB, RWB and CMY pixels, to the digits printed.

    The clear pixel has less noise than green before the matrix (0.84 against 1.24) and more after it (2.51 against
    1.60). S is in units of the photo-electrons of the exposure index; shot noise alone, one pixel of each channel.
    """
    gains, sensitivity, matrix, triangle, before, after = PUBLISHED[name]
    unit = 1e4  # electrons of a channel with gain 1
    white = unit / (np.array(gains) * sensitivity)
    luminance = (0.2126, 0.7152, 0.0722)
    noise = photon_noise(3)
    plain, corrected = (output_noise(each, white, noise, 1.0, luminance) for each in (np.eye(3), matrix))
    np.testing.assert_allclose(corrected.rgb, 1, atol=2e-3)
    published = np.zeros((3, 3))
    published[np.tril_indices(3)] = triangle
    published += np.tril(published, -1).T
    # rounding of S_C, and of matrices with three digits after the point
    np.testing.assert_allclose(corrected.covariance * unit, published, atol=0.02)
    for found, expected in ((plain, before), (corrected, after)):
        assert math.sqrt(unit) * found.rgb @ luminance / found.ysnr == pytest.approx(expected, abs=0.006)


def test_snr10_of_a_textbook_sensor():
    """One channel, 3200 e⁻ per lux of white, 18 %: N² = 100 (N + σ²) solved by the schoolbook."""
    for read in (0.0, 2.0, 50.0):
        electrons = (100 + math.sqrt(100**2 + 400 * read**2)) / 2
        assert electrons**2 == pytest.approx(100 * (electrons + read**2))
        lux = light_for_snr(10, [1.0], [3200.0], photon_noise(1, read))
        assert lux == pytest.approx(electrons / (0.18 * 3200), rel=1e-12)
    # the light found gives the SNR asked for, also with a quadratic part and several pixels
    noise = ChannelNoise(np.array([9.0, 16.0]), np.ones(2), np.array([1e-4, 0.0]), np.array([2.0, 1.0]))
    per_lux, weights = np.array([40.0, 90.0]), np.array([0.4, 0.2])
    lux = light_for_snr(7, weights, per_lux, noise, 0.3)
    signal = 0.3 * per_lux * lux
    variance = weights[0] ** 2 * (9 + signal[0] + 1e-4 * signal[0] ** 2) / 2 + weights[1] ** 2 * (16 + signal[1])
    assert weights @ signal / math.sqrt(variance) == pytest.approx(7, rel=1e-12)
    assert light_for_snr(300, [1, 0], per_lux, noise, 0.3) == math.inf  # 1 % of the signal in two pixels: never 300
    with pytest.raises(RangeError):
        light_for_snr(0, [1], [1], photon_noise(1))
    with pytest.raises(RangeError):
        light_for_snr(10, [-1], [1], photon_noise(1))


def test_noise_of_a_sensor_is_that_of_its_model_and_its_tile():
    sensor = hr.load_sensor("reference-bayer", {"aps.dark_current_e_per_s": 500.0, "aps.residual_noise_dn": 0.5})
    noise = channel_noise(sensor, ["red", "green", "blue"], 20_000, area_px=4)
    constant = 2**2 + 500 * 0.02 + (0.5 / 0.25) ** 2 + (1 / 12) / 0.25**2
    np.testing.assert_allclose(noise.constant, constant, rtol=1e-9)
    np.testing.assert_allclose(noise.linear, 1, rtol=1e-9)
    np.testing.assert_allclose(noise.quadratic, 0, atol=1e-12)
    assert noise.count.tolist() == [1, 2, 1]
    assert channel_noise(sensor, ["green"], 20_000).count.tolist() == [1]
    # a polynomial of its own for each position: β3 and β4 too
    beta = np.array([[[2.0, 0.25, 3.0, 1e-4, 0.5, 1.0]] * 2] * 2)
    beta[0, 1, 0] = 4.0
    own = hr.load_sensor("reference-bayer", {"aps.beta": beta.tolist()})
    noise = channel_noise(own, ["red", "green"], 10_000)
    rest = 3.0 * 0.01 + 1.0 * 1e-4 + 1 / 12
    np.testing.assert_allclose(noise.constant, [(2 + rest) * 16, (3 + rest) * 16], rtol=1e-9)
    np.testing.assert_allclose(noise.linear, (0.25 + 0.005) / 0.25, rtol=1e-6)
    np.testing.assert_allclose(noise.quadratic, 1e-4, rtol=1e-6)
    with pytest.raises(RangeError, match="filter of the frame pixels"):
        channel_noise(hr.load_sensor("gen2"), ["white"], 10_000)


def test_the_closed_form_is_the_noise_of_samples():
    """A grey field through the noise model, channels of a tile averaged, balanced and mixed: covariance and YSNR.

    49152 tiles: a standard deviation is known to 0.32 %, 3 % are nine of these.
    """
    sensor = hr.load_sensor("reference-bayer").crop(512, 384)
    per_white = np.array([2000.0, 4000.0, 1500.0])
    image = 0.18 * per_white[sensor.layout.filter_index]
    dn = sensor.aps.sample(image, 10_000, seed=5).astype(float)
    electrons = (dn - 64) / 0.25
    tile = electrons.reshape(192, 2, 256, 2).swapaxes(1, 2)
    channels = np.stack([tile[..., 0, 0], (tile[..., 0, 1] + tile[..., 1, 0]) / 2, tile[..., 1, 1]], axis=-1)
    balanced = (channels / per_white).reshape(-1, 3)
    rgb = balanced @ MATRIX.T
    found = output_noise(MATRIX, per_white, channel_noise(sensor, ["red", "green", "blue"], 10_000, area_px=4))
    np.testing.assert_allclose(np.cov(rgb.T), found.covariance, atol=0.03 * np.diag(found.covariance).max())
    measured = np.sqrt(rgb.var(axis=0).mean() / balanced.var(axis=0).mean())
    assert found.amplification == pytest.approx(measured, rel=0.03)
    luminance = rgb @ [0.299, 0.587, 0.114]
    assert found.ysnr == pytest.approx(luminance.mean() / luminance.std(), rel=0.03)


def test_dynamic_range_by_hand():
    sensor = hr.load_sensor("reference-mono", {"aps.dark_current_e_per_s": 1000.0})
    spec = sensor.spec.aps
    top = min(spec.full_well_e, (2**spec.bit_depth - 1 - spec.black_level_dn) / spec.system_gain_dn_per_e) - 10
    assert saturation_e(sensor, 10_000) == pytest.approx(top)
    dark = spec.read_noise_e**2 + 10 + 1 / 12 / spec.system_gain_dn_per_e**2
    assert dynamic_range_db(sensor, 10_000) == pytest.approx(20 * math.log10(top / (math.sqrt(dark + 0.25) + 0.5)))


def test_a_matrix_of_another_size_is_refused():
    with pytest.raises(RangeError, match=r"\(3, 2\)"):
        output_noise(MATRIX, [1.0, 2.0], photon_noise(2))
    with pytest.raises(RangeError, match="above 0"):
        output_noise(MATRIX, [1.0, 2.0, 0.0], photon_noise(3))


def test_colours_of_noisy_frames_are_those_of_the_matrix_to_xyz():
    """Frames whose patches have their true colours, and noise on the grey card alone: no difference is left."""
    rng = np.random.default_rng(4)
    rgb_matrix, xyz_matrix = np.eye(3) + 0.1 * rng.random((2, 3, 3))
    xyz, white = rng.uniform(0.2, 0.7, (5, 3)), np.array([0.95, 1.0, 1.09])
    patches = np.broadcast_to((xyz @ np.linalg.inv(xyz_matrix).T)[None, :, None], (3, 5, 8, 3))
    grey = 0.18 + 0.01 * rng.standard_normal((3, chart_noise.GREYS, 8, 3))
    samples = SimpleNamespace(xyz=xyz, white_xyz=white)
    found = chart_noise.measured_figures(np.concatenate([patches, grey], axis=1), rgb_matrix, xyz_matrix, samples)
    assert found["delta_e_noisy"].value < 1e-6 < found["noise_amplification"].value


def test_charts_that_do_not_fill_their_rows_show_every_patch():
    """Five patches on 3 × 2 places, without noise to speak of: each has its own electrons."""
    sensor = hr.load_sensor("reference-bayer", {"aps.dark_current_e_per_s": 700.0})
    filters = ["red", "green", "blue"]
    patch_e = 300.0 * np.arange(1, 6)[:, None] * np.array([1.0, 1.5, 0.7])
    order = [sensor.layout.filters.index(name) for name in filters]
    told = np.empty_like(patch_e)
    told[:, order] = patch_e
    chart = chart_noise.noisy_chart(sensor, filters, told, 20_000, repeats=3, patch_px=23)
    assert chart.channels.shape == (3, 5, 144, 3) and chart.tile_px == 4
    np.testing.assert_allclose(chart.channels.mean(axis=(0, 2)), patch_e, atol=10)


def test_tiles_at_the_rim_of_a_patch_are_left_out_where_pixels_share_their_light():
    """Crosstalk of 0.4: a pixel keeps 0.6 and has a tenth of each of its four neighbours, all of its own patch."""
    sensor, filters = hr.load_sensor("reference-bayer"), ["red", "green", "blue"]
    patch_e = np.array([[900.0, 1300.0, 500.0], [5200.0, 3100.0, 7700.0], [40.0, 90.0, 60.0]])
    order = [sensor.layout.filters.index(name) for name in filters]
    given = np.empty_like(patch_e)
    given[:, order] = patch_e
    red, green, blue = patch_e.T
    expected = np.stack([0.6 * red + 0.4 * green, 0.6 * green + 0.2 * (red + blue), 0.6 * blue + 0.4 * green], axis=-1)
    for side, tiles, even in ((23, 100, True), (5, 1, True), (4, 4, False)):  # of 12 × 12, 3 × 3 and 2 × 2
        chart = chart_noise.noisy_chart(sensor, filters, given, 20_000, repeats=40, patch_px=side, crosstalk=0.4)
        assert chart.channels.shape == (40, 3, tiles, 3)
        off = np.abs(chart.channels.mean(axis=(0, 2)) / expected - 1)
        assert (off.max() < 0.05) == even

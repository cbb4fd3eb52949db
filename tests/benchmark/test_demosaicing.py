"""Full-colour truth and the demosaicing task: rendered light through every filter, against independent values."""

import json

import numpy as np
import pytest

from benchmarks import small
from hesim_render.benchmark import build_benchmark, evaluate_benchmark
from hesim_render.benchmark.pictures import ClipDevelopment, bilinear

BAYER = np.array([[0, 1], [1, 2]])


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A clip of a hybrid sensor, whose light is bright beside its noise, and the folder of its benchmark."""
    spec = small(
        scenes={"given": [{"scene": "colorchecker", "split": "test"}]}, sensors=[{"sensor": "gen2", "roi": "64x48"}],
        sharp={"times_us": [5000], "window_us": 500, "colours": True}, truth=[], audit=0, quality=1, duration_s=0.014,
    )  # fmt: skip
    built = build_benchmark(spec, tmp_path_factory.mktemp("colours") / "b", estimate=False)
    return next(built.clips()), built.root


def test_the_truth_is_the_light_of_each_pixel_through_its_own_filter(clip):
    """At the frame pixels the sensor's own flux is a second estimate, with other random numbers.

    The squares of the differences over the squares of both stated errors have the mean 1 for correct errors; over some
    2000 pixels, whose errors have one degree of freedom each, 0.7 to 1.4 holds with a false-alarm rate below 1e-6.
    """
    clip, _ = clip
    mosaic, colours = clip.recording.mosaic, clip.colours
    flux, stderr = colours.flux_e_per_s(0).astype(float), colours.stderr_e_per_s(0).astype(float)
    assert flux.shape == (48, 64, 3) and np.isfinite(flux).all() and set(colours.channels) == set(mosaic.channels)
    order = [colours.channels.index(name) for name in mosaic.channels]
    channel = mosaic.tiled(mosaic.tile_channel, (48, 64))
    row, col = np.nonzero(channel >= 0)
    own = (row, col, np.array(order)[channel[row, col]])
    seen, error = clip.sharp.flux_e_per_s(0)[row, col], clip.sharp.stderr_e_per_s(0)[row, col]
    off = flux[own] - seen
    spread = np.mean(off**2) / np.mean(stderr[own] ** 2 + error.astype(float) ** 2)
    assert np.sqrt(np.mean(off**2)) < 0.1 * seen.mean()
    assert 0.7 < spread < 1.4, spread
    # event pixels have a truth, though no frame value: that of the pixels around them, on this chart of large patches
    hole = channel < 0
    assert hole.sum() == 48 * 64 // 16
    others = [flux[np.roll(hole, 1, axis=0), k].mean() / flux[hole, k].mean() for k in range(3)]
    np.testing.assert_allclose(others, 1, atol=0.05)


def test_methods_are_scored_against_it(clip, tmp_path):
    clip, root = clip
    exposure, mosaic = clip.content["exposure_us"] or 10_000, clip.recording.mosaic
    order = [clip.colours.channels.index(name) for name in mosaic.channels]
    flux = clip.colours.flux_e_per_s(0)[..., order].astype(float)
    truth = mosaic.black_level_dn + mosaic.system_gain_dn_per_e * flux * exposure * 1e-6
    folder = tmp_path / "mine" / "demosaic" / clip.name
    folder.mkdir(parents=True)
    np.save(folder / "000000.npy", truth)
    found = evaluate_benchmark(root, tasks=["demosaic"], predictions=tmp_path / "mine")
    values = {score["method"]: score["values"] for score in json.loads(json.dumps(found["scores"]))}
    assert set(values) == {"guided", "bilinear", "prediction"}
    assert {(score["clip"], score["task"], score["item"]) for score in found["scores"]} == {(clip.name, "demosaic", 0)}
    # rounding of float64 alone separates the prediction from the truth
    assert values["prediction"]["delta_e"] < 1e-3 and values["guided"]["delta_e"] > 0.1
    assert values["guided"]["psnr_db"] > values["bilinear"]["psnr_db"] > 15
    # PSNR of the channels again, in NumPy
    raw = clip.sharp.raw_dn(0).astype(float)
    span = mosaic.white_level_dn - mosaic.black_level_dn
    error = np.mean(((bilinear(raw, mosaic.tile_channel) - truth) / span) ** 2)
    assert values["bilinear"]["channel_psnr_db"] == pytest.approx(-10 * np.log10(error), abs=1e-3)


def test_channels_are_developed_as_a_mosaic_of_them_is(clip):
    """An even picture is the same before and after demosaicing, clipped or not."""
    clip, _ = clip
    development, mosaic = ClipDevelopment(clip), clip.recording.mosaic
    for part in (0.2, 0.95):
        level = mosaic.black_level_dn + part * (mosaic.white_level_dn - mosaic.black_level_dn) * np.array([0.6, 1, 0.7])
        channel = mosaic.tiled(mosaic.tile_channel, (48, 64))
        raw = np.where(channel >= 0, level[channel], 0)
        np.testing.assert_allclose(
            development.linear(raw)[8:-8, 8:-8],
            development.linear_of_channels(np.broadcast_to(level, (48, 64, 3)))[8:-8, 8:-8],
            atol=2e-3,
        )
        np.testing.assert_allclose(
            development.demosaiced(raw)[8:-8, 8:-8], np.broadcast_to(level, (32, 48, 3)), rtol=5e-3
        )


def test_a_tent_reaches_over_one_tile_in_each_direction():
    """Of a tile of 3 × 4 px with a gap: each missing value by the weights (1 - |i|/3)(1 - |j|/4), summed by hand."""
    tile = np.array([[0, 1, 2, -1], [2, 0, 0, 1], [1, 2, -1, 0]])
    raw = np.random.default_rng(6).uniform(20, 900, (14, 19))
    found = bilinear(raw, tile)
    assert found.shape == (14, 19, 3)
    for row, col in ((0, 0), (7, 10), (8, 3), (13, 18), (5, 17)):
        for channel in range(3):
            weights, values = [], []
            for i in range(max(row - 2, 0), min(row + 3, 14)):
                for j in range(max(col - 3, 0), min(col + 4, 19)):
                    if tile[i % 3, j % 4] == channel:
                        weights.append((1 - abs(i - row) / 3) * (1 - abs(j - col) / 4))
                        values.append(raw[i, j])
            is_own = tile[row % 3, col % 4] == channel
            expected = raw[row, col] if is_own else np.average(values, weights=weights)
            assert found[row, col, channel] == pytest.approx(expected, rel=1e-12)


def test_bilinear_is_the_mean_of_the_nearest_samples():
    rng = np.random.default_rng(1)
    raw = rng.uniform(0, 100, (12, 12))
    found = bilinear(raw, BAYER)
    # at a red pixel: green of 4 sides, blue of 4 corners; at a green one in a red row: red of both sides
    assert found[4, 4, 0] == raw[4, 4]
    assert found[4, 4, 1] == pytest.approx((raw[3, 4] + raw[5, 4] + raw[4, 3] + raw[4, 5]) / 4)
    assert found[4, 4, 2] == pytest.approx((raw[3, 3] + raw[3, 5] + raw[5, 3] + raw[5, 5]) / 4)
    assert found[4, 5, 0] == pytest.approx((raw[4, 4] + raw[4, 6]) / 2)
    # a tile with a hole has a value there, between its neighbours
    tile = np.array([[0, 0, 1, 1], [0, -1, 1, 1], [1, 1, 2, 2], [1, 1, 2, 2]])
    even = bilinear(np.full((16, 16), 7.0), tile)
    np.testing.assert_allclose(even, 7.0)


def test_pictures_are_compared_at_the_brightness_of_the_wanted_one():
    """Grey whose 99.5 % point goes to 0.95, in the codes of sRGB; its few bright pixels end at 1 in both."""
    wanted, picture = np.full((40, 30, 3), 0.2, np.float32), np.full((40, 30, 3), 0.12, np.float32)
    wanted[3, :5], picture[3, :5] = 0.6, 0.3
    codes = [1.055 * (0.95 * part) ** (1 / 2.4) - 0.055 for part in (1, 0.6)]
    found = ClipDevelopment._compared(None, picture, wanted)
    error = (codes[0] - codes[1]) ** 2 * (1 - 5 / 1200)
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
    lightness = [116 * np.cbrt(0.95 * part) - 16 for part in (1, 0.6)]
    middle = sum(lightness) / 2
    weight = 1 + 0.015 * (middle - 50) ** 2 / np.sqrt(20 + (middle - 50) ** 2)
    assert found["delta_e"] == pytest.approx((lightness[0] - lightness[1]) / weight * (1 - 5 / 1200), rel=1e-3)
    assert 0 < found["ssim"] < 1
    narrow = (
        ClipDevelopment._compared(None, picture[:11], wanted[:11]),
        ClipDevelopment._compared(None, picture[:10], wanted[:10]),
    )
    assert "ssim" in narrow[0] and "ssim" not in narrow[1]
    black = ClipDevelopment._compared(None, picture, np.zeros_like(wanted))
    code = 1.055 * np.array([0.12, 0.3]) ** (1 / 2.4) - 0.055
    assert black["psnr_db"] == pytest.approx(-10 * np.log10(code**2 @ [1195 / 1200, 5 / 1200]), abs=1e-4)

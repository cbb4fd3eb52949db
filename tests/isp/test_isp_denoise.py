"""Noise reduction: what it knows of the noise against the simulator's frames, what it keeps, what it gains."""

from types import SimpleNamespace

import numpy as np
import pytest
from isp_images import BAYER, EIGER, MIPI, QUAD, images, mosaic_of
from scipy.stats import chi2

import hesim_render as hr
from hesim_render.core import bands
from hesim_render.core.errors import RangeError
from hesim_render.isp import FrameNoise, collaborate, frame_noise, rows
from hesim_render.isp import denoise as denoising
from hesim_render.isp.denoise import _each, denoise
from hesim_render.isp.rows import row_offsets
from hesim_render.isp.stabilise import Stabiliser, _padded_index

FIVE = ((0, 1, 0, 1, 2), (1, 2, 1, 0, 1), (0, 1, 2, 1, 0), (1, 0, 1, 2, 1), (2, 1, 0, 1, 0))
TILES = {"bayer": BAYER, "quad": QUAD, "mipi": MIPI, "eiger": EIGER, "five": FIVE, "mono": ((0,),)}


def noise_of(tile, a=0.64, b=0.16, **more):
    """Read noise and gain of `eiger`, the same at every position."""
    return FrameNoise(np.tile([a, b, 0, 0, 0, 0], (*np.shape(tile), 1)), 10_000.0, **more)


def noisy(signal, noise, seed=1):
    """Independent of the package: electrons of a Poisson law, Gaussian read noise, rounding."""
    rng = np.random.default_rng(seed)
    a, b = noise.beta[0, 0, :2]
    return np.rint(b * rng.poisson(signal / b) + rng.normal(0, np.sqrt(a), signal.shape)).astype(np.float32)


# -- the transform -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "c", "levels"),
    [
        (0.72, 0.16, 0.0, (0, 0.5, 3, 30, 900)),
        (0.1, 5.0, 0.0, (0.5, 5, 40, 500, 50_000)),  # single electrons are told apart
        (2.0, 0.0, 0.0, (0, 10, 200)),
        (0.72, 0.16, 3e-5, (0, 10, 900)),
    ],
)
def test_the_transform_evens_the_noise_and_comes_back_without_bias(a, b, c, levels):
    rng = np.random.default_rng(7)
    n = 200_000
    transform = Stabiliser(a, b, c, 60_000.0 if b > 1 else 959.0)
    for level in levels:
        rest = np.sqrt(a + c * level**2)
        samples = (b * rng.poisson(level / b, n) if b else level) + rng.normal(0, rest, n)
        stable = transform.forward(samples.astype(np.float32)[None])
        back = transform.backward(np.float32([[stable.mean(dtype=np.float64)]]))[0, 0]
        sigma = np.sqrt(a + b * level + c * level**2)
        # 17 levels, two-sided 4.5 sigma: false alarm 1e-4; the tables are good to 1e-3 sigma
        assert abs(back - level) < 4.5 * sigma / np.sqrt(n) + 1e-3 * sigma, level
        if level >= 6 * b or (level == 0 and b < 1):  # where a few electrons are told apart, no transform evens them
            assert stable.var() == pytest.approx(1, abs=0.08), level


def test_a_variance_is_a_thousandth_of_that_in_the_dark_at_least():
    """4 + 0.4 I − 0.05 I² ends at 13.8 DN; below 0 the noise is that of the dark."""
    transform = Stabiliser(4.0, 0.4, -0.05, 100.0)
    found = transform.sigma([-3.0, 0.0, 5.0, 13.0, 20.0, 100.0]) ** 2
    np.testing.assert_allclose(found, [4.0, 4.0, 4.75, 0.75, 4e-3, 4e-3])


def test_the_transform_is_monotonic_and_its_own_inverse_at_high_light():
    transform = Stabiliser(0.72, 0.16, 0.0, 959.0)
    signal = np.linspace(-5, 959, 4001, dtype=np.float32)[None]
    stable = transform.forward(signal)
    assert (np.diff(stable) > 0).all()
    # f(I) of a mean is what noise of mean I + 1/4 b gives on average, far above the read noise
    np.testing.assert_allclose(transform.backward(stable)[0, 500:], signal[0, 500:] + 0.04, atol=5e-3)


# -- what is known of the noise ----------------------------------------------------------------------------------


def test_variance_and_maps_are_those_of_the_simulators_frames():
    """64 frames of a flat field: each pixel's mean and variance against what the ISP takes for true."""
    sensor = hr.load_sensor("eiger", {"aps.dark_current_e_per_s": 20_000.0, "aps.prnu_rel": 0.02}).crop(96, 64)
    electrons, exposure_us, count = 1500.0, 20_000, 64
    frames = [sensor.aps.sample(electrons, exposure_us, 5, frame=k).astype(np.float32) for k in range(count)]
    noise = FrameNoise.of_sensor(sensor.spec, sensor.layout).at(exposure_us)
    assert noise.row_std_dn == 0 and noise.prnu_rel == 0
    black = sensor.spec.aps.black_level_dn
    corrected = np.array([noise.corrected(frame - np.float32(black)) for frame in frames], dtype=np.float64)
    signal_dn = electrons * sensor.spec.aps.system_gain_dn_per_e
    # the law at the light and dark counts of this pixel: PRNU and dark current are in the maps, their noise is not
    a, b, c = noise.variance((0, 0))
    expected = a + b * signal_dn + c * signal_dn**2
    z = (corrected.mean(axis=0) - signal_dn) / np.sqrt(expected / count)
    valid = sensor.layout.aps_mask
    n = valid.sum()
    assert abs(z[valid].mean()) < 4 / np.sqrt(n)  # false alarm 6e-5
    # a fixed pattern that stays would make the scatter of z larger: 4 sigma of the variance of n normals, and 3 % for
    # pixels of more or less dark current and response than the mean, whose noise differs
    assert abs(z[valid].var() - 1) < 4 * np.sqrt(2 / n) + 0.03
    pooled = corrected.var(axis=0, ddof=1)[valid].mean() / expected
    assert abs(pooled - 1) < 4 * np.sqrt(2 / (count - 1) / n) + 0.02


def test_terms_switched_off_are_not_looked_for():
    sensor = hr.load_sensor("eiger").crop(80, 48)
    everything = FrameNoise.of_sensor(sensor.spec, sensor.layout)
    no_rows = FrameNoise.of_sensor(sensor.spec, sensor.layout, frozenset({"row"}))
    assert everything.offset_dn.mean(axis=1).std() > 1 > 0.2 > no_rows.offset_dn.mean(axis=1).std()
    recording = hr.simulate_video(
        np.full((2, 48, 80), 128, np.uint8), sensor, fps=10, transfer="srgb", duration_s=0.06, clean=True, fit="pixel"
    )
    clean = FrameNoise.of_recording(recording.manifest)
    assert clean.is_clean and clean.describe()["clean"] and not everything.is_clean
    assert not np.any(clean.offset_dn) and not np.any(clean.dark_dn_per_s) and np.all(np.asarray(clean.response) == 1)


def test_temporal_row_noise_is_in_no_map():
    sensor = hr.load_sensor("eiger", {"aps.row_noise_dn": 1.5}).crop(80, 48)
    noise = FrameNoise.of_sensor(sensor.spec, sensor.layout)
    assert noise.unknown_rows_dn == 1.5 and noise.describe() == {"maps": "known", "row_std_dn": 1.5, "clean": False}
    unknown = FrameNoise.of_sensor(sensor.spec, sensor.layout, maps=False)
    assert unknown.unknown_rows_dn == pytest.approx(np.hypot(1.5, sensor.spec.aps.row_offset_std_dn))
    assert FrameNoise.of_sensor(sensor.spec, sensor.layout, frozenset({"row_noise"})).unknown_rows_dn == 0


@pytest.mark.parametrize("name", ["offset_dn", "dark_dn_per_s", "response"])
def test_one_map_is_a_known_one(name):
    assert noise_of(((0, 1),), **{name: np.full((4, 6), 1.5, np.float32)}).describe()["maps"] == "known"
    assert noise_of(((0, 1),)).describe()["maps"] == "none"


def test_without_maps_what_they_would_tell_counts_as_noise():
    sensor = hr.load_sensor("eiger").crop(80, 48)
    aps = sensor.spec.aps
    noise = FrameNoise.of_sensor(sensor.spec, sensor.layout, maps=False)
    assert noise.row_std_dn == aps.row_offset_std_dn and noise.describe()["maps"] == "unknown"
    known = FrameNoise.of_sensor(sensor.spec, sensor.layout).variance((0, 0))
    a, b, c = noise.variance((0, 0))
    assert a - known[0] == pytest.approx((aps.dsnu_e * aps.system_gain_dn_per_e) ** 2)
    assert b == known[1] and c == pytest.approx(aps.prnu_rel**2)
    with pytest.raises(RangeError, match="shape of the map offset_dn"):
        FrameNoise.of_sensor(sensor.spec, sensor.layout).corrected(np.zeros((8, 8), np.float32))
    with pytest.raises(RangeError, match="shape of beta"):
        FrameNoise(np.zeros((4, 4)), 1000.0)


# -- the filter --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TILES)
def test_flat_fields_keep_their_mean_and_lose_their_noise(name):
    """A flat colour of 2, 5 and 3 DN, where a pixel's noise is 1 DN."""
    tile = np.array(TILES[name])
    planes = np.broadcast_to(np.array([2.0, 5.0, 3.0])[: tile.max() + 1], (160, 200, tile.max() + 1))
    signal = mosaic_of(planes, tile)
    noise = noise_of(tile)
    found = denoise(noisy(signal, noise), tile, noise, 959.0, [1.0] * (tile.max() + 1))
    channel = tile[np.arange(160)[:, None] % tile.shape[0], np.arange(200) % tile.shape[1]]
    for c in range(tile.max() + 1):
        own = channel == c
        level = signal[own][0]
        sigma = np.sqrt(0.64 + 0.16 * level + 1 / 12)
        error = found[own] - level
        # the mean of n samples, 4 sigma: false alarm 6e-5 a channel; 2 % of sigma for what thresholds do
        assert abs(error.mean()) < 4 * sigma / np.sqrt(own.sum()) + 0.02 * sigma
        assert error.std() < sigma / 5


def test_noise_of_long_waves_is_reduced_too():
    """Means over 16×16 px, many patches of a pass: 0.088 DN before, 0.062 after the passes over patches alone."""
    signal = mosaic_of(4 + 3 * (np.arange(320) > 160)[None, :, None] + np.zeros((320, 320, 3)), EIGER)
    noise = noise_of(EIGER)
    valid = np.tile(np.array(EIGER) >= 0, (80, 80))
    found = denoise(np.where(valid, noisy(signal, noise), 0), EIGER, noise, 959.0, [2.0, 1.0, 1.5])
    error = np.where(valid, found - signal, 0).reshape(20, 16, 20, 16).sum(axis=(1, 3)) / (16 * 12)
    assert error.std() < 0.055


@pytest.mark.parametrize("name", ["bayer", "eiger"])
def test_edges_stay_and_pictures_gain(name):
    tile = np.array(TILES[name])
    picture = images()["natural"][:160, :192]
    planes = 40 * picture**2.2
    planes[:, 96:] = np.maximum(60 - planes[:, 96:], 0)
    signal = mosaic_of(planes, tile)
    noise = noise_of(tile)
    raw = noisy(signal, noise)
    found = denoise(raw, tile, noise, 959.0, [1.0, 1.0, 1.0])
    valid = np.broadcast_to(tile >= 0, (40, 48, *tile.shape)) if tile.shape == (4, 4) else None
    before, after = ((x - signal) ** 2 for x in (raw, found))
    if valid is not None:
        mask = valid.transpose(0, 2, 1, 3).reshape(160, 192)
        before, after = before[mask], after[mask]
    assert after.mean() < before.mean() / 2.5
    edge = slice(92, 100)
    step = lambda x: x[:, 100:104].mean() - x[:, 88:92].mean()  # noqa: E731
    assert step(found) == pytest.approx(step(signal), rel=0.03)
    assert ((found - signal)[:, edge] ** 2).mean() < ((raw - signal)[:, edge] ** 2).mean() / 1.5


def test_nothing_to_reduce_changes_next_to_nothing():
    """At a hundredth of the noise the picture is its own best estimate."""
    signal = 400 * mosaic_of(images()["natural"][:96, :128], QUAD).astype(np.float32)
    noise = noise_of(QUAD, 6.4e-5, 1.6e-5)
    found = denoise(signal, QUAD, noise, 959.0, [1.0, 1.0, 1.0])
    assert np.abs(found - signal).max() < 2  # rounding counts: 0.29 DN
    assert np.sqrt(np.mean((found - signal) ** 2)) < 0.2


def test_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    signal = 20 * mosaic_of(images()["natural"][:200, :160], EIGER)
    noise = noise_of(EIGER)
    raw = noisy(signal, noise)
    several = denoise(raw, EIGER, noise, 959.0, [2.0, 1.0, 1.5])
    monkeypatch.setattr(bands, "_WORKERS", 1)
    np.testing.assert_array_equal(denoise(raw, EIGER, noise, 959.0, [2.0, 1.0, 1.5]), several)


@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (9, 33), (31, 18)])
def test_any_size_gives_that_size(shape):
    noise = noise_of(EIGER)
    found = denoise(np.full(shape, 10, np.float32), EIGER, noise, 959.0, [2.0, 1.0, 1.5])
    assert found.shape == shape and np.isfinite(found).all()
    valid = np.array(EIGER)[np.arange(shape[0])[:, None] % 4, np.arange(shape[1]) % 4] >= 0
    np.testing.assert_allclose(found[valid], 10, atol=0.2)  # its noise is 1.5 DN


def test_saturated_samples_stay_and_positions_have_their_own_noise():
    signal = np.full((64, 64), 30.0)
    signal[20:30, 20:40] = 959
    noise = noise_of(QUAD)
    noise.beta[1, 1, 0] = 25.0  # one position reads much more noisily
    raw = noisy(signal, noise_of(QUAD))
    raw[20:30, 20:40] = 959
    rng = np.random.default_rng(3)
    raw[1::4, 1::4] = np.where(raw[1::4, 1::4] < 900, 30 + rng.normal(0, np.sqrt(25 + 4.8), (16, 16)), 959)
    found = denoise(raw, QUAD, noise, 959.0, [1.0, 1.0, 1.0])
    assert (found[20:30, 20:40] == 959).all()
    bad = found[1::4, 1::4][found[1::4, 1::4] < 900]
    assert np.abs(bad - 30).mean() < 1.5 < np.abs(raw[1::4, 1::4][raw[1::4, 1::4] < 900] - 30).mean()


def test_a_patch_of_the_first_pass_is_shrunk_by_the_spread_of_its_group():
    """Moments of each group written out; a mean counts above 2.7 of its own deviations, 1/4 of that of a patch."""
    rng = np.random.default_rng(6)
    noisy = rng.normal([0, 0.4, 0.8, 1, 2, 5], 1.6, (2, 20, 6)).astype(np.float32)
    alike, flat = rng.integers(0, 40, (5, 16)), noisy.reshape(40, 6).astype(np.float64)
    found, weights = collaborate._estimate(noisy, None, alike, 3)
    for number, members in enumerate(alike):
        mean, spread = flat[members].mean(axis=0), flat[members].var(axis=0, ddof=1)
        kept, share = np.abs(mean) > 2.7 / 4, np.maximum(spread - 1, 0) / spread
        expected = kept * mean + share * (flat[3 + number] - mean)
        np.testing.assert_allclose(found[number], expected, rtol=1e-4, atol=1e-5)
        assert weights[number] == pytest.approx(1 / (1 + (share**2).sum() + kept.sum() / 16), rel=1e-4)


def test_each_position_of_a_tile_that_is_not_square_has_its_own_transform():
    laws = {(row, col): Stabiliser(0.5 + row, 0.1 + 0.2 * col, 0.0, 900.0) for row in range(2) for col in range(3)}
    image = np.random.default_rng(4).uniform(0, 800, (7, 11)).astype(np.float32)
    found = _each(image, (2, 3), laws, Stabiliser.forward)
    for row, col in np.ndindex(image.shape):
        assert found[row, col] == laws[row % 2, col % 3].forward(image[row : row + 1, col : col + 1])[0, 0]


# -- rows --------------------------------------------------------------------------------------------------------


def test_row_offsets_are_found_in_a_picture():
    """Offsets of 1.5 DN under shot and read noise, in a picture with edges: a third of them is left."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:256, :768]
    discs = sum((np.hypot(y - 80 * k % 256, x - 130 * k) < 40 + 9 * k) * (0.3 + 0.1 * k) for k in range(6))
    planes = 30 * (images()["natural"][:256] ** 2.2 + discs[..., None] * [1.0, 0.5, 0.2])
    noise = noise_of(EIGER)
    offsets = rng.normal(0, 1.5, 256)
    raw = noisy(mosaic_of(planes, EIGER), noise) + offsets[:, None].astype(np.float32)
    found = row_offsets(raw, EIGER, noise, 1.5)
    assert np.std(found - offsets) < 0.5 < 1.3 < offsets.std()
    np.testing.assert_array_equal(row_offsets(raw, EIGER, noise, 0.0), 0)


def test_rows_that_show_picture_are_left_alone():
    """A horizon across the whole frame, much higher than row noise, is no offset; nor is a slope."""
    noise = noise_of(BAYER)
    scene = np.where(np.arange(128) < 64, 10.0, 60.0)[:, None] + np.zeros((1, 256))
    found = row_offsets(noisy(scene, noise), BAYER, noise, 1.4)
    assert np.abs(found).max() < 0.5
    slope = np.linspace(10, 200, 128)[:, None] + np.zeros((1, 256))
    assert np.abs(row_offsets(noisy(slope, noise), BAYER, noise, 1.0)).max() < 0.6


@pytest.mark.parametrize("row_std", [0.4, 2.5])
def test_row_offsets_solve_their_normal_equations(row_std):
    """Without noise or picture the differences are exact: the banded solution against a dense one.

    Twelve columns: the noise of a row's mean is as large as its offset, so that the prior counts.
    """
    rng = np.random.default_rng(4)
    offsets = rng.normal(0, row_std, 40)
    flat = (50 + offsets[:, None] + np.zeros((1, 12))).astype(np.float32)
    noise = noise_of(((0,),))
    found = row_offsets(flat, [[0]], noise, row_std)
    sigma2 = (0.64 + 1 / 12 + 0.16 * 50) * 1.5 / 12
    difference = np.zeros((38, 40))
    difference[np.arange(38), np.arange(38)] = difference[np.arange(38), np.arange(2, 40)] = -0.5
    difference[np.arange(38), np.arange(1, 39)] = 1
    dense = np.linalg.solve(
        difference.T @ difference / sigma2 + np.eye(40) / row_std**2, difference.T @ (difference @ offsets) / sigma2
    )
    # the noise of each row is that at its own level
    np.testing.assert_allclose(found, dense, atol=0.03 * row_std)
    assert np.abs(dense - offsets).max() > 0.1 * row_std


def test_an_offset_counts_up_to_four_deviations_of_what_is_likely():
    """A line that differs from its neighbours by more is picture; the deviation is that of rows, squared, and noise.

    Beyond it the line's own comparison does not count; beyond twice as much, nor do those of its neighbours.
    """
    noise, row_std = noise_of(((0,),)), 3.0
    limit = 4 * np.sqrt(1.5 * (row_std**2 + (0.64 + 1 / 12 + 0.16 * 50) / 96))
    for factor, share in ((0.998, 0.818), (1.002, 0.658), (1.96, 0.656), (2.04, 0.0)):
        flat = np.full((31, 96), 50.0, np.float32)
        flat[15] += factor * limit
        found = row_offsets(flat, [[0]], noise, row_std)
        assert found[15] / (factor * limit) == pytest.approx(share, abs=0.01)


def test_picture_in_a_row_counts_as_alike_over_eight_pixels():
    """Samples of a position lie two pixels apart in a tile of three rows and two columns: four of them are one."""
    tile, noise, size = np.array([[0, 1], [2, 2], [3, 4]]), noise_of(np.zeros((3, 2), int)), 60
    flat = np.full((15, 2 * size), 50.0, np.float32)
    flat[6, ::4] += 7
    flat[6, 2::4] -= 7
    (found,) = rows._compared(flat, tile, (0, 0), noise, 3.0)
    sigma2 = (0.64 + 1 / 12 + 0.16 * 50) * 1.5
    assert found.rows.tolist() == [3, 6, 9] and found.mean[1] == pytest.approx(0, abs=1e-6)
    assert found.variance[1] == pytest.approx((sigma2 + 4 * (49 - sigma2)) / size, rel=1e-5)


def test_scatter_of_what_is_left_is_what_the_noise_makes():
    """On a flat field the error of a row's offset is that of means of samples: chi-square over rows, both sides."""
    noise = noise_of(((0,),))
    raw = noisy(np.full((400, 512), 20.0), noise, seed=9)
    found = row_offsets(raw, [[0]], noise, 1.4)
    # a row against the mean of its two neighbours: the second difference of what was found
    second = found[1:-1] - (found[2:] + found[:-2]) / 2
    sigma2 = (0.64 + 1 / 12 + 0.16 * 20) * 1.5 / 512
    score = (second[::3] ** 2).sum() / sigma2
    # shrunk by the prior a little; false alarm 1e-4 and 5 % for the robust mean, which is less efficient
    assert chi2.ppf(1e-4, second[::3].size) * 0.8 < score < chi2.ppf(1 - 1e-4, second[::3].size) * 1.05


def test_noise_times_a_factor_has_that_factor_in_every_standard_deviation():
    beta = np.array([[[0.64, 0.16, 3.0, 2e-4, 0.7, 11.0]]])
    noise = FrameNoise(beta, 20_000.0, residual_dn2=1.3, prnu_rel=0.02)
    once, more = (each.variance((0, 0)) for each in (noise, noise.times(2.5)))
    rounding = 1 / 12
    assert more[0] - rounding == pytest.approx(6.25 * (once[0] - rounding), rel=1e-12)
    assert once[0] == pytest.approx(0.64 + 3.0 * 0.02 + 11.0 * 0.02**2 + 1.3 + rounding, rel=1e-12)
    np.testing.assert_allclose(more[1:], 6.25 * np.array(once[1:]), rtol=1e-12)


def test_patches_that_begin_within_a_block_have_the_colours_of_their_own_places(monkeypatch):
    """A block of 5 by 7 samples: the second patches begin at its row 2 and column 3; a mean of both is weighted."""
    block = np.random.default_rng(2).integers(-1, 3, (5, 7))
    stable = np.arange(15 * 21, dtype=np.float32).reshape(15, 21)
    monkeypatch.setattr(denoising, "block_of", lambda tile: block)
    begins = []

    def blocks(image, turned, amplitude):
        row, col = divmod(int(image[0, 0]), 21)
        begins.append((row, col))
        for i, j in np.ndindex(block.shape):
            assert turned[i, j] == block[(i + row) % 5, (j + col) % 7]
        return SimpleNamespace(values=len(begins))

    def one_pass(given, known):
        assert known is None
        weight = np.float32([0.5, 1.5][given.values - 1])
        return np.full((2, 3, 4), 10 * given.values * weight), np.full((2, 3), weight)

    monkeypatch.setattr(denoising, "_blocks", blocks)
    monkeypatch.setattr(denoising.collaborate, "one_pass", one_pass)
    monkeypatch.setattr(denoising, "_image", lambda values, turned, shape: np.full(shape, values[0, 0, 0]))
    found = denoising._over_phases(stable, None, None, None)
    assert begins == [(0, 0), (2, 3)]
    expected = np.full((15, 21), 10.0)
    expected[2:, 3:] = (5 + 30) / 2
    np.testing.assert_allclose(found, expected)


def test_means_of_blocks_are_samples_a_block_apart(monkeypatch):
    """Blocks of 6 by 4 px: 2 × 2 of their means are a block of samples, whose places are those of the picture."""
    seen = []

    def one_pass(blocks, known):
        seen.append((blocks, known))
        return 3.0 * blocks.values, np.full(blocks.values.shape[:2], 1.5, np.float32)

    monkeypatch.setattr(denoising.collaborate, "one_pass", one_pass)
    means = np.random.default_rng(1).normal(size=(2, 8, 10)).astype(np.float32)
    found = denoising._reduced_means(means, (6, 4), np.array([5.0, 9.0]))
    blocks, known = seen[0]
    np.testing.assert_array_equal(blocks.at, [[0, 0], [0, 4], [6, 0], [6, 4]] * 2)
    assert blocks.size == (12, 8) and known is None and len(seen) == 2
    assert blocks.channel.tolist() == [0] * 4 + [1] * 4 and blocks.amplitude.tolist() == [5.0] * 4 + [9.0] * 4
    np.testing.assert_allclose(seen[1][1], 2 * blocks.values, rtol=1e-6)
    np.testing.assert_allclose(found, 2 * means, rtol=1e-6)


@pytest.mark.parametrize(("size", "period"), [(12, 4), (13, 4), (15, 5), (7, 5), (3, 5), (1, 4), (4, 4)])
def test_borders_of_a_line_repeat_its_outermost_whole_blocks(size, period):
    """A line shorter than a block is repeated by itself."""
    expected = []
    for number in range(-period, -(-size // period) * period + period):
        place = number + period if number < 0 else number
        while place >= size:
            place -= period
        expected.append(place if place >= 0 else (number + period) % min(size, period))
    assert _padded_index(size, period).tolist() == expected


@pytest.mark.parametrize(("rows", "expected"), [({"value": 0.6}, 0.6), ({"value": None}, 0.0), (None, 0.0)])
def test_a_calibration_gives_its_polynomial_its_rows_and_its_maps(rows, expected, monkeypatch, tmp_path):
    """What a calibration could not measure counts as none."""
    beta = [[[0.4, None, 7.0, 0.002, None, 3.0]], [[0.9, 0.31, None, None, 0.5, None]]]
    maps = {"n_row": np.array([0.5, -0.7]), "n_blc": np.array([[3.0, 1.0], [4.0, -2.0]]), "n_dp": np.full((2, 2), 6.0)}
    section = {"beta": beta} | ({} if rows is None else {"row_noise_dn": rows})
    monkeypatch.setattr(frame_noise, "read_calibration", lambda path: {"aps": section})
    monkeypatch.setattr(frame_noise, "read_maps", lambda path, kind, data, names: {name: maps[name] for name in names})
    noise = FrameNoise.of_calibration(tmp_path / "calibration.yaml", 25_000)
    assert noise.row_noise_dn == expected and noise.row_std_dn == 0
    np.testing.assert_array_equal(noise.offset_dn, np.array([[3.5, 1.5], [3.3, -2.7]], np.float32))
    # a + b I + c I² at 25 ms, rounding included
    assert noise.variance((0, 0)) == pytest.approx((0.4 + 7 * 0.025 + 3 * 0.025**2 + 1 / 12, 0.0, 0.002))
    assert noise.variance((1, 0)) == pytest.approx((0.9 + 1 / 12, 0.31 + 0.5 * 0.025, 0.0))
    corrected = noise.corrected(np.full((2, 2), 50.0, np.float32))
    np.testing.assert_allclose(corrected, 50 - noise.offset_dn - 6 * 0.025, rtol=1e-6)

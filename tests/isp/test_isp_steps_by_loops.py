"""Parts of demosaicing and noise reduction against loops over patches, cells and priors."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hesim_render.isp import collaborate, guide
from hesim_render.isp.collaborate import SampleBlocks
from hesim_render.isp.kriging import Prior


@pytest.mark.parametrize("inside", [slice(0, 3), slice(5, 9), slice(2, 4)])
def test_the_patches_that_are_alike_are_the_nearest_within_four_blocks(inside):
    features = np.random.default_rng(1).standard_normal((9, 13, 5)).astype(np.float32)
    found = collaborate._alike(features, inside)
    assert found.shape == ((inside.stop - inside.start) * 13, 16)
    for k, (row, col) in enumerate(np.ndindex(inside.stop - inside.start, 13)):
        row += inside.start
        near = [
            (np.sum((features[row, col] - features[r, c]) ** 2), r * 13 + c)
            for r in range(max(row - 4, 0), min(row + 5, 9))
            for c in range(max(col - 4, 0), min(col + 5, 13))
        ]
        assert sorted(found[k]) == sorted(place for _, place in sorted(near)[:16])
        assert row * 13 + col in found[k]
    # small pictures have fewer members than 16
    assert collaborate._alike(features[:2, :3], slice(0, 2)).shape == (6, 6)


def test_patches_are_four_blocks_and_faint_details_are_not_compared():
    values = np.random.default_rng(2).standard_normal((6, 7, 3)).astype(np.float32)
    basis = np.linalg.qr(np.random.default_rng(3).standard_normal((12, 12)))[0].astype(np.float32)
    found = collaborate._coefficients(values, basis, slice(1, 4))
    for row, col in np.ndindex(3, 6):
        patch = [values[row + 1 + i, col + j] for i in range(2) for j in range(2)]
        np.testing.assert_allclose(found[row, col], np.concatenate(patch) @ basis, rtol=1e-4, atol=1e-5)
    many = np.tile(found, 2)[..., :20]
    np.testing.assert_array_equal(collaborate._features(many, False), many[..., :16])
    compared = collaborate._features(many, True)
    np.testing.assert_array_equal(compared[..., 0], many[..., 0])
    np.testing.assert_array_equal(compared[..., 1:], np.where(np.abs(many[..., 1:16]) < 1.5, 0, many[..., 1:16]))


@pytest.mark.parametrize("is_second", [False, True])
def test_estimates_of_a_patch_are_those_of_its_group(is_second):
    """First pass: means above 2.7 of their errors, and the rest shrunk by the spread beyond noise; second: Wiener."""
    rng = np.random.default_rng(4)
    noisy = (2 * rng.standard_normal((5, 8, 6))).astype(np.float32)
    clean = (2 * rng.standard_normal((5, 8, 6))).astype(np.float32) if is_second else None
    alike = rng.integers(0, 40, (9, 7))
    out, weights = collaborate._estimate(noisy, clean, alike, 11)
    flat = noisy.reshape(40, 6).astype(float)
    for k in range(9):
        group, own = flat[alike[k]], flat[11 + k]
        mean = group.mean(axis=0)
        if is_second:
            pilot = clean.reshape(40, 6).astype(float)
            picture, spread = pilot[alike[k]].mean(axis=0), pilot[alike[k]].var(axis=0)
            signal = spread + 0.5 * ((pilot[11 + k] - picture) ** 2 - spread)
            of_mean, of_rest = picture**2 / (picture**2 + 1 / 7), signal / (signal + 1)
        else:
            spread = group.var(axis=0, ddof=1)
            of_mean = (np.abs(mean) > 2.7 / np.sqrt(7)).astype(float)
            of_rest = np.maximum(spread - 1, 0) / np.maximum(spread, 1e-6)
        np.testing.assert_allclose(out[k], of_mean * mean + of_rest * (own - mean), rtol=1e-3, atol=1e-4)
        left = np.sum(of_rest**2) + np.sum(of_mean**2) / 7
        assert weights[k] == pytest.approx(1 / (1 + left), rel=1e-3)


def test_a_pass_puts_weighted_patches_back_where_they_were(monkeypatch):
    """Patches that keep their coefficients, each with a weight of its own, give the blocks back times the weights."""
    rng = np.random.default_rng(5)
    values = rng.standard_normal((40, 9, 3)).astype(np.float32)
    blocks = SampleBlocks(values, np.array([[0.0, 0], [0, 1], [1, 0]]), (2, 2), np.array([0, 1, 1]), np.ones(3))
    weight = rng.uniform(0.5, 2, (39, 8)).astype(np.float32)

    def keep(noisy, clean, alike, first):
        flat = noisy.reshape(-1, noisy.shape[2])
        own = flat[first : first + len(alike)]
        # the patch's own place in the picture, from its first coefficients
        place = [int(np.argmin(np.abs(every - one).sum(axis=1))) for one in own]
        return own.copy(), weight.ravel()[place].copy()

    every = collaborate._coefficients(values, blocks.basis(), slice(0, 39)).reshape(-1, 12)
    monkeypatch.setattr(collaborate, "_estimate", keep)
    total, shares = collaborate.one_pass(blocks)
    wanted = np.zeros((40, 9))
    for i, j in np.ndindex(2, 2):
        wanted[i : i + 39, j : j + 8] += weight
    np.testing.assert_allclose(shares, wanted, rtol=1e-4)
    np.testing.assert_allclose(total, wanted[..., None] * values, rtol=1e-3, atol=1e-3)


def test_axes_of_a_patch_are_those_of_its_covariance():
    """exp(−d/24 px), and 0.06 of it more where the colours agree; amplitudes scale rows and columns."""
    at, channel = np.array([[0.0, 0], [0, 1], [1, 2]]), np.array([0, 1, 0])
    amplitude = np.array([1.0, 2.0, 0.5])
    blocks = SampleBlocks(None, at, (2, 3), channel, amplitude)
    places = np.concatenate([np.add(at, (2 * i, 3 * j)) for i in range(2) for j in range(2)])
    same = np.tile(channel, 4)[:, None] == np.tile(channel, 4)
    far = np.linalg.norm(places[:, None] - places[None], axis=2)
    covariance = np.exp(-far / 24) * (1 + 0.06 * same) * np.outer(np.tile(amplitude, 4), np.tile(amplitude, 4))
    basis = blocks.basis().astype(float)
    along = basis.T @ covariance @ basis
    np.testing.assert_allclose(along, np.diag(np.diag(along)), atol=2e-5)
    assert np.all(np.diff(np.diag(along)) < 1e-6)


def test_priors_have_their_covariances():
    dy, dx, same = np.array([0.0, 1.5, -2.0]), np.array([0.0, -0.7, 3.0]), np.array([True, False, True])
    far = np.hypot(dy, dx)
    usual = np.exp(-far / 24)
    np.testing.assert_allclose(Prior(0.3).covariance(dy, dx, same), usual * (1 + 0.3 * same))
    smooth = (1 + far / 1.5) * np.exp(-far / 1.5)
    np.testing.assert_allclose(Prior(0.3, smooth=True).covariance(dy, dx, same), smooth + 0.3 * usual * same)
    along, across = dx * np.cos(0.4) + dy * np.sin(0.4), dy * np.cos(0.4) - dx * np.sin(0.4)
    turned = np.exp(-np.hypot(along / 6, across) * np.sqrt(6) / 24)
    np.testing.assert_allclose(Prior(0.3, angle=0.4).covariance(dy, dx, same), turned + 0.3 * usual * same)
    assert not Prior(grey=True).distinguished(np.array([0, 2, 1])).any()
    assert Prior().distinguished(np.array([0, 2, 1])).tolist() == [0, 2, 1]


def test_residuals_are_averaged_over_cells_and_their_neighbours():
    """Two by three cells in a block, wrapped into the neighbouring blocks; weights 1, 2, 1 in both directions."""
    rng = np.random.default_rng(6)
    cells = [(0, 0), (0, 1), (1, 2), (1, 2), (1, 0), (0, 2), (1, 1)]
    counts = np.zeros((2, 3), np.float32)
    for cell in cells:
        counts[cell] += 1
    residual = rng.standard_normal((4, 7, 6, 5)).astype(np.float32)
    found = guide._energy(residual.copy(), cells, counts)
    sums, number = np.zeros((4, 12, 15)), np.zeros((12, 15))
    for k, (i, j) in enumerate(cells):
        sums[:, i::2, j::3] += residual[:, k].astype(float) ** 2
        number[i::2, j::3] += 1
    kernel = np.outer([1, 2, 1], [1, 2, 1])
    for i, j, row, col in np.ndindex(2, 3, 4, 3):
        at, beside = 2 * (row + 1) + i, 3 * (col + 1) + j
        around = np.s_[at - 1 : at + 2, beside - 1 : beside + 2]
        wanted = (kernel * sums[(slice(None), *around)]).sum(axis=(1, 2)) / (kernel * number[around]).sum() + 5e-5
        np.testing.assert_allclose(found[i, j, :, row, col], wanted, rtol=1e-4)


def test_priors_are_weighted_by_the_eighth_power_of_their_residuals():
    energy = np.array([1.0, 2.0, 1.1, 5.0], np.float32)[None, None, :, None, None] * np.array([1.0, 3.0], np.float32)
    found = guide._shares(energy.copy())[0, 0, :, 0]
    wanted = np.array([1.0, 2.0, 1.1, 5.0]) ** -8.0
    np.testing.assert_allclose(found, np.tile((wanted / wanted.sum())[:, None], 2), rtol=1e-4)


def test_strong_colours_and_greys_are_handicapped_by_what_is_around():
    """Colourfulness: standard deviation of the channels' means, 0.03 and less is grey, 0.1 and more coloured."""
    factor = guide._handicap(np.array([[0.0, 0.25, 1.0]], np.float32))
    assert factor.shape == (len(guide.PRIORS), 1, 3)
    np.testing.assert_allclose(factor[0], 1)
    np.testing.assert_allclose(factor[1:11], 1.3)
    np.testing.assert_allclose(factor[11:16, 0], np.tile([2.5, 2.5 - 0.25 * 1.4, 1.1], (5, 1)), rtol=1e-6)
    np.testing.assert_allclose(factor[16:, 0], np.tile([1.5, 1.5 + 0.25 * 2.5, 4.0], (4, 1)), rtol=1e-6)
    rng = np.random.default_rng(7)
    block = np.array([[0, 1, -1], [2, 0, 1]])
    planes = (0.5 + 0.1 * rng.standard_normal((6, 9, 8))).astype(np.float32)
    inner = planes[:, 1:-1, 1:-1].astype(float)
    means = [(inner[0] + inner[4]) / 2, (inner[1] + inner[5]) / 2, inner[3]]
    spread = np.std([gaussian_filter(mean, 1.4, mode="nearest") for mean in means], axis=0)
    np.testing.assert_allclose(
        guide._saturation(planes, block), np.clip((spread - 0.03) / 0.07, 0, 1), rtol=1e-3, atol=1e-5
    )

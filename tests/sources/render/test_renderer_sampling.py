"""The sampler's and the wavelengths' laws: permutation, strata, uniformity, distribution."""

import drjit as dr
import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.sampling.sampler import (
    permute,
    sampler_class,
    surface_points,
    third_coordinates,
    zero_two_point,
)
from hesim_render.sources.render.sampling.wavelengths import WavelengthSampler
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.spectral.spectrum import Spectrum


def started(pixels, per_half, seed=11):
    """A sampler of all pixels, halves and samples, in this order."""
    mi = mitsuba()
    index = np.indices((pixels, 2, per_half)).reshape(3, -1).astype(np.uint32)
    sampler = sampler_class(mi.variant())()
    sampler.setup(from_host(mi.UInt64, seed), *(from_host(mi.UInt32, i) for i in index), per_half)
    return sampler


def draws(pixels, per_half, dimensions, seed=11):
    """Pairs [pixel, half, sample, dimension, 2]."""
    sampler = started(pixels, per_half, seed)
    pairs = [np.array(sampler.next_2d()).T for _ in range(dimensions)]
    return np.stack(pairs, axis=1).reshape(pixels, 2, per_half, dimensions, 2)


@pytest.mark.parametrize("bits", [1, 3, 6, 10])
def test_permute_is_a_bijection(bits):
    types = jit()
    size = 1 << bits
    for key in (0, 1, 0xDEADBEEF, 0xFFFFFFFF):
        result = np.array(permute(dr.arange(types.UInt32, size), size - 1, dr.full(types.UInt32, key, size)))
        np.testing.assert_array_equal(np.sort(result), np.arange(size))


def test_points_fill_every_elementary_interval():
    types = jit()
    x, y = (np.array(v, dtype=np.float64) / 2**32 for v in zero_two_point(dr.arange(types.UInt32, 16)))
    for split in range(5):
        cells = np.floor(x * 2**split) * 2 ** (4 - split) + np.floor(y * 2 ** (4 - split))
        np.testing.assert_array_equal(np.sort(cells), np.arange(16))


def test_points_are_those_of_sobol():
    """SciPy's table of direction numbers is the oracle; it goes through the points in Gray-code order."""
    types = jit()
    count = 4096
    place = np.arange(count) ^ (np.arange(count) >> 1)
    expected = np.empty((count, 3))
    expected[place] = stats.qmc.Sobol(3, scramble=False, bits=32).random(count)
    pair = [np.array(v, dtype=np.float64) / 2**32 for v in zero_two_point(dr.arange(types.UInt32, count))]
    np.testing.assert_array_equal(np.stack([*pair, third_coordinates(0, 12) / 2**32], axis=1), expected)
    np.testing.assert_array_equal(third_coordinates(11, 1), third_coordinates(0, 12)[[0, 2048]])


def held(points, splits):
    """Smallest and largest number of points of a half in boxes of 2^-split; points [half, n, axis]."""
    cell = np.zeros(points.shape[:2])
    for axis, split in enumerate(splits):
        cell = cell * 2**split + np.floor(points[..., axis] * 2**split)
    counts = [np.bincount(each.astype(np.int64), minlength=2 ** sum(splits)) for each in cell]
    return np.min(counts), np.max(counts)


@pytest.mark.parametrize("bits", range(5, 12))
def test_place_and_direction_fill_all_boxes(bits):
    """A net of t = 2, or of 3 for 1024 points, in four dimensions; numbers beyond the table keep their order."""
    types, count, t = jit(), 1 << bits, 3 if bits == 10 else 2
    numbers = np.arange(count, dtype=np.uint32), surface_points()[:count]
    np.testing.assert_array_equal(np.sort(numbers[1]), numbers[0])
    pairs = [
        np.array(v, dtype=np.float64) / 2**32 for each in numbers for v in zero_two_point(from_host(types.UInt32, each))
    ]
    points = np.stack(pairs, axis=1)[None]
    total, splits = bits - t, range(bits - t + 1)
    for i, j, k in ((i, j, k) for i in splits for j in splits for k in splits if i + j + k <= total):
        assert held(points, [i, j, k, total - i - j - k]) == (1 << t, 1 << t)
    assert all(held(points[..., 2:], [i, bits - i]) == (1, 1) for i in range(bits + 1))


@pytest.mark.parametrize("per_half", [64, 4096])
def test_place_and_instant_are_stratified_together(per_half):
    pair, third = started(20, per_half).start_3d()
    points = np.stack([*np.array(pair), np.array(third)], axis=1).reshape(40, per_half, 3)
    for axis in range(3):
        cells = np.sort(np.floor(points[..., axis] * per_half), axis=1)
        np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(per_half), cells.shape))
    # Sobol's first three coordinates are a net of t = 1 (Sobol 1967): any box of volume 2/n holds two points
    bits = per_half.bit_length() - 2
    for i in range(bits + 1):
        for j in range(bits - i + 1):
            assert held(points, [i, j, bits - i - j]) == (2, 2)


@pytest.mark.parametrize("per_half", [256, 4096])
def test_lamps_are_stratified_with_the_place(per_half):
    """Each lamp by itself, with shifts of its own; the wavelength between them is drawn apart."""
    sampler, bits = started(5, per_half), per_half.bit_length() - 1
    place, _ = sampler.start_3d()
    wavelength, lamp, other = sampler.next_1d(), sampler.surface_2d(), sampler.surface_2d()
    points = np.stack([*np.array(place), *np.array(lamp), *np.array(other), np.array(wavelength)], axis=1)
    points = points.reshape(10, per_half, 7)
    for axes in ([0, 1, 2, 3], [0, 1, 4, 5]):
        # of 4096 points only the first 2048 are ordered together
        least, most = held(points[..., axes], [2, 1, 1, bits - 6 - (per_half == 4096)])
        assert least == most or (per_half == 4096 and least >= most / 2)
        for axis in axes[2:]:
            cells = np.sort(np.floor(points[..., axis] * per_half), axis=1)
            np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(per_half), cells.shape))
    assert held(points[..., [0, 6]], [2, bits - 4])[0] < 4
    assert not np.array_equal(points[..., 2:4], points[..., 4:6])


def test_a_penumbra_costs_fewer_rays_with_the_lamp_among_the_coordinates():
    """RMS error of the mean of a step in place and the point on a lamp, against the same with the lamp drawn apart."""
    per_half, pixels = 512, 1000
    sampler = started(pixels, per_half)
    place, _ = sampler.start_3d()
    lamps = sampler.surface_2d(), sampler.next_2d()
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(pixels, 1, 1, 4))
    normal /= np.linalg.norm(normal, axis=3, keepdims=True)
    edge, errors = rng.uniform(-0.4, 0.4, (pixels, 1, 1)), []
    for lamp in lamps:
        points = np.concatenate([np.array(place), np.array(lamp)]).T.reshape(pixels, 2, per_half, 4) - 0.5
        means = (np.sum(points * normal, axis=3) > edge).mean(axis=2)
        errors.append(np.sqrt(np.mean((means[:, 0] - means[:, 1]) ** 2)))
    assert errors[0] < 0.7 * errors[1]


def test_a_moving_edge_costs_fewer_rays_with_the_instant_among_the_coordinates():
    """RMS error of the mean of a step in x + v t, against the same with the instant drawn apart.

    A simulation in numpy with SciPy's points gave 0.38 and 0.60 of independent rays for 128 points and v = 1.
    """
    per_half, pixels = 128, 2000
    sampler = started(pixels, per_half)
    (x, y), t = sampler.start_3d()
    apart = sampler.next_1d()
    rng = np.random.default_rng(3)
    angle, edge = rng.uniform(0, 2 * np.pi, (pixels, 1, 1)), rng.uniform(-1, 1, (pixels, 1, 1))
    gains = []
    for instant in (t, apart):
        u, v, w = (np.array(a, dtype=float).reshape(pixels, 2, per_half) - 0.5 for a in (x, y, instant))
        means = (u * np.cos(angle) + v * np.sin(angle) + w > edge).mean(axis=2)
        share = means.mean(axis=1)
        gains.append(np.sqrt(np.mean((means[:, 0] - means[:, 1]) ** 2) / 2 / np.mean(share * (1 - share) / per_half)))
    assert gains[0] < 0.45 and gains[1] > 0.5


def test_draws_of_a_vertex():
    """Place and lobe are a net; each coordinate of the light is stratified; the luck is drawn apart.

    Shifts of place and light belong to a half and differ between halves: their joint law over 20,000 halves is even
    (χ², 16 × 16 cells, false alarm 1e-4 for each of four pairs).
    """
    per_half, pixels = 64, 10_000
    place, lobe, light, luck = started(pixels, per_half).next_vertex(jit().Bool(False))
    columns = np.stack([*np.array(place), np.array(lobe), *np.array(light), np.array(luck)], axis=1)
    points = columns.reshape(2 * pixels, per_half, 6)
    assert points.min() > 0 and points.max() < 1
    for axis in range(6):
        cells = np.sort(np.floor(points[..., axis] * per_half), axis=1)
        np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(per_half), cells.shape))
    for i, j, k in ((5, 0, 0), (2, 2, 1), (1, 1, 3), (0, 4, 1)):  # boxes of volume 2/n hold two points
        x, y, z = np.moveaxis(np.floor(points[..., :3] * 2.0 ** np.array([i, j, k])), -1, 0)
        cell = np.sort((x * 2**j + y) * 2**k + z, axis=1)
        np.testing.assert_array_equal(cell, np.broadcast_to(np.arange(per_half) // 2, cell.shape))
    first = points[:, 0]
    for one, other in ((0, 3), (1, 4), (0, 2), (3, 5)):
        counts = np.histogram2d(first[:, one], first[:, other], bins=16, range=[[0, 1], [0, 1]])[0]
        assert stats.chisquare(counts.ravel()).pvalue > 1e-4


def test_the_first_vertex_is_stratified_with_the_place():
    """Lanes choose for themselves whether theirs is the first."""
    per_half, pixels = 256, 10
    sampler = started(pixels, per_half)
    (x, y), _ = sampler.start_3d()
    lane = dr.arange(jit().UInt32, len(x))
    (u, v), lobe, light, _ = sampler.next_vertex(lane < len(x) // 2)
    points = np.stack([np.array(each) for each in (x, y, u, v, *light, lobe)], axis=1).reshape(20, per_half, 7)
    splits = ([1, 2, 2, 1], [0, 2, 1, 3], [2, 0, 3, 1], [2, 1, 1, 2])
    for axes in ([0, 1, 2, 3], [0, 1, 4, 5]):
        assert all(held(points[:10][..., axes], split) == (4, 4) for split in splits)
        assert all(held(points[10:][..., axes], split)[1] > 4 for split in splits)
    # place and lobe of either are a net of t = 1
    assert held(points[..., [2, 3, 6]], [2, 2, 3]) == (2, 2)


def test_samples_of_a_half_are_stratified_and_uniform():
    pairs = draws(400, 8, 6)
    assert pairs.min() >= 0 and pairs.max() < 1
    cells = np.sort(np.floor(pairs * 8), axis=2)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(8)[None, None, :, None, None], cells.shape))
    # one sample of each pixel and half: independent and uniform (χ², 16 × 16 cells, false alarm 1e-4)
    one = pairs[:, :, 3].reshape(-1, 2)
    counts = np.histogram2d(one[:, 0], one[:, 1], bins=16, range=[[0, 1], [0, 1]])[0]
    assert stats.chisquare(counts.ravel()).pvalue > 1e-4


def test_dimensions_pixels_and_halves_are_uncorrelated():
    pairs = draws(4000, 4, 6)
    columns = pairs.reshape(4000, -1)
    matrix = np.corrcoef(columns, rowvar=False)
    # within one dimension strata make samples of a half anticorrelated; everything else must be 0 on average
    same = np.kron(np.eye(2), np.kron(np.ones((4, 4)), np.eye(12))).astype(bool)
    off = matrix[~same]
    # 1e-4 over all entries by Bonferroni
    assert np.abs(off).max() < stats.norm.isf(1e-4 / off.size / 2) / np.sqrt(4000)
    assert matrix[same & ~np.eye(matrix.shape[0], dtype=bool)].mean() < -0.2


def test_no_draw_is_zero_or_one():
    """All strata of a coordinate, in which 0 itself would be: a surface that is asked there may send no ray on."""
    first, second = (np.array(v) for v in started(1, 1 << 22).next_2d())
    for drawn in (first, second):
        assert drawn.min() > 0 and drawn.max() < 1
        assert drawn.min() < 2.0**-20 and drawn.max() > 1 - 2.0**-20


@pytest.mark.parametrize("per_half", [1, 3, 5])
def test_any_number_of_samples_is_unbiased(per_half):
    pairs = draws(20_000, per_half, 1)
    mean = pairs.mean(axis=(0, 1, 2, 3))
    assert np.all(np.abs(mean - 0.5) < 4.4 / np.sqrt(12 * 40_000))


def test_wavelengths_follow_the_response_exactly():
    types = jit()
    spiky = Spectrum(
        np.array([400.0, 450.0, 450.5, 452.0, 500.0, 600.0, 601.0, 700.0]),
        np.array([0.0, 0.0, 5.0, 0.1, 0.0, 0.0, 1.0, 0.2]),
    )
    flat = Spectrum(np.array([380.0, 780.0]), np.array([2.0, 2.0]))
    sampler = WavelengthSampler({"flat": flat, "spiky": spiky})
    count = 1 << 16
    u = from_host(types.Float, (np.arange(count) + 0.5) / count)
    for number, response in enumerate((flat, spiky)):
        which = dr.full(types.UInt32, number, count)
        np.testing.assert_allclose(np.array(sampler.total(which))[0], response.integral(), rtol=1e-6)
        wavelengths = np.sort(np.concatenate([np.array(w, dtype=float) for w in sampler.sample(which, u)]))
        grid = np.linspace(*response.support_nm, 200_001)
        values = response.at(grid)
        area = np.concatenate([[0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(grid))])
        expected = np.interp(wavelengths, grid, area / area[-1])
        np.testing.assert_allclose(expected, (np.arange(4 * count) + 0.5) / (4 * count), atol=2e-5)


def test_tables_of_wavelengths_make_one_kernel_wherever_they_lie_in_memory():
    flat, types, kernels = Spectrum(np.array([400.0, 700.0]), np.ones(2)), jit(), set()
    held = []
    for k in range(12):
        held.append(np.empty(16 * k + 1, np.uint32))  # other places for what follows
        sampler = WavelengthSampler({"flat": flat})
        u = dr.opaque(types.Float, 0.3, 64)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(sampler.sample(dr.opaque(types.UInt32, 0, 64), u))
            kernels.add(tuple(entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])))
        held.append(sampler)
    assert len(kernels) == 1

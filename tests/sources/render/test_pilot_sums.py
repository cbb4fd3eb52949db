"""Sums over the neighbours of pixels and over the rays of pairs, against NumPy and SciPy."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.ray_statistics import RayStatistics

ROWS, COLS = 23, 17


@pytest.mark.parametrize(
    "pixels",
    [
        pytest.param(np.arange(ROWS * COLS), id="all"),
        pytest.param(np.arange(5 * COLS + 4, 12 * COLS + 9), id="ends within rows"),
        pytest.param(np.array([8 * COLS + 8]), id="one pixel"),
        # two runs of whole rows, with others between them and at either side
        pytest.param(np.r_[0:3, 8 * COLS : 10 * COLS, 20 * COLS + 16], id="several runs"),
        pytest.param(np.arange(3, ROWS * COLS, 9 * COLS + 8), id="no whole row"),
    ],
)
@pytest.mark.parametrize("radius", [1, 2, 3])
def test_largest_values_around_pixels(pixels, radius):
    sites = Sites.around(pixels.astype(np.uint32), Lattice.whole(ROWS, COLS))
    values = np.random.default_rng(radius).normal(size=sites.size).astype(np.float32)
    image = np.full(ROWS * COLS, -np.inf, np.float32)
    image[sites.index] = values
    known = maximum_filter(image.reshape(ROWS, COLS), 2 * radius + 1, mode="constant", cval=-np.inf).ravel()
    np.testing.assert_array_equal(sites.most(values, radius), known[pixels])
    # of marks, and of some of the pixels
    some = np.arange(0, pixels.size, 2)
    marked = maximum_filter(image.reshape(ROWS, COLS) > 1, 2 * radius + 1, mode="constant", cval=False).ravel()
    np.testing.assert_array_equal(sites.only(some).most(values > 1, radius), marked[pixels[some]])


@pytest.mark.parametrize("alike", [16, 8])
@pytest.mark.parametrize("mild", [False, True])
def test_statistics_of_the_rays_of_pairs(alike, mild):
    """By the formulas of `PilotFlux` in float64; scatter is that about the mean of each kind."""
    rng, pairs, rays, types = np.random.default_rng(3), 7, 16, jit()
    one, other, third = (rng.lognormal(4.0 + k, 1.0, (pairs, rays)).astype(np.float32) for k in range(3))
    # rays in another window, in another order of pairs; of one pair all rays see the same in either window
    order = rng.permutation(pairs)
    shift = rng.normal(size=(2, pairs, rays)).astype(np.float32) * np.float32(30)
    one[2], other[4], shift[:, 3] = 5, 6, 0
    before = [(each + move)[np.argsort(order)] for each, move in zip((one, other), shift, strict=True)]
    bits = rng.integers(0, 2, (pairs, rays)).astype(np.uint32)
    bits[1] = 0
    statistics = RayStatistics(pairs, rays, alike)
    means, met, estimates, changes = statistics.of(
        [from_host(types.Float, third)],
        from_host(types.UInt32, bits),
        [from_host(types.Float, one), from_host(types.Float, other)],
        [from_host(types.Float, each) for each in before],
        from_host(types.UInt32, order.astype(np.uint32) * rays),
        2 if mild else 0,
    )
    np.testing.assert_allclose(np.array(means[0]), third.mean(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(np.array(met), bits.max(axis=1))
    for values, (mean, scatter), change, move in zip((one, other), estimates, changes, shift, strict=True):
        kinds = values.astype(np.float64).reshape(pairs, -1, alike)
        deviation = (kinds - kinds.mean(axis=2, keepdims=True)).reshape(pairs, rays)
        square, fourth = (deviation**2).mean(axis=1), (deviation**4).mean(axis=1)
        known = np.sqrt(fourth) if mild else fourth / np.maximum(square, 1e-30)
        np.testing.assert_allclose(np.array(mean), values.mean(axis=1), rtol=1e-5)
        np.testing.assert_allclose(np.array(scatter), np.sqrt(known * alike / (alike - 1)), rtol=1e-4, atol=1e-3)
        # the same factor as of the scatter
        spread = np.std(move.astype(np.float64), axis=1) * np.sqrt(alike / (alike - 1))
        np.testing.assert_allclose(np.array(change), spread, rtol=1e-4, atol=1e-3)


def test_without_rays_to_compare_with_there_are_no_changes():
    types = jit()
    values = from_host(types.Float, np.arange(16, dtype=np.float32))
    means, met, estimates, changes = RayStatistics(2, 8, 8).of(
        [], from_host(types.UInt32, np.zeros(16, np.uint32)), [values]
    )
    assert (means, changes) == ([], [])
    np.testing.assert_array_equal(np.array(met), [0, 0])
    np.testing.assert_allclose(np.array(estimates[0][0]), [3.5, 11.5], rtol=1e-6)

"""Poisson and normal deviates against SciPy."""

import math

import drjit as dr
import numpy as np
import pytest
from scipy import special, stats

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, normal_pair, philox
from hesim_render.pixels.aps.poisson import _log_probability, poisson

MEANS = (0.02, 0.7, 3.0, 9.99, 10.0, 10.3, 37.0, 500.0, 5000.0, 1e5, 1e6)
# 33 comparisons (χ², mean, variance at 11 means) at 1e-7 each: a false alarm in 300,000 runs
ALARM = 1e-7


def draw(mean, count, seed=1, index=0):
    types = jit()
    generator = philox(seed, Stream.APS, dr.arange(types.UInt32, count), index)
    return np.array(poisson(dr.full(types.Float, mean, count), generator)).astype(np.int64)


def chi_square_p(counts, mean):
    """p-value of the histogram of `counts`, cells below 20 expected merged into the tails."""
    low, high = stats.poisson.ppf([1e-9, 1 - 1e-9], mean).astype(int)
    k = np.arange(max(low, 0), high + 1)
    expected = stats.poisson.pmf(k, mean) * len(counts)
    wide = k[expected > 20]
    edges = np.arange(wide[0], wide[-1] + 2)
    # below the first cell, cells, above the last
    observed = np.bincount(
        np.clip(np.searchsorted(edges, counts, side="right"), 0, len(edges)), minlength=len(edges) + 1
    )
    cumulated = stats.poisson.cdf(edges - 1, mean)
    probability = np.concatenate([[cumulated[0]], np.diff(cumulated), [stats.poisson.sf(edges[-1] - 1, mean)]])
    kept = probability * len(counts) > 5
    statistic = np.sum((observed - probability * len(counts))[kept] ** 2 / (probability * len(counts))[kept])
    return stats.chi2.sf(statistic, kept.sum() - 1)


@pytest.mark.parametrize("mean", MEANS)
def test_law_mean_and_variance(mean):
    mean = float(np.float32(mean))
    counts = draw(mean, 1_000_000)
    assert counts.min() >= 0
    assert chi_square_p(counts, mean) > ALARM
    bound = stats.norm.isf(ALARM / 2)
    deviation = counts - mean
    assert abs(deviation.mean()) < bound * math.sqrt(mean / len(counts))
    # fourth central moment of a Poisson law: m + 3 m²
    assert abs((deviation**2).mean() - mean) < bound * math.sqrt((mean + 2 * mean**2) / len(counts))


@pytest.mark.slow
@pytest.mark.parametrize("mean", (1.0, 5.0, 9.99, 10.0, 20.0, 500.0))
def test_law_with_many_samples(mean):
    mean = float(np.float32(mean))
    counts = np.concatenate([draw(mean, 8_000_000, seed=9, index=k) for k in range(5)])
    # 6 comparisons at 1e-6: a false alarm in 170,000 runs
    assert chi_square_p(counts, mean) > 1e-6


def test_nothing_comes_of_nothing():
    types = jit()
    mean = types.Float([0.0, -0.0, -3.0, 1e-30])
    counts = np.array(poisson(mean, philox(1, Stream.APS, dr.arange(types.UInt32, 4))))
    assert counts.tolist() == [0, 0, 0, 0]


def test_a_pixel_does_not_depend_on_its_neighbours():
    types = jit()
    rng = np.random.default_rng(0)
    mean = (10.0 ** rng.uniform(-2, 5, 10_000)).astype(np.float32)
    pixel = np.arange(10_000, dtype=np.uint32)
    together = np.array(poisson(from_host(types.Float, mean), philox(3, Stream.APS, from_host(types.UInt32, pixel), 7)))
    order = rng.permutation(10_000)[:3333]
    alone = np.array(
        poisson(from_host(types.Float, mean[order]), philox(3, Stream.APS, from_host(types.UInt32, pixel[order]), 7))
    )
    np.testing.assert_array_equal(together[order], alone)
    other = np.array(poisson(from_host(types.Float, mean), philox(3, Stream.APS, from_host(types.UInt32, pixel), 8)))
    assert np.mean(other != together) > 0.5


@pytest.mark.parametrize("mean", (10.0, 30.0, 500.0, 2e4, 1e6))
def test_probabilities_are_good_to_single_precision(mean):
    types = jit()
    width = 7 * math.sqrt(mean)
    k = np.unique(np.linspace(max(mean - width, 0), mean + width, 4001).astype(int)).astype(float)
    deviance, scale = _log_probability(from_host(types.Float, k), dr.full(types.Float, mean, len(k)))
    ours = np.exp(-np.array(deviance, dtype=float)) / np.array(scale, dtype=float)
    # ln of the probability in double precision, from Stirling's series where lgamma would cancel
    exact = np.where(k < 1e4, stats.poisson.logpmf(k, mean), 0.0)
    big = k >= 1e4
    kb = k[big]
    ratio = (kb - mean) / mean
    exact[big] = mean * (ratio - (1 + ratio) * np.log1p(ratio)) - 0.5 * np.log(2 * np.pi * kb) - 1 / (12 * kb)
    # single precision gives ln p to about 1e-7 of itself, and k ≤ 25 in the fit to 3e-7
    np.testing.assert_array_less(np.abs(np.log(ours) - exact), 3e-6 + 6e-7 * np.abs(exact))


def test_normal_deviates_reach_into_the_tail():
    types = jit()
    count = 4_000_000
    word = philox(5, Stream.EVS, dr.arange(types.UInt32, count), 1).next_uint32x4()
    pair = np.stack([np.array(v) for v in normal_pair(word[0], word[1])]).astype(float)
    # 12 comparisons at z = 5.5 (4e-8): a false alarm in 2 million runs
    z_bound = 5.5
    assert np.all(np.abs(pair.mean(axis=1)) < z_bound / math.sqrt(count))
    assert np.all(np.abs((pair**2).mean(axis=1) - 1) < z_bound * math.sqrt(2 / count))
    assert abs((pair[0] * pair[1]).mean()) < z_bound / math.sqrt(count)
    assert abs((pair[0] ** 2 * pair[1] ** 2).mean() - 1) < z_bound * math.sqrt(8 / count)
    for level in (1.0, 3.0, 4.0, 4.5):
        for sign in (1, -1):
            p = special.ndtr(-level)
            found = np.mean(sign * pair > level)
            assert abs(found - p) < z_bound * math.sqrt(p / (2 * count))


def test_normal_deviates_at_the_ends_of_the_words():
    types = jit()
    ends = from_host(types.UInt32, [0, 1, 2**31, 2**32 - 1])
    first, second = (np.array(v) for v in normal_pair(ends, types.UInt32(0, 0, 0, 0)))
    assert np.all(np.isfinite(first)) and np.all(second == 0)
    # the smallest radius word is the uniform 2^-33
    assert first[0] == pytest.approx(math.sqrt(2 * 33 * math.log(2)), rel=1e-6)
    assert abs(first[3]) < 1e-4

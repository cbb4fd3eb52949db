"""Dark noise below a step of the ADC: against rounded normal numbers of NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from hesim_render.calibrate.aps.long_series import Long
from hesim_render.calibrate.aps.pair_levels import levels, pair_statistics
from hesim_render.calibrate.aps.rounded_noise import grey_moments, levels_of, rounded_noise, without_rounding
from hesim_render.calibrate.aps.spatial import Temporal, spatial_variance

SHAPE = (53, 71)


def series(seed, level, spread, noise, frames=9):
    """Mean and variance of frames of rounded values."""
    rng = np.random.default_rng(seed)
    own = level + spread * rng.standard_normal(SHAPE)
    values = np.rint(own + noise * rng.standard_normal((frames, *SHAPE)))
    return SimpleNamespace(mean=values.mean(axis=0), variance=values.var(axis=0, ddof=1), frames=frames)


@pytest.mark.parametrize(("level", "noise"), [(3.37, 0.31), (0.46, 0.07), (-2.71, 0.58), (7.5, 0.22), (4.02, 1.7)])
def test_mean_and_variance_of_a_rounded_value(level, noise):
    """Sums over grey values of chances from SciPy's normal law."""
    grey = np.arange(-20, 30)
    chance = stats.norm.cdf(grey + 0.5, level, noise) - stats.norm.cdf(grey - 0.5, level, noise)
    mean, variance = grey_moments(level, noise)
    assert mean == pytest.approx(grey @ chance, abs=1e-9)
    assert variance == pytest.approx((grey - grey @ chance) ** 2 @ chance, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("level", "spread", "noise"), [(3.5, 0.15, 0.22), (5.13, 0.31, 0.27), (2.94, 0.62, 0.4), (8.21, 0.11, 0.34)]
)
def test_the_noise_is_recovered(level, spread, noise):
    """Twelve series: the intervals hold the noise in all, or all but one (95 %: a chance of 0.88, one more 0.98)."""
    none = np.zeros(SHAPE, bool)
    results = [rounded_noise(series(seed, level, spread, noise), none) for seed in range(12)]
    assert sum(one.low <= noise <= one.high for one in results) >= 10
    assert np.mean([one.value for one in results]) == pytest.approx(noise, rel=0.02)
    assert np.mean([one.spread for one in results]) == pytest.approx(spread, rel=0.05)
    # as uncertain as they scatter
    scatter = np.std([one.value for one in results], ddof=1)
    assert 0.5 < np.mean([one.error for one in results]) / scatter < 2


def test_defects_are_left_out_and_no_change_tells_nothing():
    one = series(3, 4.31, 0.23, 0.26)
    wrong = np.zeros(SHAPE, bool)
    wrong[5, 7] = wrong[40:43, 60] = True
    clean = rounded_noise(one, wrong)
    one.mean[wrong], one.variance[wrong] = 190.0, 31.0
    assert rounded_noise(one, wrong) == clean
    assert rounded_noise(one, np.zeros(SHAPE, bool)).value > 1.2 * clean.value
    assert rounded_noise(series(4, 4.02, 0.03, 0.02), wrong) is None


def test_levels_keep_the_order_of_the_means_and_have_the_law_of_the_grey_values():
    one = series(6, 3.41, 0.37, 0.19)
    good = np.ones(SHAPE, bool)
    good[9, 11] = False
    levels = levels_of(one.mean, good, 0.37)
    order = np.argsort(levels[good])
    assert np.all(np.diff(one.mean[good][order]) >= 0)
    assert stats.kstest(levels[good], stats.norm(0, 0.37).cdf).statistic < 1e-3
    assert levels[9, 11] == one.mean[9, 11] - one.mean[good].mean()


@pytest.mark.parametrize(("level", "shift"), [(64.0, 0.31), (64.5, -0.27)])
def test_noise_above_the_limit_of_the_standard_is_free_of_rounding(level, shift):
    """0.35 DN of pixels and 0.21 of columns, and levels of 0.13 DN at or between whole numbers, as a black level may
    be: pairs at that level and beside it, and the spread of the levels. Rounding alone moves them by 13, 3 and 9 %.
    """
    measured, results = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        own = rng.standard_normal(SHAPE)
        own = level + 0.13 * (own - own.mean()) / own.std()
        own = own - np.add.outer([0.0, shift], np.zeros((13, *SHAPE)))
        own += 0.35 * rng.standard_normal(own.shape) + 0.21 * rng.standard_normal((2, 13, 1, SHAPE[1]))
        frames = np.rint(own)
        dark = levels([0.01, 0.02], [0.0, 0.0], [pair_statistics(*two[:2], 1023) for two in frames])
        mean, variance = frames[0, 2:].mean(axis=0), frames[0, 2:].var(axis=0, ddof=1)
        columns = float(frames[0, 2:].mean(axis=1).var(axis=0, ddof=1).mean() - variance.mean() / SHAPE[0])
        temporal = Temporal(float(variance.mean()) - columns, 0.0, columns, 0.0, 0.0, 0.0)
        one = Long(mean, variance, frames[0, 2], 11, np.zeros(11), temporal,
                   spatial_variance(mean, temporal, 11, variance), None)  # fmt: skip
        free, series = without_rounding(dark, one)
        measured.append([*(dark.variance - 1 / 12), *dark.col, one.spatial.pixel])
        results.append([*(free.variance - 1 / 12), *free.col, series.spatial.pixel])
    true = np.array([0.35**2, 0.35**2, 0.21**2, 0.21**2, 0.13**2])
    error = np.std(results, axis=0) / np.sqrt(8) / true
    away = np.mean(results, axis=0) / true - 1
    assert np.all(np.abs(away) < 4 * error + 0.01)
    assert abs(np.mean(measured, axis=0) / true - 1)[0] > 0.1

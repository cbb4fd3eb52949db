"""Steps of the calibration of frames: dark lines, clipping, composite, telegraph noise, checks; by hand."""

from types import SimpleNamespace

import capture_sets
import numpy as np
import pytest
import yaml
from scipy.stats import chi2, norm

from hesim_render.calibrate import calibrate_aps, moments
from hesim_render.calibrate.aps import calibration as frame_calibration
from hesim_render.calibrate.aps import checks, common_mode, composite, dark, sensor_file, telegraph, variance
from hesim_render.calibrate.estimate import ALARM
from hesim_render.core.errors import SpecError


def test_lines_of_pixels_that_lack_exposures_are_those_of_polyfit():
    rng = np.random.default_rng(1)
    t, weight = np.array([0.01, 0.05, 0.2, 0.4]), np.array([3.0, 2.0, 1.5, 0.4])
    mean = rng.uniform(20, 60, (4, 5)).astype(np.float32)
    valid = np.array([[1, 1, 1, 1], [0, 1, 1, 1], [1, 0, 1, 1], [1, 1, 0, 0], [0, 1, 0, 1]], bool).T
    value, slope = dark._masked(mean, t, weight, valid)
    for k in range(5):
        some = valid[:, k]
        wanted = np.polyfit(t[some], mean[some, k], 1, w=np.sqrt(weight[some]))
        np.testing.assert_allclose((slope[k], value[k]), wanted, rtol=1e-4)
    n_fp, n_dp, covariance = dark._all_pixels(mean[:, None], t, weight)
    for k in range(5):
        line, plain = np.polyfit(t, mean[:, k], 1, w=np.sqrt(weight), cov="unscaled")
        np.testing.assert_allclose((n_dp[0, k], n_fp[0, k]), line, rtol=1e-5)
    np.testing.assert_allclose(covariance[::-1, ::-1], plain)
    model = dark.DarkModel(None, 0.0, None, None, covariance, None, None, None, 0.0)
    assert model.mean_variance(0.3) == pytest.approx(plain[1, 1] + 2 * 0.3 * plain[0, 1] + 0.09 * plain[0, 0])


def test_the_fixed_pattern_is_black_rows_and_what_is_left():
    """Means of good pixels alone; a row without any has no offset, and a pixel that is not good none of its own."""
    n_fp = np.array([[40.0, 44, 300], [50, 52, 54], [7, 8, 9]])
    good = np.array([[1, 1, 0], [1, 1, 1], [0, 0, 0]], bool)
    black, row, own = dark.split_fixed_pattern(n_fp, good)
    assert black == pytest.approx((42 + 52) / 2)
    np.testing.assert_allclose(row, [-5, 5, 0])
    np.testing.assert_allclose(own, [[-2, 2, 0], [-2, 0, 2], [0, 0, 0]])


def moments_of(**given):
    exposures = np.array(given["exposures_s"])
    return SimpleNamespace(exposures_us=(1e6 * exposures).round().astype(int), **given)


def test_hot_pixels_lie_six_robust_deviations_above_the_middle():
    """1.4826 times the median deviation of normal dark currents is their spread; the line is weighted by its noise."""
    rng, t = np.random.default_rng(3), np.array([0.02, 0.1, 0.3])
    current = 30 + 4 * norm.ppf((rng.permutation(40 * 50) + 0.5) / 2000).reshape(40, 50)
    current[[3, 20], [5, 7]] = 30 + 4 * 6.15, 30 + 4 * 5.85
    mean = (50 + current * t[:, None, None]).astype(np.float32)
    moments = moments_of(
        exposures_s=t, mean=mean, variance=np.full(mean.shape, 3.0, np.float32), frames=4000,
        lowest=np.full(mean.shape, 9), highest=np.full(mean.shape, 90),
    )  # fmt: skip
    found = dark.fit_dark(moments, np.ones((40, 50), bool), 1023)
    assert found.hot_limit_dn_per_s == pytest.approx(30 + 24, abs=0.2)
    assert np.argwhere(found.hot).tolist() == [[3, 5]] and not found.bad.any()
    assert found.chi2_per_dof == pytest.approx(0, abs=1e-4) and found.black == pytest.approx(50, abs=1e-3)


def lit(signal, t, variance, frames=9, **more):
    signal = np.asarray(signal, np.float32)
    given = {
        "exposures_s": np.asarray(t), "mean": signal + 50, "variance": np.broadcast_to(variance, signal.shape),
        "frames": frames, "highest": signal + 60, "lowest": signal + 40,
    }  # fmt: skip
    return moments_of(**{**given, **more})


def test_full_well_shows_as_pixels_at_one_level_that_shorter_exposures_predict_beyond():
    """25 of 400 pixels stop at 300 DN where 1.15 · 300 is predicted and more; a level below full scale."""
    rate = np.full((20, 20), 1000.0)
    rate.ravel()[:25] = 3600.0
    t = np.array([0.05, 0.1, 0.2])
    signal = np.minimum(rate * t[:, None, None], 300.0)
    good = np.ones((20, 20), bool)
    moments = lit(signal, t, 0.5)
    assert composite.saturation_dn(moments, signal, good, 1023) == pytest.approx(300)
    assert composite.saturation_dn(moments, signal, good, 355) is None  # the ADC clips them
    # predicted are 600 DN, with six deviations 2 √(V/9): less than 1.15 · 300 from V = 4064 DN² on
    assert composite.saturation_dn(lit(signal, t, 4000.0), signal, good, 1023) == pytest.approx(300)
    assert composite.saturation_dn(lit(signal, t, 4130.0), signal, good, 1023) is None
    good.ravel()[:6] = False
    assert composite.saturation_dn(moments, signal, good, 1023) is None  # 19 are too few
    other = signal.copy()
    other[1:].reshape(2, -1)[:, :25] *= np.linspace(0.6, 1.0, 25)  # of no common level
    assert composite.saturation_dn(lit(other, t, 0.5), other, np.ones((20, 20), bool), 1023) is None


def test_pixels_are_clear_of_both_ends_and_of_the_full_well_by_six_deviations():
    beta = np.array([[[9.0, 0.5, 0.0, 0.0, 0.0, 0.0]]])
    row_variance, signal = 2.0, np.array([[0.0, 100.0, 400.0, 900.0]])
    margin = 6 * np.sqrt(9 + 0.5 * signal + 1 / 12 + row_variance)
    moments = lit(signal[None], [0.1], 1.0)
    for low in (-1e-3, 1e-3):  # the mean just inside, or just outside of either end
        shifted = SimpleNamespace(**{**vars(moments), "mean": (margin + low)[None]})
        assert np.all(composite.clear_of_clipping(shifted, signal, 0, beta, 2000, None, row_variance) == (low > 0))
        shifted = SimpleNamespace(**{**vars(moments), "mean": (2000 - margin + low)[None]})
        assert np.all(composite.clear_of_clipping(shifted, signal, 0, beta, 2000, None, row_variance) == (low < 0))
    inside = SimpleNamespace(**{**vars(moments), "mean": np.full((1, 1, 4), 1000.0)})
    well = 400 + margin[0, 2]
    for low in (-1e-3, 1e-3):
        found = composite.clear_of_clipping(inside, signal, 0, beta, 2000, well + low, row_variance)
        assert found.tolist() == [[True, True, low > 0, False]]
    # without a polynomial by the pixels' own extremes
    ends = SimpleNamespace(
        **{**vars(moments), "highest": np.array([[[1999, 2000, 9, 9]]]), "lowest": np.array([[[1, 5, 0, 9]]])}
    )
    assert composite.clear_of_clipping(ends, signal, 0, None, 2000, None).tolist() == [[True, False, False, True]]
    at = signal[0, 1] + 6 * np.sqrt(1.0)
    assert composite.clear_of_clipping(ends, signal, 0, None, 2000, at)[0].tolist() == [True, False, False, False]


def test_the_composite_weighs_exposures_by_their_noise():
    """Rate of a line through the origin with weights 1/(V/n + dark); its error is 1/√(Σ w t²)."""
    t = np.array([0.02, 0.1])
    beta = np.array([[[4.0, 0.3, 11.0, 1e-4, 0.2, 3.0]]])
    signal = np.array([[[10.0, 14.0, 90.0]], [[55.0, 66.0, 400.0]]])
    usable = np.array([[[1, 1, 0]], [[1, 0, 0]]], bool)
    model = SimpleNamespace(
        n_fp=np.full((1, 3), 50.0, np.float32), n_dp=np.full((1, 3), 20.0, np.float32),
        mean_variance=lambda s: 0.1 + 2 * s,
    )  # fmt: skip
    moments = SimpleNamespace(mean=(signal + 50 + 20 * t[:, None, None]).astype(np.float32), exposures_s=t, frames=7)
    found = composite.compose(moments, model, usable, beta)
    x = signal[:, 0]
    s = t[:, None]
    terms = np.stack([np.ones_like(x), x, s + 0 * x, x**2, x * s, s**2 + 0 * x])
    variance = np.tensordot(beta[0, 0], terms, 1)
    weight = usable[:, 0] / ((variance + 1 / 12) / 7 + 0.1 + 2 * s)
    rate = np.sum(weight * x * s, axis=0)[:2] / np.sum(weight * s**2, axis=0)[:2]
    np.testing.assert_allclose(found.rate_dn_per_s[0, :2], rate, rtol=1e-5)
    error = 1 / np.sqrt(np.sum(weight * s**2, axis=0)[:2])
    np.testing.assert_allclose(found.standard_error_dn_per_s[0, :2], error, rtol=1e-5)
    assert np.isnan(found.rate_dn_per_s[0, 2]) and np.isnan(found.standard_error_dn_per_s[0, 2])


def test_the_chain_has_the_likelihood_of_all_paths():
    """A chain of two states over 4 frames, twice: the sum over its 16 paths gives likelihood and states."""
    rng = np.random.default_rng(5)
    y, t = rng.normal(50, 4, (2, 4, 3)), np.array([0.3, 1.0])[:, None, None]
    level, width = np.array([[48.0, 50, 46], [2.0, 1.0, 0.0], [6.0, 3.0, 9.0]]), np.array([2.0, 3.0, 1.5])
    share, stay = np.array([0.3, 0.6, 0.2]), np.array([0.7, 0.2, 0.5])
    found, high, both = telegraph._chain(y, t, level, width, share, stay)
    for pixel in range(3):
        p = np.array([1 - share[pixel], share[pixel]])
        move = stay[pixel] * np.eye(2) + (1 - stay[pixel]) * p
        total, states, pairs = 0.0, np.zeros((2, 4)), 0.0
        for k in range(2):
            mean = level[0, pixel] + level[1, pixel] * t[k, 0, 0] + np.array([0, level[2, pixel]])
            density = norm.pdf(y[k, :, pixel, None], mean, width[pixel])
            paths = np.array(np.unravel_index(np.arange(16), (2, 2, 2, 2))).T
            chance = np.array([
                p[path[0]] * np.prod(move[path[:-1], path[1:]]) * np.prod(density[range(4), path]) for path in paths
            ])  # fmt: skip
            total += np.log(chance.sum())
            chance /= chance.sum()
            states[k] = chance @ paths
            pairs += chance @ (paths[:, :-1] * paths[:, 1:]).sum(axis=1)
        assert found[pixel] == pytest.approx(total)
        np.testing.assert_allclose(high[:, :, pixel], states)
        assert both[pixel] == pytest.approx(pairs / (2 * 3))


def test_two_levels_are_fitted_with_their_share_and_correlation():
    """30 pixels of 12 DN distance, a fifth of the time high, correlation 0.6; upside down it is four fifths."""
    rng, frames = np.random.default_rng(6), 200
    state = np.zeros((2, frames, 30), bool)
    state[:, 0] = rng.random((2, 30)) < 0.2
    for k in range(1, frames):
        state[:, k] = np.where(rng.random((2, 30)) < 0.6, state[:, k - 1], rng.random((2, 30)) < 0.2)
    t = np.array([0.1, 0.4])
    y = 60 + 25 * t[:, None, None] + 12.0 * state + 2.5 * rng.standard_normal(state.shape)
    found = telegraph.fit_two_levels(y, t)
    assert found.is_telegraph.all()
    seen = state.mean(axis=(0, 1))
    np.testing.assert_allclose(found.amplitude_dn, 12, atol=1.2)
    np.testing.assert_allclose(found.width_dn, 2.5, rtol=0.15)
    np.testing.assert_allclose(found.high_share, seen, atol=0.02)
    np.testing.assert_allclose(found.visits, 400 * seen, atol=10)
    assert found.correlation.mean() == pytest.approx(0.6, abs=0.04)
    turned = telegraph.fit_two_levels(200 - y, t)
    np.testing.assert_allclose(turned.high_share, 1 - found.high_share, atol=0.01)
    # the gain: the likelihood of one level of any width, with as many values
    rest = y - y.mean(axis=1, keepdims=True)
    one = -0.5 * 400 * (np.log(2 * np.pi * np.mean(rest**2, axis=(0, 1))) + 1)
    two = norm.logpdf(y - 60 - 25 * t[:, None, None] - 12 * state, scale=2.5).sum(axis=(0, 1))
    np.testing.assert_allclose(found.gain / (two - one), 1, atol=0.55)


def test_suspects_have_a_chance_of_1e_6_beside_pixels_with_as_much_dark_current():
    """Variance 4 DN² and 0.2 DN² for each DN of dark current; two pixels just above, and just below the limit."""
    t, frames = np.array([0.1, 0.5]), 21
    current = np.tile(np.linspace(10, 100, 80), (80, 1))
    signal = (current * t[:, None, None]).astype(np.float32)
    variance = 4 + 0.2 * (current * t[:, None, None])
    limit = chi2.isf(1e-6, 2 * (frames - 1)) / (2 * (frames - 1))
    for factor, place in ((1.01, (7, 60)), (0.99, (8, 20)), (1.01, (40, 79)), (0.99, (41, 0))):
        variance[:, place[0], place[1]] *= factor * limit
    clear = np.full(signal.shape, 30)
    moments = moments_of(
        exposures_s=t,
        mean=50 + signal,
        variance=variance.astype(np.float32),
        frames=frames,
        lowest=clear,
        highest=clear,
    )
    used = np.ones((80, 80), bool)
    found = telegraph._suspects(moments, used, (1, 1), 1023)
    assert np.argwhere(found).tolist() == [[7, 60], [40, 79]]
    used[7, 60] = False
    assert np.argwhere(telegraph._suspects(moments, used, (2, 1), 1023)).tolist() == [[40, 79]]


def test_the_largest_of_several_deviations_is_told_with_its_chance():
    """Twice the tail of a normal law, times the number of values; both significance and size are asked for."""
    values = [(0.02, 0.001, 5000), (-0.05, 0.008, 20_000), (0.5, 0.2, 40_000)]
    found = checks._largest(values, 0.01, "name", "{:+.3g} at {:g} ms", 100.0)
    assert found.check == "name" and found.text == "-5 at 20 ms"
    assert found.p_value == pytest.approx(2 * norm.sf(0.05 / 0.008) * 3, rel=1e-6, abs=0)
    assert checks._largest(values, 0.06, "name", "", 1.0) is None
    shared = lambda variance, p, ratio: SimpleNamespace(variance=variance, p_value=p, ratio=ratio)  # noqa: E731
    drifts = [("a", shared(0.2, 1e-7, 5.0)), ("b", shared(0.1, 1e-9, 8.0)), ("c", shared(0.3, 0.9 * ALARM, 9.0))]
    assert checks._worst(drifts, 0.05) == ("b", pytest.approx(3e-9))
    assert checks._worst(drifts, 0.1) == ("a", pytest.approx(3e-7)) and checks._worst(drifts, 0.2) is None
    assert checks._worst(drifts[2:], 0.1) == ("c", pytest.approx(0.9 * ALARM))


@pytest.mark.parametrize(("seen", "limit"), [(0.01, "captures"), (0.011, "ADC")])
def test_the_sensor_file_of_captures_has_their_figures(tmp_path, seen, limit):
    """Full well is the largest signal, or 1.25 of full scale where the ADC limits it; exposures take half the time."""
    pairs = SimpleNamespace(
        spec=SimpleNamespace(full_scale_dn=1023, bit_depth=10), shape=(14, 22), has_photons=True,
        spatial_lit=SimpleNamespace(exposure_s=0.0304),
    )  # fmt: skip
    result = SimpleNamespace(
        gain=SimpleNamespace(slope=0.4), pairs=pairs, saturation=1, signal=np.array([100.0, 800.0]), brightest_dn=800.0,
        lit=SimpleNamespace(high=np.array([0.9, seen])), responsivity=SimpleNamespace(slope=0.23),
        black=SimpleNamespace(value=61.5, slope=17.0), noise=SimpleNamespace(value=8.9),
    )  # fmt: skip
    (tmp_path / "there").mkdir()
    file = sensor_file.write_sensor(tmp_path / "s.yaml", tmp_path / "there" / "c.yaml", result)
    data = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert data["noise"] == "there/c.yaml" and data["name"] == "s" and data["geometry"]["rows"] == 14
    assert data["geometry"]["cols"] == 22 and data["quantum_efficiency"] == pytest.approx(0.23 / 0.4)
    aps = data["aps"]
    assert aps["full_well_e"] == pytest.approx(800 / 0.4 if limit == "captures" else 1.25 * 1023 / 0.4, rel=1e-5)
    assert limit in data["assumptions"]["aps.full_well_e"]
    assert aps["read_noise_e"] == pytest.approx(np.sqrt(8.9 - 1 / 12) / 0.4, rel=1e-5)
    assert aps["dark_current_e_per_s"] == pytest.approx(17 / 0.4) and aps["black_level_dn"] == 61.5
    assert aps["exposure_us"] == 30_400 and aps["frame_rate_hz"] == pytest.approx(0.5 / 0.0304, rel=1e-5)
    assert aps["bit_depth"] == 10 and aps["system_gain_dn_per_e"] == pytest.approx(0.4)
    pairs.has_photons, pairs.spatial_lit.exposure_s, result.black.slope = False, 1e-3, -2.0
    data = yaml.safe_load(sensor_file.write_sensor(file, tmp_path / "c.yaml", result).read_text(encoding="utf-8"))
    assert data["quantum_efficiency"] == 0.5 and data["noise"] == "c.yaml"
    assert data["aps"]["frame_rate_hz"] == 30 and data["aps"]["dark_current_e_per_s"] == 0
    result.saturation = 2  # never seen
    data = yaml.safe_load(sensor_file.write_sensor(file, tmp_path / "c.yaml", result).read_text(encoding="utf-8"))
    assert data["aps"]["full_well_e"] == pytest.approx(1.25 * 1023 / 0.4, rel=1e-5)


def test_suspects_are_judged_by_the_exposures_that_are_clear_of_both_ends():
    """χ² over 8 − 1 degrees of freedom of each exposure that counts."""
    rows, cols, frames, full = 12, 9, 8, 255
    rng = np.random.default_rng(3)
    clear = rng.random((3, rows, cols)) < 0.7
    freedom = 7 * clear.sum(axis=0)
    beyond = rng.uniform(0.85, 1.15, (rows, cols))
    # the dark current is zero and every other variance is 5: that is what a good pixel has
    variance = np.full((3, rows, cols), 5.0)
    odd = np.zeros((rows, cols), bool)
    odd[1::3, 1::3] = True
    limit = chi2.isf(1e-6, np.maximum(freedom, 1))
    variance[:, odd] = (beyond * limit * 5.0 / np.maximum(freedom, 1))[odd]
    low = rng.random(clear.shape) < 0.5
    moments = SimpleNamespace(
        lowest=np.where(clear | ~low, 1, 0), highest=np.where(clear | low, full - 1, full), variance=variance,
        mean=np.full((3, rows, cols), 20.0), exposures_s=np.array([0.1, 0.4, 1.2]), frames=frames,
    )  # fmt: skip
    used = np.ones((rows, cols), bool)
    expected = odd & (beyond > 1) & (freedom > 0)
    assert expected.sum() >= 3 and (odd & (beyond < 1)).sum() >= 2
    np.testing.assert_array_equal(telegraph._suspects(moments, used, (1, 3), full), expected)
    used[tuple(np.argwhere(expected)[0])] = False
    np.testing.assert_array_equal(telegraph._suspects(moments, used, (1, 3), full), expected & used)


def test_only_the_most_suspicious_pixels_are_examined(monkeypatch):
    monkeypatch.setattr(telegraph, "_MOST", 2)
    shape = 2, 5, 7
    variance = np.full(shape, 5.0)
    variance[:, [0, 2, 4], [3, 1, 6]] = 70.0, 90.0, 80.0
    moments = SimpleNamespace(
        lowest=np.ones(shape), highest=np.full(shape, 9), variance=variance, mean=np.zeros(shape),
        exposures_s=np.array([0.1, 0.4]), frames=8,
    )  # fmt: skip
    found = telegraph._suspects(moments, np.ones(shape[1:], bool), (1, 1), 255)
    assert np.argwhere(found).tolist() == [[2, 1], [4, 6]]


def test_one_row_has_no_row_noise_that_shows():
    used = np.zeros((4, 6), bool)
    used[2] = True
    found = common_mode.row_noise(None, used)
    assert found == common_mode.Shared(0.0, float("inf"), 1.0, 1.0)


def test_variances_that_rounding_hides_fit_nothing():
    rng = np.random.default_rng(2)
    bins = variance.Pooled(
        np.full(3, 0.1), np.zeros(3), np.full((3, 7), 50.0), np.full((3, 4), 4.0), rng.random(3), np.zeros(3),
        np.full(3, 9.0), np.ones(3, bool),
    )  # fmt: skip
    found = variance.fit_variance(bins, least_dn2=0.081)  # 4/50 DN²
    assert not found.identified.any() and not found.beta.any() and found.covariance.shape == (6, 6)
    assert found.quantised_pixels == 150 and found.p_value == found.expected_chi2 == 1 and found.dof == 0


def test_pixels_that_hardly_respond_are_below_a_fiftieth_of_their_like():
    """Of a tile of 2 × 3 px of unlike rates: a fiftieth, ten errors, one dead neighbour; in corners too."""
    own = np.array([[900.0, 70.0, 5000.0], [300.0, 2500.0, 40.0]])
    rate = np.tile(own, (8, 9))
    error = 1e-3 * rate
    dead = {(4, 6): 0.019, (9, 10): 0.019, (2, 20): 0.0, (6, 3): 0.015, (0, 0): 0.01, (1, 26): 0.0, (14, 12): 0.01}
    for place, part in dead.items():
        rate[place] *= part
    rate[11, 5] *= 0.021  # alive
    rate[8, 18], error[8, 18] = 10.0, 95.0  # of 900, known to 95: not ten errors below
    rate[12, 24], error[12, 24] = 10.0, 85.0
    rate[14, 25] = np.nan  # unknown
    given = SimpleNamespace(rate_dn_per_s=rate, standard_error_dn_per_s=error)
    found = frame_calibration._unresponsive(given, (2, 3))
    assert {tuple(place) for place in np.argwhere(found).tolist()} == {*dead, (12, 24)}


def test_sensors_without_event_pixels_have_no_signal_at_them():
    sensor = SimpleNamespace(tile_rows=["ab"], evs_grid=None)
    rate = SimpleNamespace(rate_dn_per_s=np.ones((4, 4)), standard_error_dn_per_s=np.ones((4, 4)))
    signal, uneven = composite.signal_at_event_pixels(rate, sensor)
    assert signal.shape == uneven.shape == (0, 0) and signal.dtype == np.float32 and uneven.dtype == np.bool_


def test_signals_at_event_pixels_are_those_of_their_filter_around():
    """A tile of 2 × 3 px: red and blue frame pixels, an event pixel that gives frames too, one of red, one of white.

    The mean over red pixels within 3 σ, each by its distance, summed by hand; a strong step of the scene is told.
    """
    tile = ["abE", "WbF"]
    kinds = {
        "a": ("red", "aps"),
        "b": ("blue", "aps"),
        "E": ("red", "evs"),
        "W": ("white", "evs"),
        "F": ("blue", "aps evs"),
    }
    sensor = SimpleNamespace(
        tile_rows=tile, evs_grid=SimpleNamespace(rows_per_tile=1, cols_per_tile=3),
        pixels={key: SimpleNamespace(filter=name, roles=roles.split()) for key, (name, roles) in kinds.items()},
        positions=lambda role: [
            (i, j) for i in range(2) for j in range(3) if role in kinds[tile[i][j]][1].split()
        ],
    )  # fmt: skip
    y, x = np.mgrid[:28, :45]
    rate = (100 + 3.0 * y + 2.0 * x).astype(np.float32)
    rate[:, 30:] += 400
    given = SimpleNamespace(rate_dn_per_s=rate, standard_error_dn_per_s=np.full(rate.shape, 0.5, np.float32))
    signal, uneven = composite.signal_at_event_pixels(given, sensor)
    assert signal.shape == uneven.shape == (14, 45)
    np.testing.assert_array_equal(signal[:, 2::3], rate[1::2, 2::3])
    assert np.isnan(signal[:, 1::3]).all()  # no frame pixel has the filter of the white one
    sigma, reach = composite._SIGMA_PX, int(3 * composite._SIGMA_PX + 0.5)
    for i, j in ((4, 5), (7, 3), (5, 6)):
        row, col = 2 * i, 3 * j + 2
        weights, values = [], []
        for r in range(row - reach, row + reach + 1):
            for c in range(col - reach, col + reach + 1):
                if r % 2 == 0 and c % 3 == 0:
                    weights.append(np.exp(-((r - row) ** 2 + (c - col) ** 2) / (2 * sigma**2)))
                    values.append(rate[r, c])
        assert signal[i, 3 * j] == pytest.approx(np.average(values, weights=weights), rel=1e-5)
    assert uneven[3:11, 27].all() and not uneven[3:11, 3:24:3].any() and not uneven[:, 2::3].any()


@pytest.mark.parametrize("turned", [False, True])
def test_event_pixels_far_from_their_filter_see_it_through_a_wider_gaussian(monkeypatch, turned):
    """Four pixels from the nearest one, at 1.7 times its signal, in a tile of nine by one."""
    tile = list("aeeeEeeee") if turned else ["aeeeEeeee"]
    place = (4, 0) if turned else (0, 4)
    sensor = SimpleNamespace(
        tile_rows=tile, evs_grid=SimpleNamespace(rows_per_tile=1, cols_per_tile=1), positions=lambda role: [place],
        pixels={"E": SimpleNamespace(filter="white", roles=["evs"])},
    )  # fmt: skip
    monkeypatch.setattr(composite, "_like_it", lambda *_: {(0, 0): 1.7})
    rate = np.full((36, 3) if turned else (3, 36), 300.0, np.float32)
    signal, uneven = composite.signal_at_event_pixels(composite.Composite(rate, 0 * rate), sensor)
    assert signal.shape == ((4, 3) if turned else (3, 4)) and not uneven.any()
    np.testing.assert_allclose(signal, 510, rtol=1e-5)


@pytest.mark.parametrize("part", [0.98, 1.02])
def test_a_scene_is_uneven_beyond_a_tenth_and_the_square_root_of_three_times_its_noise(part):
    """A chequered scene, whose mean over a Gaussian is even: its squared contrast against 0.1² + 3 · 0.05²."""
    contrast = part * np.sqrt(0.1**2 + 3 * 0.05**2)
    values = 40 * (1 + contrast * (-1.0) ** np.add.outer(np.arange(24), np.arange(24)))
    mean, uneven = composite._smoothed(values, np.full(values.shape, 2.0), 1.0, 1.0)
    np.testing.assert_allclose(mean[5:-5, 5:-5], 40, rtol=1e-3)
    assert (uneven[5:-5, 5:-5] == (part > 1)).all()


def test_values_between_two_levels_belong_to_both_by_their_chance():
    """Least squares of 4 × 7 values, each twice, once a level, with its chance as weight."""
    rng = np.random.default_rng(8)
    t, high = np.array([0.2, 0.35, 0.6, 1.0])[:, None, None], rng.random((4, 7, 3))
    y = rng.normal(70, 9, (4, 7, 3))
    found, width = telegraph._line(y, np.broadcast_to(t, y.shape), high)
    plain, plain_width = telegraph._line(y, np.broadcast_to(t, y.shape), None)
    for pixel in range(3):
        times = np.broadcast_to(t[..., 0], (4, 7)).ravel()
        design = np.stack([np.ones(56), np.tile(times, 2), np.repeat([0.0, 1.0], 28)], axis=1)
        chance, values = high[..., pixel].ravel(), np.tile(y[..., pixel].ravel(), 2)
        root = np.sqrt(np.concatenate([1 - chance, chance]))
        line = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        np.testing.assert_allclose(found[:, pixel], line, rtol=1e-5)
        assert width[pixel] == pytest.approx(np.sqrt(np.sum((root * (values - design @ line)) ** 2) / 28), rel=1e-5)
        line = np.polyfit(times, values[:28], 1)
        np.testing.assert_allclose(plain[:, pixel], line[::-1], rtol=1e-5)
        assert plain_width[pixel] == pytest.approx(np.std(values[:28] - np.polyval(line, times)), rel=1e-5)


def test_a_chain_has_the_share_and_the_correlation_of_its_states(monkeypatch):
    """P(high, high) = p² + p (1 − p) c; the search ends where the likelihood rises no more, or after its rounds."""
    rng, rounds = np.random.default_rng(2), []
    y, high = rng.normal(40, 3, (2, 6, 3)), rng.uniform(0.1, 0.6, (2, 6, 3))
    high[..., 2] = 1.0  # never low: share and correlation stay 1e-4 below 1
    share = high.mean(axis=(0, 1))
    both = share**2 + share * (1 - share) * np.array([0.37, 0.81, 0.0])
    share[2], stay = 0.9999, [0.37, 0.81, 0.9999]

    def chain(y, t, level, width, share, correlation):
        rounds.append((share, correlation))
        return np.full(3, [-50.0, -40.0, -40.0][len(rounds) - 1]), high, both

    monkeypatch.setattr(telegraph, "_chain", chain)
    found = telegraph._climb(y, np.array([0.4, 1.0])[:, None, None], y > 40)
    assert len(rounds) == 3
    np.testing.assert_allclose(rounds[0], 0.5)
    for one in (rounds[1], rounds[2], found[2:4]):
        np.testing.assert_allclose(one, [share, stay])
    np.testing.assert_allclose(found[0], telegraph._line(y, np.broadcast_to([[[0.4]], [[1.0]]], y.shape), high)[0])
    assert found[4].tolist() == [-40, -40, -40]


def test_the_likelier_of_two_fits_counts_and_its_higher_level(monkeypatch):
    """Of states above the line, and above the median; the gain is over a line with one normal law."""
    rng, begun = np.random.default_rng(4), []
    times, y = np.array([0.3, 0.7, 1.2]), rng.normal(50, 4, (3, 5, 2)) + 30 * np.array([0.3, 0.7, 1.2])[:, None, None]

    def climb(y, t, begin):
        np.testing.assert_allclose(t.ravel(), times / 1.2)
        begun.append(begin)
        k = len(begun)
        level = np.array([[50.0, 51], [30, 31], [6.0 * k, -7.0 * k]])
        return level, np.array([2.0, 3.0]) * k, np.array([0.2, 0.3]) / k, np.array([0.6, 0.5]), np.array([-9.0, -8 - k])

    monkeypatch.setattr(telegraph, "_climb", climb)
    found = telegraph.fit_two_levels(y, times)
    for pixel in range(2):
        line = np.polyfit(np.repeat(times, 5), y[..., pixel].ravel(), 1)
        rest = y[..., pixel] - np.polyval(line, times)[:, None]
        np.testing.assert_array_equal(begun[0][..., pixel], rest > 0)
        one = norm.logpdf(rest, scale=rest.std()).sum()
        assert found.gain[pixel] == pytest.approx([-9.0, -9.0][pixel] - one, rel=1e-5)
    np.testing.assert_array_equal(begun[1], y > np.median(y, axis=1)[:, None])
    assert found.amplitude_dn.tolist() == [6, 7] and found.width_dn.tolist() == [2, 3]
    np.testing.assert_allclose(found.high_share, [0.2, 0.7])
    np.testing.assert_allclose(found.visits, 15 * np.array([0.2, 0.3]))
    begun.clear()
    monkeypatch.setattr(telegraph, "_climb", lambda *given: (*climb(*given)[:4], np.full(2, -9.0 + len(begun))))
    assert telegraph.fit_two_levels(y, times).amplitude_dn.tolist() == [12, 14]


def test_pixels_have_two_levels_by_gain_visits_and_distance():
    plain = {"amplitude_dn": 12.0, "high_share": 0.3, "correlation": 0.5, "width_dn": 2.0}
    least = {"gain": telegraph._LEAST_GAIN, "visits": telegraph._LEAST_VISITS}
    far = {"amplitude_dn": telegraph._LEAST_DISTANCE * 2.0}
    for changed, is_one in (
        ({"gain": 1.01 * least["gain"]}, True), ({"gain": 0.99 * least["gain"]}, False),
        ({"visits": least["visits"]}, True), ({"visits": 0.99 * least["visits"]}, False),
        ({"amplitude_dn": 1.01 * far["amplitude_dn"]}, True), ({"amplitude_dn": 0.99 * far["amplitude_dn"]}, False),
    ):  # fmt: skip
        values = {**plain, "gain": 2 * least["gain"], "visits": 3 * least["visits"], **changed}
        one = telegraph.TwoLevels(**{name: np.array([value]) for name, value in values.items()})
        assert one.is_telegraph.tolist() == [is_one]


def test_rows_lose_their_own_noise_or_the_usual_one_where_nearly_all_is_clipped(monkeypatch):
    """What the clear pixels of a row show, over the square of their share, and what the frame's mean took of it."""
    change = np.array([[3.0, -1.0, 2.0], [-2.0, 4.0, -1.0], [-1.0, -3.0, -1.0]])
    own = np.array([0.3, 0.5, 0.2])
    monkeypatch.setattr(common_mode, "_row_changes", lambda *_: (change, own))
    lowest, highest = np.full((1, 3, 10), 40), np.full((1, 3, 10), 60)
    lowest[0, 0, :4], highest[0, 2, 1:] = 255, 0
    kept = np.full((1, 3, 10), 9.0, np.float32)
    given = moments.FrameMoments(np.array([700]), 3, kept, kept, lowest, highest, kept, change[None], kept, kept, kept)
    found = common_mode.without_rows(given, np.ones((3, 10), bool), 255, 4.2).variance[0]
    of_rows = np.sum(change**2, axis=0) / 2 - own
    np.testing.assert_allclose(found[0, 4:], 9 - of_rows[0] / 0.6**2 - 1.4, rtol=1e-6)
    np.testing.assert_allclose(found[1], 9 - of_rows[1] - 1.4, rtol=1e-6)
    assert found[2, 0] == pytest.approx(9 - 4.2) and (found[0, :4] == 9).all() and (found[2, 1:] == 9).all()


def test_pixels_are_unlike_their_kind_by_the_scatter_of_their_variances():
    """Σ (n − 1)(s²/σ² − 1) over what is clear, over √(2 Σ (n − 1)): eight robust widths decide, or eight errors."""
    rng, shape = np.random.default_rng(6), (14, 18)
    beta = np.array([[[3.0, 0.02, 0.5, 0, 0, 0], [5.0, 0.03, 0.2, 0, 0, 0]]])
    sets, sums, freedom = [], np.zeros(shape), np.zeros(shape)
    odd = rng.random(shape) < 0.1
    factor = np.where(odd, rng.uniform(2.5, 5.0, shape), 1.0)
    for frames, times, light in ((6, [0.1, 0.7], 0.0), (11, [0.2, 0.5, 0.9], 300.0)):
        signals = light * rng.uniform(0.5, 1, (len(times), *shape))
        mask = rng.random(signals.shape) < 0.8
        variance = np.empty(signals.shape)
        for k, t in enumerate(times):
            terms = np.array([np.ones(shape), signals[k], np.full(shape, t)])
            tiled = np.tile(beta[0, :, :3], (shape[1] // 2, 1)).T[:, None]
            expected = np.sum(tiled * terms, axis=0) + 1 / 12
            variance[k] = expected * factor * rng.chisquare(frames - 1, shape) / (frames - 1)
            sums += mask[k] * (frames - 1) * (variance[k] / expected - 1)
            freedom += mask[k] * (frames - 1)
        moments = SimpleNamespace(exposures_s=np.array(times), variance=variance, frames=frames, mean=variance)
        sets.append((moments, mask, signals))
    (dark, dark_clear, _), (lit, usable, signals) = sets
    scaled = sums / np.sqrt(2 * np.maximum(freedom, 1))
    width = 1.4826 * np.median(np.abs(scaled - np.median(scaled)))
    expected = np.abs(scaled) > 8 * max(1.0, width)
    assert expected.sum() > 5 and (odd & ~expected).sum() > 5
    found = frame_calibration._unlike_their_kind(beta, dark, lit, signals.astype(np.float32), dark_clear, usable)
    np.testing.assert_array_equal(found, expected)


def test_light_is_there_from_five_deviations_of_a_mean_on_and_until_98_per_cent_are_saturated():
    """The longest exposure: √(36/9 + 5) = 3 DN, median of the good pixels."""
    good = np.arange(400).reshape(20, 20) % 5 > 0
    variance = np.where(good, 36.0, 900.0)[None] * np.array([0.1, 1.0])[:, None, None]
    lit = SimpleNamespace(
        highest=np.full((2, 20, 20), 200), variance=variance, frames=9, exposures_s=np.array([0.1, 0.4])
    )  # fmt: skip
    dark = SimpleNamespace(mean_variance=lambda t: {0.1: 0.0, 0.4: 5.0}[t])

    def check(level):
        signals = np.stack([np.full((20, 20), 900.0), np.where(good, level, 900.0)])
        frame_calibration._check_light(dark, lit, signals, good, 255)

    check(15.1)
    with pytest.raises(SpecError, match="no light above the dark"):
        check(14.9)
    lit.highest[:] = 255
    lit.highest[0][good & (np.arange(400).reshape(20, 20) < 18)] = 200  # 14 of 640
    check(15.1)
    lit.highest[0, 0] = 255
    with pytest.raises(SpecError, match="saturated at every exposure"):
        check(15.1)


def test_the_halves_of_a_frame_are_the_dimmer_and_the_brighter_of_its_clear_pixels():
    """Pixels at 0, near full scale, or that do not count belong to neither; a pixel at the median is dim."""
    limit = moments._CLEAR * 1000
    first = np.array([[0, 0, 0, 0, 7], [9, 20, 33, int(limit) - 1, int(limit) + 1], [41, 1000, 12, 0, 0]], np.uint16)
    used = np.ones(first.shape, bool)
    used[2, 2] = False
    clear = [7, 9, 20, 33, int(limit) - 1, 41]
    middle = np.median(clear)
    expected = np.full(first.shape, -1)
    for place in np.argwhere(used):
        value = int(first[tuple(place)])
        if value in clear:
            expected[tuple(place)] = int(value > middle)
    np.testing.assert_array_equal(moments._halves(first, used, 1000), expected)
    first[0, 4] = int(limit)  # the limit itself is not clear
    assert moments._halves(first, used, 1000)[0, 4] == -1
    assert np.all(moments._halves(np.zeros((2, 3), np.uint16), np.ones((2, 3), bool), 1000) == -1)


def test_clipping_is_judged_by_the_noise_that_was_fitted_and_the_fit_is_repeated_without_odd_pixels(
    tmp_path, monkeypatch
):
    """Two rounds: the second knows the polynomial of the first. In the first, odd pixels drop out of a second fit."""
    capture_sets.write_frames(tmp_path / "set", size=(24, 32), frames=16)
    with np.load(tmp_path / "set" / "aps_lit.npz") as data:
        frames, noise = data["frames"].astype(int), np.random.default_rng(1)
    frames[:, :, 5, 7] += noise.integers(-90, 90, frames.shape[:2])
    capture_sets.change(tmp_path / "set" / "aps_lit.npz", frames=np.clip(frames, 0, 1023).astype(np.uint16))
    judged, fitted = [], []
    clear, fit = frame_calibration.clear_of_clipping, frame_calibration._fit

    def recorded_clear(lit, signal, k, beta, *rest):
        judged.append(None if beta is None else beta.copy())
        return clear(lit, signal, k, beta, *rest)

    def recorded_fit(positions, tile, dark, dark_moments, lit, signals, good, *rest):
        result = fit(positions, tile, dark, dark_moments, lit, signals, good, *rest)
        fitted.append((good.copy(), {position: each.beta for position, each in result[0].items()}))
        return result

    monkeypatch.setattr(frame_calibration, "clear_of_clipping", recorded_clear)
    monkeypatch.setattr(frame_calibration, "_fit", recorded_fit)
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    exposures = len(frames)
    assert len(judged) == 2 * exposures and all(beta is None for beta in judged[:exposures])
    assert [good[5, 7] for good, _ in fitted] == [True, False, False] and all(good[5, 9] for good, _ in fitted)
    for beta in judged[exposures:]:
        for position, expected in fitted[1][1].items():
            np.testing.assert_array_equal(beta[position], expected)

"""Counts of event pixels: cells by a loop, tails of defects, rates of first events, losses and floors by hand."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm, poisson

from hesim_render.calibrate.asynchronous import analysis, defects, fit
from hesim_render.calibrate.asynchronous import checks as trial_checks
from hesim_render.calibrate.asynchronous import trials as trials_module
from hesim_render.calibrate.asynchronous.likelihood import LEAK, NAMES, RESPONSE
from hesim_render.calibrate.asynchronous.trials import Parts, Trials
from hesim_render.calibrate.evs import fitted, medians, steps
from hesim_render.calibrate.evs import model as good_fit
from hesim_render.calibrate.evs.cells import Cells, PixelThresholds, brightness_edges, pool_events
from hesim_render.calibrate.evs.model import log_likelihood, log_probability
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError


@pytest.mark.parametrize("position", [None, 1])
def test_cells_are_sums_over_pixels_of_like_brightness_and_threshold(position):
    """A loop over 12 by 9 pixels, some of them not good; the dark is a brightness of its own."""
    rng, shape = np.random.default_rng(1), (12, 9)
    signal = rng.choice([5.0, 5.01, 80.0, 300.0], shape)
    counts = [rng.integers(0, 90, shape) for _ in range(4)]
    good = rng.random(shape) < 0.8
    tile = np.add.outer(np.arange(12) % 2, np.arange(9) % 2)
    static = SimpleNamespace(
        signal_dn=signal, position=tile, sessions=[(signal, *counts[:2]), (0 * signal, *counts[2:])], trials=100
    )
    about = [1 + 0.02 * rng.standard_normal(shape) for _ in range(2)]
    known = PixelThresholds(*about, *rng.uniform(0.01, 0.1, (2, *shape)))
    found = pool_events(static, good, known, position)
    take = good if position is None else good & (tile == position)
    edges = brightness_edges(signal[good])
    sums = {}
    for session, (light, *both) in enumerate(static.sessions):
        for k, (sign, events) in enumerate(zip((1.0, -1.0), both, strict=True)):
            relative, left = (known.on, known.on_spread) if sign > 0 else (known.off, known.off_spread)
            for place in np.argwhere(take):
                at = tuple(place)
                step = round(relative[at] / 0.01)
                key = (session, k, 0 if session else np.searchsorted(edges, signal[at], side="right"), step)
                sums.setdefault(key, []).append((light[at], relative[at], left[at], events[at]))
    wanted = []
    for key in sorted(sums):
        x, r, own, n = np.array(sums[key]).T
        spread = np.sqrt(np.mean(own**2 + (r - r.mean()) ** 2))
        wanted.append((x.mean(), 1.0 - 2 * key[1], r.mean(), spread, x.size, n.sum()))
    table = found.cells
    told = np.stack([table.signal_dn, table.polarity, table.relative, table.spread, table.pixels, table.events], axis=1)
    np.testing.assert_allclose(told, wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found.counts, [c[take] for c in counts])
    assert found.is_dark.tolist() == [False, False, True, True] and found.polarity.tolist() == [1, -1, 1, -1]
    np.testing.assert_array_equal(table.total, 100 * table.pixels)
    one = found.single(3)
    assert not one.signal_dn.any() and np.all(one.polarity == -1) and one.trials == 100
    np.testing.assert_allclose(one.relative, known.off[take], rtol=1e-6)
    np.testing.assert_allclose(found.single(0).signal_dn, signal[take])


def test_coarser_cells_keep_sums_and_variances():
    """300 cells of ON and 5 of OFF in at most 40 each: sums and means stay, the scatter within is spread."""
    rng = np.random.default_rng(2)
    sizes, polarity = rng.uniform(1, 9, 305), np.repeat([1.0, -1.0], (300, 5))
    fine = Cells(rng.uniform(1, 100, 305), polarity, rng.uniform(0.8, 1.2, 305), rng.uniform(0.02, 0.1, 305), sizes,
                 rng.uniform(0, 50, 305), 70)  # fmt: skip
    found = fine.coarser(40)
    assert np.sum(found.polarity == 1) == 40 and np.sum(found.polarity == -1) == 5 and found.trials == 70
    for sign in (1.0, -1.0):
        before, after = fine.polarity == sign, found.polarity == sign
        assert np.all(np.diff(found.signal_dn[after]) > 0)
        assert found.events[after].sum() == pytest.approx(fine.events[before].sum())
        assert found.pixels[after].sum() == pytest.approx(sizes[before].sum())
        for name in ("signal_dn", "relative"):
            assert found.pixels[after] @ getattr(found, name)[after] == pytest.approx(
                sizes[before] @ getattr(fine, name)[before]
            )
        squares = [c.pixels[w] @ (c.spread**2 + c.relative**2)[w] for c, w in ((found, after), (fine, before))]
        assert squares[0] == pytest.approx(squares[1])
    assert np.ptp(np.sort(found.pixels[found.polarity == 1])) < 40  # seven or eight cells each
    near = fine.typical()
    assert np.all(np.abs(near.relative - 1) <= 0.1) and near.pixels.size == np.sum(np.abs(fine.relative - 1) <= 0.1)
    np.testing.assert_allclose(fine.with_spread(1.7).spread, 1.7 * fine.spread)


def test_bins_of_brightness_are_as_narrow_as_they_promise():
    """0.5 % of the range, 2 % of the brightness down to 1e-4 of the brightest, and 1 % of the pixels at most."""
    rng = np.random.default_rng(3)
    signal = np.concatenate([rng.uniform(40, 50, 9000), np.geomspace(0.01, 1000, 1001)])
    edges = np.concatenate([[signal.min()], brightness_edges(signal), [signal.max()]])
    width = np.diff(edges)
    assert np.all(width > 0)
    assert width.max() <= 1000 / 192 * 1.0001
    bright = edges[1:] > 0.1001
    assert np.all((width / edges[1:])[bright] <= 0.0194)  # 480 steps over four decades
    assert np.histogram(signal, edges)[0].max() <= 1.2 * signal.size / 96


def test_likelihood_of_events_is_the_binomial_one():
    rng = np.random.default_rng(4)
    p, total = rng.uniform(0.01, 0.9, 6), rng.integers(50, 90, 6).astype(float)
    events = np.floor(rng.uniform(0, 1, 6) * total)
    given = Cells(np.ones(6), np.ones(6), np.ones(6), np.zeros(6), total / 10, events, 10)
    wanted = np.sum(events * np.log(p) + (total - events) * np.log1p(-p))
    assert float(log_likelihood(given, np.log(p))) == pytest.approx(wanted)


def test_terms_that_are_left_out_change_nothing_else():
    """g = (1 + e y)² + w y²: without D (e) the square of y keeps its factor C² = w + e²."""
    eta = np.array([0.01, -0.2, 0.3, 0.4, 0.05, 0.001])
    assert fitted._without(eta, 3) == pytest.approx([0.01, -0.2, 0.3 + 0.16, 0.0, 0.05, 0.001])
    assert fitted._without(eta, 2) == pytest.approx([0.01, -0.2, 0.0, 0.4, 0.05, 0.001])
    root = np.random.default_rng(5).standard_normal((9, 6)) * 10.0 ** np.array([0, -6, 4, 2, -3, 5])
    covariance, mixed = fitted._covariance(root.T @ root)
    np.testing.assert_allclose(covariance, np.linalg.inv(root.T @ root), rtol=1e-6)
    assert mixed == []
    root[:, 2] = 1e4 * root[:, 0] + 3e9 * root[:, 1]
    assert fitted._covariance(root.T @ root)[1] == [0, 1, 2]


@pytest.mark.parametrize("spread", [0.0, 0.2])
def test_the_variance_of_a_cell_is_that_of_counting_and_of_thresholds(spread):
    """Pixels · (n p q + n (n − 1) Var p), the mean over thresholds by quadrature."""
    eta = np.array([0.004, np.log(0.9), 1e-5, 5e-4, 0.06, 0.0])
    given = Cells(np.array([40.0, 900.0]), np.array([1.0, -1.0]), np.array([1.05, 0.97]), np.full(2, spread),
                  np.array([70.0, 31.0]), np.zeros(2), 50)  # fmt: skip
    found = fitted.cell_variance(given, eta, 2.3, "linear")
    y = given.signal_dn
    u = 2.3 * (0.004 * y + 0.9) / np.sqrt(2 * ((1 + 5e-4 * y) ** 2 + 1e-5 * y**2))
    z, w = np.polynomial.hermite_e.hermegauss(60)
    p = norm.sf(((1 - given.polarity * 0.06) * u)[:, None] * (given.relative[:, None] + spread * z))
    mean, square = p @ w / w.sum(), p**2 @ w / w.sum()
    between = square - mean**2
    plain = given.pixels * (50 * mean * (1 - mean) + (50 * 49 if spread else 0) * between)
    np.testing.assert_allclose(found, plain, rtol=0.03)
    if not spread:
        np.testing.assert_allclose(np.exp(log_probability(eta, given, 2.3, "linear")[0]), mean, rtol=1e-6)


def test_typical_pixels_have_the_rates_of_the_median_threshold():
    """Two scenes of 40 × 60 pixels with a spread of 12 %; u rises with the light, ON and OFF differ, two in three are
    good.
    """
    rng, trials, shape = np.random.default_rng(15), 2000, (40, 60)
    good = rng.random(shape) < 0.67
    signal = rng.permutation(np.linspace(50, 900, good.size)).reshape(shape)
    theta = 1 + 0.12 * rng.standard_normal(shape)

    def truth(light, sign):
        return 1.5 + 0.001 * light + 0.15 * sign

    sessions = []
    for light in (signal, np.zeros(shape)):
        counts = [rng.binomial(trials, norm.cdf(-theta * truth(light, sign))) for sign in (1, -1)]
        sessions.append((light, *(np.where(good, each, 1999) for each in counts)))
    found = medians.Typical.of(SimpleNamespace(sessions=sessions, trials=trials), good)
    cells = found.cells
    assert found.spread == pytest.approx(0.12, rel=0.15) and len(found.lines) == 4
    assert cells.pixels.sum() == pytest.approx(4 * good.sum()) and set(cells.polarity) == {1, -1}
    expected = norm.cdf(-truth(cells.signal_dn, cells.polarity))
    np.testing.assert_allclose(cells.events / (cells.pixels * trials), expected, rtol=0.15)
    assert np.mean(cells.events / (cells.pixels * trials) / expected) == pytest.approx(1, abs=0.03)
    for count, sign in ((0, 1), (1, -1)):
        light = np.array([200.0, 700.0])
        np.testing.assert_allclose(found.threshold_over_noise(count, light), truth(light, sign), rtol=0.04)
        middles = found.lines[count][0]
        assert found.group(count, middles + 0.4 * np.gradient(middles)).tolist() == list(range(middles.size))


def test_groups_of_like_brightness_are_of_200_pixels_or_more():
    signal = np.random.default_rng(6).permutation(np.arange(950.0))
    group = medians.like_brightness(signal)
    np.testing.assert_array_equal(group, np.minimum(signal.astype(int) // 200, 3))
    parts = medians.by_group(signal, group)
    assert [part.size for part in parts] == [200, 200, 200, 350] and all(np.all(g == k) for k, g in enumerate(
        medians.by_group(group, group)))  # fmt: skip
    assert np.bincount(medians.like_brightness(np.arange(900.0), 3)).tolist() == [300, 300, 300]


def trials_of(on, off, calm, signal, contrast=None, parts=None, settle_s=0.3):
    """[kind, bin, pixel] events of trials with bins that end at 0.1 and 0.5 s."""
    contrast = np.zeros(len(signal)) if contrast is None else np.asarray(contrast, float)
    return Trials(
        signal_dn=np.asarray(signal, float), contrast=contrast, settle_s=settle_s, edges_s=np.array([0.0, 0.1, 0.5]),
        calm=np.asarray(calm), on=np.asarray(on), off=np.asarray(off), parts=parts, shape=(1, np.shape(calm)[1]),
    )  # fmt: skip


def test_rates_of_first_events_are_those_of_an_exponential_law():
    """−ln(1 − events/calm)/0.5 s, three quarters of them ON; where a tenth is calm, from the 0.3 s of settling."""
    on = np.array([[[20, 0, 0, 3], [10, 0, 0, 3]]])
    off = np.array([[[6, 0, 0, 0], [4, 0, 0, 2]]])
    steady = trials_of(on, off, [[100, 100, 10, 8]], [50.0])
    never = np.array([False, False, True, False])
    found = defects._own_rates(steady, 0, never, 100.0)
    total = np.array([-np.log(0.6) / 0.5, 0.0, -np.log(0.1) / 0.3, np.log(8 / 0.5) / 0.5])
    share = np.array([0.75, 1.0, 1.0, 0.75])
    np.testing.assert_allclose(found, np.stack([share, 1 - share]) * total)


def test_flickering_pixels_fire_at_a_rate_of_their_own_while_they_do():
    """2 pixels: trials with an event in the parts in which they fire; the usual share of good pixels is taken off."""
    rng = np.random.default_rng(7)
    chance, usual, trials = np.array([0.6, 0.4]), 0.05, 40
    state = np.zeros((400 * trials, 2), bool)
    for k in range(1, state.shape[0]):  # the state is kept with 0.99 from trial to trial
        state[k] = np.where(rng.random(2) < 0.99, state[k - 1], rng.random(2) < [0.3, 0.5])
    disturbed = np.empty((400, 12), int)
    fires = rng.random(state.shape) < usual + (chance - usual) * state
    disturbed[:, :2] = fires.reshape(400, trials, 2).sum(axis=1)
    disturbed[:, 2:] = rng.binomial(trials, usual, (400, 10))
    bad = np.arange(12) < 2
    given = Parts(disturbed, trials, 0.7)
    rates, firing_share, change_hz = defects._flicker(bad, np.arange(2), given, np.array([[3.0, 1.0], [1.0, 1.0]]))
    share = state.mean(axis=0)
    np.testing.assert_allclose(firing_share, share, rtol=0.12)
    seen = (disturbed[:, :2].mean(axis=0) / trials - disturbed[:, 2:].mean() / trials) / firing_share
    rate = -np.log1p(-seen) / 0.7
    np.testing.assert_allclose(rates[0], rate * [0.75, 0.5], rtol=1e-3)
    np.testing.assert_allclose(rates[1], rate * [0.25, 0.5], rtol=1e-3)
    np.testing.assert_allclose(change_hz, -np.log(0.99) / 0.7, rtol=0.3)


@pytest.mark.parametrize("more", [0, 1])
def test_pixels_are_plainly_bad_by_polarity_calm_and_events_in_the_brightest_light(more):
    """400 pixels with 5 events of the usual ones: a tail of 1e-7 begins at `least`; half of the calm trials count."""
    pixels = 400
    usual = 5.0
    least = next(n for n in range(60) if poisson.sf(n - 1, usual) < 1e-7)
    steady_on = np.zeros((2, 2, pixels), int)
    steady_on[1, 0] = 5
    steady_on[1, 1, 11] = least - 5 - 1 + more  # in the other bin
    steady_on[0, 0, 12] = 90  # of a dim light: that is not judged
    calm = np.full((2, pixels), 200)
    calm[1, 30] = 99 + more
    steps_on, steps_off = (np.ones((2, 2, pixels), int) for _ in range(2))
    steps_on[:, :, 40] = 0
    steps_off[:, :, 41] = 0
    steady = trials_of(steady_on, 0 * steady_on, calm, [3.0, 80.0])
    steps = trials_of(steps_on, steps_off, np.full((2, pixels), 50), [80.0, 80.0], [0.3, -0.3])
    found = defects.plainly_bad(steady, steps)
    assert np.flatnonzero(found).tolist() == [*([11] if more else []), *([] if more else [30]), 40, 41]


@pytest.mark.parametrize(("others", "is_bad"), [(1, True), (3, False)])
def test_what_is_usual_counts_an_event_of_each_of_the_few_pixels_that_have_any(others, is_bad):
    """One of 400 pixels has three events: a chance of 2e-8 where 2 of 400 have any, and of 2e-7 where 4 have."""
    on = np.zeros((1, 2, 400), int)
    on[0, 0, 7] = 3
    on[0, 1, 20 : 20 + others] = 2
    steady = trials_of(on, 0 * on, np.full((1, 400), 200), [80.0])
    ones = np.ones((2, 2, 400), int)
    steps = trials_of(ones, ones, np.full((2, 400), 50), [80.0, 80.0], [0.3, -0.3])
    assert (poisson.sf(2, (1 + others) / 400) < 1e-7) == is_bad
    assert np.flatnonzero(defects.plainly_bad(steady, steps)).tolist() == ([7] if is_bad else [])


def test_kinds_of_bad_pixels():
    """Stuck: no event from a step; hot: hardly calm, or more events than chance gives (1e-3); else other."""
    pixels = 50
    steady_on = np.full((1, 2, pixels), 2)
    calm = np.full((1, pixels), 200)
    usual = 4 * 1.0
    least = next(n for n in range(60) if poisson.sf(n - 1, usual) < 1e-3)
    steady_on[0, :, 3] = least // 2, least - least // 2
    steady_on[0, :, 4] = (least - 1) // 2, least - 1 - (least - 1) // 2
    calm[0, 5] = 99
    steps_on, steps_off = (np.ones((2, 2, pixels), int) for _ in range(2))
    steps_on[:, :, [4, 6]] = steps_off[:, :, 6] = 0
    bad = np.isin(np.arange(pixels), (3, 4, 5, 6))
    steady = trials_of(steady_on, 0 * steady_on, calm, [80.0])
    steps = trials_of(steps_on, steps_off, np.full((2, pixels), 50), [80.0, 80.0], [0.3, -0.3])
    found = defects.classify(steady, steps, bad)
    assert found.kind[[3, 4, 5, 6]].tolist() == [Defect.HOT, Defect.OTHER, Defect.HOT, Defect.STUCK]
    assert not found.kind[~bad].any()
    assert found.on_hz[3] == pytest.approx(-np.log1p(-least / 200) / 0.5, rel=1e-5) and found.on_hz[4] == 0
    assert found.on_hz[5] == pytest.approx(-np.log(99 / 200) / 0.3, rel=1e-5)


def test_losses_at_large_steps_are_told_from_one_in_a_thousand_on():
    """200 pixels whose S-curves end at 1 − loss: steps beyond four spreads count, those of a dim light do not.

    The largest steps are of 0.05 % less light, which is the same light. The loss has a normal error from its scatter
    over pixels, and one trial more.
    """
    size = np.array([0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.36, 0.8, 0.9, 0.95])
    contrast = np.concatenate([size, -size])
    signal = np.tile([70.0] * 7 + [69.965] * 2 + [50.0], 2)
    pixels, trials = 200, 2000
    centre = 0.25 * (1 + 0.14 * norm.ppf((np.arange(pixels) + 0.5) / pixels))  # beyond four spreads lie 0.8 and 0.9
    uneven = np.where(np.arange(pixels) % 2 == 0, 1, -1)
    for loss, is_told in ((0.0015, True), (0.0005, False)):
        events = np.rint(trials * norm.cdf((size[:, None] - centre) / 0.03))
        events[7:9] -= round(trials * loss) + uneven
        events[9] -= 100
        on = np.zeros((20, 2, pixels))
        off = on.copy()
        on[:10, 0], off[10:, 1] = events, events
        steps = trials_of(on, off, np.full((20, pixels), trials), signal, contrast)
        found = trial_checks._ceiling(steps)
        assert (found is not None) is is_told
        if is_told:
            assert f"in {loss:.2g} of the trials" in found.text
            # four columns of each pixel lose 3 ± 1 trials each
            error = np.sqrt(pixels * 4**2 + 1) / (4 * trials * pixels)
            assert found.p_value == pytest.approx(norm.sf((loss - 0.0005) / error), rel=1e-9, abs=0)


def test_events_away_from_the_threshold_are_told_beyond_leak():
    """OFF events after bright ON steps of more than half of θ, and ON events after OFF steps beyond those of leak."""
    values = np.zeros(len(NAMES))
    values[:2], values[LEAK], values[RESPONSE] = (0.2, 0.3), 0.02, 1e6
    pixels, trials = 100, 500
    contrast = np.array([0.4, 0.14, -0.4, -0.09])
    on, off = np.zeros((2, 4, 2, pixels), int)
    usual = 50_000 * 0.02 * 0.5
    fit = SimpleNamespace(values=values)

    def found():
        steps = trials_of(on, off, np.full((4, pixels), trials), np.full(4, 60.0), contrast)
        return trial_checks._floor(fit, steps)

    on[2, 0] = 5  # 500 in 50,000 trials, as leak makes them
    assert found() is None
    off[1, 1], on[3, 1] = 50, 50  # after steps of less than half of a threshold
    assert found() is None
    off[0, 0, :50] = 1
    told = found()
    assert "0.001 (OFF) of the trials" in told.text
    assert told.p_value == pytest.approx(2 * poisson.sf(49, 0.5), rel=1e-6, abs=0)
    on[2, 1] = 2
    told = found()
    assert "0.014 (ON) and 0.001 (OFF)" in told.text
    off[0, 0] = 0
    assert found().p_value == pytest.approx(2 * poisson.sf(699, usual + 0.5), rel=1e-6, abs=0)


@pytest.mark.parametrize(
    ("trials", "leak", "events", "is_told"),
    [(500, 0.02, 587, False), (500, 0.02, 594, True), (10_000, 2e-4, 180, False), (10_000, 2e-4, 220, True)],
)
def test_a_floor_is_told_below_half_the_chance_of_an_alarm_and_above_one_in_ten_thousand(trials, leak, events, is_told):
    """Of a chance of 1e-4 half for each polarity; at 80 or 120 events too many in a million trials."""
    values = np.zeros(len(NAMES))
    values[:2], values[LEAK], values[RESPONSE] = (0.2, 0.3), leak, 1e6
    on = np.zeros((2, 2, 100), int)
    on[1, 0, 0] = events
    steps = trials_of(on, 0 * on, np.full((2, 100), trials), [60.0, 60.0], [0.4, -0.4])
    told = trial_checks._floor(SimpleNamespace(values=values), steps)
    usual = 100 * trials * leak * 0.5
    chance = poisson.sf(events - 1, usual + 0.5)
    assert (told is not None) is is_told and (chance < 5e-5) == (is_told or trials > 500) and chance < 1e-4


@pytest.mark.parametrize(("on", "off"), [(0.071, 0.052), (0.006, 0.004)])
def test_the_mismatch_of_both_polarities_is_weighed_by_their_covariance(on, off):
    """Generalised least squares: Vᵢⱼ⁻¹ sums to the weights; 0 with a limit of two errors more where it is not seen."""
    covariance = np.array([[0.0030**2, 0.4 * 0.0030 * 0.0045], [0.4 * 0.0030 * 0.0045, 0.0045**2]])
    inverse = np.linalg.inv(covariance)
    error = 1 / np.sqrt(inverse.sum())
    value = inverse.sum(axis=0) @ [on, off] * error**2
    k = [analysis.NAMES.index(name) for name in ("mismatch_on", "mismatch_off")]
    values, whole = np.full(len(analysis.NAMES), 7.0), np.eye(len(analysis.NAMES))
    values[k], whole[np.ix_(k, k)] = (on, off), covariance
    found = analysis._mismatch(SimpleNamespace(values=values, covariance=whole))
    assert found.limit == pytest.approx(value + 2 * error)
    if on > 0.05:
        assert (found.value, found.error) == pytest.approx((value, error))
    else:
        assert found.value == 0 and np.isnan(found.error)
    whole[np.ix_(k, k)] = np.nan
    found = analysis._mismatch(SimpleNamespace(values=values, covariance=whole))
    assert (found.value, found.limit) == (0, max(on, off)) and np.isnan(found.error)


def test_thresholds_of_pixels_are_the_means_of_what_their_counts_leave(monkeypatch):
    """Of 11 pixels, four at once: mean and deviation over the grid, relative to the threshold of the fit."""
    monkeypatch.setattr(analysis, "_CHUNK", 4)
    monkeypatch.setattr(analysis, "TrialCounts", SimpleNamespace(of=lambda sets, polarity: sets))
    rng, grids = np.random.default_rng(3), (np.array([0.1, 0.17, 0.26, 0.3]), np.array([0.2, 0.28, 0.33, 0.41]))
    weights = rng.dirichlet(np.ones(4), 11)

    def given(sets):
        assert sets[0].tolist() == sets[1].tolist() and sets[0].size <= 4
        return weights[sets[0]]

    values = np.arange(9.0)
    values[:2] = 0.21, 0.29
    found_fit = SimpleNamespace(values=values, likelihood=SimpleNamespace(grids=grids), law_given=given)
    trials = SimpleNamespace(calm=np.zeros((3, 11)), of=lambda some: some)
    for polarity, theta, grid in ((1, 0.21, grids[0]), (-1, 0.29, grids[1])):
        mean, spread = analysis._pixel_thresholds(found_fit, trials, trials, polarity)
        expected = weights @ grid / theta
        np.testing.assert_allclose(mean, expected, rtol=1e-6)
        deviation = np.sqrt(np.sum(weights * (grid / theta - expected[:, None]) ** 2, axis=1))
        np.testing.assert_allclose(spread, deviation, rtol=1e-4)


def test_pixels_are_unlike_the_fit_by_any_test_that_few_fail(monkeypatch):
    """Chunks of three of the eight good pixels; a test that more than a quarter fails tells of the fit, and is left."""
    monkeypatch.setattr(defects, "_CHUNK", 3)
    monkeypatch.setattr(defects, "_MOST_BAD", 0.25)
    good = np.array([1, 1, 0, 1, 1, 1, 0, 1, 1, 1], bool)
    failed = {1: np.zeros((3, 10), bool), -1: np.zeros((3, 10), bool)}
    failed[1][0, [0, 9]] = True
    failed[1][2, [1, 3, 4]] = True
    failed[-1][1, 5] = failed[-1][2, 2] = True
    chunks = []

    def tests(fit, steady, steps, polarity):
        assert fit == "fit" and np.array_equal(steady, steps)
        chunks.append(len(steps))
        return failed[polarity][:, steps]

    monkeypatch.setattr(defects, "_tests", tests)
    trials = SimpleNamespace(of=lambda some: some)
    assert np.flatnonzero(defects.unlike("fit", trials, trials, good)).tolist() == [0, 5, 9]
    assert chunks == [3, 3, 3, 3, 2, 2]


def test_goodness_is_the_quadratic_form_of_groups_with_their_own_scatter(monkeypatch):
    """Two sessions of 60 pixels in four groups, two wide ones; ON and OFF are correlated, and the dark is one group."""
    rng = np.random.default_rng(12)
    means = rng.uniform(3, 40, (4, 60)) * np.array([[1.0], [2.0], [0.1], [0.3]])
    noise = rng.normal(size=(4, 60))
    noise[1] = 0.6 * noise[0] + 0.8 * noise[1]
    counts = means + 1.4 * np.sqrt(means) * noise
    group, wide = np.arange(60) % 4, np.array([0, 1, 1, 0])
    pixels = SimpleNamespace(
        is_dark=np.array([False, False, True, True]), cells=SimpleNamespace(trials=50), counts=counts,
        single=lambda k: k, signal_dn=np.arange(60.0),
    )  # fmt: skip
    asked = []

    def wider(events):
        asked.append(events)
        return wide if events.size == 4 else np.zeros(events.size, int)

    monkeypatch.setattr(good_fit, "probability", lambda values, k, theta_v, law: means[k] / 50)
    monkeypatch.setattr(good_fit, "_groups", lambda signal, events: asked.append(events) or group)
    monkeypatch.setattr(good_fit, "_wider", wider)
    found = good_fit.goodness(pixels, np.zeros(6), 0.3, "sqrt", 5)
    chi2 = 0.0
    for on, off, number, wider in ((0, 1, group, wide), (2, 3, 0 * group, np.zeros(1, int))):
        residual = counts[[on, off]] - means[[on, off]]
        effect = max(1.0, *(np.sum(residual**2, axis=1) / means[[on, off]].sum(axis=1)))
        alike = [number == g for g in range(number.max() + 1)]
        expected = np.array([[means[k][some].sum() for some in alike] for k in (on, off)])
        if on == 0:
            np.testing.assert_allclose(asked[0], np.minimum(means[0], means[1]) / effect)
        np.testing.assert_allclose(asked[1 if on == 0 else 2], expected.min(axis=0) / effect)
        for g, some in enumerate(alike):
            near = np.isin(number, np.flatnonzero(wider == wider[g]))
            size = expected[:, wider == wider[g]].sum(axis=1)
            matrix = residual[:, near] @ residual[:, near].T / np.sqrt(np.outer(size, size))
            total = residual[:, some].sum(axis=1) / np.sqrt(expected[:, g])
            chi2 += total @ np.linalg.solve(matrix, total)
    assert found.chi2 == pytest.approx(chi2) and found.dof == 2 * 5 - 5


def test_counts_of_steps_are_sums_over_groups_of_good_pixels(monkeypatch):
    """The light may be a number, or a map of which nearly all good pixels are within a tenth."""
    rng, shape = np.random.default_rng(3), (6, 9)
    good = rng.random(shape) < 0.7
    counts = {name: rng.integers(0, 20, (2, *shape)) for name in ("n_on", "n_off")}
    group = rng.integers(0, steps.GROUPS, shape)
    light = np.where(good, 50 + 0.04 * np.arange(54).reshape(shape), 900.0)
    given, contrast = [light], np.array([0.2, -0.3])
    monkeypatch.setattr(steps, "read_contrast", lambda captures, more: (contrast, given[0], {"n_trials": 40}))
    monkeypatch.setattr(steps, "single_number", lambda value, *name, **limits: value)
    monkeypatch.setattr(steps, "step_maps", lambda captures, name, *sizes: counts[name])
    monkeypatch.setattr(steps, "pixel_groups", lambda shape: group)
    captures = SimpleNamespace(folder=Path("captures"))
    found = steps.read_steps(captures, good)
    for name, sums, total in (("n_on", found.on, found.on_total), ("n_off", found.off, found.off_total)):
        np.testing.assert_array_equal(total, counts[name].sum(axis=0))
        for k in range(2):
            for g in np.unique(group):
                assert sums[k, g] == counts[name][k][good & (group == g)].sum()
    assert found.signal_dn == np.median(light[good]) and found.trials == 40
    assert found.pixels.sum() == good.sum() and found.pixels[group[good][0]] == (good & (group == group[good][0])).sum()
    given[0] = np.array(77.0)
    assert steps.read_steps(captures, good).signal_dn == 77
    for wrong, words in ((light[:5], "is of size"), (np.where(good, 50 + np.arange(54).reshape(shape), 0), "10 %")):
        given[0] = wrong
        with pytest.raises(SpecError, match=words):
            steps.read_steps(captures, good)


@pytest.mark.parametrize(("advantage", "law"), [(4.0, "linear"), (6.0, "sqrt"), (900.0, "sqrt"), (-900.0, "linear")])
def test_trials_are_fitted_to_good_pixels_by_the_law_that_is_likelier(advantage, law, monkeypatch):
    """Two plainly bad pixels of 90, and a third that is unlike the first fit; the laws are compared on 50 pixels."""
    plain, other = np.zeros(90, bool), np.zeros(90, bool)
    plain[[4, 70]] = other[33] = True
    fits, asked = [], []

    def fit(sets, law, start, rounds=None):
        fits.append((set(sets[0].tolist()), law, start, rounds))
        return SimpleNamespace(
            law=law, values=np.array([float(len(fits))]),
            covariance=np.eye(9), log_likelihood=(advantage if law == "sqrt" else 0.0) - 71.5,
        )  # fmt: skip

    def unlike(fitted, steady, steps, good):
        asked.append(good.copy())
        return other & good

    trials = SimpleNamespace(of=np.asarray)
    changes = {
        "read_trials": lambda captures: (trials, trials), "plainly_bad": lambda *_: plain.copy(), "fit_trials": fit,
        "rough_start": lambda steady, steps, good, law: (law, good.sum()), "unlike": unlike,
        "_pixel_thresholds": lambda fitted, steady, steps, polarity: (polarity, -polarity), "_mismatch": lambda _: "m",
        "check_trials": lambda fitted, sets: (["finding"], {"all": len(sets[0])}),
        "classify": lambda steady, steps, bad: np.flatnonzero(bad).tolist(), "_FEW": 50, "MOST_PIXELS": 80,
    }  # fmt: skip
    for name, value in changes.items():
        monkeypatch.setattr(analysis, name, value)
    parts = []
    found = analysis.analyse_trials(SimpleNamespace(folder=None), 3, lambda what, part: parts.append(part))
    assert parts == pytest.approx([0.05, 0.3, 0.6, 0.8, 0.9])
    glances = fits[:2]
    assert [one[1] for one in glances] == ["linear", "sqrt"] and all(one[2] == (one[1], 88) for one in glances)
    assert all(len(one[0]) == 50 and one[3] == analysis._GLANCE for one in glances)
    assert not glances[0][0] & {4, 70} and glances[0][0] == glances[1][0]
    close = abs(advantage) < 500
    assert len(fits) == (6 if close else 4) and [one[1] for one in fits[-2:]] == [law, law]
    first, second = fits[-2:]
    assert len(first[0]) == len(second[0]) == 80 and not first[0] & {4, 70} and not second[0] & {4, 70, 33}
    assert np.flatnonzero(~asked[0]).tolist() == [4, 70] and np.flatnonzero(~asked[1]).tolist() == [4, 33, 70]
    assert found.defects == [4, 33, 70] and found.advantage == (advantage if law == "sqrt" else -advantage)
    assert (found.relative, found.noise) == ((1, -1), (-1, 1)) and set(found.fitted.tolist()) == second[0]
    assert found.goodness == {"all": 80} and found.findings == ["finding"] and found.mismatch == "m"
    monkeypatch.setattr(analysis, "plainly_bad", lambda *_: np.arange(90) < 46)
    with pytest.raises(SpecError, match="46 of 90 event pixels"):
        analysis.analyse_trials(SimpleNamespace(folder=None))


@pytest.mark.parametrize(
    ("reference", "files", "kind"),
    [
        (None, {"evs_static"}, False), (None, {"evs_s_curve"}, True), (None, {"evs_noise_rate"}, True),
        ("last_event", {"evs_s_curve"}, True), ("last_event", set(), True), ("last_event", {"evs_static"}, "reset"),
        ("previous_sample", {"evs_static"}, False), ("previous_sample", {"evs_noise_rate"}, "fixed ticks"),
    ],
)  # fmt: skip
def test_captures_are_of_trials_by_their_files_or_their_sensor(reference, files, kind, monkeypatch):
    monkeypatch.setattr(trials_module, "S_CURVE", "evs_s_curve")
    monkeypatch.setattr(trials_module, "NOISE_RATE", "evs_noise_rate")
    sensor = None if reference is None else SimpleNamespace(evs=SimpleNamespace(reference=reference))
    captures = SimpleNamespace(sensor=sensor, has=files.__contains__, folder=Path("captures"))
    if isinstance(kind, bool):
        assert trials_module.is_asynchronous(captures) == kind
    else:
        with pytest.raises(SpecError, match=kind):
            trials_module.is_asynchronous(captures)
    if reference is not None:
        sensor.evs = None
        assert not trials_module.is_asynchronous(SimpleNamespace(**{**vars(captures), "has": lambda name: False}))


def test_the_spread_of_thresholds_is_that_of_two_quantiles_less_counting():
    """Of 300 pixels with 400 trials: the lowest quantile with ten events and the next one, of each polarity."""
    rng, trials = np.random.default_rng(5), 400
    both = [rng.binomial(trials, norm.sf(u * (1 + 0.08 * rng.standard_normal(300)))) for u in (1.5, 2.1)]
    middles, spread = medians.middle_and_spread(both, np.zeros(300, np.intp), trials)
    z, parts = list(medians.QUANTILES.values()), list(medians.QUANTILES)
    jittered = [counts + np.random.default_rng(0).uniform(-0.5, 0.5, 300) for counts in both]
    q = np.array([np.quantile(counts, parts) for counts in jittered])
    k = int(np.argmax(q.min(axis=0) >= 10))
    values = []
    for own in q:
        low, high = norm.isf((own[[k, k + 1]] + 0.5) / (trials + 1))
        m = (low - high) / (high * z[k] - low * z[k + 1])
        p = own[[k, k + 1]] / trials
        counting = np.mean(p * (1 - p) / trials / norm.pdf([low, high]) ** 2)
        values.append(m**2 - counting / (low / (1 + m * z[k])) ** 2)
    assert k + 1 < len(parts)
    assert spread == pytest.approx(np.sqrt(np.median(values))) and spread == pytest.approx(0.08, abs=0.03)
    assert [float(one[0]) for one in middles] == pytest.approx([1.5, 2.1], rel=0.05)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None), ({(1, 0, 2): 41}, "outside 0 to n_trials"), ({(2, 1, 0): -1}, "outside 0 to n_trials"),
        (2, "n_on holds 2 steps, contrast 3"), (4, "n_on holds 4 steps, contrast 3"), (float, "must be whole numbers"),
        ((3, 3, 2), "of the static capture's size"),
    ],
)  # fmt: skip
def test_maps_of_steps_hold_0_to_n_trials(change, words, monkeypatch):
    """Both ends are right, and as many maps as there are contrasts."""
    maps = np.zeros((4, 2, 3), np.int64)
    maps[0, 1, 1], maps[2, 0, 0] = 40, 40
    maps = maps[: change if isinstance(change, int) else 3]
    if isinstance(change, dict):
        for place, value in change.items():
            maps[place] = value
    elif change is float:
        maps = maps.astype(float)
    elif isinstance(change, tuple):
        maps = np.zeros(change, np.int64)
    monkeypatch.setattr(steps, "count_maps", lambda captures, file, name: iter(maps))
    asked = steps.step_maps(SimpleNamespace(folder=Path("captures")), "n_on", 3, (2, 3), 40)
    if words is None:
        np.testing.assert_array_equal(list(asked), maps)
    else:
        with pytest.raises(SpecError, match=words):
            list(asked)


def arrays_of(**changes):
    """Two kinds, two time bins, 2 by 3 pixels; a fifth of the trials is calm, and each calm one gives an event."""
    calm = np.array([[[10, 2, 0], [0, 0, 0]], [[0, 0, 3], [20, 1, 0]]])
    on, off = np.zeros((2, 2, 2, 3), int), np.zeros((2, 2, 2, 3), int)
    on[0, 1], off[1, 0] = calm[0], calm[1]
    arrays = {"signal_dn": np.array([3.0, 7.0]), "contrast": np.array([20.0, -20.0]), "settle_us": 900.0,
              "edges_us": np.array([0, 40, 110]), "n_calm": calm, "n_on": on, "n_off": off}  # fmt: skip
    for name, value in changes.items():
        arrays[name] = value(arrays[name].copy())
    return arrays


def with_one(place, value):
    def change(values):
        values[place] = value
        return values

    return change


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"contrast": with_one(0, 20.01)}, "within ±20"), ({"contrast": with_one(1, -20.01)}, "within ±20"),
        ({"contrast": with_one(1, 0.0)}, "steps up"), ({"contrast": with_one(0, -19.0)}, "steps up"),
        ({"contrast": with_one(1, 19.0)}, "steps up"), ({"n_off": with_one((0, 1, 1, 0), -1)}, "below 0"),
        ({"signal_dn": with_one(0, 0.0)}, "a step needs light"),
        ({"n_on": with_one((0, 0, 0, 0), 1)}, "more trials together"),
        ({"n_calm": with_one((1, 0, 2), 2)}, "more trials together"),
        ({"n_calm": with_one((1, 1, 0), 21)}, "fifth"), ({"edges_us": with_one(0, 1)}, "begin with 0"),
        ({"edges_us": with_one(1, 110)}, "begin with 0"), ({"n_calm": with_one((0, 0, 0), 2**31)}, "beyond 2"),
    ],
)  # fmt: skip
def test_trials_that_are_just_right_and_just_wrong(changes, words, tmp_path):
    file = tmp_path / "evs_s_curve.npz"
    np.savez(file, **arrays_of(**changes))
    if words is None:
        found = trials_module._read(file, has_steps=True)
        assert found.settle_s == pytest.approx(9e-4) and found.shape == (2, 3)
        np.testing.assert_allclose(found.edges_s, [0, 4e-5, 1.1e-4])
        assert found.calm.shape == (2, 6) and found.on.shape == found.off.shape == (2, 2, 6)
        for name, values in (("n_calm", found.calm), ("n_on", found.on), ("n_off", found.off)):
            np.testing.assert_array_equal(values.reshape(arrays_of()[name].shape), arrays_of()[name])
    else:
        with pytest.raises(SpecError, match=words):
            trials_module._read(file, has_steps=True)


@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_weights_of_cells_are_found_with_the_fit(spread, monkeypatch):
    """Each fit is weighed by the variance at the one before: with a fit of v/5 + 1, the variance comes near 5/4."""
    seen = []

    def maximise(cells, eta, theta_v, law, free, variance):
        seen.append(variance)
        return eta if variance is None else np.array([[variance / 5 + 1]]), np.eye(1)[None], None

    monkeypatch.setattr(fitted, "maximise", maximise)
    monkeypatch.setattr(fitted, "cell_variance", lambda cells, eta, theta_v, law: float(eta[0]))
    cells = SimpleNamespace(spread=np.array([0.0, spread]))
    eta, _, variance = fitted._fit(cells, np.array([9.0]), 0.1, "sqrt", [True])
    if spread == 0:
        assert eta == [9.0] and seen == [None] and variance is None
    else:
        assert eta[0] == pytest.approx(1.25, rel=0.06) and variance == seen[-1] == pytest.approx(5 * (eta[0] - 1))
        assert seen[0] == 9.0 and len(seen) >= 3


def test_grids_of_thresholds_are_laid_about_the_fit_before(monkeypatch):
    """Twice: about the start, and about the end of the first round, whose grid is kept with the result."""
    laid, size = [], len(NAMES)
    scores, free = np.random.default_rng(4).normal(0.0, 3.0, (40, size)), np.arange(size) != fit.LEAK

    def climb(likelihood, values, rounds):
        assert likelihood == laid[-2:] and rounds == 7
        return values * 1.1, scores, free, -3.0 - len(laid)

    def grid(theta, mismatch):
        laid.append((theta, mismatch))
        return laid[-1]

    monkeypatch.setattr(fit, "_climb", climb)
    monkeypatch.setattr(fit, "threshold_grid", grid)
    monkeypatch.setattr(fit.Likelihood, "of", lambda sets, law, grids: list(grids))
    start = 1.0 + np.arange(size)
    found = fit.fit_trials(["set"], "sqrt", start, rounds=7)
    at = [(start[t], start[m]) for t, m in zip(fit.THETA, fit.MISMATCH, strict=True)]
    np.testing.assert_allclose(laid, [*at, *(1.1 * np.array(at))])
    np.testing.assert_allclose(found.values, 1.21 * start)
    assert found.likelihood == laid[2:]
    # inverse of the sum of squares of scores, of the logarithms, and the error of the law
    inverse = np.linalg.inv(scores[:, free].T @ scores[:, free])
    of_law = np.diag([0.0, 0.0, 0.0, 0.0, 0.004, 0.01, 0.015, 0.02]) @ np.diag(found.values[free])
    wanted = found.values[free][:, None] * inverse * found.values[free] + of_law**2
    np.testing.assert_allclose(found.covariance[np.ix_(free, free)], wanted)
    assert np.isnan(found.covariance[~free]).all() and np.isnan(found.covariance[:, ~free]).all()
    for k, name in enumerate(NAMES):
        assert found.value(name) == found.values[k]
        np.testing.assert_allclose(found.error(name), np.sqrt(wanted[k, k]) if free[k] else np.nan)


@pytest.mark.parametrize(("size", "is_reported"), [(3.9, False), (4.1, True)])
def test_a_search_that_ended_four_errors_from_the_best_is_reported(size, is_reported):
    """Scores of 30 pixels whose sum is that of a point so many standard errors away, whatever the units."""
    rng = np.random.default_rng(7)
    scores = rng.standard_normal((30, 3)) * [40.0, 0.3, 5.0]
    scores -= scores.mean(axis=0)
    free = np.array([True, False, True, True])
    away = np.array([0.6, -0.64, 0.48])
    # with a mean a of all scores, sᵀ S⁻¹ s of n of them is n x/(1 + x), x = n aᵀ C⁻¹ a, C that of the centred ones
    x = size**2 / 30 / (1 - size**2 / 30)
    root = np.linalg.cholesky(scores.T @ scores)
    scores += root @ away / np.linalg.norm(away) * np.sqrt(x / 30)
    told = trial_checks._ended(SimpleNamespace(scores=np.insert(scores, 1, 99.0, axis=1), free=free))
    assert (told is not None) == is_reported
    if told is not None:
        assert told.check == "fit" and "ended 4.1 standard errors" in told.text

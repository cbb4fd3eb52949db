"""Laws that calibrations of event pixels fit: by SciPy, slopes by finite differences, means by quadrature."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import multivariate_normal, norm

from hesim_render.calibrate.asynchronous import analysis as trials_analysis
from hesim_render.calibrate.asynchronous import fit as trials_fit
from hesim_render.calibrate.asynchronous import likelihood
from hesim_render.calibrate.evs import defects, dispersion, thresholds
from hesim_render.calibrate.evs import fit as events_fit
from hesim_render.calibrate.evs.cells import Cells
from hesim_render.calibrate.evs.model import log_probability
from hesim_render.calibrate.evs.steps import GROUPS

#: θ₊, θ₋, s, κ.
VALUES = np.array([0.21, 0.33, 0.05, 0.12])
STEP = np.array([-0.7, -0.41, -0.3, -0.22, -0.05, 0.0, 0.07, 0.18, 0.26, 0.5])


def slopes_of(function, at, step=1e-6):
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(at.size)], axis=-1)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_s_curves_and_their_slopes(polarity):
    """P = Q((θ ∓ S)/s) with s = 0.05 (1 + κ S/θ̄), θ̄ the mean of both thresholds."""
    theta = 0.21 if polarity > 0 else 0.33
    width = 0.05 * (1 + 0.12 * STEP / 0.27)
    np.testing.assert_allclose(thresholds.curve(VALUES, polarity, STEP), norm.sf((theta - polarity * STEP) / width))
    found = thresholds.curve_slopes(VALUES, polarity, STEP)
    # the width's own θ̄ is left out of the slope by θ, as the search does not need it
    fixed = lambda values: norm.sf((values[0 if polarity > 0 else 1] - polarity * STEP) / width)  # noqa: E731
    wanted = slopes_of(fixed, VALUES)[:, :2]
    np.testing.assert_allclose(found[:, :2], wanted, atol=1e-7)
    whole = slopes_of(lambda values: thresholds.curve(values, polarity, STEP), VALUES)
    np.testing.assert_allclose(found[:, 2:], whole[:, 2:], atol=1e-7)
    narrow = thresholds.curve(np.array([0.21, 0.33, 0.05, 3.0]), polarity, np.array([-2.0]))
    np.testing.assert_allclose(narrow, norm.sf((theta + 2 * polarity) / (0.2 * 0.05)))


def test_score_and_information_of_s_curves_are_those_of_binomial_counts():
    """n = 700 trials: Σ n (rate − p)/(p q) ∂p, and Σ n ∂p ∂p/(p q)."""
    rates = [np.linspace(0.05, 0.9, STEP.size), np.linspace(0.8, 0.1, STEP.size)]
    score, fisher = thresholds._score(VALUES, rates, STEP, 700.0)
    wanted, information = np.zeros(4), np.zeros((4, 4))
    for rate, polarity in zip(rates, (1.0, -1.0), strict=True):
        p = np.clip(thresholds.curve(VALUES, polarity, STEP), 1e-12, 1 - 1e-12)
        slope = thresholds.curve_slopes(VALUES, polarity, STEP)
        for k in range(STEP.size):
            wanted += 700 * (rate[k] - p[k]) / (p[k] * (1 - p[k])) * slope[k]
            information += 700 / (p[k] * (1 - p[k])) * np.outer(slope[k], slope[k])
    np.testing.assert_allclose(score, wanted, rtol=1e-10)
    np.testing.assert_allclose(fisher, information, rtol=1e-10)


@pytest.mark.parametrize("m", [0.06, 0.15])
def test_the_mismatch_explains_the_scatter_of_totals(m):
    """Mean over normal thresholds of 40 trials a step: the variance of the total by quadrature gives m² back.

    The width of a pixel's own curve is what is left of that of all: s² − m² θ².
    """
    theta, width, slope, trials = 0.21, 0.05, 0.12, 40
    z, w = np.polynomial.hermite_e.hermegauss(60)
    w = w / w.sum()
    own = np.sqrt(width**2 - (m * theta) ** 2) * (1 + slope * STEP / theta)
    p = norm.sf((theta * (1 + m * z)[:, None] - STEP) / own)
    mean, within = trials * p.sum(axis=1), trials * (p * (1 - p)).sum(axis=1)
    variance = w @ within + w @ mean**2 - (w @ mean) ** 2
    found = thresholds._mismatch_square(theta, width, slope, STEP, variance, trials)
    assert found == pytest.approx(m * m, rel=2e-3)
    # less scatter than counting alone: below 0, by the slope of the total against the threshold
    p = norm.sf((theta - STEP) / (width * (1 + slope * STEP / theta)))
    ends = [trials * norm.sf((theta * f - STEP) / (width * (1 + slope * STEP / theta))).sum() for f in (0.999, 1.001)]
    counting, by_theta = trials * (p * (1 - p)).sum(), (ends[1] - ends[0]) / 0.002
    found = thresholds._mismatch_square(theta, width, slope, STEP, 0.7 * counting, trials)
    assert found == pytest.approx(-0.3 * counting / by_theta**2, rel=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_pixels_threshold_and_error_from_its_total(sign):
    """The total that a threshold expects gives this threshold; its error is √(variance + ¼) over the slope."""
    m, trials, signed = 0.1, 400, np.linspace(-0.1, 0.6, 15)
    theta = VALUES[0 if sign > 0 else 1]
    own = np.sqrt(0.05**2 - (m * theta) ** 2)
    expect = lambda r: norm.sf((theta * r - signed) / (own * np.maximum(1 + 0.12 * sign * signed / theta, 0.2)))  # noqa: E731
    for relative in (0.81, 1.0, 1.23):
        p = expect(relative)
        pixel, error = thresholds._of_pixel(VALUES, sign, signed, np.array([trials * p.sum()]), trials, m)
        assert pixel[0] == pytest.approx(relative, abs=2e-4)
        slope = trials * (expect(relative - 1e-3).sum() - expect(relative + 1e-3).sum()) / 2e-3
        assert error[0] == pytest.approx(np.sqrt(trials * (p * (1 - p)).sum() + 0.25) / slope, rel=2e-3)


def test_known_thresholds_are_drawn_towards_the_mean_by_their_noise():
    """m²/(m² + n²) of the deviation is kept, and √(that · n²) is left unknown; ON and OFF have their own."""
    on, off = np.array([[1.2, 0.7]]), np.array([[0.9, 1.3]])
    given = SimpleNamespace(
        pixel_on=on, pixel_off=off, noise_on=np.array([[0.05, 0.2]]), noise_off=np.array([[0.1, 0.03]]),
        mismatch_on=0.1, mismatch_off=0.17,
    )  # fmt: skip
    found = thresholds.Thresholds.of_pixels(given)
    for seen, spread, pixel, noise, m in (
        (found.on, found.on_spread, on, given.noise_on, 0.1), (found.off, found.off_spread, off, given.noise_off, 0.17),
    ):  # fmt: skip
        trust = m**2 / (m**2 + noise**2)
        np.testing.assert_allclose(seen, 1 + trust * (pixel - 1))
        np.testing.assert_allclose(spread, np.sqrt(trust) * noise)


@pytest.mark.parametrize(("law", "power"), [("sqrt", 0.5), ("linear", 1.0)])
def test_probability_of_events_and_its_slopes(law, power):
    """P is the mean of Q(θ±/σ) over pixels whose θ± = (1 ∓ ρ) (r + m z) θ, as pixels have them, with a normal z; λ
    comes to ON. u = Θ (A I + B)/√(2 ((1 + e y)² + w y²)), y = √I or I.
    """
    signal = np.array([3.0, 3.0, 40.0, 40.0, 900.0, 900.0])
    polarity = np.array([1.0, -1, 1, -1, 1, -1])
    relative, spread = np.array([1.0, 0.9, 1.1, 1.05, 0.97, 1.2]), np.array([0.1, 0.12, 0.05, 0.2, 0.15, 0.08])
    cells = Cells(signal, polarity, relative, spread, np.ones(6), np.zeros(6), 1)
    at = np.array([0.004, np.log(0.9), 0.0021 if law == "sqrt" else 2e-5, 0.013 if law == "sqrt" else 9e-4, 0.06, 3e-3])
    theta_v, z = 2.3, np.linspace(-9, 9, 2_001)
    weight = norm.pdf(z) / norm.pdf(z).sum()

    def expected(parameters):
        a, log_b, w, e, rho, leak = parameters
        y = signal**power
        u = theta_v * (a * signal + np.exp(log_b)) / np.sqrt(2 * ((1 + e * y) ** 2 + w * y**2))
        theta = (1 - polarity * rho) * (relative + spread * z[:, None])
        p = weight @ norm.sf(theta * u)
        return np.log(p + np.where(polarity > 0, leak, 0.0))

    found, slopes = log_probability(at, cells, theta_v, law)
    np.testing.assert_allclose(found, expected(at), rtol=1e-9)
    wanted = np.stack(
        [(expected(at + d) - expected(at - d)) / (2 * d.max()) for d in 1e-5 * np.diag(np.abs(at))], axis=-1
    )
    np.testing.assert_allclose(slopes, wanted, rtol=2e-4, atol=1e-7)


def test_likelihood_of_counts_is_the_mean_over_normal_thresholds():
    """Counts of 200 trials of pixels with u (1 + m z): against a sum over 40,001 thresholds, up to one constant."""
    u, events = np.array([0.4, 0.9, 1.6, 2.2]), np.array([90.0, 31.0, 16.0, 1.0])
    scale, m = np.array([1.1, 0.93]), 0.17
    group = np.array([0, 0, 1, 1])
    mixture = dispersion._Mixture(u, events, group, np.arange(4), 200)
    z = np.linspace(-10, 10, 40_001)
    middle = (u * scale[group])[:, None]
    log_q, log_rest = norm.logsf(middle * (1 + m * z)), norm.logcdf(middle * (1 + m * z))
    terms = events[:, None] * log_q + (200 - events[:, None]) * log_rest - z * z / 2
    top = terms.max(axis=1)
    wanted = top + np.log(np.exp(terms - top[:, None]).sum(axis=1) * (z[1] - z[0])) - 0.5 * np.log(2)
    np.testing.assert_allclose(mixture.log_likelihood(m, scale), wanted, atol=2e-5)


@pytest.mark.parametrize("pixels", [199, 200])
def test_the_spread_of_thresholds_is_sought_in_two_hundred_counts(pixels, monkeypatch):
    """Counts of pixels of normal thresholds, of a spread of 0.35, give it back; of fewer nothing is said."""
    rng, m, trials = np.random.default_rng(3), 0.35, 400
    u = np.linspace(1.2, 1.6, pixels)
    events = rng.binomial(trials, norm.sf(u * (1 + m * rng.standard_normal(pixels)))) + 0.0
    mixture = dispersion._Mixture(u, events, np.zeros(pixels, np.intp), np.arange(pixels), trials)
    monkeypatch.setattr(dispersion._Mixture, "of", lambda *_: mixture)
    spread = dispersion.static_mismatch(None, SimpleNamespace(spread=0.1))
    if pixels < 200:
        assert spread.value == 0 and np.isnan(spread.error)
    else:
        assert spread.value == pytest.approx(m, abs=4 * m / np.sqrt(2 * pixels))
        assert 1 < spread.error / (m / np.sqrt(2 * pixels)) < 1.5  # counting adds to it


@pytest.mark.parametrize("reach", [0.34, 1.2])
def test_counts_are_out_of_reach_where_no_threshold_near_gives_them_in_1e_7(reach):
    """Of 300 comparisons, the sum over all counts that are as far off; beyond a reach of 1 the threshold is 0."""
    trials, u = 300, np.array([0.9, 1.7])

    def chances(p):
        return np.array([math.comb(trials, k) * p**k * (1 - p) ** (trials - k) for k in range(trials + 1)])

    for number, typical in enumerate(u):
        group = np.full(trials + 1, number)
        found = defects._out_of_reach(np.arange(trials + 1), group, trials, u, reach)
        as_many = chances(norm.sf(typical * max(1 - reach, 0)))[::-1].cumsum()[::-1]
        as_few = chances(norm.sf(typical * (1 + reach))).cumsum()
        np.testing.assert_array_equal(found, np.minimum(as_many, as_few) < 1e-7)


def test_dispersion_weighs_counts_by_what_their_variance_is_known_with():
    """Weights 1/(2 + 1/c) of the squares over counting, less thresholds; the error is that of the weighted mean."""
    rng = np.random.default_rng(1)
    counting, between = rng.uniform(0.3, 9, 400), rng.uniform(0, 0.2, 400)
    residual = np.sqrt(1.4 * counting + between) * rng.standard_normal(400)
    weight = 1 / (2 + 1 / counting)
    values = (residual**2 - between) / counting
    mean = np.average(values, weights=weight)
    error = np.sqrt(np.sum(weight**2 * (values - mean) ** 2)) / weight.sum()
    assert dispersion._ratio(residual, counting, between) == pytest.approx((mean, error))
    assert dispersion._ratio(0 * residual, counting, between)[0] == 0
    assert np.isnan(dispersion._ratio(residual[:99], counting[:99], between[:99])).all()
    assert np.isfinite(dispersion._ratio(residual[:100], counting[:100], between[:100])).all()


def curves_of(theta, response, lights):
    """Centres |ln I₁/I₀| at which a threshold θ is met: (1 + r I e^{±c})/(1 + r I) = e^{±θ}."""
    result = []
    for polarity, one in zip((1, -1), theta, strict=True):
        for light in lights:
            ratio = (np.exp(polarity * one) * (1 + response * light) - 1) / (response * light)
            result.append((polarity, light, polarity * np.log(ratio), 1e-3))
    return result


def test_lights_agree_on_the_threshold_at_the_true_response():
    """Relative variances of θ over three lights, of ON and of OFF; 0 at the response that the centres are of."""
    lights = np.array([20.0, 60.0, 300.0])
    curves = curves_of((0.2, 0.31), 0.03, lights)
    assert trials_fit._disagreement(curves, 0.03) == pytest.approx(0, abs=1e-20)
    wanted = 0.0
    for polarity in (1, -1):
        centre = np.array([c for p, _, c, _ in curves if p == polarity])
        theta = np.abs(np.log1p(0.1 * lights * np.exp(polarity * centre)) - np.log1p(0.1 * lights))
        wanted += theta.var() / theta.mean() ** 2
    assert wanted > 1e-3 and trials_fit._disagreement(curves, 0.1) == pytest.approx(wanted)
    assert trials_fit._disagreement([curves[0], curves[-1]], 0.1) == 0  # one light of each tells nothing


def test_pooled_s_curves_have_the_moments_of_their_law():
    """Steps of both signs in any order, 3 pixels, 10,000 trials of a normal law: its mean, and its variance."""
    rng = np.random.default_rng(5)
    size = np.arange(0.02, 0.62, 0.02)
    contrast = np.concatenate([size, -size])[rng.permutation(2 * size.size)]
    light = np.where(np.arange(contrast.size) < 0, 0.0, 70.0)
    centre, width = {1: 0.27, -1: 0.36}, {1: 0.05, -1: 0.07}
    sign = np.sign(contrast).astype(int)
    chance = np.array([ndtr((abs(c) - centre[s]) / width[s]) for c, s in zip(contrast, sign, strict=True)])
    calm = np.full((contrast.size, 3), 10_000)
    first = np.rint(calm * chance[:, None])  # in the first bin; a second one has what comes later
    events = {s: np.stack([np.where((sign == s)[:, None], first, 0), 77 + 0 * first], axis=1) for s in (1, -1)}
    steps = SimpleNamespace(signal_dn=light, contrast=contrast, calm=calm, events=lambda polarity: events[polarity])
    for s in (1, -1):
        ((polarity, at, mean, variance),) = trials_fit._pooled_curves(steps, s)
        assert (polarity, at) == (s, 70.0)
        assert mean == pytest.approx(centre[s], abs=2e-3)
        assert variance == pytest.approx(width[s] ** 2, rel=0.08)
    few = SimpleNamespace(**{**vars(steps), "calm": calm * 2})  # a rate that ends at a half is none
    assert trials_fit._pooled_curves(few, 1) == []
    # each pixel's own, from the events of all bins
    both = {s: np.stack([part * first * (sign == s)[:, None] for part in (0.6, 0.4)], axis=1) for s in (1, -1)}
    steps = SimpleNamespace(**{**vars(steps), "events": lambda polarity: both[polarity]})
    for s in (1, -1):
        np.testing.assert_allclose(trials_fit.pixel_thresholds(steps, s), centre[s], atol=2e-3)
    # of several lights the brightest of that polarity, to a thousandth, whatever those of the other are
    bright = np.where(sign > 0, 70.0, 41.0) * np.where(np.abs(contrast) < 0.3, 0.9996, 1)
    more = [size[:3] * s for s in (1, -1)]
    unlike = SimpleNamespace(
        signal_dn=np.concatenate([bright, [31.0] * 3, [17.0] * 3]),
        contrast=np.concatenate([contrast, *more]), calm=np.concatenate([calm, calm[:6]]),
        events=lambda polarity: np.concatenate([both[polarity], np.zeros((6, 2, 3))]),
    )  # fmt: skip
    for s in (1, -1):
        np.testing.assert_allclose(trials_fit.pixel_thresholds(unlike, s), centre[s], atol=2e-3)


def test_middle_spread_and_leak_of_a_start():
    """Quartiles of a normal law are 1.349 deviations apart; half an event is added to those of the brightest light."""
    values = 3.0 + 0.4 * norm.ppf((np.arange(4001) + 0.5) / 4001)
    assert trials_fit.median_and_spread(values) == pytest.approx((3.0, 0.4 / 3.0), rel=1e-3)
    steady = SimpleNamespace(
        signal_dn=np.array([3.0, 90.0, 20.0]), on=np.array([[[5, 1]], [[7, 4]], [[9, 9]]]),
        calm=np.array([[10, 10], [30, 50], [90, 90]]), edges_s=np.array([0.0, 0.1, 0.25]),
    )  # fmt: skip
    assert trials_fit._leak_start(steady) == pytest.approx(11.5 / (80 * 0.25))


@pytest.mark.parametrize(("law", "power"), [("sqrt", 1), ("linear", 2)])
def test_the_noise_of_trials_is_a_thousandth_of_the_threshold_or_more(law, power):
    values = np.zeros(9)
    values[[0, 1, likelihood.RESPONSE]] = 0.3, 0.9, 0.05
    light = np.array([0.0, 30.0])
    np.testing.assert_allclose(likelihood.noise_of(values, light, law), 3e-4)
    values[[likelihood.SHOT, likelihood.DARK]] = 2e-6, 7e-6
    own = (2e-6 * light**power + 7e-6) / (1 + 0.05 * light) ** 2
    np.testing.assert_allclose(likelihood.noise_of(values, light, law), np.sqrt(own + 9e-8))


@pytest.mark.parametrize(("mismatch", "reach"), [(0.1, (0.4, 1.6)), (0.2, (0.03, 2.2)), (0.001, (0.95, 1.05))])
def test_grids_of_thresholds_reach_six_spreads_on_both_sides(mismatch, reach):
    grid = likelihood.threshold_grid(0.4, mismatch)
    assert grid.size == 97 and (grid[0], grid[-1]) == pytest.approx((0.4 * reach[0], 0.4 * reach[1]))
    np.testing.assert_allclose(np.diff(grid), 0.4 * (reach[1] - reach[0]) / 96)


@pytest.mark.parametrize("law", ["linear", "sqrt"])
def test_the_approach_finds_the_parameters_of_rates_without_noise(law):
    """A, B and C of u = Θ (A y + B) / √(2 (1 + 2 e r + (w + e²) r²)) with r = y or √y, from starts far off in all."""
    rng, y = np.random.default_rng(8), np.linspace(5.0, 600.0, 40)
    a, b, w, e, theta = 0.01, 1.5, 0.02, 0.05, 1.6
    r = y if law == "linear" else np.sqrt(y)
    if law == "linear":
        w, e = w / 900, e / 30
    u = theta * (a * y + b) / np.sqrt(2 * (1 + 2 * e * r + (w + e * e) * r * r))
    relative, spread = rng.uniform(0.8, 1.2, 40), rng.uniform(0.02, 0.06, 40)
    v = u * relative / np.sqrt(1 + (u * spread) ** 2)
    pixels = rng.integers(50, 4000, 40).astype(float)
    events = norm.sf(v) * (pixels * 700 + 1) - 0.5
    cells = Cells(y, np.ones(40), relative, spread, pixels, events, 700)
    off = np.exp([[-0.75], [1.5]])  # of C, among the factors that are tried
    start = np.array([[9.0, -2.0, w, e, 0.1, 0.02], [1e-4, 3.0, w, e, 0.1, 0.02]])
    start[:, 2:3] *= off**2
    start[:, 3:4] *= off
    found = events_fit._approach(cells, start, theta, law, [True] * 4)
    np.testing.assert_allclose(found[:, :4], np.tile([a, np.log(b), w, e], (2, 1)), rtol=1e-6)
    np.testing.assert_array_equal(found[:, 4:], start[:, 4:])
    np.testing.assert_array_equal(events_fit._approach(cells, start, theta, law, [True, True, False, True]), start)


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_totals_of_pixels_have_the_threshold_and_mismatch_of_their_polarity(polarity):
    result = SimpleNamespace(
        theta_on=0.21, theta_off=0.33, mismatch_on=0.06, mismatch_off=0.12, width=0.06, slope=0.1, step=STEP
    )
    theta, m = (0.21, 0.06) if polarity > 0 else (0.33, 0.12)
    relative = np.array([0.8, 1.0, 1.3])
    noise = np.sqrt(0.06**2 - (m * theta) ** 2) * np.maximum(1 + 0.1 * STEP / theta, 0.2)
    wanted = 250 * norm.sf((theta * relative[:, None] - polarity * STEP) / noise).sum(axis=1)
    np.testing.assert_allclose(thresholds.totals_of(result, polarity, relative, 250), wanted, rtol=1e-6)


def test_each_polarity_of_a_trial_has_its_own_threshold_leak_and_grid(monkeypatch):
    """Thresholds 0.2 and 0.31; leak makes ON events alone. Of a pixel the mean over its own grid counts."""
    values = np.full(len(likelihood.NAMES), 0.5)
    values[likelihood.THETA[0]], values[likelihood.THETA[1]], values[likelihood.LEAK] = 0.2, 0.31, 0.04
    seen = []

    def first_event(own, other, *given):
        seen.append((own.ravel().tolist(), other, given[-1]))
        return np.zeros((1, 2, 3)), np.zeros((1, 2, 3))

    monkeypatch.setattr(likelihood, "first_event", first_event)
    trials = SimpleNamespace(
        signal_dn=np.array([9.0, 20.0]), contrast=np.array([0.1, 0.3]), settle_s=0.01, edges_s=np.array([0.0, 0.1])
    )
    grids = [np.array([0.15, 0.2, 0.25]), np.array([0.2, 0.31, 0.5])]
    for k, polarity in enumerate((1, -1)):
        likelihood.chances(values, trials, polarity, grids[k], "sqrt")
    assert seen == [(grids[0].tolist(), 0.31, (0.04, 0.0)), (grids[1].tolist(), 0.2, (0.0, 0.04))]
    # step and noise by their definitions, and chances among the trials that the other polarity has not ended
    rng, law = np.random.default_rng(2), {"linear": 2, "sqrt": 1}
    own, other, given = rng.uniform(0, 0.2, (2, 2, 3)), rng.uniform(0, 0.3, (2, 2, 3)), []
    monkeypatch.setattr(likelihood, "first_event", lambda *some: given.append(some) or (own, other))
    values[likelihood.RESPONSE], values[likelihood.SHOT], values[likelihood.DARK] = 0.07, 0.003, 0.0021
    trials.edges_s = np.array([0.0, 0.1, 0.3])
    after = trials.signal_dn * np.exp(trials.contrast)
    for name, power in law.items():
        for k, polarity in enumerate((1, -1)):
            chance = likelihood.chances(values, trials, polarity, grids[k], name)
            np.testing.assert_allclose(chance, np.moveaxis(own / (1 - other[0] - other[1]), 0, 1))
            _, _, step, noise, *_ = given.pop()
            np.testing.assert_allclose(
                step[:, 0], polarity * np.log((1 + 0.07 * after) / (1 + 0.07 * trials.signal_dn))
            )
            for sigma, light in zip(noise, (trials.signal_dn, after), strict=True):
                variance = (0.003 * light**power + 0.0021) / (1 + 0.07 * light) ** 2
                np.testing.assert_allclose(sigma[:, 0] ** 2, variance + (1e-3 * 0.2) ** 2)
    weight = np.array([[0.2, 0.5, 0.3], [0.0, 0.9, 0.1]])
    monkeypatch.setattr(trials_analysis, "TrialCounts", SimpleNamespace(of=lambda sets, polarity: polarity))
    some = SimpleNamespace(calm=np.zeros((2, 2)), of=lambda which: which)
    fit = SimpleNamespace(
        values=values, likelihood=SimpleNamespace(grids=grids), law_given=lambda polarity: weight[::polarity]
    )
    for k, polarity in enumerate((1, -1)):
        relative = grids[k] / (0.2, 0.31)[k]
        mean, spread = trials_analysis._pixel_thresholds(fit, some, some, polarity)
        np.testing.assert_allclose(mean, weight[::polarity] @ relative, rtol=1e-6)
        wanted = np.sqrt(weight[::polarity] @ relative**2 - (weight[::polarity] @ relative) ** 2)
        np.testing.assert_allclose(spread, wanted, rtol=1e-4)


def test_noise_passes_a_level_at_the_rate_of_its_crossings_and_their_clumps():
    """Rice's rate at two equal poles times κ, ln κ a polynomial from −1.5 to 6, a line below, even above."""
    h = np.array([-4.0, -2.0, -1.0, 0.0, 0.7, 2.5, 4.5, 6.0, 7.5])
    inside = np.clip(h, -1.5, 6.0)
    kappa = sum(factor * inside ** (7 - k) for k, factor in enumerate(likelihood._LOG_KAPPA))
    kappa += -2.112 * np.minimum(h + 1.5, 0)
    crossings = np.exp(-(h**2) / 2) / np.sqrt(np.sqrt(2) - 1)
    np.testing.assert_allclose(likelihood.passage_rate(h), crossings * np.exp(kappa), rtol=1e-9)
    # of lines between nodes 1/16 of a period apart, far up: the chance of being below at one and above at the next.
    # The variance of a line is (2 + ρ)/3 of that of its nodes on the average
    step = 2 * np.pi / 16 / np.sqrt(np.sqrt(2) - 1)
    rho = (1 + step) * np.exp(-step)
    for level in (4.0, 5.0):
        node = level * np.sqrt((2 + rho) / 3)
        both = multivariate_normal.cdf([-node, -node], cov=[[1, rho], [rho, 1]])
        assert likelihood.passage_rate(np.array(level)) == pytest.approx(16 * (norm.sf(node) - both), rel=0.02)


def test_counts_of_trials_have_the_likelihood_of_their_outcomes(monkeypatch):
    """Each event has the chance of its kind and bin, each silent trial that of none; a posterior adds up to 1."""
    rng, grid = np.random.default_rng(4), np.array([0.15, 0.2, 0.25, 0.3])
    tables = {"a": rng.uniform(0.05, 0.3, (2, 3, 4)), "b": rng.uniform(0.05, 0.4, (1, 2, 4))}
    monkeypatch.setattr(likelihood, "chances", lambda values, trials, polarity, grid, law: tables[trials])
    events, silent = rng.integers(0, 9, (5, 8)).astype(float), rng.integers(0, 40, (5, 3)).astype(float)
    counts = likelihood.TrialCounts(-1, ["a", "b"], events, silent)
    found = counts.log_likelihood(None, grid, "sqrt")
    wanted = np.zeros((5, 4))
    for pixel in range(5):
        column = 0
        for number, chance in enumerate([*tables["a"], *tables["b"]]):
            for of_bin in chance:
                wanted[pixel] += events[pixel, column] * np.log(of_bin)
                column += 1
            wanted[pixel] += silent[pixel, number] * np.log(1 - chance.sum(axis=0))
    np.testing.assert_allclose(found, wanted)
    values = np.full(9, 0.4)
    values[likelihood.THETA[1]], values[likelihood.MISMATCH[1]] = 0.22, 0.17
    spread = np.hypot(0.17, 0.05 / 0.22)  # no narrower than a step of the grid
    prior = np.exp(-0.5 * ((grid / 0.22 - 1) / spread) ** 2)
    fit = trials_fit.Fit("sqrt", values, None, None, None, SimpleNamespace(grids=(None, grid)), 0.0)
    posterior = np.exp(wanted - wanted.max(axis=1, keepdims=True)) * prior
    np.testing.assert_allclose(fit.law_given(counts), posterior / posterior.sum(axis=1, keepdims=True))
    np.testing.assert_allclose(fit.law_of_thresholds(1), prior / prior.sum())


def test_sums_of_steps_give_the_variance_of_totals_and_the_noise_in_the_width(monkeypatch):
    """Of good pixels, but for a group; the noise is what both widths have beyond the spread of their thresholds."""
    rng, shape, trials = np.random.default_rng(7), (12, 15), 300
    group, good = rng.integers(0, GROUPS, shape), rng.random(shape) < 0.8
    totals = {"on_total": rng.integers(200, 400, shape), "off_total": rng.integers(100, 500, shape)}
    pixels = np.bincount(group[good], minlength=GROUPS).astype(float)
    on, off = rng.uniform(5, 60, (2, 4, GROUPS))
    steps = SimpleNamespace(on=on, off=off, pixels=pixels, group=group, **totals)
    step, asked = np.array([-0.3, -0.1, 0.2, 0.4]), []
    monkeypatch.setattr(
        thresholds, "_fit_curves", lambda *given: asked.append(given) or np.array([0.2, 0.3, 0.1, 0.15])
    )
    monkeypatch.setattr(thresholds, "_mismatch_square", lambda *given: asked.append(given) or 0.02 * len(asked))
    sums = thresholds._Sums.of(steps, good)
    for one, left in ((sums, good), (sums.without(3), good & (group != 3))):
        asked.clear()
        found = one.fit(step, trials, None)
        keep = np.arange(GROUPS) != 3 if one is not sums else np.ones(GROUPS, bool)
        rates, at, count, start = asked[0]
        assert at is step and count == left.sum() * trials and start is None
        np.testing.assert_allclose(rates, [each[:, keep].sum(axis=1) / count for each in (on, off)])
        for k, (sign, name) in enumerate(((1, "on_total"), (-1, "off_total"))):
            theta, width, slope, signed, variance, number = asked[1 + k]
            assert (theta, width, slope, number) == ((0.2, 0.3)[k], 0.1, sign * 0.15, trials)
            np.testing.assert_array_equal(signed, sign * step)
            assert variance == pytest.approx(totals[name][left].var(ddof=1))
        noise = np.sqrt(((0.1 * 1.15) ** 2 - 0.04 * 0.2**2 + (0.1 * 0.85) ** 2 - 0.06 * 0.3**2) / 2)
        np.testing.assert_allclose(found, [0.2, 0.3, 0.1, 0.15, 0.04, 0.06, noise])


@pytest.mark.parametrize("squares", [(0.012, 0.03), (0.0005, 0.03), (0.0002, 0.0003)])
def test_a_mismatch_counts_beyond_errors_of_both_polarities_together(monkeypatch, squares):
    """Jackknife over the groups that have pixels: (n − 1)/n Σ of squares; each polarity where both together show."""
    rng = np.random.default_rng(3)
    values = np.array([0.2, 0.3, 0.1, 0.05, *squares, 0.07])
    left = values + rng.normal(size=(GROUPS, 7)) * [3e-3, 4e-3, 1e-3, 2e-3, 2e-4, 6e-4, 5e-4]
    pixels = np.where(np.arange(GROUPS) == 5, 0.0, 30.0)

    def of(steps, good):
        return SimpleNamespace(
            pixels=pixels, fit=lambda step, trials: values,
            without=lambda k: SimpleNamespace(fit=lambda step, trials, start: left[k]),
        )  # fmt: skip

    def of_pixel(start, sign, signed, total, trials, m):
        return (np.array([sign * signed[0], m]), total)

    monkeypatch.setattr(thresholds, "_Sums", SimpleNamespace(of=of))
    monkeypatch.setattr(thresholds, "_of_pixel", of_pixel)
    steps = SimpleNamespace(trials=40, on_total="on", off_total="off")
    found = thresholds.fit_thresholds(steps, np.array([0.4, 0.5]), None)
    kept = left[pixels > 0]
    n = len(kept)
    covariance = (n - 1) / n * (kept - kept.mean(axis=0)).T @ (kept - kept.mean(axis=0))
    error = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.covariance, covariance[:4, :4])
    assert found.theta == pytest.approx(0.25)
    assert found.theta_error == pytest.approx(np.sqrt([0.5, 0.5] @ covariance[:2, :2] @ [0.5, 0.5]))
    both, both_error = np.mean(squares), np.sqrt([0.5, 0.5] @ covariance[4:6, 4:6] @ [0.5, 0.5])
    shows = both > thresholds._SIGMAS * both_error
    assert shows == (squares[1] > 0.01)
    own = [np.sqrt(v) if shows and v > thresholds._SIGMAS * e else 0 for v, e in zip(squares, error[4:6], strict=True)]
    assert (own[0] > 0) == (squares[0] > 0.01)
    assert (found.mismatch_on, found.mismatch_off) == pytest.approx(own)
    assert found.spread.value == pytest.approx(np.sqrt(both) if shows else 0)
    assert found.spread.error == pytest.approx(both_error / (2 * np.sqrt(both)) if shows else np.nan, nan_ok=True)
    assert found.spread.limit == pytest.approx(np.sqrt(both + 2 * both_error)) and found.spread.groups == GROUPS
    assert found.noise == pytest.approx((0.07, error[6]))
    np.testing.assert_allclose([found.pixel_on, found.pixel_off], [[0.4, own[0]], [0.4, own[1]]])
    assert (found.noise_on, found.noise_off) == ("on", "off")


def test_first_events_are_means_over_the_noise_at_the_reset():
    """A trapezoid rule over that noise. Calm trials count by their chance to be so while settling, but for the first
    0.15 of a period, in which the noise stays. What lies beyond a threshold after the step passes with it.
    """
    theta, other, step, cutoff, settle, leak = 0.3, 0.36, 0.11, 40.0, 0.009, (2.0, 3.0)
    before, after, edges = 0.17, 0.2, np.array([0.0, 0.004, 0.02])
    z = np.linspace(-8, 8, 4001)
    h = 2 * np.pi * cutoff * settle / np.sqrt(np.sqrt(2) - 1)
    rho = (1 + h) * np.exp(-h)
    fresh = np.sqrt(1 - rho**2)

    def rate(level):
        return cutoff * likelihood.passage_rate(level)

    high, low = theta / before + z, other / before - z
    weight = norm.pdf(z) * np.exp(-(rate(high) + rate(low) + 5.0) * (settle - 0.15 / cutoff))
    up, down = (theta - step + before * z) / after, (other + step - before * z) / after
    calm = norm.cdf(high, rho * z, fresh) - norm.cdf(-low, rho * z, fresh)
    first = np.maximum(norm.cdf(high, rho * z, fresh) - norm.cdf(up, rho * z, fresh), 0) / calm
    first_other = np.maximum(norm.cdf(-down, rho * z, fresh) - norm.cdf(-low, rho * z, fresh), 0) / calm
    own, others = rate(up) + leak[0], rate(down) + leak[1]
    found = likelihood.first_event(theta, other, step, (before, after), cutoff, settle, edges, leak)
    for k, (at_once, mine) in enumerate(((first, own), (first_other, others))):
        for j in range(2):
            left = (1 - first - first_other) * (
                np.exp(-(own + others) * edges[j]) - np.exp(-(own + others) * edges[j + 1])
            )
            chance = (at_once if j == 0 else 0.0) + left * mine / (own + others)
            assert found[k][j] == pytest.approx(np.sum(weight * chance) / weight.sum(), rel=2e-3)

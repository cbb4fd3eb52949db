"""Lines of the calibration against closed forms of their own, without captures: each fails if its line is changed.

Inputs are exact expectations, so that answers are exact as well, where no seed is named.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import betainc, gammaincc, log_ndtr, logsumexp, ndtr
from scipy.stats import norm

import hesim_render as hr
from hesim_render.calibrate.aps import checks as frame_checks
from hesim_render.calibrate.aps import photon_transfer, variance
from hesim_render.calibrate.aps.common_mode import Shared
from hesim_render.calibrate.aps.composite import Composite, signal_at_event_pixels
from hesim_render.calibrate.aps.dark import fit_dark
from hesim_render.calibrate.aps.photon_transfer import _read_noise, linearity, system_gain
from hesim_render.calibrate.aps.variance import Pooled, fit_variance, join, pool
from hesim_render.calibrate.asynchronous import defects as asynchronous_defects
from hesim_render.calibrate.asynchronous.likelihood import correlation
from hesim_render.calibrate.asynchronous.trials import Parts
from hesim_render.calibrate.estimate import Spread, estimated
from hesim_render.calibrate.evs import checks as event_checks
from hesim_render.calibrate.evs import counts, dispersion
from hesim_render.calibrate.evs import fitted as fitted_events
from hesim_render.calibrate.evs import model as event_goodness
from hesim_render.calibrate.evs.analysis import _with_conversion_error, step_in_ln
from hesim_render.calibrate.evs.cells import PixelThresholds, pool_events
from hesim_render.calibrate.evs.checks import curve_levels
from hesim_render.calibrate.evs.counts import StaticCapture
from hesim_render.calibrate.evs.defects import bad_event_pixels, bad_in_steps
from hesim_render.calibrate.evs.defects import classify as classify_event_defects
from hesim_render.calibrate.evs.fitted import fit_events
from hesim_render.calibrate.evs.medians import middle_and_spread
from hesim_render.calibrate.evs.model import from_natural, natural
from hesim_render.calibrate.evs.output import _gauge
from hesim_render.calibrate.evs.steps import GROUPS, Steps
from hesim_render.calibrate.evs.thresholds import Thresholds, curve
from hesim_render.calibrate.flicker import dynamics
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError

BETA = np.array([4.0, 0.3, 20.0, 2e-5, 0.05, 30.0])  # 1, I, t, I², I t, t²
FRAMES, TAU = 16, 6.0


def variance_of(signal, seconds):
    terms = np.array(
        [np.ones_like(signal), signal, 0 * signal + seconds, signal**2, signal * seconds, 0 * signal + seconds**2]
    )
    return BETA @ terms


def pooled(seconds, tau, lit=True, pixels=1000.0, signals=None):
    """Bins as very many pixels would fill them, whose signals are estimated with Gaussian errors of std `tau`.

    The mean of Îᵏ over the errors is a quadrature that is exact up to k = 19.
    """
    signal = np.linspace(10, 600, 40) if signals is None else np.asarray(signals, float)
    nodes, weights = np.polynomial.hermite_e.hermegauss(10)
    seen = signal[:, None] + tau * nodes
    weights = weights / weights.sum()
    powers = np.stack([pixels * (seen**k @ weights) for k in range(7)], axis=1)
    y = variance_of(signal, seconds)
    full = np.ones(signal.size)
    return Pooled(
        seconds * full, tau**2 * full, powers, y[:, None] * powers[:, :4], pixels * y**2, 0 * full, (FRAMES - 1) * full,
        np.full(signal.size, lit),
    )  # fmt: skip


@pytest.mark.parametrize("tau", [0.0, TAU, 40.0])
def test_variance_polynomial_is_exact_however_noisy_the_signals_are(tau):
    """Errors in variables: noise of the signals inflates Σ I² by τ², and Σ I³ and Σ I⁴ accordingly."""
    found = fit_variance(join([pooled(seconds, tau) for seconds in (0.01, 0.05, 0.2)]))
    np.testing.assert_allclose(found.beta, BETA, rtol=1e-6, atol=1e-12)
    assert found.identified.all() and found.quantised_pixels == 0


@pytest.mark.parametrize(("alike", "kept"), [
    (None, [1, 1, 1, 1, 1, 1]), ((5, 2), [1, 1, 1, 1, 1, 0]), ((4, 1), [1, 1, 1, 1, 0, 0]),
    ((3, 0), [1, 1, 1, 0, 0, 0]), ((1, 0), [1, 0, 0, 0, 0, 0]),
])  # fmt: skip
def test_terms_are_kept_whatever_their_units_and_left_out_in_their_order(alike, kept):
    """Two columns of the design that are one: terms go from t² on, until the rest is independent."""
    design = np.random.default_rng(3).standard_normal((400, 6))
    if alike is not None:
        design[:, alike[0]] = design[:, alike[1]]
    design *= 10.0 ** np.array([0, -9, 4, -14, 7, 12])
    assert variance._identifiable(design.T @ design, []).tolist() == np.array(kept, bool).tolist()
    without = np.array(kept, bool)
    without[2] = False
    assert variance._identifiable(design.T @ design, [2]).tolist()[:3] == without.tolist()[:3]


@pytest.mark.parametrize("more", [0.99, 1.0, 1.01])
def test_goodness_of_the_variance_fit(more):
    """Sample variances that scatter `more` times as much as 2 V²/(n − 1): χ² and its chance, written out.

    χ² of N squares of variance 2 + 12/(n − 1) each is normal; a Poisson count of gain K has the fourth cumulant K²
    times its variance, which adds that over n to each square.
    """
    parts = []
    for seconds in (0.01, 0.05, 0.2):
        bins = pooled(seconds, 0.0)
        y = bins.variance_dn2
        parts.append(replace(bins, squares=bins.pixels * (y**2 + more * 2 * (y + 1 / 12) ** 2 / (FRAMES - 1))))
    bins = join(parts)
    found = fit_variance(bins)
    y, count = bins.variance_dn2, bins.pixels.sum()
    assert found.dof == count - 6
    assert found.chi2_per_dof == pytest.approx(more * count / (count - 6), rel=1e-9)
    cumulant = BETA[1] ** 2 * (y - BETA[0]) / FRAMES
    expected = 1 + np.mean(cumulant * (FRAMES - 1) / (2 * (y + 1 / 12) ** 2))
    assert found.expected_chi2 == pytest.approx(expected, rel=1e-6)
    deviation = (found.chi2_per_dof / expected - 1) * np.sqrt((count - 6) / (2 + 12 / (FRAMES - 1)))
    assert found.p_value == pytest.approx(ndtr(-deviation), rel=1e-4, abs=0)


@pytest.mark.parametrize(("chi2", "chance", "seen"), [(2.098, 1e-30, False), (2.102, 1e-30, True), (2.102, 0.5, False)])
def test_variances_scatter_too_much_from_a_twentieth_on(chi2, chance, seen):
    """χ² of 2 is expected: 5 % more is 2.1; of four positions the chance of any counts."""
    good = SimpleNamespace(chi2_per_dof=2.0, expected_chi2=2.0, p_value=0.3)
    wide = SimpleNamespace(chi2_per_dof=chi2, expected_chi2=2.0, p_value=chance)
    told = frame_checks._scatter(SimpleNamespace(fits={(0, 0): good, (0, 1): good, (1, 0): wide, (1, 1): good}))
    assert (told is not None) is seen
    if told is not None:
        assert "χ²/dof 2.102 at position (1, 0)" in told.text and told.p_value == pytest.approx(4e-30, rel=1e-6, abs=0)


def test_of_several_positions_that_scatter_the_least_likely_is_named():
    """Not the one of the largest χ²: its count of pixels may be small."""
    chances = {(0, 0): (2.9, 1e-12), (0, 1): (2.2, 1e-30), (1, 1): (2.5, 1e-20), (1, 2): (2.0, 0.3)}
    fits = {p: SimpleNamespace(chi2_per_dof=c, expected_chi2=2.0, p_value=v) for p, (c, v) in chances.items()}
    told = frame_checks._scatter(SimpleNamespace(fits=fits))
    assert "2.200 at position (0, 1)" in told.text and told.p_value == pytest.approx(4e-30, rel=1e-6, abs=0)


def of_frames(cubic=None):
    """A calibration with a dark variance of 4 − 1/12 DN², and known errors of β0 and β3."""
    bins = SimpleNamespace(
        variance_dn2=np.array([4 - 1 / 12, 30.0, 81.0]), lit=np.array([False, True, True]),
        signal_dn=np.array([0.0, 100.0, 300.0]), exposure_s=np.array([0.01, 0.02, 0.03]),
    )  # fmt: skip
    fit = SimpleNamespace(
        covariance=np.diag([0.0036, 0, 0, 1e-6, 0, 0]), identified=np.array([True] * 6), beta=BETA, cubic=cubic
    )
    return SimpleNamespace(bins={(0, 1): bins}, fits={(0, 1): fit}, rows=Shared(0.49, 0.1, 8.0, 1e-9))


@pytest.mark.parametrize(("part", "seen"), [(0.99, False), (1.01, True)])
def test_findings_of_frames_begin_at_their_limits_and_have_their_figures(part, seen):
    """Each just below and just above the size from which it matters, with its numbers in DN, ms and per cent."""
    given = of_frames()
    still = Shared(1e-9, 1e-9, 0.1, 0.5)

    def drift(black, light):
        return [
            SimpleNamespace(exposure_us=2500, black=still, black_range_dn=0.0, light=still, light_range=0.0),
            SimpleNamespace(exposure_us=7500, black=black, black_range_dn=0.71, light=light, light_range=0.034),
        ]

    # a thousandth of the dark variance, or half of the error of β0, 0.03: the first is less
    moved = Shared(0.004 * part, 1e-4, 40.0, 3e-5)
    told = frame_checks._black(given, drift(moved, still), "black level, dark")
    assert (told is not None) is seen
    if told is not None:
        assert f"by {np.sqrt(0.00404):.3g} DN rms (0.71 DN from lowest" in told.text and "frames of 7.5 ms" in told.text
        assert told.p_value == pytest.approx(6e-5)
    # a thousandth of the largest variance over the square of the largest signal, 9e-7; half of the error of β3 is 5e-4
    told = frame_checks._light(given, drift(still, Shared(9e-7 * part, 1e-8, 40.0, 3e-5)))
    assert (told is not None) is seen
    if told is not None:
        rms = 100 * np.sqrt(9.09e-7)
        assert f"by {rms:.3g} % rms (3.4 % from lowest" in told.text and "frames of 7.5 ms" in told.text
    assert frame_checks._black(given, drift(Shared(1.0, 1e-4, 40.0, 6e-5), still), "b") is None  # of two exposures
    # a twentieth of the dark noise, 2 DN; 0.3 % of the signal
    moved = [frame_checks.Proportion(1500, 0.01, 0.1, -1e-4, 1e-3)]
    moved.append(frame_checks.Proportion(4500, -0.1 * part, 1e-3, 3e-3 * part, 1e-5))
    for told, text in (
        (frame_checks._shift(given, moved), "are -0.101 DN off"), (frame_checks._deviation(moved), "by +0.303 %"),
    ):  # fmt: skip
        assert (told is not None) is seen
        assert told is None or (text in told.text and "at 4.5 ms" in told.text)
    assert frame_checks._deviation(moved[1:]) is None
    assert "together by 0.7 DN rms" in frame_checks._rows(given).text


def test_a_bend_of_the_variance_is_told_in_parts_of_the_brightest():
    told = frame_checks._curvature(of_frames(cubic=(-3e-8, 5e-9)))
    share = -3e-8 * 300**3 / (BETA @ [1, 300, 0.03, 300**2, 300 * 0.03, 0.03**2])
    assert f"is -3e-08 ± 5e-09 DN⁻¹, {100 * share:+.2g} % of" in told.text
    assert told.p_value == pytest.approx(2 * norm.sf(6), rel=1e-6, abs=0)
    assert frame_checks._curvature(of_frames(cubic=(-3e-8, 1e-8))) is None  # three errors
    assert frame_checks._curvature(of_frames()) is None
    # of two positions the one that is more errors off is named; χ² of two degrees of freedom is exponential
    one, two = of_frames(cubic=(1e-8, 1e-8)), of_frames(cubic=(-3e-8, 5e-9))
    both = SimpleNamespace(
        bins={(0, 0): one.bins[0, 1], (1, 0): two.bins[0, 1]}, fits={(0, 0): one.fits[0, 1], (1, 0): two.fits[0, 1]}
    )
    told = frame_checks._curvature(both)
    assert "at position (1, 0) a term in I³ is -3e-08" in told.text
    assert told.p_value == pytest.approx(np.exp(-37 / 2), rel=1e-6, abs=0)


def test_dark_current_is_the_mean_of_good_pixels():
    rates = np.array([[60.0, 64.0, 900.0], [68.0, 72.0, 0.0]])
    none = np.zeros((2, 3), bool)
    bad, hot = none.copy(), none.copy()
    hot[0, 2], bad[1, 2] = True, True
    found = photon_transfer._dark_current(SimpleNamespace(n_dp=rates, bad=bad, hot=hot), {}, 0.4, 0.03)
    assert found["value"] == pytest.approx(66 / 0.4)
    assert found["standard_error"] == pytest.approx(np.hypot(np.sqrt(20 / 4) / 0.4, 66 / 0.4 * 0.03))


def test_read_noise_is_the_root_of_the_mean_variance_with_its_error():
    """σ = √β0: an error e of β0 is e/2σ of σ; of two positions the mean has half the root of the sum."""
    fits = {
        (0, k): SimpleNamespace(beta=np.array([value, 0]), covariance=np.diag([error**2, 0]), identified=[True])
        for k, (value, error) in enumerate([(8.0, 0.4), (10.0, 0.3)])
    }
    told = _read_noise(fits, 0.5, 0.02)
    assert told["value_dn"] == 3.0 and told["value"] == 6.0
    assert told["standard_error"] == pytest.approx(6.0 * np.hypot(0.5 / 2 / (2 * 3.0) / 3.0, 0.02))


def test_linearity_is_the_deviation_of_each_exposure_from_proportionality():
    rate = np.full((10, 10), 1000.0)
    exposures = np.array([0.01, 0.1, 0.5, 0.8, 2.0])  # 1 % and 200 % of the range do not count
    signals = rate * exposures[:, None, None] * np.array([3, 1.01, 0.98, 1.0, 0.5])[:, None, None]
    lit = SimpleNamespace(exposures_s=exposures, exposures_us=np.rint(1e6 * exposures))
    told = linearity(lit, signals, np.ones(signals.shape, bool), SimpleNamespace(rate_dn_per_s=rate), 1000.0)
    assert told["largest"] == pytest.approx(2.0) and told["value"] == pytest.approx((1 + 2 + 0) / 3)
    assert told["per_exposure"] == pytest.approx({100_000: 1.0, 500_000: -2.0, 800_000: 0.0}, abs=1e-9)


def test_error_of_a_signal_is_that_of_a_mean_over_the_frames():
    """τ² = (V + V_row)/n + variance of the dark line, V with the ADC's 1/12 in it."""
    signal = np.full(500, 100.0)
    for lit in (True, False):
        bins = pool(signal, np.full(500, 8.0), 0.01, 0.25, FRAMES, lit, row_variance=0.5)
        np.testing.assert_allclose(bins.noise, (8.0 + 0.5) / FRAMES + 0.25 if lit else 0.0)
        np.testing.assert_allclose(bins.variance_dn2, 8.0 - 1 / 12)
    # the sample variance of n values scatters by 2 V²/(n − 1); row noise taken out leaves 4 V R/(n − 1) more
    np.testing.assert_allclose(1 / bins.weight(np.array([8.0])), 2 * (64 + 2 * 8.0 * 0.5) / (FRAMES - 1))


@pytest.mark.parametrize("tau", [0.0, 20.0])
def test_system_gain_is_exact_however_noisy_the_signals_are(tau, monkeypatch):
    """K of a sensor with lit − dark variance K·I exactly; without the correction K is 0.3 % too small at τ = 20."""
    monkeypatch.setitem(globals(), "BETA", np.array([4.0, 0.3, 20.0, 0, 0, 0]))
    times = (0.01, 0.05)
    bins = join([pooled(t, tau) for t in times] + [pooled(t, 0.0, lit=False, signals=[0.0]) for t in times])
    gain, _ = system_gain(bins, top_dn=700.0)
    assert gain == pytest.approx(0.3, rel=1e-9)
    assert system_gain(bins, top_dn=300.0)[0] == pytest.approx(0.3, rel=1e-9)
    assert np.isnan(system_gain(bins, top_dn=-1.0)[0])
    # lit variances, each with 2 V²/(n − 1) of its own, and that of the dark, which all lit bins of a time share
    lit, dark = (bins.lit == which for which in (True, False))
    signal = bins.powers[lit, 1] / bins.powers[lit, 0]
    shared = bins.variance_dn2[dark]
    expected = np.repeat(shared, lit.sum() // 2) + 0.3 * signal
    weight = (FRAMES - 1) / (2 * expected**2)
    x2 = bins.powers[lit, 2] - tau**2 * bins.powers[lit, 0]
    bottom = np.sum(weight * x2)
    of_dark = [np.sum((weight * bins.powers[lit, 1])[bins.exposure_s[lit] == t]) for t in times]
    dark_variance = 2 * shared**2 / ((FRAMES - 1) * bins.pixels[dark])
    error = np.sqrt(bottom + np.sum(np.square(of_dark) * dark_variance)) / bottom
    assert system_gain(bins, top_dn=700.0)[1] == pytest.approx(error, rel=1e-9)


def test_prnu_is_the_spread_of_good_pixels_at_each_position_of_the_tile():
    """Two positions of different rates and spreads; pixels that are bad, hot or without a rate have absurd ones."""
    rng, spread, noise = np.random.default_rng(9), (0.03, 0.017), 0.011
    rate, error = np.empty((36, 25)), np.full((36, 25), np.nan)
    for row, level in enumerate((730.0, 210.0)):
        values = rng.standard_normal((18, 25))
        values.flat[:3] = 0  # the three that do not count
        rest = values.ravel()[3:]
        rest -= rest.mean()
        values.ravel()[3:] = rest / rest.std()
        rate[row::2] = level * (1 + np.hypot(spread[row], noise) * values)
        error[row::2] = level * noise
        rate[row::2].flat[:3] = rate[row, :3] = np.nan, 9e4, -7e4
    bad, hot = np.zeros((2, 36, 25), bool)
    bad[:2, 1] = hot[:2, 2] = True
    dark, spec = SimpleNamespace(bad=bad, hot=hot), SimpleNamespace(tile_rows=2, tile_cols=1)
    found = photon_transfer._prnu(Composite(rate, error), dark, spec)
    assert found["value"] == pytest.approx(100 * np.sqrt(np.mean(np.square(spread))), rel=1e-6)
    total = np.square(spread) + noise**2
    scatter = np.sqrt(np.sum(2 * total**2 / (18 * 25 - 3))) / 2
    expected = 100 * scatter / (2 * np.sqrt(np.mean(np.square(spread))))
    assert found["standard_error"] == pytest.approx(expected, rel=1e-6)


# ---- thresholds ---------------------------------------------------------------------------------


def thresholds(covariance=None, mismatch=0.0, size=(20, 20)):
    one = np.ones(size, np.float32)
    return Thresholds(
        theta_on=0.2, theta_off=0.25, width=0.05, slope=0.0,
        covariance=np.zeros((4, 4)) if covariance is None else covariance,
        spread=Spread(mismatch, 0.0, 0.0), mismatch_on=mismatch, mismatch_off=mismatch, noise=(0.05, 0.0),
        pixel_on=one, pixel_off=one, noise_on=0 * one, noise_off=0 * one, step=np.linspace(-0.5, 0.5, 11),
    )  # fmt: skip


def test_error_of_the_mean_threshold_has_the_covariance_of_both():
    """var((θ₊ + θ₋)/2) = (var θ₊ + var θ₋ + 2 cov)/4; with the covariance's other sign it would be half as large."""
    covariance = np.diag([4e-6, 9e-6, 1.0, 1.0])
    covariance[0, 1] = covariance[1, 0] = 3e-6
    found = thresholds(covariance)
    assert found.theta == pytest.approx(0.225) and found.theta_error == pytest.approx(np.sqrt(19e-6) / 2)


def test_error_of_the_conversion_to_voltage_is_that_of_finite_differences():
    """Contrasts of the signal become S = ln x₁/x₀ by A/B: its error moves θ₊ and θ₋ together, as both steps shrink."""
    a, b, signal = 0.7, 12.0, 40.0
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [[0.02**2, 0.6 * 0.02 * 0.5], [0.6 * 0.02 * 0.5, 0.5**2]]
    captures = SimpleNamespace(spec=SimpleNamespace(contrast_of="signal"))

    def steps(a, b, contrast):
        fit = SimpleNamespace(values=np.array([a, b, 0, 0, 0, 0]), identified=lambda name: True)
        return step_in_ln(captures, SimpleNamespace(contrast=contrast, signal_dn=signal), fit)

    # contrasts at which S is θ₊ and −θ₋
    goals = np.array([0.2, -0.25])
    contrast = np.log((np.exp(goals) * (a * signal + b) - b) / (a * signal))
    np.testing.assert_allclose(steps(a, b, contrast), goals, rtol=1e-12)
    h = 1e-6
    jacobian = np.stack(
        [
            (steps(a * (1 + h), b, contrast) - steps(a * (1 - h), b, contrast)) / (2 * h * a),
            (steps(a, b * (1 + h), contrast) - steps(a, b * (1 - h), contrast)) / (2 * h * b),
        ],
        axis=1,
    )
    jacobian[1] *= -1  # θ₋ is −S
    fit = SimpleNamespace(values=np.array([a, b, 0, 0, 0, 0]), covariance=covariance)
    found = _with_conversion_error(thresholds(), signal, fit).covariance
    np.testing.assert_allclose(found[:2, :2], jacobian @ covariance[:2, :2] @ jacobian.T, rtol=1e-6)
    assert found[0, 1] > 0 and not found[2:].any()


def test_errors_of_the_gauge_are_those_of_finite_differences():
    """β0 … β5 from (A, B, C, D, θ) and their errors, all correlated but θ's."""
    values = np.array([0.7, 12.0, 0.03, -0.2, 0.0, 0.0])
    root = np.array([[0.02, 0, 0, 0], [0.3, 0.4, 0, 0], [0.001, -0.002, 0.003, 0], [0.02, 0.03, -0.01, 0.05]])
    covariance = np.zeros((6, 6))
    covariance[:4, :4] = root @ root.T
    both = np.diag([4e-6, 9e-6, 0, 0])
    both[0, 1] = both[1, 0] = 3e-6
    theta_v, found = 0.75e-3, thresholds(both)
    fit = SimpleNamespace(values=values, covariance=covariance, identified=lambda name: True)
    told = _gauge(SimpleNamespace(thresholds=found, theta_v=theta_v, fits=[fit]))

    def beta(p):
        a, b, c, d, t0 = p
        return np.array([t0, a / b, 1.0, c * t0 / b, t0 / b, d])

    at = np.array([*values[:4], found.theta / theta_v])
    steps = 1e-6 * np.abs(at)
    jacobian = np.stack([(beta(at + h) - beta(at - h)) / (2 * h.sum()) for h in np.diag(steps)], axis=1)
    whole = np.zeros((5, 5))
    whole[:4, :4], whole[4, 4] = covariance[:4, :4], (4e-6 + 9e-6 + 6e-6) / 4 / theta_v**2
    np.testing.assert_allclose(told["beta"][0], beta(at), rtol=1e-12)
    expected = np.sqrt(np.diag(jacobian @ whole @ jacobian.T))
    (errors,) = (value for name, value in told.items() if name != "beta" and isinstance(value, list))
    np.testing.assert_allclose(errors[0], expected, rtol=1e-5, atol=1e-12)


def test_natural_parameters_and_their_covariance():
    parameters = np.array([0.7, np.log(12.0), 8e-4, -6e-3, 0.02, 1e-4])
    root = np.tril(0.1 * np.abs(parameters)[:, None] * np.cos(np.arange(36).reshape(6, 6)))
    covariance = root @ root.T
    values, found = natural(parameters, covariance)
    c = np.sqrt(8e-4 + 36e-6)
    np.testing.assert_allclose(values, [0.7, 12.0, c, -6e-3 / c, 0.02, 1e-4], rtol=1e-12)
    np.testing.assert_allclose(from_natural(values), parameters, rtol=1e-12)
    steps = np.diag(1e-6 * np.abs(parameters))
    jacobian = np.stack(
        [
            (natural(parameters + h, covariance)[0] - natural(parameters - h, covariance)[0]) / (2 * h.sum())
            for h in np.abs(steps)
        ],
        axis=1,
    )
    np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, rtol=1e-5, atol=1e-16)


# ---- bad event pixels ---------------------------------------------------------------------------

TRIALS = 200_000


def lone_pixel(count, usual, shape=(24, 24)):
    """A capture whose pixels all have the same counts, but one."""
    on = np.full(shape, usual)
    on[5, 7] = count
    return StaticCapture(np.full(shape, 50.0), on, on.copy(), None, None, TRIALS, (1, 1))


@pytest.mark.parametrize("fires", ["too little", "too often"])
def test_a_pixel_is_bad_beyond_a_tail_of_1e_7_about_thresholds_six_per_cent_away(fires):
    """The binomial tail by the incomplete beta function: P(X ≤ k) = I_{1−p}(n − k, k + 1).

    All pixels are alike, so the reach is its least, 6 %. The median count is known to half of one: counts 3 % on either
    side of the limit are decided.
    """
    usual = 4000
    u = -_quantile(usual / TRIALS)
    if fires == "too little":
        p = ndtr(-1.06 * u)
        limit = brentq(lambda k: np.log(betainc(TRIALS - k, k + 1, 1 - p)) - np.log(1e-7), 2000, TRIALS * p)
        bad, good = 0.97 * limit, 1.03 * limit
        assert good < usual
    else:
        p = ndtr(-0.94 * u)
        limit = brentq(lambda k: np.log(betainc(k, TRIALS - k + 1, p)) - np.log(1e-7), TRIALS * p, 8000)
        bad, good = 1.03 * limit, 0.97 * limit
        assert good > usual
    found = bad_event_pixels(lone_pixel(round(bad), usual))
    assert found[5, 7] and found.sum() == 1
    assert not bad_event_pixels(lone_pixel(round(good), usual)).any()


def _quantile(p):
    return brentq(lambda x: ndtr(x) - p, -9, 9, xtol=1e-14)


@pytest.mark.parametrize("polarity", ["on", "off"])
@pytest.mark.parametrize("fires", ["too little", "too often"])
def test_a_pixel_is_bad_in_steps_beyond_a_poisson_tail_of_1e_7(polarity, fires):
    """P(X ≤ k) = Γ(k + 1, λ)/Γ(k + 1), exact to the count; λ is the mean of a threshold 6 % away over all steps."""
    found, trials, size = thresholds(), 300, (20, 20)
    theta = found.theta_on if polarity == "on" else found.theta_off
    signed = found.step if polarity == "on" else -found.step

    def mean(relative):
        return trials * ndtr(-(theta * relative - signed) / found.width).sum()

    k = np.arange(5000)
    if fires == "too little":
        limit = int(k[gammaincc(k + 1, mean(1.06)) < 1e-7].max())  # the largest count that is bad
        counts = limit, limit + 1
    else:
        limit = int(k[1:][1 - gammaincc(k[1:], mean(0.94)) < 1e-7].min())  # the smallest count that is bad
        counts = limit, limit - 1
    for count, is_bad in zip(counts, (True, False), strict=True):
        totals = {"on": np.full(size, round(mean(1.0))), "off": np.full(size, 1000)}
        totals["off" if polarity == "on" else "on"][:] = round(_total(found, polarity != "on", trials))
        totals[polarity][:] = round(mean(1.0))
        totals[polarity][3, 4] = count
        steps = Steps(
            found.step, 50.0, np.zeros((11, 100)), np.zeros((11, 100)), np.zeros(100), trials,
            totals["on"], totals["off"], np.zeros(size, np.intp),
        )  # fmt: skip
        bad = bad_in_steps(steps, found, np.ones(size, bool))
        assert bad[3, 4] == is_bad and bad.sum() == is_bad


def _total(found, on, trials):
    theta, sign = (found.theta_on, 1) if on else (found.theta_off, -1)
    return trials * ndtr(-(theta - sign * found.step) / found.width).sum()


# ---- asymmetry ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "kept"), [(10.3, False), (11.4, True)])
def test_asymmetry_is_kept_from_a_likelihood_ratio_of_1e_3_on(gain, kept):
    """χ² of one degree of freedom exceeds 10.83 with a chance of 1e-3.

    Counts are exact expectations of thresholds θ(1 ∓ ρ). The best model without ρ has the mean of both probabilities to
    first order in ρ, so that 2 Δ ln L is 2 n Σ KL(p, p̄) over brightness and polarity, in closed form.
    """
    a, b, c, d = 0.02, 3.0, 0.004, 0.0
    signal = np.repeat(np.linspace(0, 200, 32), 32).reshape(32, 32)
    trials = 10**8

    def u(x):
        y = c * x
        return (a * x + b) / np.sqrt(2 * (1 + 2 * d * y + y * y))

    def ratio(rho):
        both = [ndtr(-u(signal) * (1 - sign * rho)) for sign in (1, -1)]
        mean = sum(both) / 2
        return sum(
            float(np.sum(2 * trials * (p * np.log(p / mean) + (1 - p) * np.log((1 - p) / (1 - mean))))) for p in both
        )

    rho = brentq(lambda r: ratio(r) - gain, 1e-9, 1e-2)
    on, off = (np.rint(trials * ndtr(-u(signal) * (1 - sign * rho))).astype(np.int64) for sign in (1, -1))
    static = StaticCapture(signal, on, off, None, None, trials, (1, 1))
    good = np.ones(signal.shape, bool)
    pixels = pool_events(static, good, PixelThresholds.unknown(good.shape, 0.0))
    fit = fit_events(pixels, 1.0, "linear", from_natural(np.array([a, b, c, d, 0.0, 0.0])))
    assert fit.free[4] == kept and not fit.free[5]
    if kept:
        assert fit.values[4] == pytest.approx(rho, rel=0.02)


def test_errors_of_a_poor_fit_are_those_of_the_scatter_about_it(monkeypatch):
    """From twice the expected χ² on, all variances are so many times as large; below it they stay."""
    rng, trials, shape = np.random.default_rng(4), 3000, (24, 40)
    signal = np.linspace(0, 220, 960).reshape(shape)
    y = 0.02 * signal
    u = (0.03 * signal + 2.2) / np.sqrt(2 * (1 + y * y))
    on, off = (rng.binomial(trials, ndtr(-u)) for _ in range(2))
    good = np.ones(shape, bool)
    static = StaticCapture(signal, on, off, None, None, trials, (1, 1))
    pixels = pool_events(static, good, PixelThresholds.unknown(shape, 0.0))
    start = from_natural(np.array([0.03, 2.2, 0.02, 0.0, 0.0, 0.0]))
    found = {}
    for per_dof in (1.0, 1.97, 2.03, 5.0):
        monkeypatch.setattr(fitted_events, "goodness", lambda *_, each=per_dof: event_goodness.Goodness(7 * each, 7))
        found[per_dof] = fit_events(pixels, 1.0, "linear", start).covariance
    assert found[1.0][0, 0] > 0
    for per_dof, factor in ((1.97, 1.0), (2.03, 2.03), (5.0, 5.0)):
        np.testing.assert_allclose(found[per_dof], factor * found[1.0], rtol=1e-9, atol=0)


def test_intervals_of_a_jackknife_are_as_wide_as_students_law_asks():
    """Tables of t at 97.5 %: 2.2622 with 9 degrees of freedom, 1.9842 with 99; 1.9600 of a normal law."""
    for groups, half in ((10, 2.2622), (100, 1.9842), (None, 1.9600)):
        low, high = estimated(5.0, 0.5, "", groups)["interval_95"]
        assert (low, high) == pytest.approx((5 - half / 2, 5 + half / 2), abs=5e-5)
        spread = Spread(0.15, 0.002, 0.2, groups).described()
        assert spread["interval_95"][1] == pytest.approx(0.15 + 0.002 * half, abs=1e-6)


# ---- counts in time, signals between pixels --------------------------------------------------------------


@pytest.mark.parametrize("between", [0.0, 4e-5])
def test_counts_of_a_trinomial_law_have_no_dispersion(between, monkeypatch):
    """20,000 pixels with P₊ = 0.31 and P₋ = 0.12; their probabilities may differ by a known variance, each of its own.

    The mean of 20,000 squares is known to 1 %. With the wrong sign of (P₊ − P₋)² the difference has 0.84.
    """
    trials, pixels, mean = 400, 20_000, np.array([0.31, 0.12])
    rng = np.random.default_rng(6)
    p = mean[:, None] + np.sqrt(between) * rng.standard_normal((2, pixels))
    counts = rng.multinomial(trials, np.stack([*p, 1 - p.sum(axis=0)], axis=-1))[:, :2].T
    cells = SimpleNamespace(
        trials=trials, signal_dn=np.array([30.0, 30.0]), polarity=np.array([1, -1]), spread=None, relative=None
    )
    given = SimpleNamespace(
        cells=cells, is_dark=np.array([False, False]), counts=counts, cell=np.repeat([[0], [1]], pixels, axis=1)
    )
    monkeypatch.setattr(dispersion, "log_probability", lambda *_: (np.log(mean), None))
    monkeypatch.setattr(dispersion, "threshold_over_noise", lambda *_: (np.ones(2), None))
    monkeypatch.setattr(dispersion, "probability_variance", lambda *_: np.full(2, between))
    fit = SimpleNamespace(parameters=np.zeros(5), law="linear")
    found = dispersion.dispersion_in_time(given, fit, 0.7)
    assert abs(found.total - 1) < 5 * 0.011 and abs(found.difference - 1) < 5 * 0.011
    assert 0.006 < found.total_error < 0.02 and 0.006 < found.difference_error < 0.02


def test_goodness_weighs_on_and_off_by_their_own_covariance(monkeypatch):
    """In the dark all pixels are one group: χ² = Sᵀ Q⁻¹ S, S the sum of the residuals and Q that of their products.

    Both polarities lie a little high and correlate by 0.8, which halves χ² against independent ones.
    """
    rng, trials, chance = np.random.default_rng(14), 900, {0: 0.31, 1: 0.17}
    shared = rng.normal(0, 11, 400)
    counts = np.stack([trials * chance[k] + 1.5 + shared + rng.normal(0, 5, 400) for k in (0, 1)])
    pixels = SimpleNamespace(
        is_dark=np.array([True, True]), cells=SimpleNamespace(trials=trials), single=lambda k: k, counts=counts,
        signal_dn=np.zeros(400),
    )  # fmt: skip
    monkeypatch.setattr(event_goodness, "probability", lambda _, k, *__: np.full(400, chance[k]))
    found = event_goodness.goodness(pixels, np.zeros(6), 0.7, "linear", 1)
    residual = counts - trials * np.array([[0.31], [0.17]])
    total = residual.sum(axis=1)
    assert found.chi2 == pytest.approx(total @ np.linalg.solve(residual @ residual.T, total), rel=1e-9)
    assert found.dof == 1 and found.chi2 < 0.7 * np.sum(total**2 / np.sum(residual**2, axis=1))


def test_likelihood_of_spread_thresholds_is_that_of_normal_counts(monkeypatch):
    """Of their own variances, which may differ between laws: without constants."""
    events, total, p = np.array([31.0, 40.0, 55.0]), np.array([100.0, 130.0, 150.0]), np.array([0.3, 0.33, 0.34])
    variance = np.array([25.0, 90.0, 41.0])
    cells = SimpleNamespace(events=events, total=total, relative=np.array([0.9, 1.0, 1.2]))
    monkeypatch.setattr(fitted_events, "log_probability", lambda *_: (np.log(p), None))
    monkeypatch.setattr(fitted_events, "cell_variance", lambda *_: variance)
    found = fitted_events._log_likelihood(cells, np.zeros(6), 0.7, "linear", np.ones(3))
    assert found == pytest.approx(norm.logpdf(events, total * p, np.sqrt(variance)).sum() + 1.5 * np.log(2 * np.pi))


def test_the_error_of_the_mismatch_is_that_of_scores_along_the_fitted_thresholds():
    """Where few trials tell more of a pixel's mean than of its threshold, a larger m looks like a lower threshold. The
    error from ln L with both groups' middle thresholds fitted anew at m ± h; without their share it would be 1.3 times.
    """
    rng, m, trials = np.random.default_rng(7), 0.3, 40
    group, pixel = np.repeat([0, 1, 1], 400), np.tile(np.arange(400), 3)
    u = np.where(group == 0, 2.1, 2.6) * np.linspace(0.95, 1.05, 1200)
    threshold = (1 + m * rng.standard_normal(400))[pixel] * np.where(group == 0, 1.04, 0.97)
    mixture = dispersion._Mixture(u, rng.binomial(trials, ndtr(-u * threshold)) + 0.0, group, pixel, trials)
    _, found, scale = mixture.maximum(0.1)
    assert found == pytest.approx(m, abs=4 * 0.0155)
    information, error = mixture.information(found, scale)
    h = 0.03 * found
    scales = [mixture.maximum(found + step, fixed=True)[2] for step in (-h, 0, h)]
    logs = [mixture.log_likelihood(found + step, s) for step, s in zip((-h, 0, h), scales, strict=True)]
    low, middle, high = (log.sum() - 0.5 * np.sum((np.log(s) / 0.3) ** 2) for log, s in zip(logs, scales, strict=True))
    curvature = (2 * middle - low - high) / h**2
    score = np.bincount(pixel, (logs[2] - logs[0]) / (2 * h))
    assert information == pytest.approx(curvature, rel=5e-3)
    assert error == pytest.approx(np.sqrt(score @ score) / curvature, rel=5e-3)


@pytest.mark.parametrize("contrast_of", ["signal", "voltage"])
@pytest.mark.parametrize("law", ["sqrt", "linear"])
def test_the_width_of_s_curves_is_compared_with_the_noise_of_the_static_counts(contrast_of, law):
    """σ_n² is the mean over both signs of s₀²/x₀² + s₁²/x₁² at the steps that reach θ₊ and −θ₋ (in volts: at one x)."""
    natural_values = np.array([0.6, 9.0, 0.35, -0.4, 0.1, 0.002])
    a, b, c, d = natural_values[:4]
    signal, theta_v = 40.0, 2.7
    given = replace(thresholds(mismatch=0.14), noise=(0.062, 0.0011), width=0.071)

    def relative_variance(signal):
        y = c * (signal if law == "linear" else np.sqrt(signal))
        return 2 * (y * y + 2 * d * y + 1) / (a * signal + b) ** 2 / theta_v**2

    levels, measured = [signal], np.sqrt(0.071**2 - (0.14 * 0.225) ** 2)
    if contrast_of == "signal":
        after = [((a * signal + b) * np.exp(step) - b) / a for step in (0.2, -0.25)]
        levels, measured = [signal, signal, *after], 0.062
    expected = 0.225 * np.sqrt(np.mean(relative_variance(np.array(levels))))
    covariance = np.zeros((6, 6))
    covariance[1, 1] = 0.09**2
    error = np.sqrt((0.0011 / measured) ** 2 + 0.01**2 + 0.02**2)

    def told(share, measured=measured, given=given):
        """What is found where Θ is such that the static counts ask for a share of the measured noise."""
        fit = SimpleNamespace(
            values=natural_values, parameters=from_natural(natural_values), covariance=covariance, law=law,
            identified=lambda name: True,
        )  # fmt: skip
        steps = SimpleNamespace(signal_dn=signal)
        own = theta_v * expected / (share * measured)
        return event_checks._width(
            SimpleNamespace(thresholds=given, steps=steps, together=fit, theta_v=own), contrast_of
        )

    assert told(1.02) is None
    for share in (0.86, 1.17):
        assert told(share).p_value == pytest.approx(2 * ndtr(-abs(np.log(share)) / error), rel=1e-6)
    # noise that is not known to a quarter tells nothing, and a mismatch beyond the width is not taken from it
    for part, is_told in ((0.245, True), (0.255, False)):
        assert (told(0.2, given=replace(given, noise=(0.062, part * measured))) is not None) == is_told
    assert told(0.8, 0.062, replace(given, width=0.0305)) is not None


def test_noise_of_the_frames_makes_no_edge_of_an_even_scene():
    """White event pixels between frame pixels: these differ where they do beyond √3 times their noise."""
    sensor = hr.load_sensor("gen2").spec
    rng, shape = np.random.default_rng(3), (64, 96)
    scatter = 700.0 * (1 + 0.2 * rng.standard_normal(shape))
    shares = []
    for error in (140.0, 14.0):
        composite = Composite(scatter.astype(np.float32), np.full(shape, error, np.float32))
        signal, uneven = signal_at_event_pixels(composite, sensor, "D65")
        assert signal.shape == (16, 24) and np.isfinite(signal).all()
        shares.append(uneven.mean())
    assert shares[0] < 0.1 and shares[1] > 0.8


@pytest.mark.parametrize("mismatch", [0.03, 0.08])
def test_spread_of_thresholds_is_freed_of_counting(mismatch):
    """Counts of 60,000 pixels in 3000 trials: counting alone has 5 % of the threshold, near the spread itself."""
    rng, trials, u = np.random.default_rng(12), 3000, np.array([1.1, 1.7])
    own = u[:, None] * (1 + mismatch * rng.standard_normal((2, 60_000)))
    both = [rng.binomial(trials, ndtr(-each)).astype(float) for each in own]
    middles, spread = middle_and_spread(both, np.zeros(60_000, np.intp), trials)
    assert spread == pytest.approx(mismatch, rel=0.05)
    np.testing.assert_allclose([float(each[0]) for each in middles], u, rtol=0.01)


def test_thresholds_of_few_events_are_freed_of_their_spread():
    """An event a pixel: the mean over normal thresholds is Q(u/√(1 + m² u²)), which tells u to 5 %, for starts of fits:
    half an event is added to the mean. Without the spread u would be 8 % low.
    """
    rng, trials, u, mismatch = np.random.default_rng(13), 3000, np.array([3.4, 3.55]), 0.11
    both = [
        rng.binomial(trials, ndtr(-each * (1 + mismatch * rng.standard_normal(60_000)))).astype(float) for each in u
    ]
    middles, spread = middle_and_spread(both, np.zeros(60_000, np.intp), trials, known=mismatch)
    assert spread == mismatch and max(counts.mean() for counts in both) < 2.5
    np.testing.assert_allclose([float(each[0]) for each in middles], u, rtol=0.05)


def test_floors_and_ceiling_of_exact_curves_are_found():
    """S-curves of ON and OFF that begin above 0 and end below 1, with different thresholds and floors."""
    step = np.linspace(-0.6, 0.6, 25)
    values, floors, ceiling = np.array([0.17, 0.26, 0.05, 0.0]), (0.013, 0.038), 0.91
    rates = [
        floor + (ceiling - floor) * curve(values, sign, step) for sign, floor in zip((1.0, -1.0), floors, strict=True)
    ]
    pixels, trials = np.full(GROUPS, 40.0), 500
    on, off = (np.outer(rate, pixels * trials) for rate in rates)
    steps = SimpleNamespace(on=on, off=off, pixels=pixels, trials=trials)
    found = curve_levels(steps, SimpleNamespace(values=values * [1.02, 0.98, 1.05, 1.0], step=step))
    for (value, error), true in zip((found.floor_on, found.floor_off, found.ceiling), (*floors, ceiling), strict=True):
        assert value == pytest.approx(true, abs=1e-6) and error < 1e-6


def test_errors_of_floors_and_ceiling_are_those_of_leaving_groups_out(monkeypatch):
    """Of the groups that have pixels."""
    pixels = np.where(np.arange(GROUPS) == 3, 0.0, 40.0)
    own = np.random.default_rng(2).normal(size=(GROUPS, 7))
    monkeypatch.setattr(event_checks, "_fit", lambda steps, step, groups, start: own[groups].sum(axis=0))
    given = SimpleNamespace(values=np.ones(4), step=None)
    found = curve_levels(SimpleNamespace(pixels=pixels), given)
    for k, (value, error) in zip((4, 5, 6), (found.floor_on, found.floor_off, found.ceiling), strict=True):
        without = own[:, k].sum() - own[pixels > 0, k]
        assert value == pytest.approx(own[:, k].sum())
        count = GROUPS - 1
        assert error == pytest.approx(np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2)))


def test_noise_of_two_equal_poles_has_its_correlation():
    """The cosine transform of 1/(1 + (f/f_p)²)², which is ½ at the cut-off."""
    cutoff_hz = 130.0
    pole = cutoff_hz / np.sqrt(np.sqrt(2) - 1)
    f = np.linspace(0, 40 * pole, 200_001)
    power = (1 + (f / pole) ** 2) ** -2.0
    for elapsed_s in (0.0, 2e-4, 1.1e-3, 4e-3):
        expected = np.trapezoid(power * np.cos(2 * np.pi * f * elapsed_s), f) / np.trapezoid(power, f)
        assert correlation(cutoff_hz, elapsed_s) == pytest.approx(expected, abs=1e-4)


def test_dark_lines_of_pixels_and_their_goodness_are_those_of_weighted_least_squares():
    """Five exposures, of which one has its noise hidden by rounding and does not count; NumPy's own polynomial."""
    rng = np.random.default_rng(21)
    seconds, frames, shared = np.array([0.002, 0.01, 0.03, 0.05, 0.09]), 12, 0.03
    spread = np.array([2.3, 0.09, 3.1, 4.7, 6.5])
    mean = 40.0 + np.array([-1.0, 2.0, 4.5])[:, None] + 60.0 * seconds[:, None, None] + rng.normal(0, 0.8, (5, 3, 7))
    moments = SimpleNamespace(
        exposures_s=seconds, frames=frames, mean=mean, variance=spread[:, None, None] + np.zeros((5, 3, 7)),
        lowest=np.full((5, 3, 7), 9), highest=np.full((5, 3, 7), 90),
    )  # fmt: skip
    used = np.ones((3, 7), bool)
    used[1, 4] = False
    found = fit_dark(moments, used, 255, shared)
    told, weight = np.arange(5) != 1, frames / (spread + shared)
    lines = np.polynomial.polynomial.polyfit(seconds[told], mean[told][:, used], 1, w=np.sqrt(weight[told]))
    left = mean[told][:, used] - np.polynomial.polynomial.polyval(seconds[told], lines).T
    chi2 = np.sum(weight[told] * np.mean(left**2, axis=1))
    assert found.chi2_per_dof == pytest.approx(chi2 / 2, rel=1e-5)
    np.testing.assert_allclose(found.n_dp[used], lines[1], rtol=1e-4)
    np.testing.assert_allclose(found.n_fp[used], lines[0], rtol=1e-5)


def test_dark_line_is_judged_by_the_noise_of_rows_and_pixels():
    """Five exposures, one off the line: the p-value is that of χ² with the variance of a mean over rows of a frame."""
    t, frames, shape = np.array([1e-3, 3e-3, 9e-3, 2e-2, 5e-2]), 25, (48, 80)
    mean = 64 + 90.0 * t
    mean[3] += 0.06
    dark = SimpleNamespace(
        exposures_s=t, frames=frames, mean=np.full((5, *shape), 1.0) * mean[:, None, None],
        variance=np.full((5, *shape), 1.7),
    )  # fmt: skip
    none = np.zeros(shape, bool)
    result = SimpleNamespace(bad=none, dark=SimpleNamespace(bad=none, hot=none))
    rows = 0.3
    variance = (1.7 / none.size + rows / shape[0]) / frames
    residual = mean - np.polynomial.Polynomial.fit(t, mean, 1)(t)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_checks, "_dark_variance", lambda _: 1e-9)  # any shift that is significant counts
        patch.setattr(frame_checks, "ALARM", 1.0)
        found = frame_checks._line(result, dark, rows)
    assert found.p_value == pytest.approx(gammaincc(1.5, np.sum(residual**2) / variance / 2), rel=1e-6)
    assert 1e-6 < found.p_value < 0.9


def test_signals_of_event_pixels_are_those_of_the_reference_exposure(tmp_path, monkeypatch):
    """A rate of the frames, in DN/s, times the exposure of the reference, in µs; NaN at edges, and none below 0."""
    rate = np.array([[1200.0, -30.0], [500.0, 80.0]], np.float32)
    uneven = np.array([[False, False], [True, False]])
    (tmp_path / "c.yaml").write_text("")
    monkeypatch.setattr(counts, "read_calibration", lambda _: {"aps": {}})
    monkeypatch.setattr(counts, "read_maps", lambda *_: {"evs_signal_dn_per_s": rate, "evs_signal_uneven": uneven})
    reference = SimpleNamespace(filter="own", t_ref_us=7000.0)
    captures = SimpleNamespace(folder=tmp_path, spec=SimpleNamespace(signal_reference=reference))
    found = counts._composite_signal(captures, tmp_path / "c.yaml", tmp_path / "evs_static.npz")
    np.testing.assert_allclose(found, [[8.4, 0.0], [np.nan, 0.56]], rtol=1e-6)


def test_a_pixel_silent_in_no_trial_while_it_fires_has_a_rate_of_half_a_silent_trial():
    parts, trials, trial_s = 40, 24, 0.05
    disturbed = np.zeros((parts, 3), np.int64)
    disturbed[5:17, 1] = disturbed[23:35, 1] = trials  # fires in all trials of 24 parts of 40
    disturbed[::7, 2] = 1  # a good pixel with an event now and then
    bad = np.array([False, True, False])
    own_hz = np.array([[6.0], [2.0]])  # three of four events are ON
    found = Parts(disturbed, trials, trial_s)
    rates, share, change_hz = asynchronous_defects._flicker(bad, np.array([1]), found, own_hz)
    usual = disturbed[:, [0, 2]].mean() / trials
    expected_share, correlation = dynamics(disturbed[:, [1]], trials, usual)
    assert share == expected_share and 0.5 < share[0] < 0.7
    assert disturbed[:, 1].mean() / trials - usual > 0.99 * share[0]  # no silent trial was seen
    total = -np.log(0.5 / (parts * trials * share[0])) / trial_s
    np.testing.assert_allclose(rates[:, 0], [0.75 * total, 0.25 * total], rtol=1e-12)
    np.testing.assert_allclose(change_hz, -np.log(correlation) / trial_s, rtol=1e-12)


def test_a_flickering_pixel_has_the_chance_of_the_time_in_which_it_fires():
    parts, trials = 40, 9600
    few = np.full((24, 24), 2)
    on, of_parts = few.copy(), np.zeros((parts, 24, 24), np.int64)
    of_parts[::20] = 2  # good pixels: two events of either polarity in all
    fires = np.repeat([0, 1, 0, 1, 0], 8) == 1
    of_parts[fires, 5, 7] = 72  # 0.3 of 240 trials, in 16 of 40 parts
    on[5, 7] = of_parts[:, 5, 7].sum()
    static = StaticCapture(np.full(few.shape, 50.0), on, few, on, few, trials, (1, 1), of_parts)
    bad = np.zeros(few.shape, bool)
    bad[5, 7] = True
    found = classify_event_defects(static, bad, None)
    assert found.kind[5, 7] == Defect.FLICKERING and found.count(Defect.NONE) == bad.size - 1
    # two times of firing tell the share within a tenth, and with it the chance; their product is the mean
    assert found.firing_share[5, 7] == pytest.approx(0.4, rel=0.1)
    assert found.on[5, 7] * found.firing_share[5, 7] == pytest.approx(0.12, rel=0.005) and found.off[5, 7] == 0
    assert 0.9 < found.correlation[5, 7] < 1
    assert np.all(found.on[~bad] == 0) and np.all(found.firing_share[~bad] == 1)


def test_a_pixel_that_is_known_in_one_light_alone_is_hot_or_silent():
    """Nothing tells whether its rate changes: no dark capture, no parts."""
    static = lone_pixel(9000, 40)
    static.n_on[2, 3] = static.n_off[2, 3] = 0
    bad = np.zeros((24, 24), bool)
    bad[5, 7] = bad[2, 3] = True
    found = classify_event_defects(static, bad, None)
    assert found.kind[5, 7] == Defect.HOT and found.kind[2, 3] == Defect.STUCK
    assert found.on[5, 7] == pytest.approx((9000 - 40) / TRIALS, rel=0.01)


def test_without_maps_of_frames_there_is_no_signal_at_event_pixels(tmp_path, monkeypatch):
    """No calibration yet, none at all, or one of events alone; and pixels whose filter no frame pixel has."""
    (tmp_path / "events.yaml").write_text("")
    monkeypatch.setattr(counts, "read_calibration", lambda _: {"evs": {}})
    captures = SimpleNamespace(folder=tmp_path, spec=SimpleNamespace(signal_reference=None))
    for calibration in (None, tmp_path / "none.yaml", tmp_path / "events.yaml"):
        with pytest.raises(SpecError, match="holds no array 'signal_dn'"):
            counts._composite_signal(captures, calibration, tmp_path / "evs_static.npz")


@pytest.mark.parametrize(("changes", "shape", "tile"), [
    ({"grid": (1, 3), "stated": (2, 2)}, (6, 9), (1, 3)), ({"stated": (2, 1)}, (6, 9), (2, 1)),
    # of frames of 8 × 12 px in tiles of 4 × 3; of another aspect, or not of whole tiles, the sizes tell nothing
    ({"frames": (8, 12)}, (4, 6), (2, 1)), ({"frames": (8, 12)}, (8, 6), (4, 3)),
    ({"frames": (24, 36)}, (4, 6), (4, 3)),
    ({}, (8, 9), (4, 3)), ({}, (6, 9), "whole tiles"), ({}, (8, 10), "whole tiles"),
    ({"grid": (0, 3)}, (6, 9), "whole"), ({"grid": (1, 3), "roi": (24, 9)}, (6, 9), (1, 3)),
    ({"grid": (1, 3), "roi": (24, 12)}, (6, 9), "24×9 frame pixels"),
    ({"grid": (1, 3), "roi": (20, 9)}, (6, 9), "24×9 frame pixels"),
])  # fmt: skip
def test_tiles_of_event_maps_are_stated_or_follow_from_the_sizes_of_both_grids(changes, shape, tile, tmp_path):
    grid, stated, frames, roi = (changes.get(name) for name in ("grid", "stated", "frames", "roi"))
    of_sensor = None if grid is None else SimpleNamespace(rows_per_tile=grid[0], cols_per_tile=grid[1])
    captures = SimpleNamespace(
        sensor=None if grid is None else SimpleNamespace(evs_grid=of_sensor), folder=tmp_path,
        has=lambda name: frames is not None, frames=lambda name: SimpleNamespace(shape=(3, 5, *frames)),
        spec=SimpleNamespace(
            tile_rows=4, tile_cols=3, evs_tile_rows=stated and stated[0], evs_tile_cols=stated and stated[1],
            roi=None if roi is None else SimpleNamespace(height_px=roi[0], width_px=roi[1]),
        ),
    )  # fmt: skip
    if isinstance(tile, str):
        with pytest.raises(SpecError, match=tile):
            counts.event_tile(captures, shape)
    else:
        assert counts.event_tile(captures, shape) == tile


@pytest.mark.parametrize("part", [8, 12, 40])
def test_parts_of_a_dark_capture_are_eight_or_more_and_add_up(part):
    rng = np.random.default_rng(1)
    parts = rng.integers(0, 5, (part, 7, 4))
    moved = parts.copy()
    moved[:2, 0, 0] += [-10, 10]
    on = parts.sum(axis=0) // 3
    maps = {"dark_n_on": on, "dark_n_off": parts.sum(axis=0) - on}
    assert counts._parts({"dark_parts": parts}, maps, 120, "a.npz") is parts
    for wrong, trials, words in (
        (parts[:7], 70, "holds 7 parts"), (parts, 119, "a divisor of n_trials"), (parts[:, :2], 120, "whole numbers"),
        (parts + 1, 120, "does not add up"), (moved, 120, "does not add up"), (parts * 1.0, 120, "whole numbers"),
    ):  # fmt: skip
        with pytest.raises(SpecError, match=words):
            counts._parts({"dark_parts": wrong}, maps, trials, "a.npz")
    assert counts._parts({}, maps, 120, "a.npz") is None


def test_without_steps_or_the_noise_of_counts_no_widths_are_compared():
    class Fit(SimpleNamespace):
        def identified(self, name):
            return name != self.lacks

    for thresholds, curves, lacks in ((None, 1, "D"), (1, None, "D"), (1, 1, "A"), (1, 1, "B"), (1, 1, "C")):
        result = SimpleNamespace(thresholds=thresholds, steps=curves, together=Fit(lacks=lacks))
        assert event_checks._width(result, "voltage") is None


def test_ceilings_below_one_are_told_beyond_noise_and_a_thousandth():
    def told(value, error):
        return event_checks._ceiling(event_checks.CurveLevels((0.0, 0.0), (0.0, 0.0), (value, error)))

    found = told(0.99, 0.002)
    assert found.p_value == pytest.approx(norm.sf(5), rel=1e-6, abs=0) and "0.9900 ± 0.002" in found.text
    assert told(0.99, 0.003) is None and told(0.9991, 1e-6) is None and told(0.9989, 1e-6) is not None


def test_floors_are_told_beyond_leak_with_its_error():
    """ON events beside the leak of the static counts; four comparisons, two of them of events that are too few."""
    covariance = np.diag([1.0, 1, 1, 1, 1, 4e-8])

    def told(on, off, free=True):
        fit = SimpleNamespace(values=np.array([1, 1, 1, 1, 0, 3e-3]), covariance=covariance, free=[True] * 5 + [free])
        levels = event_checks.CurveLevels(on, off, (1.0, 0.1))
        return event_checks._floor(SimpleNamespace(together=fit), levels)

    assert told((3.4e-3, 1e-4), (0.0, 1e-4)) is None  # 1.8 errors, of both together
    found = told((5e-3, 3e-4), (9e-4, 1e-4))
    errors = 2e-3 / np.hypot(3e-4, 2e-4), 9.0
    assert (
        found.p_value == pytest.approx(4 * norm.sf(max(errors)), rel=1e-6, abs=0)
        and "0.005 (ON) and 0.0009 (OFF)" in found.text
    )
    assert told((3e-3, 3e-4), (0.0, 1e-4), False).p_value == pytest.approx(4 * norm.sf(10), rel=1e-6, abs=0)
    assert told((-1e-2, 1e-5), (-1e-2, 1e-5)) is None and told((3e-3 + 9e-6, 0.0), (9e-6, 0.0), True) is None


def test_searches_that_end_elsewhere_are_told_where_they_describe_the_counts():
    values = np.array([[1.0, 2, 3, 4], [1.0, 2, 3, 4], [1.0, 2, 3, 4], [1.2, 2, 3, 4], [9.0, 2, 3, 4], [1.0, 2, 3, 40]])
    ends = SimpleNamespace(
        standard_error=np.array([0.5, 0.1, 0.1, 0.1]), values=values,
        describe_counts=lambda per_dof: np.array([1, 1, 1, 1, 0, 1], bool),
    )  # fmt: skip
    fit = SimpleNamespace(free=(True, True, True, False, False, False), goodness=SimpleNamespace(per_dof=1.0))
    found = event_checks._starts(SimpleNamespace(ends=ends, together=fit))
    assert "1 of 5 searches" in found.text and "up to 0.4 standard errors" in found.text
    values[3, 0] = 1.14
    assert event_checks._starts(SimpleNamespace(ends=ends, together=fit)) is None  # 0.28 errors


@pytest.mark.parametrize(("m", "trials", "within"), [(0.1, 300, 1e-6), (0.1, 20_000, 1e-3), (0.3, 20_000, 2e-3)])
def test_the_mean_over_thresholds_of_a_count_is_that_of_a_fine_sum(m, trials, within):
    """Quadrature about the likeliest threshold, against 56 001 thresholds; the constant is common to all counts."""
    u = np.array([1.5, 2.5, 3.5, 3.5, 2.5, 1.2])
    events = np.array([0, 3, 0, trials // 100, trials // 3, trials // 2])
    counts = SimpleNamespace(u=u, events=events, trials=trials, group=np.zeros(6, int))
    found = dispersion._Mixture.log_likelihood(counts, m, np.ones(1))
    z = np.linspace(-14, 14, 56_001)
    terms = [
        k * log_ndtr(-a * (1 + m * z)) + (trials - k) * log_ndtr(a * (1 + m * z)) - z * z / 2
        for a, k in zip(u, events, strict=True)
    ]
    away = found - logsumexp(terms, axis=1)
    assert np.ptp(away) < within


def test_floors_and_ceiling_of_s_curves_are_found_from_afar():
    """Rates of known curves: θ₊, θ₋, width, asymmetry, floors and ceiling, from a start without the last three."""
    step = np.linspace(-0.6, 0.6, 41)
    true = np.array([0.19, 0.26, 0.05, 0.06, 0.013, 0.021, 0.94])
    rates = [
        true[floor] + (true[6] - true[floor]) * curve(true[:4], polarity, step)
        for polarity, floor in ((1.0, 4), (-1.0, 5))
    ]
    pixels = np.linspace(50, 70, event_checks.GROUPS)
    counts = [rate[:, None] * pixels * 300 for rate in rates]
    steps = SimpleNamespace(on=counts[0], off=counts[1], pixels=pixels, trials=300)
    start = np.array([0.22, 0.23, 0.07, 0.0, 0.0, 0.0, 1.0])
    found = event_checks._fit(steps, step, np.ones(event_checks.GROUPS, bool), start)
    np.testing.assert_allclose(found, true, atol=2e-5)
    levels = event_checks.curve_levels(steps, SimpleNamespace(values=start[:4], step=step))
    for level, value in ((levels.floor_on, 0.013), (levels.floor_off, 0.021), (levels.ceiling, 0.94)):
        assert level[0] == pytest.approx(value, abs=2e-5) and level[1] < 1e-3

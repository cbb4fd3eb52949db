"""Scores, groups and defects of counts of event pixels: by finite differences, loops and tails of known laws."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from hesim_render.calibrate.evs import analysis, checks, defects, fit, fitted, model
from hesim_render.calibrate.evs.cells import Cells
from hesim_render.calibrate.evs.model import log_likelihood, log_probability
from hesim_render.calibrate.flicker import dynamics, unsteady
from hesim_render.calibration.spec import Defect
from hesim_render.core.errors import SpecError

ETA = np.array([0.004, np.log(0.9), 0.0021, 0.013, 0.06, 3e-3])
FREE = np.array([True, True, False, True, True, True])


def some_cells(rng, trials=500):
    signal = np.repeat([0.0, 9.0, 80.0, 300.0, 900.0], 2)
    polarity = np.tile([1.0, -1.0], 5)
    pixels = rng.integers(30, 90, 10).astype(float)
    plain = Cells(signal, polarity, rng.uniform(0.9, 1.1, 10), rng.uniform(0, 0.1, 10), pixels, np.zeros(10), trials)
    p = np.exp(log_probability(ETA, plain, 2.3, "sqrt")[0])
    events = rng.binomial((pixels * trials).astype(int), p).astype(float)
    return Cells(signal, polarity, plain.relative, plain.spread, pixels, events, trials), p


@pytest.mark.parametrize("weighed", [False, True])
def test_scores_are_slopes_of_the_likelihood(weighed):
    """Of binomial counts, or of −½ Σ (events − n p)²/variance; the information is Σ (∂ n p)²/variance."""
    cells, p = some_cells(np.random.default_rng(1))
    variance = 1.7 * cells.total * p * (1 - p) if weighed else None

    def value(eta):
        log_p = log_probability(eta, cells, 2.3, "sqrt")[0]
        if weighed:
            return -0.5 * np.sum((cells.events - cells.total * np.exp(log_p)) ** 2 / variance)
        return float(log_likelihood(cells, log_p))

    found, score, information = fit._evaluate(cells, ETA[None], 2.3, "sqrt", FREE, variance)
    assert found[0] == pytest.approx(value(ETA))
    steps = 1e-5 * np.diag(np.abs(ETA))
    slopes = np.array([(value(ETA + d) - value(ETA - d)) / (2 * d.max()) for d in steps])
    np.testing.assert_allclose(score[0], np.where(FREE, slopes, 0), rtol=2e-4, atol=1e-3)
    means = np.array([
        cells.total * (np.exp(log_probability(ETA + d, cells, 2.3, "sqrt")[0])
                       - np.exp(log_probability(ETA - d, cells, 2.3, "sqrt")[0])) / (2 * d.max()) for d in steps
    ])  # fmt: skip
    weight = 1 / (variance if weighed else cells.total * p * (1 - p))
    wanted = (means * weight) @ means.T * np.outer(FREE, FREE) + np.diag(1.0 * ~FREE)
    np.testing.assert_allclose(information[0], wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max() * 1e-6)


@pytest.mark.parametrize("weighed", [False, True])
def test_the_covariance_is_that_of_the_scores_of_single_pixels(weighed, monkeypatch):
    """Bread, meat and bread: a loop over 40 pixels with two counts each; 7 are summed at once."""
    monkeypatch.setattr(fit, "_CHUNK", 7)
    rng = np.random.default_rng(2)
    cells, p = some_cells(rng)
    variance = 1.7 * cells.total * p * (1 - p) if weighed else None
    cell = np.stack([2 * rng.integers(0, 5, 40), 2 * rng.integers(0, 5, 40) + 1])
    counts = rng.binomial(500, p[cell]).astype(float)
    pixels = SimpleNamespace(signal_dn=np.zeros(40), counts=counts, cell=cell, cells=cells)
    slope = log_probability(ETA, cells, 2.3, "sqrt")[1] * FREE
    influence = slope / (1 - p)[:, None] if variance is None else slope * (cells.total * p / variance)[:, None]
    meat = np.zeros((6, 6))
    for k in range(40):
        score = sum((counts[j, k] - 500 * p[cell[j, k]]) * influence[cell[j, k]] for j in (0, 1))
        meat += np.outer(score, score)
    information = (slope * (cells.total * p)[:, None]).T @ influence
    bread = np.zeros((6, 6))
    bread[np.ix_(FREE, FREE)] = np.linalg.inv(information[np.ix_(FREE, FREE)])
    found = fit.sandwich(pixels, ETA, 2.3, "sqrt", FREE, variance)
    np.testing.assert_allclose(found, bread @ meat @ bread, rtol=1e-5, atol=1e-15)


def test_groups_of_brightness_hold_pixels_and_events():
    """200 pixels and 100 events at least (a twentieth of all where they are few); the rest joins the last group."""
    rng = np.random.default_rng(3)
    signal, events = rng.uniform(0, 9, 3000), rng.uniform(0.1, 0.5, 3000)
    for factor, enough in ((1.0, events.sum() / 20), (9.0, 100.0), (0.1, 10.0)):
        group = model._groups(signal, factor * events)
        order = np.argsort(signal)
        assert np.all(np.diff(group[order]) >= 0)
        sizes, sums = np.bincount(group), np.bincount(group, factor * events)
        assert sizes.min() >= 200 and sums.min() >= min(enough, 100) - 1e-9
        # no group but the last could end one pixel earlier
        for k in range(sizes.size - 1):
            inside = order[group[order] == k]
            assert inside.size == 200 or sums[k] - factor * events[inside[-1]] < enough
    wide = model._wider(np.array([60.0, 50, 30, 30, 50, 99, 3]))
    sums = np.bincount(wide, [60.0, 50, 30, 30, 50, 99, 3])
    assert np.all(np.diff(wide) >= 0) and sums[:-1].min() >= 60 and sums[-1] >= 100


def test_a_goodness_without_degrees_of_freedom_says_nothing():
    for dof, per_dof, chance in ((9, 14.4 / 9, chi2.sf(14.4, 9)), (0, 1.0, 1.0), (-3, 1.0, 1.0)):
        found = model.Goodness(14.4, dof)
        assert (found.per_dof, found.p_value) == pytest.approx((per_dof, chance))


def one_fit(**given):
    base = {
        "values": np.array([0.2, 0.9, 0.1, 0.0, 0.05, 0.0]), "free": (True, True, True, False, True, False),
        "covariance": np.diag([1e-4, 2e-4, 3e-4, 0, 1e-5, 0]), "log_likelihood": -90.0, "design_effect": 2.0,
    }  # fmt: skip
    return SimpleNamespace(**{**base, **given})


def test_the_sampling_of_pixels_adds_to_a_b_and_rho(monkeypatch):
    """A and B move with the mean of both thresholds, ρ with half of their difference; estimates' noise is taken off."""
    rng = np.random.default_rng(4)
    on, off = 1 + 0.12 * rng.standard_normal((9, 11)), 1 + 0.2 * rng.standard_normal((9, 11))
    good = rng.random((9, 11)) < 0.9
    thresholds = SimpleNamespace(pixel_on=on, pixel_off=off, spread=SimpleNamespace(value=0.1))
    monkeypatch.setattr(analysis, "replace", lambda fit, covariance: covariance)
    given = one_fit()
    found = analysis._with_sampling_error(given, thresholds, good)
    scale = 0.1**2 / ((on[good].var() + off[good].var()) / 2)
    assert scale < 1
    both = scale * np.var((on + off)[good] / 2) / good.sum()
    apart = scale * np.var((on - off)[good] / 2) / good.sum()
    change = np.array([0.2, 0.9, 0, 0, 0, 0])
    wanted = given.covariance + both * np.outer(change, change)
    wanted[4, 4] += apart
    np.testing.assert_allclose(found, wanted)
    fixed = analysis._with_sampling_error(one_fit(free=(True, False, True, False, False, False)), thresholds, good)
    assert fixed[1, 1] == 2e-4 and fixed[4, 4] == 1e-5 and fixed[0, 1] == 0


def test_one_law_is_likelier_by_the_scatter_of_the_counts():
    """10 ln units over the larger effect of 2 and 4, which counts between 1 and 1000."""
    better, worse = one_fit(log_likelihood=-80.0), one_fit(design_effect=4.0)
    assert analysis._advantage(better, worse) == pytest.approx(10 / 4)
    assert analysis._advantage(better, one_fit(design_effect=5000.0)) == pytest.approx(0.01)
    limit = analysis.DECISIVE
    for more, law in ((1.01, "sqrt"), (0.99, "linear")):
        laws = {"linear": one_fit(), "sqrt": one_fit(log_likelihood=-90.0 + 2 * more * limit)}
        assert analysis._likelier(laws) == law
    assert analysis._likelier({"sqrt": one_fit()}) == "sqrt"


def test_medians_tell_a_law_by_the_lead_over_the_smaller_scatter(monkeypatch):
    """Both laws are fitted unless the lead leaves no doubt."""
    starts = {"linear": ("a", -500.0, 4.0), "sqrt": ("b", -440.0, 5.0)}
    monkeypatch.setattr(analysis, "Typical", SimpleNamespace(of=lambda *_: SimpleNamespace(cells="cells")))
    monkeypatch.setattr(analysis, "best_start", lambda cells, theta_v, law: starts[law])
    begun = analysis._Begun.of(None, None, 0.7)
    assert begun.lead == pytest.approx(15) and begun.starts == {"linear": "a", "sqrt": "b"} and begun.theta_v == 0.7
    sure, doubt = analysis.DECISIVE, analysis._BEYOND_DOUBT
    for lead, law in ((1.01 * sure, "sqrt"), (0.99 * sure, "linear"), (-1.01 * sure, "linear")):
        assert begun._replace(lead=lead).law == law
    for lead, wanted in ((0.99 * doubt, 2), (1.01 * doubt, ("sqrt",)), (-1.01 * doubt, ("linear",))):
        found = begun._replace(lead=lead).wanted
        assert found == wanted or len(found) == wanted


def test_brightness_and_events_that_tell_nothing_are_refused(tmp_path):
    captures, good = SimpleNamespace(folder=tmp_path), np.ones((3, 4), bool)

    def static(signal, on, dark=True):
        light = np.broadcast_to(np.asarray(signal, float), (3, 4))
        sessions = [(light, np.full((3, 4), on), np.zeros((3, 4)))]
        sessions += [(0 * light, np.zeros((3, 4)), np.full((3, 4), on))] if dark else []
        return SimpleNamespace(signal_dn=light, sessions=sessions, trials=100)

    analysis._check_brightness(static(5.0, 50), good, captures)
    analysis._check_brightness(static([5.0, 5, 5, 5.00001], 50, dark=False), good, captures)
    for given in (static(5.0, 50, dark=False), static(0.0, 50)):
        with pytest.raises(SpecError, match="one brightness"):
            analysis._check_brightness(given, good, captures)
    with pytest.raises(SpecError, match="more than half of the trials"):
        analysis._check_brightness(static(5.0, 51), good, captures)


def test_of_two_parameters_the_one_goes_without_which_the_fit_is_better(monkeypatch):
    """Each is left out alone; one that is not free stays so."""
    asked = []

    def fit(cells, eta, theta_v, law, free):
        asked.append(free)
        return free, None, None

    monkeypatch.setattr(fitted, "_fit", fit)
    for likelihoods, better in (((-3.0, -5.0), True), ((-5.0, -3.0), False)):
        values = iter(likelihoods)
        monkeypatch.setattr(fitted, "_log_likelihood", lambda *_, values=values: next(values))
        assert fitted._better_without(0, 2, None, ETA, 2.3, "sqrt", [True, False, True, True, True, True]) == better
    assert asked == 2 * [[False, False, True, True, True, True], [True, False, False, True, True, True]]


@pytest.mark.parametrize("more", [0.998, 1.002])
def test_a_pixel_is_unsteady_beyond_a_tail_of_1e_6(more):
    """χ² of 20 parts about a rate, its deviation from 19 divided by √(1 + 1/(2 mean)); ten events are needed."""
    limit = 19 + (chi2.isf(1e-6, 19) - 19) * np.sqrt(1 + 1 / (2 * 30.0))
    off = np.sqrt(more * limit * 30 * (1 - 30 / 400) / 20)
    parts = np.stack([30 + off * np.tile([1, -1], 10), np.full(20, 30.0)], axis=1)
    assert unsteady(parts, 400).tolist() == [more > 1, False]
    few = np.zeros((20, 2))
    few[0] = 9, 10  # all events in one part
    assert unsteady(few, 400).tolist() == [False, True]


@pytest.mark.parametrize(("trials", "firing", "rate", "correlation", "usual"), [
    (30, 0.37, 0.6, 0.93, 0.02), (45, 0.7, 0.3, 0.8, 0.05), (80, 0.2, 0.9, 0.985, 0.0),
])  # fmt: skip
def test_share_and_correlation_follow_from_the_moments_of_successive_counts(trials, firing, rate, correlation, usual):
    """The moments of a chain of two states, summed trial by trial, as those of a wave of 4001 parts."""
    i = np.arange(trials)
    own = rate**2 * firing * (1 - firing)
    within = own * (np.sum(correlation ** np.abs(i[:, None] - i)) - trials)
    neighbour = own * np.sum(correlation ** (i[:, None] + trials - i))
    mean = trials * (rate * firing + usual)
    variance = mean * (1 - mean / trials) + within
    wave = np.sqrt(2 * variance) * np.cos(np.arccos(neighbour / variance) * np.arange(4001) + 0.3)
    steady = np.sqrt(mean) * np.where(np.arange(4001) % 2, 0.3, -0.3)
    share, found = dynamics(mean + np.stack([wave, steady], axis=1), trials, usual)
    assert share[0] == pytest.approx(firing, rel=0.02) and np.log(found[0]) == pytest.approx(
        np.log(correlation), rel=0.05
    )
    assert (share[1], found[1]) == (1, 0)


def static_of(lit, dark, signal, parts=None, trials=10_000):
    on, off = lit
    dark_on, dark_off = dark
    zero = np.zeros_like(signal)
    return SimpleNamespace(
        sessions=[(signal, on, off), (zero, dark_on, dark_off)], trials=trials, parts=parts,
        part_trials=None if parts is None else trials // parts.shape[0],
    )  # fmt: skip


def test_kinds_of_defects_and_their_own_rates():
    """Hot as much in the dark as in the light, else flickering; stuck without an event; else other."""
    rng, shape = np.random.default_rng(5), (30, 40)
    signal = rng.uniform(10, 90, shape)
    lit, dark = rng.poisson(9, (2, *shape)), rng.poisson(4, (2, *shape))
    places = [(3, 4), (7, 8), (9, 30), (20, 2)]
    hot, flickering, stuck, other = places
    lit[0][hot], dark[0][hot] = 3009, 3004
    lit[0][flickering], dark[0][flickering] = 2009, 1004
    for one in (*lit, *dark):
        one[stuck] = 0
    lit[1][other], dark[1][other] = 9, 4
    bad = np.zeros(shape, bool)
    for place in places:
        bad[place] = True
    found = defects.classify(static_of(lit, dark, signal), bad, None)
    kinds = [Defect(found.kind[place]) for place in places]
    assert kinds == [Defect.HOT, Defect.FLICKERING, Defect.STUCK, Defect.OTHER] and not found.kind[~bad].any()
    # own events beside those of good pixels: p = own + (1 − own) usual, in the light and in the dark
    usual = [one[~bad].mean() / 10_000 for one in (lit[0], dark[0])]
    own = [(p - u) / (1 - u) for p, u in zip((0.3009, 0.3004), usual, strict=True)]
    assert found.on[hot] == pytest.approx(np.mean(own), rel=2e-3) and found.off[hot] == 0
    assert found.on[flickering] == pytest.approx(0.15, rel=0.01) and found.on[other] == 0
    # steps with an event: not stuck
    steps = SimpleNamespace(on_total=np.zeros(shape, int), off_total=np.zeros(shape, int))
    steps.off_total[stuck] = 1
    assert Defect(defects.classify(static_of(lit, dark, signal), bad, steps).kind[stuck]) is Defect.OTHER
    # parts that scatter: flickering although light and dark agree
    parts = np.broadcast_to(((dark[0] + dark[1]) // 20)[None], (20, *shape)).copy()
    parts[::2, hot[0], hot[1]], parts[1::2, hot[0], hot[1]] = 280, 20
    found = defects.classify(static_of(lit, dark, signal, parts), bad, None)
    assert Defect(found.kind[hot]) is Defect.FLICKERING and found.firing_share[hot] < 1


def test_bad_pixels_are_compared_with_good_ones_of_their_brightness():
    """Means over groups of 200; a pixel of unknown brightness with the group that has most events."""
    signal = np.arange(800.0).reshape(20, 40)
    on, off = np.where(signal < 400, 10, 30), np.where(signal < 400, 7, 2)
    on[0, 0] = 25
    bad = np.zeros((20, 40), bool)
    bad[1, 1] = bad[15, 7] = bad[3, 3] = True
    signal[3, 3] = np.nan
    mean, limit = defects._of_like(signal, bad, (on, off), 1000)
    # two of the 400 dim pixels are bad, or of unknown brightness; the first group has the pixel of 25 events
    np.testing.assert_allclose(mean[0], [(10 * 199 + 25) / 200 / 1000, 0.03, 0.03], rtol=1e-6)
    np.testing.assert_allclose(mean[1], [7e-3, 7e-3, 2e-3], rtol=1e-9)
    dark = np.sort(np.append(np.full(198, 10), 25))
    assert limit[0, 0] == pytest.approx(np.quantile(dark, 0.999), rel=0.02) and limit[0, 2] == 30


@pytest.mark.parametrize(
    ("value", "error", "is_told"), [(0.98, 0.004, True), (0.98, 0.006, False), (1.01, 1e-4, False)]
)
def test_a_ceiling_below_1_is_told_beyond_its_error(value, error, is_told):
    """Five errors below are beyond a chance of 1e-4, three and a third are not."""
    found = checks._ceiling(SimpleNamespace(ceiling=(value, error)))
    assert (found is not None) is is_told
    if is_told:
        assert found.p_value == pytest.approx(norm.sf(0.02 / error), rel=1e-6, abs=0)


def test_pixels_whose_thresholds_lie_apart_more_than_those_of_others(monkeypatch):
    """Six spreads of θ₊ − θ₋ without its noise, and six errors of the pixel; beside them those beyond the means."""
    rng, shape = np.random.default_rng(5), (20, 30)
    on, off = rng.normal(1, 0.05, shape), rng.normal(1.02, 0.07, shape)
    noise = rng.uniform(0.01, 0.04, (2, *shape))
    good = rng.random(shape) < 0.9
    places = [(3, 4), (3, 5), (11, 20), (11, 21)]
    for place, away in zip(places, (9.0, 9.0, -9.0, -9.0), strict=True):
        on[place], good[place] = away, True
    apart = on - off
    low, centre, high = np.quantile(apart[good], [0.16, 0.5, 0.84])
    both = noise[0] ** 2 + noise[1] ** 2
    spread = np.sqrt((high / 2 - low / 2) ** 2 - np.median(both[good]))
    assert 0.02 < spread < 0.95 * (high - low) / 2
    for place, part in zip(places, (0.99, 1.01, 0.99, 1.01), strict=True):
        limit = part * (6 * spread + 6 * np.sqrt(both[place]))
        on[place] = off[place] + centre + (limit if place[0] == 3 else -limit)
    monkeypatch.setattr(defects, "totals_of", lambda thresholds, polarity, ends, trials: (700 + 40 * polarity, 400.0))
    thresholds = SimpleNamespace(
        mismatch_on=0.1, mismatch_off=0.1, pixel_on=on, pixel_off=off, noise_on=noise[0], noise_off=noise[1]
    )
    steps = SimpleNamespace(on_total=np.full(shape, 600), off_total=np.full(shape, 550), trials=50)
    found = defects.bad_in_steps(steps, thresholds, good)
    assert [tuple(place) for place in np.argwhere(found)] == [(3, 5), (11, 21)]


def test_static_counts_of_pixels_whose_thresholds_lie_apart():
    """Of three groups with medians of their own: deviates of the counts' shares, each with its counting error.

    A twentieth of the pixels scatter by up to half of their threshold, about the limit.
    """
    rng, pixels, trials = np.random.default_rng(9), 700, 4000
    group = rng.integers(0, 3, pixels)
    middle = [np.array([1.4, 1.9, 0.25]), np.array([1.6, 1.7, 0.3])]
    wide = np.where(rng.random(pixels) < 0.05, rng.uniform(-0.5, 0.5, pixels), 0.03 * rng.standard_normal(pixels))
    chance = [norm.sf(own[group] * (1 + sign * wide)) for own, sign in zip(middle, (1, -1), strict=True)]
    both = [rng.binomial(trials, one).astype(float) for one in chance]
    both[0][:7] = 0  # too few events
    found = defects._apart(both, group, trials, middle)
    known = np.flatnonzero((both[0] >= 10) & (both[1] >= 10) & (group < 2))
    share = (np.stack(both) + 0.5) / (trials + 1)
    u = (middle[0] + middle[1])[group] / 2
    deviates = norm.isf(share) - np.stack(middle)[:, group]
    differ = (deviates[0] - deviates[1]) / u
    error = np.sum(share * (1 - share) / trials / norm.pdf(norm.isf(share)) ** 2, axis=0) / u**2
    low, centre, high = np.quantile(differ[known], [0.16, 0.5, 0.84])
    spread = np.sqrt((high - low) ** 2 / 4 - np.median(error[known]))
    limit = np.maximum(0.06, 6 * spread) + 6 * np.sqrt(error)
    expected = np.isin(np.arange(pixels), known) & (np.abs(differ - centre) > limit)
    assert 6 * spread > 0.06 and 5 < expected.sum() < 40
    assert found.tolist() == expected.tolist()

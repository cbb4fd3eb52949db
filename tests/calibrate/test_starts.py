"""Starts of the searches for a sensor's parameters: from counts and curves of a law, they are that law's own."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from hesim_render.calibrate.asynchronous import fit as trials_fit
from hesim_render.calibrate.asynchronous.likelihood import first_event
from hesim_render.calibrate.evs import fit
from hesim_render.calibrate.evs.cells import Cells


@pytest.mark.parametrize("law", ["sqrt", "linear"])
def test_starts_agree_with_the_rates_in_the_dark_and_in_the_brightest_light(law):
    """u = Θ (A I + B)/√(2 (1 + C I)): the two dimmest cells tell B, the two brightest A for each C that is tried."""
    signal = np.array([7.0, 0.0, 900.0, 300.0, 40.0, 960.0, 0.0, 100.0] * 2 + [500.0] * 4)
    theta_v, one = 0.7, np.ones(20)
    pixels = np.arange(60.0, 80.0)
    u = 2.6 - 0.0011 * signal
    events = pixels * 4000 * norm.cdf(-u)
    cells = Cells(signal, np.tile([1.0, -1.0], 10), one, 0 * one, pixels, events, 4000)
    starts = fit.start_values(cells, theta_v, law)
    lit = 960.0  # the tenth of the cells that is brightest: the two of 960
    assert starts.shape == (7, 6) and not starts[:, 3:].any()
    b = np.exp(starts[:, 1])
    np.testing.assert_allclose(b * theta_v / np.sqrt(2), 2.6, rtol=1e-3)
    shot = starts[:, 2] * (lit**2 if law == "linear" else lit)
    np.testing.assert_allclose(np.sqrt(shot), [0.1, 0.5, 2, 10, 50, 200, 1000])
    found = theta_v * (starts[:, 0] * lit + b) / np.sqrt(2 * (1 + shot))
    grows = starts[:, 0] * lit > 0.02 * b
    np.testing.assert_allclose(found[grows], 2.6 - 0.0011 * 960, rtol=1e-3)
    assert grows.tolist() == [False, False] + [True] * 5
    np.testing.assert_allclose(starts[:2, 0] * lit, 0.01 * b[:2], rtol=1e-9)


def test_few_and_many_events_have_a_finite_distance_to_the_threshold():
    def distance(events):
        one = np.ones(3)
        return fit._threshold_over_noise(Cells(one, one, one, one, 10 * one, np.array(events), 50), np.array([0, 2]))

    assert distance([13.0, 400.0, 20.0]) == pytest.approx(-norm.ppf(34 / 1002))
    assert distance([0.0, 9.0, 0.0]) == pytest.approx(-norm.ppf(1 / 1002)) and distance([490.0, 0.0, 480.0]) == 0.05


@pytest.mark.parametrize("is_noisy", [True, False])
@pytest.mark.parametrize("law", ["sqrt", "linear"])
def test_a_start_has_the_thresholds_and_the_noise_of_exact_curves(monkeypatch, law, is_noisy):
    """ON and OFF in four lights, whose centres and widths follow the law with unlike values of everything.

    Without noise its read part begins at a fiftieth of θ₊, and its shot part at a twentieth of that in the brightest
    light.
    """
    light, power = np.array([11.0, 60.0, 250.0, 900.0]), (1 if law == "sqrt" else 2)
    response = float((np.geomspace(0.3, 3000.0, 200) / 900.0)[90])
    theta, mismatch, shot, read = (0.21, 0.34), 0.13, (2.4e-3 if law == "sqrt" else 9e-5), 7e-3
    if not is_noisy:
        shot = read = 0.0
    curves = {1: [], -1: []}
    for sign, own in ((1, theta[0]), (-1, theta[1])):
        for lit in light:
            x0 = 1 + response * lit
            x1 = x0 * np.exp(sign * own)
            later = (x1 - 1) / response
            if later <= 0:
                continue
            noise = shot * (lit**power / x0**2 + later**power / x1**2) + read * (1 / x0**2 + 1 / x1**2)
            width = (mismatch * own) ** 2 + noise
            curves[sign].append((sign, lit, abs(np.log(later / lit)), width / ((x1 - 1) / x1) ** 2))
    steps = SimpleNamespace(of=lambda some: some, edges_s=np.array([0.0, 2e-3, 5e-3]))
    steady = SimpleNamespace(of=lambda some: some)
    spreads = iter([(None, 0.5), (None, 0.09)])
    wanted = np.geomspace(0.1, 30.0, 16)[11] / 5e-3

    class Likely:
        @staticmethod
        def of(sets, law, grids):
            assert all(len(some) == 5 and set(some) <= {3, 4, 5, 6, 9, 11, 12} for some in sets)
            for grid, own, spread in zip(grids, theta, (mismatch, 0.09), strict=True):
                reach = min(6 * spread, 0.97)
                np.testing.assert_allclose([grid.size, grid[0], grid[-1]], [25, own * (1 - reach), own * (1 + reach)])
            return Likely()

        def of_pixels(self, values):
            return -(np.log(values[trials_fit.CUTOFF] / wanted) ** 2) * np.ones(3)

    for name, other in {
        "pixel_thresholds": lambda *_: None, "median_and_spread": lambda _: next(spreads), "Likelihood": Likely,
        "_pooled_curves": lambda steps, polarity: curves[polarity], "_leak_start": lambda _: 0.031, "_FEW": 5,
    }.items():  # fmt: skip
        monkeypatch.setattr(trials_fit, name, other)
    good = np.isin(np.arange(15), (3, 4, 5, 6, 9, 11, 12))
    found = trials_fit.rough_start(steady, steps, good, law)
    if not is_noisy:
        read = (0.02 * 0.21) ** 2
        shot = 0.05 * read * (1 + response * 900) ** 2 / 900**power
    # a mismatch is at most that of the pixels' own thresholds
    expected = [*theta, mismatch, 0.09, response, shot, read, wanted, 0.031]
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_a_pooled_curve_begins_below_two_fifths_and_ends_above_three():
    """Shares of the calm trials of both pixels with an ON event in the first bin, by light; at least three steps."""
    shares = {
        5.0: [0.39, 0.45, 0.8, 0.9], 9.0: [0.42, 0.45, 0.8, 0.9], 20.0: [0.1, 0.3, 0.55, 0.59],
        30.0: [0.1, 0.3, 0.59, 0.61], 50.0: [0.1, 0.9],
    }  # fmt: skip
    light = np.repeat(list(shares), [len(one) for one in shares.values()])
    contrast = np.concatenate([0.05 + 0.1 * np.arange(len(one)) for one in shares.values()])
    events = np.round(np.concatenate(list(shares.values()))[:, None] * [1000, 3000]).astype(int)
    mixed = np.random.default_rng(2).permutation(light.size)
    steps = SimpleNamespace(
        signal_dn=light[mixed], contrast=contrast[mixed], calm=np.tile([1000, 3000], (light.size, 1)),
        events=lambda polarity: np.stack([events, 0 * events + 7], axis=1)[mixed],
    )  # fmt: skip
    found = trials_fit._pooled_curves(steps, 1)
    assert [(polarity, lit) for polarity, lit, _, _ in found] == [(1, 5.0), (1, 30.0)]
    for _, lit, mean, _ in found:
        # a law that rises in straight lines between the steps, whose first part lies at the first step
        parts = np.diff(np.append(0.0, shares[lit])) / shares[lit][-1]
        assert mean == pytest.approx(parts @ np.append(0.05, 0.1 * np.arange(1, 4)), rel=1e-9)


def test_chances_of_a_step_up_are_those_of_a_mirrored_step_down():
    """Whatever the noise at the reset leaves at the step: thresholds, step and leaks of both polarities exchanged."""
    noise, edges = (np.full(1, 0.06), np.full(1, 0.045)), np.array([0.0, 2e-4, 3e-3])
    for settle_s in (4e-4, 1.1e-3, 8e-3):
        up = first_event(0.2, 0.11, np.full(1, 0.07), noise, 300.0, settle_s, edges, (0.4, 2.5))
        down = first_event(0.11, 0.2, np.full(1, -0.07), noise, 300.0, settle_s, edges, (2.5, 0.4))
        np.testing.assert_allclose(up, down[::-1], rtol=1e-9)
        assert np.min(up) > 1e-6


class Parabolas:
    """ln L of each pixel: −½ Σ (ln of a parameter less the pixel's own centre)²/spread², and a slope along the leak."""

    def __init__(self, centres, spread, slope):
        self.centres, self.spread, self.slope = centres, spread, slope

    def given_thresholds(self, values):
        return None

    def of_pixels(self, values, given=None):
        squares = ((np.log(values) - self.centres) / self.spread) ** 2
        return -0.5 * squares.sum(axis=1) + self.slope * values[trials_fit.LEAK]


def a_search(slope):
    """60 pixels whose centres scatter as their parabolas say, without correlation, and the mean of the centres."""
    names, rng = len(trials_fit.NAMES), np.random.default_rng(6)
    middle, spread = rng.uniform(-1.5, 1.0, names), rng.uniform(0.2, 0.4, names)
    z = rng.standard_normal((60, names))
    z -= z.mean(axis=0)
    centres = middle + spread * np.sqrt(60) * np.linalg.qr(z)[0]
    spread[trials_fit.LEAK] = 1e9 if slope else spread[trials_fit.LEAK]
    return Parabolas(centres, spread, slope), middle, spread


def test_one_round_of_the_search_ends_at_the_top_of_parabolas():
    search, middle, spread = a_search(0.0)
    start = np.exp(middle + np.resize([0.4, -0.5, 0.3], middle.size))
    values, scores, free, best = trials_fit._climb(search, start, 1)
    np.testing.assert_allclose(np.log(values), middle, atol=1e-4)
    np.testing.assert_allclose(scores, (search.centres - np.log(values)) / spread**2, atol=2e-4)
    assert free.all() and best == pytest.approx(-0.5 * 60 * middle.size)
    # a round changes no logarithm by more than 0.7, and by twice as much where that is better
    for away, rounds, left in ((-1.2, 1, 0.2), (1.2, 1, -0.2), (0.9, 1, 0.2), (1.2, 2, 0.0)):
        start = np.exp(middle - np.where(np.arange(middle.size) == 0, away, 0.0))
        there = np.log(trials_fit._climb(search, start, rounds)[0])
        assert middle[0] - there[0] == pytest.approx(left, abs=1e-3)


def test_a_leak_without_likelihood_ends_at_its_floor_and_is_not_free():
    search, middle, _ = a_search(-900.0)
    values, _, free, _ = trials_fit._climb(search, np.exp(middle + 0.3), 40)
    others = np.arange(middle.size) != trials_fit.LEAK
    np.testing.assert_allclose(np.log(values[others]), middle[others], atol=0.01)
    assert free.tolist() == others.tolist()
    assert values[trials_fit.LEAK] == pytest.approx(1e-6 * np.exp(middle[trials_fit.LEAK] + 0.3), rel=1)


@pytest.mark.parametrize(
    ("top", "reached"), [(3.0, 2.0), (5.5, 4.0), (6.5, 8.0), (0.3, 0.4), (0.1, 0.16), (0.5001, 1.0), (-1.0, None)]
)
def test_a_step_is_doubled_while_it_gains_and_shortened_until_it_does(top, reached):
    """Along a direction with a parabola's top at so many steps."""
    change = np.linspace(0.01, 0.05, 9)
    start = np.linspace(0.4, 2.0, 9)
    search = SimpleNamespace(
        of_pixels=lambda values: np.array([-((np.log(values[3] / start[3]) / change[3] - top) ** 2)])
    )
    found = trials_fit._along(search, start, change, 1e-6 * start, -(top**2))
    if reached is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, start * np.exp(reached * change))
        # of what may vanish nothing goes below its floor
        floor = 1.02 * start
        held = trials_fit._along(search, start, -change, floor, -((top + 9) ** 2))
        assert held is None or np.all(held[[5, 6, 8]] >= floor[[5, 6, 8]])

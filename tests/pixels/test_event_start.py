"""Asynchronous pixels begin as they are after a long time in still light: noise events come as often at any time."""

import functools

import numpy as np
import pytest
from scipy import stats

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.shipped import list_names
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs import reference_law
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.reference_law import Pixels, law
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.specs import event_noise_table as table
from hesim_render.specs.event_noise import events_per_period
from hesim_render.specs.sensor import read_sensor

SIDE = 64
#: σ of ln x at 0 e⁻ is 0.07: thresholds of 2.6 and 3 standard deviations.
NOISY = {"beta1": 1.0, "beta2": 1.3, "beta3": 0.0, "beta4": 0.091, "beta5": 0.0}


@functools.cache
def pixels(**overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": SIDE, "geometry.cols": SIDE + 8, "evs.coefficients": [NOISY], "evs.reference": "last_event",
         "evs.tick_us": None, "evs.photoreceptor_cutoff_hz": 250.0, "evs.contrast_threshold_on": 0.182,
         "evs.contrast_threshold_off": 0.21, **changes},
    )  # fmt: skip
    return EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.ones(1))


def counts(noise, until_us, seed=5, electrons=0.0, **keys):
    """Events of each pixel in successive spans of still light, [span, pixel]."""
    size = int(np.prod(noise.layout.evs_shape))
    light, stage = jit().Float(np.full(size, electrons, np.float32)), EvsStage(noise, seed, **keys)
    stage.step(light, 12_345)
    found = []
    for t_us in until_us:
        events = stage.step(light, 12_345 + t_us)
        found.append(np.bincount(events["y"].astype(int) * noise.layout.evs_shape[1] + events["x"], minlength=size))
    return np.array(found)


@pytest.mark.parametrize("changes", (
    {}, {"evs__threshold_mismatch_std": 0.1}, {"evs__refractory_period_us": 150, "evs__threshold_mismatch_std": 0.1},
    {"evs__refractory_period_us": 1500, "evs__leak_rate_hz": 2.0}, {"evs__refractory_period_us": 90_000},
), ids=("plain", "mismatch", "dead-time", "leak", "long-dead-time"))  # fmt: skip
def test_the_rate_of_noise_events_does_not_depend_on_time(changes):
    """Spans from 6 to 60 ms against the 120 ms after them: within 4 % and 4.5 standard errors (20 of them: 1e-4).

    From a reset of all pixels most of these differ by 5 to 50 %.
    """
    until_us = (6_000, 24_000, 60_000, 180_000)
    found = counts(pixels(**changes), until_us)
    rates = found / np.diff([0, *until_us])[:, None]
    error = np.sqrt(rates.var(axis=1) / rates.shape[1])
    rates = rates.mean(axis=1)
    away = np.abs(rates[:-1] - rates[-1])
    assert np.all(away < 0.04 * rates[-1] + 4.5 * np.hypot(error[:-1], error[-1])), rates / rates[-1]


def test_comparisons_of_successive_samples_have_no_beginning():
    """Fixed ticks: 4 spans of 20 ticks, χ² at 1e-6; noise that neighbours share makes sums vary by up to 1.2 times."""
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": SIDE, "geometry.cols": SIDE, "evs.coefficients": [NOISY], "evs.contrast_threshold_on": 0.182},
    )
    noise = EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.ones(1))
    stage, dark = EvsStage(noise, 4), jit().Float(np.zeros(SIDE * SIDE, np.float32))
    found = np.array([stage.step(dark, 1000 * k).size for k in range(81)])[1:].reshape(4, 20).sum(axis=1)
    assert found.min() > 5000
    assert stats.chi2.sf(np.sum((found - found.mean()) ** 2) / (1.2 * found.mean()), 3) > 1e-6


def test_the_start_is_the_same_for_any_region_and_continues():
    """Events of a region are those of the whole sensor there; a resumed stage continues bit by bit."""
    whole = pixels(evs__refractory_period_us=150, evs__threshold_mismatch_std=0.1)
    part = EvsNoise(whole.spec, Layout(whole.layout.spec, 24, 8, 40, 56), whole.device_seed, np.ones(1))

    def run(noise, times_us, stop=None):
        light = jit().Float(np.full(int(np.prod(noise.layout.evs_shape)), 0.2, np.float32))
        stage, found = EvsStage(noise, 11), []
        for t_us in times_us:
            if t_us == stop:
                state, stage = stage.state(), EvsStage(noise, 11)
                stage.resume(state)
            found.append(stage.step(light, t_us))
        return np.concatenate(found)

    every, mine = run(whole, (0, 20_000, 41_000)), run(part, (0, 20_000, 41_000))
    inside = (every["y"] >= 24) & (every["y"] < 64) & (every["x"] >= 8) & (every["x"] < 64)
    moved = every[inside]
    moved["y"] -= 24
    moved["x"] -= 8
    assert mine.size > 300
    np.testing.assert_array_equal(np.sort(mine), np.sort(moved))
    np.testing.assert_array_equal(run(part, (0, 20_000, 41_000), stop=20_000), mine)
    assert run(part, (0, 7, 41_000)).size == mine.size


def test_other_seeds_start_otherwise_and_noise_free_pixels_at_their_own_level():
    noise = pixels()
    size = int(np.prod(noise.layout.evs_shape))
    light = jit().Float(np.full(size, 0.4, np.float32))
    found = []
    for model, seed in ((noise, 1), (noise, 2), (noise.clean(), 1)):
        stage = EvsStage(model, seed)
        stage.step(light, 0)
        found.append(np.array(stage.reference - np.log(2.1)))
    assert abs(np.corrcoef(found[0], found[1])[0, 1]) < 0.05
    np.testing.assert_allclose(found[2], 0.0, atol=1e-6)
    # most pixels wait where both thresholds are equally far: at (θ₋ − θ₊)/2
    assert np.median(found[0]) == pytest.approx((0.21 - 0.182) / 2, abs=0.004)


# ---- the law ---------------------------------------------------------------------------------------------


def test_stationary_laws_of_chains():
    """Against the eigenvector of the eigenvalue 1, for chances over nine powers of ten."""
    rng = np.random.default_rng(3)
    chances = 10.0 ** rng.uniform(-9, 0, (3, 7, 7))
    chances /= chances.sum(axis=2, keepdims=True)
    found = reference_law._stationary(chances)
    for matrix, own in zip(chances, found, strict=True):
        value, vector = np.linalg.eig(matrix.T)
        expected = np.real(vector[:, np.argmax(np.real(value))])
        np.testing.assert_allclose(own, expected / expected.sum(), rtol=1e-6)


def test_a_normal_law_on_the_grid_has_its_mean_and_variance():
    grid, step = reference_law._GRID, reference_law._STEP
    mean = np.array([-1.234, 0.0, 0.05, 2.71])
    for deviation in (0.03, 0.1, 0.5):
        weight = reference_law._weights(mean, deviation)
        np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-12)
        np.testing.assert_allclose(weight @ grid, mean, atol=1e-12)
        variance = weight @ grid**2 - mean**2
        assert np.all(np.abs(variance - deviation**2 - step**2 / 6) < step**2 / 5)
    # beyond the ends, at the ends
    np.testing.assert_allclose(reference_law._weights(np.array([-9.0, 9.0]), 0.2)[[0, 1], [0, -1]], 1)


def test_crossings_are_those_of_a_gaussian_process():
    """With many nodes Rice's formula; with the 16 of the simulation those of two correlated normal numbers."""
    level = np.array([0.0, 0.7, 2.3, 4.1])
    found = reference_law._crossings(level, 0.01)
    np.testing.assert_allclose(found, reference_law.POLE / (2 * np.pi) * np.exp(-0.5 * level**2), rtol=4e-3)
    angle = reference_law.POLE / 16
    correlation = (1 + angle) * np.exp(-angle)
    amplitude = np.sqrt(3 / (2 + correlation))
    for one, value in zip(level, reference_law._crossings(level, angle), strict=True):
        both = stats.multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf([one / amplitude] * 2)
        assert value == pytest.approx(16 * (stats.norm.cdf(one / amplitude) - both), rel=2e-3, abs=1e-7)


def test_the_law_agrees_with_simulated_rates():
    """The table is of another simulation, of 3000 periods: where that is long enough, rates agree within 7 %."""
    angle = reference_law.POLE / 16
    for dead in (0.03, 0.3, 1.0):
        for difference in (0.5, 1.2):
            mean = np.array([2.5, 3.0, 3.5])
            on, off = mean - difference / 2, mean + difference / 2
            found = law(Pixels(on, off, dead, 1e-5, angle)).events
            place = table.DIFFERENCE.index(difference), table.DEAD_PERIODS.index(dead)
            known = [table.EVENTS[table.MEAN.index(one)][place[0]][place[1]] for one in mean]
            np.testing.assert_allclose(found, known, rtol=0.07)


def test_the_law_is_symmetric_and_follows_the_leak():
    angle = reference_law.POLE / 16
    one, other = law(Pixels(np.array([2.7, 3.9]), np.array([3.9, 2.7]), 0.05, 1e-4, angle)).share
    np.testing.assert_allclose(one, other[::-1], rtol=1e-6, atol=1e-12)
    # with frequent resets the level is that of the noise itself
    often = law(Pixels(np.array([5.0]), np.array([5.6]), 0.05, 0.3, angle))
    centre = (often.edges[1:] + often.edges[:-1]) / 2
    own = often.share[0] @ centre
    assert abs(own) < 0.02 and np.sqrt(often.share[0] @ centre**2 - own**2) == pytest.approx(1.0, abs=0.03)
    # without any, and without a dead time, pixels are where they wait for long: about halfway between both thresholds
    never = law(Pixels(np.array([5.0]), np.array([5.6]), 0.0, 1e-9, angle)).share[0]
    near = np.abs(centre - 0.3) < 2.0
    wait = 1 / (np.exp(-0.5 * (5.0 + centre) ** 2) + np.exp(-0.5 * (5.6 - centre) ** 2))
    np.testing.assert_allclose(never[near], wait[near] / wait[near].sum(), atol=0.05 * never.max())
    assert often.dead_share[0] == pytest.approx(0.05 / (0.05 + 1 / 0.3), rel=0.01)  # and noise


# ---- shipped sensors ---------------------------------------------------------------------------------------


def lit(name, lux, seconds, seed=3):
    """Rates of events of a crop of a shipped sensor in still light, noise and leak, in successive spans, Hz."""
    sensor = hr.load_sensor(name).crop(128, 128)
    spec = sensor.spec.evs
    reference = spec.signal_reference
    electrons = lux * spec.window_us / (reference.k_dn_per_e * reference.t_ref_us)
    until_us = [round(1e6 * value) for value in seconds]
    found = counts(sensor.evs.without("readout_limit"), until_us, seed, electrons)
    return found.mean(axis=1) / np.diff([0.0, *seconds])


ASYNCHRONOUS = sorted(
    name for name in list_names("sensors")
    if (spec := read_sensor(name).evs) is not None and spec.reference == "last_event"
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_shipped_sensors_meet_their_sheet_from_the_first_moment(name):
    """Background activity of the data sheet within 5 %, and of all within 7 % (and chance) of the later rate."""
    sheet = read_sensor(name).evs.data_sheet
    lux, expected = (sheet.background[0].lux, sheet.background[0].rate_hz) if sheet else (100.0, None)
    seconds = (0.25, 0.5, 1.0, 2.0, 4.0)
    rates = lit(name, lux, seconds)
    if expected is not None:
        # 5 standard deviations of Poisson counts of the first half second, which come in bursts of two or three
        chance = 5 * np.sqrt(3 * expected * 0.5 * 128**2) / (0.5 * 128**2)
        assert np.mean(rates[:2]) == pytest.approx(expected, abs=0.05 * expected + chance)
        assert rates @ np.diff([0, *seconds]) / 4 == pytest.approx(expected, rel=0.05)
    chance = 5 * np.sqrt(3 * rates[-1] / np.diff([0.0, *seconds]) / 128**2)
    assert np.all(np.abs(rates - rates[-1]) <= 0.07 * rates[-1] + chance), rates


def test_the_table_of_rates_is_that_of_the_law():
    """Of the table with the leak of a data sheet, where events are rare: from both the same σ follows."""
    found = law(Pixels(np.array([3.5, 4.2]), np.array([3.9, 4.4]), 0.03, 2e-3, reference_law.POLE / 16)).events
    np.testing.assert_allclose(events_per_period([3.5, 4.2], [3.9, 4.4], 0.03, 2e-3), found, rtol=0.12)

"""Asynchronous pixels begin as they are after a long time in still light: noise events come as often at any time."""

import functools

import numpy as np
import pytest
from scipy import stats

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.core.shipped import list_names
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs import start
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.noise_rates import events_per_period
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.pixels.evs.start import Pixels, law, start_chances, start_of
from hesim_render.sensor.reading import read_sensor

SIDE = 64
#: σ of ln x at 0 e⁻ is 0.07: thresholds of 2.6 and 3 standard deviations.
NOISY = {"beta1": 1.0, "beta2": 1.3, "beta3": 0.0, "beta4": 0.091, "beta5": 0.0}


@functools.cache
def pixels(**overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": SIDE, "geometry.cols": SIDE + 8, "evs.coefficients": [NOISY], "evs.reference": "last_event",
         "evs.tick_us": None, "evs.noise_cutoff_hz": 250.0, "evs.contrast_threshold_on": 0.182,
         "evs.contrast_threshold_off": 0.21, **changes},
    )  # fmt: skip
    return EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.ones(1))


def counts(noise, until_us, seed=5, electrons=0.0, **keys):
    """Events of each pixel in successive spans of still light, [span, pixel]."""
    size = int(np.prod(noise.layout.evs_shape))
    light, stage = from_host(jit().Float, np.full(size, electrons, np.float32)), EvsStage(noise, seed, **keys)
    stage.step(light, 12_345)
    found = []
    for t_us in until_us:
        events = stage.step(light, 12_345 + t_us)
        found.append(np.bincount(events["y"].astype(int) * noise.layout.evs_shape[1] + events["x"], minlength=size))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("changes", (
    {}, {"evs__threshold_mismatch_rel": 0.1}, {"evs__refractory_period_us": 150, "evs__threshold_mismatch_rel": 0.1},
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
    stage, dark = EvsStage(noise, 4), from_host(jit().Float, np.zeros(SIDE * SIDE, np.float32))
    found = np.array([stage.step(dark, 1000 * k).size for k in range(81)])[1:].reshape(4, 20).sum(axis=1)
    assert found.min() > 5000
    assert stats.chi2.sf(np.sum((found - found.mean()) ** 2) / (1.2 * found.mean()), 3) > 1e-6


def test_the_start_is_the_same_for_any_region_and_continues():
    """Events of a region are those of the whole sensor there; a resumed stage continues bit by bit."""
    whole = pixels(evs__refractory_period_us=150, evs__threshold_mismatch_rel=0.1)
    part = EvsNoise(whole.spec, Layout(whole.layout.spec, 24, 8, 40, 56), whole.device_seed, np.ones(1))

    def run(noise, times_us, stop=None):
        light = from_host(jit().Float, np.full(int(np.prod(noise.layout.evs_shape)), 0.2, np.float32))
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
    light = from_host(jit().Float, np.full(size, 0.4, np.float32))
    found = []
    for model, seed in ((noise, 1), (noise, 2), (noise.clean(), 1)):
        stage = EvsStage(model, seed)
        stage.step(light, 0)
        found.append(np.array(stage.reference - np.log(2.1)))
    assert abs(np.corrcoef(found[0], found[1])[0, 1]) < 0.05
    np.testing.assert_allclose(found[2], 0.0, atol=1e-6)
    # most pixels wait where both thresholds are equally far: at (θ₋ − θ₊)/2
    assert np.median(found[0]) == pytest.approx((0.21 - 0.182) / 2, abs=0.004)


def test_levels_of_comparison_are_drawn_from_the_law():
    """At the thresholds of 3 and 3.5 σ the law of 4608 pixels; between nodes the median moves with the thresholds."""
    noise = pixels(evs__refractory_period_us=400, evs__contrast_threshold_on=0.21, evs__contrast_threshold_off=0.245)
    count = int(np.prod(noise.layout.evs_shape))
    angle = start.POLE / 16
    found = start_of(noise, 3, np.full(count, 0.07, np.float32), np.ones(count), angle).reference
    expected = law(Pixels(np.array([3.0]), np.array([3.5]), 400e-6 * 250, 1e-3 / 250, angle))
    below = np.append(0.0, np.cumsum(expected.share[0]))
    # Kolmogorov, 1e-6
    assert np.abs(np.interp(np.sort(found), expected.edges, below) - (np.arange(count) + 0.5) / count).max() < 0.04
    # a larger number never gives a lower level
    assert np.diff(found[np.argsort(start_chances(noise, 3)[0])]).min() >= 0
    # twice the noise halves both thresholds; half the bandwidth halves the dead time in periods
    other = start_of(noise, 3, np.full(count, 0.14, np.float32), np.full(count, 0.5), angle).reference
    half = law(Pixels(np.array([1.5]), np.array([1.75]), 400e-6 * 125, 1e-3 / 125, angle / 2))
    median = np.interp(0.5, np.append(0.0, np.cumsum(half.share[0])), half.edges)
    assert np.median(other) == pytest.approx(median, abs=0.08)


@pytest.mark.parametrize("octave", (0, 2))
def test_each_bandwidth_has_the_law_of_its_own_periods(octave):
    """At nodes of the table, 3 and 3.5 σ: levels, noise events and dead times are those of the law.

    A dead time is shorter in longer periods, and nodes of the noise lie closer.
    """
    noise = pixels(evs__refractory_period_us=4000, evs__contrast_threshold_on=0.21, evs__contrast_threshold_off=0.245)
    count, angle = int(np.prod(noise.layout.evs_shape)), start.POLE / 16
    own_hz = 250 / 2**octave
    resets_hz = 1e-3 + noise.resets_hz
    expected = law(Pixels(np.array([3.0]), np.array([3.5]), 4e-3 * own_hz, resets_hz / own_hz, angle / 2**octave))
    found = start_of(noise, 3, np.full(count, 0.07, np.float32), np.full(count, 0.5**octave), angle)
    np.testing.assert_allclose(found.events_hz, expected.events[0] * own_hz, rtol=1e-5)
    asleep = found.dead_us > 0
    assert abs(asleep.mean() - expected.dead_share[0]) < 4.5 * np.sqrt(expected.dead_share[0] / count)
    assert found.dead_us.max() < 4000 and stats.kstest(found.dead_us[asleep] / 4000, "uniform").pvalue > 1e-5
    chance = np.clip(start_chances(noise, 3)[0], stats.norm.cdf(-4), stats.norm.cdf(4))
    levels = np.interp(chance, np.append(0.0, np.cumsum(expected.share[0])), expected.edges)
    # quantiles are kept at 161 places, and linear between them
    assert np.abs(found.reference - levels).max() < 0.02


def test_between_octaves_of_bandwidth_the_start_is_linear():
    noise = pixels(evs__refractory_period_us=400)
    count = int(np.prod(noise.layout.evs_shape))
    spread = np.full(count, 0.07, np.float32)
    one, half, between = (
        start_of(noise, 3, spread, np.full(count, share), start.POLE / 16) for share in (1.0, 0.5, 0.5**0.3)
    )
    np.testing.assert_allclose(between.reference, 0.7 * one.reference + 0.3 * half.reference, atol=1e-5)
    np.testing.assert_allclose(between.events_hz, 0.7 * one.events_hz + 0.3 * half.events_hz, rtol=1e-5)
    assert np.abs(one.reference - half.reference).max() > 0.01


# ---- the law ---------------------------------------------------------------------------------------------


def test_stationary_laws_of_chains():
    """Against the eigenvector of the eigenvalue 1, for chances over nine powers of ten."""
    rng = np.random.default_rng(3)
    chances = 10.0 ** rng.uniform(-9, 0, (3, 7, 7))
    chances /= chances.sum(axis=2, keepdims=True)
    found = start._stationary(chances)
    for matrix, own in zip(chances, found, strict=True):
        value, vector = np.linalg.eig(matrix.T)
        expected = np.real(vector[:, np.argmax(np.real(value))])
        np.testing.assert_allclose(own, expected / expected.sum(), rtol=1e-6)


def test_a_normal_law_on_the_grid_has_its_mean_and_variance():
    grid, step = start._GRID, start._STEP
    mean = np.array([-1.234, 0.0, 0.05, 2.71])
    for deviation in (0.03, 0.1, 0.5):
        weight = start._weights(mean, deviation)
        np.testing.assert_allclose(weight.sum(axis=1), 1, rtol=1e-12)
        np.testing.assert_allclose(weight @ grid, mean, atol=1e-12)
        variance = weight @ grid**2 - mean**2
        assert np.all(np.abs(variance - deviation**2 - step**2 / 6) < step**2 / 5)
    # beyond the ends, at the ends
    np.testing.assert_allclose(start._weights(np.array([-9.0, 9.0]), 0.2)[[0, 1], [0, -1]], 1)


def test_crossings_are_those_of_a_gaussian_process():
    """With many nodes Rice's formula; with the 16 of the simulation those of two correlated normal numbers."""
    level = np.array([0.0, 0.7, 2.3, 4.1])
    found = start._crossings(level, 0.01)
    np.testing.assert_allclose(found, start.POLE / (2 * np.pi) * np.exp(-0.5 * level**2), rtol=4e-3)
    angle = start.POLE / 16
    correlation = (1 + angle) * np.exp(-angle)
    amplitude = np.sqrt(3 / (2 + correlation))
    for one, value in zip(level, start._crossings(level, angle), strict=True):
        both = stats.multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf([one / amplitude] * 2)
        assert value == pytest.approx(16 * (stats.norm.cdf(one / amplitude) - both), rel=2e-3, abs=1e-7)


#: Events per period at means of both thresholds of 2.5, 3.0 and 3.5 σ, for dead time and difference of the thresholds:
#: from simulations that began with a reset, the 1000th to the 3000th period.
SIMULATED = {
    (0.03, 0.5): (0.37, 0.1422, 0.04169), (0.03, 1.2): (0.3757, 0.1432, 0.04117),
    (0.3, 0.5): (0.2389, 0.08334, 0.02175), (0.3, 1.2): (0.2469, 0.0831, 0.02202),
    (1.0, 0.5): (0.1913, 0.06843, 0.01755), (1.0, 1.2): (0.2075, 0.07563, 0.01996),
}  # fmt: skip


def test_the_law_agrees_with_simulated_rates():
    """Within 7 %: crossings are not rare at 2.5 σ, and the simulations have errors of 2 %."""
    mean = np.array([2.5, 3.0, 3.5])
    for (dead, difference), known in SIMULATED.items():
        on, off = mean - difference / 2, mean + difference / 2
        found = law(Pixels(on, off, dead, 1e-5, start.POLE / 16)).events
        np.testing.assert_allclose(found, known, rtol=0.07)


def test_the_law_is_symmetric_and_follows_the_leak():
    angle = start.POLE / 16
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


ASYNCHRONOUS = sorted(
    name for name in list_names("sensors")
    if (spec := read_sensor(name).evs) is not None and spec.reference == "last_event"
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ASYNCHRONOUS)
def test_shipped_sensors_have_their_background_from_the_first_moment(name):
    """128×128 pixels of a preset for 3 s, at the light of its sheet: rates of any span, and the rate of the sheet.

    The sheet is of the mean device: the expected rate is that of the thresholds of just these pixels. 5 % and
    5 standard deviations of counts that come in bursts of three; the spans have 4 % of their own against each other.
    """
    sensor = hr.load_sensor(name).crop(128, 128)
    spec, noise = sensor.spec.evs, sensor.evs.without("readout_limit")
    lux = spec.data_sheet.background[0].lux if spec.data_sheet else 100.0
    electrons = lux * spec.window_us / (spec.signal_reference.k_dn_per_e * spec.signal_reference.t_ref_us)
    until_us = np.array([100_000, 250_000, 500_000, 1_000_000, 3_000_000])
    span_s = np.diff([0, *until_us]) * 1e-6
    rates = counts(noise, until_us, electrons=electrons).mean(axis=1) / span_s
    chance = 5 * np.sqrt(3 * np.maximum(rates.mean(), 0.01) / span_s / 128**2)
    assert np.all(np.abs(rates - rates[-1]) <= 0.04 * rates[-1] + chance), rates
    variance = float(np.array(noise.log_level(jit().Float(np.full(128**2, electrons, np.float32)))[1])[0])
    if variance == 0:
        return
    share = float(np.ravel(noise.noise_share(np.array([electrons]), 0))[0])
    bandwidth_hz = share * spec.noise_cutoff_hz
    own = [np.ravel(theta) / np.sqrt(variance) for theta in (noise.threshold_on_map, noise.threshold_off_map)]
    dead_s = (spec.refractory_period_us or 0) * 1e-6
    events = events_per_period(*own, dead_s * bandwidth_hz, spec.leak_rate_hz / bandwidth_hz).mean()
    expected = spec.leak_rate_hz + bandwidth_hz * events
    print(name, "first half second", rates[:3] @ span_s[:3] / 0.5, "3 s", rates @ span_s / 3, "expected", expected)
    assert rates @ span_s / 3 == pytest.approx(expected, rel=0.05, abs=chance[-1])
    assert rates[:3] @ span_s[:3] / 0.5 == pytest.approx(expected, rel=0.05, abs=chance[2])

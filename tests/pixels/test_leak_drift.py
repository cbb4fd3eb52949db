"""Leak as a drift of the reference: intervals, spread over pixels, jitter by noise, start, labels, bad keys.

The oracle is `numpy_pixels`, a generator written here: white noise through two equal poles, a ramp, two comparisons.
"""

import numpy as np
import pytest
from scipy import stats

from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs.events import EVENT_DTYPE, Origin
from hesim_render.pixels.evs.labels import Labeller
from hesim_render.pixels.evs.leak_drift import LeakDrift
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor
from hesim_render.specs.event_pixels import LeakSpec

SHAPE = (48, 56)
PIXELS = SHAPE[0] * SHAPE[1]
THETA_ON, THETA_OFF = 0.19, 0.23
CUTOFF_HZ = 90.0


def pixels(leak, sigma=0.0, **overrides):
    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    beta = {"beta1": 0.6, "beta2": 1.4, "beta3": 0.0, "beta4": 1.4 * sigma, "beta5": 0.0}
    spec = read_sensor(
        "reference-mono",
        {"geometry.rows": SHAPE[0], "geometry.cols": SHAPE[1], "evs.coefficients": [beta],
         "evs.reference": "last_event", "evs.noise_cutoff_hz": CUTOFF_HZ, "evs.threshold_mismatch_rel": 0.0,
         "evs.contrast_threshold_on": THETA_ON, "evs.contrast_threshold_off": THETA_OFF, "evs.leak": leak, **changes},
    )  # fmt: skip
    return EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.full(1, 1.3))


def run(noise, until_us, electrons=0.0, seed=3, **keys):
    """Times in µs after the first sample, flat pixels and polarities of all events."""
    light, stage = from_host(jit().Float, np.full(PIXELS, electrons, np.float32)), EvsStage(noise, seed, **keys)
    stage.step(light, 7_000)
    events = np.concatenate([stage.step(light, 7_000 + int(t)) for t in until_us])
    place = events["y"].astype(int) * SHAPE[1] + events["x"]
    return events["t_us"] - 7_000, place, events["polarity"]


def numpy_pixels(rng, rate_hz, sigma, span_s, warm_s):
    """Counts [pixel] of ON and OFF events and all ON intervals, s, of pixels that have run for `warm_s` before."""
    pole = 2 * np.pi * CUTOFF_HZ / np.sqrt(np.sqrt(2) - 1)
    dt = 1 / (16 * CUTOFF_HZ)
    h = pole * dt
    move = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    fresh = np.linalg.cholesky(np.eye(2) - move @ move.T)
    amplitude = sigma * np.sqrt(3 / (2 + (1 + h) * np.exp(-h)))
    state = rng.standard_normal((2, rate_hz.size))
    reference = amplitude * state[0] - THETA_ON * rng.random(rate_hz.size)
    counts, last, intervals = np.zeros((2, rate_hz.size), int), np.full(rate_hz.size, np.nan), []
    for k in range(round((warm_s + span_s) / dt)):
        state = move @ state + fresh @ rng.standard_normal(state.shape)
        reference -= THETA_ON * rate_hz * dt
        distance = amplitude * state[0] - reference
        on, off = distance >= THETA_ON, distance <= -THETA_OFF
        reference += THETA_ON * on - THETA_OFF * off
        if k * dt >= warm_s:
            counts += np.stack([on, off])
            intervals.append(k * dt - last[on & np.isfinite(last)])
            last[on] = k * dt
    return counts, np.concatenate(intervals)


def test_without_noise_intervals_are_those_of_each_pixels_own_current():
    """Currents of the dark, of the light and of the tail, over each pixel's own threshold; intervals are equal."""
    leak = {"process": "drift", "rate_hz": 3.1, "rate_hz_per_dn": 0.07, "spread_rel": 0.2, "tail_hz": 1.7}
    noise = pixels(leak, evs__threshold_mismatch_rel=0.12)
    electrons = 4.3
    t_us, place, polarity = run(noise, (170_000, 1_000_003, 3_000_000), electrons)
    assert np.all(polarity == 1)
    signal_dn = 0.2 * 10_000 / noise.spec.window_us * 1.3 * electrons
    order = np.lexsort((t_us, place))
    times, own = t_us[order], place[order]
    within = np.diff(own) == 0
    interval, of = np.diff(times)[within], own[1:][within]
    mean_us = np.bincount(of, interval, PIXELS) / np.bincount(of, minlength=PIXELS)
    assert np.all(np.abs(interval - mean_us[of]) < 60)  # levels are single precision: 3e-6 of a threshold of 0.19
    rate = 1e6 / mean_us * noise.threshold_on_map.ravel() / THETA_ON
    # the law over pixels: median of normal part and tail together, by the same law drawn here
    rng = np.random.default_rng(8)
    z, u = rng.standard_normal(400_000), rng.random(400_000)
    drawn = (3.1 + 0.07 * signal_dn) * (1 + 0.2 * z) + 1.7 * u / (1 - u)
    assert stats.ks_2samp(rate, drawn).pvalue > 1e-5


def test_the_spread_of_each_pixel_is_the_deviate_of_its_own_stream():
    """Keys and signs too: a device of a seed stays that device."""
    noise = pixels({"process": "drift", "rate_hz": 4.0, "rate_hz_per_dn": 0.0, "spread_rel": 0.15})
    t_us, place, _ = run(noise, (600_000, 1_700_000))
    first, last = np.full(PIXELS, 10**9), np.zeros(PIXELS)
    np.minimum.at(first, place, t_us)
    np.maximum.at(last, place, t_us)
    rate = 1e6 * (np.bincount(place, minlength=PIXELS) - 1) / (last - first)
    deviates = device_normal(noise.device_seed, Stream.LEAK_SPREAD, np.arange(PIXELS, dtype=np.uint32))
    np.testing.assert_allclose(rate, 4.0 * (1 + 0.15 * deviates.astype(float)), rtol=2e-3)


def test_it_begins_as_after_a_long_time():
    """Without noise the first event of a pixel is evenly distributed over its interval."""
    noise = pixels({"process": "drift", "rate_hz": 2.6})
    t_us, place, _ = run(noise, (50_000, 700_000))
    first = np.full(PIXELS, 10**9)
    np.minimum.at(first, place, t_us)
    assert stats.kstest(first * 2.6e-6, "uniform").pvalue > 1e-5


@pytest.mark.parametrize("events_hz", [0.0, 0.4, 30.0])
def test_the_last_event_lies_back_by_its_own_law(events_hz):
    """Drift of 2.6 events/s; noise events end it earlier: what passed is exponential, cut at a whole drift."""
    drift = LeakDrift(pixels({"process": "drift", "rate_hz": 2.6}))
    chance = np.linspace(0.01, 0.99, PIXELS)
    drift.start(from_host(jit().Float, np.zeros(PIXELS, np.float32)), False, np.full(PIXELS, events_hz), chance)
    passed_s = chance / 2.6
    if events_hz:
        passed_s = stats.truncexpon(events_hz / 2.6, scale=1 / events_hz).ppf(chance)
    np.testing.assert_allclose(np.array(drift.way), THETA_ON * 2.6 * passed_s, rtol=1e-5)


def test_the_way_at_an_event_counts_from_the_last_sample():
    drift = LeakDrift(pixels({"process": "drift", "rate_hz": 2.6}))
    light = from_host(jit().Float, np.zeros(PIXELS, np.float32))
    drift.start(light, True, np.zeros(PIXELS), np.zeros(PIXELS))
    events = np.zeros(2, EVENT_DTYPE)
    events["t_us"], events["x"], events["y"], events["polarity"] = (252_000, 257_000), (5, 9), (3, 3), 1
    drift.pass_by(events, SHAPE[1], light, 250_000, 260_000)
    per_us = THETA_ON * 2.6e-6
    expected = np.zeros(PIXELS)
    expected[[3 * SHAPE[1] + 5, 3 * SHAPE[1] + 9]] = 2000 * per_us, 7000 * per_us
    np.testing.assert_allclose(drift._at_event, expected, rtol=1e-5)
    np.testing.assert_allclose(np.array(drift.way), 10_000 * per_us, rtol=1e-5)


@pytest.mark.parametrize(("sigma", "rate_hz"), ((0.045, 2.2), (0.07, 0.9)), ids=("regular", "with-noise-events"))
def test_noise_and_drift_against_numpy(sigma, rate_hz):
    """Counts of both polarities within 4.5 standard errors, ON intervals by Kolmogorov and Smirnov."""
    span_s = 2.5
    counts, intervals = numpy_pixels(np.random.default_rng(4), np.full(PIXELS, rate_hz), sigma, span_s, 1.5)
    t_us, place, polarity = run(pixels({"process": "drift", "rate_hz": rate_hz}, sigma), (400_000, span_s * 1e6))
    for sign, theirs in ((1, counts[0]), (-1, counts[1])):
        ours = np.bincount(place[polarity == sign], minlength=PIXELS)
        error = np.sqrt((ours.var() + theirs.var()) / PIXELS)
        assert abs(ours.mean() - theirs.mean()) <= 4.5 * error + 0.01 * theirs.mean()
    order = np.lexsort((t_us, place))
    order = order[polarity[order] > 0]
    own = np.diff(t_us[order])[np.diff(place[order]) == 0] * 1e-6
    assert stats.ks_2samp(own, intervals).statistic < 0.025
    assert intervals.size > 2000


@pytest.mark.slow
@pytest.mark.parametrize("changes", ({}, {"evs__refractory_period_us": 2500}), ids=("plain", "dead-time"))
def test_the_rate_does_not_depend_on_time(changes):
    """Noise events and drift together: the first 0.3 s against the 1.2 s after them, within 10 %: the law with which
    pixels begin takes drift and noise one after the other. From a reset it would be 40 % of ON events too few.
    """
    leak = {"process": "drift", "rate_hz": 1.4, "spread_rel": 0.25}
    noise = pixels(leak, 0.062, evs__threshold_mismatch_rel=0.09, **changes)
    t_us, _, polarity = run(noise, (300_000, 1_500_000))
    for sign in (1, -1):
        early = np.count_nonzero((t_us <= 300_000) & (polarity == sign)) / 0.3
        late = np.count_nonzero((t_us > 300_000) & (polarity == sign)) / 1.2
        assert abs(early / late - 1) < 0.1


def test_steps_do_not_matter():
    """Two samples or two hundred, and more than 4 ln units of drift on the way: the same events to 30 µs."""
    noise = pixels({"process": "drift", "rate_hz": 40.0, "spread_rel": 0.3})
    few, many = (run(noise, np.linspace(0, 1_500_000, count + 1)[1:]) for count in (2, 200))
    assert few[0].size > 50 * PIXELS
    counts = [np.bincount(found[1], minlength=PIXELS) for found in (few, many)]
    same = counts[0] == counts[1]
    assert np.count_nonzero(~same) <= 3  # an event at the very end
    times = [
        found[0][np.lexsort((found[0], found[1]))][np.repeat(same, count)]
        for found, count in zip((few, many), counts, strict=True)
    ]
    assert np.max(np.abs(times[0] - times[1])) <= 30


def test_changing_light_is_integrated():
    """Current that grows with the light while it ramps: events at the times of the integral, within 30 µs."""
    leak = {"process": "drift", "rate_hz": 5.0, "rate_hz_per_dn": 1.9}
    noise = pixels(leak, evs__coefficients=[{"beta1": 0.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.0}])
    per_electron = 0.2 * 10_000 / noise.spec.window_us * 1.3
    stage = EvsStage(noise, 3, is_reset=True)
    light = [from_host(jit().Float, np.full(PIXELS, value, np.float32)) for value in (0.0, 12.0)]
    stage.step(light[0], 1_000)
    events = stage.step(light[1], 401_000)
    one = events[(events["x"] == 5) & (events["y"] == 9)]["t_us"] - 1_000
    last = 5.0 + 1.9 * per_electron * 12.0
    slope = (last - 5.0) / 0.4
    expected = (-5.0 + np.sqrt(25 + 2 * slope * np.arange(1, one.size + 1))) / slope * 1e6
    assert one.size == int(0.4 * (5.0 + last) / 2)
    # between two samples a noiseless level is one straight line: the mean current
    assert abs(one[-1] - expected[-1]) < 1.1e6 / (0.5 * (5.0 + last))


def test_an_on_event_is_the_drifts_from_half_a_threshold_on():
    """At 2 Hz the drift has passed 0.45 and 0.55 of a threshold after 225 and 275 ms; OFF events are never its own."""
    drift = LeakDrift(pixels({"process": "drift", "rate_hz": 2.0, "rate_hz_per_dn": 0.0, "spread_rel": 0.0}))
    dark = from_host(jit().Float, np.zeros(PIXELS, np.float32))
    drift.start(dark, True, np.zeros(PIXELS), np.zeros(PIXELS))
    given = [(225, 3, 1, 1), (275, 4, 1, 1), (290, 2, 7, -1), (490, 4, 1, 1), (530, 3, 1, 1), (560, 2, 7, 1)]
    events = np.array([(1000 * ms + 50, x, y, p) for ms, x, y, p in given], EVENT_DTYPE)
    drift.pass_by(events, SHAPE[1], dark, 50, 600_050)
    # the third pixel's ON comes 0.54 after its own OFF, the others' second ones 0.43 and 0.61 after their first
    assert (events["polarity"] == Origin.DRIFT).tolist() == [False, True, False, False, True, True]


def test_origin_and_label():
    """Without a light signal all events of a drift are leak; steps of light in between stay signal, but for the half
    event that a drifted reference gives in addition.
    """
    noise = pixels({"process": "drift", "rate_hz": 4.0, "spread_rel": 0.1})
    labeller = Labeller(noise, 3, 10**9)
    stage = EvsStage(noise, 3, labels=labeller)
    bright = from_host(jit().Float, np.full(PIXELS, 9.0, np.float32))
    stage.step(bright, 1_000)
    for k in range(1, 6):
        stage.step(bright, 1_000 + 100_000 * k)
    found = labeller.taken().label
    assert found.size > PIXELS
    assert np.all(found == 2)
    up = from_host(jit().Float, np.full(PIXELS, 22.0, np.float32))
    stage.step(up, 501_200)
    stage.step(up, 501_400)
    found = labeller.taken().label
    assert 0.85 < np.mean(found == 0) < 0.95


def test_a_state_goes_on():
    """A stage that is saved and resumed gives the same events."""
    noise = pixels({"process": "drift", "rate_hz": 6.0, "tail_hz": 0.4}, 0.05)
    light = from_host(jit().Float, np.full(PIXELS, 2.0, np.float32))
    whole, first = EvsStage(noise, 3), EvsStage(noise, 3)
    for stage in (whole, first):
        stage.step(light, 0)
        stage.step(light, 150_000)
    state = first.state()
    first.step(light, 200_000)
    second = EvsStage(noise, 3)
    second.resume(state)
    expected, found = whole.step(light, 400_000), second.step(light, 400_000)
    assert expected.size > 1000
    assert np.array_equal(expected, found)


def test_it_can_be_switched_off_and_poisson_is_as_before():
    noise = pixels({"process": "drift", "rate_hz": 6.0})
    assert run(noise.without("leak"), (300_000,))[0].size == 0
    before, now = pixels(None, evs__leak_rate_hz=7.5), pixels({"process": "poisson", "rate_hz": 7.5})
    assert all(np.array_equal(a, b) for a, b in zip(run(before, (300_000,)), run(now, (300_000,)), strict=True))


def test_the_mean_rate_is_that_of_its_law():
    leak = LeakSpec(process="drift", rate_hz=0.7, rate_hz_per_dn=0.02, spread_rel=0.2, tail_hz=0.9)
    u = (np.arange(2_000_000) + 0.5) / 2_000_000 * 1000 / 1000.9
    assert leak.mean_rate_hz(11.0) == pytest.approx(0.7 + 0.22 + np.mean(0.9 * u / (1 - u)), rel=1e-3)


@pytest.mark.parametrize(("changes", "told"), (
    ({"evs.leak": {"process": "drift", "rate_hz": 1.0}, "evs.reference": "previous_sample"}, "a fixed tick"),
    ({"evs.leak": {"process": "poisson", "rate_hz": 1.0, "spread_rel": 0.2}}, "'poisson' has rate_hz alone"),
    ({"evs.leak": {"process": "poisson", "rate_hz": 1.0}, "evs.leak_rate_hz": 2.0}, "leave one of them out"),
), ids=("tick", "poisson-spread", "twice"))  # fmt: skip
def test_keys_that_do_not_go_together(changes, told):
    with pytest.raises(SpecError, match=told):
        read_sensor("reference-mono", {"evs.noise_cutoff_hz": 90.0, "evs.reference": "last_event", **changes})


def test_the_mean_leak_of_a_pixel_grows_with_its_signal():
    """And the tail adds the mean of a law with the share T/(T + r) above r, cut off at 1 kHz."""
    plain = LeakSpec(process="drift", rate_hz=0.3, rate_hz_per_dn=0.02)
    assert plain.mean_rate_hz(40.0) == pytest.approx(1.1)
    tail = plain.model_copy(update={"tail_hz": 0.5})
    rate = np.linspace(0, 1000, 2_000_001)
    share = (0.5 / (0.5 + rate) - 0.5 / 1000.5) / (1 - 0.5 / 1000.5)
    assert tail.mean_rate_hz(40.0) == pytest.approx(1.1 + np.trapezoid(share, rate), rel=1e-4)

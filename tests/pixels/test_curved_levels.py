"""Events of asynchronous pixels behind a photoreceptor, whose levels are curves between samples."""

import numpy as np
import pytest
from test_evs_limits import FIXED, FOLLOWING, RATE, asynchronous, brute_force, electrons

from hesim_render.pixels.evs import last_event
from hesim_render.pixels.evs.photoreceptor import Photoreceptor
from hesim_render.pixels.evs.processes import BandNoise
from hesim_render.pixels.evs.stage import EvsStage

EVERY_US, SAMPLES, SIDE = 1700, 24, 8
#: Random light, ln x [sample, row, col]: still, then slow and fast changes in both directions.
LEVELS = np.cumsum(np.random.default_rng(5).normal(0, 0.25, (SAMPLES, SIDE, SIDE)), axis=0)
LEVELS = np.maximum(LEVELS + np.linspace(0.4, 4.0, SIDE), 0.05)
LEVELS[:3] = LEVELS[2]

NOISY = {
    "evs__coefficients": [{"beta1": 1.0, "beta2": 1.0, "beta3": 0.0, "beta4": 0.1, "beta5": 0.0}],
    "evs__threshold_mismatch_rel": 0.1,
}


def events_of(noise, levels=LEVELS, seed=3):
    stage = EvsStage(noise, seed=seed, is_reset=True)
    return np.concatenate([stage.step(electrons(v, noise), EVERY_US * k) for k, v in enumerate(levels)])


def filtered_every(step_us, levels, follows):
    """y every `step_us`, by exact steps of two poles with the rate at the middle of each; NumPy alone."""
    times = np.arange(0, EVERY_US * (len(levels) - 1) + 0.5 * step_us, step_us)
    samples = EVERY_US * np.arange(len(levels))
    light = np.stack([np.interp(times, samples, column) for column in levels.reshape(len(levels), -1).T], axis=1)
    z = y = light[0]
    result = [y]
    for before, after in zip(light[:-1], light[1:], strict=True):
        middle = 0.5 * (before + after)
        h = RATE * step_us * (np.minimum(0.01 + 0.99 * np.expm1(middle) / 100.0, 1.0) if follows else 1.0)
        decay = np.exp(-h)
        z, y = middle + decay * (z - middle), middle + decay * (y - middle + h * (z - middle))
        result.append(y)
    return times, np.array(result)


def stairs(times_us, level, theta_on, theta_off):
    """One pixel without a dead time: its reference goes up or down by a threshold at each event."""
    reference, result = level[0], []
    for t, value in zip(times_us, level, strict=True):
        while value - reference >= theta_on:
            reference += theta_on
            result.append((t, 1))
        while reference - value >= theta_off:
            reference -= theta_off
            result.append((t, -1))
    return result


def noise_every(times, noise, seed, cutoff_hz):
    """The noise of all pixels at some times: on lines between its nodes, 16 a period, and the samples."""
    process = BandNoise(noise, seed=seed)
    nodes = np.union1d(np.arange(0, times[-1], 1e6 / (16 * cutoff_hz)), EVERY_US * np.arange(SAMPLES))
    unit = np.array([np.array(process.start(0)), *(np.array(process.at(float(t))) for t in nodes[1:])], float)
    spread = 0.1 * np.exp(-LEVELS.reshape(SAMPLES, -1))
    samples = EVERY_US * np.arange(SAMPLES)
    at_nodes = unit * np.stack([np.interp(nodes, samples, column) for column in spread.T], axis=1)
    return np.stack([np.interp(times, nodes, column) for column in at_nodes.T], axis=1)


@pytest.mark.parametrize(
    ("follows", "dead_us", "noisy"),
    ((False, None, False), (False, 600, False), (True, None, False), (True, 600, False), (True, None, True)),
)
def test_events_are_those_of_the_curve(follows, dead_us, noisy):
    """Every event against steps of 2 µs; between two nodes, 104 µs apart, y is taken as a straight line."""
    light = {"evs__photoreceptor": FOLLOWING if follows else FIXED, "evs__noise_cutoff_hz": 130.0}
    coefficients = {"evs__coefficients": NOISY["evs__coefficients"]} if noisy else {}
    noise = asynchronous(SIDE, evs__refractory_period_us=dead_us, **light, **coefficients)
    events = events_of(noise)
    times, paths = filtered_every(2.0, LEVELS, follows)
    if noisy:
        paths = paths + noise_every(times, noise, 3, 130.0)
    # with a dead time, what is off by a few µs shifts the references of all that follows
    most_us = 40 if dead_us else 12
    total = differing = 0
    for pixel in range(SIDE * SIDE):
        path = paths[:, pixel]
        expected = brute_force(times, path, 0.2, 0.23, dead_us) if dead_us else stairs(times, path, 0.2, 0.23)
        one = events[(events["y"] * SIDE + events["x"]) == pixel]
        total += len(expected)
        same = len(one) == len(expected) and np.all(np.abs(one["t_us"] - [t for t, _ in expected]) < most_us)
        differing += not (same and np.array_equal(one["polarity"], [sign for _, sign in expected]))
    assert total > 250 and {-1, 1} == set(events["polarity"].tolist())
    # a crossing that only just touches may fall to either side
    assert differing <= 2


@pytest.mark.slow
@pytest.mark.parametrize("drift", (False, True))
@pytest.mark.parametrize("dead_us", (None, 600))
def test_pixels_far_from_a_threshold_are_not_followed_and_lose_nothing(dead_us, drift, monkeypatch):
    """All pixels followed, only those that need it, and these in small parts: the same events to the bit."""
    light = {"evs__leak": {"process": "drift", "rate_hz": 30.0}} if drift else {"evs__leak_rate_hz": 40.0}
    given = NOISY | light
    given["evs__contrast_threshold_on"] = 0.27 if dead_us else 0.2  # above and below θ₋
    noise = asynchronous(SIDE, evs__photoreceptor=FOLLOWING, evs__refractory_period_us=dead_us, **given)
    counted, along = [], Photoreceptor.along
    monkeypatch.setattr(Photoreceptor, "along", lambda self, *args: counted.append(len(args[2])) or along(self, *args))
    events = events_of(noise)
    near = sum(counted)
    counted.clear()
    monkeypatch.setattr(last_event, "_PATHS", 37)
    np.testing.assert_array_equal(events_of(noise), events)
    assert sum(counted) == near and max(counted) == 37 and len(counted) > 10
    counted.clear()
    monkeypatch.setattr(last_event, "_MARGIN_REL", 1e9)
    np.testing.assert_array_equal(events_of(noise), events)
    assert len(events) > 250
    assert 0.05 * sum(counted) < near < 0.7 * sum(counted)

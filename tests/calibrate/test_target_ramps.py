"""Noise in the ramps of a moving target's light (`calibrate.recordings.ramps`): laws by hand, and against noise written
in NumPy.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp

from hesim_render.calibrate.recordings import ramps, rests, target
from hesim_render.calibrate.recordings.tally import GROUPS, tally
from hesim_render.exchange import EventStream
from hesim_render.pixels.evs.events import EVENT_DTYPE
from tests.calibrate.test_target_rests import Sensor, judged, recordings

POLE = 2 * np.pi / np.sqrt(np.sqrt(2) - 1)


def ramp_events(rng, sigma, cutoff_hz, interval_s, pixels, count=9):
    """Times in s of events 2 to 2 + count of pixels whose light rises by a threshold an interval: [event, pixel]."""
    pole = POLE * cutoff_hz
    dt = min(interval_s / 40, 0.08 / pole)
    h = pole * dt
    move = np.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    fresh = np.linalg.cholesky(np.eye(2) - move @ move.T)
    state = rng.standard_normal((2, pixels))
    times, number = np.full((count + 4, pixels), np.nan), np.zeros(pixels, int)
    before, step = sigma * state[0], rng.random(pixels)
    reference = before - step
    for k in range(1, round((count + 6) * interval_s / dt)):
        state = move @ state + fresh @ rng.standard_normal(state.shape)
        level = k * dt / interval_s + sigma * state[0]
        some = np.flatnonzero(level >= reference + 1)
        place = (reference[some] + 1 - before[some]) / (level[some] - before[some])
        times[np.minimum(number[some], count + 3), some] = (k - 1 + place) * dt
        number[some] += 1
        reference[some] += 1
        before = level
    return times[2 : 2 + count]


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "cutoff_hz"), [(0.02, 8.0), (0.05, 25.0), (0.15, 12.0), (0.08, 150.0), (0.2, 70.0),
                                                  (0.1, 400.0), (0.15, 500.0)])  # fmt: skip
def test_noise_moves_events_of_a_ramp_as_the_law_says(sigma, cutoff_hz):
    """Intervals of 20 ms: σ p I of 0.03 to 15. The median size of D within 8 %, its error is 2.5 %."""
    rng = np.random.default_rng(3)
    times = ramp_events(rng, sigma, cutoff_hz, 0.02, 1600)[3:7]
    log = np.log(np.diff(times[:, np.isfinite(times).all(axis=0)], axis=0))
    second = log[0] - 2 * log[1] + log[2]
    deviation = np.median(np.abs(second)) / 0.674490
    expected = ramps.variance(np.array(sigma), np.array(cutoff_hz), np.array(0.02))
    assert deviation == pytest.approx(np.sqrt(expected), rel=0.08)


def test_slow_noise_moves_neighbours_alike_and_strong_noise_is_not_known():
    """By the covariance of four values, −1, 3, −3, 1 times each; ten times the noise is that of a quarter threshold."""
    t = 0.003 * np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    alike = (1 + POLE * 40 * t) * np.exp(-POLE * 40 * t)
    by = np.array([-1, 3, -3, 1])
    still = ramps.variance(np.array([0.01, 2.5, 0.25]), np.array(40.0), np.array(0.003))
    assert still[0] == pytest.approx(0.01**2 * by @ alike @ by)
    assert still[1] == still[2] > 100 * still[0]


def kept(rng, sigma, interval_us, *, pixels=400, cycles=6, clock_us=1, bend=0.0, is_on=True, length=12, turn=1.0):
    """A tally of pixels with a ramp a cycle of 1 s, each event moved by a normal deviate of σ intervals."""
    place = np.arange(length) + bend * np.sin(np.arange(length))
    start = (np.arange(cycles) + 0.2) * 1e6 * turn
    t = start[:, None, None] + interval_us * (place + sigma * rng.standard_normal((cycles, pixels, length)))
    back = start[:, None, None] + 5e5 + 1000.0 * np.arange(3) + np.zeros((cycles, pixels, 1))
    t = np.concatenate([t, back], axis=2).transpose(1, 0, 2).reshape(pixels, -1)
    on = np.tile(np.append(np.full(length, is_on), np.full(3, not is_on)), (pixels, cycles))
    pixel = np.repeat(np.arange(pixels), t.shape[1])
    t_us = (np.rint(t / clock_us) * clock_us).astype(np.int64).ravel()
    return SimpleNamespace(
        kept=lambda: (pixel, t_us, on.ravel()), period_s=lambda: 1.0, group=np.arange(pixels, dtype=np.uint64) % GROUPS
    )


@pytest.mark.parametrize("is_on", [True, False])
@pytest.mark.parametrize(("clock_us", "bend"), [(1, 0.0), (300, 0.0), (1, 0.2)])
def test_the_scatter_of_a_ramp_is_that_of_its_events(is_on, clock_us, bend):
    """20 σ² for deviates of their own, without the light's own bends and the steps of the clock, which add 19 %.

    The longer half of the intervals is taken, in which noise counts for 6 % less; the error is 2 %, by bends 3 %.
    """
    given = kept(np.random.default_rng(2), 0.02, 10_000, is_on=is_on, clock_us=clock_us, bend=bend)
    of = ramps.jitter(given)
    assert (of.is_on == is_on).all() and of.is_on.size <= 2
    assert of.interval_s == pytest.approx(0.01, rel=0.2)
    of_events = of.variance * (of.interval_s / 0.01) ** 2
    assert np.average(of_events, weights=of.error**-2) == pytest.approx(0.94 * 20 * 0.02**2, rel=0.07)
    assert np.all((of.error > 0.002) & (of.error < 0.1))
    if clock_us > 1:
        exact = ramps.jitter(kept(np.random.default_rng(2), 0.02, 10_000, is_on=is_on))
        assert of.variance == pytest.approx(exact.variance, rel=0.01)


def test_ramps_of_a_few_events_or_of_another_speed_tell_nothing():
    """Six events of a ramp are needed, as its ends do not count; cycles 1.3 times as long are none of one period."""
    rng = np.random.default_rng(6)
    assert ramps.jitter(kept(rng, 0.05, 10_000, length=5)) is None
    assert ramps.jitter(kept(rng, 0.05, 10_000, length=6)) is not None
    assert ramps.jitter(kept(rng, 0.05, 10_000, turn=1.3)) is None
    assert ramps.jitter(kept(rng, 0.05, 10_000, turn=1.1)) is not None
    # steps of the clock that make more than three tenths of the scatter
    assert ramps.jitter(kept(rng, 0.03, 10_000, clock_us=2000)) is None
    # a variance of 0.2, that of deviates of a tenth, is the largest one that tells
    assert ramps.jitter(kept(rng, 0.09, 10_000)) is not None and ramps.jitter(kept(rng, 0.12, 10_000)) is None
    without = kept(rng, 0.05, 10_000)
    without.period_s = lambda: None
    assert ramps.jitter(without) is None


def test_the_chance_of_a_scatter_is_that_of_its_logarithm():
    """A mean of the noise over the ramp, in thresholds of the polarity; the error of the law counts once for all."""
    noise, cut = np.array([0.03, 0.05, 0.09]), np.array([40.0, 300.0])
    of = ramps.Jitter(np.array([True, False]), np.array([0.004, 0.007]), np.array([0.02, 0.03]), np.array([0.05, 0.1]))
    told = ramps._of_ramps(noise, cut, of, 1.3)
    for b, k, j in ((0, 0, 0), (1, 2, 1), (1, 0, 2)):
        bright, dark = noise[k], 1.3 * noise[j]
        level = np.linspace(0, 1, 100_001)
        mean = np.sqrt(np.mean((bright * level + dark * (1 - level)) ** 2))
        chance = 0.0
        for i in range(2):
            own = ramps.variance(np.array(mean / (1, 1.3)[i]), cut[b], of.interval_s[i])
            unsure = 0.15**2 + (0.25 * np.log(bright**2 / dark**2)) ** 2
            spread = np.sqrt(of.error[i] ** 2 + 2 * unsure)
            chance -= 0.5 * (np.log(of.variance[i] / own) / spread) ** 2 + np.log(spread)
        assert told[b, k, j] == pytest.approx(chance, rel=1e-3)


def test_each_rest_has_the_chance_of_the_other_and_of_the_ramps(monkeypatch):
    """Ramps that say what late events exclude do not count."""
    rng = np.random.default_rng(7)
    noise, cut = np.array([0.03, 0.05, 0.09]), np.array([40.0, 90.0, 300.0, 900.0])
    top, bottom, own = rng.standard_normal((4, 3)), rng.standard_normal((4, 3)), rng.standard_normal((4, 3, 3))
    monkeypatch.setattr(ramps, "_of_ramps", lambda *_: own)
    for given in (own, np.zeros_like(own)):
        told = ramps.likelihoods(top, bottom, noise, cut, "of ramps" if given is own else None, 1.2)
        assert np.array_equal(told[2], given)
        for b in range(4):
            for k in range(3):
                assert told[0][b, k] == pytest.approx(logsumexp(given[b, k] + bottom[b]))
                assert told[1][b, k] == pytest.approx(logsumexp(given[b, :, k] + top[b]))
    late = np.full((4, 3), -40.0)
    late[0, 0] = 0.0
    for drop, counts in ((4.4, True), (4.6, False)):
        own = np.zeros((4, 3, 3))
        own[0, 0, 0] = -drop
        told = ramps.likelihoods(late, late, noise, cut, "of ramps", 1.0)[0]
        assert told[0, 0] == pytest.approx(-drop if counts else 0.0)


def test_events_of_some_pixels_are_kept_by_pixel_and_time(monkeypatch):
    """Of 60 pixels five, and of those that count alone; blocks after the most events are not."""
    rng = np.random.default_rng(8)
    events = np.zeros(6000, EVENT_DTYPE)
    events["t_us"], events["x"] = np.sort(rng.integers(1, 10**6, 6000)), rng.integers(0, 60, 6000)
    events["polarity"] = rng.choice([-1, 1], 6000)
    stream = EventStream(lambda: iter(np.split(events, 6)), (1, 60))
    monkeypatch.setattr("hesim_render.calibrate.recordings.tally._KEPT_PIXELS", 5)
    only = np.arange(60) % 2 == 1
    for chosen in (None, only):
        pixel, t_us, on = tally(stream, chosen).kept()
        mine = np.unique(pixel)
        assert mine.size == 5 and (chosen is None or chosen[mine].all())
        for one in mine:
            own = events[events["x"] == one]
            assert np.array_equal(t_us[pixel == one], own["t_us"])
            assert np.array_equal(on[pixel == one], own["polarity"] > 0)
        assert (np.diff(pixel) >= 0).all()
    monkeypatch.setattr("hesim_render.calibrate.recordings.tally._KEPT", 100)
    few = tally(stream).kept()[1]
    assert few.size < 300 and few.max() < events["t_us"][3000]


@pytest.mark.slow
def test_ramps_tell_the_bandwidth_that_late_events_do_not(monkeypatch):
    """Noise of 60 Hz: thresholds to 1 %, and an interval of less than two thirds of that without the ramps."""
    of = Sensor(0.18, 1.1, 0.07, (1 / 18, 1 / 18), 60.0, 0.1, 2.4, 2.0, (0.4, 0.36))
    one = recordings(of, 11, 1)
    outcome = judged(of, one)[0]
    assert outcome[:2, 0].all() and np.abs(outcome[:2, 1]).max() < 0.01, outcome
    wide = []
    for known in (True, False):
        if not known:
            monkeypatch.setattr(target, "jitter", lambda _: None)
        low, high = target.thresholds(one[0], np.exp(of[6]), None, of[5]).entries["theta_on"]["interval_95"]
        wide.append(high - low)
    assert wide[0] < 0.67 * wide[1], wide


def test_late_events_of_light_that_comes_to_its_rest_slowly_are_no_noise(monkeypatch):
    """A tail as large as the noise that falls by a factor of 3: noise 20 % lower at most, and known less well. Taken
    for noise, it makes the overshoot half as large again. Without one nothing changes.
    """
    slopes, seconds = rests.Ramps((60.0, 70.0), 0.0, 0.16), np.array([0.02, 0.04, 0.08, 0.16])
    sigma, cutoff_hz = np.array(0.06), np.array(90.0)
    begins = rests._mean(rests.highest(sigma, cutoff_hz, slopes, seconds[:-1], False))
    end = rests._mean(rests.highest(sigma, cutoff_hz, slopes, seconds[-1:], True))
    noise = 0.06 * np.diff(np.append(begins, end)) * 20_000
    at = np.argmin(np.abs(np.log(rests._CUTOFF_HZ / 90)))

    def overshoot(tail):
        late = noise + tail * noise[0] / 3.0 ** np.arange(3)
        log, mean = rests._posterior(rests.Rest(slopes, seconds, late, 20_000.0, 1.0, False))
        weight = np.exp(log[0, at] - log[0, at].max())
        value = np.average(mean[0, at], weights=weight)
        return value, np.sqrt(np.average((mean[0, at] - value) ** 2, weights=weight))

    (without, sure), (slow, unsure) = overshoot(0.0), overshoot(1.0)
    assert without == pytest.approx(0.06 * end[0], rel=0.05) and sure < 0.03 * without
    assert 0.8 * without < slow < 1.1 * without and unsure > 0.1 * without
    monkeypatch.setattr(rests, "_tails", lambda late: [])
    assert overshoot(1.0)[0] > 1.4 * without


@pytest.mark.slow
def test_rests_that_are_short_beside_the_intervals_of_a_ramp_have_their_noise_from_the_ramps(monkeypatch):
    """Six events a ramp and rests of as long as eight of them: no late event is one for sure. Without a correction
    thresholds are 3 % too low, many of their errors.
    """
    of = Sensor(0.29, 1.13, 0.1, (1 / 24, 1 / 27), 480.0, 0.0, 1.86, 4.2, (0.25, 0.29))
    one = recordings(of, 1031, 1)
    both = rests.rests(one[0], of[5], of[1])
    assert [rest.late.size for rest in both] == [0, 0]
    assert all(rest.edges_s.tolist() == [rest.ramps.rest_s] for rest in both)
    outcome = judged(of, one)[0]
    assert outcome[:2, 0].all() and np.abs(outcome[:2, 1]).max() < 0.02, outcome
    monkeypatch.setattr(target, "jitter", lambda _: None)
    course = target._course(one[0], of[5], 1 / of[7], of[1])
    assert not course.top.any() and not course.ends.any()

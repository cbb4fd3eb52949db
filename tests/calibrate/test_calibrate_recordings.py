"""Event pixels from ordinary recordings: every figure on events of a generator written in NumPy alone
(`tests/support/still_pixels.py`), coverage of the intervals, what is not identifiable, and bad input.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from hesim_render.calibrate.recordings import calibrate_recordings, calibration, short_intervals, still, stillness
from hesim_render.calibrate.recordings.rate_spread import rate_spread, regularity
from hesim_render.calibrate.recordings.short_intervals import dead_time, readout_limit
from hesim_render.calibrate.recordings.tally import GROUPS, LONG_US, tally
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.exchange import EventStream
from hesim_render.pixels.evs.events import EVENT_DTYPE
from tests.support.event_files import written
from tests.support.still_pixels import even_events, random_events, reset_events, still_events, target_events

SHAPE = (22, 27)
PIXELS = SHAPE[0] * SHAPE[1]
LUX = (2.0, 60.0, 700.0)
RISE = 2.1


def sensor(seed):
    """A sensor of its own for each seed: the truth, and its recordings at three lights and of a target."""
    rng = np.random.default_rng(seed)
    theta_on = rng.uniform(0.15, 0.3)
    theta_off, mismatch = theta_on * rng.uniform(0.8, 1.4), rng.uniform(0.05, 0.12)
    on, off = (theta * (1 + mismatch * rng.standard_normal(PIXELS)) for theta in (theta_on, theta_off))
    dark, growth = rng.uniform(0.3, 0.8), rng.uniform(0.5e-3, 2e-3)
    current = theta_on * np.maximum(1 + 0.3 * rng.standard_normal(PIXELS), 0.05)
    events = [
        still_events(rng, on, off, theta_on / part, current * (dark + growth * lux), cutoff_hz=30.0, seconds=6.0,
                     shape=SHAPE)
        for lux, part in zip(LUX, (2.6, 3.4, 9.0), strict=True)
    ]  # fmt: skip
    # the light of the target is another: its leak is that of the still scenes within 10 %, which the intervals hold
    of_light = 1 + 0.1 * rng.standard_normal()
    moving = target_events(rng, on, off, RISE, hz=5.0, cycles=12, shape=SHAPE, sigma=0.001,
                           drift=of_light * current * (dark + growth * 250.0))  # fmt: skip
    more = 1 + mismatch**2  # mean of 1/θ
    truth = {"theta_on": theta_on, "theta_off": theta_off, "threshold_mismatch_rel": mismatch,
             "threshold_ratio": theta_off / theta_on, "leak_dark_hz": dark * more,
             "leak_growth_hz_per_lux": growth * more}  # fmt: skip
    return truth, events, moving


def files(events, moving, folder):
    names = []
    for k, found in enumerate((*events, moving)):
        (folder / str(k)).mkdir()
        names.append(written(found, "evt3" if k % 2 else "npz", folder / str(k), SHAPE))
    return names


def covered(seeds):
    """How often each interval holds the truth, of how many, and the mean error in standard errors."""
    found = {}
    for seed in seeds:
        truth, events, moving = sensor(seed)
        tallies, of_target = ([tally(EventStream.of(one, SHAPE)) for one in part] for part in (events, [moving]))
        entries = calibration.figures(tallies, of_target[0], LUX, np.exp(RISE), None)
        entries = {name: entries[name] for name in truth}
        entries["ratio_alone"] = still.balance(tallies, LUX).ratio
        truth["ratio_alone"] = truth["threshold_ratio"]
        for name, entry in entries.items():
            low, high = entry["interval_95"]
            z = (entry["value"] - truth[name]) / entry["standard_error"]
            found.setdefault(name, []).append((low <= truth[name] <= high, z))
    return {name: (sum(hit for hit, _ in values), np.mean([z for _, z in values])) for name, values in found.items()}


@pytest.mark.slow
def test_intervals_hold_the_truth_of_two_sensors():
    """The seeds are fixed."""
    for name, (hits, z) in covered(range(2)).items():
        assert hits == 2, (name, z)


@pytest.mark.slow
def test_intervals_hold_the_truth_of_a_hundred_sensors():
    for name, (hits, z) in covered(range(20271124, 20271224)).items():
        assert 90 <= hits <= 99, (name, hits)
        assert abs(z) < 0.6, (name, z)


def test_files_of_any_format_give_the_figures_and_a_file_of_them(tmp_path):
    truth, events, moving = sensor(4)
    names, out = files(events, moving, tmp_path), tmp_path / "found.yaml"
    steps = []
    found = calibrate_recordings(
        names[:3], out, lux=LUX, target_file=names[3], target_contrast=np.exp(RISE), shape=SHAPE,
        progress=lambda what, part: steps.append((what, part)),
    )  # fmt: skip
    for name in ("theta_on", "theta_off", "threshold_mismatch_rel", "leak_dark_hz", "leak_growth_hz_per_lux"):
        assert abs(found[name]["value"] - truth[name]) < 4 * found[name]["standard_error"], name
    assert found["findings"] == []
    assert [entry["lux"] for entry in found["recordings"]] == list(LUX)
    counts = [[np.count_nonzero(one["polarity"] == sign) for sign in (1, -1)] for one in events]
    for entry, (on, off) in zip(found["recordings"], counts, strict=True):
        assert entry["on_rate_hz"]["value"] == pytest.approx(on / PIXELS / entry["seconds"])
        assert entry["off_rate_hz"]["value"] == pytest.approx(off / PIXELS / entry["seconds"])
    bright = found["recordings"][2]
    assert bright["on_local_variation"]["value"] < 0.2 < found["recordings"][0]["on_local_variation"]["value"]
    assert "leak_dark_hz" in out.read_text()
    assert [part for _, part in steps] == sorted(part for _, part in steps)
    with pytest.raises(Exception, match="exists"):
        calibrate_recordings(names[:3], out, shape=SHAPE)


def test_blocks_do_not_matter():
    """One block, or many of odd sizes: the same tally."""
    _, events, _ = sensor(6)
    whole = tally(EventStream.of(events[0], SHAPE))
    cuts = np.cumsum(np.random.default_rng(2).integers(1, 900, 200))
    parts = tally(EventStream(lambda: iter(np.split(events[0], cuts[cuts < events[0].size])), SHAPE))
    for name in ("counts", "slices", "intervals", "windows", "pairs"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name)), name
    assert np.allclose(whole.variation, parts.variation)
    assert whole.windows @ np.arange(whole.windows.size) == events[0].size


def test_spread_of_the_rates_has_no_part_of_the_counting():
    """Random events with rates of 30 % spread, and with none."""
    rng = np.random.default_rng(3)
    rates = 20.0 * np.maximum(1 + 0.3 * rng.standard_normal(PIXELS), 0.1)
    found = rate_spread(tally(EventStream.of(random_events(rng, rates, 0.0, seconds=2.0, shape=SHAPE), SHAPE)), 0)
    assert abs(found["value"] - 0.3) < 4 * found["standard_error"] < 0.1
    even = random_events(rng, np.full(PIXELS, 20.0), 0.0, seconds=2.0, shape=SHAPE)
    assert rate_spread(tally(EventStream.of(even, SHAPE)), 0)["value"] == 0
    assert regularity(tally(EventStream.of(even, SHAPE)))["value"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("gamma", "events"), [(40.0, 2.2), (6.0, 3.1), (2.0, 2.4), (1.0, 5.3)])
def test_even_intervals_do_not_hide_the_spread_of_the_rates(gamma, events):
    """So many ON events a pixel and half of the time; without the law of even intervals it is up to 15 % too low."""
    rng, away = np.random.default_rng(21), []
    for _ in range(3):
        rates = events / 1.5 * np.maximum(1 + 0.25 * rng.standard_normal(4000), 0.1)
        seen = even_events(rng, rates, gamma, seconds=3.0, shape=(50, 80))
        of = rate_spread(tally(EventStream.of(seen, (50, 80))), 0)
        true = rates.std() / rates.mean()
        assert abs(of["value"] - true) < 3 * of["standard_error"] < 0.2 * true
        away.append(of["value"] / true - 1)
    assert abs(np.mean(away)) < (0.03 if gamma > 1 else 0.06)


def test_counts_of_like_places_between_whole_numbers_tell_little_of_a_small_spread():
    """2.5 even events of each pixel in half of the time; 1.8 are too few, and so are 180 pairs of intervals."""
    rng, shape = np.random.default_rng(22), (50, 80)
    rates = 2.5 / 1.5 * (1 + 0.08 * rng.standard_normal(4000))
    of = rate_spread(tally(EventStream.of(even_events(rng, rates, 60.0, seconds=3.0, shape=shape), shape)), 0)
    assert of["value"] == 0 and 0.15 < of["upper_limit"] < 0.3
    slow = tally(EventStream.of(even_events(rng, 0.72 * rates, 60.0, seconds=3.0, shape=shape), shape))
    assert "a pixel has 1.8 events in half of the time; 2 are needed" in rate_spread(slow, 0)["reason"]
    few = tally(EventStream.of(even_events(rng, 2 * rates[:20], 60.0, seconds=3.0, shape=(4, 5)), (4, 5)))
    assert "pairs of successive ON intervals; 200 are needed" in rate_spread(few, 0)["reason"]


@pytest.mark.parametrize("dead_us", (23.4, 61.7, 812.5))
def test_dead_time(dead_us):
    hits = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        rate_hz = rng.uniform(100, 600, PIXELS)
        events = random_events(rng, rate_hz, dead_us, seconds=0.5, shape=SHAPE)
        found = dead_time([tally(EventStream.of(events, SHAPE))])
        hits += found["interval_95"][0] <= dead_us <= found["interval_95"][1]
        assert abs(found["value"] - dead_us) < 0.02 * dead_us + 2
    assert hits >= 3
    slow = random_events(rng, np.full(PIXELS, 30.0), 0.0, seconds=3.0, shape=SHAPE)
    assert "no step" in dead_time([tally(EventStream.of(slow, SHAPE))])["reason"]


def with_bursts(seed, dead_us, clock_us, late_us=0.0, spread=0.0):
    """The tally of pixels at random times, four of them hot, all with bursts of noise: what falls into the dead time
    after an event is not one. Times are cut to whole steps of the clock; the read-out may come late.
    """
    rng = np.random.default_rng(seed)
    rate_hz = rng.uniform(3, 50) * np.exp(0.4 * rng.standard_normal(PIXELS))
    rate_hz[rng.choice(PIXELS, 4, replace=False)] += rng.uniform(200, 1500, 4)
    t_us, pixel = [], []
    for rate, many, length_us in ((rate_hz, 1, 3e6), (np.full(PIXELS, rng.uniform(800, 4000)), 3, 8e3)):
        count = rng.poisson(rate * length_us * 1e-6, (many, PIXELS))
        start_us = rng.uniform(0, 3e6, (many, PIXELS)) if many > 1 else np.zeros((1, PIXELS))
        t_us.append(np.repeat(start_us.ravel(), count.ravel()) + rng.uniform(0, length_us, count.sum()))
        pixel.append(np.repeat(np.tile(np.arange(PIXELS), many), count.ravel()))
    t_us, pixel = np.concatenate(t_us), np.concatenate(pixel)
    order = np.lexsort((t_us, pixel))
    t_us, pixel = t_us[order], pixel[order]
    own_us = dead_us * (1 + spread * rng.standard_normal(PIXELS))
    first = np.searchsorted(pixel, np.arange(PIXELS))
    kept, last = np.zeros(t_us.size, bool), np.full(PIXELS, -np.inf)
    for k in range(np.bincount(pixel).max()):
        at = first + k
        is_own = pixel[np.minimum(at, t_us.size - 1)] == np.arange(PIXELS)
        at = at[is_own & (at < t_us.size)]
        at = at[t_us[at] - last[pixel[at]] >= own_us[pixel[at]]]
        kept[at], last[pixel[at]] = True, t_us[at]
    t_us, pixel = t_us[kept], pixel[kept]
    t_us = (t_us + late_us * rng.exponential(size=t_us.size)) // clock_us * clock_us
    order = np.argsort(t_us, kind="stable")
    events = np.zeros(t_us.size, EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us[order], rng.choice([-1, 1], t_us.size)
    events["y"], events["x"] = np.divmod(pixel[order], SHAPE[1])
    return tally(EventStream.of(events, SHAPE))


def test_dead_times_of_clocks_of_1_10_and_1000_microseconds():
    """Of eight intervals three miss the truth with a chance of 6e-3; beside steps of 1 ms nothing is known."""
    hits = 0
    for seed in range(2):
        for dead_us, clock_us, most_us in ((37.4, 1, 1.5), (37.4, 10, 6.0), (183.0, 10, 6.0), (1300.0, 1, 3.0)):
            low, high = dead_time([with_bursts(seed, dead_us, clock_us)])["interval_95"]
            hits += low <= dead_us <= high
            assert high - low < 2 * most_us
    assert hits >= 6
    for dead_us, why in ((1300.0, "after its step at 1000 µs"), (37.4, "times are whole numbers of 1000 µs")):
        found = dead_time([with_bursts(1, dead_us, 1000)])
        assert found["value"] is None and why in found["reason"]


@pytest.mark.slow
@pytest.mark.parametrize(("dead_us", "clock_us", "least"), (
    (37.4, 1, 100), (37.4, 10, 60), (183.0, 1, 100), (183.0, 10, 60), (1300.0, 1, 100), (1300.0, 10, 60),
    (1300.0, 1000, 0), (37.4, 1000, 0), (0.0, 1, 0), (0.0, 10, 0), (0.0, 1000, 0),
))  # fmt: skip
def test_intervals_hold_the_dead_times_of_a_hundred_sensors(dead_us, clock_us, least):
    every = [dead_time([with_bursts(seed, dead_us, clock_us)]) for seed in range(100, 200)]
    known = [one["interval_95"] for one in every if one["value"] is not None]
    assert least <= len(known) <= (100 if least else 3)
    hits = sum(low <= dead_us <= high for low, high in known)
    assert not least or 0.9 * len(known) <= hits, hits


def test_a_gradual_rise_of_the_density_is_in_the_interval():
    """A read-out that is late by 4 µs at random; dead times that differ by 5 %. Their mean is the value."""
    for options in ({"late_us": 4.0}, {"spread": 0.05}):
        found = dead_time([with_bursts(3, 61.0, 1, **options)])
        low, high = found["interval_95"]
        assert low < 57 and high >= 65 and found["value"] == pytest.approx(61, abs=1.5)


def test_noise_of_pixels_that_start_anew_comes_late_after_the_dead_time():
    """Two dead times that are long against the noise are in the interval; a short one, and a rare event, have a bound.

    Of a sensor whose pixels do so (dead time 1 ms, noise of 60 Hz) 6.8 ms were found, 5.5 at least.
    """
    for seed, (theta, cutoff_hz, dead_us) in enumerate(((1.4, 290.0, 3100.0), (0.8, 1400.0, 310.0))):
        rng = np.random.default_rng(seed)
        events = reset_events(rng, theta, cutoff_hz=cutoff_hz, dead_us=dead_us, seconds=120 / cutoff_hz, shape=(20, 30))
        found = dead_time([tally(EventStream.of(events, (20, 30)))])
        low, high = found["interval_95"]
        assert 0.8 * dead_us < low < dead_us < found["value"] < high < 1.15 * dead_us
    events = reset_events(rng, 2.1, cutoff_hz=290.0, dead_us=210.0, seconds=0.3, shape=(20, 30))
    reason = dead_time([tally(EventStream.of(events, (20, 30)))])["reason"]
    assert "comes to a threshold late" in reason and 500 < float(reason.split()[-2]) < 700


def test_the_shortest_time_of_a_moving_target_is_no_dead_time():
    """Pixels that see an edge pass have 900 µs between events; their noise in still light has a dead time of 61."""
    rng = np.random.default_rng(4)
    target = random_events(rng, np.full(PIXELS, 300.0), 900.0, seconds=0.5, shape=SHAPE)
    quiet = random_events(rng, np.full(PIXELS, 2.0), 0.0, seconds=0.4, shape=SHAPE)
    noisy = random_events(rng, np.full(PIXELS, 400.0), 61.0, seconds=0.5, shape=SHAPE)
    quiet, noisy, moving = (tally(EventStream.of(one, SHAPE)) for one in (quiet, noisy, target))
    found = calibration.figures([quiet], moving, None, 3.0, None)["dead_time_us"]
    assert found["value"] is None and "at most 90" in found["reason"]
    # a target without its contrast tells no thresholds
    assert "it takes a recording" in calibration.figures([noisy], moving, None, None, None)["theta_on"]["reason"]
    assert calibration.figures([noisy], moving, None, 3.0, None)["dead_time_us"]["value"] == pytest.approx(61, abs=2)


def test_the_shortest_dead_time_is_judged_by_the_four_microseconds_after_it():
    """30 intervals in each µs from 2 µs on: 120 of them are within a factor of two and a µs, and 100 are needed.

    Two lack them, and with times of whole µs that of 0 µs has half of them anyway: a step at 1.5 µs takes as much.
    """
    counts = np.full(LONG_US, 30)
    counts[:2] = 0
    found = dead_time([SimpleNamespace(intervals=counts)])
    assert found["value"] == pytest.approx(1.5) and "90 % at 2 µs; 0 intervals are shorter" in found["note"]
    counts[2:] = 24
    assert "no step" in dead_time([SimpleNamespace(intervals=counts)])["reason"]


@pytest.mark.parametrize(("fall", "is_known"), ((0.03, True), (0.12, False)))
def test_a_density_that_falls_within_the_counts_at_its_edge_is_not_known(fall, is_known):
    """From 5 µs on, 900 intervals in the first µs; stray ones before it are in each µs, and in the density after it."""
    counts = np.zeros(LONG_US)
    counts[5:] = 900 * np.exp(-fall * np.arange(LONG_US - 5.0))
    found = dead_time([SimpleNamespace(intervals=counts)])
    assert (found["value"] is not None) == is_known
    if is_known:
        assert found["value"] == pytest.approx(4.5, abs=0.02)
        # counting, and 2 % of the density of three counts
        assert found["standard_error"] == pytest.approx(0.140, rel=0.02)
        stray = dead_time([SimpleNamespace(intervals=counts + 20.0)])
        assert stray["value"] == pytest.approx(4.5, abs=0.02)
    else:
        assert "falls at once after its step at 5 µs" in found["reason"]


def stepped(edge, **others):
    """900 intervals in each µs from the edge on, and other numbers where they are given."""
    counts = np.where(np.arange(LONG_US) < edge, 0.0, 900.0)
    for place, count in others.items():
        counts[int(place[1:])] = count
    return dead_time([SimpleNamespace(intervals=counts)])


def test_a_crowded_first_microsecond_bounds_a_late_sharp_step_and_hides_an_early_one():
    """1300 intervals where the density has 900 (chance below 1e-9): a step at 16 µs or later is known to 2 µs, unless
    the density begins to rise more than 2 µs before it. 960 are none too many.
    """
    for edge, others in ((16, {"_16": 1300.0}), (40, {"_40": 1300.0}), (40, {"_40": 1300.0, "_38": 108.0})):
        told = stepped(edge, **others)
        assert (told["value"], *told["interval_95"]) == pytest.approx((edge, edge - 2, edge + 2))
    for edge, others in ((15, {"_15": 1300.0}), (40, {"_40": 1300.0, "_37": 108.0})):
        assert "falls at once" in stepped(edge, **others)["reason"]
    assert stepped(40, _40=960.0)["value"] == pytest.approx(39.5 - 60 / 900)
    # the shortest dead time that shows
    assert stepped(2)["value"] == pytest.approx(1.5) and "no step" in stepped(1)["reason"]


def test_a_rise_over_more_than_two_microseconds_is_in_the_interval():
    """A tenth is reached at 41 µs, nine tenths at 44: a µs more on either side; 43.08 whole µs are missing.

    Noise may have begun five times the rise before it, after 25 µs. A rise of 8 µs has an upper limit alone.
    """
    told = stepped(46, _40=45.0, _41=90.0, _42=270.0, _43=540.0, _44=810.0, _45=873.0)
    assert told["value"] == pytest.approx(42.58) and told["interval_95"] == pytest.approx([25, 45])
    slow = {f"_{41 + k}": 80.0 * (k + 1) for k in range(11)}
    assert stepped(52, **slow)["reason"].endswith("at most 50 µs")
    assert "10 % of what it is later at 41 µs and 90 % at 44 µs; 45 intervals" in told["note"]
    low, high = stepped(46, _41=90.0, _42=270.0, _43=810.0, _44=900.0, _45=900.0)["interval_95"]
    assert 41.5 < low < high < 43.5


def test_strays_are_no_steps_of_the_clock():
    """500 intervals in every tenth µs: 5 in another one are strays, 6 are not."""
    for strays, clock_us in (({13: 5.0}, 10), ({13: 6.0}, 1), ({25: 6.0}, 5)):
        counts = np.where(np.arange(LONG_US) % 10, 0.0, 500.0)
        counts[list(strays)] = list(strays.values())
        assert short_intervals._clock_us(counts) == clock_us


def limited(rng, per_ms):
    """Events of a read-out that passes so many per ms, and is asked for more in two fifths of the time."""
    wanted = np.sort(np.concatenate([rng.uniform(0, 500_000, 60_000), rng.uniform(0, 200_000, 4 * 200 * per_ms)]))
    free, taken = 0.0, []
    for t_us in wanted:  # a buffer of one event
        if t_us >= free - 1000 / per_ms:
            free = max(t_us, free) + 1000 / per_ms
            taken.append(free)
    events = np.zeros(len(taken), EVENT_DTYPE)
    events["t_us"] = np.ceil(taken)
    events["x"], events["y"] = rng.integers(0, SHAPE[1], len(taken)), rng.integers(0, SHAPE[0], len(taken))
    events["polarity"] = rng.choice([-1, 1], len(taken))
    return events


def test_readout_limit_and_saturated_recordings(tmp_path):
    rng = np.random.default_rng(5)
    events = limited(rng, 640)
    one = tally(EventStream.of(events, SHAPE))
    found, saturated = readout_limit([one])
    assert found["interval_95"][0] <= 640_000 <= found["interval_95"][1]
    assert saturated == [one]
    name = written(events, "evt3", tmp_path, SHAPE)
    with pytest.raises(SpecError, match=rf"{name.name}.*is saturated.*expected a recording of all events"):
        calibrate_recordings([name])
    free = tally(EventStream.of(random_events(rng, np.full(PIXELS, 90.0), 0.0, seconds=1.0, shape=SHAPE), SHAPE))
    assert "at least" in readout_limit([free])[0]["reason"]


@pytest.mark.parametrize("most", (1, 2, 3, 5))
def test_windows_of_a_few_events_are_no_readout_limit(most):
    """Still pixels in dim light have an event now and then; such recordings were refused as saturated."""
    windows = np.array([0, 300, 40, 9, 30, 25])[: most + 1]
    found, saturated = readout_limit([SimpleNamespace(windows=windows, pixels=1120)])
    assert f"at least {most},000 events/s" in found["reason"] and saturated == []
    full = np.append(np.zeros(6, int), 25)
    assert readout_limit([SimpleNamespace(windows=full, pixels=1120)])[0]["value"] == 6000


def test_windows_with_the_same_events_of_every_pixel_are_no_readout_limit():
    """The pixels fire twice in each of 40 windows: more of them would give more."""
    events = np.zeros(80 * PIXELS, EVENT_DTYPE)
    events["t_us"] = np.repeat(np.arange(80) * 500 + 7, PIXELS)
    events["x"], events["y"] = np.tile(np.arange(PIXELS) % SHAPE[1], 80), np.tile(np.arange(PIXELS) // SHAPE[1], 80)
    events["polarity"] = 1
    for silent in (0, round(0.015 * PIXELS)):
        one = tally(EventStream.of(events[events["x"] + SHAPE[1] * events["y"] >= silent], SHAPE))
        found, saturated = readout_limit([one])
        assert "2 events of every pixel" in found["reason"] and saturated == []
    part = tally(EventStream.of(events[events["x"] + SHAPE[1] * events["y"] >= 0.04 * PIXELS], SHAPE))
    assert readout_limit([part])[0]["value"] == pytest.approx(2000 * np.ceil(0.96 * PIXELS), rel=0.01)


def test_hot_and_silent_pixels():
    rng = np.random.default_rng(7)
    rates = rng.uniform(15, 25, PIXELS)
    hot, silent = rng.choice(PIXELS, 9, replace=False), np.arange(100, 105)
    rates[hot] = 900.0
    parts = []
    for factor in (1.0, 1.3):
        own = np.where(np.isin(np.arange(PIXELS), hot), rates, factor * rates)
        own[silent] = 1e-9
        parts.append(tally(EventStream.of(random_events(rng, own, 0.0, seconds=2.0, shape=SHAPE), SHAPE)))
    count = len(set(hot) - set(silent))
    assert still.hot_share(parts)["value"] == pytest.approx(count / PIXELS)
    assert still.silent_share(parts)["value"] == pytest.approx(5 / PIXELS)
    low, high = still.silent_share(parts)["interval_95"]
    # Clopper and Pearson: as few pixels, or as many, have a chance of 2.5 % at each end
    assert stats.binom.sf(4, PIXELS, low) == pytest.approx(0.025) == stats.binom.cdf(5, PIXELS, high)
    assert "two recordings" in still.hot_share(parts[:1])["reason"]


def test_hot_pixels_are_in_no_rate_and_no_leak():
    """Five pixels of 300 Hz would treble the mean of pixels of 1.2 Hz; in one recording nothing tells them."""
    rng = np.random.default_rng(12)
    events = []
    for hz in (1.2, 1.5):
        on = np.full(PIXELS, hz)
        on[[3, 40, 41, 200, 590]] = 300.0
        events.append(random_events(rng, on, 0.0, seconds=20.0, shape=SHAPE))
        events[-1]["polarity"] = 1
    several = [tally(EventStream.of(one, SHAPE)) for one in events]
    found = calibration.figures(several, None, (1.0, 31.0), None, None)
    assert found["hot_share"]["note"] == f"5 of {PIXELS} pixels"
    for entry, hz in zip(found["recordings"], (1.2, 1.5), strict=True):
        assert abs(entry["on_rate_hz"]["value"] - hz) < 4.5 * entry["on_rate_hz"]["standard_error"] < 0.1
        assert entry["leak_rate_hz"]["value"] == pytest.approx(hz, abs=0.05)
        assert entry["on_rate_spread_rel"]["value"] == 0 and entry["on_rate_spread_rel"]["upper_limit"] < 0.1
        assert entry["on_local_variation"]["value"] == pytest.approx(1, abs=0.03)
    assert found["leak_growth_hz_per_lux"]["value"] == pytest.approx(0.01, abs=0.002)
    alone = calibration.figures([tally(EventStream.of(events[0], SHAPE))], None, None, None, None)
    assert alone["recordings"][0]["on_rate_hz"]["value"] > 3


@pytest.mark.parametrize(("hz", "part"), [(100.0, 0.3), (120.04, 0.3), (100.0, 0.05), (90.0, 0.6)])
def test_a_lamp_of_alternating_current_is_named(hz, part):
    """A part of the ON events comes within a tenth of a period; other frequencies, and a few, are not lamps."""
    rng = np.random.default_rng(13)
    events = random_events(rng, np.full(PIXELS, 6.0), 4.0, seconds=10.0, shape=SHAPE)
    chosen = (events["polarity"] > 0) & (rng.random(events.size) < part)
    phase = np.floor(events["t_us"][chosen] * 1e-6 * hz) + 0.1 * rng.random(np.count_nonzero(chosen))
    events["t_us"][chosen] = phase / hz * 1e6
    events = events[np.argsort(events["t_us"], kind="stable")]
    found = calibration.figures([tally(EventStream.of(events, SHAPE))], None, None, None, None)
    is_lamp = part == 0.3
    assert len(found["findings"]) == is_lamp
    if is_lamp:
        assert f"a lamp of {round(hz)} Hz" in found["findings"][0]["text"]
        assert "lamp flickers" in found["dead_time_us"]["reason"]


def test_windows_of_a_lamp_that_flickers_are_no_readout_limit():
    """20,000 events in each of 30 ms, but for chance: 0.7 %, of which a read-out at its limit has nothing."""
    rng = np.random.default_rng(14)
    for spread, is_limited in ((np.sqrt(20_000), False), (3.0, True)):
        windows = np.bincount(np.maximum(np.rint(20_000 + spread * rng.standard_normal(60)), 0).astype(np.int64))
        one = SimpleNamespace(windows=windows, pixels=307_200)
        assert (readout_limit([one])[0]["value"] is not None) is is_limited


@pytest.mark.slow
def test_what_is_not_identifiable_says_why(tmp_path):
    _, events, moving = sensor(8)
    names = files(events, moving, tmp_path)
    two = calibrate_recordings(names[:2], lux=LUX[:2], shape=SHAPE)
    assert "three different lights" in two["threshold_ratio"]["reason"]
    assert "ratio of the thresholds is not known" in two["recordings"][0]["leak_rate_hz"]["reason"]
    assert "two are needed" in two["leak_dark_hz"]["reason"]
    assert "moving target" in two["theta_on"]["reason"]
    without = calibrate_recordings(names[:3], shape=SHAPE)
    assert "--lux" in without["threshold_ratio"]["reason"] and "--lux" in without["leak_growth_hz_per_lux"]["reason"]
    assert without["recordings"][2]["leak_rate_hz"]["value"] is not None  # there are no OFF events in it
    still_target = calibrate_recordings(names[:1], target_file=names[2], target_contrast=8.0, shape=SHAPE)
    assert "of both polarities" in still_target["theta_on"]["reason"]


def test_a_target_without_a_steady_period_tells_no_thresholds():
    """Random events, of which a third turns near the median; they gave 0.404 ± 0.005 at a contrast of 3."""
    rng = np.random.default_rng(16)
    one = tally(EventStream.of(random_events(rng, np.full(PIXELS, 40.0), 30.0, seconds=2.0, shape=SHAPE), SHAPE))
    for key, entry in calibration.figures([one], one, None, 3.0, None).items():
        if key.startswith("the") or key == "threshold_mismatch_rel":
            assert "no steady period is seen" in entry["reason"]
    assert calibration.figures([one], one, None, 3.0, 12.0)["theta_on"]["value"] is not None  # stated with --target-hz
    one.turns_us = [np.append(np.full(60, 300), np.full(40, 900))]
    assert one.period_s() is None
    one.turns_us = [np.append(np.full(61, 300), np.full(39, 900))]
    assert one.period_s() == pytest.approx(300e-6)


def test_a_scene_that_is_not_still_is_a_finding(tmp_path):
    rng = np.random.default_rng(9)
    events = random_events(rng, np.full(PIXELS, 40.0), 0.0, seconds=1.0, shape=SHAPE)
    kept = events[(events["t_us"] > 600_000) | (rng.random(events.size) < 0.3)]
    found = calibrate_recordings([written(kept, "evt3", tmp_path, SHAPE)])
    assert "the scene moves" in found["findings"][0]["text"]


def test_a_scene_that_moves_at_a_steady_rate_is_a_finding_and_tells_no_leak():
    """Each pixel of the upper half has its events early, each of the lower one late, as those of swaying plants."""
    rng = np.random.default_rng(12)
    shape = (48, 32)
    events = random_events(rng, np.full(48 * 32, 8.0), 0.0, seconds=1.0, shape=shape)
    still_one = tally(EventStream.of(events, shape))
    assert stillness.not_still(still_one) is None
    upper, early = events["y"] < 24, events["t_us"] < 500_000
    moving = tally(EventStream.of(events[(upper == early) | (rng.random(events.size) < 0.3)], shape))
    found = calibration.figures([moving], None, (5.0,), None, None)
    assert "something in the scene moves" in found["findings"][0]["text"]
    assert "its rate changes (findings)" in found["recordings"][0]["leak_rate_hz"]["reason"]


@pytest.mark.slow
def test_a_camera_that_has_not_settled_spoils_no_leak():
    """A burst of OFF events at the begin of one of three recordings: the others tell what they told without it."""
    truth, events, moving = sensor(4)
    rng = np.random.default_rng(15)
    burst = np.zeros(6 * PIXELS, EVENT_DTYPE)
    burst["t_us"], burst["polarity"] = np.sort(rng.integers(1, 200_000, burst.size)), -1
    burst["x"], burst["y"] = rng.integers(0, SHAPE[1], burst.size), rng.integers(0, SHAPE[0], burst.size)
    spoiled = np.concatenate([events[1], burst])
    spoiled = spoiled[np.argsort(spoiled["t_us"], kind="stable")]
    given = [tally(EventStream.of(one, SHAPE)) for one in (events[0], spoiled, events[2], moving)]
    three = calibration.figures(given[:3], None, LUX, None, None)
    assert "the camera was not settled" in three["findings"][0]["text"] and len(three["findings"]) == 1
    assert "three different lights" in three["threshold_ratio"]["reason"]
    assert "its rate changes" in three["recordings"][1]["leak_rate_hz"]["reason"]
    two = calibration.figures([given[0], given[2]], None, (LUX[0], LUX[2]), None, None)
    assert three["recordings"][2]["leak_rate_hz"] == two["recordings"][1]["leak_rate_hz"]
    alone = calibration.figures(given[1:2], given[3], LUX[1:2], np.exp(RISE), None)
    assert "of every recording changes" in alone["leak_dark_hz"]["reason"]
    # a target tells thresholds and their ratio without any
    assert abs(alone["theta_on"]["value"] - truth["theta_on"]) < 0.05 * truth["theta_on"]
    assert alone["threshold_ratio"]["value"] is not None


def test_few_events_of_a_still_scene_are_no_finding():
    """Random events, a few in all: their rate scatters by counting alone. 40 recordings, chance of one finding 0.04."""
    rng = np.random.default_rng(11)
    for count in range(3, 43):
        events = random_events(rng, np.full(PIXELS, count / PIXELS / 0.5), 0.0, seconds=0.5, shape=SHAPE)
        if events.size > 1:
            assert stillness.not_still(tally(EventStream.of(events, SHAPE))) is None, count


def test_bad_input_is_one_clear_error(tmp_path):
    rng = np.random.default_rng(10)
    events = random_events(rng, np.full(PIXELS, 40.0), 0.0, seconds=0.5, shape=SHAPE)
    name = written(events, "evt3", tmp_path, SHAPE)
    np.savez(tmp_path / "bare.npz", t=events["t_us"], x=events["x"], y=events["y"], p=events["polarity"] > 0)
    with pytest.raises(SpecError, match=r"bare\.npz.*does not state the size"):
        calibrate_recordings([tmp_path / "bare.npz"])
    with pytest.raises(SpecError, match=r"bare\.npz.*is of 30x22 px; expected 27x22"):
        calibrate_recordings([name, tmp_path / "bare.npz"], shape=(22, 30))
    turned = events[::-1]
    np.savez(tmp_path / "turned.npz", t=turned["t_us"], x=turned["x"], y=turned["y"], p=turned["polarity"] > 0)
    with pytest.raises(SpecError, match=r"turned\.npz.*order"):
        calibrate_recordings([tmp_path / "turned.npz"], shape=SHAPE)
    empty = events[:0]
    with pytest.raises(SpecError, match="has no events"):
        tally(EventStream.of(empty, SHAPE, "nothing"))
    for keys, told in (
        ({"lux": [1.0, 2.0]}, "one illuminance for each of the 1 recordings"),
        ({"lux": [-1.0]}, "0 or more"),
        ({"target_file": name}, "the contrast of the target"),
        ({"target_file": name, "target_contrast": 0.8}, "bright over dark"),
        ({"target_hz": 3.0}, "cycles per second of a moving target"),
    ):
        with pytest.raises(RangeError, match=told):
            calibrate_recordings([name], **keys)
    with pytest.raises(RangeError, match="at least"):
        calibrate_recordings([])


def test_groups_are_of_all_columns():
    one = tally(
        EventStream.of(
            random_events(np.random.default_rng(1), np.full(PIXELS, 40.0), 0.0, seconds=0.3, shape=SHAPE), SHAPE
        )
    )
    counts = np.bincount(one.group.astype(int), minlength=GROUPS)
    assert counts.min() > 0.5 * PIXELS / GROUPS

"""Figures of still recordings: sums over events one by one, jackknives written out, lines of exact rates."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from hesim_render.calibrate.estimate import estimated
from hesim_render.calibrate.recordings import calibration, short_intervals, still, stillness, target
from hesim_render.calibrate.recordings import tally as recording_tally
from hesim_render.calibrate.recordings.rate_spread import rate_spread, regularity
from hesim_render.calibrate.recordings.short_intervals import readout_limit
from hesim_render.calibrate.recordings.tally import GROUPS, LAMPS_HZ, LONG_US, SLICES, EventTally, tally
from hesim_render.core.errors import RangeError
from hesim_render.exchange import EventStream
from hesim_render.pixels.evs.events import EVENT_DTYPE

SHAPE, SECONDS = (5, 8), 0.06
PIXELS = 40


def events_of(rng, count=3000, begin_us=700):
    events = np.zeros(count, EVENT_DTYPE)
    events["t_us"] = begin_us + np.sort(np.concatenate([[0, 60_000], rng.integers(0, 60_001, count - 2)]))
    events["x"], events["y"] = rng.integers(0, 8, count), rng.integers(0, 5, count)
    events["polarity"] = rng.choice([-1, 1], count, p=[0.4, 0.6])
    return events


def test_a_tally_is_what_a_loop_over_events_counts(monkeypatch):
    monkeypatch.setattr(recording_tally, "_ONE_PERIOD", 0.1)  # random events have no period
    events = events_of(np.random.default_rng(1))
    found = EventTally("x", SHAPE, 700, 60_700)
    for block in np.array_split(events, 7):
        found.add(block)
    found.finish()
    assert found.seconds == pytest.approx(SECONDS) and found.pixels == PIXELS
    counts, slices = np.zeros((2, 2, PIXELS)), np.zeros((2, SLICES, GROUPS))
    intervals, windows = np.zeros(LONG_US + 1), np.zeros(61)
    variation, pairs, turns = np.zeros(PIXELS), np.zeros(PIXELS), []
    waves = np.zeros((2, SLICES), complex)
    last, last_on, was_on, turned = {}, {}, {}, {}
    group = found.group.astype(int)
    for t, x, y, polarity in events[["t_us", "x", "y", "polarity"]].tolist():
        pixel, k, part = y * 8 + x, int(polarity < 0), (t - 700) / 60_000
        counts[k, min(int(2 * part), 1), pixel] += 1
        slices[k, min(int(SLICES * part), SLICES - 1), group[pixel]] += 1
        windows[(t - 700) // 1000] += 1
        if pixel in last:
            intervals[min(t - last[pixel], LONG_US)] += 1
            if polarity > 0 and not was_on[pixel]:
                if pixel in turned:
                    turns.append(t - turned[pixel])
                turned[pixel] = t
        last[pixel], was_on[pixel] = t, polarity > 0
        if polarity > 0:
            waves[:, min(int(SLICES * part), SLICES - 1)] += np.exp(2j * np.pi * np.array([1e-4, 1.2e-4]) * (t - 700))
            before = last_on.get(pixel, [])
            if len(before) == 2 and before[1] > before[0] and t > before[1]:
                a, b = t - before[1], before[1] - before[0]
                variation[pixel] += 3 * ((a - b) / (a + b)) ** 2
                pairs[pixel] += 1
            last_on[pixel] = [*before, t][-2:]
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.slices, slices)
    np.testing.assert_array_equal(found.intervals, intervals)
    np.testing.assert_array_equal(found.windows[1:], np.bincount(windows.astype(int))[1:])
    np.testing.assert_array_equal(found.pairs, pairs)
    np.testing.assert_allclose(found.variation, variation)
    np.testing.assert_allclose(found.waves, waves)
    every = np.array(turns)
    near = every[np.abs(every / np.median(every) - 1) < 0.3]
    assert found.period_s() == pytest.approx(near.mean() * 1e-6)
    np.testing.assert_array_equal(found.per_pixel(), counts.sum(axis=1))


def test_rates_spread_and_regularity_have_the_errors_of_leaving_groups_out():
    rng = np.random.default_rng(2)
    one = tally(EventStream.of(events_of(rng), SHAPE))
    one.counts[:] = rng.poisson(rng.uniform(20, 80, PIXELS), (2, 2, PIXELS))
    group = one.group.astype(int)
    rates = still.group_rates(one)
    of_group = np.array([np.bincount(group, count, GROUPS) for count in one.counts.sum(axis=1)])
    assert rates[:, 0] == pytest.approx(of_group.sum(axis=1) / (PIXELS * SECONDS))
    for k in range(GROUPS):
        left = PIXELS - np.sum(group == k)
        assert rates[:, 1 + k] == pytest.approx((of_group.sum(axis=1) - of_group[:, k]) / (left * SECONDS))
    error = [np.sqrt(19 / 20 * np.sum((r[1:] - r[1:].mean()) ** 2)) for r in rates]
    assert still.jackknife(rates) == pytest.approx(error)
    for polarity in (0, 1):
        told = still.rate(rates, polarity)
        assert (told["value"], told["standard_error"]) == pytest.approx((rates[polarity, 0], error[polarity]))

    def relative(a, b):
        return (np.mean(a * b) - a.mean() * b.mean()) / (a.mean() * b.mean())

    told = rate_spread(one, 1)
    first, second = one.counts[1].astype(float)
    parts = [relative(first[group != k], second[group != k]) for k in range(GROUPS)]
    error = np.sqrt(19 / 20 * np.sum((np.array(parts) - np.mean(parts)) ** 2))
    whole = relative(first, second)
    assert whole > 2 * error
    assert told["value"] == pytest.approx(np.sqrt(whole))
    assert told["standard_error"] == pytest.approx(error / (2 * np.sqrt(whole)))
    # halves of which one is larger where the other is smaller: no spread, and a limit that chance may have, above 0
    moved = rng.poisson(9, PIXELS) - 9
    one.counts[1] = 70 + moved, 70 - moved
    first, second = one.counts[1].astype(float)
    parts = [relative(first[group != k], second[group != k]) for k in range(GROUPS)]
    error = np.sqrt(19 / 20 * np.sum((np.array(parts) - np.mean(parts)) ** 2))
    told = rate_spread(one, 1)
    assert relative(first, second) < -2 * error and told["value"] == 0
    assert told["upper_limit"] == pytest.approx(np.sqrt(2 * error))
    # even intervals: a gamma law of shape r has a local variation of 3/(2r + 1), and the squared deviation 1/r
    one.pairs, one.variation = np.full(PIXELS, 6), np.full(PIXELS, 6 * 3 / (2 * 2.5 + 1))
    for counts in (rng.poisson(rng.uniform(20, 80, PIXELS), (2, PIXELS)), np.where(np.arange(PIXELS) % 4, 4, 3)):
        one.counts[0] = counts
        a, b = one.counts[0].astype(float)
        own = [relative(a[group != k], b[group != k]) for k in range(GROUPS)]
        scatter = np.sqrt(19 / 20 * np.sum((np.array(own) - np.mean(own)) ** 2))
        even = (1 - 1 / 2.5**2) / 12 / (a.mean() * b.mean())
        square = relative(a, b) + even
        like = 2 * np.exp(-2 * np.pi**2 * square * a.mean() * b.mean())
        told = rate_spread(one, 0)
        assert told["value"] == pytest.approx(np.sqrt(square))
        error = np.hypot(scatter, (0.1 + like) * even)
        assert told["standard_error"] == pytest.approx(error / (2 * np.sqrt(square)), rel=1e-6)
    assert like > 0.005
    one.variation, one.pairs = rng.uniform(3, 9, PIXELS), rng.integers(5, 9, PIXELS)
    total, count = one.variation.sum(), one.pairs.sum()
    parts = np.array([one.variation[group != k].sum() / one.pairs[group != k].sum() for k in range(GROUPS)])
    told = regularity(one)
    assert told["value"] == pytest.approx(total / count)
    assert told["standard_error"] == pytest.approx(np.sqrt(19 / 20 * np.sum((parts - parts.mean()) ** 2)))
    one.pairs = np.full(PIXELS, 5)
    assert regularity(one)["value"] is not None
    one.used[7] = False  # a hot pixel takes no part in any of them
    first[7] = 1e6
    assert rate_spread(one, 1)["value"] < 1 and still.group_rates(one)[1, 0] < 1e5
    assert "195 pairs" in regularity(one)["reason"]
    one.counts[1] = 0
    one.counts[1, 0], one.counts[1, :, 7] = 1, 1000  # those of the hot pixel do not count
    one.counts[1, 1, 3] += 59 - one.counts[1][:, one.used].sum()
    assert rate_spread(one, 1)["reason"] == "59 events in all"
    one.counts[1, 1, 3] += 1
    assert "reason" not in rate_spread(one, 1)
    one.used[7], one.pairs[3] = True, 4
    assert "199 pairs" in regularity(one)["reason"]


@pytest.mark.parametrize("off", [1, 0])
def test_a_pixel_is_hot_beyond_the_tail_of_ten_times_the_usual_rate(off):
    """Usual is the mean of the lower nine tenths and one event over all pixels; the chance is 1e-3 over the pixels."""
    usual = (18 * 30 + 18 * 50) / 36 + 1 / PIXELS
    least = stats.poisson.isf(1e-3 / PIXELS, 10 * usual)
    counts = np.array([30] * 18 + [50] * 18 + [60] * 3 + [int(least) + 1 - off])
    one = SimpleNamespace(pixels=PIXELS, seconds=0.7, per_pixel=lambda: np.stack([counts, 0 * counts]))
    assert still.hot_pixels([one, one]).sum() == 1 - off


def test_a_hot_pixel_may_be_hidden_among_busy_ones():
    """In the first, of 3 s, pixels have 6 events and four stand out. In the second, of 2 s, others have 160, so that
    none could; what has half of its rate is hot. A rate of 300 Hz would stand out in the third, of 1 s.
    """
    calm, busy, third = np.full(PIXELS, 6), np.full(PIXELS, 160), np.full(PIXELS, 3)
    calm[[2, 9, 17, 30]] = 600, 570, 900, 900  # 200, 190, 300 and 300 Hz
    busy[[2, 9, 17, 30]] = 201, 189, 700, 700
    third[[2, 9, 17, 30]] = 200, 190, 20, 300
    given = [
        SimpleNamespace(pixels=PIXELS, seconds=s, per_pixel=lambda c=counts: np.stack([c, 0 * c]))
        for counts, s in ((calm, 3.0), (busy, 2.0), (third, 1.0))
    ]
    assert np.flatnonzero(still.hot_pixels(given[:2])).tolist() == [2, 17, 30]
    assert np.flatnonzero(still.hot_pixels(given)).tolist() == [2, 30]


def test_levels_that_do_not_balance_tell_no_leak(monkeypatch):
    """Of three lights, the one whose leak is below 0 by more than three errors has a reason and no part in the line."""
    monkeypatch.setattr(still, "jackknife", lambda values: np.full(values.shape[:-1], 0.03))
    leak = np.repeat([[0.2], [-0.16], [0.5]], GROUPS + 1, axis=1)
    for error, values in ((0.04, [0.2, None, 0.5]), (0.05, [0.2, -0.16, 0.5])):
        found = still._with_ratio(leak, np.full(3, error), [1.0, 2.0, 4.0], {"value": 1.3})
        assert [one["value"] for one in found.leaks] == values
        if error == 0.04:
            assert "it would be -0.16 Hz" in found.leaks[1]["reason"]
            assert found.dark["value"] == pytest.approx(0.1) and found.growth["value"] == pytest.approx(0.1)
        else:
            assert found.dark["value"] < 0.1


def slices_tally(per_slice):
    """Counts of 20 slices of a recording of 40 pixels and 2 s."""
    slices = np.zeros((2, SLICES, GROUPS))
    slices[0, :, 3], slices[1, :, 5] = np.asarray(per_slice) * 0.75, np.asarray(per_slice) * 0.25
    return SimpleNamespace(slices=slices, pixels=PIXELS, seconds=2.0, waves=np.zeros((2, SLICES)),
                           period_s=lambda: None, shape=(1, PIXELS), counts=np.zeros((2, 2, PIXELS)))  # fmt: skip


def test_a_scene_is_not_still_beyond_half_of_its_rate_or_a_burst():
    even = np.full(20, 4000.0)
    assert stillness.not_still(slices_tally(even)) is None
    steps = even.copy()
    for early, late in ((0.755, 1.245), (0.75, 1.25)):  # differences of 0.49 and of exactly 0.5 of the mean
        steps[:5], steps[-5:] = 4000 * early, 4000 * late
        assert stillness.not_still(slices_tally(steps)) is None
    steps[:5], steps[-5:] = 4000 * 0.745, 4000 * 1.255
    told = stillness.not_still(slices_tally(steps))
    # 2980 and 5020 events of 40 pixels in 0.1 s
    assert "its rate goes from 745 to 1255 Hz a pixel, at most 1255" in told
    assert "its rate goes from 1255 to 745" in stillness.not_still(slices_tally(steps[::-1]))
    for factor, is_told in ((0.99, False), (1.03, True)):
        burst = np.full(20, 400.0)
        # c of 19 · 400 + c is beyond the tail of three times the mean at c ≈ 1530
        high = next(c for c in range(400, 4000, 4) if c > stats.poisson.isf(1e-3 / 20, 3 * (19 * 400 + c) / 20))
        burst[9] = 4 * round(factor * high / 4)
        assert (stillness.not_still(slices_tally(burst)) is not None) is is_told


def test_a_rate_changes_beyond_four_errors_of_counting():
    """Quarters of 5 slices with 20 events each: of a mean √(2/20)/√5, so that a difference of 0.566 counts."""
    for part, is_told in ((0.56, False), (0.57, True)):
        few = np.full(20, 20.0)
        few[:5], few[-5:] = 20 * (1 - part / 2), 20 * (1 + part / 2)
        assert (stillness.unsteady(slices_tally(few)) is not None) is is_told


def test_a_rate_changes_beyond_four_errors_of_its_scatter():
    """Quarters that differ by 0.6 of the mean, and slices between them that scatter by 0.35 or 0.36 of it.

    Four errors are 4 √((2.5 · 0.6² + 10 y²)/19)/√5 of the mean, 0.598 or 0.608.
    """
    for scatter, is_told in ((0.35, True), (0.36, False)):
        rate = 1 + np.repeat([-0.3, 0, 0.3], [5, 10, 5])
        rate[5:15] += scatter * (-1) ** np.arange(10)
        assert (stillness.unsteady(slices_tally(4000 * rate)) is not None) is is_told


def test_a_burst_is_beyond_the_count_of_its_chance():
    """A slice with as many events as three times the mean has with a chance of 1e-3/20 is none, with one more it is."""
    for each in range(400, 500):
        most = [c for c in range(1200, 2000) if c == stats.poisson.isf(1e-3 / 20, 3 * (19 * each + c) / 20)]
        for count in most[-1:]:
            for more, is_told in ((0, False), (4, True)):
                burst = np.full(20, float(each))
                burst[9] = count + more
                assert (stillness.unsteady(slices_tally(burst)) is not None) is is_told
            return
    raise AssertionError("no count is at its limit")


@pytest.mark.parametrize(("turns", "period", "lamp", "is_seen"), [
    ((200, 100), 0.83, None, True), ((200, 99), 0.83, None, False), ((200, 100), None, None, False),
    ((200, 100), 0.01, "a lamp", False),
])  # fmt: skip
def test_pixels_that_see_a_steady_change_are_of_no_still_scene(monkeypatch, turns, period, lamp, is_seen):
    monkeypatch.setattr(stillness, "of_a_lamp", lambda tally: lamp)
    one = slices_tally(np.full(20, 4000.0))
    one.period_s, one.turns_us = lambda: period, [np.ones(count) for count in turns]
    assert (stillness.moving(one) is not None) is is_seen
    told = stillness.not_still(one)
    assert told == lamp if not is_seen else "turn from OFF to ON events every 0.83 s" in told


@pytest.mark.parametrize(("events", "part", "squares", "others", "is_seen"), [
    (800, 0.26, 4, 3000, True), (800, 0.24, 4, 3000, False), (800, 0.26, 3, 3000, False), (800, 0.26, 4, 9900, False),
    (800, 0.26, 4, 9300, True), (100, 0.59, 4, 0, False), (100, 0.61, 4, 0, True),
])  # fmt: skip
def test_squares_whose_rate_changes_are_of_a_scene_that_moves(events, part, squares, others, is_seen):
    """Difference over sum of their events beyond a quarter and six errors of counting; four squares of a quarter."""
    halves = np.zeros((2, 40, 30))  # 3 rows and 2 columns of squares, some of them cut
    begins = [(0, 0), (16, 16), (32, 0), (32, 17)][:squares]
    for k, (row, col) in enumerate(begins):
        more, less = events * (1 + part) / 2, events * (1 - part) / 2
        halves[:, row : row + 4, col : col + 4] += (np.array([more, less]) / 16)[:: 1 if k % 2 else -1, None, None]
    halves[:, 20, 3] += others / 2
    one = SimpleNamespace(shape=(40, 30), counts=np.stack([0.3 * halves, 0.7 * halves]).reshape(2, 2, -1))
    told = stillness.wandering(one)
    assert (told is not None) is is_seen
    if is_seen and others == 3000:
        assert "52 % of its events are in 4 squares of 16x16 px" in told


def test_one_recording_tells_how_many_pixels_outdo_their_neighbours():
    """More than ten times the ON events of each of the eight beside it, and ten at least; borders have fewer."""
    on = np.zeros((6, 7), int)
    on[0, 0], on[0, 6], on[3, 3], on[3, 4], on[5, 3], on[4, 5] = 10, 9, 200, 19, 11, 1
    one = SimpleNamespace(shape=(6, 7), per_pixel=lambda: np.stack([on.ravel(), 500 * np.ones(42, int)]))
    assert "; 3 pixels have more than ten times" in still.hot_share([one])["reason"]
    on[3, 4] = 20
    assert "; 2 pixels have more than ten times" in still.hot_share([one])["reason"]


def test_any_change_but_that_of_a_lamp_takes_a_scene_out_of_balance(monkeypatch):
    names = ("unsteady", "moving", "wandering", "of_a_lamp")
    for changing in (*names, None):
        for name in names:
            monkeypatch.setattr(stillness, name, lambda tally, is_it=name == changing: "why" if is_it else None)
        assert stillness.changes(None) is (changing in names[:3])
        assert stillness.not_still(None) == ("why" if changing else None)


def test_on_events_of_one_phase_are_those_of_a_lamp():
    """The sum of phases over the number is 0.1 or more, and its square over the number four times that of chance."""
    for depth, each, is_seen in ((0.099, 4000, False), (0.101, 4000, True), (0.2, 70, False), (0.2, 80, True)):
        one = slices_tally(np.full(20, each / 0.75))
        one.waves = np.zeros((2, SLICES), complex)
        one.waves[1] = np.sqrt(depth**2 * each**2 + each) * np.exp(1j * np.arange(SLICES))
        assert (stillness.not_still(one) is not None) is is_seen, (depth, each)
    assert "a lamp of 120 Hz (the sum of their phases is 20 % of" in stillness.of_a_lamp(one)


def test_slices_that_are_no_whole_number_of_periods_have_a_sum_of_their_own():
    """Of 22.5 ms each: the sum of even events is left out, so that 0.2 of one phase in each slice are read as such."""
    one, each = slices_tally(np.full(20, 4000 / 0.75)), 4000
    one.seconds = 0.45
    at = (np.arange(20_000) + 0.5) * 0.45 / 20_000
    even = np.array([np.exp(2j * np.pi * hz * at).reshape(SLICES, -1).mean(axis=1) for hz in LAMPS_HZ])
    assert np.abs(even).max() > 0.1
    one.waves = each * even
    assert stillness.of_a_lamp(one) is None
    one.waves[0] += np.sqrt(0.2**2 * each**2 + each) * np.exp(1j * np.arange(SLICES))
    assert "a lamp of 100 Hz (the sum of their phases is 20 % of" in stillness.of_a_lamp(one)


def rates_of(rng, lux, ratio, dark, growth, scatter=0.0):
    """[recording, polarity, k] of leaks that follow the light exactly; each group is off by as much as it likes."""
    off = np.array([0.7, 0.2, 0.05])[: len(lux), None] * (1 + 0.05 * rng.standard_normal(GROUPS + 1))
    on = ratio * off + dark + growth * np.asarray(lux)[:, None] + scatter * rng.standard_normal((len(lux), GROUPS + 1))
    return np.stack([on, off], axis=1)


def test_the_ratio_of_three_lights_is_that_of_its_own_weights():
    """Errors of n₊ − ρ n₋ are those with the ρ that comes out.

    ON and OFF events of a pixel scatter together: with another ρ, weights and ratio are others.
    """
    rng, lux = np.random.default_rng(5), np.array([2.0, 30.0, 90.0, 400.0])
    off = np.array([0.9, 2.3, 5.1, 4.0])[:, None] * (1 + 0.1 * rng.standard_normal((4, GROUPS)))
    alike = np.array([0.02, 0.9, 0.3, 0.7])[:, None]
    noise = 0.2 * rng.standard_normal((4, GROUPS))
    on = 2.6 * off + 0.4 + 3e-3 * lux[:, None] + noise * (1 - alike) + alike * 0.8 * (off - off.mean(axis=1)[:, None])
    groups = np.stack([on, off], axis=1)
    whole = groups.sum(axis=2, keepdims=True)
    rates = np.concatenate([whole / GROUPS, (whole - groups) / (GROUPS - 1)], axis=2)
    found = still._three_lights(rates, lux)
    parts = rates[:, 0, 1:] - found[0] * rates[:, 1, 1:]
    error = np.sqrt((GROUPS - 1) / GROUPS * ((parts - parts.mean(axis=1)[:, None]) ** 2).sum(axis=1))
    for k in (0, 3, GROUPS):
        design = np.stack([rates[:, 1, k], np.ones(4), lux], axis=1)
        scaled = np.linalg.lstsq(design / error[:, None], rates[:, 0, k] / error, rcond=None)[0]
        assert found[k] == pytest.approx(scaled[0], rel=1e-6)
    # weights of a ρ of 1, with which the search begins, give another one
    parts = rates[:, 0, 1:] - rates[:, 1, 1:]
    error = parts.std(axis=1)
    design = np.stack([rates[:, 1, 0], np.ones(4), lux], axis=1)
    assert abs(np.linalg.lstsq(design / error[:, None], rates[:, 0, 0] / error, rcond=None)[0][0] / found[0] - 1) > 1e-3


def test_the_balance_of_three_lights_gives_ratio_and_leak():
    rng, lux = np.random.default_rng(3), [2.0, 60.0, 700.0]
    rates = rates_of(rng, lux, 1.3, 0.5, 1e-3, 1e-5)
    np.testing.assert_allclose(still._three_lights(rates, np.array(lux)), 1.3, rtol=2e-3)
    rates[:, 1] = rates[:1, 1] * 0 + np.array(lux)[:, None]  # OFF events that follow the light
    assert np.isnan(still._three_lights(rates, np.array(lux))).all()


def test_a_leak_follows_a_line_weighted_by_both_kinds_of_error():
    """Scatter of groups and an error of its own, of which only the first is that of the jackknife."""
    rng = np.random.default_rng(4)
    leak = np.array([0.5, 0.61, 1.3, 9.0])[:, None] + np.array([0.01, 0.03, 0.02, 0.1])[:, None] * rng.standard_normal(
        (4, GROUPS + 1)
    )
    unknown, lux = np.array([0.05, 0.02, 0.11, 0.0]), [2.0, 60.0, 700.0, 9.0]
    known = np.array([True, True, True, False])
    dark, growth = still._line(leak, unknown, known, lux)
    error = np.hypot(still.jackknife(leak[:3]), unknown[:3])
    fits = np.array([np.polyfit(lux[:3], leak[:3, k], 1, w=1 / error)[::-1] for k in range(GROUPS + 1)]).T
    design = np.stack([np.ones(3), lux[:3]], axis=1) / error[:, None]
    line = np.linalg.inv(design.T @ design) @ (design / error[:, None]).T
    for told, fit, row, unit in zip((dark, growth), fits, line, ("Hz", "Hz/lx"), strict=True):
        own = np.sqrt(19 / 20 * np.sum((fit[1:] - fit[1:].mean()) ** 2))
        assert told["value"] == pytest.approx(fit[0]) and told["unit"] == unit
        assert told["standard_error"] == pytest.approx(np.sqrt(own**2 + np.sum((row * unknown[:3]) ** 2)))
    assert "at one light;" in still._line(leak, unknown, known, [5.0, 5.0, 5.0, 1.0])[0]["reason"]


def test_leaks_without_a_ratio_are_known_where_off_events_hardly_count():
    """Half of the range 0.5 to 2 of the ratio times the OFF rate: up to a hundredth of the ON rate, or the scatter."""
    rates = np.tile(np.array([[10.0], [0.13]]), GROUPS + 1)
    told = still._leak_alone(rates, "why")
    assert told["value"] == pytest.approx(9.87) and told["standard_error"] == pytest.approx(0.75 * 0.13)
    rates[1] = 0.134
    assert "OFF events come at 0.134 Hz" in still._leak_alone(rates, "why")["reason"]
    rates[0, 1:] += np.linspace(-0.05, 0.05, GROUPS)  # 0.1006 > 0.75 · 0.134 = 0.1005
    scatter = still.jackknife(rates[0] - rates[1])
    assert (still._leak_alone(rates, "why")["value"] is None) is bool(scatter < 0.75 * 0.134)


def test_a_target_tells_each_pixels_ratio_and_so_its_leak():
    """Pixels with θ₋/θ₊ of 0.8 to 1.5, and leaks of their own in still light: counts that balance exactly."""
    rng = np.random.default_rng(5)
    group = np.arange(PIXELS) % GROUPS
    ratio = rng.uniform(0.8, 1.5, PIXELS)
    off = rng.integers(40, 90, PIXELS).astype(float)
    moving = SimpleNamespace(
        per_pixel=lambda: np.stack([ratio * off + 3.0 * 4.0, off]), seconds=4.0, group=group.astype(np.uint64),
        used=np.ones(PIXELS, bool),
    )  # fmt: skip
    tallies, own = [], np.array([[0.7], [1.9]]) * (1 + 0.4 * rng.standard_normal((2, PIXELS)))
    for leak, quiet in zip(own, (30.0, 11.0), strict=True):
        count = quiet * rng.uniform(0.5, 1.5, PIXELS)
        both = np.stack([ratio * count + leak * 2.5, count])
        tallies.append(
            SimpleNamespace(
                per_pixel=lambda both=both: both, seconds=2.5, pixels=PIXELS, group=group,
                by_group=lambda values: np.bincount(group, values, GROUPS),
            )
        )  # fmt: skip
    found = still.balance_with_target(tallies, [5.0, 80.0], moving, {"value": 1.1}, 3.0)
    assert found.ratio == {"value": 1.1}
    first, second = own.mean(axis=1)
    assert [leak["value"] for leak in found.leaks] == pytest.approx([first, second])
    # a tenth of the target's leak is not known: each pixel's ratio is off by 0.1 · 3 · 4 over its OFF events
    for leak, one, each in zip(found.leaks, tallies, own, strict=True):
        unsure = 0.1 * 12 * np.mean(1 / off) * one.per_pixel()[1].sum() / (PIXELS * 2.5)
        without = np.array([each[group != k].mean() for k in range(GROUPS)])
        scatter = np.sqrt(19 / 20 * np.sum((without - without.mean()) ** 2))
        assert scatter > 0.05 * unsure and leak["standard_error"] == pytest.approx(np.hypot(unsure, scatter))
    assert found.dark["value"] == pytest.approx(first - (second - first) * 5 / 75)
    assert found.growth["value"] == pytest.approx((second - first) / 75)


def course():
    """Light that turns without rests, and no leak: nothing but its swing."""
    none = np.zeros(target._PIXELS)
    return target._Course(none, none, (0.0, 0.0), 0.0, np.zeros((2, 2)), 0.0)


@pytest.mark.parametrize("scatters", [True, False])
def test_errors_of_a_target_go_from_its_moments_through_their_slope(monkeypatch, scatters):
    """Groups left out, simulated pixels, drift and overshoots, each by its own formula; a spread, or its limit."""
    rng, pixels, period_s, seconds, rise = np.random.default_rng(12), 200, 0.25, 11.0, 1.3
    group = rng.permutation(np.arange(pixels) % GROUPS)
    counts = rng.normal([[320.0], [210.0]], 12.0, (2, pixels))
    tally = SimpleNamespace(
        per_pixel=lambda: counts, used=np.ones(pixels, bool), seconds=seconds, group=group.astype(np.uint64),
        period_s=lambda: period_s,
    )  # fmt: skip
    ends, leak_hz, asked = np.array([[0.02, 0.05], [0.07, 0.03]]), 1.7, []
    over = SimpleNamespace(
        top=np.array([0.2, 0.4]), bottom=np.array([0.1, 0.25]), unsure=0.08, ends=ends, alike=-0.4
    )  # fmt: skip
    fitted = np.array([0.21, 0.33, 0.011 if scatters else 0.0003])
    slope = np.array([[-30.0, 2.0, 0.4], [1.5, -14.0, 0.3], [0.02, 0.01, 0.9]])
    root = rng.normal(size=(3, 3)) * [[0.03], [0.02], [0.0002]]

    class Simulated:
        def __init__(self, *given):
            asked.append(given)

        def fit(self, wanted):
            asked.append(wanted)
            return fitted, slope

        def moment_covariance(self, values):
            assert values is fitted
            return root @ root.T

    def moments(count):
        mean = count.mean(axis=1)
        return np.array([*mean, np.mean(count.var(axis=1, ddof=1) / mean**2)])

    monkeypatch.setattr(target, "seen_alike", lambda tally: tally.used)
    monkeypatch.setattr(target, "_Simulated", Simulated)
    monkeypatch.setattr(target, "_course", lambda *given: asked.append(given) or over)
    found = target.thresholds(tally, np.exp(rise), None, leak_hz)
    ratio = (counts[0].mean() - leak_hz * seconds) / counts[1].mean()
    assert asked[0][1:] == pytest.approx((leak_hz, period_s, ratio)) and asked[1][:2] == (pytest.approx(rise), 44)
    a_cycle = counts / 44
    np.testing.assert_allclose(asked[2], moments(a_cycle))
    left = [fitted + np.linalg.inv(slope) @ (moments(a_cycle[:, group != k]) - asked[2]) for k in range(GROUPS)]
    left = np.array(left).T

    def scatter(values):
        return np.sqrt(19 / 20 * np.sum((values - values.mean(axis=-1, keepdims=True)) ** 2, axis=-1))

    simulated = np.linalg.inv(slope) @ root @ root.T @ np.linalg.inv(slope).T
    unsure = 0.08 * np.array([1, 1 / ratio]) / a_cycle.mean(axis=1)
    errors = np.sqrt(scatter(left) ** 2 + np.diag(simulated) + [*(fitted[:2] * unsure) ** 2, (0.06 * fitted[2]) ** 2])
    own = ends * fitted[:2]
    beyond = np.sqrt([one @ [[1, -0.4], [-0.4, 1]] @ one for one in own])
    beyond = beyond / (rise + 0.3 * fitted[0] + 0.175 * fitted[1])
    for k, name in enumerate(("theta_on", "theta_off")):
        entry, half = found.entries[name], stats.t.ppf(0.975, 19) * errors[k]
        low, high = (np.hypot(half, part * fitted[k]) for part in beyond)
        assert entry["value"] == fitted[k]
        assert entry["interval_95"] == pytest.approx([fitted[k] - low, fitted[k] + high])
    entry = found.entries["threshold_mismatch_rel"]
    assert (fitted[2] > 2 * errors[2]) == scatters
    if scatters:
        told = entry["value"], entry["standard_error"]
        assert told == pytest.approx((np.sqrt(0.011), errors[2] / (2 * np.sqrt(0.011))))
    else:
        assert entry["value"] == 0 and entry["upper_limit"] == pytest.approx(np.sqrt(0.0003 + 2 * errors[2]))
    away = np.array([-1 / fitted[0], 1 / fitted[1], 0])
    rho = fitted[1] / fitted[0]
    more = rho**2 * ((unsure[0] + unsure[1]) ** 2 + away @ simulated @ away)
    assert found.ratio["value"] == pytest.approx(rho)
    assert found.ratio["standard_error"] == pytest.approx(np.sqrt(scatter(left[1] / left[0]) ** 2 + more))


def test_simulated_pixels_count_their_thresholds_in_the_swing():
    """Without spread and after the turns have settled: as many thresholds as lie between them, and slopes alike."""
    simulated = target._Simulated(2.1, 12, course())
    on, off, _ = simulated.moments(np.array([0.2, 0.3, 0.0]))
    # between the turns lie 2.1 less half a threshold of either kind, in the mean over places of the first turn
    assert on * 0.2 == pytest.approx(off * 0.3, rel=1e-3) and on * 0.2 == pytest.approx(2.1 - 0.25, abs=0.06)
    values, slope = simulated.fit(simulated.moments(np.array([0.22, 0.31, 0.09**2])))
    assert values == pytest.approx([0.22, 0.31, 0.0081], rel=0.02)
    assert slope[0, 0] == pytest.approx(-on / 0.2, rel=0.25) and slope[1, 1] == pytest.approx(-off / 0.3, rel=0.25)


def test_the_readout_limit_is_the_mean_of_the_fullest_windows():
    """30 windows of 198 to 200 events of 170 pixels; half of two events is what the limit may be off by."""
    windows = np.zeros(201, np.int64)
    windows[[198, 199, 200]], windows[150] = (5, 15, 10), 20
    one = SimpleNamespace(windows=windows, pixels=170)
    found, limited = readout_limit([one])
    value = (5 * 198 + 15 * 199 + 10 * 200) / 30
    assert found["value"] == pytest.approx(1000 * value) and found["standard_error"] == pytest.approx(500)
    assert found["interval_95"] == pytest.approx([1000 * (value - 1), 1000 * (value + 1)]) and limited == [one]
    windows[150] = 271  # 30 of 301 are less than a tenth
    assert readout_limit([one])[1] == []
    windows[[195, 196, 197]] = 2, 2, 3  # 7 just below: 30 are not five times as many
    assert "no two of the fullest windows" in readout_limit([one])[0]["reason"]
    windows[197] = 2
    assert readout_limit([one])[0]["value"] is not None
    windows[[198, 199, 200]] = 4, 10, 5  # 19 are too few
    assert "it is at least 200,000 events/s" in readout_limit([one])[0]["reason"]


def test_a_target_whose_cycles_do_not_show_tells_no_thresholds(monkeypatch):
    monkeypatch.setattr(target, "seen_alike", lambda tally: tally.per_pixel().min(axis=0) > 0)
    count = np.full((2, 3 * target.GROUPS), 40.0)
    tally = SimpleNamespace(
        per_pixel=lambda: count,
        period_s=lambda: None,
        seconds=3.0,
        group=np.arange(count.shape[1]),
        used=np.ones(count.shape[1], np.bool_),
    )
    found = target.thresholds(tally, 2.0, None, 0.0)
    assert "no steady period is seen" in found.ratio["reason"]
    few = target.thresholds(tally, 2.0, 0.9, 0.0)
    assert "a pixel sees 2.7 cycles of the target, with 14.8 events" in few.entries["theta_on"]["reason"]
    count[:, 2 * target.GROUPS - 1 :] = 0
    assert f"{2 * target.GROUPS} are needed" in target.thresholds(tally, 2.0, 5.0, 0.0).ratio["reason"]


@pytest.mark.parametrize(("hz", "events", "enough"), [(1.0, 4.5, True), (0.99, 4.5, False), (1.0, 4.4, False)])
def test_three_cycles_of_one_and_a_half_events_are_enough(hz, events, enough, monkeypatch):
    monkeypatch.setattr(target, "seen_alike", lambda tally: tally.used)
    monkeypatch.setattr(target, "_course", lambda *given: course())
    count = events + np.tile([-1.0, 1.0], (2, 2 * target.GROUPS))
    tally = SimpleNamespace(
        per_pixel=lambda: count,
        seconds=3.0,
        group=np.arange(count.shape[1]) // 4,
        used=np.ones(count.shape[1], np.bool_),
    )
    told = target.thresholds(tally, 2.0, hz, 0.0)
    assert ("3 cycles of 1.5 events are needed" in str(told)) is not enough


def test_leaks_are_those_of_all_pixels_with_jackknife_errors():
    """The first column is of all groups, the others leave one out; the unknown part is a square beside them."""
    rng = np.random.default_rng(4)
    leak = rng.uniform(1, 2, (2, 1)) + 0.05 * rng.standard_normal((2, 1 + GROUPS))
    unknown = np.array([0.11, 0.3])
    found = still._with_ratio(leak, unknown, None, {"value": 1.2})
    for entry, row, unsure in zip(found.leaks, leak, unknown, strict=True):
        parts = row[1:]
        scatter = np.sqrt((GROUPS - 1) / GROUPS * np.sum((parts - parts.mean()) ** 2))
        assert entry["value"] == pytest.approx(row[0]) and entry["unit"] == "Hz"
        assert entry["standard_error"] == pytest.approx(np.hypot(scatter, unsure))
    assert found.ratio == {"value": 1.2}


def test_a_tenth_of_the_leak_is_an_error_of_the_thresholds_of_a_target(monkeypatch):
    """12 thresholds of leak: half of them in 40 ON events, and 15/28 of as many missing in 30 OFF events."""
    monkeypatch.setattr(target, "seen_alike", lambda tally: tally.used)
    seen, scatter = [], np.diag([1e-4, 4e-4, 1e-6])

    class Simulated:
        def __init__(self, rise, cycles, course):
            seen.append((rise, cycles, *course.drifts))

        def fit(self, wanted):
            seen.append(wanted)
            return np.array([0.21, 0.34, 0.09]), np.diag([2.0, 4.0, 1.0])

        def moment_covariance(self, values):
            return scatter

    monkeypatch.setattr(target, "_Simulated", Simulated)
    monkeypatch.setattr(target, "rests", lambda *_: None)
    count = np.array([[40.0], [30.0]]) * np.ones(4 * target.GROUPS)
    group, used = np.arange(count.shape[1]) % target.GROUPS, np.ones(count.shape[1], np.bool_)
    tally = SimpleNamespace(per_pixel=lambda: count, seconds=3.0, group=group, used=used)
    found = target.thresholds(tally, 2.0, 4.0, 4.0)
    # half a threshold of leak in each half of the period
    assert seen[0] == (pytest.approx(np.log(2)), 12, pytest.approx(0.5), pytest.approx(0.5))
    assert seen[1] == pytest.approx([40 / 12, 30 / 12, 0])
    unsure = 0.1 * 12 * np.array([0.5 / 40, 15 / 28 / 30])
    for name, theta, leak, own in (("theta_on", 0.21, unsure[0], 1e-2 / 2), ("theta_off", 0.34, unsure[1], 2e-2 / 4)):
        assert found.entries[name]["value"] == pytest.approx(theta)
        assert found.entries[name]["standard_error"] == pytest.approx(np.hypot(theta * leak, own))
    spread = found.entries["threshold_mismatch_rel"]
    assert (spread["value"], spread["standard_error"]) == pytest.approx((0.3, 1e-3 / 0.6))
    ratio, relative = 0.34 / 0.21, np.sqrt(unsure.sum() ** 2 + (5e-3 / 0.21) ** 2 + (5e-3 / 0.34) ** 2)
    assert (found.ratio["value"], found.ratio["standard_error"]) == pytest.approx((ratio, ratio * relative))


def test_what_is_not_known_of_overshoots_widens_either_end_by_itself():
    """Squares of both are added at each end; the standard error grows as the mean of the ends."""
    own = estimated(0.31, 0.004, "ln", 7)
    half = 0.004 * stats.t.ppf(0.975, 6)
    found = target._widened(own, np.array([0.02, 0.09]))
    below, above = np.hypot(half, 0.02 * 0.31), np.hypot(half, 0.09 * 0.31)
    assert found["interval_95"] == pytest.approx([0.31 - below, 0.31 + above])
    assert found["standard_error"] == pytest.approx(0.004 * (below + above) / (2 * half))
    exact = target._widened(estimated(0.31, 0.0, "ln", 7), np.array([0.02, 0.04]))
    assert exact["standard_error"] == pytest.approx(0.03 * 0.31 / 1.959964)
    unknown = estimated(np.nan, 0.004)
    assert target._widened(unknown, np.array([0.1, 0.2])) == unknown


def test_simulated_moments_have_the_covariance_of_their_groups():
    simulated = target._Simulated(2.1, 3, course())
    values = np.array([0.22, 0.31, 0.08**2])
    count = simulated._counts(values)
    every = []
    for k in range(GROUPS):
        own = count[:, k::GROUPS]
        every.append([own[0].mean(), own[1].mean(), np.mean(own.var(axis=1, ddof=1) / own.mean(axis=1) ** 2)])
    np.testing.assert_allclose(simulated.moment_covariance(values), np.cov(np.transpose(every)) / GROUPS)


def test_simulated_pixels_turn_at_the_ends_of_the_swing(monkeypatch):
    """A loop over nine pixels: levels begin anywhere in the swing, and the first four cycles are not counted."""
    monkeypatch.setattr(target, "_PIXELS", 9)
    simulated = target._Simulated(1.7, 3, course())
    counts = simulated._counts(np.array([0.31, 0.23, 0.15**2]))
    assert sorted(simulated._start) == pytest.approx((np.arange(9) + 0.5) / 9)
    for k in range(9):
        on, off = 0.31 * (1 + 0.15 * simulated._z[0, k]), 0.23 * (1 + 0.15 * simulated._z[1, k])
        level, ups, downs = 1.7 * simulated._start[k], 0, 0
        for cycle in range(7):
            while level + on <= 1.7 + 1e-9:
                level, ups = level + on, ups + (cycle >= 4)
            while level - off >= -1e-9:
                level, downs = level - off, downs + (cycle >= 4)
        assert counts[:, k] == pytest.approx([ups / 3, downs / 3])


@pytest.mark.parametrize("true", [(0.21, 0.34, 0.0625), (0.9, 0.4, 0.04)])
def test_thresholds_with_a_wide_mismatch_are_found_from_their_own_moments(true):
    """The begin of the search is 20 % off for thresholds and twice too large for the variance."""
    simulated = target._Simulated(2.1, 12, course())
    wanted = simulated.moments(np.array(true))
    found, slope = simulated.fit(wanted)
    np.testing.assert_allclose(simulated.moments(found), wanted, rtol=4e-3)
    # pixels are left out as a whole, so that the variance of few of them makes steps
    np.testing.assert_allclose(found[:2], true[:2], rtol=4e-3)
    assert found[2] == pytest.approx(true[2], rel=0.01)
    # the slope is that of the moments there, over steps of 5 %
    away = np.array([0.02 * true[0], 0.0, 0.0])
    change = (simulated.moments(found + away) - simulated.moments(found - away)) / (2 * away[0])
    np.testing.assert_allclose(slope[:2, 0], change[:2], rtol=0.1, atol=0.1 * np.abs(slope[0, 0]))


def windows_of(counts, pixels=20_000):
    """Recordings with so many windows of each number of events."""
    size = max(counts) + 1
    return SimpleNamespace(windows=np.bincount(list(counts), list(counts.values()), size).astype(int), pixels=pixels)


@pytest.mark.parametrize(("counts", "reason"), [
    ({5000: 40, 4999: 30, 4998: 30, 4997: 20}, None),  # 100 full, 20 below
    ({5000: 40, 4999: 30, 4998: 30, 4997: 21}, "no two of the fullest windows are equally full"),
    ({5000: 9, 4998: 11}, None),
    ({5000: 9, 4998: 10}, "no two of the fullest windows are equally full"),  # fewer than 20
    ({5000: 40, 4999: 30, 4998: 30, 4995: 20}, None),
    ({5000: 40, 4999: 30, 4998: 30, 4994: 500}, None),  # too far below to count
    ({5000: 40, 4999: 30, 4998: 30, 4994: 901}, None),  # less than a tenth of the time
    ({5000: 40, 4999: 30, 4998: 30, 4994: 899}, None),
])  # fmt: skip
def test_a_read_out_at_its_limit_fills_its_windows_equally(counts, reason, monkeypatch):
    """Full are windows within 2 events of the fullest, as a share of 0.04 % asks for."""
    monkeypatch.setattr(short_intervals, "_SAME", 4e-4)
    found, limited = readout_limit([one := windows_of(counts), windows_of({4000: 900, 3000: 70})])
    if reason is not None:
        assert reason in found["reason"] and limited == []
        return
    full = {count: number for count, number in counts.items() if count >= 4998}
    mean = sum(count * number for count, number in full.items()) / sum(full.values())
    assert found["value"] == pytest.approx(1000 * mean) and found["standard_error"] == pytest.approx(500)
    assert found["interval_95"] == pytest.approx([1000 * (mean - 1), 1000 * (mean + 1)])
    assert limited == ([one] if sum(full.values()) > 0.1 * sum(counts.values()) else [])


WHOLE = [(5000, True), (5102, True), (5103, False), (4999, False), (1683, True)]


@pytest.mark.parametrize(("pixels", "is_limit_of_pixels"), WHOLE)
def test_windows_that_hold_whole_events_of_every_pixel_tell_no_limit(pixels, is_limit_of_pixels):
    """Up to 2 % below 1 event, or 3, of each pixel, as a few pixels are silent; above 1 it is no whole number."""
    found, _ = readout_limit([windows_of({5000: 60, 4999: 60}, pixels)])
    assert ("events of every pixel" in found.get("reason", "")) == is_limit_of_pixels


@pytest.mark.parametrize(("events", "pixels", "is_unsteady"), [
    (300.0, 5000, True), (300.0, 20, True), (1.5, 5000, False), (1.5, 20, False),
])  # fmt: skip
def test_a_rate_that_doubles_is_unsteady_beyond_four_errors_of_counting(events, pixels, is_unsteady):
    """In both polarities together, whatever the rate of a pixel is; the last quarter has twice the first."""
    course = events * np.linspace(0.62, 1.38, SLICES)
    tally = SimpleNamespace(slices=np.stack([0.7 * course, 0.3 * course])[..., None], pixels=pixels, seconds=8.0)
    found = stillness.unsteady(tally)
    assert (found is not None) == is_unsteady
    if is_unsteady:
        rate = course / (pixels * 8.0 / SLICES)
        quarter = SLICES // 4
        early, late = rate[:quarter].mean(), rate[-quarter:].mean()
        assert f"from {early:.4g} to {late:.4g} Hz a pixel, at most {rate.max():.4g}" in found
    tally.slices[:] = events / 2
    assert stillness.unsteady(tally) is None


def test_the_error_of_a_leak_without_a_ratio_has_the_scatter_of_the_difference():
    """ON and OFF scatter together, by 3 % and 1 % of ON; OFF events are a thousandth of ON."""
    rates = np.tile(np.array([[10.0], [0.01]]), GROUPS + 1)
    rates[:, 1:] += np.array([[3.0], [1.0]]) * np.linspace(-0.1, 0.1, GROUPS)
    scatter = np.sqrt(19 / 20 * np.sum((2 * np.linspace(-0.1, 0.1, GROUPS)) ** 2))
    told = still._leak_alone(rates, "why")
    assert told["standard_error"] == pytest.approx(np.hypot(scatter, 0.75 * 0.01))


@pytest.mark.parametrize(("count", "of"), [(7, 23), (0, 40), (31, 31)])
def test_a_share_has_the_interval_of_a_binomial_count(count, of):
    told = still.share(count, of)
    interval = stats.binomtest(count, of).proportion_ci(method="exact")
    assert told["value"] == count / of and told["interval_95"] == pytest.approx([interval.low, interval.high])
    assert told["standard_error"] == pytest.approx(stats.binom.std(of, count / of) / of)


@pytest.mark.parametrize("periods", [1.95, 2.05])
def test_a_lamp_is_told_from_slices_of_two_of_its_periods(periods):
    """All ON events at one phase of the slower lamp."""
    seconds = periods * SLICES / min(LAMPS_HZ)
    slices = np.zeros((2, SLICES, GROUPS), int)
    slices[0] = 50
    on = slices[0].sum(axis=1)
    waves = on * np.exp(0.4j) * np.array([[lamp == min(LAMPS_HZ)] for lamp in LAMPS_HZ])
    told = stillness.of_a_lamp(SimpleNamespace(slices=slices, seconds=seconds, waves=waves))
    assert (told is not None) == (periods > 2)
    if told is not None:
        assert f"a lamp of {min(LAMPS_HZ):g} Hz" in told


@pytest.mark.parametrize("fewest", [0, 1])
def test_a_slice_without_on_events_has_no_phase_of_a_lamp(fewest):
    """All others have one phase of the slower lamp; a slice of one event is as good as any."""
    slices = np.zeros((2, SLICES, GROUPS), int)
    slices[0, :, 0] = 900
    slices[0, 4, 0] = fewest
    on = slices[0].sum(axis=1)
    waves = on * np.exp(0.7j) * np.array([[lamp == min(LAMPS_HZ)] for lamp in LAMPS_HZ])
    found = stillness.of_a_lamp(SimpleNamespace(slices=slices, seconds=4.0, waves=waves))
    assert (found is not None) == (fewest > 0)


@pytest.mark.parametrize(("contrast", "cycles_hz", "is_right"), [
    (1.001, 0.01, True), (1.0, 3.0, False), (9999.0, None, True), (1e4, None, False), (2.0, 0.0, False),
    (2.0, -3.0, False), (None, 3.0, False),
])  # fmt: skip
def test_a_target_has_a_contrast_above_one_and_cycles(contrast, cycles_hz, is_right):
    if is_right:
        calibration._check_target(True, contrast, cycles_hz)
    else:
        with pytest.raises(RangeError, match="target_"):
            calibration._check_target(contrast is not None, contrast, cycles_hz)


def test_files_are_read_in_equal_parts_of_the_progress(monkeypatch):
    parts = []
    monkeypatch.setattr(calibration, "open_events", lambda name, **_: SimpleNamespace(shape=(3, 4), name=name))
    monkeypatch.setattr(calibration, "tally", lambda stream: SimpleNamespace(shape=(3, 4), name=stream.name))
    monkeypatch.setattr(
        target, "of_whole_cycles", lambda stream, first, cycles_hz: SimpleNamespace(name=f"{first.name} {cycles_hz}")
    )
    monkeypatch.setattr(
        calibration, "figures", lambda tallies, moving, *given: ([t.name for t in tallies], moving.name)
    )
    found = calibration.calibrate_recordings(
        ["a", "b"], lux=[3.0, 8.0], target_file="c", target_contrast=4.0, progress=lambda what, part: parts.append(part)
    )
    assert found == (["a", "b"], "c None") and parts == pytest.approx([0, 0.25, 0.5, 0.75])


@pytest.mark.parametrize("seed", [5, 12, 14, 18, 24])
def test_the_step_of_a_density_is_where_two_poisson_laws_are_likeliest(seed):
    """Counts of each µs, before d and from d to 2 d: the gain in likelihood over one law."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(np.where(np.arange(60) < rng.integers(3, 9), rng.uniform(20, 80), 45)).astype(np.float64)

    def log(some, rate):
        return stats.poisson.logpmf(some, rate).sum()

    gains = {}
    for d in range(1, 30):
        below, upper = counts[:d], counts[d : 2 * d + 1]
        if upper.sum() >= 100 and upper.mean() > below.mean():
            both = counts[: 2 * d + 1]
            gains[d] = log(below, below.mean()) + log(upper, upper.mean()) - log(both, both.mean())
    best = max(gains, key=gains.get)
    assert short_intervals._steepest(counts) == best

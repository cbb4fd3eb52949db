"""Distances of two streams of events: equal laws are not far apart, each change shows in its own figure."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.core.errors import SpecError
from hesim_render.exchange import EventStream
from hesim_render.measure import event_distance
from hesim_render.measure.event_distance import event_distances, event_statistics, of_equal_time
from hesim_render.pixels.evs.events import EVENT_DTYPE

SHAPE, SECONDS, RATE_HZ = (31, 37), 2.6, 21.0
PIXELS = SHAPE[0] * SHAPE[1]


def made(t_us, pixel, polarity):
    order = np.argsort(t_us, kind="stable")
    events = np.zeros(t_us.size, EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us[order], polarity[order]
    events["y"], events["x"] = np.divmod(pixel[order], SHAPE[1])
    return events


def poisson(seed, rate=1.0, on=0.6, hot=0, rhythm=0.0, burst=1, pairs=0.0, regular=False):
    """Random events; `rhythm` of 40 Hz in the rate, bursts, events of neighbours at once, or equal intervals."""
    rng = np.random.default_rng(seed)
    count = rng.poisson(rate * RATE_HZ * PIXELS * SECONDS / burst)
    t_us, pixel = rng.uniform(0, SECONDS * 1e6, count), rng.integers(0, PIXELS, count)
    if regular:
        number = round(RATE_HZ * SECONDS)
        pixel = np.repeat(np.arange(PIXELS), number)
        t_us = (np.tile(np.arange(number), PIXELS) + rng.random(PIXELS)[pixel]) / RATE_HZ * 1e6
        keep = t_us < SECONDS * 1e6
        t_us, pixel = t_us[keep], pixel[keep]
    keep = rng.random(t_us.size) < (1 + rhythm * np.sin(2 * np.pi * 40 * t_us * 1e-6)) / (1 + rhythm)
    t_us, pixel = t_us[keep], pixel[keep]
    if hot:
        extra = rng.poisson(40 * RATE_HZ * SECONDS, hot)
        t_us = np.append(t_us, rng.uniform(0, SECONDS * 1e6, extra.sum()))
        pixel = np.append(pixel, np.repeat(np.arange(hot) * 29, extra))
    if burst > 1:
        t_us = (t_us[:, None] + 400 * np.arange(burst)).ravel()
        pixel = np.repeat(pixel, burst)
    if pairs:
        chosen = (rng.random(t_us.size) < pairs) & (pixel % SHAPE[1] < SHAPE[1] - 1)
        t_us, pixel = np.append(t_us, t_us[chosen] + 30), np.append(pixel, pixel[chosen] + 1)
    polarity = np.where(rng.random(t_us.size) < on, 1, -1)
    return event_statistics(EventStream.of(made(np.ceil(t_us).astype(int), pixel, polarity), SHAPE))


def test_equal_laws_do_not_differ():
    """Seven figures, eight pairs: at 5 % each three differ on average; 10 or more have a chance of 1e-3."""
    found = [event_distances(poisson(2 * k), poisson(2 * k + 1)) for k in range(8)]
    assert sum(one.differs for distances in found for one in distances) < 10
    assert all(one.value == 0 for one in event_distances(poisson(3), poisson(3)))
    assert {one.name for one in found[0] if one.first is not None} == {"rate", "polarity", "hot pixels"}
    for distances in found:
        assert {one.name: one for one in distances}["rate"].value < 0.03


@pytest.mark.parametrize(("changes", "name", "value"), (
    ({"rate": 1.5}, "rate", np.log(1.5)),
    ({"on": 0.7}, "polarity", 0.2),
    ({"regular": True}, "intervals", None),
    ({"rhythm": 0.6}, "time", None),
    ({"pairs": 0.4}, "space", None),
    ({"hot": 12}, "hot pixels", 12 / PIXELS),
    ({"burst": 3}, "bursts", None),
), ids=("rate", "polarity", "intervals", "time", "space", "hot", "bursts"))  # fmt: skip
def test_each_change_shows_in_its_figure(changes, name, value):
    one = {found.name: found for found in event_distances(poisson(1), poisson(2, **changes))}[name]
    assert one.differs
    assert one.value > 2 * one.within
    assert one.interval_95[0] <= one.value * 1.2 and one.interval_95[1] >= one.value * 0.8
    if value is not None:
        assert one.value == pytest.approx(value, abs=0.03)


def by_loop(t_us, pixel, begin_us, part_us, shape):
    """What `event_statistics` sums, one event after the other."""
    cols = shape[1]
    last, series = {}, np.zeros((20, part_us // 1000), int)
    intervals, runs, active = [], [[] for _ in range(20)], [set() for _ in range(20)]
    open_runs = [{} for _ in range(20)]
    for time, place in zip(t_us, pixel, strict=True):
        part, inside = divmod(time - begin_us, part_us)
        if inside // 1000 < series.shape[1]:
            series[part, inside // 1000] += 1
        if inside // 5000 < part_us // 5000:
            active[part].add((inside // 5000, place // cols, place % cols))
        if place in last:
            intervals.append(max(time - last[place], 1))
        if place in open_runs[part] and time - last[place] <= 1000:
            open_runs[part][place] += 1
        else:
            if place in open_runs[part]:
                runs[part].append(open_runs[part][place])
            open_runs[part][place] = 1
        last[place] = time
    bursts = np.zeros((20, 65), int)
    for part in range(20):
        for length in (*runs[part], *open_runs[part].values()):
            bursts[part, min(length, 64)] += 1
    neighbours = ((0, 1), (1, 0), (0, 2), (2, 0))
    both = [
        [len(of), *(sum((w, r + down, c + right) in of for w, r, c in of) for down, right in neighbours)]
        for of in active
    ]
    return intervals, series, bursts, np.array(both)


def test_statistics_are_those_of_a_loop():
    """Events in blocks that end within the parts, some of them at once, one pixel with a burst longer than 64."""
    rng = np.random.default_rng(5)
    shape = (6, 9)
    t_us = np.concatenate([rng.integers(300, 143_000, 6000), 70_100 + 11 * np.arange(90)])
    pixel = np.concatenate([rng.integers(0, 54, 6000), np.full(90, 41)])
    order = np.argsort(t_us, kind="stable")
    t_us, pixel = t_us[order], pixel[order]
    sign = np.where(rng.random(t_us.size) < 0.7, 1, -1)
    events = np.zeros(t_us.size, EVENT_DTYPE)
    events["t_us"], events["y"], events["x"], events["polarity"] = t_us, pixel // 9, pixel % 9, sign
    found = event_statistics(EventStream(lambda: iter(np.array_split(events, 7)), shape))
    part_us = -(-(t_us[-1] + 1 - t_us[0]) // 20)
    gaps, series, bursts, active = by_loop(t_us.tolist(), pixel.tolist(), int(t_us[0]), int(part_us), shape)
    assert found.seconds == part_us * 1e-6 and found.windows == part_us // 5000
    assert np.array_equal(found.intervals.sum(axis=0), np.histogram(gaps, 10 ** np.linspace(0.0, 8.0, 161))[0])
    assert np.array_equal(found.series, series)
    assert np.array_equal(found.bursts, bursts) and bursts[:, 64].sum() == 1
    assert np.array_equal(found.active, active)
    part = (t_us - t_us[0]) // part_us
    assert np.array_equal(found.pixels, np.histogram2d(part, pixel, (np.arange(21), np.arange(55)))[0])
    assert found.polarity.tolist() == [[np.sum(sign[part == k] == s) for s in (1, -1)] for k in range(20)]


def test_correlation_over_time_at_six_lags():
    """Those of the definition; lags that the windows do not have count as 0."""
    rng = np.random.default_rng(8)
    series = rng.poisson(20 + 9 * np.sin(np.arange(50) / 3.0), (4, 50))
    draw = np.array([2, 0, 2])
    rest = series[draw] - series[draw].mean()
    wanted = [np.mean(rest[:, lag:] * rest[:, : 50 - lag]) / rest.var() for lag in (1, 2, 4, 8, 16, 32)]
    assert event_distance._over_time(SimpleNamespace(series=series), draw) == pytest.approx(wanted)
    short = event_distance._over_time(SimpleNamespace(series=series[:, :8]), draw)
    assert short.size == 6 and short[3:].tolist() == [0, 0, 0] and np.all(short[:3] != 0)


def test_hot_pixels_have_more_than_ten_times_the_usual_rate():
    """Usual is the mean of the lower nine tenths: 2; 21 is hot, 20 is not. Where nothing happens, 3 are not hot."""
    counts = np.array([[2] * 18 + [20, 21]])
    assert event_distance._hot(SimpleNamespace(pixels=counts), np.array([0])) == [1 / 20]
    counts = np.array([[0] * 18 + [3, 4]])
    assert event_distance._hot(SimpleNamespace(pixels=counts), np.array([0])) == [1 / 20]


def test_intervals_and_bounds_are_those_of_the_bootstrap():
    """Two rates of which each part is another: half widths as those of the law of the mean of 20 parts."""
    rng = np.random.default_rng(11)
    first, second = poisson(3), poisson(4, rate=1.3)
    for one in (first, second):
        one.polarity[:] = rng.normal(1.3 if one is second else 1.0, 0.1, (20, 1)) * np.array([[4000, 3000]])
    found = {one.name: one for one in event_distances(first, second)}["rate"]
    assert found.first == pytest.approx(first.polarity.sum() / (20 * first.seconds * PIXELS))
    assert found.second == pytest.approx(second.polarity.sum() / (20 * second.seconds * PIXELS))
    assert found.value == pytest.approx(np.log(found.second / found.first))
    errors = [one.polarity.sum(axis=1).std() / one.polarity.sum(axis=1).mean() / np.sqrt(20) for one in (first, second)]
    half = 1.96 * np.hypot(*errors)
    assert found.interval_95 == pytest.approx((found.value - half, found.value + half), abs=0.3 * half)
    assert found.within == pytest.approx(1.96 * np.sqrt(2) * errors[0], rel=0.25)
    assert [one.name for one in event_distances(first, second) if one.first is not None] == [
        "rate", "polarity", "hot pixels",
    ]  # fmt: skip


def test_bounds_are_these_percentiles_of_the_draws(monkeypatch):
    """Distances of 200 draws 10 + k between the streams, k within the first; 300 is that of the whole."""
    order = np.random.default_rng(6).permutation(200)
    between, within = iter(10.0 + order), iter(1.0 * order[::-1])

    def figure(statistics, draw):
        return np.array([statistics.source, np.array_equal(draw, np.arange(20))], object)

    def distance(one, other):
        if one[1]:
            return 300.0
        return next(within if one[0] == other[0] else between)

    monkeypatch.setattr(event_distance, "_FIGURES", [("a", "b", figure, distance, False, None)])
    streams = [SimpleNamespace(shape=SHAPE, source=name) for name in ("one", "other")]
    (found,) = event_distances(*streams)
    # the p-th percentile of 0 to 199 is 1.99 p; Student's factor is 2.093 in place of 1.96
    wider = 2.0930 / 1.9600 * np.sqrt(20 / 19)
    half = wider * 1.99 * (97.5 - 50)
    assert found.interval_95 == pytest.approx((300 - half, 300 + half), rel=1e-4)
    assert found.within == pytest.approx(wider * 1.99 * 95, rel=1e-4) and found.value == 300


def test_the_lower_end_has_the_noise_taken_off_and_is_0_where_streams_do_not_differ(monkeypatch):
    """Draws 200 + k between the streams, about a whole of 250: their median is 50 above it."""
    for within, low in ((210.0, 250 - 1.0955 * (200 + 1.99 * 97.5 - 250)), (240.0, 0.0)):
        between = iter(200.0 + np.arange(200))

        def distance(one, other, own=within, draws=between):
            return 250.0 if one[1] else own if one[0] == other[0] else next(draws)

        figure = ("a", "b", lambda s, draw: np.array([s.source, np.array_equal(draw, np.arange(20))], object),
                  distance, False, None)  # fmt: skip
        monkeypatch.setattr(event_distance, "_FIGURES", [figure])
        (found,) = event_distances(*(SimpleNamespace(shape=SHAPE, source=name) for name in ("one", "other")))
        assert found.interval_95 == pytest.approx((low, 250 + 1.0955 * 1.99 * 47.5), rel=1e-3)


def test_pixels_that_know_nothing_of_one_another_have_no_correlation():
    """A part of 129.98 ms has 25 whole windows; events after them, counted as those of a 26th, make it −0.0045."""
    found = np.mean([event_distance._over_space(poisson(k), np.arange(20)) for k in range(60, 72)], axis=0)
    assert np.all(np.abs(found) < 4 * 0.0013 / np.sqrt(12))


def halves(seed):
    """A process of pixels of unlike rates, some hot, of which 0.5 s are one stream and the 4 s after it another."""
    rng = np.random.default_rng(seed)
    rate_hz = 9.0 * np.exp(0.6 * rng.standard_normal(PIXELS))
    rate_hz[rng.integers(0, PIXELS, 6)] += rng.uniform(100, 400, 6)
    pixel = np.repeat(np.arange(PIXELS), rng.poisson(4.5 * rate_hz))
    t_us = rng.integers(0, 4_500_000, pixel.size)
    on = np.where(rng.random(pixel.size) < rng.uniform(0.4, 0.7, PIXELS)[pixel], 1, -1)
    is_short = t_us < 500_000
    return [EventStream.of(made(t_us[kept], pixel[kept], on[kept]), SHAPE) for kept in (is_short, ~is_short)]


def test_a_shorter_recording_of_the_same_does_not_differ():
    """Of 28 figures, at 5 % each, six or more differ with a chance of 2e-3."""
    streams = [halves(seed)[:: 1 if seed % 2 else -1] for seed in range(4)]
    both = [[event_statistics(one) for one in of_equal_time(*pair)] for pair in streams]
    assert sum(one.differs for pair in both for one in event_distances(*pair)) < 6


def test_of_two_recordings_as_much_time_counts():
    """As of the longer one without its later events; without events enough in it, it is refused."""
    short, long = halves(5)
    begin_us, end_us = short.span_us()
    (events,) = long.blocks()
    until_us = events["t_us"][0] + end_us - begin_us
    cut = EventStream.of(events[events["t_us"] <= until_us], SHAPE)
    parts, read = np.array_split(events, 9), []
    other, one = of_equal_time(replace(long, blocks=lambda: (read.append(part) or part for part in parts)), short)
    read.clear()
    assert one.interval_us == (begin_us, end_us) and other.interval_us == (events["t_us"][0], until_us)
    found = event_statistics(other)
    assert len(read) == 1 + np.argmax([part["t_us"][-1] > until_us for part in parts]) < 5  # no later ones are held
    expected = event_statistics(replace(cut, interval_us=other.interval_us))
    for name in ("polarity", "intervals", "series", "active", "bursts", "pixels"):
        assert np.array_equal(getattr(found, name), getattr(expected, name))
    assert found.seconds == event_statistics(short).seconds and found.polarity.sum() == cut.count() < events.size
    late = EventStream.of(np.append(events[:900], events[-3000:]), SHAPE, "late")
    with pytest.raises(SpecError, match=r"late: has 900 events in 0\.4\d+ s; expected 2000"):
        event_statistics(of_equal_time(late, short)[0])


@pytest.mark.parametrize("part", (0, 19))
def test_each_part_is_drawn(part):
    """All but a few events are in one part, two of three ON: a draw has it, or not, and then as many of both."""
    one = poisson(33)
    one.polarity[:] = 1
    one.polarity[part] = 4000, 2000
    found = {d.name: d for d in event_distances(one, poisson(34))}["polarity"]
    assert found.within == pytest.approx(1.0955 / 3, rel=0.02)


def test_one_burst_in_thousands_is_no_difference():
    """None in the first stream of 54,000, one in the second, in 18,000: any draw of the first has none."""
    one, other = poisson(31), poisson(32)
    one.bursts[:], other.bursts[:] = 0, 0
    one.bursts[:, 1], other.bursts[:, 1], other.bursts[3, 2] = 2700, 900, 1
    found = {d.name: d for d in event_distances(one, other)}
    assert found["bursts"].value == pytest.approx(1 / 18_001) and not found["bursts"].differs
    assert found["bursts"].within == pytest.approx(3 / 18_001)
    assert found["bursts"].interval_95[1] >= 3.99 / 18_001 and found["hot pixels"].interval_95 == (0.0, 3 / PIXELS)
    other.bursts[3, 2] = 4
    assert {d.name: d for d in event_distances(one, other)}["bursts"].differs


def truth_of(changes, more):
    """Distances of the mean figures of 40 streams each."""
    means = [
        [np.mean([figure[2](poisson(seed, **keys), np.arange(20)) for seed in range(90_000, 90_040)], axis=0)
         for figure in event_distance._FIGURES]
        for keys in (changes, changes | more)
    ]  # fmt: skip
    return {figure[0]: figure[3](a, b) for figure, a, b in zip(event_distance._FIGURES, *means, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "more"), (
    ({}, {}),
    ({"hot": 6}, {}),
    ({"rhythm": 0.4, "burst": 3}, {}),
    ({}, {"rate": 1.02, "on": 0.606, "rhythm": 0.1, "pairs": 0.01}),
    ({"rhythm": 0.4, "burst": 2}, {"rate": 1.1, "on": 0.62, "rhythm": 0.5, "pairs": 0.1}),
), ids=("equal", "equal, hot", "equal, bursts", "nearly equal", "different"))  # fmt: skip
def test_intervals_hold_the_true_distance_of_sixty_pairs(changes, more):
    """Fewer than 51 of 60 have a chance of 1e-3 where 94 of 100 are expected."""
    true = truth_of(changes, more) if more else {}
    inside = {figure[0]: 0 for figure in event_distance._FIGURES}
    for seed in range(1000, 1120, 2):
        for one in event_distances(poisson(seed, **changes), poisson(seed + 1, **(changes | more))):
            inside[one.name] += one.interval_95[0] <= true.get(one.name, 0.0) <= one.interval_95[1]
    assert min(inside.values()) >= 51, inside


def test_an_interval_holds_its_value_where_drawn_parts_have_other_ones():
    """Hot pixels of a part alone: in drawn parts, which repeat, fewer pixels are hot, or more of them."""
    one, other = poisson(21), poisson(22)
    one.pixels[:] = 1
    for part in range(20):
        one.pixels[part, 40 * part : 40 * part + 5] = 220
    found = {d.name: d for d in event_distances(one, other)}["hot pixels"]
    low, high = found.interval_95
    assert found.value == pytest.approx(100 / PIXELS) and low < found.value < high


def test_the_shortest_stream_has_two_windows_a_part():
    rng = np.random.default_rng(2)
    for last_us, enough in ((39_980, True), (39_979, False)):
        t_us = np.append(rng.integers(0, 39_979, 3000), (0, last_us))
        stream = EventStream.of(made(t_us, rng.integers(0, PIXELS, 3002), np.ones(3002, int)), SHAPE)
        if enough:
            assert event_statistics(stream).series.shape == (20, 2)
        else:
            with pytest.raises(SpecError, match="expected 40000 µs at least"):
                event_statistics(stream)


def test_bad_input_is_one_clear_error():
    rng = np.random.default_rng(1)
    few = made(np.arange(100) * 1000, rng.integers(0, PIXELS, 100), np.ones(100, int))
    with pytest.raises(SpecError, match=r"few: has 100 events in 0\.099 s; expected 2000"):
        event_statistics(EventStream.of(few, SHAPE, "few"))
    short = EventStream.of(made(np.arange(100), few["x"], few["polarity"]), SHAPE, "short")
    with pytest.raises(SpecError, match="short: lasts 99 µs; expected 40000"):
        event_statistics(short)
    # the longer one, cut to the time of the other, is not what is too short
    for pair in ((EventStream.of(few, SHAPE, "few"), short), (short, EventStream.of(few, SHAPE, "few"))):
        with pytest.raises(SpecError, match="short: lasts 99 µs; expected 40000"):
            of_equal_time(*pair)


def test_sensors_of_other_sizes_are_compared_pixel_by_pixel():
    """Random events at 6 Hz a pixel of 12x50 and of 31x37 pixels: no figure differs; at 6 and 9 Hz, ln 1.5 does."""
    rng = np.random.default_rng(6)
    several = []
    for shape, hz in (((50, 12), 6.0), ((37, 31), 6.0), ((37, 31), 9.0)):
        pixels = shape[0] * shape[1]
        count = rng.poisson(hz * pixels * 20)
        events = made(rng.integers(0, 20 * 10**6, count), rng.integers(0, 12, count), rng.choice([-1, 1], count))
        events["x"], events["y"] = rng.integers(0, shape[1], count), rng.integers(0, shape[0], count)
        several.append(event_statistics(EventStream.of(events, shape)))
    alike, other = (event_distances(several[0], one) for one in several[1:])
    assert sum(one.differs for one in alike) <= 1  # of seven, with a chance of 0.05 each
    assert other[0].value == pytest.approx(np.log(1.5), abs=0.03) and other[0].differs


def test_neighbours_that_are_active_together_more_often_than_by_chance_correlate():
    """A quarter of 4 by 6 pixels is active; neighbours at four distances together in 0.1, 0.0625, 0.25 and 0.04."""
    pairs, both = np.array([4 * 5, 3 * 6, 4 * 4, 2 * 6]), np.array([0.1, 0.0625, 0.25, 0.04])
    active = np.append(0.25 * 24, pairs * both)[None] * 400
    found = event_distance._over_space(SimpleNamespace(active=active, shape=(4, 6), windows=400), np.array([0]))
    assert found == pytest.approx((both - 0.0625) / (0.25 * 0.75)) and found[1] == 0


def test_the_rate_correlates_with_itself_at_lags_of_1_to_32_ms():
    series = np.random.default_rng(8).poisson(3.0, (4, 90))
    found = event_distance._over_time(SimpleNamespace(series=series), np.array([2, 0, 2]))
    drawn = series[[2, 0, 2]] - series[[2, 0, 2]].mean()
    expected = [
        sum(a * b for row in drawn for a, b in zip(row, row[lag:], strict=False)) / (3 * (90 - lag)) / drawn.var()
        for lag in (1, 2, 4, 8, 16, 32)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    short = event_distance._over_time(SimpleNamespace(series=series[:, :32]), np.array([2, 0, 2]))
    assert np.isfinite(short).all() and short[-1] == 0 and np.all(short[:-1] != 0)

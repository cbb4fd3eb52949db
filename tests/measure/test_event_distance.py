"""Distances of two streams of events: equal laws are not far apart, each change shows in its own figure."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2, f

from hesim_render.core.errors import SpecError
from hesim_render.exchange import EventStream
from hesim_render.measure import event_distance
from hesim_render.measure.event_distance import event_distances
from hesim_render.measure.event_statistics import event_statistics, of_equal_time
from hesim_render.pixels.evs.events import EVENT_DTYPE

SHAPE, SECONDS, RATE_HZ = (31, 37), 2.6, 21.0
PIXELS = SHAPE[0] * SHAPE[1]


def made(t_us, pixel, polarity):
    order = np.argsort(t_us, kind="stable")
    events = np.zeros(t_us.size, EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us[order], polarity[order]
    events["y"], events["x"] = np.divmod(pixel[order], SHAPE[1])
    return events


def rates_of(sensor, spread):
    """Rates of the pixels of a sensor, about a mean of 1 of all sensors: log-normal, far above and below."""
    return np.exp(spread * np.random.default_rng(sensor).standard_normal(PIXELS) - spread**2 / 2)


def poisson(seed, rate=1.0, on=0.6, hot=0, rhythm=0.0, burst=1, pairs=0.0, regular=False, spread=0.0, sensor=0):
    """Random events; `rhythm` of 40 Hz in the rate, bursts, events of neighbours at once, or equal intervals."""
    rng = np.random.default_rng(seed)
    pixel = np.repeat(np.arange(PIXELS), rng.poisson(rate * RATE_HZ * SECONDS / burst * rates_of(sensor, spread)))
    t_us = rng.uniform(0, SECONDS * 1e6, pixel.size)
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
    ({"hot": 24}, "hot pixels", 24 / PIXELS),
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
    intervals, runs, active = [[] for _ in range(20)], [], [set() for _ in range(20)]
    open_runs = {}
    for time, place in zip(t_us, pixel, strict=True):
        part, inside = divmod(time - begin_us, part_us)
        if inside // 1000 < series.shape[1]:
            series[part, inside // 1000] += 1
        if inside // 5000 < part_us // 5000:
            active[part].add((inside // 5000, place // cols, place % cols))
        if place in last:
            intervals[part].append((time, max(time - last[place], 1)))
        if place in last and time - last[place] <= 1000:
            open_runs[place] += 1
        else:
            if place in last:
                runs.append((last[place], open_runs[place]))
            open_runs[place] = 1
        last[place] = time
    bursts = np.zeros((20, 65), int)
    for time, length in runs + [(last[place], length) for place, length in open_runs.items()]:
        bursts[min((time + 1000 - begin_us) // part_us, 19), min(length, 64)] += 1
    neighbours = ((0, 1), (1, 0), (0, 2), (2, 0))
    both = [
        [len(of), *(sum((w, r + down, c + right) in of for w, r, c in of) for down, right in neighbours)]
        for of in active
    ]
    return intervals, series, bursts, np.array(both), last


def at_risk_by_loop(intervals, last, begin_us, part_us):
    """Intervals that reach each age in each part; one that comes into a part or leaves it counts half in that bin."""
    bounds_us, found = 10 ** np.linspace(0.0, 8.0, 161), np.zeros((20, 162))
    ended = [(time - gap, time) for part in intervals for time, gap in part]
    for start, end in ended + [(time, begin_us + 20 * part_us + 1) for time in last.values()]:
        for part in range(20):
            first = begin_us + part * part_us
            if start < first + part_us and end >= first:
                lowest = np.searchsorted(bounds_us, first - start, side="right")
                highest = np.searchsorted(bounds_us, min(first + part_us, end) - start, side="right")
                found[part, lowest + 1 : highest + 1] += 1
                found[part, lowest] += 0.5 * (start < first)
                found[part, highest] -= 0.5 * (end >= first + part_us)
    return found[:, 1:]


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
    begin_us, part_us = int(t_us[0]), int(part_us)
    gaps, series, bursts, active, last = by_loop(t_us.tolist(), pixel.tolist(), begin_us, part_us, shape)
    assert found.seconds == part_us * 1e-6 and found.windows == part_us // 5000
    for ended, part in zip(found.intervals, gaps, strict=True):
        counted = np.histogram([gap for _, gap in part], 10 ** np.linspace(0.0, 8.0, 161))[0]
        assert np.array_equal(ended[:-1], counted) and ended[-1] == 0
    assert np.array_equal(found.at_risk, at_risk_by_loop(gaps, last, begin_us, part_us))
    assert np.array_equal(found.series, series)
    assert np.array_equal(found.bursts, bursts) and bursts[:, 64].sum() == 1
    assert np.array_equal(found.active, active)
    part = (t_us - t_us[0]) // part_us
    assert np.array_equal(found.pixels, np.histogram2d(part, pixel, (np.arange(21), np.arange(55)))[0])
    assert found.polarity.tolist() == [[np.sum(sign[part == k] == s) for s in (1, -1)] for k in range(20)]


@pytest.mark.parametrize(("gap_us", "lengths"), ((1000, {1: 2400, 2: 1}), (1001, {1: 2402})))
def test_a_burst_goes_on_over_the_end_of_a_part_by_the_longest_gap(gap_us, lengths):
    """Its second event is at the first instant of a part. In other pixels all events are 50 ms apart."""
    number, pixel = np.divmod(np.arange(2400), 60)
    t_us = 50_000 * number + 700 * pixel
    edge_us = -(-(int(t_us[-1]) + 1) // 20) * 7
    t_us, pixel = np.append(t_us, [edge_us - gap_us, edge_us]), np.append(pixel, [61, 61])
    found = event_statistics(EventStream.of(made(t_us, pixel, np.ones(t_us.size, int)), SHAPE)).bursts
    assert {length: int(count) for length, count in enumerate(found.sum(axis=0)) if count} == lengths
    assert np.flatnonzero(found[:, 2]).tolist() == [7] * (gap_us == 1000)


def test_intervals_are_those_of_the_law_however_short_the_recording():
    """Pixels of unlike rates r: a share Σ r exp(-r t) / Σ r of intervals is longer than t, up to half of the time.

    In each part as many end as should, of those that reach their age. Cumulated as they end, they are further off.
    """
    rates_hz = RATE_HZ * rates_of(0, 1.5)
    bounds_us = 10 ** np.linspace(0.0, 8.0, 161)
    longer = np.array([np.sum(rates_hz * np.exp(-rates_hz * t * 1e-6)) for t in bounds_us]) / rates_hz.sum()
    seen = bounds_us[1:] <= SECONDS / 2 * 1e6
    several = [poisson(seed, spread=1.5) for seed in range(300, 312)]
    found = np.mean([event_distance._intervals(one, np.arange(20)) for one in several], axis=0)
    assert found.size == seen.sum() and np.abs(found - 1 + longer[1:][seen]).max() < 0.003
    ended, at_risk = (sum(getattr(one, name) for one in several)[:, :-1][:, seen] for name in ("intervals", "at_risk"))
    expected = (at_risk * (1 - longer[1:] / longer[:-1])[seen]).sum(axis=1)
    assert np.abs((ended.sum(axis=1) - expected) / np.sqrt(expected)).max() < 4
    plain = np.cumsum(ended.sum(axis=0)) / ended.sum()
    assert np.abs(plain - 1 + longer[1:][seen]).max() > 0.01


def test_more_that_end_than_could_are_all_of_them():
    """A draw of parts may have ends of intervals without their time before."""
    ended, at_risk = np.zeros((1, 161)), np.zeros((1, 161))
    ended[0, [3, 7, 9]], at_risk[0, [3, 7, 9]] = (1, 3, 1), (4.0, 2.5, 2.0)
    found = event_distance._intervals(SimpleNamespace(intervals=ended, at_risk=at_risk, seconds=1.0), np.array([0]))
    assert found[[2, 3, 6, 7, 9, -1]].tolist() == [0, 0.25, 0.25, 1, 1, 1]


def test_intervals_longer_than_the_last_bin_were_at_risk_in_all():
    """Each of 1147 pixels has two events, 20 to 28 minutes apart, in parts of 2 minutes."""
    rng = np.random.default_rng(4)
    first_us = rng.integers(0, 100_000_000, PIXELS)
    t_us = np.append(first_us, first_us + rng.integers(1_200_000_000, 1_680_000_000, PIXELS))
    events = made(t_us, np.tile(np.arange(PIXELS), 2), np.ones(2 * PIXELS, int))
    found = event_statistics(replace(EventStream.of(events, SHAPE), interval_us=(0, 2_400_000_000)))
    assert found.intervals.sum(axis=0)[-1] == PIXELS == found.intervals.sum()
    # in all parts together those that went on at the end as well, of which half count in their bin
    total = found.at_risk.sum(axis=0)
    assert np.all(total[:-1] == 2 * PIXELS) and total[-1] == 1.5 * PIXELS


def test_intervals_of_two_streams_are_compared_up_to_half_of_the_shorter_one():
    """Of 2.6 s and of their first half: equal where both have ages."""
    rng = np.random.default_rng(9)
    t_us, pixel = np.sort(rng.integers(0, 2_600_000, 50_000)), rng.integers(0, PIXELS, 50_000)
    events = made(t_us, pixel, np.ones(50_000, int))
    long, short = (event_statistics(EventStream.of(events[:n], SHAPE)) for n in (50_000, 25_000))
    assert event_distance._difference_of_both(np.array([0.0, 0.5]), np.array([0.0, 1.0, 9.0])) == 0.5
    a, b = (event_distance._intervals(one, np.arange(20)) for one in (long, short))
    assert a.size - b.size == 6 and b.size == np.sum(10 ** np.linspace(0.0, 8.0, 161)[1:] <= 650_000)
    for pair in ((long, short), (short, long)):
        found = event_distances(*pair)[1]
        assert found.name == "intervals" and found.value == np.abs(a[: b.size] - b).max() < 0.02


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


def test_bounds_are_those_of_these_draws(monkeypatch):
    """Distances of 200 draws 10 + k between the streams, k within the first; 300 is that of the whole."""
    order = np.random.default_rng(6).permutation(200)
    between, within = iter(10.0 + order), iter(1.0 * order[::-1])

    def figure(statistics, draw):
        return [(statistics.source, np.array_equal(draw, np.arange(20)))]

    def distance(one, other):
        if one[0][1]:
            return 300.0
        return next(within if one[0] == other[0] else between)

    monkeypatch.setattr(event_distance, "_FIGURES", [("a", "b", figure, distance, False, None)])
    streams = [SimpleNamespace(shape=SHAPE, source=name) for name in ("one", "other")]
    (found,) = event_distances(*streams)
    # the p-th percentile of 0 to 199 is 1.99 p; Student's factor is 2.093 in place of 1.96
    wider = 2.0930 / 1.9600 * np.sqrt(20 / 19)
    half = wider * 1.99 * (97.5 - 50)
    assert found.interval_95 == pytest.approx((300 - half, 300 + half), rel=1e-4)
    # a single number: Student's factor, and the mean square of 0 to 199
    square = 199 * 399 / 6
    assert found.within == pytest.approx(2.0930 * np.sqrt(square * 20 / 19), rel=1e-4) and found.value == 300


@pytest.mark.parametrize("length", (1, 2))
def test_the_lower_end_has_the_noise_taken_off_and_is_0_where_streams_do_not_differ(monkeypatch, length):
    """Draws 200 + k between the streams, about a whole of 250: their median is 50 above it.

    Draws of a single number have it there only since they fold back at 0, and reach as far below it as above.
    """
    top = 1.0955 * (200 + 1.99 * 97.5 - 250)
    # limits of 115 for one number, and of 118 for two, are 247 and 218; for one number that of 118 is 253
    for within, low in (({1: 115.0, 2: 118.0}[length], 250 - top), (140.0, 0.0)):
        between = iter(200.0 + np.arange(200))

        def distance(one, other, own=within, draws=between):
            return 250.0 if one[0][1] else own if one[0] == other[0] else next(draws)

        figure = ("a", "b", lambda s, draw: [(s.source, np.array_equal(draw, np.arange(20)))] * length,
                  distance, False, None)  # fmt: skip
        monkeypatch.setattr(event_distance, "_FIGURES", [figure])
        (found,) = event_distances(*(SimpleNamespace(shape=SHAPE, source=name) for name in ("one", "other")))
        half = top if length == 1 else 1.0955 * 1.99 * 47.5
        assert found.interval_95 == pytest.approx((low, 250 + half), rel=1e-3)


def test_the_limit_of_draws_is_that_of_a_chi_square():
    """Mean squares of 3 normal numbers: 20 parts show 3 of what 3.75 numbers are; no more than the figure has."""
    squares = chi2.ppf((np.arange(100_000) + 0.5) / 100_000, 3) / 3 * 0.7**2
    for length, count in ((100, 3.75), (2, 2.0), (1, 1.0)):
        expected = 0.7 * np.sqrt(20 / 19 * f.ppf(0.95, count, 19 * count))
        assert event_distance._limit(squares, length) == pytest.approx(expected, rel=2e-3)
    assert event_distance._limit(np.zeros(200), 5) == 0
    # without scatter as of most numbers that 20 parts tell apart
    assert event_distance._limit(np.ones(200), 100) == pytest.approx(np.sqrt(20 / 19 * f.ppf(0.95, 20, 380)))


@pytest.mark.parametrize("length", (1, 4, 7))
def test_the_limit_of_draws_is_exceeded_in_5_of_100_cases(length):
    """Means of 20 parts of so many normal numbers, as distances from those of another stream.

    Of 6000 cases 300 exceed it, with a standard deviation of 17; three of these have a chance of 3e-3 in each test.
    """
    rng = np.random.default_rng(12)
    drawn = rng.multinomial(20, np.full(20, 0.05), 400) / 20
    parts = rng.standard_normal((6000, 20, length))
    values = drawn @ parts
    own = ((values[:, :200] - values[:, 200:]) ** 2).sum(axis=2)
    others = rng.standard_normal((6000, length)) / np.sqrt(20)
    pairs = np.sqrt(((parts.mean(axis=1) - others) ** 2).sum(axis=1))
    beyond = sum(pair > event_distance._limit(squares, length) for pair, squares in zip(pairs, own, strict=True))
    assert abs(beyond - 300) < 3 * 17


def test_margins_of_shares_are_those_of_the_paper():
    """Four of the differences and intervals of Newcombe's second table, by his tenth method."""
    for one, one_of, other, other_of, low, high in (
        (56, 70, 48, 80, 0.0524, 0.3339), (9, 10, 3, 10, 0.1705, 0.8090), (5, 56, 0, 29, -0.0381, 0.1926),
        (10, 10, 0, 20, 0.6791, 1.0),
    ):  # fmt: skip
        for shares in (
            (one / one_of, other / other_of, one_of, other_of),
            (other / other_of, one / one_of, other_of, one_of),
        ):
            below, above = event_distance._margins(*shares)
            value = one / one_of - other / other_of
            assert (value - below, value + above) == pytest.approx((low, high), abs=6e-5)


def test_hot_pixels_have_the_interval_of_pixels_drawn_at_random():
    """12 and 3 of 40 pixels; none of 10 and of 20 (his table: 0.2775 and 0.1611, of which either may be the larger)."""

    def found(*counts):
        streams = [
            SimpleNamespace(
                pixels=np.where(np.arange(of) < hot, 400, 1)[None].repeat(20, axis=0) * np.ones((20, 1), int)
            )
            for hot, of in counts
        ]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                event_distance, "_FIGURES", [one for one in event_distance._FIGURES if one[0] == "hot pixels"]
            )
            return event_distances(*streams)[0]

    # 4 of 40 are the most that the lower nine tenths do not hold
    few = found((4, 40), (1, 80))
    below, above = event_distance._margins(4 / 40, 1 / 80, 40, 80)
    assert few.value == pytest.approx(4 / 40 - 1 / 80) and few.within == below
    assert few.interval_95 == (few.value - below, few.value + above) and few.differs == (below < few.value)
    for pair in (((0, 10), (0, 20)), ((0, 20), (0, 10))):
        none = found(*pair)
        assert none.value == 0 and not none.differs and none.interval_95 == pytest.approx((0, 0.2775), abs=6e-5)


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


def unequal_parts(seed):
    """A process of 0.5 to 50 Hz a pixel, with hot pixels, bursts, dead times: a part, and one 3 to 10 times as long."""
    rng = np.random.default_rng(seed)
    rate_hz = np.exp(rng.uniform(np.log(0.5), np.log(50)) + 0.6 * rng.standard_normal(PIXELS))
    rate_hz[rng.integers(0, PIXELS, 6)] += 10 * rate_hz.mean()
    part_s, burst, dead_us = 9000 / rate_hz.sum(), rng.integers(1, 4), rng.choice([0, 300, 5000])
    # both parts begin within bursts and dead times
    begin_us, end_us = 20_000, 20_000 + part_s * (1 + rng.uniform(3, 10)) * 1e6
    pixel = np.repeat(np.arange(PIXELS), rng.poisson(end_us * 1e-6 * rate_hz / burst))
    t_us = np.floor(rng.uniform(0, end_us, pixel.size)[:, None] + 700 * np.arange(burst)).ravel().astype(int)
    pixel = np.repeat(pixel, burst)
    last_us, kept = np.full(PIXELS, -(10**9)), np.ones(t_us.size, np.bool_)
    for k in np.argsort(t_us, kind="stable"):
        kept[k] = t_us[k] - last_us[pixel[k]] > dead_us
        last_us[pixel[k]] = t_us[k] if kept[k] else last_us[pixel[k]]
    on = np.where(rng.random(pixel.size) < rng.uniform(0.4, 0.7, PIXELS)[pixel], 1, -1)
    middle_us = begin_us + part_s * 1e6
    own = [kept & (low <= t_us) & (t_us < high) for low, high in ((begin_us, middle_us), (middle_us, end_us))]
    return [EventStream.of(made(t_us[one], pixel[one], on[one]), SHAPE) for one in own]


@pytest.mark.slow
@pytest.mark.parametrize("order", (1, -1))
def test_parts_of_a_process_differ_in_five_of_a_hundred_figures(order):
    """Of 200 of each figure at most 18, of all 1400 at most 105, where 10 and 70 are expected.

    One of six figures is above 18 by chance in 3 of 100 such tests. Bursts that are cut between parts have 24 and 19.
    """
    counts = dict.fromkeys([figure[0] for figure in event_distance._FIGURES], 0)
    for seed in range(200):
        both = of_equal_time(*unequal_parts(seed)[::order])
        for one in event_distances(*map(event_statistics, both)):
            counts[one.name] += one.differs
    assert max(counts.values()) <= 18 and sum(counts.values()) <= 105, counts


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
    # one draw has it and the other one does not: 0.46 of pairs
    has = 1 - 0.95**20
    assert found.within == pytest.approx(2.093 * np.sqrt(20 / 19 * 2 * has * (1 - has)) / 3, rel=0.1)


def test_one_burst_in_thousands_is_no_difference():
    """None in the first stream of 54,000, one in the second, in 18,000: any draw of the first has none."""
    one, other = poisson(31), poisson(32)
    one.bursts[:], other.bursts[:] = 0, 0
    one.bursts[:, 1], other.bursts[:, 1], other.bursts[3, 2] = 2700, 900, 1
    found = {d.name: d for d in event_distances(one, other)}
    assert found["bursts"].value == pytest.approx(1 / 18_001) and not found["bursts"].differs
    assert found["bursts"].within == pytest.approx(3 / 18_001)
    assert found["bursts"].interval_95[1] >= 3.99 / 18_001
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


UNLIKE = {"spread": 1.5}


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "more", "width_px"), (
    ({}, {}, 4),
    ({"hot": 6}, {}, 8),
    ({"rhythm": 0.4, "burst": 3}, {}, 4),
    ({}, {"rate": 1.02, "on": 0.606, "rhythm": 0.1, "pairs": 0.01}, 4),
    ({"rhythm": 0.4, "burst": 2}, {"rate": 1.1, "on": 0.62, "rhythm": 0.5, "pairs": 0.1}, 4),
    (UNLIKE, {}, 30),
    (UNLIKE, {"rate": 1.05, "spread": 1.6}, 40),
), ids=("equal", "equal, hot", "equal, bursts", "nearly equal", "different", "equal, unlike", "unlike"))  # fmt: skip
def test_intervals_hold_the_true_distance_in_90_to_99_of_100_pairs(changes, more, width_px):
    """Of 400 pairs 360 to 396: where 380 are expected, anything else has a chance of 2e-5 for each of 42 counts.

    (Of 100 pairs, where 95 are expected, a count is beyond 90 to 99 with a chance of 0.017, and one of 42 in half of
    all such tests.)

    Both streams are of the same pixels, so that the share of hot ones varies little or not at all: all intervals hold
    it, and may be no wider than so many pixels.
    """
    true = truth_of(changes, more) if more else {}
    held = {figure[0]: [] for figure in event_distance._FIGURES}
    widths = []
    for seed in range(1000, 1800, 2):
        for one in event_distances(poisson(seed, **changes), poisson(seed + 1, **(changes | more))):
            low, high = one.interval_95
            held[one.name].append(low <= true.get(one.name, 0.0) <= high)
            if one.name == "hot pixels":
                widths.append(high - low)
    inside = {name: sum(each) for name, each in held.items()}
    assert inside.pop("hot pixels") == 400 and max(widths) <= width_px / PIXELS
    assert min(inside.values()) >= 360 and max(inside.values()) <= 396, inside


def share_of_hot(spread):
    """Mean share over 4000 sensors of pixels with more than ten times the mean count of the lower nine tenths."""
    rng = np.random.default_rng(77)
    rates = np.exp(spread * rng.standard_normal((4000, PIXELS)) - spread**2 / 2)
    counts = np.sort(rng.poisson(RATE_HZ * SECONDS * rates), axis=1)
    usual = counts[:, : round(0.9 * PIXELS)].mean(axis=1, keepdims=True)
    return np.mean(counts > 10 * usual)


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), ((1.5, 1.5), (1.0, 1.0), (1.5, 1.1)), ids=("equal", "few", "different"))
def test_intervals_hold_the_true_difference_of_hot_pixels_in_90_to_99_of_100_pairs_of_sensors(one, other):
    """Each stream is of another sensor, with pixels drawn anew, of which few or many are hot. Counts as above."""
    true, held = abs(share_of_hot(one) - share_of_hot(other)), []
    for seed in range(1000, 1800, 2):
        pair = (poisson(k, spread=s, sensor=10_000 + k) for k, s in ((seed, one), (seed + 1, other)))
        ((low, high),) = (d.interval_95 for d in event_distances(*pair) if d.name == "hot pixels")
        held.append(low <= true <= high)
    assert 360 <= sum(held) <= 396


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

"""Event frames, time surfaces, voxel grids and rates, against definitions written out event by event."""

import math

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import RangeError
from hesim_render.events import EVENT_DTYPE, event_frame, event_frames, event_rate, time_surface, voxel_grid

SHAPE = (5, 7)


def random_events(count=400, seed=1, last_us=100_000):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, last_us, count))
    events["y"], events["x"] = rng.integers(0, SHAPE[0], count), rng.integers(0, SHAPE[1], count)
    events["polarity"] = rng.choice(np.array([-1, 1], np.int8), count)
    return events


EVENTS = random_events()
NONE = EVENTS[:0]


@pytest.mark.parametrize("kind", ["sum", "counts", "last"])
def test_event_frames_one_event_at_a_time(kind):
    begin, end, period = 12_345, 87_654, 10_000
    number = math.ceil((end - begin) / period)
    expected = np.zeros((number, 2, *SHAPE) if kind == "counts" else (number, *SHAPE), int)
    for t, x, y, polarity in EVENTS.tolist():
        if begin <= t < end:
            k = (t - begin) // period
            if kind == "counts":
                expected[k, 0 if polarity > 0 else 1, y, x] += 1
            elif kind == "sum":
                expected[k, y, x] += polarity
            else:
                expected[k, y, x] = polarity
    found = event_frames(EVENTS, SHAPE, period, begin, end, kind)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, expected)
    if kind != "last":
        np.testing.assert_array_equal(event_frame(EVENTS, SHAPE, begin, end, kind), expected.sum(axis=0))


def test_a_frame_of_all_events_has_the_last_one_too():
    assert event_frame(EVENTS, SHAPE, kind="counts").sum() == EVENTS.size
    assert event_frames(EVENTS, SHAPE, 1000, kind="counts").sum() == EVENTS.size


@pytest.mark.parametrize("decay", ["exponential", "linear"])
def test_time_surfaces_one_event_at_a_time(decay):
    now, tau = 60_000, 20_000.0
    expected = np.zeros((2, *SHAPE))
    for t, x, y, polarity in EVENTS.tolist():
        if t <= now:
            age = (now - t) / tau
            expected[0 if polarity > 0 else 1, y, x] = math.exp(-age) if decay == "exponential" else max(1 - age, 0)
    np.testing.assert_allclose(time_surface(EVENTS, SHAPE, now, tau, decay), expected, rtol=1e-6)
    assert time_surface(EVENTS, SHAPE).max() == 1  # of the last event, at its own time


@pytest.mark.parametrize(("bins", "split"), [(1, False), (2, False), (5, False), (9, True)])
def test_voxel_grids_one_event_at_a_time(bins, split):
    first, last = EVENTS["t_us"][[0, -1]].tolist()
    expected = np.zeros((2, bins, *SHAPE))
    for t, x, y, polarity in EVENTS.tolist():
        scaled = (bins - 1) * (t - first) / (last - first)
        for b in range(bins):
            weight = max(0.0, 1 - abs(b - scaled))
            expected[0 if polarity > 0 else 1, b, y, x] += weight
    found = voxel_grid(EVENTS, SHAPE, bins, split=split)
    np.testing.assert_allclose(found, expected if split else expected[0] - expected[1], atol=1e-5)
    # nothing is lost between bins
    assert found.sum() == pytest.approx(EVENTS.size if split else EVENTS["polarity"].astype(int).sum(), abs=1e-3)


def test_a_normalised_voxel_grid_has_mean_0_and_deviation_1_where_it_is_filled():
    plain, found = voxel_grid(EVENTS, SHAPE), voxel_grid(EVENTS, SHAPE, normalise=True)
    values = found[plain != 0].astype(float)
    assert values.mean() == pytest.approx(0, abs=1e-5) and values.std() == pytest.approx(1, abs=1e-5)
    assert np.all(found[plain == 0] == 0)
    # equal values have no deviation: 0 each
    alike = voxel_grid(EVENTS[:1], SHAPE, bins=1, normalise=True)
    assert np.count_nonzero(voxel_grid(EVENTS[:1], SHAPE, bins=1)) == 1 and not alike.any()


def test_rates_times_intervals_are_the_events():
    begin, end, length = 1000, 90_500, 10_000
    rate = event_rate(EVENTS, length, begin, end)
    edges = [*range(begin, end, length), end]
    for sign, found in ((1, rate.on_per_s), (-1, rate.off_per_s)):
        counted = np.histogram(EVENTS["t_us"][(EVENTS["polarity"] == sign) & (EVENTS["t_us"] < end)], edges)[0]
        np.testing.assert_allclose(found * np.diff(edges) * 1e-6, counted)
    assert rate.t_us.tolist() == edges[:-1]


def test_intervals_are_as_many_as_fit_but_for_rounding():
    """24 of 97.1 µs are 2330.4 µs, whose quotient in double precision is above 24: a 25th one would have no length."""
    assert 2330.4 / 97.1 > 24
    for begin, end, number in ((0.0, 2330.4, 24), (0.0, 2330.5, 25), (7.3, 7.3 + 97.1 * 3, 3)):
        rate = event_rate(NONE, 97.1, begin, end)
        np.testing.assert_allclose(rate.t_us, begin + 97.1 * np.arange(number))
        assert not rate.on_per_s.any() and np.isfinite(rate.on_per_s).all()
        assert event_frames(NONE, SHAPE, 97.1, begin, end).shape == (number, *SHAPE)


def test_no_events_give_empty_arrays_of_the_right_shape():
    assert event_frame(NONE, SHAPE).shape == SHAPE and not event_frame(NONE, SHAPE).any()
    assert event_frames(NONE, SHAPE, 10, 0, 100, "counts").shape == (10, 2, *SHAPE)
    assert time_surface(NONE, SHAPE).shape == (2, *SHAPE) and not time_surface(NONE, SHAPE).any()
    assert voxel_grid(NONE, SHAPE, 3, normalise=True).shape == (3, *SHAPE)
    assert event_rate(NONE, 10, 0, 100).on_per_s.tolist() == [0.0] * 10
    one = EVENTS[:1]
    assert voxel_grid(one, SHAPE, 4)[0].sum() == one["polarity"][0]


def test_events_of_a_recording_fit_its_grid():
    sensor = hr.load_sensor("gen2", {"evs.contrast_threshold_on": 0.02}).crop(64, 32)
    recording = hr.simulate(hr.load_scene("dark"), sensor, duration_s=0.02)
    assert recording.events.size > 20
    grid = hr.events.voxel_grid(recording.events, recording.event_shape, 5)
    assert grid.shape == (5, 8, 16) and grid.sum() == pytest.approx(
        recording.events["polarity"].astype(int).sum(), abs=0.01
    )


@pytest.mark.parametrize(
    ("act", "text"),
    [
        (lambda: event_frame(EVENTS, (5, 6)), "at least 5 rows and 7 columns"),
        (lambda: event_frame(EVENTS, (0, 6)), "shape"),
        (lambda: event_frame(EVENTS, SHAPE, 10, 10), "a time after the begin"),
        (lambda: event_frame(EVENTS, SHAPE, kind="mean"), "sum, counts or last"),
        (lambda: event_frames(EVENTS, SHAPE, 0), "a length above 0"),
        (lambda: event_frames(EVENTS, SHAPE, 1e-6), "at most"),
        (lambda: event_frame(EVENTS[::-1], SHAPE, kind="last"), "order of time"),
        (lambda: time_surface(EVENTS[::-1], SHAPE), "order of time"),
        (lambda: time_surface(EVENTS, SHAPE, tau_us=0), "above 0"),
        (lambda: time_surface(EVENTS, SHAPE, decay="step"), "exponential or linear"),
        (lambda: voxel_grid(EVENTS, SHAPE, 0), "bins"),
        (lambda: voxel_grid(EVENTS, SHAPE, 5, 100, 50), "from the begin on"),
        (lambda: voxel_grid(EVENTS["t_us"], SHAPE), "t_us, x, y, polarity"),
        (lambda: event_rate(EVENTS, -1), "above 0"),
        (lambda: event_rate(EVENTS, 1, 0, 10_000_001), "at most 10000000 intervals"),
    ],
)
def test_mistakes_are_named(act, text):
    with pytest.raises(RangeError, match=text):
        act()


@pytest.mark.parametrize(("name", "kind", "value"), [("x", "i4", -1), ("y", "i2", -7), ("x", "f8", 1.5)])
def test_places_of_other_types_are_on_the_grid_or_refused(name, kind, value):
    """A place of −1 would be that of the last pixel; the types of other programs' arrays are taken."""
    types = {"t_us": "i8", "x": "u4", "y": "i4", "polarity": "i1", name: kind}
    events = np.array([(5, 1, 2, 1), (6, 3, 0, -1)], list(types.items()))
    if kind[0] == "i":
        assert event_frame(events, (3, 4)).tolist() == [[0, 0, 0, -1], [0, 0, 0, 0], [0, 1, 0, 0]]
    events[name][1] = value
    for make in (lambda: event_frame(events, (3, 4), kind="last"), lambda: time_surface(events, (3, 4)),
                 lambda: voxel_grid(events, (3, 4))):  # fmt: skip
        with pytest.raises(RangeError, match=rf"^events\['{name}'\] is .*expected whole numbers, 0 or more"):
            make()


def test_rates_of_many_intervals_are_those_of_a_histogram():
    """173 intervals of 37 µs from 411 µs on, the last one cut short; an event on a bound belongs to what follows."""
    rng, begin, end = np.random.default_rng(6), 411, 411 + 172 * 37 + 20
    events = np.zeros(5000, EVENT_DTYPE)
    events["t_us"] = np.sort(rng.integers(0, end + 500, events.size))
    events["polarity"] = rng.choice([-1, 1], events.size, p=[0.3, 0.7])
    rate = event_rate(events, 37, begin_us=begin, end_us=end)
    edges = np.append(begin + 37 * np.arange(173), end)
    for sign, found in ((1, rate.on_per_s), (-1, rate.off_per_s)):
        own = events["t_us"][events["polarity"] == sign]
        counts = np.array(
            [np.count_nonzero((own >= a) & (own < b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]
        )
        np.testing.assert_allclose(found, counts / np.diff(edges) * 1e6, rtol=1e-9)

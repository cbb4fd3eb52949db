"""Distances of two streams of events: equal laws are not far apart, each change shows in its own figure."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.core.errors import SpecError
from hesim_render.exchange import EventStream
from hesim_render.measure import event_distance
from hesim_render.measure.event_distance import event_distances, event_statistics
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
    count = round(rate * RATE_HZ * PIXELS * SECONDS / burst)
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
        extra = round(40 * RATE_HZ * SECONDS)
        t_us = np.append(t_us, rng.uniform(0, SECONDS * 1e6, hot * extra))
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


def test_intervals_are_those_of_a_loop():
    """Also across the parts, and the lengths of bursts within them."""
    rng = np.random.default_rng(5)
    t_us = np.sort(rng.integers(1, 400_000, 6000))
    pixel = rng.integers(0, 40, 6000)
    found = event_statistics(EventStream.of(made(t_us, pixel, np.ones(6000, int)), SHAPE))
    gaps = np.concatenate([np.diff(t_us[pixel == own]) for own in range(40)])
    bounds = 10 ** np.linspace(0.0, 8.0, 161)
    assert np.array_equal(found.intervals.sum(axis=0), np.histogram(np.maximum(gaps, 1), bounds)[0])
    assert found.polarity.sum() == found.pixels.sum() == (found.bursts * np.arange(65)).sum() == 6000


def test_bad_input_is_one_clear_error():
    rng = np.random.default_rng(1)
    few = made(np.arange(100) * 1000, rng.integers(0, PIXELS, 100), np.ones(100, int))
    with pytest.raises(SpecError, match="few: has 100 events; expected 2000"):
        event_statistics(EventStream.of(few, SHAPE, "few"))
    with pytest.raises(SpecError, match="short: lasts 99 µs; expected 40000"):
        event_statistics(EventStream.of(made(np.arange(100), few["x"], few["polarity"]), SHAPE, "short"))
    one = poisson(1)
    other = EventStream.of(made(rng.integers(0, 10**6, 5000), rng.integers(0, 100, 5000), np.ones(5000, int)), (31, 40))
    with pytest.raises(SpecError, match="is of 40x31 px; expected 37x31"):
        event_distances(one, event_statistics(other))


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

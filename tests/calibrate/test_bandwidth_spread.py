"""Spread of the noise's bandwidth from a still scene, on pixels of NumPy alone (`tests/support/still_pixels.py`)."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.calibrate.recordings import noise_spread as of_noise
from hesim_render.calibrate.recordings.noise_spread import KEYS, noise_spread, surest
from hesim_render.calibrate.recordings.tally import GROUPS, tally
from hesim_render.exchange import EventStream
from tests.support.still_pixels import random_events, still_events

SHAPE = (24, 33)
PIXELS = SHAPE[0] * SHAPE[1]


def sensor(seed, shape=SHAPE, seconds=6.0, nodes=40):
    """A sensor of its own for each seed: truth, and events of still light. Coarse steps make fast pixels slower."""
    rng = np.random.default_rng(seed)
    pixels = shape[0] * shape[1]
    mismatch, ratio = rng.uniform(0.02, 0.12), rng.uniform(0.8, 1.35)
    on, off = (0.2 * part * (1 + mismatch * rng.standard_normal(pixels)) for part in (1, ratio))
    spread, rows, cols = rng.uniform(0.15, 0.5), rng.uniform(-0.3, 0.3), rng.uniform(-0.15, 0.15)
    y, x = np.divmod(np.arange(pixels), shape[1])
    cutoff_hz = rng.uniform(20, 60) * np.exp(spread * rng.standard_normal(pixels))
    cutoff_hz *= (1 + rows * (2 * (y % 2) - 1)) * (1 + cols * (2 * (x % 2) - 1))
    sigma = 0.2 * np.sqrt(ratio) / rng.uniform(1.3, 2.6)
    leak = np.full(pixels, 0.2 * rng.uniform(0, 0.3))
    events = still_events(
        rng, on, off, sigma, leak, cutoff_hz=cutoff_hz, seconds=seconds, shape=shape, nodes=nodes
    )  # fmt: skip
    return dict(zip(KEYS, (spread, rows, cols), strict=True)), tally(EventStream.of(events, shape))


def holds(entry, truth):
    low, high = entry.get("interval_95", (0.0, entry.get("upper_limit")))
    return low <= truth <= high


def test_intervals_hold_the_spread_of_a_sensor():
    """The seed is fixed; a hundred sensors follow."""
    truth, one = sensor(16, seconds=3.0, nodes=20)
    found = noise_spread(one)
    assert all(holds(found[key], truth[key]) for key in KEYS)
    assert all(found[key]["standard_error"] < 0.016 for key in KEYS)


@pytest.mark.slow
def test_intervals_hold_the_spread_of_a_hundred_sensors():
    hits = dict.fromkeys(KEYS, 0)
    for seed in range(500, 600):
        truth, one = sensor(seed)
        found = noise_spread(one)
        for key in KEYS:
            hits[key] += holds(found[key], truth[key])
    assert all(90 <= count <= 99 for count in hits.values()), hits


def made_tally(rates, seconds=1.0, gap_us=9000.0):
    """A tally of counts that are given exactly, [polarity, half, pixel], and of one time between polarities."""
    counts = np.array(rates)
    gaps = np.zeros((2, 20, 32 * 26), np.int64)
    gaps[:, :, int(32 * np.log2(gap_us))] = 50
    pixels = counts.shape[2]
    return SimpleNamespace(
        counts=counts, used=np.ones(pixels, bool), shape=SHAPE, pixels=pixels, gaps=gaps, seconds=seconds,
        group=np.random.default_rng(0).integers(0, 20, pixels),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("turn", "fall"),
    [(0.103, 5.59), (0.13, 4.8), (0.16, 4.2), (0.2, 3.57), (0.25, 2.98), (0.3, 2.6), (0.35, 2.37), (0.4, 2.22),
     (0.45, 2.08), (0.5, 1.91), (0.55, 1.78), (0.6, 1.66)],
)  # fmt: skip
def test_thresholds_have_no_part_in_it(turn, fall):
    """Rates of two thresholds without noise of counting: ln n₊ = ln f − (k+1)/2 δ₊ − (k−1)/2 δ₋."""
    rng, pixels = np.random.default_rng(8), 24 * 330
    f = 0.3 * rng.standard_normal(pixels)
    on, off = 0.09 * rng.standard_normal((2, pixels))
    up = 100 * np.exp(f - (fall + 1) / 2 * on - (fall - 1) / 2 * off)
    down = 100 * np.exp(f - (fall - 1) / 2 * on - (fall + 1) / 2 * off)
    one = made_tally([[up, up], [down, down]], seconds=2.0)
    one.shape = (24, 330)

    def set_gaps(product):
        one.gaps[:] = 0
        one.gaps[:, :, round(32 * np.log2(product / one.counts.mean(axis=2).sum() * 2.0e6))] = 50

    set_gaps(turn * np.exp(-0.9 * 0.09))
    found = noise_spread(one)
    assert found["bandwidth_rel"]["value"] == pytest.approx(f.std(), rel=0.02)
    assert abs(found["odd_rows_rel"]["value"]) < 3 * found["odd_rows_rel"]["standard_error"] < 0.05
    # alike pixels of other thresholds have no spread
    up, down = up / np.exp(f), down / np.exp(f)
    one.counts = np.array([[up, up], [down, down]])
    set_gaps(turn)
    alike = noise_spread(one)["bandwidth_rel"]
    # twice the law's error of 8 %: m k √(2 · 0.08)
    assert alike["value"] == 0 and "thresholds" in alike["note"]
    assert 0.035 * fall < alike["upper_limit"] < 0.036 * fall + 0.05


def test_patterns_are_those_of_rows_and_of_columns():
    y, x = np.divmod(np.arange(PIXELS), SHAPE[1])
    rate = 40 * (1 + 0.25 * (2 * (y % 2) - 1)) * (1 - 0.1 * (2 * (x % 2) - 1))
    found = noise_spread(made_tally([[rate, rate], [0.8 * rate, 0.8 * rate]]))
    assert found["odd_rows_rel"]["value"] == pytest.approx(0.25) and found["odd_cols_rel"]["value"] == pytest.approx(
        -0.1
    )
    assert found["bandwidth_rel"]["value"] == 0 and found["bandwidth_rel"]["upper_limit"] < 1e-3


@pytest.mark.parametrize(("first", "signs"), [((2, 4), (1, 1)), ((3, 4), (-1, 1)), ((6, 1), (1, -1))])
def test_rows_of_a_crop_are_odd_where_those_of_the_sensor_are(first, signs):
    y, x = np.divmod(np.arange(PIXELS), SHAPE[1])
    y, x = y + first[0], x + first[1]
    rate = 40 * (1 + 0.25 * (2 * (y % 2) - 1)) * (1 - 0.1 * (2 * (x % 2) - 1))
    one = made_tally([[rate, rate], [0.8 * rate, 0.8 * rate]])
    for origin, sign in ((first, (1, 1)), ((0, 0), signs)):
        found = noise_spread(one, origin)
        assert found["odd_rows_rel"]["value"] == pytest.approx(0.25 * sign[0])
        assert found["odd_cols_rel"]["value"] == pytest.approx(-0.1 * sign[1])


def test_what_is_not_identifiable_says_why():
    even = np.full(PIXELS, 40.0)
    weak = noise_spread(made_tally([[even, even], [even, even]], gap_us=200.0))
    assert "too weak" in weak["bandwidth_rel"]["reason"] and weak["odd_rows_rel"]["value"] == 0
    leaking = noise_spread(made_tally([[even, even], [0.45 * even, 0.45 * even]]))
    assert "2.2 ON events for an OFF event" in leaking["odd_cols_rel"]["reason"]
    few = noise_spread(made_tally([[even, even], [0.12 * even, 0.12 * even]]))
    assert "4.8 events of a polarity in half of the time; 5 are needed" in few["bandwidth_rel"]["reason"]
    for shape in ((3, 4), (1, 400)):
        small = made_tally(np.full((2, 2, shape[0] * shape[1]), 40.0))
        small.shape = shape
        assert "too few pixels" in noise_spread(small)["bandwidth_rel"]["reason"]
    assert "rate of every recording changes" in surest([])["odd_rows_rel"]["reason"]


def test_of_several_recordings_the_surest_counts():
    reason, wide = {"value": None, "reason": "a"}, {"value": 0.3, "interval_95": [0.1, 0.5]}
    narrow, limit = {"value": 0.2, "interval_95": [0.1, 0.3]}, {"value": 0.0, "upper_limit": 0.1}
    given = [dict.fromkeys(KEYS, one) for one in (reason, wide, narrow)]
    given[1]["odd_cols_rel"] = limit
    found = surest(given)
    assert found["bandwidth_rel"] is narrow and found["odd_cols_rel"] is limit
    assert surest([given[0], given[0]])["bandwidth_rel"] is reason
    narrow, low = ({key: {"interval_95": interval} for key in KEYS} for interval in ([0.5, 0.6], [0.1, 0.4]))
    assert surest([low, narrow]) == surest([narrow, low]) == narrow


def test_random_events_without_noise_of_a_level_have_no_spread_beyond_their_limit():
    rng = np.random.default_rng(3)
    found = noise_spread(
        tally(EventStream.of(random_events(rng, np.full(PIXELS, 40.0), 0, seconds=3.0, shape=SHAPE), SHAPE))
    )
    assert found["bandwidth_rel"]["value"] == 0 and found["bandwidth_rel"]["upper_limit"] < 0.1
    assert of_noise._TURN.size == of_noise._FALL.size


def test_sums_patterns_and_covariances_are_those_of_a_loop_over_pixels():
    """Of used pixels of 7 × 9, by even or odd row and column of the sensor: counts of both halves and their products.

    The crop begins at row 3 and column 4.
    """
    rng, shape = np.random.default_rng(6), (7, 9)
    counts, group = rng.integers(1, 30, (4, 63)).astype(float), rng.integers(0, GROUPS, 63)
    used = rng.random(63) < 0.9
    given = SimpleNamespace(pixels=63, shape=shape, group=group.astype(np.uint64), used=used)
    sums = of_noise._sums(given, counts, (3, 4))
    wanted = np.zeros((9, 4, GROUPS))
    for k in np.flatnonzero(used):
        on, late_on, off, late_off = counts[:, k]
        own = [1, on, late_on, off, late_off, on * late_on, off * late_off, on * late_off, late_on * off]
        wanted[:, 2 * ((k // 9 + 3) % 2) + k % 9 % 2, group[k]] += own
    np.testing.assert_allclose(sums, wanted)
    whole = wanted.sum(axis=2, keepdims=True)
    row, col = np.divmod(np.arange(63), 9)
    row, col = row + 3, col + 4
    total = counts.sum(axis=0)

    def of(is_odd_row, is_odd_col, values):
        return values[used & (row % 2 == is_odd_row) & (col % 2 == is_odd_col)].mean()

    for bit, place in ((2, lambda a, b: (a, b)), (1, lambda a, b: (b, a))):
        odd, even = (np.mean([of(*place(is_odd, k), total) for k in (0, 1)]) for is_odd in (1, 0))
        np.testing.assert_allclose(of_noise._pattern(whole, bit), (odd - even) / (odd + even))
    own, both = of_noise._covariances(whole)
    expected = np.zeros(2)
    for a in (0, 1):
        for b in (0, 1):
            share = np.sum(used & (row % 2 == a) & (col % 2 == b)) / used.sum()
            for k, (i, j) in enumerate(((0, 1), (2, 3), (0, 3), (1, 2))):
                log = np.log(of(a, b, counts[i] * counts[j]) / (of(a, b, counts[i]) * of(a, b, counts[j])))
                expected[k // 2] += 0.5 * share * log
    np.testing.assert_allclose([own[0], both[0]], expected)

"""Waveforms: means over intervals against sums written out again, following times against their promise."""

import numpy as np
import pytest

from hesim_render.specs.light import LightSpec
from hesim_render.spectral.waveform import FOLLOW_TOLERANCE, Mains, Pwm, TableWaveform

TABLE_US, POWER = (200.0, 900.0, 1000.0, 3000.0, 4200.0), (1.0, 4.0, 2.0, 2.0, 0.5)
WAVEFORMS = {
    "mains": Mains(50, 0.4, 30),
    "mains to zero": Mains(60, 1.0, -200),
    "pwm": Pwm(1000, 0.3, 0),
    "pwm shifted": Pwm(333.3, 0.05, 100),
    "table": TableWaveform(TABLE_US, POWER),
    "table repeated": TableWaveform(TABLE_US, POWER, repeat=True),
}


def power(name, t_us):
    """w(t) written out again, one value a time."""
    w, t = WAVEFORMS[name], np.asarray(t_us, dtype=np.float64)
    if isinstance(w, Mains):
        return 1 + w.depth * np.cos(4 * np.pi * w.frequency_hz * t * 1e-6 + np.radians(w.phase_deg))
    if isinstance(w, Pwm):
        return ((t * 1e-6 * w.frequency_hz + w.phase_deg / 360) % 1 < w.duty) / w.duty
    mean = np.trapezoid(POWER, TABLE_US) / 4000.0
    if w.repeat:
        t = 200 + (t - 200) % 4000
    return np.interp(t, TABLE_US, POWER) / mean


@pytest.mark.parametrize("name", list(WAVEFORMS))
def test_mean_over_intervals_equals_dense_quadrature(name):
    rng = np.random.default_rng(3)
    begin = rng.uniform(-3e4, 9e4, 40)
    length = 10 ** rng.uniform(0.5, 4.7, 40)
    steps = 400_000
    for a, b in zip(begin, begin + length, strict=True):
        middles = a + (np.arange(steps) + 0.5) * ((b - a) / steps)
        dense = power(name, middles).mean()
        # a midpoint sum misses at most half a step of each jump: the interval meets few
        jumps = WAVEFORMS[name].jumps_us(a, b).size
        assert abs(WAVEFORMS[name].mean(a, b) - dense) < 1e-7 + (jumps + 2) * 20 / steps


@pytest.mark.parametrize("name", list(WAVEFORMS))
def test_arrays_of_intervals_instants_and_long_times(name):
    w = WAVEFORMS[name]
    rows = np.arange(50)[:, None] * 14.3
    means = w.mean(rows, rows + np.array([[10.0, 1000.0]]))
    assert means.shape == (50, 2)
    np.testing.assert_allclose(means[7, 1], w.mean(7 * 14.3, 7 * 14.3 + 1000.0), rtol=1e-12)
    instants = np.array([-5000.0, 250.0, 777.0, 12345.0])
    np.testing.assert_allclose(w.mean(instants, instants), power(name, instants), atol=1e-9)
    # an hour later: 4e9 µs in double precision still tell 1e-6 µs
    late = 3.6e9 + 12_000.0  # periods of 20, 16.67, 1, 4 ms do not all divide it: compare with the formula
    if not name.startswith("pwm"):
        np.testing.assert_allclose(w.mean(late, late), power(name, late), atol=1e-6)
    # parts add up
    np.testing.assert_allclose(w.mean(0, 5000) * 5000, w.mean(0, 1234) * 1234 + w.mean(1234, 5000) * 3766, rtol=1e-12)


def test_pwm_mean_equals_the_overlap_with_its_pulses():
    w = Pwm(250.0, 0.2, 45.0)  # 4 ms; on from −0.5 ms to 0.3 ms, and so on
    rng = np.random.default_rng(5)
    begin = rng.uniform(0, 2e4, 200)
    end = begin + 10 ** rng.uniform(-3, 4, 200)
    starts = -500.0 + 4000.0 * np.arange(-1, 10)
    overlap = np.clip(np.minimum(end[:, None], starts + 800) - np.maximum(begin[:, None], starts), 0, None).sum(axis=1)
    np.testing.assert_allclose(w.mean(begin, end), 5 * overlap / (end - begin), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(w.jumps_us(0, 8000), [300, 3500, 4300, 7500], rtol=1e-12)


def test_time_means_are_one():
    for name, w in WAVEFORMS.items():
        if isinstance(w, TableWaveform):
            np.testing.assert_allclose(w.mean(200.0, 4200.0), 1, rtol=1e-12)
            continue
        period_us = 1e6 / w.frequency_hz
        np.testing.assert_allclose(w.mean(123.0, 123.0 + 3 * period_us), 1, rtol=1e-12, err_msg=name)
    assert Pwm(100, 1.0).is_constant and Mains(50, 0).is_constant and TableWaveform((0, 5, 9), (2, 2, 2)).is_constant
    assert np.all(TableWaveform((0, 5, 9), (2, 2, 2)).mean([0, 3], [1, 100]) == 1)
    assert not any(w.is_constant for w in WAVEFORMS.values())


@pytest.mark.parametrize("name", ["mains", "table", "table repeated", "pwm", "pwm shifted"])
def test_following_times_keep_the_logarithm_straight(name):
    w = WAVEFORMS[name]
    times = w.follow_us(0, 20_000)
    assert np.all(np.diff(times) > 0) and times.min() > 0 and times.max() < 20_000
    jumps = w.jumps_us(0, 20_000)
    assert np.isin(jumps, times).all() and (jumps.size > 0) == (name not in ("mains", "table"))
    nodes = np.concatenate([[0.0], times, [20_000.0]])
    # just inside each stretch, so that a jump at its ends does not count
    first, last = nodes[:-1] + 1e-6, nodes[1:] - 1e-6
    for share in (0.25, 0.5, 0.75):
        middle = power(name, first + share * (last - first))
        lit = middle > 0.02
        with np.errstate(divide="ignore"):
            straight = (1 - share) * np.log(power(name, first)) + share * np.log(power(name, last))
        assert np.abs(np.log(middle[lit]) - straight[lit]).max() < 1.05 * FOLLOW_TOLERANCE
        assert np.all(power(name, last)[~lit] <= 0.02)
    # a pure function of time, whatever interval is asked for
    inner = w.follow_us(3000, 9000)
    np.testing.assert_allclose(inner, times[(times > 3000) & (times < 9000)], rtol=1e-12)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"type": "mains", "frequency_hz": 50, "depth": 1.2}, "less than or equal to 1"),
        ({"type": "mains", "frequency_hz": 0, "depth": 0.2}, "greater than 0"),
        ({"type": "mains", "frequency_hz": 50}, "depth"),
        ({"type": "mains", "frequency_hz": 50, "depth": 0.2, "duty": 0.5}, "duty"),
        ({"type": "pwm", "frequency_hz": 1000, "duty": 0}, "greater than 0"),
        ({"type": "pwm", "frequency_hz": 1e6, "duty": 0.5}, "100000"),
        ({"type": "sine", "frequency_hz": 50}, "mains"),
        ({"type": "table", "t_us": [0, 10], "value": [1]}, "1 values for 2 times"),
        ({"type": "table", "t_us": [0, 10, 10], "value": [1, 2, 3]}, "10 µs follows 10 µs"),
        ({"type": "table", "t_us": [0, 10], "value": [0, 0]}, "always off"),
        ({"type": "table", "t_us": [0, 10], "value": [1, -1]}, "greater than or equal to 0"),
        ({"type": "table", "t_us": [0], "value": [1]}, "at least 2"),
        ({"type": "table", "t_us": [0, 10], "value": [1, float("nan")]}, "finite"),
    ],
)
def test_wrong_waveforms_are_refused(given, text):
    with pytest.raises(ValueError, match=text):
        LightSpec.model_validate({"type": "uniform", "illuminance_lux": 1, "waveform": given})


def test_what_is_constant_has_no_times_and_the_highest_power_is_that_of_the_peak():
    for constant in (Mains(50, 0), Pwm(300, 1.0), TableWaveform((0, 5, 9), (2, 2, 2))):
        assert constant.follow_us(0, 20_000).size == constant.jumps_us(0, 20_000).size == 0
        assert constant.highest == 1
    assert Mains(50, 0.3).highest == pytest.approx(1.3) and Pwm(300, 0.4).highest == pytest.approx(2.5)
    # a mean of (1·10 + 2·30)/40 over the table
    assert TableWaveform((5, 15, 45), (1, 1, 3)).highest == pytest.approx(3 / (70 / 40))


def test_jumps_of_a_pulsed_light_are_at_both_ends_of_its_pulses():
    """4 kHz, on for a tenth of 250 µs, 90° ahead: switched on at −62.5 µs and every 250 µs from there."""
    np.testing.assert_allclose(Pwm(4000, 0.1, 90.0).jumps_us(100, 700), [187.5, 212.5, 437.5, 462.5, 687.5])


@pytest.mark.parametrize(
    ("wave", "period_us", "steps"),
    [
        (Mains(50, 0.01, 10), 10_000, 32),
        (Mains(40, 0.999, 10), 12_500, 352),
        (TableWaveform((0.0, 700.0, 1000.0), (1e-5, 3.0, 3.0), repeat=True), 1000, 64 + 1),
    ],
)
def test_a_period_has_no_fewer_and_no_more_steps_than_pay(wave, period_us, steps):
    """Four periods from an instant without a node: mains at least 32, and no more for power below 2 % of the mean; at
    most 64 between two samples of a table.
    """
    times = wave.follow_us(3.3, 3.3 + 4 * period_us)
    assert times.size == 4 * steps and np.all(np.diff(times) > 0)

"""Bandwidth and thresholds from modulated light, on pixels that NumPy follows step by step."""

import numpy as np
import pytest
import yaml

from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.report import figures, modulated
from hesim_render.report.bench import EventBench
from hesim_render.report.modulated import bandwidth, count_thresholds
from hesim_render.report.steady import Background, doubling
from tests.support.slow_pixels import events_of

ROWS, COLS = 14, 23
PIXELS = ROWS * COLS
EVERY = np.ones(PIXELS, bool)


def written(folder, modulation, files, **content):
    folder.mkdir(parents=True)
    for name, events in files.items():
        np.savez(folder / name, t=events["t_us"], x=events["x"], y=events["y"], p=events["polarity"] > 0)
    whole = {"sensor": "x", "rows": ROWS, "cols": COLS, "modulation": modulation, **content}
    (folder / "bench.yaml").write_text(yaml.safe_dump(whole))
    return EventBench(folder)


CORNER_HZ, DEAD_US = 430.0, 2700


def band_bench(folder, in_bursts, seed):
    """Modulation up to two corners of pixels that are dead for more than a cycle at the corner.

    Before each burst the light jumps to its mean from far below: the pixels fire, and take the mean as their reference
    at the end of the dead time.
    """
    rng = np.random.default_rng(seed)
    own = np.array([[0.19], [0.23]]) * (1 + 0.07 * rng.standard_normal((2, PIXELS)))
    modulation, files = [], {}
    for k, hz in enumerate(CORNER_HZ * np.array([0.1, 0.6, 1.2, 2.0])):
        step_us = int(8e3 / hz)
        for j, swing in enumerate((0.27, 0.36, 0.46, 0.6, 0.78, 1.01, 1.31)):
            depth, length_us = float(np.tanh(swing / 2)), round(5e6 / hz)
            about = {"file": f"{k}-{j}.npz", "lux": 310.0, "hz": float(hz), "depth": depth}
            if in_bursts:
                begin_us = 3 * DEAD_US
                period_us = length_us + begin_us
                t_us = np.arange(0, 4 * period_us, step_us) + 0.5 * step_us
                place = t_us % period_us - begin_us
                burst = np.sin(np.pi * place / length_us) ** 2 * np.sin(2e-6 * np.pi * hz * place)
                log_light = np.where(place > 0, swing / 2 * burst, np.where(place < -1.5 * DEAD_US, -0.7, 0.0))
                about["bursts"] = {"begin_us": begin_us, "length_us": length_us, "period_us": period_us}
            else:
                t_us = np.arange(0, 14e6 / hz, step_us) + 0.5 * step_us
                log_light = np.log1p(depth * np.sin(2e-6 * np.pi * hz * t_us))
            files[about["file"]] = events_of(
                log_light, step_us, own, corner_hz=CORNER_HZ, dead_us=DEAD_US, noise=0.02, cols=COLS, rng=rng
            )
            modulation.append({**about, "interval_us": [0, log_light.size * step_us]})
    return written(folder, modulation, files)


@pytest.mark.slow
def test_bursts_show_the_bandwidth_of_pixels_with_a_long_dead_time(tmp_path):
    """The corner of the low-pass, although the dead time is longer than its period."""
    found = bandwidth(band_bench(tmp_path / "bursts", True, 11), EVERY)
    assert found.in_bursts and found.lux == 310.0 and found.hz.size == 4
    # the lowest frequency is a tenth of the corner, where the low-pass lets through 0.995
    corner_hz = CORNER_HZ * np.sqrt(2 * (1 + 0.1**2) - 1)
    assert abs(found.entry["value"] - corner_hz) < 3 * found.entry["standard_error"] + 0.02 * corner_hz
    assert found.entry["standard_error"] < 0.04 * corner_hz


@pytest.mark.slow
def test_continuous_modulation_does_not_and_says_so(tmp_path):
    found = figures.event_figures(band_bench(tmp_path / "always", False, 12))
    entry = next(one for one in found.entries if one.key == "bandwidth")
    assert entry.name == "ON" and not found.band.in_bursts
    assert entry.value["value"] is None or abs(entry.value["value"] - CORNER_HZ) > 0.15 * CORNER_HZ
    assert any(one.startswith("bandwidth: the dead time of 27") and "860 Hz" in one for one in found.findings)


def slow_bench(folder, own, rng, *, swings=(1.6, 3.2), hz=7.0, dead_us=0.0, **content):
    modulation, files = [], {}
    for k, swing in enumerate(swings):
        depth = float(np.tanh(swing / 2))
        t_us = np.arange(0, round(8e6 / hz), 50) + 25
        log_light = np.log1p(depth * np.sin(2e-6 * np.pi * hz * t_us))
        files[f"{k}.npz"] = events_of(
            log_light, 50, own, dead_us=dead_us, noise=0.03, background_hz=6.0, cols=COLS, rng=rng
        )
        modulation.append(
            {"file": f"{k}.npz", "lux": 55.0, "hz": hz, "depth": depth, "interval_us": [0, len(t_us) * 50]}
        )
    return written(folder, modulation, files, **content)


@pytest.mark.parametrize("dead_us", [pytest.param(0.0, marks=pytest.mark.slow), 200.0])
def test_thresholds_by_counts_need_no_reset(tmp_path, dead_us):
    """Both thresholds, in spite of a background of 6 Hz and of a dead time that swallows up to 8 % of the events."""
    rng = np.random.default_rng(21)
    own = np.array([[0.17], [0.21]]) * (1 + 0.09 * rng.standard_normal((2, PIXELS)))
    bench = slow_bench(tmp_path / "slow", own, rng, dead_us=dead_us)
    *entries, lux = count_thresholds(bench, EVERY, dead_us)
    assert lux == 55.0
    for entry, theta in zip(entries, 1 / np.mean(1 / own, axis=1), strict=True):
        assert abs(entry["value"] - theta) < 3.5 * entry["standard_error"] < 0.05 * theta
    if dead_us:  # without the dead time, the threshold would be too large
        wrong = count_thresholds(bench, EVERY, 0.0)[0]["value"]
        assert wrong > entries[0]["value"] + 3 * entries[0]["standard_error"]


def test_what_counts_do_not_tell(tmp_path):
    rng = np.random.default_rng(22)
    own = np.full((2, PIXELS), 0.2)
    near = slow_bench(tmp_path / "near", own, rng, swings=(1.6, 1.8), hz=40.0)
    assert "two swings that give 6 events a cycle" in count_thresholds(near, EVERY, 0.0)[0]["reason"]
    small = slow_bench(tmp_path / "small", own, rng, swings=(0.9, 2.5), hz=40.0)
    assert count_thresholds(small, EVERY, 0.0)[2] is None
    right = slow_bench(tmp_path / "right", own, rng, hz=40.0, swings=(1.6, 1.8, 3.2))  # the outer two are taken
    assert "swallows more than a tenth" in count_thresholds(right, EVERY, 9000.0)[1]["reason"]
    assert count_thresholds(right, EVERY, 0.0)[1]["value"] == pytest.approx(0.2, rel=0.05)


def test_one_cycle_after_the_first_two_is_enough(tmp_path):
    """Of 322 pixels 161 answer the third cycle of 10 ms, which is the last."""
    events = np.zeros(161, EVENT_DTYPE)
    events["t_us"], events["polarity"] = 25_000, 1
    events["x"], events["y"] = np.arange(161) % COLS, np.arange(161) // COLS
    about = {"file": "a.npz", "lux": 1.0, "hz": 100.0, "depth": 0.3, "interval_us": [0, 30_000]}
    bench = written(tmp_path / "a", [about], {"a.npz": events})
    assert modulated._answered(bench, bench.spec.modulation[0], EVERY)[0] == 0.5
    about["interval_us"] = [0, 29_000]
    bench = written(tmp_path / "b", [about], {"a.npz": events})
    assert np.isnan(modulated._answered(bench, bench.spec.modulation[0], EVERY)).all()


@pytest.mark.slow
def test_steps_without_a_reset_use_the_thresholds_by_counts(tmp_path):
    """Twice the threshold of the dynamic range is that of the counts, and the report says why."""
    rng = np.random.default_rng(23)
    own = np.array([[0.17], [0.21]]) * (1 + 0.09 * rng.standard_normal((2, PIXELS)))
    step = {"file": "s.npz", "lux": 55.0, "contrast": 0.4, "begin_us": 3000, "period_us": 40_000}
    bench = slow_bench(tmp_path / "slow", own, rng, steps=[step])
    t_us = np.arange(0, 163_000, 50) + 25
    jumps = np.where((t_us > 3000) & ((t_us - 3000) % 40_000 < 20_000), np.log1p(0.4), 0.0)
    events = events_of(jumps, 50, own, noise=0.03, cols=COLS, rng=rng)
    events["t_us"] += rng.integers(0, 7, events.size)
    events = events[np.argsort(events["t_us"], kind="stable")]
    np.savez(bench.folder / "s.npz", t=events["t_us"], x=events["x"], y=events["y"], p=events["polarity"] > 0)
    found = figures.event_figures(bench)
    counts = [one for one in found.entries if one.key == "threshold_by_counts"]
    assert [one.name for one in counts] == ["ON", "OFF"] and counts[0].lux == 55.0 and counts[0].pixels <= PIXELS
    light = [one for one in found.entries if one.key == "least_light"]
    assert [one.contrast for one in light] == pytest.approx([np.expm1(2 * one.value["value"]) for one in counts])
    assert "thresholds by counts do not have this error" in found.findings[-1]


def test_temperature_is_not_modelled_or_not_stated():
    rate = {"value": 2.0, "standard_error": 0.1, "interval_95": [1.8, 2.2], "unit": "Hz"}
    one = Background(7.0, None, 1.0, (rate, rate), 9, None)
    assert doubling([one], 0, True)["reason"] == "not modelled: simulated event pixels have no temperature"
    assert "no temperature is stated" in doubling([one], 0, False)["reason"]


@pytest.mark.parametrize(
    ("bursts", "told"),
    [
        ({"begin_us": 0, "length_us": 39_900, "period_us": 90_000}, "four cycles of hz or more"),
        ({"begin_us": 0, "length_us": 50_000, "period_us": 50_000}, "more than length_us"),
    ],
)
def test_bursts_that_cannot_be(tmp_path, bursts, told):
    with pytest.raises(SpecError, match=told):
        written(tmp_path / "b", [{"file": "a", "lux": 1.0, "hz": 100.0, "depth": 0.3, "bursts": bursts}], {})

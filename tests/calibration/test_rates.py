"""Rates of a calibrated sensor are per second: they are those of the captures at whatever tick it is simulated."""

from pathlib import Path

import capture_sets
import numpy as np
import pytest

import hesim_render as hr
from hesim_render.calibrate import calibrate_evs, read_calibration, read_maps
from hesim_render.calibration.measured import measured_maps
from hesim_render.calibration.rates import EventDefectsPerTrial, TelegraphPerFrame, change_hz, needs_interval, rate_hz
from hesim_render.calibration.spec import Defect
from hesim_render.core.backend import jit
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.evs.events import Origin
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.recording.capture_set import read_captures

ROWS, COLS, TICK_US, LEAK = 24, 40, 1700, 3e-4
HOT, FLICKERING = (3, 5), (20, 7)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A calibration of captures every 1700 µs, with leak, a hot pixel and a flickering one, none of them by our code.

    The sensor file beside it compares every 1000 µs.
    """
    folder = tmp_path_factory.mktemp("rates")
    keys = {"tile_rows": 1, "tile_cols": 1, "signal_reference": "{k: 0.2, t_ref_us: 10000}"}
    capture_sets.write_events(folder / "set", size=(ROWS, COLS), trials=64_000, a=200.0, c=0.1, leak=LEAK, **keys)
    rng, trials, parts = np.random.default_rng(8), 64_000, 64
    with np.load(folder / "set" / "evs_static.npz") as static:
        counts = {name: static[name] for name in ("n_on", "dark_n_on", "n_off", "dark_n_off")}
    by_part = np.stack(
        [rng.multinomial(n, np.full(parts, 1 / parts)) for n in (counts["dark_n_on"] + counts["dark_n_off"]).ravel()], 1
    ).reshape(parts, ROWS, COLS)
    for name in ("n_on", "dark_n_on"):
        own = rng.binomial(trials // parts, 0.2, parts)
        counts[name][HOT] += own.sum()
        by_part[:, *HOT] += own if name == "dark_n_on" else 0
        high = np.repeat(rng.random(parts // 4) < 0.5, 4) if name == "dark_n_on" else rng.random(parts) < 0.5
        own = rng.binomial(trials // parts, 0.3 * high)
        counts[name][FLICKERING] += own.sum()
        by_part[:, *FLICKERING] += own if name == "dark_n_on" else 0
    capture_sets.change(folder / "set" / "evs_static.npz", **counts, dark_parts=by_part)
    calibrate_evs(folder / "set", folder / "untold.yaml")
    with (folder / "set" / "capture.yaml").open("a") as stream:
        stream.write(f"tick_us: {TICK_US}\n")
    calibrate_evs(folder / "set", folder / "c.yaml")
    text = (Path(hr.__file__).parents[1] / "sensors" / "reference-mono.yaml").read_text()
    text = text.replace("rows: 1024", f"rows: {ROWS}").replace("cols: 1024", f"cols: {COLS}")
    (folder / "s.yaml").write_text(text + "\nnoise: c.yaml\n")
    (folder / "untold-s.yaml").write_text(text + "\nnoise: untold.yaml\n")
    return folder


def test_a_calibration_holds_the_tick_and_rates_per_second(captured):
    section, maps = read_calibration(captured / "c.yaml")["evs"], read_maps(captured / "c.yaml", "evs")
    assert read_calibration(captured / "c.yaml")["capture"]["tick_us"] == section["tick_us"] == TICK_US
    leak, chance = section["leak_rate_hz"], section["leak_per_trial"]
    assert leak["value"] == pytest.approx(-np.log1p(-chance["value"]) / 1.7e-3, rel=1e-6)
    assert leak["standard_error"] == pytest.approx(chance["standard_error"] / (1 - chance["value"]) / 1.7e-3, rel=1e-6)
    assert abs(chance["value"] - LEAK) < 4.5 * chance["standard_error"]
    kinds = maps["defect"][HOT], maps["defect"][FLICKERING]
    assert kinds == (Defect.HOT, Defect.FLICKERING) and np.count_nonzero(maps["defect"]) == 2
    # 5 standard errors of 128,000 comparisons
    assert -np.expm1(-maps["defect_on_hz"][HOT] * 1.7e-3) == pytest.approx(0.2, abs=0.006)
    # the state lasts for about four parts of 1.7 s
    assert 0.02 < maps["defect_change_hz"][FLICKERING] < 0.6
    assert not {"defect_on_per_trial", "defect_correlation"} & set(maps)


def test_rates_do_not_depend_on_the_tick_of_the_simulation(captured):
    leak = read_calibration(captured / "c.yaml")["evs"]["leak_rate_hz"]["value"]
    hot = read_maps(captured / "c.yaml", "evs")["defect_on_hz"]
    for tick_us in (1000, 4000):
        sensor = hr.load_sensor(captured / "s.yaml", {"evs.tick_us": tick_us})
        assert sensor.spec.evs.leak_rate_hz == pytest.approx(leak, rel=1e-9)
        found = sensor.evs.defects
        assert sorted(found.place) == [HOT[0] * COLS + HOT[1], FLICKERING[0] * COLS + FLICKERING[1]]
        np.testing.assert_allclose(found.on_hz, hot.ravel()[found.place], rtol=1e-6)
        assert (found.change_hz > 0).tolist() == [False, True]


def test_events_of_leak_come_as_often_at_any_tick(captured):
    """1024 pixels for 8 s at two ticks: 1463 events expected, 5 standard deviations."""
    sensors = [hr.load_sensor(captured / "s.yaml", {"evs.tick_us": tick_us}) for tick_us in (4000, 16000)]
    expected = sensors[0].spec.evs.leak_rate_hz * ROWS * COLS * 8
    for sensor in sensors:
        counted = 0

        class Count:
            def take(self, stage, electrons, events, origin, kept):
                nonlocal counted
                counted += int(np.sum(origin == Origin.LEAK))

        stage = EvsStage(sensor.evs.without("shot", "dark_current"), 5, labels=Count())
        light = from_host(jit().Float, np.full(ROWS * COLS, 300.0, np.float32))
        for t_us in range(0, 8_000_001, sensor.spec.evs.tick_us):
            stage.step(light, t_us)
        assert counted == pytest.approx(expected, abs=5 * expected**0.5)


def test_captures_without_a_tick_count_as_made_at_that_of_the_sensor_file(captured):
    """Also of older calibrations: chances per comparison become rates at the tick of the file, 1 ms, not of `--set`."""
    section, maps = read_calibration(captured / "untold.yaml")["evs"], read_maps(captured / "untold.yaml", "evs")
    assert "tick_us" not in section and "leak_rate_hz" not in section and "defect_on_hz" not in maps
    chance, hot = section["leak_per_trial"]["value"], float(maps["defect_on_per_trial"][HOT])
    for tick_us in (1000, 4000):
        sensor = hr.load_sensor(captured / "untold-s.yaml", {"evs.tick_us": tick_us})
        assert sensor.spec.evs.leak_rate_hz == pytest.approx(-np.log1p(-chance) / 1e-3)
        assert sensor.evs.defects.on_hz[0] == pytest.approx(-np.log1p(-hot) / 1e-3, rel=1e-5)
        dump = sensor.spec.model_dump(mode="json", exclude_none=True)
        assert dump["noise"]["tick_us"] == 1000
        # a recording's sensor is read from such a dump
        dump["noise"]["folder"] = str(captured)
        again = type(sensor.spec).model_validate(dump)
        assert measured_maps(again.noise).intervals_s["evs"] == pytest.approx(1e-3)
    told = hr.load_sensor(captured / "untold-s.yaml", {"noise.tick_us": TICK_US})
    known = hr.load_sensor(captured / "s.yaml")
    assert known.layout.maps.intervals_s["evs"] == pytest.approx(1.7e-3)  # that of the captures, not of the file
    assert told.spec.evs.leak_rate_hz == pytest.approx(known.spec.evs.leak_rate_hz, rel=1e-6)
    np.testing.assert_allclose(told.evs.defects.on_hz, known.evs.defects.on_hz, rtol=1e-5)
    np.testing.assert_allclose(told.evs.defects.change_hz, known.evs.defects.change_hz, rtol=1e-3)


def test_without_any_tick_the_key_is_named(captured):
    spec = hr.load_sensor(captured / "untold-s.yaml").spec
    noise = spec.noise.model_copy(update={"tick_us": None})
    with pytest.raises(SpecError, match=r"untold\.yaml: evs\.tick_us: is not stated"):
        measured_maps(noise)


def test_a_tick_comes_from_the_named_sensor_or_from_the_captures(tmp_path):
    capture_sets.write_description(tmp_path / "a", tile_rows=4, tile_cols=4, sensor="eiger")
    captures = read_captures(tmp_path / "a")
    assert captures.interval_s == pytest.approx(1239e-6) and captures.frame_rate_hz == captures.sensor.aps.frame_rate_hz
    capture_sets.write_description(
        tmp_path / "b", tile_rows=4, tile_cols=4, sensor="eiger", tick_us=700.5, frame_rate_hz=12.5
    )
    captures = read_captures(tmp_path / "b")
    assert captures.interval_s == pytest.approx(700.5e-6) and captures.frame_rate_hz == 12.5
    capture_sets.write_description(tmp_path / "c")
    captures = read_captures(tmp_path / "c")
    assert captures.interval_s is None and captures.frame_rate_hz is None


def test_rates_from_chances_and_correlations():
    assert rate_hz(0.3, 0.02) == pytest.approx(-np.log(0.7) / 0.02) and np.isfinite(rate_hz(1.0, 0.02))
    assert change_hz(0.3, 0.02) == pytest.approx(-np.log(0.3) / 0.02)
    assert change_hz(0.0, 0.5) == pytest.approx(-np.log(1e-9) / 0.5) and 0 < change_hz(1.0, 0.5) < 1e-8
    single = [np.array(values, np.float32) for values in ([0.3, 0.2, 0], [0.1, 0, 0], [0.4, 1, 1], [0.8, 0.9, 0])]
    counted = EventDefectsPerTrial(np.array([3, 2, 0], np.uint8), *single)
    assert EventDefectsPerTrial.of(counted.maps()).maps().keys() == {
        "defect", "defect_on_per_trial", "defect_off_per_trial", "defect_firing_share", "defect_correlation"
    }  # fmt: skip
    found = counted.per_second(0.004).maps()
    assert found["defect"].dtype == np.uint8 and found["defect_on_hz"].dtype == np.float32
    np.testing.assert_allclose(found["defect_on_hz"], -np.log1p([-0.3, -0.2, 0]) / 0.004, rtol=1e-6)
    np.testing.assert_allclose(found["defect_off_hz"], -np.log1p([-0.1, 0, 0]) / 0.004, rtol=1e-6)
    np.testing.assert_allclose(found["defect_firing_share"], [0.4, 1, 1], rtol=1e-6)
    np.testing.assert_allclose(found["defect_change_hz"], [-np.log(0.8) / 0.004, 0, 0], rtol=1e-6)
    frames = [np.array(values, np.float32) for values in ([7.5, 0], [0.3, 0.2], [0.6, 0.9])]
    counted_maps = TelegraphPerFrame(*frames).maps()
    rates = TelegraphPerFrame(*frames).per_second(0.04).maps()
    still = counted_maps | {"telegraph_amplitude_dn": np.zeros(2, np.float32)}
    for maps, needed in ((counted_maps, True), (still, False), (rates | counted_maps, False), ({}, False)):
        assert needs_interval("aps", maps) == needed
    for amplitude, jumps in (([0.4, 0], True), ([0, 0], False)):
        assert TelegraphPerFrame(np.float32(amplitude), *frames[1:]).misbehaves == jumps
    found = TelegraphPerFrame(*frames).per_second(0.04).maps()
    assert list(found) == ["telegraph_amplitude_dn", "telegraph_high_share", "telegraph_change_hz"]
    np.testing.assert_allclose(found["telegraph_change_hz"], [-np.log(0.6) / 0.04, 0], rtol=1e-6)
    np.testing.assert_array_equal([found[name] for name in list(found)[:2]], frames[:2])

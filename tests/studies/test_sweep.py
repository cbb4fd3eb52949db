"""Sweeps: their table against single simulations and closed forms; resumed runs; errors."""

import json
import math

import numpy as np
import pytest

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.specs.files import data_folder, list_names
from hesim_render.specs.sweep import RangeSpec, read_sweep
from hesim_render.studies import sweep as sweeps
from hesim_render.studies.sweep import sweep

BASE = {
    "schema_version": 1, "name": "test", "scenes": ["flat-field"], "sensors": ["reference-mono"], "roi": "32x24",
    "duration_s": 0.09, "options": {"samples": 4},
    "vary": {"light.illuminance_lux": [10, 200], "sensor.aps.exposure_us": [2000, 10000]}, "seeds": [1, 2],
    "metrics": ["frames", "electrons", "raw_mean", "raw_variance", "snr", "events", "event_rate"],
}  # fmt: skip


def test_a_sweep_has_the_figures_of_single_runs(tmp_path):
    table = sweep(BASE, out=tmp_path / "out")
    assert len(table) == 8 and table["light.illuminance_lux"].tolist() == [10] * 4 + [200] * 4
    row = table.where(**{"light.illuminance_lux": 200, "sensor.aps.exposure_us": 2000, "seed": 2}).row(0)
    sensor = hr.load_sensor("reference-mono", {"aps.exposure_us": 2000}).crop(32, 24)
    scene = hr.load_scene("flat-field", {"light.illuminance_lux": 200})
    alone = hr.simulate(scene, sensor, duration_s=0.09, seed=2, samples=4)
    assert row["electrons_mean"] == pytest.approx(alone.frames[0].electrons_mean.mean(), rel=1e-6)
    assert row["raw_mean_dn"] == pytest.approx(alone.frames[0].raw.mean(), rel=1e-9)
    assert row["frames"] == len(alone.frames) and row["events"] == len(alone.events)
    assert row["event_rate_hz_per_px"] == pytest.approx(len(alone.events) / (32 * 24 * 0.09), rel=1e-9)
    # SNR of the noise model; 768 pixels: the variance of a difference is known to 5 %, so SNR to 2.6 %: 4 errors
    electrons = row["electrons_mean"]
    signal = electrons * sensor.spec.aps.system_gain_dn_per_e
    sigma = math.sqrt(float(sensor.aps.variance_dn2(electrons, 2000, adc=True)))
    assert row["snr"] == pytest.approx(signal / sigma, rel=0.11)
    electrons = table["electrons_mean"].reshape(2, 2, 2)
    np.testing.assert_allclose(electrons[1] / electrons[0], 20, rtol=1e-3)
    np.testing.assert_allclose(electrons[:, 1] / electrons[:, 0], 5, rtol=1e-3)


def test_a_sweep_that_was_ended_goes_on(tmp_path, monkeypatch):
    lux = {"light.illuminance_lux": [10, 200]}
    small = {**BASE, "metrics": ["electrons"], "duration_s": 0.04, "roi": "16x8", "vary": lux}
    plain, done = sweeps.simulate, []

    def ends(*args, **options):
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(options["seed"])
        return plain(*args, **options)

    monkeypatch.setattr(sweeps, "simulate", ends)
    with pytest.raises(KeyboardInterrupt):
        sweep(small, out=tmp_path / "out")
    assert not (tmp_path / "out" / "results.csv").exists()
    again = []
    monkeypatch.setattr(sweeps, "simulate", lambda *args, **options: again.append(1) or plain(*args, **options))
    table = sweep(small, out=tmp_path / "out")
    assert len(again) == 3 and len(table) == 4
    # once more, with one value and one seed more: only these are new
    again.clear()
    more = {**small, "seeds": [1, 2, 3]}
    assert len(sweep(more, out=tmp_path / "out")) == 6 and len(again) == 2
    # the file of a sensor changed: none of its runs is still right
    sensor = tmp_path / "mine.yaml"
    text = (data_folder("sensors") / "reference-mono.yaml").read_text()
    sensor.write_text(text)
    one = {**small, "sensors": [str(sensor)], "vary": {}, "seeds": [1]}
    again.clear()
    for changed in (text, text, text.replace("pitch_um: 5.0", "pitch_um: 6.0")):
        sensor.write_text(changed)
        rows = sweep(one, out=tmp_path / "mine")
    assert text.count("pitch_um: 5.0") == 1 and len(again) == 2 and len(rows) == 1
    # nothing new: the same table; other metrics are other runs
    again.clear()
    assert sweep(small, out=tmp_path / "out").to_csv() == table.to_csv() and not again
    sweep({**small, "metrics": ["raw_mean"]}, out=tmp_path / "out")
    assert len(again) == 4


@pytest.mark.slow
def test_resolution_is_a_metric_where_there_is_an_edge(tmp_path):
    spec = {**BASE, "scenes": ["slanted-edge", "flat-field"], "roi": "64x48", "vary": {}, "seeds": [1],
            "metrics": ["mtf50"], "options": {"samples": 64}}  # fmt: skip
    found = sweep(spec, out=tmp_path / "out")
    assert found.row(0)["mtf50_cy_per_px"] == pytest.approx(0.6, abs=0.05)  # sinc f = 1/2 at 0.603
    assert found.row(1)["mtf50_cy_per_px"] is None


def test_ranges_and_files(tmp_path, capsys):
    assert RangeSpec(first=1, last=1000, count=4, scale="log").values() == [1, 10, 100, 1000]
    assert RangeSpec(first=0, last=1, count=5).values() == [0, 0.25, 0.5, 0.75, 1]
    for name in list_names("sweep_specs"):
        assert read_sweep(name).vary
    file = tmp_path / "sweep.yaml"
    file.write_text(json.dumps({**BASE, "vary": {}, "seeds": [5], "keep": True}))
    with pytest.raises(SystemExit) as stop:
        cli.main(["sweep", str(file), "--out", str(tmp_path / "out")])
    assert stop.value.code == 0 and "1 runs in" in capsys.readouterr().out
    (kept,) = (tmp_path / "out" / "recordings").iterdir()
    assert hr.Recording.load(kept).manifest["seed"] == 5


@pytest.mark.parametrize(("changes", "message"), [
    ({"vary": {"light.illuminance": [3]}}, r"run with scene=flat-field.*light.illuminance=3.*unknown key"),
    ({"vary": {"sensor.aps.exposure_us": []}}, "a list of values is empty"),
    ({"vary": {"a": {"first": 0, "last": 1, "count": 3, "scale": "log"}}}, "ends above 0"),
    ({"roi": "32"}, "WIDTHxHEIGHT"), ({"metrics": ["psnr"]}, "metrics"),
    ({"options": {"speed": 1}}, "expected quality"),
    ({"scenes": ["none"]}, "no scene named 'none'"), ({"seeds": list(range(100_001))}, "more than 100000"),
])  # fmt: skip
def test_bad_sweeps_are_one_clear_line(tmp_path, changes, message):
    with pytest.raises(SpecError, match=message) as caught:
        sweep({**BASE, **changes}, out=tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_other_folders_and_damaged_runs_are_refused(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(OutputError, match="holds other things"):
        sweep(BASE, out=tmp_path / "mine")
    small = {**BASE, "vary": {}, "seeds": [1], "metrics": ["frames"], "duration_s": 0.01}
    sweep(small, out=tmp_path / "out")
    (run,) = (tmp_path / "out" / "runs").iterdir()
    run.write_text("{")
    with pytest.raises(OutputError, match="is damaged"):
        sweep(small, out=tmp_path / "out")

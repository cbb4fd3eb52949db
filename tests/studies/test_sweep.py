"""Sweeps: their table against single simulations and closed forms; resumed runs; errors."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError
from skimage.metrics import peak_signal_noise_ratio

import hesim_render as hr
from hesim_render import cli
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.isp import Pipeline, process
from hesim_render.sources.render.audit.audit import Audit
from hesim_render.specs.files import data_folder, read_spec
from hesim_render.specs.run import StudyKind, study_kind
from hesim_render.specs.sweep import RangeSpec, SweepSpec
from hesim_render.studies import sweep as sweeps
from hesim_render.studies import sweep_metrics
from hesim_render.studies.sweep import check_sweep, sweep
from hesim_render.studies.sweep_metrics import RunFigures

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
    spec |= {"metrics": ["mtf10", "mtf_nyquist", "picture_mtf50"], "scenes": ["slanted-edge"]}
    spec["vary"] = {"light.illuminance_lux": [100, 3000]}
    row, saturated = sweep(spec, out=tmp_path / "more")
    assert saturated["picture_mtf50_cy_per_px"] is None
    assert row["mtf_nyquist"] == pytest.approx(np.sinc(0.5), abs=0.03)
    assert row["mtf10_cy_per_px"] == pytest.approx(0.908, abs=0.05)  # sinc f = 0.1
    assert row["picture_mtf50_cy_per_px"] == pytest.approx(0.6, abs=0.05)


def test_keys_of_the_isp_are_varied_on_one_recording(tmp_path, monkeypatch):
    """Pictures of the same frame: as `develop` makes them, against those of its noise-free electrons."""
    plain, done = sweeps.simulate, []
    monkeypatch.setattr(sweeps, "simulate", lambda *args, **options: done.append(1) or plain(*args, **options))
    file = tmp_path / "pipeline.yaml"
    file.write_text(
        "schema_version: 1\nsteps:\n- {step: black_level}\n- {step: white_balance}\n- {step: demosaic}\n"
        "- {step: colour_matrix}\n- {step: exposure, gain: 1.0}\n- {step: encode}\n"
    )
    spec = {**BASE, "scenes": ["colorchecker"], "sensors": ["reference-bayer"], "roi": "48x32", "duration_s": 0.03,
            "isp": str(file), "seeds": [3],
            "vary": {"isp.demosaic.method": ["guided", "linear"], "isp.exposure.gain": [1, 2],
                     "light.illuminance_lux": [50, 400], "isp.encode": [True, False]},
            "metrics": ["picture_mean", "picture_psnr", "picture_ssim", "picture_delta_e", "isp_report"]}  # fmt: skip
    table = sweep(spec, out=tmp_path / "out")
    assert len(table) == 16 and len(done) == 2
    row = table.where(**{"isp.demosaic.method": "linear", "isp.exposure.gain": 2, "isp.encode": False,
                         "light.illuminance_lux": 400}).row(0)  # fmt: skip
    scene = hr.load_scene("colorchecker", {"light.illuminance_lux": 400})
    rec = plain(scene, hr.load_sensor("reference-bayer").crop(48, 32), duration_s=0.03, seed=3, samples=4)
    steps = ["black_level", "white_balance", {"step": "demosaic", "method": "linear"}, "colour_matrix",
             {"step": "exposure", "gain": 2}]  # fmt: skip
    picture = process(rec.frames[0], rec.mosaic, Pipeline.of(*steps))
    clean = process((64 + 0.25 * rec.frames[0].electrons_mean).astype(np.float32), rec.mosaic, Pipeline.of(*steps))
    assert row["picture_mean"] == pytest.approx(float(picture.mean()), rel=1e-6)
    expected = peak_signal_noise_ratio(np.minimum(clean, 1), np.minimum(picture, 1), data_range=1)
    assert row["picture_psnr_db"] == pytest.approx(expected, rel=1e-6)
    assert 0 < row["picture_ssim"] < 1 and row["picture_delta_e"] > 0
    # the noise-free picture is never smoothed
    reduced = RunFigures(
        rec, Pipeline.of("black_level", "white_balance", "demosaic", "noise_reduction", "colour_matrix")
    )
    plain_steps = Pipeline.of("black_level", "white_balance", "demosaic", "colour_matrix")
    clean = (64 + 0.25 * rec.frames[0].electrons_mean).astype(np.float32)
    np.testing.assert_allclose(reduced.clean_picture, process(clean, rec.mosaic, plain_steps), atol=1e-6)
    assert not np.allclose(reduced.picture.image, process(rec.frames[0], rec.mosaic, plain_steps), atol=1e-4)
    # twice the gain doubles what is linear and not clipped, noise included: 6.02 dB
    once, twice = (
        table.where(**{"isp.exposure.gain": gain, "isp.encode": False, "light.illuminance_lux": 50}) for gain in (1, 2)
    )
    np.testing.assert_allclose(twice["picture_mean"], 2 * once["picture_mean"], rtol=1e-3)
    np.testing.assert_allclose(once["picture_psnr_db"] - twice["picture_psnr_db"], 6.02, atol=0.2)


def test_a_study_is_swept_over_its_keys_and_those_of_its_sensors(tmp_path, monkeypatch):
    file = tmp_path / "study.yaml"
    file.write_text(
        "schema_version: 1\nname: two\nsensors: [reference-bayer]\nfilter_sets: [rggb, ryyb]\nfigures: [noise]\n"
        "palette: mine.yaml\n"
    )
    palette = (data_folder("palettes") / "dyes.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(palette)
    spec = {"schema_version": 1, "name": "sweep", "study": str(file), "metrics": ["ysnr_noise_aware"],
            "vary": {"sensor.aps.read_noise_e": [1.0, 20.0], "illuminance_lux": [[5], [50]]}}  # fmt: skip
    table = sweep(spec, out=tmp_path / "out")
    assert len(table) == 8 and table["illuminance_lux"].tolist() == [5, 5, 50, 50] * 2
    alone = hr.study({"schema_version": 1, "name": "one", "sensors": ["reference-bayer"], "filter_sets": ["ryyb"],
                      "figures": ["noise"], "illuminance_lux": [5],
                      "sensor_keys": {"aps.read_noise_e": 20.0}})  # fmt: skip
    found = table.where(**{"sensor.aps.read_noise_e": 20.0, "illuminance_lux": 5, "filter_set": "ryyb"}).row(0)
    assert found["ysnr_noise_aware"] == pytest.approx(alone["ysnr_noise_aware"][0], rel=1e-12)
    assert "snr10_lux_noise_aware" not in found
    # again: nothing is computed; a changed palette is a changed run
    monkeypatch.setattr(sweeps, "study", None)
    assert sweep(spec, out=tmp_path / "out").to_csv() == table.to_csv()
    monkeypatch.undo()
    assert palette.count("depth_um: 3.0") == 1
    (tmp_path / "mine.yaml").write_text(palette.replace("depth_um: 3.0", "depth_um: 1.0"))
    assert np.all(sweep(spec, out=tmp_path / "out")["ysnr_noise_aware"] < table["ysnr_noise_aware"])
    # seeds are those of the noisy frames
    exact, simulated = "ysnr_noise_aware", "ysnr_noise_aware_simulated"
    noisy = {**spec, "metrics": [exact, simulated], "seeds": [1, 2], "vary": {"noise.repeats": [1]}}
    first, second = (sweep(noisy, out=tmp_path / "out").where(seed=seed) for seed in (1, 2))
    assert np.all(first[exact] == second[exact]) and np.all(first[simulated] != second[simulated])
    spec["vary"] = {"noise.repeats": [0]}
    assert len(sweep({**spec, "metrics": []}, out=tmp_path / "out")) == 2
    for changes, message in (
        ({"metrics": ["ysnr_noise_awar"]}, "no column 'ysnr_noise_awar'.*did you mean 'ysnr_noise_aware'"),
        ({"vary": {"isp.demosaic.method": ["linear"]}}, "for sweeps of recordings"),
        ({"vary": {"filter_set": ["rggb"]}}, "run with filter_set=rggb.*unknown key"),
        ({"scenes": ["flat-field"]}, "scenes: not in a sweep of a study"),
        ({"study": "five-cfa"}, "no study named 'five-cfa'.*did you mean"),
    ):
        with pytest.raises(SpecError, match=message) as caught:
            sweep({**spec, **changes}, out=tmp_path / "bad")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("call", [sweep, check_sweep])
@pytest.mark.parametrize(("key", "values", "message"), [
    ("sensor.aps.exposure_us", [2000, 464.2], r"exposure_us=464.2, .*valid integer"),
    ("light.illuminance_lux", {"first": 30, "last": -1, "count": 3}, r"illuminance_lux=-1.0, "),
    ("isp.demosaic.method", ["guided", "best"], r"isp.demosaic.method=best, "),
])  # fmt: skip
def test_every_value_is_checked_before_the_first_run(key, values, message, call, tmp_path, monkeypatch):
    monkeypatch.setattr(sweeps, "simulate", None)
    with pytest.raises(SpecError, match=f"^run with .*{message}"):
        call({**BASE, "vary": {"light.illuminant": ["D65", "A"], key: values}}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_ranges_and_files(tmp_path, capsys):
    assert RangeSpec(first=1, last=1000, count=4, scale="log").values() == [1, 10, 100, 1000]
    assert RangeSpec(first=0, last=1, count=5).values() == [0, 0.25, 0.5, 0.75, 1]
    whole = RangeSpec(first=2, last=300, count=7, scale="log", whole=True).values()
    assert whole == [2, 5, 11, 24, 56, 130, 300] and all(type(value) is int for value in whole)
    assert RangeSpec(first=1, last=3, count=9, whole=True).values() == [1, 2, 3]
    assert (
        study_kind("light-and-exposure") is StudyKind.sweep
        and read_spec(SweepSpec, "light-and-exposure", "studies").vary
    )
    file = tmp_path / "sweep.yaml"
    file.write_text(json.dumps({**BASE, "vary": {}, "seeds": [5], "keep": True, "options": {"samples": 512}}))
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(file), "--out", str(tmp_path / "out")])
    assert stop.value.code == 0 and "1 run in" in capsys.readouterr().out
    (kept,) = (tmp_path / "out" / "recordings").iterdir()
    assert hr.Recording.load(kept).manifest["seed"] == 5


def test_runs_that_miss_their_quality_are_told(tmp_path, capsys, monkeypatch):
    """What the audits found is a column, which a sweep that goes on still has."""
    plain, lux = Audit.run, {"light.illuminance_lux": [20, 90]}
    monkeypatch.setattr(Audit, "run", lambda self: plain(self) | {"verdict": "not met", "quality_needed": 1.5})
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    changes = {"vary": lux, "seeds": [5], "roi": "8x8", "metrics": ["electrons"], "duration_s": 0.02}
    file.write_text(json.dumps({**BASE, **changes, "options": {"quality": 8}}))
    for _ in range(2):
        with pytest.raises(SystemExit) as stop:
            cli.main(["study", str(file), "--out", str(out)])
        told = capsys.readouterr().out
        assert stop.value.code == 3 and "  NOT MET: 2 of 2 runs are worse than asked for (row 1, row 2)" in told
    assert [row["audit"] for row in json.loads((out / "results.json").read_text())["rows"]] == ["not met"] * 2


@pytest.mark.parametrize(("changes", "message"), [
    ({"vary": {"light.illuminance": [3]}}, r"run with scene=flat-field.*light.illuminance=3.*unknown key"),
    ({"vary": {"sensor.aps.exposure_us": []}}, "a list of values is empty"),
    ({"vary": {"a": {"first": 0, "last": 1, "count": 3, "scale": "log"}}}, "ends above 0"),
    ({"roi": "32"}, "WIDTHxHEIGHT"), ({"metrics": ["snrs"]}, "metrics: unknown 'snrs'.*did you mean 'snr'"),
    ({"vary": {"isp.demosaick.method": ["linear"]}}, "no step 'demosaick'.*did you mean 'demosaic'"),
    ({"vary": {"isp.demosaic.method": ["cubic"]}}, "method"), ({"vary": {"isp.demosaic": [False]}}, "exactly one"),
    ({"vary": {"isp.encode": [3]}}, "expected true or false"), ({"scenes": []}, "needs 'scenes' and 'sensors'"),
    ({"options": {"speed": 1}}, "expected quality"),
    ({"scenes": ["none"]}, "no scene named 'none'"), ({"seeds": list(range(100_001))}, "more than 100000"),
])  # fmt: skip
def test_bad_sweeps_are_one_clear_line(tmp_path, changes, message):
    with pytest.raises(SpecError, match=message) as caught:
        sweep({**BASE, **changes}, out=tmp_path / "out")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "runs"),
    [
        ({"scenes": ["a"], "sensors": ["b"]}, 50_000 * 2),
        ({"scenes": ["a", "b", "c"], "sensors": ["d", "e"]}, 50_000 * 2 * 6),
        ({"study": "s"}, 50_000 * 2),
    ],
)
def test_the_runs_of_a_sweep_are_counted(changes, runs):
    """Two seeds of 50,000 pairs of values; a study has no scenes. 100,000 are accepted."""
    vary = {"x.y": {"first": 1, "last": 2, "count": 10_000}, "x.z": [1, 2, 3, 4, 5]}
    content = {"schema_version": 1, "name": "n", "seeds": [1, 2], "vary": vary, **changes}
    if runs == 100_000:
        SweepSpec.model_validate(content)
        content["seeds"], runs = [1, 2, 3], 150_000
    with pytest.raises(ValidationError, match=f"makes {runs} runs, more than 100000"):
        SweepSpec.model_validate(content)


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


def test_a_dry_run_says_how_many_runs_are_missing(tmp_path, capsys):
    changes = {"vary": {}, "seeds": [5], "roi": "8x8", "metrics": ["electrons"], "duration_s": 0.02}
    sweep({**BASE, **changes}, out=tmp_path / "out")
    (tmp_path / "sweep.yaml").write_text(json.dumps({**BASE, **changes, "seeds": [4, 5, 6]}))
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", str(tmp_path / "sweep.yaml"), "--out", str(tmp_path / "out"), "--dry-run"])
    assert stop.value.code == 0 and "3 runs, 2 of them not yet made" in capsys.readouterr().out


def test_figures_of_a_run_by_hand(monkeypatch):
    """Share of ON events, an MTF between two of its frequencies, and an edge that the full scale cuts off."""
    polarity = np.array([(1,), (1,), (-1,), (1,)], [("polarity", "i1")])
    given = SimpleNamespace(events=4, recording=SimpleNamespace(events=polarity))
    assert RunFigures.on_share.fget(given) == 0.75
    assert RunFigures.on_share.fget(SimpleNamespace(events=0)) is None
    edge = SimpleNamespace(frequency_cy_per_px=np.array([0.2, 0.4, 0.6]), mtf=np.array([0.9, 0.5, 0.3]))
    assert RunFigures.mtf_nyquist.fget(SimpleNamespace(edge=edge)) == pytest.approx(0.4)
    assert RunFigures.mtf_nyquist.fget(SimpleNamespace(edge=None)) is None
    mosaic = SimpleNamespace(black_level_dn=60, system_gain_dn_per_e=0.5, white_level_dn=1000)
    frame = SimpleNamespace(electrons_mean=np.array([3.0, 1879.0]))
    run = SimpleNamespace(
        picture=1, recording=SimpleNamespace(mosaic=mosaic, frames=[frame]), pipeline=SimpleNamespace(without=str),
        _of_clean=lambda pipeline: np.ones((2, 2, 3)),
    )  # fmt: skip
    monkeypatch.setattr(sweep_metrics, "edge_response", lambda y: SimpleNamespace(frequency_at=lambda share: share / 4))
    assert RunFigures.picture_mtf50.fget(run) == 0.125
    frame.electrons_mean[1] = 1880.0  # 60 + 940 DN
    assert RunFigures.picture_mtf50.fget(run) is None

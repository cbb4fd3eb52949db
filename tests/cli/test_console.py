"""What commands tell programs: ``--json``, ``--quiet``, ``--dry-run``, and the table of exit statuses."""

import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from test_cli import call, fails

import hesim_render as hr
from benchmarks import SMALL
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.core.errors import RangeError
from hesim_render.core.progress import Pace, ProgressReport
from hesim_render.core.shipped import data_folder, list_names, read_keys
from hesim_render.core.yaml_file import read_yaml

DOCS = data_folder("sensors").parent / "docs"
STILL = ["simulate", "colorchecker", "--sensor", "reference-mono", "--roi", "16x12", "--duration", "0.02"]


def test_the_page_has_every_exit_status_and_no_other():
    page = (DOCS / "cli.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| `(\w+)` \|", page, re.MULTILINE)
    assert {name: int(number) for number, name in rows} == {each.name: each.value for each in ExitStatus}


def test_json_is_one_object_that_agrees_with_the_recording(capsys, tmp_path):
    status, out, err = call(capsys, *STILL, "--out", tmp_path / "o", "--json")
    told = json.loads(out)
    recording = hr.Recording.load(tmp_path / "o")
    assert status == told["status"] == 0 and err == ""
    assert told["recording"] == str(tmp_path / "o") and told["counts"] == recording.manifest["counts"]
    assert told["duration_us"] == 20_000 and told["sensor"] == "reference-mono" and told["scene"] == "colorchecker"
    assert told["estimate"]["seconds"] > 0 and told["estimate"]["rays"] > 0
    assert told["render"]["audit"] == recording.manifest["settings"]["render"]["audit"]


def test_quiet_prints_nothing_and_errors_all_the_same(capsys, tmp_path):
    assert call(capsys, *STILL, "--out", tmp_path / "o", "--quiet", "--samples", "4") == (ExitStatus.NOT_MET, "", "")
    assert "exists; give another name" in fails(capsys, *STILL, "--out", tmp_path / "o", "--quiet")
    assert fails(capsys, *STILL, "--out", tmp_path / "o", "--json")  # no object where nothing was made


@pytest.mark.parametrize("options", [[], ["--samples", "4"], ["--exact"]])
@pytest.mark.parametrize("moving", [False, True])
def test_a_dry_run_estimates_and_writes_nothing(options, moving, capsys, tmp_path):
    words = ["rotating-star" if word == "colorchecker" and moving else word for word in STILL]
    status, out, _ = call(capsys, *words, *options, "--dry-run", "--json")  # no place is needed
    told = json.loads(out)
    assert status == 0 and told["dry_run"] is True and told["estimate"]["seconds"] > 0
    assert list(tmp_path.iterdir()) == []
    if options and not moving:  # every pixel once, in the only slice of a still scene
        assert told["estimate"]["rays"] == 16 * 12 * (4 if "--samples" in options else 64)
    assert "--duration is 0.0" in fails(capsys, *words, "--duration", "0", "--out", tmp_path / "o", "--dry-run")


@pytest.mark.parametrize(("words", "estimates"), [
    (STILL, "sources.render.change_driven.flux.forecast"), (STILL, "load_scene"),
    (["benchmark", "build", "tiny.yaml"], "benchmark.build.estimate_build"),
])  # fmt: skip
@pytest.mark.parametrize("is_dry", [True, False])
def test_a_long_dry_run_shows_progress_within_five_seconds(words, estimates, is_dry, capsys, tmp_path, monkeypatch):
    """Also where there is no terminal. The time is that of a clock which stands still but in the estimate."""
    reports, clock = [], SimpleNamespace(now=31.0)

    class Watched(ProgressReport):
        def __init__(self, view, pace=None):
            super().__init__(view, Pace(lambda: clock.now))
            reports.append(self)

        def _refresh(self):  # nothing but this test moves it
            pass

    seen = {}

    def estimate(*_, **__):
        (progress,) = reports
        progress(0, 3, "estimate")
        for clock.now in (31.9, 35.5):
            progress._step()
            seen[clock.now] = capsys.readouterr().err
        raise RangeError("estimate", 0, "seen")  # this is enough

    given = {"scenes": {"given": [{"scene": "flat-field", "split": "test"}]}}
    (tmp_path / "tiny.yaml").write_text(json.dumps(SMALL | given))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hesim_render.core.progress.ProgressReport", Watched)
    monkeypatch.setattr(f"hesim_render.{estimates}", estimate)
    assert "seen" in fails(capsys, *words, "--out", tmp_path / "o", *(["--dry-run"] if is_dry else []))
    title = SMALL["name"] if words[0] == "benchmark" else "colorchecker → reference-mono"
    assert seen == {31.9: "", 35.5: f"{title}: 0 % of estimate, 4 s so far\n" if is_dry else ""}


def test_the_rays_of_an_exact_run_are_near_their_estimate(capsys, tmp_path, monkeypatch):
    """Rays that the tracer counts in a moving scene under a rolling shutter, without those of the estimate's own."""
    from hesim_render.sources.render.tracer import Tracer

    tracers = []
    made = Tracer.__init__
    monkeypatch.setattr(Tracer, "__init__", lambda self, *a, **k: (made(self, *a, **k), tracers.append(self))[0])
    given = ["simulate", "rotating-star", "--sensor", "eiger", "--roi", "48x32", "--duration", "0.04", "--samples", "2"]
    _, out, _ = call(capsys, *given, "--out", tmp_path / "o", "--json")
    own = 2 * 2 * (48 * 32 * 3 // 4 + 48 * 32 // 4)  # both pictures of all pixels
    assert json.loads(out)["estimate"]["rays"] == pytest.approx(max(t.rays_done for t in tracers) - own, rel=0.3)


@pytest.mark.parametrize("duration", ["0.005", pytest.param("0.06", marks=pytest.mark.slow)])
def test_the_rays_of_a_run_are_near_their_estimate(duration, capsys, tmp_path, monkeypatch):
    """A fifth of the rays of a short run are those of its first window. GEN2 has few event pixels in the region."""
    monkeypatch.setattr("hesim_render.sources.render.audit.audit._RAYS", 300_000)  # an audit has no part in it
    for sensor, region in (("eiger", "96x64"), ("gen2", "160x128")):
        given = ["rotating-star", "--sensor", sensor, "--roi", region, "--duration", duration]
        out = tmp_path / sensor
        status, told, _ = call(capsys, "simulate", *given, "--out", out, "--json")
        assert status == 0
        render = json.loads((out / "recording.json").read_text())["settings"]["render"]
        assert json.loads(told)["estimate"]["rays"] == pytest.approx(render["rays"] + render["pilot_rays"], rel=0.12)


def test_a_long_exact_run_has_to_be_wanted(capsys, tmp_path):
    status, out, line = call(
        capsys, "simulate", "rotating-star", "--sensor", "gen2", "--duration", "300", "--samples", "1024", "--roi",
        "256x256", "--out", tmp_path / "o",
    )  # fmt: skip
    assert status == 2 and out.startswith("estimate: about ") and "or fewer rays, such as --samples 512" in line
    assert list(tmp_path.iterdir()) == []


def test_only_a_dry_run_does_without_a_place(capsys, tmp_path, monkeypatch):
    """Of each kind of input; nothing is left where temporary files go either."""
    there, temporary = tmp_path / "there", tmp_path / "temporary"
    there.mkdir(), temporary.mkdir()
    monkeypatch.chdir(there)
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    assert call(capsys, *STILL, "--samples", "4", "--quiet", "--out", tmp_path / "o")[0] == ExitStatus.NOT_MET
    (tmp_path / "run.yaml").write_text(
        "schema_version: 1\nname: x\nscene: colorchecker\nsensor: reference-mono\nroi: 16x12\nduration_s: 0.02\n"
    )
    lab = ["calibrate", "lab", "reference-mono", "--roi", "16x12", "--frames", "8", "--ticks", "500"]
    for words in (STILL, ["simulate", tmp_path / "o"], ["simulate", tmp_path / "run.yaml"], lab):
        assert "Missing option '--out': the folder to write to (or --dry-run)" in fails(capsys, *words)
        status, out, _ = call(capsys, *words, "--dry-run", "--json")
        assert status == 0 and json.loads(out)["dry_run"] is True and json.loads(out)["estimate"]["text"]
    for option in (["--framing"], ["--look", "0.01"]):
        assert "give one of" in fails(capsys, *STILL, *option, "--dry-run")
        assert "Missing option '--out'" in fails(capsys, *STILL, *option)
    assert list(there.iterdir()) == list(temporary.iterdir()) == []


def test_a_dry_run_of_a_video(capsys, tmp_path):
    np.save(tmp_path / "v.npy", np.full((4, 12, 16), 90, np.uint8))
    words = [
        "simulate",
        tmp_path / "v.npy",
        "--sensor",
        "reference-mono",
        "--roi",
        "16x12",
        "--set",
        "fps=100",
        "--out",
    ]
    words += [tmp_path / "o", "--set", "transfer=srgb", "--set", "primaries=bt709"]
    told = json.loads(call(capsys, *words, "--dry-run", "--json")[1])
    assert told["estimate"]["pictures"] == 4 and told["dry_run"] is True
    assert [path.name for path in tmp_path.iterdir()] == ["v.npy"]


def test_a_cube_is_rendered_with_keys_of_scene_and_sensor(capsys, tmp_path, monkeypatch):
    """--set changes the scene, or the sensor after sensor.; window, rays and seed reach the renderer."""
    seen = []

    def render(scene, sensor, bands, samples, begin_us, *, end_us, seed):
        seen.append((scene.spec.light.illuminance_lux, sensor.spec.lens.f_number, samples, begin_us, end_us, seed))
        return np.array(bands), np.full((5, 7, 2), 0.5, np.float32), np.full((5, 7, 2), 0.015, np.float32)

    monkeypatch.setattr("hesim_render.render_cube", render)
    words = ["cube", "colorchecker", "--sensor", "reference-mono", "--bands", "450,620", "--out", tmp_path / "c.exr"]
    words += ["--set", "light.illuminance_lux=321", "--set", "sensor.lens.f_number=3.7", "--roi", "7x5"]
    told = call(capsys, *words, "--begin-us", "300", "--end-us", "700", "--samples", "12")
    assert seen == [(321, 3.7, 12, 300, 700, 7)]
    text = told[1] + told[2]
    assert text.startswith("2 bands of 7x5 px, mean 0.5 W") and "standard error of a pixel 3 % of it" in text


def test_a_dry_run_of_a_cube(capsys, tmp_path):
    np.save(tmp_path / "c.npy", np.full((12, 16, 31), 0.3, np.float32))
    words = ["simulate", tmp_path / "c.npy", "--set", "wavelength_nm=400:700:10", "--set", "beyond=hold"]
    words += ["--set", "illuminance_lux=500", "--sensor", "reference-mono"]
    words += ["--roi", "16x12", "--duration", "0.1", "--out", tmp_path / "o"]
    told = json.loads(call(capsys, *words, "--dry-run", "--json")[1])
    # 30 frames a second and 1000 comparisons a second
    assert told["dry_run"] is True and told["estimate"]["text"] == "3 frames and 100 samples of event pixels; no rays"
    assert [path.name for path in tmp_path.iterdir()] == ["c.npy"]
    assert "pan" in fails(capsys, *words, "--set", "pan_px_per_s=x", "--dry-run")
    assert json.loads(call(capsys, *words, "--json")[1])["counts"]["frames"] == 3


def test_a_dry_run_of_a_lab(capsys, tmp_path):
    words = [
        "calibrate",
        "lab",
        "reference-mono",
        "--roi",
        "16x12",
        "--frames",
        "8",
        "--ticks",
        "500",
        "--out",
        tmp_path / "o",
    ]
    words += ["--dark-ms", "1,5", "--lit-ms", "1,5,9", "--dry-run", "--json"]
    told = json.loads(call(capsys, *words)[1])
    # 5 exposures of 8 frames of 192 pixels; 500 ticks lit and dark, and 50 at each of 21 contrasts of both signs
    assert told["estimate"]["text"] == "40 frames, 1.54e-05 GB; 3100 comparisons of event pixels"
    assert told["dry_run"] is True and list(tmp_path.iterdir()) == []
    words[2] = "imx636"
    assert "event pixels for" in json.loads(call(capsys, *words)[1])["estimate"]["text"]
    assert "frames is 2" in fails(capsys, *words, "--frames", "2")
    assert list(tmp_path.iterdir()) == []


def test_lists_as_json_agree_with_the_files(capsys):
    """Only some keys of each file are parsed; the whole files say the same."""
    for kind in ("scenes", "sensors", "studies", "filter_sets"):
        found = {row["name"]: row for row in json.loads(call(capsys, "info", kind, "--json")[1])[kind]}
        assert list(found) == list_names(kind)
        for name in list_names(kind)[:: 7 if kind == "scenes" else 1]:
            file = data_folder(kind) / f"{name}.yaml"
            whole = read_yaml(file)
            assert found[name]["description"] == whole.get("description", "")
            keys = ("geometry", "tile", "pixels", "evs_grid")
            assert read_keys(file, keys) == {key: whole[key] for key in keys if key in whole}
    assert found and json.loads(call(capsys, "info", "sensors", "--json")[1])["sensors"][2]["events_px"] == [128, 128]


def test_listing_and_completing_load_no_renderer():
    """Names are completed while somebody waits: 20 scenes were once parsed for it, with 3 s of imports."""
    code = (
        "import sys; from hesim_render.cli import main\ntry: main(['info', 'scenes'])\nexcept SystemExit: pass\n"
        "from hesim_render.cli.options import names_of; print(names_of('sensors')('im'))\n"
        "print([m for m in ('mitsuba', 'scipy', 'colour', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *_, names, heavy = done.stdout.splitlines()
    assert heavy == "[]" and names == "['imx250', 'imx264', 'imx363', 'imx477', 'imx636']"


@pytest.mark.parametrize(("shell", "answer"), [("bash", "rotating-star"), ("zsh", '"rotating-star"'), ("fish", "rot")])
def test_the_shell_completes_names(shell, answer):
    words = "hesim-render simulate rot"
    place = {**os.environ, "_HESIM_RENDER_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": words,
             "COMP_WORDS": words, "COMP_CWORD": "2", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}  # fmt: skip
    program = "import sys; sys.argv[0] = 'hesim-render'; from hesim_render.cli import main; main([])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=place)
    assert answer in done.stdout and "Usage" not in done.stdout, done.stderr


def test_what_is_printed_moves_no_cursor_and_is_json(capsys):
    """Names of files and texts in them are of others."""
    from hesim_render.cli.console import Console

    name = "a\x1b[2Jb\x9b1mc\u202ed\ud800 ö"
    Console().result(f"made {name}\nof x", {})
    assert capsys.readouterr().out == "made a\\x1b[2Jb\\x9b1mc\\u202ed\\ud800 ö\nof x\n"
    Console(as_json=True).result("", {"name": name})
    text = capsys.readouterr().out
    assert json.loads(text)["name"] == name and text.replace("\n", "").isprintable()

"""Whole runs from a file: its mistakes have lines, its steps are those of the commands, and an ended run goes on."""

import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from test_cli import call, fails

import hesim_render as hr
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.core.shipped import data_folder
from hesim_render.exchange import open_events
from hesim_render.specs.files import read_spec
from hesim_render.specs.run import RunSpec

RUN = """\
schema_version: 1
name: small
scene: rotating-star
sensor: davis346
set: {light.illuminance_lux: 300, sensor.aps.exposure_us: 2000}
roi: 48x36
duration_s: 0.03
samples: 2
isp: {denoise: false}
export:
  - {format: evt3, out: events.raw}
  - {format: npy, out: frames}
view: true
"""


def write(folder, text=RUN):
    (folder / "run.yaml").write_text(text)
    return folder / "run.yaml"


def test_a_run_is_its_commands_one_after_the_other(capsys, tmp_path):
    status, out, err = call(capsys, "simulate", write(tmp_path), "--out", tmp_path / "o", "--json")
    told = json.loads(out)
    assert status == told["status"] == ExitStatus.NOT_MET  # two rays a pixel
    assert told["kept"] == [] and "Traceback" not in err
    assert sorted(told["written"]) == ["events.raw", "frames", "pictures", "recording", "recording/recording.html"]
    assert sorted(os.listdir(tmp_path / "o")) == ["events.raw", "frames", "pictures", "recording", "run.json"]
    same = ["--sensor", "davis346", "--roi", "48x36", "--duration", "0.03", "--samples", "2"]
    same += ["--set", "light.illuminance_lux=300", "--set", "sensor.aps.exposure_us=2000", "--out", tmp_path / "r"]
    assert call(capsys, "simulate", "rotating-star", *same)[0] == ExitStatus.NOT_MET
    alone = sorted(path.relative_to(tmp_path / "r") for path in (tmp_path / "r").rglob("*") if path.is_file())
    for name in alone:
        assert (tmp_path / "o" / "recording" / name).read_bytes() == (tmp_path / "r" / name).read_bytes(), name
    rec = hr.Recording.load(tmp_path / "r")
    np.testing.assert_array_equal(np.concatenate(list(open_events(tmp_path / "o" / "events.raw"))), rec.events)
    np.testing.assert_array_equal(np.load(tmp_path / "o" / "frames" / "000000.npy"), rec.frames[0].raw)

    # the second time all is there; what is missing is made again, and nothing else
    before = (tmp_path / "o" / "recording" / "recording.json").stat().st_mtime_ns
    (tmp_path / "o" / "events.raw").unlink()
    told = json.loads(call(capsys, "simulate", tmp_path / "run.yaml", "--out", tmp_path / "o", "--json")[1])
    assert len(told["kept"]) == 5 and (tmp_path / "o" / "events.raw").is_file()
    assert (tmp_path / "o" / "recording" / "recording.json").stat().st_mtime_ns == before
    dry = json.loads(call(capsys, "simulate", tmp_path / "run.yaml", "--out", tmp_path / "o", "--dry-run", "--json")[1])
    assert dry["estimate"]["text"] == "the recording is there already"

    # another content is refused, and replaces all of the old one where that is wanted
    other = ["simulate", tmp_path / "run.yaml", "--out", tmp_path / "o", "--set", "seed=8", "--set", "export=[]"]
    assert "holds a run of other content" in fails(capsys, *other)
    assert call(capsys, *other, "--overwrite")[0] == ExitStatus.NOT_MET
    assert sorted(os.listdir(tmp_path / "o")) == ["pictures", "recording", "run.json"]
    assert hr.Recording.load(tmp_path / "o" / "recording").manifest["seed"] == 8


@pytest.mark.parametrize(("before", "after", "told"), [
    ("scene: rotating-star", "scne: flat-field", "run.yaml:3: scne: unknown key (did you mean 'scene'?)"),
    ("scene: rotating-star", "description: x", "run.yaml:1: a run is of a 'scene', a 'video' or a 'cube'"),
    ("scene: rotating-star", "scene: rotating-sta", "no scene named 'rotating-sta'"),
    ("roi: 48x36", "roi: 16x", "run.yaml:6: roi: roi is '16x'; expected WIDTHxHEIGHT"),
    ("roi: 48x36", "roi: 1600x12", "roi width_px is 1600"),
    ("samples: 2", "samples: 2\nquality: 1", "run.yaml:9: quality: give it, or exact or samples, not both"),
    ("format: evt3", "format: evt4", "format is 'evt4'; expected one of"),
    ("out: frames", "out: ../frames", "run.yaml:12: export.1.out: '../frames' is not the name of a file or folder"),
    ("out: frames", "out: /", "run.yaml:12: export.1.out: '/' is not the name of a file or folder"),
    ("out: frames", "out: pictures", "run.yaml:12: export.1.out: expected a name other than recording, pictures"),
    ("out: frames", "out: events.raw", "export: 'events.raw' is written twice"),
    ("sensor: davis346\nset: {light.illuminance_lux: 300, sensor.aps.exposure_us: 2000}", "sensor: dvs128",
     "format is 'npy'; expected a format of events"),
    ("light.illuminance_lux", "light.iluminance_lux", "light.iluminance_lux: unknown key"),
    ("scene: rotating-star\nsensor: davis346\nset: {light.illuminance_lux: 300, ", "video: {file: v.mp4}\nsensor: "
     "davis346\nset: {", "run.yaml:8: samples: only a run of a scene takes it"),
])  # fmt: skip
def test_mistakes_of_the_file_are_a_line_each_and_nothing_is_written(before, after, told, capsys, tmp_path):
    assert before in RUN
    line = fails(capsys, "simulate", write(tmp_path, RUN.replace(before, after)), "--out", tmp_path / "o")
    assert told in line
    assert os.listdir(tmp_path) == ["run.yaml"]


def test_runs_of_videos_and_cubes(capsys, tmp_path):
    np.save(tmp_path / "v.npy", np.full((4, 12, 16), 90, np.uint8))
    np.save(tmp_path / "c.npy", np.full((12, 16, 2), 0.18, np.float32))
    base = "schema_version: 1\nname: x\nsensor: reference-mono\nroi: 16x12\n"
    video = "video:\n  file: v.npy\n  options:\n    fps: 100\n    transfer: srgb\n    primaries: bt709\n"
    cube = "duration_s: 0.03\ncube:\n  file: c.npy\n  options:\n    wavelength_nm: [360, 830]\n    illuminance_lux: 9\n"
    for name, text, seconds in (("v", video, 0.04), ("c", cube, 0.03)):
        given = ["simulate", write(tmp_path, base + text), "--out", tmp_path / name]
        assert json.loads(call(capsys, *given, "--dry-run", "--json")[1])["dry_run"] and not (tmp_path / name).exists()
        assert call(capsys, *given, "--quiet") == (0, "", "")
        assert hr.Recording.load(tmp_path / name / "recording").duration_us == round(1e6 * seconds)
    wrong = write(tmp_path, base + video.replace("fps: 100", "fsp: 100"))
    assert "run.yaml:8: fsp: unknown key (did you mean 'fps'?)" in fails(
        capsys, "simulate", wrong, "--out", tmp_path / "w"
    )
    wrong = write(tmp_path, base + video.replace("v.npy", "w.npy"))
    assert "video.file: w.npy: no such file" in fails(capsys, "simulate", wrong, "--out", tmp_path / "w")
    assert not (tmp_path / "w").exists()


@pytest.mark.slow
def test_a_run_that_was_interrupted_after_its_recording_goes_on(tmp_path, capsys):
    """The program is stopped while it develops: the second call renders nothing."""
    run = write(tmp_path)
    program = (
        "import sys, time\nfrom hesim_render.capture import run_file\n"
        "run_file.develop_recording = lambda *a: (print('developing', flush=True), time.sleep(60))\n"
        "from hesim_render.cli import main; main(sys.argv[1:])"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program, "simulate", run, "--out", tmp_path / "o"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    while (line := child.stdout.readline()) and "developing" not in line:
        pass
    assert line, child.stderr.read()
    os.kill(child.pid, signal.SIGINT)
    assert child.wait(timeout=60) == 130
    assert json.loads((tmp_path / "o" / "run.json").read_text())["done"] == ["recording"]
    before = (tmp_path / "o" / "recording" / "recording.json").stat().st_mtime_ns
    status, out, _ = call(capsys, "simulate", run, "--out", tmp_path / "o")
    assert status == 0 and "made by an earlier run: recording" in out and "estimate: the recording is there" in out
    assert (tmp_path / "o" / "recording" / "recording.json").stat().st_mtime_ns == before


def test_the_example_of_the_page_is_a_valid_file(tmp_path):
    page = (data_folder("sensors").parent / "docs" / "cli.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    spec = read_spec(RunSpec, write(tmp_path, text))
    assert (spec.scene, spec.sensor, spec.roi, spec.view) == ("rotating-star", "gen2", "256x192", True)
    assert spec.isp is not None and not spec.isp.denoise and [step.format for step in spec.export] == ["evt3", "png"]


def test_a_file_cannot_let_its_scene_out_of_its_folder(capsys, tmp_path):
    """That is for who runs it to say: the file may come from somebody else."""
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "scene.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: d\nobjects: [{name: m, shape: mesh, mesh: ../mesh.obj}]\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {origin_m: [0, 0, 2]}\n"
    )
    plain = "schema_version: 1\nname: r\nscene: scene.yaml\nsensor: reference-mono\nroi: 8x8\nsamples: 2\n"
    (folder / "run.yaml").write_text(plain + "allow_outside: true\n")
    assert "allow_outside" in fails(capsys, "simulate", folder / "run.yaml", "--out", tmp_path / "o")
    (folder / "run.yaml").write_text(plain)
    assert "--allow-outside" in fails(capsys, "simulate", folder / "run.yaml", "--out", tmp_path / "o")
    status, _, _ = call(
        capsys, "simulate", folder / "run.yaml", "--out", tmp_path / "o", "--allow-outside", "--dry-run"
    )
    assert status == 0

"""The command line: exit codes, one clear line for every mistake, nothing left behind."""

import html
import json
import math
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render import cli
from hesim_render.capture.run_settings import NOISE_TERMS
from hesim_render.cli.exit_status import ExitStatus
from hesim_render.core import backend, progress
from hesim_render.core.backend import BackendCandidate
from hesim_render.core.errors import RangeError, how_to_install
from hesim_render.core.region import parse_roi
from hesim_render.core.shipped import data_folder, list_names


def call(capsys, *arguments):
    """(exit status, stdout, stderr) of one command, in this process. What a slow machine adds to stderr is left out:
    lines of progress, and notes that a run takes longer than its estimate.
    """
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as caught:
        patch.setattr(progress, "_FIRST_LINE_S", math.inf)
        patch.setattr(progress, "_LEAST_LATE_S", math.inf)
        cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return caught.value.code, out, err


def fails(capsys, *arguments):
    """The one line a mistake gives."""
    status, out, err = call(capsys, *arguments)
    assert status == 2 and out == ""
    assert err.startswith("hesim-render: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


def test_help_lists_the_commands():
    done = subprocess.run([sys.executable, "-m", "hesim_render.cli", "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    named = re.findall(r"^  ([a-z]+)  ", done.stdout.partition("Commands:")[2], re.MULTILINE)
    assert named[0] == "simulate" and {"info", "view", "export", "calibrate", "study", "benchmark"} <= set(named)
    assert len(named) <= 15 and "..." not in done.stdout.partition("Commands:")[2]


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from hesim_render.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
        "print([m for m in ('drjit', 'mitsuba', 'numpy', 'scipy', 'colour', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_no_arguments_show_the_help(capsys):
    status, out, _ = call(capsys)
    assert status == 0 and "Usage" in out
    assert call(capsys, "--version")[1] == f"hesim-render {hr.__version__}\n"


@pytest.mark.parametrize("kind", ["sensors", "scenes"])
def test_list_names_what_ships(kind, capsys):
    status, out, _ = call(capsys, "info", kind)
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == list_names(kind)
    assert all(len(line.split()) > 3 for line in out.splitlines())


def test_list_illuminants(capsys):
    names = call(capsys, "info", "illuminants")[1].splitlines()
    assert {"D65", "A", "FL11", "LED-B3"} <= set(names)


def test_list_noise_names_every_term_and_the_docs_do_too(capsys):
    names = call(capsys, "info", "noise")[1].splitlines()
    assert names == list(NOISE_TERMS) and "aps.read" in names and "evs.leak" in names
    docs = (data_folder("sensors").parent / "docs" / "sensors.md").read_text()
    table = docs[docs.index("## Switching noise off") : docs.index("## Changing one figure")]
    assert {name for name in re.findall(r"`((?:aps|evs)\.\w+)`", table)} == set(names)


def test_list_alone_lists_everything(capsys):
    status, out, err = call(capsys, "info", "names")
    assert status == 0 and err == ""
    for kind in ("scenes", "sensors", "illuminants", "noise", "truth"):
        below = out[out.index(f"{kind}:\n") :].splitlines()[1:]
        assert [line.strip() for line in below[:3]] == call(capsys, "info", kind)[1].splitlines()[:3]


@pytest.mark.parametrize("command", ["--help", "info scenes"])
def test_output_that_nobody_reads_is_no_failure_and_a_full_disk_is_one_line(command):
    run = [sys.executable, "-m", "hesim_render.cli", *command.split()]
    # with it, nothing is left to flush at the end, which is where the status was lost
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reading, writing = os.pipe()
    os.close(reading)
    closed = subprocess.run(run, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (closed.returncode, closed.stderr) == (0, "")
    with open("/dev/full", "w") as full:
        done = subprocess.run(run, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "hesim-render: standard output: No space left on device\n")
    with open("/dev/full", "w") as full:  # nor is there a traceback where nobody can be told
        for more in ({}, {"PYTHONUNBUFFERED": "1"}):
            done = subprocess.run([*run, "--wrong"], stdout=full, stderr=full, env={**buffered, **more})
            assert done.returncode == 2


@pytest.mark.slow
def test_a_run_goes_on_where_nobody_reads_what_it_says(tmp_path):
    run = [
        sys.executable, "-m", "hesim_render.cli", "simulate", "dark", "--sensor", "reference-mono", "--roi", "8x8",
        "--duration", "0.002", "--out", str(tmp_path / "o"),
    ]  # fmt: skip
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(run, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "") and (tmp_path / "o" / "recording.json").is_file()


def test_what_no_pixel_uses_after_a_change_is_noted(capsys, tmp_path):
    status, out, err = call(
        capsys, "simulate", "dark", "--sensor", "eiger", "--roi", "8x8", "--duration", "0.002", "--out", tmp_path / "o",
        "--set", "sensor.pixels.W={filter: green, roles: [aps]}",
    )  # fmt: skip
    assert status == 0 and "RAW frames" in out and err.count("\n") == 1
    assert err.startswith("hesim-render: note: ") and "pixels.W: no pixel of the tile has this letter" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "dark", "--sensor", "reference-mono", "--roi", "8x8", "--out", "LONG"],
        ["simulate", "LONG", "--sensor", "reference-mono", "--out", "o"],
        ["simulate", "dark", "--sensor", "LONG", "--out", "o"],
        ["simulate", "LONG", "--sensor", "reference-mono", "--out", "o"],
        ["calibrate", "lab", "reference-mono", "--out", "LONG"],
        ["demo", "--out", "LONG"],
        ["view", "LONG"],
        ["isp", "LONG"],
        ["calibrate", "aps", "LONG", "--out", "c.yaml"],
    ],
)
def test_a_name_of_256_characters_is_one_line(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fails(capsys, *["a" * 256 if argument == "LONG" else argument for argument in arguments])
    assert list(tmp_path.iterdir()) == []


def test_all_mistakes_of_a_file_are_a_line_each(capsys, tmp_path):
    changes = ["--set", "sensor.aps.reed_noise_e=1", "--set", "sensor.lens.f_number=-1"]
    status, out, err = call(
        capsys, "simulate", "dark", "--sensor", "eiger", "--roi", "16x16", "--out", tmp_path / "o", *changes
    )
    assert status == 2 and out == "" and not (tmp_path / "o").exists()
    lines = err.splitlines()
    assert len(lines) == 2 and all(line.startswith("hesim-render: ") for line in lines)
    assert "aps.reed_noise_e: unknown key (did you mean 'read_noise_e'?)" in err and "lens.f_number" in err


def test_the_summary_of_a_sensor_without_frames_speaks_of_events_alone(capsys, tmp_path):
    events_only = ["--set", "sensor.pixels.M.roles=[evs]", "--set", "sensor.aps=null"]
    events_only += ["--set", "sensor.sources={}", "--set", "sensor.assumptions={}"]
    status, out, _ = call(
        capsys, "simulate", "dark", "--sensor", "reference-mono", "--roi", "8x8", "--duration", "0.002", "--out",
        tmp_path / "o", *events_only,
    )  # fmt: skip
    assert status == 0 and "events: " in out and "on 8x8 px" in out
    assert "RAW" not in out and "bit" not in out


def test_a_long_run_says_what_to_do_in_one_reading(capsys, tmp_path):
    status, out, line = call(
        capsys, "simulate", "rotating-star", "--sensor", "gen2", "--duration", "1000", "--out", tmp_path / "o",
        "--quality", "0.4", "--roi", "64x64",
    )  # fmt: skip
    assert status == 2 and out.startswith("estimate: about ") and line.count("\n") == 1
    assert "this run takes about " in line and "must be allowed: add --yes (max_minutes=None), or ask for less" in line
    assert "--duration, a smaller --roi, or a larger error, such as --quality 0.8" in line
    assert list(tmp_path.iterdir()) == []


def test_doctor_says_what_runs(capsys):
    status, out, _ = call(capsys, "info")
    assert status == 0
    last = out.splitlines()[-1]
    assert last.startswith("backend") and last.endswith("_ad_spectral")
    assert any(line.startswith("candidate") and line.endswith("works") for line in out.splitlines())
    assert any(line.split() == ["numpy", np.__version__] for line in out.splitlines())


def test_doctor_says_what_to_install_where_nothing_runs(capsys, monkeypatch):
    broken = BackendCandidate("llvm", "system", "/nowhere/libLLVM-20.so")
    monkeypatch.setattr(backend, "candidates", lambda: [broken])
    status, out, err = call(capsys, "info")
    assert status == 2 and "does not work: no such file" in out
    assert err.count("\n") == 1 and "libllvm19" in err and how_to_install("llvm") in err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nonsense"], "No such command 'nonsense'"),
        (["info", "cameras"], "WHAT is 'cameras'; expected a sensor or one of machine, names, scenes"),
        (["simulate"], "Missing argument"),
        (["simulate", "colorchecker", "--out", "o"], "Missing option '--sensor'"),
        (["simulate", "colorchecker", "--sensor", "eiger"], "Missing option '--out'"),
        (["simulate", "colorchecker", "--sensor", "eiger", "--out", "o", "--colour"], "No such option"),
        (["view"], "Missing argument"),
    ],
)
def test_wrong_usage_is_one_line(arguments, text, capsys):
    assert text in fails(capsys, *arguments)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--duration", "0"], "--duration is 0.0; expected a time above 0"),
        (["--duration", "-1"], "--duration is -1.0"),
        (["--duration", "nan"], "--duration is nan"),
        (["--duration", "soon"], "--duration"),
        (["--duration", "1e300"], "expected at most 4294.967295: so long is a recording of events"),
        (["--duration", "1e5"], "expected at most 4294.967295: so long is a recording of events"),
        (
            ["--duration", "3000", "--set", "sensor.evs.tick_us=100", "--set", "sensor.evs.window_us=50"],
            "expected at most 2000: so long is 20000000 comparisons, one every 100 µs",
        ),
        (
            ["--duration", "4000", "--set", "sensor.aps.frame_rate_hz=1000", "--set", "sensor.aps.exposure_us=500"],
            "expected at most 2000: so long is 2000000 frames at 1000 Hz",
        ),
        (["--roi", "512"], "--roi is '512'; expected WIDTHxHEIGHT"),
        (["--roi", "axb"], "expected WIDTHxHEIGHT"),
        (["--roi", "٨x8"], "expected WIDTHxHEIGHT"),
        (["--roi", "8x-8"], "expected WIDTHxHEIGHT"),
        (["--roi", " 8x8"], "expected WIDTHxHEIGHT"),
        (["--roi", "1_6x16"], "expected WIDTHxHEIGHT"),
        (["--roi", "512x384+1"], "expected WIDTHxHEIGHT"),
        (["--roi", "4000x384"], "roi width_px is 4000; expected 1 to 3264"),
        (["--roi", "510x384"], "a multiple of the tile's 4 pixels"),
        (["--roi", "512x384+3200+0"], "inside the sensor"),
        (["--seed", "-1"], "seed is -1"),
        (["--set", "camera"], "expected KEY=VALUE"),
        (["--set", "camera.f_numbr=4"], "colorchecker.yaml: camera.f_numbr: unknown key"),
        (["--set", "light.illuminance_lux=-4"], "light.illuminance_lux"),
        (["--set", "sensor.aps.exposure_us=-4"], "eiger.yaml: aps.exposure_us: Input should be greater than 0"),
        (["--set", "sensor.aps.reed_noise=1"], "eiger.yaml: aps.reed_noise: unknown key"),
        (["--set", "light.illuminant={flat: 1, band_nm: [400, 600]}"], "of the response of"),
        (["--without", "aps.nothing"], "noise term is 'aps.nothing'; expected one of aps."),
        (["--sensor", "eigr"], "no sensor named 'eigr'; shipped are"),
        (["--sensor", "eigr"], "(did you mean 'eiger'?)"),
        (["--without", "aps.reed"], "(did you mean 'aps.read'?)"),
        (["--quality", "0.3", "--samples", "8"], "give --quality or --samples (quality, samples), not both"),
        (["--sensor", "./my.yaml"], "my.yaml: no such file"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(options, text, capsys, tmp_path):
    out = tmp_path / "o"
    base = ["simulate", "colorchecker", "--sensor", "eiger", "--out", out, "--duration", "0.02", "--roi", "16x16"]
    assert text in fails(capsys, *base, *options)
    assert list(tmp_path.iterdir()) == []


def test_unknown_and_unreadable_scenes_are_one_line(capsys, tmp_path):
    base = ["--sensor", "eiger", "--roi", "16x16", "--out", tmp_path / "o"]
    assert "no scene named 'colourchecker'; shipped are" in fails(capsys, "simulate", "colourchecker", *base)
    (tmp_path / "broken.xml").write_text("<scene version='3.0.0'><shape></scene>")
    (tmp_path / "xml.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: x\nmitsuba: {file: broken.xml}\n"
        "camera: {origin_m: [0, 0, 4], target_m: [0, 0, 0]}\n"
    )
    assert "broken.xml" in fails(capsys, "simulate", tmp_path / "xml.yaml", *base)
    assert not (tmp_path / "o").exists()


def test_existing_output_is_refused_before_anything_is_rendered(capsys, tmp_path, monkeypatch):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "thesis.txt").write_text("x")
    monkeypatch.setitem(hr.__dict__, "simulate", lambda *a, **k: pytest.fail("rendered"))
    line = fails(capsys, "simulate", "colorchecker", "--sensor", "eiger", "--out", tmp_path / "o", "--overwrite")
    assert "holds other things" in line
    assert "is not a folder" in fails(
        capsys, "simulate", "colorchecker", "--sensor", "eiger", "--out", tmp_path / "o" / "thesis.txt" / "r"
    )


def test_options_reach_simulate(capsys, tmp_path, monkeypatch):
    seen = {}

    def simulate(scene, sensor, **options):
        seen.update(options, scene=scene, sensor=sensor)
        return recordings.make("eiger", options["out"])

    monkeypatch.setitem(hr.__dict__, "simulate", simulate)
    monkeypatch.setitem(hr.__dict__, "load_scene", lambda name, changes, allow_outside=False: (name, changes))
    monkeypatch.setitem(hr.__dict__, "load_sensor", lambda name, changes: Cropped(name, changes))
    status, out, _ = call(
        capsys, "simulate", "dark", "--sensor", "gen2", "--out", tmp_path / "o", "--duration", "0.25", "--roi",
        "64x32+4+8", "--seed", "9", "--samples", "32", "--set", "camera.f_number=4", "--set",
        "sensor.aps.law=gaussian", "--clean", "--without", "aps.read", "--without", "evs.leak",
    )  # fmt: skip
    assert status == 0 and "RAW frames: 2 of 128x96 px" in out and str(tmp_path / "o") in out
    assert seen["scene"] == ("dark", {"camera.f_number": 4})
    assert (seen["sensor"].name, seen["sensor"].changes) == ("gen2", {"aps.law": "gaussian"})
    assert seen["sensor"].region == (64, 32, 4, 8)
    assert {k: seen[k] for k in ("duration_s", "seed", "samples", "clean", "without", "overwrite")} == {
        "duration_s": 0.25, "seed": 9, "samples": 32, "clean": True, "without": ["aps.read", "evs.leak"],
        "overwrite": False,
    }  # fmt: skip


class Cropped:
    def __init__(self, name, changes):
        self.name, self.changes, self.region = name, changes, None

    def crop(self, *region):
        self.region = region
        return self


def test_a_run_that_is_not_what_was_asked_for_says_so_and_has_a_status_of_its_own(capsys, tmp_path, monkeypatch):
    """With a tolerance that no run of this quality meets; then with the usual one."""
    from hesim_render.sources.render.audit import audit

    given = ("simulate", "rotating-star", "--sensor", "reference-mono", "--roi", "24x16", "--duration", 0.01)
    monkeypatch.setattr(audit, "FINEST_QUALITY", 0.1)  # a quality is named, not that none would do
    for tolerance, rays, wanted in ((1.0, 500_000, 3), (audit.TOLERANCE, audit._RAYS, 0)):
        monkeypatch.setattr(audit, "TOLERANCE", tolerance)
        monkeypatch.setattr(audit, "_RAYS", rays)  # what can never be shown is not tried for long
        out = tmp_path / str(wanted)
        status, text, err = call(capsys, *given, "--out", out)
        told = json.loads((out / "recording.json").read_text())["settings"]["render"]
        assert status == wanted and all("estimate" in line for line in err.splitlines())
        assert (told["audit"]["verdict"] == "not met") == (status == 3)
        short = [line for line in text.splitlines() if "NOT MET" in line]
        assert len(short) == (status == 3)
        for name in ("events", "frames"):
            (line,) = (line for line in text.splitlines() if line.startswith(f"  render, {name}: stated error"))
            assert f"{told['error_noise'][name]['rms']:.2g} of the sensor's noise (rms, asked for 0.5)" in line
            (line,) = (line for line in text.splitlines() if line.startswith(f"  audit, {name}:"))
            assert f"{100 * told['audit'][name]['off_at_most']:.2g} %" in line
            assert f"rms {told['audit'][name]['deviation_noise']['rms']:.2g}" in line
        if status == 3:
            needed = told["audit"]["quality_needed"]
            assert 0 < needed < 0.5 and f"--quality {needed:g} would do" in short[0]


def test_view_writes_the_previews_anew(capsys, tmp_path):
    recordings.make("eiger", tmp_path / "r")
    (tmp_path / "r" / "preview.png").unlink()
    status, out, _ = call(capsys, "view", tmp_path / "r")
    assert status == 0 and (tmp_path / "r" / "preview.png").is_file()
    assert "events: 20000" in out and "preview.png" in out
    assert "not a recording" in fails(capsys, "view", tmp_path)
    assert "no such folder" in fails(capsys, "view", tmp_path / "nowhere")


def test_parse_roi():
    assert parse_roi("512x384") == (512, 384, None, None)
    assert parse_roi("512X384+100+200") == (512, 384, 100, 200)
    with pytest.raises(RangeError):
        parse_roi("512x384x2")


#: A run that says when it is about to keep its first result, or has kept it, and stays there until it is ended.
HELD = """
import sys, time
from hesim_render.core.journal import Journal
keep, when = Journal.keep, sys.argv[1]
def held(*given):
    if when == "after":
        keep(*given)
    print("held", flush=True)
    time.sleep(600)
Journal.keep = held
from hesim_render.cli import main
main(sys.argv[2:])
"""


@pytest.mark.parametrize(
    ("number", "when", "left"),
    [
        (signal.SIGINT, "before", []),
        pytest.param(signal.SIGTERM, "before", [], marks=pytest.mark.slow),
        (signal.SIGINT, "after", [".o.unfinished"]),
    ],
)
def test_interrupt_exits_130_and_leaves_what_was_kept_or_nothing(number, when, left, tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", HELD, when, "simulate", "rotating-star", "--sensor", "gen2", "--roi", "64x48",
         "--duration", "0.02", "--yes", "--out", tmp_path / "o"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # a test run in the background of a shell ignores SIGINT, and its children would too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    while (line := child.stdout.readline()) and line != "held\n":
        pass
    assert line and any(path.name.endswith(".partial") for path in tmp_path.iterdir())
    os.kill(child.pid, number)
    _, err = child.communicate(timeout=60)
    assert child.returncode == 130, err
    assert "interrupted" in err and "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == left


def test_the_main_job_end_to_end(capsys, tmp_path):
    status, out, err = call(
        capsys, "simulate", "colorchecker", "--sensor", "eiger", "--roi", "64x48", "--duration", "0.02",
        "--out", tmp_path / "o", "--samples", "16", "--seed", "3",
    )  # fmt: skip
    assert err == "" and "RAW frames: 1 of 64x48 px" in out
    # 16 rays a pixel are not enough for this chart, which a run says itself
    assert status == ExitStatus.NOT_MET and re.search(r"NOT MET: by their stated error .*; --samples \d+ would do", out)
    # whoever looks at the recording later reads the same line, and looking at it is no failure
    (line,) = re.findall("NOT MET.*", out)
    status, out, _ = call(capsys, "view", tmp_path / "o", "--no-viewer")
    assert status == ExitStatus.DONE and f"  {line}" in out
    assert line in html.unescape((tmp_path / "o" / "recording.html").read_text(encoding="utf-8"))
    recording = hr.Recording.load(tmp_path / "o")
    frame = recording.frames[0]
    assert frame.raw.shape == (48, 64) and frame.raw.dtype == np.uint16
    assert 0.74 < frame.valid.mean() < 0.76 and (frame.raw[~frame.valid] == 0).all()
    assert np.isfinite(frame.electrons_mean[frame.valid]).all() and np.isnan(frame.electrons_mean[~frame.valid]).all()
    assert (frame.electrons_mean[frame.valid] > 0).all() and (frame.electrons_stderr[frame.valid] >= 0).all()
    assert recording.manifest["settings"]["samples"] == 16 and recording.manifest["seed"] == 3
    assert recording.event_truth.flux_mean_e_per_s.shape == recording.event_shape == (24, 32)
    assert json.loads((tmp_path / "o" / "recording.json").read_text())["scene"]["name"] == "colorchecker"
    assert (tmp_path / "o" / "preview.png").is_file()
    assert "exists; give another name" in fails(
        capsys, "simulate", "colorchecker", "--sensor", "eiger", "--out", tmp_path / "o"
    )


@pytest.mark.slow
def test_lab_calibrate_and_simulate_end_to_end(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, err = call(
        capsys, "calibrate", "lab", "eiger", "--out", "lab", "--roi", "64x64", "--frames", "16", "--ticks", "1500",
        "--seed", "4",
        "--dark-ms", "1,20,80", "--lit-ms", "1,10,20,80", "--set", "sensor.evs.contrast_threshold_on=0.15",
        "--set", "sensor.evs.contrast_threshold_off=0.15",
    )  # fmt: skip
    assert status == 0 and err == "" and "lab/aps_dark.npz" in out and "lab/evs_steps.npz" in out
    for part, text in (("aps", "K, system gain"), ("evs", "threshold mismatch")):
        status, out, err = call(
            capsys, "calibrate", part, "lab", "--out", "calibration.yaml", "--report", "report.html"
        )
        assert status == 0 and err == "" and text in out and " to " in out
        assert out.endswith("in calibration.yaml\nreport: report.html\n")
    assert "Frames (APS)" in (tmp_path / "report.html").read_text()
    line = fails(
        capsys, "simulate", "dark", "--sensor", "eiger", "--set", "sensor.noise=calibration.yaml", "--out", "r",
        "--roi", "128x64", "--duration", "0.02",
    )  # fmt: skip
    assert "--roi 64x64+1600+1192" in line and not (tmp_path / "r").exists()
    status, out, err = call(
        capsys, "simulate", "dark", "--sensor", "eiger", "--set", "sensor.noise=calibration.yaml", "--out", "r",
        "--roi", "64x64", "--duration", "0.02", "--samples", "2",
    )  # fmt: skip
    assert status == 0 and err == ""
    frame = hr.Recording.load(tmp_path / "r").frames[0]
    with np.load(tmp_path / "lab" / "aps_dark.npz") as data:
        captured = data["frames"][0].mean(axis=0)
    # the rows of this device (1.5 DN) above read noise (0.8 DN): 1/sqrt(1 + (0.8² + 2·0.32²)/1.5²) = 0.86
    assert np.corrcoef(frame.raw[frame.valid], captured[frame.valid])[0, 1] > 0.75


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["calibrate", "lab"], "Missing argument"),
        (["calibrate", "lab", "eiger"], "Missing option '--out'"),
        (["calibrate", "lab", "eigr", "--out", "o"], "no sensor named 'eigr'"),
        (["calibrate", "lab", "eiger", "--out", "o", "--frames", "3"], "frames is 3; expected 8 or more"),
        (["calibrate", "lab", "eiger", "--out", "o", "--ticks", "0"], "ticks is 0"),
        (
            ["calibrate", "lab", "eiger", "--out", "o", "--dark-ms", "short"],
            "exposures is 'short'; expected times in ms",
        ),
        (["calibrate", "lab", "eiger", "--out", "o", "--dark-ms", "5"], "dark exposures"),
        (
            ["calibrate", "lab", "eiger", "--out", "o", "--set", "camera.f_number=4"],
            "expected a key of the sensor file",
        ),
        (["calibrate", "lab", "eiger", "--out", "o", "--illuminant", "D66"], "D66"),
        (["calibrate", "lab", "eiger", "--out", "o", "--without", "aps.reed"], "noise term is 'aps.reed'"),
        (["calibrate", "isp", "x", "--out", "c.yaml"], "No such command 'isp'"),
        (["calibrate", "aps", "nowhere", "--out", "c.yaml"], "nowhere: no such folder of captures"),
        (["calibrate", "aps", ".", "--out", "c.yaml"], "capture.yaml: no such file"),
    ],
)
def test_bad_input_of_lab_and_calibrate_is_one_line_and_writes_nothing(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert text in fails(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_lab_of_an_asynchronous_sensor_and_keeps_what_is_there(capsys, tmp_path):
    command = [
        "calibrate",
        "lab",
        "davis346",
        "--out",
        tmp_path / "o",
        "--roi",
        "8x8",
        "--frames",
        "8",
        "--trials",
        "4",
    ]
    status, out, _ = call(capsys, *command)
    assert status == 0 and "evs_noise_rate.npz" in out and "evs_s_curve.npz" in out
    assert out.count("\n") == 5 and "evs_static" not in out
    assert "exists; give another name" in fails(capsys, *command)
    assert "trials is 3; expected 4 to 65535" in fails(capsys, *command[:-1], "3", "--overwrite")


def test_isp_develops_a_recording(capsys, tmp_path):
    from PIL import Image

    recording = tmp_path / "rec"
    status, _, _ = call(capsys, "simulate", "colorchecker", "--sensor", "eiger", "--roi", "96x64", "--out", recording)
    assert status == 0
    status, out, _ = call(capsys, "isp", recording)
    assert status == 0 and "rec-pictures" in out
    pictures = sorted((tmp_path / "rec-pictures").glob("*.png"))
    assert len(pictures) == 1 and Image.open(pictures[0]).size == (96, 64)
    assert "exists" in fails(capsys, "isp", recording)
    assert "not a recording" in fails(capsys, "isp", tmp_path)
    assert call(capsys, "isp", recording, "--no-denoise", "--out", tmp_path / "plain")[0] == 0
    steps = [
        json.loads((tmp_path / k / "isp.json").read_text())["pipeline"]["steps"] for k in ("rec-pictures", "plain")
    ]
    assert [len([s for s in some if s["step"] == "denoise"]) for some in steps] == [1, 0]
    smooth, plain = (np.asarray(Image.open(tmp_path / k / "000000.png")) for k in ("rec-pictures", "plain"))
    assert not np.array_equal(smooth, plain)
    assert "has no calibration" in fails(capsys, "isp", recording, "--calibration", "c.yaml", "--overwrite")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError("Unable to allocate 9 GiB"), "not enough memory (Unable to allocate 9 GiB); a smaller region"),
        (MemoryError(), "not enough memory; a smaller region"),
        (RuntimeError("jit_malloc(): out of memory! Could not allocate"), "not enough memory (jit_malloc(): out of"),
        (OSError(27, "File too large"), "a file cannot be written: File too large"),
        (OSError(27, "File too large", "x.h5"), "x.h5: File too large"),
    ],
)
def test_no_memory_and_limits_of_files_are_one_line(capsys, monkeypatch, tmp_path, error, told):
    """The error comes from within; one of printing has another name (above)."""
    from hesim_render.core import shipped

    code = compile("def fail(*_):\n    raise error", shipped.__file__, "exec")
    inside = {"error": error}
    exec(code, inside)
    monkeypatch.setattr("hesim_render.cli.commands.program", lambda: lambda **_: inside["fail"]())
    with pytest.raises(SystemExit) as end:
        cli.main(["info", "names"])
    assert end.value.code == 2 and capsys.readouterr().err.startswith(f"hesim-render: {told}")

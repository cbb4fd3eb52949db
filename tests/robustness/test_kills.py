"""Every command that writes, killed at random and at every step of its work on files.

Afterwards the old result stands there whole, or the new one; the next run succeeds and leaves nothing behind. Results
are told apart by their bytes: a run of one seed always gives the same ones.
"""

import hashlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import capture_sets
import numpy as np
import pytest
import recordings

from hesim_render.calibrate import read_calibration, read_maps
from hesim_render.core.output import check_target

HERE = Path(__file__).parent
PIXELS = ["--sensor", "reference-mono", "--roi", "16x16", "--duration", "0.02", "--out", "out", "--overwrite"]
#: name: (arguments of a run, what tells the new run from the old one, folder or file written, marker of a folder)
COMMANDS = {
    "view": (["view", "out"], None, "out", "recording.json"),
    "isp": (["isp", "rec", "--out", "out", "--overwrite"], ["--no-denoise"], "out", "isp.json"),
    "aps": (["calibrate", "aps", "set", "--out", "c.yaml", "--report", "r.html"], None, None, None),
    "evs": (["calibrate", "evs", "set", "--out", "c.yaml", "--report", "r.html"], None, None, None),
    "lab": (["calibrate", "lab", "reference-mono", "--out", "out", "--roi", "16x16", "--frames", "8", "--ticks",
             "500", "--dark-ms", "1,5", "--lit-ms", "1,5", "--overwrite"], ["--seed", "8"], "out", "capture.yaml"),
    "video": (["simulate", "v.npy", "--set", "fps=100", "--set", "transfer=srgb", *PIXELS], ["--seed", "8"], "out",
              "recording.json"),
    "frames": (["export", "rec", "--format", "tiff", "--out", "out", "--overwrite"], None, "out", "frames.json"),
    "events": (["export", "rec", "--format", "evt3", "--out", "out.raw", "--overwrite"], None, "out.raw", None),
    "import": (["import", "given.h5", "--out", "out.h5", "--overwrite"], None, "out.h5", None),
    "cube": (["cube", "flat-field", "--sensor", "reference-mono", "--roi", "8x8", "--samples", "16", "--out", "out.exr",
              "--overwrite"], ["--seed", "8"], "out.exr", None),
    "simulate": (["simulate", "flat-field", *PIXELS], ["--seed", "8"], "out", "recording.json"),
    "rerun": (["simulate", "rec", "--out", "out", "--overwrite"], None, "out", "recording.json"),
    "expose": (["simulate", "cube.npy", "--set", "wavelength_nm=400:700:10", "--set", "beyond=hold", "--set",
                "illuminance_lux=500", *PIXELS], ["--seed", "8"],
               "out", "recording.json"),
    "study": (["study", "small.yaml", "--out", "out", "--overwrite"], None, "out", "results.json"),
    "measure": (["measure", "mtf", "rec", "--out", "out.csv", "--overwrite"], None, "out.csv", None),
    "describe": (["info", "reference-mono", "--out", "out.png", "--overwrite"], None, "out.png", None),
    "new": (["new", "out.yaml", "--overwrite"], None, "out.yaml", None),
}  # fmt: skip


STUDY = (
    "schema_version: 1\nname: x\ndescription: d\nsensors: [reference-bayer]\npalette: dyes\nfilter_sets: [rggb, rccb]\n"
    "surfaces: [colorchecker]\nilluminants: [D65]\nilluminance_lux: [20]\nfigures: [colour, noise]\n"
)


def prepare(name, folder):
    if name == "view":
        recordings.make("eiger", folder / "out", width=32, height=32, duration_us=60_000)
    elif name in ("isp", "frames", "events"):
        recordings.make("eiger", folder / "rec", width=32, height=32, duration_us=60_000)
    elif name == "import":
        recordings.make("eiger", folder / "rec", width=32, height=32, duration_us=60_000)
        (folder / "rec" / "events.h5").rename(folder / "given.h5")
    elif name == "aps":
        capture_sets.write_frames(folder / "set", size=32, frames=8)
    elif name == "evs":
        capture_sets.write_events(folder / "set", size=32, trials=20000)
    elif name == "rerun":
        finish(folder, ["simulate", "flat-field", *PIXELS[:-2], "rec"])
    elif name == "measure":
        finish(
            folder,
            [
                "simulate",
                "slanted-edge",
                "--sensor",
                "reference-mono",
                "--roi",
                "64x64",
                "--samples",
                "16",
                "--duration",
                "0.02",
                "--set",
                "light.illuminance_lux=300",
                "--out",
                "rec",
            ],
        )
    elif name == "expose":
        np.save(folder / "cube.npy", np.full((16, 16, 31), 0.3, np.float32))
    elif name == "study":
        (folder / "small.yaml").write_text(STUDY)
    elif name == "video":
        np.save(folder / "v.npy", np.full((4, 16, 16), 128, np.uint8))


def start(folder, arguments, step=None, side="before", exchange=True, how=("-m", "hesim_render.cli")):
    if step is not None:
        how = [HERE / "killed.py", step, side, "yes" if exchange else "no"]
    return subprocess.Popen(
        [str(part) for part in [sys.executable, *how, *arguments]], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def finish(folder, arguments):
    child = start(folder, arguments)
    out, err = child.communicate(timeout=120)
    assert child.returncode == 0, err + out
    return out


def files_in(folder):
    """Relative paths of all files, hidden ones too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def digest(name, folder):
    """Of the whole result, which must be readable."""
    target = COMMANDS[name][2]
    found = hashlib.sha256()
    if target is None:
        data = read_calibration(folder / "c.yaml")
        maps = read_maps(folder / "c.yaml", name, data)  # checks that they are the calibration's own
        assert maps
        found.update((folder / "c.yaml").read_bytes())
        return found.hexdigest()
    if COMMANDS[name][3] is None:
        return hashlib.sha256((folder / target).read_bytes()).hexdigest()
    for path in files_in(folder / target):
        if name == "view" and ".partial" in path:
            continue  # in the recording itself; the next run removes it
        found.update(path.encode() + (folder / target / path).read_bytes())
    return found.hexdigest()


class Trial:
    """One command in a folder that holds the result of an earlier run of it."""

    def __init__(self, name, folder):
        self.name, self.folder = name, folder
        self.arguments, other, self.target, self.marker = COMMANDS[name]
        folder.mkdir()
        prepare(name, folder)
        known = []
        began = time.monotonic()
        for arguments in ([*self.arguments, *(other or [])], self.arguments):
            finish(folder, arguments)
            known.append(digest(name, folder))
        self.seconds = (time.monotonic() - began) / 2
        self.known = set(known)
        self.whole = self.names()
        self.before = [*self.arguments, *(other or [])]
        self.kills = 0

    def names(self):
        """Files of a finished run; the hash in the name of a map file is not compared."""
        return {re.sub(r"-[0-9a-f]{12}\.npz", ".npz", path) for path in files_in(self.folder)}

    def check(self, child):
        """What a killed run has left is whole, once the next run has put back what was moved away."""
        _, err = child.communicate(timeout=60)
        assert "Traceback" not in err, err
        if child.returncode != 0:
            self.kills += 1
        if self.marker is not None:
            check_target(self.folder / self.target, self.marker, overwrite=True)
        assert digest(self.name, self.folder) in self.known
        return child.returncode

    def end(self):
        finish(self.folder, self.arguments)
        assert self.names() == self.whole
        assert digest(self.name, self.folder) in self.known
        shutil.rmtree(self.folder)


def kill_at_every_step(trial, exchange=True, most=12):
    """From the first step until a run has not as many."""
    for step in range(1, most + 1):
        for side in ("before", "after") if exchange else ("after",):
            child = start(trial.folder, trial.before if step % 2 else trial.arguments, step, side, exchange)
            if trial.check(child) == 0:
                return
            assert child.returncode == -signal.SIGKILL


def kill_at_random(trial, times, seed):
    """Until so many runs did not end by themselves; a run that is faster than expected is no kill."""
    rng, wanted = random.Random(seed), trial.kills + times
    for k in range(3 * times):
        if trial.kills == wanted:
            return
        child = start(trial.folder, trial.before if k % 2 else trial.arguments)
        time.sleep(rng.uniform(0.1, 1.0) * trial.seconds)
        number = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
        child.send_signal(number)
        status = trial.check(child)
        # 130 is an interrupted command. CPython ends by SIGINT itself, which shells call 130 as well, where the
        # interrupt came up through code that an extension runs; before we have handlers the signal itself ends it.
        assert status in (0, 130, -signal.SIGINT, -number), status


@pytest.mark.slow
def test_view_killed_at_every_step(tmp_path):
    trial = Trial("view", tmp_path / "view")
    kill_at_every_step(trial, most=2)
    trial.end()


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_loses_nothing(name, tmp_path):
    trial = Trial(name, tmp_path / name)
    kill_at_every_step(trial)
    at_steps = trial.kills
    kill_at_random(trial, 12, seed=sum(map(ord, name)))
    if trial.marker is not None and name != "view":
        kill_at_every_step(trial, exchange=False)
    # of all commands more than 100 kills; a single file appears in one step
    print(f"{name}: {at_steps} kills at steps, {trial.kills} in all")
    is_file = trial.marker is None and trial.target is not None
    assert at_steps >= (2 if is_file else 4) and trial.kills >= (14 if is_file else 16)
    trial.end()


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_limit_on_the_size_of_files_is_one_line(name, tmp_path):
    """``ulimit -f``: a write beyond it fails with another error than a full disk."""
    import resource

    prepare(name, tmp_path)
    arguments = COMMANDS[name][0]
    for limit in (0, 3000, 40_000):
        done = subprocess.run(
            [sys.executable, "-m", "hesim_render.cli", *map(str, arguments)], cwd=tmp_path, capture_output=True,
            text=True, env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
            preexec_fn=lambda limit=limit: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )  # fmt: skip
        told = [line for line in done.stderr.splitlines() if not line.startswith("jit_")]
        assert done.returncode in (0, 2) and "Traceback" not in done.stderr, done.stderr
        assert (done.returncode == 2) == any("cannot be written" in line for line in told), told
        assert not any(".partial" in line and "EXR" not in line and "image file" not in line for line in told), told


def ended_twice(tmp_path, command, run, given, number, more_bytes, how=("-m", "hesim_render.cli")):
    """Ended twice by a signal, a command goes on, and ends with the bytes of one that ran through (`whole`).

    Each time it is ended when its journal has grown by `more_bytes`. `run` is the command without its target.
    """
    out = tmp_path / ("r/recording" if command == "run" else "out")
    journal = out.parent / f".{out.name}.unfinished"
    before = 0
    for _ in range(2):
        child = start(tmp_path, given, how=how)
        while child.poll() is None and not (journal.is_file() and journal.stat().st_size > before + more_bytes):
            time.sleep(0.01)
        child.send_signal(number)
        _, err = child.communicate(timeout=60)
        assert child.returncode in (130, -number) and "Traceback" not in err, err
        assert not out.exists() and journal.stat().st_size > before
        before = journal.stat().st_size
    kept = journal.read_bytes()
    refused = start(tmp_path, [*run, "--seed", "8", "--out", out])
    assert "the interrupted run at this place differs in seed" in refused.communicate(timeout=60)[1]
    assert refused.returncode == 2 and journal.read_bytes() == kept
    finish(tmp_path, given)
    assert files_in(out) == files_in(tmp_path / "whole") and not journal.exists()
    for path in files_in(out):
        assert (out / path).read_bytes() == (tmp_path / "whole" / path).read_bytes(), path


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("command", ["simulate", "rerun", "run"])
def test_a_killed_run_goes_on(command, number, tmp_path):
    """Ended twice while it renders, it ends with the bytes of one that ran through, and traces only what is missing."""
    run = ["simulate", "rotating-star", "--sensor", "gen2", "--roi", "96x64", "--duration", "0.02"]
    given = {
        "simulate": [*run, "--out", "out"],
        "rerun": ["simulate", "whole", "--out", "out"],
        "run": ["simulate", "r.yaml", "--out", "r"],
    }[command]
    (tmp_path / "r.yaml").write_text(
        "schema_version: 1\nname: r\nscene: rotating-star\nsensor: gen2\nroi: 96x64\nduration_s: 0.02\n"
    )
    finish(tmp_path, [*run, "--out", "whole"])
    ended_twice(tmp_path, command, run, given, number, 50_000)


#: A run of a video is kept from its begin, and in short parts.
SHORT_PARTS = (
    "import hesim_render.capture.simulate_video as video; video._LONG_S, video._PART_S = 0.0, 0.1; "
    "from hesim_render.cli import main; main()"
)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.parametrize("command", ["video", "run"])
def test_a_killed_video_goes_on(command, number, tmp_path):
    """Ended twice, it ends with the bytes of one that ran through without a journal."""
    pictures = np.random.default_rng(1).integers(0, 256, (300, 48, 64, 1), np.uint8).repeat(4, 1).repeat(4, 2)
    np.save(tmp_path / "v.npy", pictures.repeat(3, 3))
    run = [
        "simulate",
        "v.npy",
        "--set",
        "fps=100",
        "--set",
        "transfer=srgb",
        "--set",
        "primaries=bt709",
        "--sensor",
        "gen2",
    ]
    run += ["--roi", "192x128"]
    (tmp_path / "r.yaml").write_text(
        "schema_version: 1\nname: r\nvideo: {file: v.npy, options: {fps: 100, transfer: srgb, primaries: bt709}}\n"
        "sensor: gen2\nroi: 192x128\n"
    )
    given = [*run, "--out", "out"] if command == "video" else ["simulate", "r.yaml", "--out", "r"]
    finish(tmp_path, [*run, "--out", "whole"])
    ended_twice(tmp_path, command, run, given, number, 500_000, how=("-c", SHORT_PARTS))


@pytest.mark.slow
def test_a_killed_sweep_goes_on(tmp_path):
    """Started again after each of ten kills, it ends with the bytes of one that ran through."""
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "s.yaml").write_text(
            "schema_version: 1\nname: x\ndescription: d\nscenes: [flat-field]\nsensors: [reference-mono]\nroi: 16x16\n"
            "duration_s: 0.02\nvary:\n  light.illuminance_lux: [1, 10, 100]\nseeds: [1, 2]\nmetrics: [electrons]\n"
        )
    arguments = ["study", "s.yaml", "--out", "out"]
    began = time.monotonic()
    finish(tmp_path / "whole", arguments)
    seconds, rng, killed = time.monotonic() - began, random.Random(5), 0
    for _ in range(10):
        child = start(tmp_path / "killed", arguments)
        time.sleep(rng.uniform(0.2, 0.9) * seconds)
        child.send_signal(signal.SIGKILL)
        _, err = child.communicate(timeout=60)
        assert "Traceback" not in err
        killed += child.returncode == -signal.SIGKILL
    finish(tmp_path / "killed", arguments)
    whole, again = (tmp_path / name / "out" for name in ("whole", "killed"))
    assert killed >= 3
    assert files_in(again) == files_in(whole)
    for path in files_in(whole):
        assert (again / path).read_bytes() == (whole / path).read_bytes(), path

"""Results appear whole or not at all, replace what is there in one step, and nothing that was not asked for."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import capture_sets
import numpy as np
import pytest
import recordings

from hesim_render import cli
from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps
from hesim_render.core import output
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.core.hdf5 import Disk
from hesim_render.core.output import OutputFolder, check_target, discard_unfinished, output_errors, replacing

KILLED = Path(__file__).parents[1] / "robustness" / "killed.py"


def write(folder, text, overwrite=True):
    made = OutputFolder(folder, "marker", overwrite)
    (made.path / "marker").write_text(text)
    return made


def text_of(folder):
    assert [path.name for path in folder.iterdir()] == ["marker"]
    return (folder / "marker").read_text()


@pytest.fixture(params=["exchange", "no exchange"])
def exchange(request, monkeypatch):
    """File systems that can exchange two folders in one step, and those that cannot."""
    if request.param == "no exchange":
        monkeypatch.setattr(output, "_exchange", lambda *_: False)
    return request.param == "exchange"


def test_a_folder_is_replaced_and_nothing_stays(tmp_path, exchange):
    for text in ("one", "two", "three"):
        write(tmp_path / "r", text).commit()
        assert text_of(tmp_path / "r") == text
        assert [path.name for path in tmp_path.iterdir()] == ["r"]
    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty", "x", overwrite=False).commit()
    assert text_of(tmp_path / "empty") == "x"


def test_folders_change_places_in_one_step(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    (tmp_path / "a" / "x").touch()
    assert output._exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b" / "x").exists() and not (tmp_path / "a" / "x").exists()
    assert not output._exchange(tmp_path / "a", tmp_path / "missing")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(5, "Input/output error")])
@pytest.mark.parametrize("at", [1, 2])
@pytest.mark.parametrize("done", [False, True])
def test_an_interrupt_at_any_rename_leaves_the_old_or_the_new(tmp_path, monkeypatch, error, at, done):
    """Where folders cannot be exchanged there are two renames; each may fail before or after it has been done."""
    monkeypatch.setattr(output, "_exchange", lambda *_: False)
    rename, count = os.rename, 0
    write(tmp_path / "r", "old").commit()
    made = write(tmp_path / "r", "new")

    def failing(*paths):
        nonlocal count
        count += 1
        if count != at or done:
            rename(*paths)
        if count == at:
            raise error

    monkeypatch.setattr(os, "rename", failing)
    with pytest.raises((KeyboardInterrupt, OutputError)):
        made.commit()
    made.discard()
    discard_unfinished()
    assert text_of(tmp_path / "r") == ("new" if at == 2 and done else "old")
    assert [path.name for path in tmp_path.iterdir()] == ["r"]


@pytest.mark.parametrize("can", ["yes", pytest.param("no", marks=pytest.mark.slow)])
def test_killed_at_any_step_of_a_commit(tmp_path, can):
    """The next run puts right what is left; before it the old folder or the new one is there, unless neither could
    be in one step."""
    code = """
import os, sys, runpy
sys.path.insert(0, sys.argv[1])
import hesim_render.cli
from hesim_render.core.output import OutputFolder
def run(arguments):
    made = OutputFolder("r", "marker", True)
    with open(made.path / "marker", "w") as stream: stream.write("new")
    made.commit()
hesim_render.cli.main = run
import killed
killed.main(int(sys.argv[2]), sys.argv[3], sys.argv[4], [])
"""
    seen = set()
    for step in range(1, 20):
        for side in ("before", "after"):
            write(tmp_path / "r", "old").commit()
            command = [sys.executable, "-c", code, KILLED.parent, str(step), side, can]
            child = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
            assert child.returncode in (0, -signal.SIGKILL), child.stderr
            if can == "yes":
                assert text_of(tmp_path / "r") in ("old", "new")
            check_target(tmp_path / "r", "marker", overwrite=True)
            seen.add(text_of(tmp_path / "r"))
            assert [path.name for path in tmp_path.iterdir()] == ["r"]
        if child.returncode == 0:
            break
    else:
        raise AssertionError("more steps than there are")
    assert seen == {"old", "new"} and step > 3


def test_leftovers_of_others_who_live_are_theirs(tmp_path):
    other = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        prefix = output._prefix(tmp_path / "r")
        alive, dead, old = (tmp_path / f"{prefix}{name}" for name in (f"{other.pid}.partial", "4999999.partial", "x"))
        for path in (alive, dead, old):
            path.mkdir()
        write(tmp_path / "r", "x").commit()
        assert alive.exists() and old.exists() and not dead.exists()
    finally:
        other.kill()
        other.wait()


def test_names_that_no_file_system_takes(tmp_path):
    for name in ("a" * 256, "ä" * 128):
        with pytest.raises(OutputError, match="too long"):
            check_target(tmp_path / name, "marker")
    for name in ("a" * 255, "ä" * 127, "a" * 240 + "b", "a" * 240 + "c"):
        write(tmp_path / name, name).commit()
        assert text_of(tmp_path / name) == name
    with pytest.raises(OutputError, match="cannot be written"):
        check_target(tmp_path / "/".join(["a" * 200] * 30), "marker")


def test_a_link_is_replaced_not_followed(tmp_path):
    (tmp_path / "precious").write_text("x")
    (tmp_path / "link").symlink_to("precious")
    with replacing(tmp_path / "link") as temporary:
        temporary.write_text("y")
    assert (tmp_path / "precious").read_text() == "x" and (tmp_path / "link").read_text() == "y"
    assert not (tmp_path / "link").is_symlink()
    with pytest.raises(ZeroDivisionError), replacing(tmp_path / "link") as temporary:
        temporary.write_text("half")
        raise ZeroDivisionError
    assert (tmp_path / "link").read_text() == "y" and sorted(p.name for p in tmp_path.iterdir()) == ["link", "precious"]


def test_view_writes_over_no_other_file(tmp_path, capsys):
    recordings.make("eiger", tmp_path / "r", width=32, height=32, duration_us=60_000)
    (tmp_path / "precious").write_text("x")
    for name in ("preview.png", "preview.dng"):
        (tmp_path / "r" / name).unlink()
        (tmp_path / "r" / name).symlink_to(tmp_path / "precious")
    with pytest.raises(SystemExit) as end:
        cli.main(["view", str(tmp_path / "r")])
    assert end.value.code == 0 and (tmp_path / "precious").read_text() == "x"
    assert not (tmp_path / "r" / "preview.png").is_symlink()
    assert not [path for path in (tmp_path / "r").iterdir() if path.name.startswith(".")]
    capsys.readouterr()


def test_a_full_disk_is_called_so(tmp_path):
    """NumPy says of a write that was cut short only how many items it had."""
    with pytest.raises(OutputError, match="no space left") as caught, output_errors(tmp_path):
        raise OSError("2048 requested and 1016 written")
    assert "requested" not in str(caught.value)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_numpys_own_words_for_a_full_disk():
    with pytest.raises(OSError) as caught, open("/dev/full", "wb", buffering=0) as stream:
        np.zeros(1 << 20).tofile(stream)
    assert caught.value.errno == 28 or output._CUT_SHORT.fullmatch(str(caught.value))


# ---- calibrations -----------------------------------------------------------------------------------


@pytest.fixture
def captures(tmp_path):
    capture_sets.write_frames(tmp_path / "set", size=16, frames=8)
    return tmp_path


def names(folder):
    return sorted(re.sub(r"-[0-9a-f]{12}\.npz", "-HASH.npz", path.name) for path in folder.iterdir())


def test_a_calibration_names_the_hash_of_its_maps(captures):
    calibrate_aps(captures / "set", captures / "c.yaml")
    about = read_calibration(captures / "c.yaml")["aps"]["maps"]
    file = captures / about["file"]
    whole = file.read_bytes()
    read_maps(captures / "c.yaml", "aps")
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(SpecError, match="is not the one that"):
        read_maps(captures / "c.yaml", "aps")


def test_a_calibration_and_its_maps_are_one_commit(captures, monkeypatch):
    """Interrupted before the calibration gets its name, the old one and its maps are there and fit each other."""
    calibrate_aps(captures / "set", captures / "c.yaml")
    before, maps = (captures / "c.yaml").read_bytes(), read_maps(captures / "c.yaml", "aps")
    capture_sets.write_frames(captures / "set", size=16, frames=8, seed=6)
    replace = os.replace

    def interrupted(source, target):
        if str(target).endswith("c.yaml"):
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        calibrate_aps(captures / "set", captures / "c.yaml")
    monkeypatch.setattr(os, "replace", replace)
    assert (captures / "c.yaml").read_bytes() == before
    np.testing.assert_array_equal(read_maps(captures / "c.yaml", "aps")["n_blc"], maps["n_blc"])
    assert names(captures) == ["c.yaml", "c_aps_maps-HASH.npz", "set"]
    calibrate_aps(captures / "set", captures / "c.yaml")
    assert names(captures) == ["c.yaml", "c_aps_maps-HASH.npz", "set"]
    assert not np.array_equal(read_maps(captures / "c.yaml", "aps")["n_blc"], maps["n_blc"])


def test_maps_that_another_calibration_names_are_kept(captures):
    calibrate_aps(captures / "set", captures / "c.yaml")
    (captures / "copy.yaml").write_bytes((captures / "c.yaml").read_bytes())
    capture_sets.write_frames(captures / "set", size=16, frames=8, seed=6)
    calibrate_aps(captures / "set", captures / "c.yaml")
    for name in ("c.yaml", "copy.yaml"):
        read_maps(captures / name, "aps")
    assert names(captures).count("c_aps_maps-HASH.npz") == 2


@pytest.mark.slow
def test_a_report_takes_no_other_files_place(captures, monkeypatch):
    """All of it is found out before the work, which is not begun."""
    out, report = captures / "c.yaml", captures / "r.html"
    calibrate_aps(captures / "set", out, report)
    first = report.read_bytes()
    calibrate_aps(captures / "set", out, report)  # its own is brought up to date
    assert report.read_bytes() == first
    (captures / "thesis.html").write_text("x")
    (captures / "link.html").symlink_to("thesis.html")
    (captures / "thesis.yaml").write_text("x")
    monkeypatch.setattr("hesim_render.calibrate.aps.calibration._read", lambda *_: pytest.fail("the work was begun"))
    for given, message in (
        ("thesis.html", "is no report"), ("link.html", "is no report"), ("c.yaml", r"ends in \.html"),
        (".", "is a folder"), ("thesis.html/r.html", "is not a folder"), ("a" * 300, "too long"),
    ):  # fmt: skip
        for overwrite in (False, True):
            with pytest.raises(OutputError, match=message):
                calibrate_aps(captures / "set", out, captures / given, overwrite=overwrite)
    with pytest.raises(OutputError, match=r"is of another calibration.*--overwrite"):
        calibrate_aps(captures / "set", captures / "other.yaml", report)
    for given, kind in (("set", OutputError), ("thesis.html", OutputError), ("thesis.yaml", SpecError)):
        with pytest.raises(kind):
            calibrate_aps(captures / "set", captures / given)
    assert (captures / "thesis.html").read_text() == "x" and report.read_bytes() == first
    assert not (captures / "other.yaml").exists()
    monkeypatch.undo()
    calibrate_aps(captures / "set", captures / "other.yaml", report, overwrite=True)
    assert report.read_bytes() != first


def test_events_ask_as_frames_do(tmp_path):
    capture_sets.write_events(tmp_path / "set", size=16, trials=20000)
    (tmp_path / "thesis.html").write_text("x")
    with pytest.raises(OutputError, match="is no report"):
        calibrate_evs(tmp_path / "set", tmp_path / "c.yaml", tmp_path / "thesis.html", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "thesis.html"]


#: Runs a command line that stops between reading the old calibration and replacing it, until ``go`` is there.
SLOW = """
import sys, time
from pathlib import Path
from hesim_render.calibrate import result
made = result._yaml
def slowly():
    Path("writing").touch()
    while not Path("go").exists():
        time.sleep(0.02)
    return made()
result._yaml = slowly
from hesim_render.cli import main
main(sys.argv[1:])
"""


def both_sets(folder):
    capture_sets.write_frames(folder / "frames", size=16, frames=8)
    capture_sets.write_events(folder / "events", size=16, trials=20000)


def slow_run(folder, *arguments):
    """A run in another process that is about to replace ``c.yaml``."""
    child = subprocess.Popen(
        [sys.executable, "-c", SLOW, *arguments], cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )  # fmt: skip
    end = time.monotonic() + 60
    while not (folder / "writing").exists() and time.monotonic() < end:
        time.sleep(0.02)
    assert child.poll() is None
    return child


@pytest.mark.slow
def test_two_runs_into_one_calibration_lose_no_section(tmp_path, monkeypatch):
    """One process has read the old content and not yet replaced it when the other one comes to write."""
    both_sets(tmp_path)
    child, sleep = slow_run(tmp_path, "calibrate", "evs", "events", "--out", "c.yaml"), time.sleep

    def let_it_go_on(seconds):
        """Only once this process waits for the other one."""
        (tmp_path / "go").touch()
        sleep(seconds)

    monkeypatch.setattr(output.time, "sleep", let_it_go_on)
    calibrate_aps(tmp_path / "frames", tmp_path / "c.yaml", tmp_path / "aps.html")
    _, err = child.communicate(timeout=60)
    assert child.returncode == 0, err
    data = read_calibration(tmp_path / "c.yaml")
    assert {"aps", "evs"} <= set(data)
    for section in ("aps", "evs"):
        assert read_maps(tmp_path / "c.yaml", section, data)
    found = [name for name in names(tmp_path) if name not in ("events", "frames", "go", "writing")]
    assert found == ["aps.html", "c.yaml", "c_aps_maps-HASH.npz", "c_evs_maps-HASH.npz"]


@pytest.mark.slow
def test_a_run_that_waits_too_long_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(output, "_PATIENCE_S", 0.3)
    both_sets(tmp_path)
    child = slow_run(tmp_path, "calibrate", "evs", "events", "--out", "c.yaml")
    try:
        with pytest.raises(OutputError, match=r"another run has been writing its results there for 0\.3 s"):
            calibrate_aps(tmp_path / "frames", tmp_path / "c.yaml")
    finally:
        child.kill()
        child.communicate()
    calibrate_aps(tmp_path / "frames", tmp_path / "c.yaml")  # the lock ended with its process
    found = [name for name in names(tmp_path) if name not in ("events", "frames", "writing")]
    assert "c.yaml" in found and not any("partial" in name for name in found)


def test_file_systems_without_locks_are_written_to(tmp_path, monkeypatch):
    def none(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(output.fcntl, "flock", none)
    with output.alone_in(tmp_path / "new"):
        assert (tmp_path / "new").is_dir()


def test_an_error_names_the_place_that_a_file_was_to_have(tmp_path):
    """And no temporary name, also where a file is written within an unfinished folder."""
    folder = OutputFolder(tmp_path / "out", "marker")
    told = rf"^{tmp_path}/out/results\.csv: cannot be written \(File too large\)$"
    with pytest.raises(OutputError, match=told), replacing(folder.path / "results.csv"):
        raise OSError(27, "File too large")
    folder.discard()


def test_what_lies_behind_the_end_of_a_file_is_read_as_zeros(tmp_path):
    """HDF5 asks for more than there is after an error, which it must not see."""
    disk = Disk(tmp_path / "f")
    disk.write(b"abcde")
    disk.seek(2)
    found = bytearray(b"x" * 7)
    assert disk.readinto(found) == 7 and bytes(found) == b"cde" + bytes(4)
    disk.close()


def test_a_process_is_alive_elsewhere_if_another_one_has_its_number():
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert output._is_alive_elsewhere(child.pid) and not output._is_alive_elsewhere(os.getpid())
    child.communicate(b"\n")
    assert not output._is_alive_elsewhere(child.pid)


def test_two_folders_are_exchanged_in_one_step(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert output._exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / "b").exists() and (tmp_path / "b" / "a").exists()
    assert not output._exchange(tmp_path / "a", tmp_path / "c")

"""Damaged files of every kind: each costs one clear error, or is read. No traceback, no hang, no crash, no flood of
memory. The mutations are a pure function of their numbers: a failure names what to run again."""

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from pathlib import Path

import foreign_folder
import pytest

HERE = Path(__file__).parent
#: A try takes 0.05 to 0.5 s; more processor time than this is a hang, and so is to use none for as long as `STILL_S`.
#: The time of a clock says nothing: it depends on what else the machine does.
HANG_S, STILL_S, NONE_S = 20, 60, 0.5
#: Tries of each subject in the whole run, 6010 in all.
WHOLE = {
    "recording": 1300, "developed": 60, "aps": 250, "evs": 200, "trials": 150, "calibration": 240, "sensor": 300,
    "scene": 250,
    "mitsuba": 300, "pictures": 200, "array": 200, "video": 200, "isp": 300,
    "targets": 250, "exchange": 300, "labelled": 150,
    "surfaces": 200, "lens": 250, "studies": 250, "cubes": 200, "benchmark": 100,
    "built": 150, "shards": 60, "run": 150,
}  # fmt: skip
#: Interpreter, libraries and small inputs take 0.4 GB; no damage may ask for gigabytes.
PEAK_MB = 1500


def processor_s(session):
    """Processor time of all processes of a session, and of those of them that have ended, s."""
    ticks = 0
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            fields = file.read_text().rpartition(") ")[2].split()  # from the state on: proc(5)
            ticks += sum(map(int, fields[11:15])) if int(fields[3]) == session else 0
    return ticks / os.sysconf("SC_CLK_TCK")


def wait_for_line(child, ready, limit_s):
    """The processor time until the child has written something or ended, s; None if it hangs."""
    begin = latest = processor_s(child.pid)
    moved = time.monotonic()
    while not ready.select(0.5):
        now = processor_s(child.pid)
        if now - latest > NONE_S:
            latest, moved = now, time.monotonic()
        if now - begin > limit_s or time.monotonic() - moved > STILL_S:
            return None
    return max(0.0, processor_s(child.pid) - begin)


def lines_of(*parts):
    """What fuzz.py prints; its end, of itself or by us, is the last line."""
    child = subprocess.Popen(
        [sys.executable, HERE / "fuzz.py", *parts], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": f"{HERE.parents[1]}:{HERE.parent / 'support'}"}, start_new_session=True,
    )  # fmt: skip
    try:
        with selectors.DefaultSelector() as ready:
            ready.register(child.stdout, selectors.EVENT_READ)
            while True:
                # the first try of a subject waits for imports and valid files
                seconds = wait_for_line(child, ready, HANG_S + 40)
                if seconds is None:
                    yield {"end": "hang"}
                    return
                line = child.stdout.readline()
                if not line:
                    break
                yield json.loads(line) | {"seconds": seconds}
        if child.wait(timeout=30):
            yield {"end": f"status {child.returncode}", "error": child.stderr.read().decode()[-2000:]}
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.communicate()


def check(parts, wanted):
    """Run, and name what broke; a subject goes on behind a hang or a crash."""
    bad, ends, waiting = [], {"fine": 0, "refused": 0}, list(parts)
    while waiting:
        subject, first, last = waiting.pop(0).split(":")
        place = int(first)
        for line in lines_of(f"{subject}:{first}:{last}"):
            if line["end"] in ends:
                ends[line["end"]] += 1
            elif line["end"] == "done":
                if line["peak_mb"] > PEAK_MB:
                    bad.append({"subject": subject, "first": first, "last": last, **line})
                continue
            else:
                bad.append({"subject": subject, "seed": place, **line})
                if "seed" not in line and place + 1 < int(last):  # it is gone
                    waiting.insert(0, f"{subject}:{place + 1}:{last}")
            if line.get("seconds", 0) > HANG_S and place > int(first):
                bad.append(line)
            place += 1
    assert not bad, "\n".join(map(str, bad[:20]))
    assert wanted is None or sum(ends.values()) == wanted
    return ends


@pytest.mark.slow
@pytest.mark.parametrize(("code", "hangs"), [
    ("import time; time.sleep(60)", True),
    ("while True: pass", True),
    ("import subprocess, sys; subprocess.run([sys.executable, '-c', 'while True: pass'])", True),
    ("import time; time.sleep(0.7); print('late')", False),
])  # fmt: skip
def test_a_hang_is_told_by_processor_time(code, hangs, monkeypatch):
    """Of what sleeps, of what never ends, and of its children."""
    monkeypatch.setattr("test_fuzz.STILL_S", 2 if hangs else 60)
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True)
    try:
        with selectors.DefaultSelector() as ready:
            ready.register(child.stdout, selectors.EVENT_READ)
            assert (wait_for_line(child, ready, 0.6) is None) is hangs
    finally:
        os.killpg(child.pid, signal.SIGKILL)
        child.communicate()


def test_pipes_devices_and_folders_in_place_of_files():
    """Eight readers waited for a pipe without end; the file that is larger than memory is not read whole."""
    lines = list(lines_of("sensor/places:0:200", "isp/places:0:200", "array/places:0:200"))
    assert {line["end"] for line in lines} == {"fine", "refused", "done"}, lines
    assert sum(line["end"] == "refused" for line in lines) > 20 and lines[-1]["peak_mb"] < PEAK_MB


@pytest.mark.slow
@pytest.mark.parametrize("subject", WHOLE)
def test_what_stands_in_place_of_a_file(subject):
    check([f"{subject}/places:0:200"], None)


def test_a_working_folder_with_modules_of_a_stranger(tmp_path):
    """The command starts a child that probes LLVM; it is itself started as by its script, without the folder."""
    mark = foreign_folder.fill(tmp_path)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "hesim_render.cli", "info"], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(HERE.parents[1]), "XDG_CACHE_HOME": str(tmp_path / "cache")},
    )  # fmt: skip
    assert not mark.exists(), mark.read_text()
    assert done.returncode == 0, done.stderr


def test_some_damaged_files():
    parts = ["recording:0:60", "sensor:0:30", "isp:0:30", "array:0:20"]
    ended = {}
    for line in lines_of(*parts):
        ended.setdefault(line["end"], []).append(line)
    assert set(ended) == {"fine", "refused", "done"}, [v for k, v in ended.items() if k not in ("fine", "refused")]
    assert len(ended["fine"]) + len(ended["refused"]) == 140
    assert ended["done"][0]["peak_mb"] < PEAK_MB
    # most damage is noticed: what is not lies in a comment, a name, a margin of a file, or makes another valid value
    assert len(ended["refused"]) > 70


@pytest.mark.slow
@pytest.mark.parametrize("subject", WHOLE)
def test_damaged_files(subject):
    assert sum(WHOLE.values()) >= 3000
    check([f"{subject}:1000:{1000 + WHOLE[subject]}"], WHOLE[subject])

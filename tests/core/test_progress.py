"""How far a run has come: what remains, late runs, and where it is shown."""

import io
import os
import pty
import re
import subprocess
import sys
import threading
from types import ModuleType, SimpleNamespace

import pytest

import hesim_render as hr
from hesim_render.core import progress
from hesim_render.core.progress import Pace, ProgressReport, in_words, progress_report


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def test_what_remains_of_a_steady_run_is_what_remains():
    clock = Clock()
    pace = Pace(clock)
    assert pace.remaining_s is None and pace.describe() == "0 % of the run"
    pace.expect(200)
    assert pace.remaining_s == 200
    for done in (0.1, 0.3, 0.9):
        clock.now = 100 + 200 * done
        pace.move(done * 500, 500, "rays")
        assert pace.remaining_s == pytest.approx(200 * (1 - done))
    clock.now = 300
    pace.move(0, 10, "audit")  # another phase has a pace of its own
    clock.now = 302
    pace.move(1, 10, "audit")
    assert pace.remaining_s == pytest.approx(18)
    assert pace.describe() == "10 % of audit, about 18 s left"


def test_a_slow_first_step_does_not_count_for_the_whole_run():
    clock = Clock()
    pace = Pace(clock)
    pace.expect(60)
    pace.move(0, 100, "rays")
    clock.now += 6  # kernels are compiled, which comes once
    pace.move(2, 100, "rays")
    assert 54 < pace.remaining_s < 100  # by its pace alone 294


def test_a_run_of_twice_its_estimate_says_so_once():
    clock = Clock()
    pace = Pace(clock)
    pace.expect(10)
    clock.now += 19.9
    pace.move(3, 10, "rays")
    assert pace.late_note() is None
    clock.now += 0.2
    assert pace.late_note() == (
        "takes longer than its estimate: 20 s so far, estimated were 10 s; 30 % of rays, about 47 s left"
    )
    clock.now += 100
    assert pace.late_note() is None


def test_lengths_of_time_are_words():
    assert [in_words(s) for s in (0.2, 40, 300, 7200, 86400 * 3, 1e20)] == [
        "1 s", "40 s", "5 min", "2.0 h", "3.0 days", "3e+12 years",
    ]  # fmt: skip


def test_lines_come_now_and_then_where_there_is_no_terminal(monkeypatch):
    """Also while nothing reports: native code may take its time. The clock goes on once a line has been written."""
    monkeypatch.setattr(progress, "_REFRESH_S", 0.01)
    written, clock = threading.Semaphore(0), Clock()

    class Stream(io.StringIO):
        def flush(self):
            written.release()

    stream = Stream()
    report = ProgressReport(progress._Lines("star → gen2", stream), Pace(clock))
    report.expect(40)
    report(25, 100, "simulated µs")
    with report:
        for at_s in (31, 70, 90, 200):
            clock.now = 100 + at_s
            assert written.acquire(timeout=60)
    assert stream.getvalue().splitlines() == [
        "star → gen2: 25 % of simulated µs, about 2 min left, 31 s so far",
        "star → gen2: 25 % of simulated µs, about 4 min left, 70 s so far",
        "star → gen2: takes longer than its estimate: 2 min so far, estimated were 40 s; "
        "25 % of simulated µs, about 4 min left",
        "star → gen2: 25 % of simulated µs, about 10 min left, 3 min so far",
    ]


def test_a_short_run_is_silent_where_there_is_no_terminal():
    stream = io.StringIO()
    with progress_report("x", stream) as report:
        report(1, 2, "rays")
    assert stream.getvalue() == ""


def test_a_stream_that_nobody_reads_is_no_reason_to_stop():
    tried = []

    class Closed(io.StringIO):
        def write(self, text):
            tried.append(text)
            raise BrokenPipeError

    view = progress._Lines("x", Closed())
    view.say("still here")
    view.say("and here")
    assert tried == ["x: still here\n", "x: and here\n"]


#: Each phase ends when it has been shown.
_ON_A_TERMINAL = """
import threading
from hesim_render.core import progress
from hesim_render.core.progress import progress_report
from hesim_render.cli.terminal import say
progress._LEAST_LATE_S = 0.0
shown, late = threading.Event(), threading.Event()
show, tell = progress._Bar.show, progress._Bar.say
progress._Bar.show = lambda *given: (show(*given), shown.set())
progress._Bar.say = lambda *given: (tell(*given), late.set())
with progress_report("star") as report:
    report(1, 10, "rays")
    shown.wait()
    with report.paused():
        say("estimate: about 67 s")
    report.expect(0.2)
    report(5, 10, "rays")
    late.wait()
    shown.clear()
    shown.wait()
say("the end")
"""


def _on_a_terminal(code):
    """Lines that are on a terminal's screen when a program has ended, and all that was ever sent to it."""
    leader, follower = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    child = subprocess.Popen([sys.executable, "-c", code], stdout=follower, stderr=follower, env=environment)
    os.close(follower)
    sent = b""
    while True:
        try:
            part = os.read(leader, 65536)
        except OSError:
            break
        if not part:
            break
        sent += part
    assert child.wait(timeout=30) == 0
    text = sent.decode()
    screen, row, column = [""], 0, 0
    for piece in re.findall(r"\x1b\[[?\d;]*[A-Za-z]|\r|\n|[^\x1b\r\n]+", text):
        if piece == "\r":
            column = 0
        elif piece == "\n":
            row += 1
            screen += [""] * (row + 1 - len(screen))
        elif piece == "\x1b[2K":
            screen[row] = ""
        elif match := re.fullmatch(r"\x1b\[(\d*)A", piece):
            row = max(0, row - int(match[1] or 1))
        elif not piece.startswith("\x1b"):
            screen[row] = screen[row][:column].ljust(column) + piece + screen[row][column + len(piece) :]
            column += len(piece)
    return [line.rstrip() for line in screen if line.strip()], text


def test_on_a_terminal_the_estimate_has_a_line_of_its_own_and_the_bar_is_gone_in_the_end():
    screen, sent = _on_a_terminal(_ON_A_TERMINAL)
    assert [line for line in screen if not line.startswith("star: takes longer")] == ["estimate: about 67 s", "the end"]
    assert sum(line.startswith("star: takes longer than its estimate") for line in screen) == 1
    assert "star: rays" in sent and re.search(r"\d+ s left", sent) and " 50%" in sent


def test_a_notebook_shows_a_bar_without_being_asked(monkeypatch):
    shown = []
    fake, display = ModuleType("IPython"), ModuleType("IPython.display")
    fake.get_ipython = lambda: SimpleNamespace(kernel=object())
    display.HTML = str
    display.display = lambda text, display_id: shown.append(text) or SimpleNamespace(update=shown.append)
    monkeypatch.setitem(sys.modules, "IPython", fake)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setattr(progress, "_REFRESH_S", 0.02)
    run = dict(duration_s=0.002, samples=2)
    scene, sensor = hr.load_scene("rotating-star"), hr.load_sensor("reference-mono").crop(24, 16)
    hr.simulate(scene, sensor, **run)
    assert shown[0].startswith("<progress value='0.000'") and "rotating-star → reference-mono" in shown[0]
    assert len(shown) > 2 and shown[-1] == ""
    shown.clear()
    hr.simulate(scene, sensor, progress=False, **run)
    assert shown == []
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))  # a prompt, no notebook
    hr.simulate(scene, sensor, **run)
    assert shown == []


def test_simulate_tells_its_estimate_to_who_shows_it():
    view = SimpleNamespace(show=lambda pace: None, say=lambda text: None, close=lambda: None)
    seen = []
    with ProgressReport(view) as report:
        hr.simulate(
            hr.load_scene("flat-field"), hr.load_sensor("reference-mono").crop(16, 8), duration_s=0.002,
            progress=report, on_estimate=seen.append,
        )  # fmt: skip
    assert report.pace.estimate_s == seen[0].seconds

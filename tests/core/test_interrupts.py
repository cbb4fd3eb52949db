"""Ctrl-C: two seconds at most from anywhere in the command line, a KeyboardInterrupt in Python; nothing is left."""

import builtins
import math
import os
import random
import signal
import subprocess
import sys
import time

import pytest

from hesim_render.cli.exit_status import ExitStatus, Interrupts
from hesim_render.core.child import interrupts_held
from hesim_render.core.device import dr

#: A lock that is taken twice: native code that never comes back, and that no signal wakes.
_NEVER = """
import ctypes, sys
from hesim_render.recording import manifest
from hesim_render.cli import main
from hesim_render.core.output import OutputFolder
def never():
    folder = OutputFolder(sys.argv[1], "marker")
    (folder.path / "half").write_text("x")
    print("there", flush=True)
    lock, libc = ctypes.create_string_buffer(256), ctypes.CDLL(None)
    libc.pthread_mutex_lock(lock), libc.pthread_mutex_lock(lock)
manifest.software_versions = never
main(["info"])
"""
#: The run takes the interrupt at its next step, within Python or where native code comes back.
_IN_PYTHON = """
import hesim_render as hr
import sys, time
sensor, scene = hr.load_sensor("gen2").crop(256, 256), hr.load_scene("rotating-star")
def works(*_):
    if "there" not in said:
        said.append("there")
        print("there", flush=True)
said = []
try:
    hr.simulate(scene, sensor, duration_s=20, quality=2, progress=works)
except BaseException as error:
    print(type(error).__name__, flush=True)
"""


def _start(*command):
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # a test run in the background of a shell ignores SIGINT, and its children would too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _interrupt(child, number=signal.SIGINT):
    """Exit status, what it said, and how long it took from the signal."""
    begin = time.monotonic()
    os.kill(child.pid, number)
    out, err = child.communicate(timeout=60)
    return child.returncode, out, err, time.monotonic() - begin


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_native_code_that_never_returns_is_ended_and_cleaned_up_after(number, tmp_path):
    child = _start(sys.executable, "-c", _NEVER, str(tmp_path / "o"))
    assert child.stdout.readline() == "there\n" and len(list(tmp_path.iterdir())) == 1
    status, _, err, seconds = _interrupt(child, number)
    assert (status, err) == (ExitStatus.INTERRUPTED, "hesim-render: interrupted\n")
    assert seconds < 2.0 and list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_interrupt_inside_of_a_finaliser_ends_the_run_without_a_traceback(tmp_path):
    """Python cannot raise there: it would print the exception and go on."""
    lost = """
import os, signal, sys, time
from hesim_render.recording import manifest
from hesim_render.cli import main
class Finalised:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(10):
            pass
def versions():
    Finalised()
    print("there", flush=True)
    time.sleep(30)
manifest.software_versions = versions
main(["info"])
"""
    child = _start(sys.executable, "-c", lost)
    assert child.stdout.readline() == "there\n"  # it went on
    began = time.monotonic()
    _, err = child.communicate(timeout=60)
    assert (child.returncode, err) == (ExitStatus.INTERRUPTED, "hesim-render: interrupted\n")
    assert time.monotonic() - began < 2


def test_other_errors_of_finalisers_are_still_told(capsys, monkeypatch):
    class Broken:
        def __del__(self):
            raise ValueError("told")

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    with Interrupts():
        Broken()
    assert "ValueError: told" in capsys.readouterr().err and sys.unraisablehook is sys.__unraisablehook__


def test_python_gets_a_keyboard_interrupt_at_the_next_step():
    child = _start(sys.executable, "-c", _IN_PYTHON)
    assert child.stdout.readline() == "there\n"
    status, out, err, _ = _interrupt(child)
    assert (status, out, err) == (0, "KeyboardInterrupt\n", "")


@pytest.fixture
def python_handles_interrupts():
    """Where a shell started the tests in its background, they ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_waits_while_native_libraries_are_loaded(python_handles_interrupts):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    loaded = False
    with pytest.raises(KeyboardInterrupt), interrupts_held():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        loaded = True
    assert loaded
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_an_interrupt_waits_while_drjit_is_first_used(python_handles_interrupts, monkeypatch):
    plain, loaded = builtins.__import__, []

    def interrupted(name, *rest):
        if name == "drjit":
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            loaded.append(name)
        return plain(name, *rest)

    monkeypatch.setattr(builtins, "__import__", interrupted)
    fresh = type(dr)()
    with pytest.raises(KeyboardInterrupt):
        fresh.sum  # noqa: B018
    assert loaded == ["drjit"]
    monkeypatch.undo()
    assert fresh.pi == math.pi and "pi" in vars(fresh)  # looked up once


def test_handlers_are_put_back():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    wakeup = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wakeup)
    with Interrupts() as interrupts, pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    assert interrupts.happened
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.set_wakeup_fd(wakeup) == wakeup


def test_the_status_of_an_interrupt_does_not_depend_on_what_happens_at_the_end():
    """Clearing up may crash where native threads still run; here it does in any case."""
    code = (
        "import atexit, os, signal, sys, hesim_render.cli as cli\n"
        "cli._run = lambda *_: cli.ExitStatus.INTERRUPTED\n"
        "atexit.register(os.kill, os.getpid(), signal.SIGSEGV)\n"
        "print('written')\n"
        "cli.main()\n"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (child.returncode, child.stdout, child.stderr) == (
        ExitStatus.INTERRUPTED,
        "written\n",
        "hesim-render: interrupted\n",
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_a_command_ends_within_two_seconds_whenever_it_is_interrupted(seed, tmp_path):
    """While Python starts, Mitsuba loads, kernels compile or rays are traced: instants by a seeded generator."""
    run = random.Random(seed)
    scene = run.choice(["rotating-star", "camera-sweep", "cornell-box"])
    child = _start(
        sys.executable, "-m", "hesim_render.cli", "simulate", scene, "--sensor", "gen2", "--roi", "512x384",
        "--duration", "5", "--yes", "--out", str(tmp_path / "o"),
    )  # fmt: skip
    time.sleep(run.uniform(0.4, 12.0))
    status, _, err, seconds = _interrupt(child)
    assert status == ExitStatus.INTERRUPTED and err.endswith("hesim-render: interrupted\n") and "Traceback" not in err
    assert seconds < 2.0 and list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(24))
def test_python_gets_a_keyboard_interrupt_whenever_it_is_interrupted(seed):
    child = _start(sys.executable, "-c", _IN_PYTHON)
    assert child.stdout.readline() == "there\n"
    # most of them while Dr.Jit and Mitsuba are loaded
    time.sleep(random.Random(seed).choice([3.0, 3.0, 10.0]) * random.Random(seed + 1).random())
    status, out, err, _ = _interrupt(child)
    assert (status, out, err) == (0, "KeyboardInterrupt\n", "")

"""macOS on arm64, where Mitsuba and Dr.Jit have wheels as well: nothing is asked of a module that only Linux has.

No such machine ran these tests: they take from this one what macOS lacks.
"""

import ast
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "hesim_render"
#: Names of `os` and `signal` that CPython documents as not there on macOS.
LINUX_ONLY = {
    "os": {
        "copy_file_range", "eventfd", "fdatasync", "getrandom", "getresgid", "getresuid", "memfd_create", "pidfd_open",
        "pipe2", "posix_fadvise", "posix_fallocate", "sched_getaffinity", "sched_getscheduler", "sched_setaffinity",
        "sched_setscheduler", "setns", "setresgid", "setresuid", "splice", "unshare", "getxattr", "setxattr",
        "O_DIRECT", "O_NOATIME", "O_PATH", "O_TMPFILE", "MFD_CLOEXEC", "SCHED_BATCH", "POSIX_FADV_SEQUENTIAL",
    },
    "signal": {"SIGCLD", "SIGPOLL", "SIGPWR", "SIGRTMAX", "SIGRTMIN", "SIGSTKFLT", "sigtimedwait", "sigwaitinfo"},
}  # fmt: skip
MODULES = {"ossaudiodev", "spwd", "winreg", "msvcrt"}


def needless(tree):
    """Uses of such names outside of ``… if hasattr(…, name) else …``, and imports of such modules."""
    guarded = {
        id(node)
        for choice in ast.walk(tree)
        if isinstance(choice, ast.IfExp | ast.If) and "hasattr" in ast.unparse(choice.test)
        for node in ast.walk(choice)
    }
    for node in ast.walk(tree):
        if id(node) in guarded:
            continue
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in LINUX_ONLY.get(node.value.id, ()):
                yield f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)
        elif isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names if alias.name in LINUX_ONLY.get(str(node.module), ()))


def test_no_module_needs_what_macos_lacks():
    any_name = re.compile(r"\b(?:%s)\b" % "|".join([*MODULES, *LINUX_ONLY["os"], *LINUX_ONLY["signal"]]))
    texts = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    found = {
        path.relative_to(PACKAGE).as_posix(): names
        for path, text in texts.items()
        if any_name.search(text) and (names := list(needless(ast.parse(text))))
    }
    assert not found


def test_processors_are_counted_on_macos(monkeypatch):
    from hesim_render.core import bands

    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 8}, raising=False)
    assert bands.processors() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 7)
    assert bands.processors() == 7
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert bands.processors() == 1


@pytest.mark.slow
def test_every_module_is_imported_and_a_folder_is_written_without_what_linux_has(tmp_path):
    """In a process without these names, without /proc and without `renameat2`, which says that it is a Mac."""
    lacking = {kind: sorted(name for name in names if hasattr(eval(kind), name)) for kind, names in LINUX_ONLY.items()}
    assert "sched_getaffinity" in lacking["os"] and signal.SIGPWR
    code = f"""
import ctypes, importlib, os, pathlib, pkgutil, signal, sys
import colour, h5py, hdf5plugin, jinja2, matplotlib.pyplot, numpy, pydantic
import rich, ruamel.yaml, scipy.optimize, tifffile, typer
for module, names in (os, {lacking["os"]}), (signal, {lacking["signal"]}):
    for name in names:
        delattr(module, name)
sys.platform, os.uname = "darwin", lambda: os.uname_result(("Darwin", "mac", "24.0.0", "", "arm64"))
read = pathlib.Path.read_text
def without_proc(path, *rest, **more):
    if str(path).startswith("/proc/"):
        raise FileNotFoundError(path)
    return read(path, *rest, **more)
pathlib.Path.read_text = without_proc
library = ctypes.CDLL
class Without:
    def __getattr__(self, name):
        raise AttributeError(name)
ctypes.CDLL = lambda name, *rest, **more: Without() if name is None else library(name, *rest, **more)
import hesim_render
for module in pkgutil.walk_packages(hesim_render.__path__, "hesim_render."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from hesim_render.core.output import OutputFolder, alone_in
for text in ("one", "two"):
    folder = OutputFolder(pathlib.Path("made"), "mark", overwrite=True)
    (folder.path / "mark").write_text(text)
    folder.commit()
with alone_in(pathlib.Path("made")):
    print((pathlib.Path("made") / "mark").read_text(), *sorted(path.name for path in pathlib.Path(".").iterdir()))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["two", "made"]

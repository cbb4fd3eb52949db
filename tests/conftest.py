"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import faulthandler
import os
import tempfile
from pathlib import Path

import pytest

# test processes run side by side: threads of BLAS or Dr.Jit in each would wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hesim_render

WORKER, CRASHES = os.environ.get("PYTEST_XDIST_WORKER"), "HESIM_RENDER_TEST_CRASHES"
if WORKER is not None:
    import drjit

    drjit.set_thread_count(1)

__all__ = ["hesim_render"]


@pytest.hookimpl(trylast=True)
def pytest_configure():
    """Where a test process crashes is kept until the end of the run, which prints it."""
    if WORKER is None:
        os.environ[CRASHES] = tempfile.mkdtemp(prefix="hesim_render-crashes-")
    elif CRASHES in os.environ:
        faulthandler.enable((Path(os.environ[CRASHES]) / WORKER).open("w"))


def pytest_terminal_summary(terminalreporter):
    if WORKER is not None:
        return
    for file in sorted(Path(os.environ[CRASHES]).iterdir()):
        if text := file.read_text(errors="replace"):
            terminalreporter.section(f"crash of {file.name}")
            terminalreporter.write(text)


def pytest_unconfigure():
    if WORKER is None:
        for file in (folder := Path(os.environ.pop(CRASHES))).iterdir():
            file.unlink()
        folder.rmdir()

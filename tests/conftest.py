"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import os

# test processes run side by side: threads of BLAS in each would wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

import hesim_render

__all__ = ["hesim_render"]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A process that has no test left takes some of another one, which a long test would keep waiting."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)

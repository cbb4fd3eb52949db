"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import os

# test processes run side by side: threads of BLAS or Dr.Jit in each would wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

import hesim_render

_WORKER = os.environ.get("PYTEST_XDIST_WORKER", "")
if _WORKER:
    import drjit

    drjit.set_thread_count(1)

__all__ = ["hesim_render"]


class LastFirst(pytest.Dir):
    """A folder that is collected from its end."""

    def collect(self):
        return reversed(list(super().collect()))


def pytest_collect_directory(path, parent):
    """Every other worker compiles the modules of tests from the end, and finds the others compiled: it takes ten
    seconds to compile all.
    """
    return LastFirst.from_parent(parent, path=path) if _WORKER and int(_WORKER.removeprefix("gw")) % 2 else None


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path)  # those of a module keep their order

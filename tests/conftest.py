"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import os

# test processes run side by side: threads of BLAS or Dr.Jit in each would wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hesim_render

if "PYTEST_XDIST_WORKER" in os.environ:
    import drjit

    drjit.set_thread_count(1)

__all__ = ["hesim_render"]

"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import os

# test processes run side by side: threads of BLAS in each would wait for each other
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hesim_render

__all__ = ["hesim_render"]

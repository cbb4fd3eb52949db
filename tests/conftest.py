"""Importing the package first chooses Dr.Jit's LLVM before any test module imports Dr.Jit."""

import hesim_render

__all__ = ["hesim_render"]

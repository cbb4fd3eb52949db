"""Freed memory that stays with the process."""

import ctypes
import subprocess
import sys

import pytest

from hesim_render.core.child import child_environment, python_command, with_package

_HAS_GLIBC = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "gnu_get_libc_version")

#: Fills five arrays of 24 MB and frees them, twenty times, and prints how often the system had to give memory.
_PROGRAM = """
import resource, sys
import numpy as np
from hesim_render.core.host_memory import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
def fill():
    return [np.full(5_900_000, k, np.float32) for k in range(5)]
fill()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    fill()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how):
    command = python_command(with_package(_PROGRAM), how)
    return int(subprocess.run(command, env=child_environment(), capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not _HAS_GLIBC, reason="another library manages memory")
def test_freed_arrays_are_used_again():
    """Without it, the system gives and clears 20 times 118 MB, in pages of at most 2 MB."""
    assert faults("freed") > 20 * 5 * 8
    assert faults("kept") < 20

"""Memory of the host that NumPy has freed stays with the process."""

import ctypes
import sys

#: Parameters of glibc's ``mallopt``, see its manual page.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
#: Blocks from this size on come from the system and go back to it; glibc allows no larger one.
_LARGE_BYTES = 32 << 20
#: Free memory that the process keeps, and what it asks the system for at a time.
_KEPT_BYTES, _STEP_BYTES = 1 << 30, 64 << 20


def keep_freed_memory() -> None:
    """Use freed blocks of up to 32 MiB again, where glibc manages memory.

    Plans of a block of windows are arrays of some 20 MB, each used for some milliseconds. If they went back to the
    system, it would clear their pages each time: 5 to 10 % of the time of a run of an asynchronous sensor. This changes
    the whole process, so that only programs of this package call it.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_TOP_PAD, _STEP_BYTES)

"""Bands of rows on all cores: NumPy releases Python's lock in its loops, and a band stays in the cache."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def processors() -> int:
    """Processors that this process may use; macOS tells only how many there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_WORKERS = min(8, processors())


def in_bands(rows: int, work: Callable[[slice], object], band_rows: int = 64) -> None:
    """Call `work` with slices that together cover `rows`, several at a time.

    `work` writes into arrays of the caller; no two calls get the same row.

    Parameters
    ----------
    rows : number of rows.
    work : called with a slice of rows, on several threads.
    band_rows : rows of a slice.
    """
    slices = [slice(first, min(first + band_rows, rows)) for first in range(0, rows, band_rows)]
    if len(slices) == 1 or _WORKERS == 1:
        for part in slices:
            work(part)
        return
    with ThreadPoolExecutor(_WORKERS) as pool:
        for _ in pool.map(work, slices):
            pass

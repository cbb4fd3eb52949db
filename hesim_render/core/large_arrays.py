"""Large arrays of a full sensor: bands of rows on all cores, and distinct values."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", np.int64, np.float64)


def distinct_pixels(*lists: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Mosaic indices that occur in any of some lists.

    Parameters
    ----------
    lists : mosaic indices, [n] each.

    Returns
    -------
    The indices in ascending order, each once.
    """
    size = max((int(pixel.max()) + 1 for pixel in lists if pixel.size), default=0)
    occurs = np.zeros(size, np.bool_)
    for pixel in lists:
        occurs[pixel] = True
    return np.flatnonzero(occurs).astype(np.uint32)


def distinct_columns(values: NDArray[_Number]) -> tuple[NDArray[_Number], NDArray[np.int64]]:
    """Columns of a table, each once. Fast where neighbours are alike, as windows of the pixels of a row are.

    Parameters
    ----------
    values : [k, n].

    Returns
    -------
    distinct : [k, m], in the order of the first row, then of the next.
    place : [n], number of the distinct column that each column equals.
    """
    differs = np.ones(values.shape[1], np.bool_)
    differs[1:] = (values[:, 1:] != values[:, :-1]).any(axis=0)
    first = np.flatnonzero(differs)
    found, place = np.unique(values[:, first], axis=1, return_inverse=True)
    return found, np.repeat(place.ravel(), np.diff(first, append=values.shape[1]))


_WORKERS = min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


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

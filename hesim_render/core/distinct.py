"""Distinct values of the large arrays of a full sensor, for which NumPy's `unique` takes seconds."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Number = TypeVar("_Number", np.int64, np.float64)


def distinct_pixels(*lists: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Mosaic indices that occur in any of some lists, [n] each, ascending."""
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
    result, place = np.unique(values[:, first], axis=1, return_inverse=True)
    return result, np.repeat(place.ravel(), np.diff(first, append=values.shape[1]))

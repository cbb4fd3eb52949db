"""Distinct values, against NumPy's own."""

import numpy as np
import pytest

from hesim_render.core.distinct import distinct_columns, distinct_pixels


def test_distinct_pixels_are_those_of_numpy():
    rng = np.random.default_rng(3)
    for sizes in ((50, 30), (0, 20), (0, 0)):
        lists = [rng.integers(0, 60, size).astype(np.uint32) for size in sizes]
        found = distinct_pixels(*lists)
        assert found.dtype == np.uint32
        np.testing.assert_array_equal(found, np.unique(np.concatenate(lists)))


@pytest.mark.parametrize("repeats", [1, 4])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_distinct_columns_are_those_of_numpy(count, repeats):
    """Also where a column comes again after others, and where only one of the rows changes."""
    values = np.repeat(np.random.default_rng(4).integers(0, 5, (2, count)), repeats, axis=1).astype(np.float64)
    found, place = distinct_columns(values)
    wanted, inverse = np.unique(values, axis=1, return_inverse=True)
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(place, inverse.ravel())
    np.testing.assert_array_equal(found[:, place], values)

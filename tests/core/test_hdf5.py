"""Data sets of HDF5 whose values are not all stored."""

import h5py
import numpy as np
import pytest

from hesim_render.core.hdf5 import is_whole


@pytest.mark.parametrize(("size", "written", "expected"), [(10, 10, True), (10, 8, False), (8, 8, True), (12, 9, True)])
def test_every_chunk_of_a_whole_data_set_is_stored(tmp_path, size, written, expected):
    """Chunks of four values: three for ten values, of which the third is written with the ninth."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("a", (size,), "u4", chunks=(4,))
        data[:written] = 1
        assert is_whole(data) is expected


def test_a_data_set_without_chunks_is_stored_when_it_is_written(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        empty, full = file.create_dataset("empty", (6,), "u4"), file.create_dataset("full", data=np.ones(6, np.uint32))
        assert not is_whole(empty) and is_whole(full)

"""Data sets of HDF5 whose values are not all stored."""

import subprocess
import sys

import h5py
import hdf5plugin
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


def test_blosc_packs_where_the_path_of_plugins_leads_to_it_already(tmp_path, monkeypatch):
    """For other programs users set HDF5_PLUGIN_PATH to the folder of hdf5plugin."""
    monkeypatch.setenv("HDF5_PLUGIN_PATH", hdf5plugin.PLUGIN_PATH)
    path, values = tmp_path / "a.h5", np.arange(2, 5000, 7)
    code = f"""
import h5py, numpy
from hesim_render.core.hdf5 import COMPRESSION
with h5py.File({str(path)!r}, "w") as file:
    file.create_dataset("a", data=numpy.arange(2, 5000, 7), chunks=(100,), **COMPRESSION)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["a"][:], values)

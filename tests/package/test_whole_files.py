"""Readers ask for the size of a whole file before they take memory: videos, pictures, HDF5."""

import hashlib
import os

import h5py
import numpy as np
import pytest
import tifffile

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import MOST_TEXT_BYTES, WholeFile
from hesim_render.core.hdf5 import read_dataset
from hesim_render.sources.video.file import FileVideo
from hesim_render.sources.video.folder import FolderVideo
from hesim_render.targets.cube_file import open_cube

SAID = "at most|would take"


def test_videos_and_pictures_by_their_headers(tmp_path, monkeypatch):
    monkeypatch.setattr("hesim_render.core.guard._machine_bytes", lambda: 10**9)
    (tmp_path / "v.y4m").write_bytes(b"YUV4MPEG2 W6000 H5000 F25:1 C420jpeg\nFRAME\n" + bytes(100))
    with pytest.raises(SpecError, match=SAID):
        FileVideo(tmp_path / "v.y4m")
    for name, data in (("1.ppm", b"P6\n6000 5000\n255\n" + bytes(100)), ("1.tif", None)):
        folder = tmp_path / name[-3:]
        folder.mkdir()
        if data is None:  # its values are not stored
            tifffile.memmap(folder / name, shape=(20_000, 10_000), dtype=np.uint16)
        else:
            (folder / name).write_bytes(data)
        with pytest.raises(SpecError, match=SAID):
            FolderVideo(folder)


def test_chunks_of_hdf5_and_links_from_its_small_data_sets(tmp_path):
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_dataset("cube", (31, 4, 200_000_000), "f4", chunks=(1, 1, 200_000_000), compression="gzip")
        file["bands"] = np.arange(400.0, 701.0, 10.0)
    with pytest.raises(SpecError, match="a chunk of cube would take"):
        open_cube(tmp_path / "c.h5")
    with pytest.raises(SpecError, match="a chunk of cube would take"):
        read_dataset(tmp_path / "c.h5", "as truth", "cube", 3)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["bands"] = np.arange(400.0, 701.0, 10.0)
    for bands in (h5py.ExternalLink("other.h5", "bands"), None):
        with h5py.File(tmp_path / "d.h5", "w") as file:
            file["cube"] = np.ones((31, 4, 6))
            if bands is None:
                file.create_dataset("bands", (2**40,), "f8")
            else:
                file["bands"] = bands
        with pytest.raises(SpecError, match=r"is a link to elsewhere|bands would take"):
            open_cube(tmp_path / "d.h5")


def test_a_file_that_is_read_whole(tmp_path):
    file, content = tmp_path / "x", b'{"a": [1, 2]}' + b" " * 4987
    file.write_bytes(content)
    assert len(content) == 5000 and WholeFile(file, 5000).read() == content
    assert WholeFile(file, 5000).text().encode() == content and WholeFile(file, 5000).json() == {"a": [1, 2]}
    for read in (WholeFile.checked, WholeFile.read, WholeFile.text, WholeFile.json):
        with pytest.raises(SpecError, match="such a file holds at most"):
            read(WholeFile(file, 4999))
    # a hash needs one piece of the file at a time
    assert WholeFile(file, 4999).sha256() == hashlib.sha256(content).hexdigest()


def test_text_has_a_smaller_limit_than_bytes(tmp_path):
    with (tmp_path / "x").open("wb") as file:
        file.truncate(MOST_TEXT_BYTES + 1)
    assert WholeFile(tmp_path / "x").checked() == tmp_path / "x"
    with pytest.raises(SpecError, match="such a file holds at most 67"):
        WholeFile(tmp_path / "x").text()


def test_pipes_and_what_is_no_text_or_json(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for read in (WholeFile.checked, WholeFile.read, WholeFile.text, WholeFile.json, WholeFile.sha256):
        with pytest.raises(SpecError, match="is a pipe or a device"):
            read(WholeFile(tmp_path / "pipe"))
        with pytest.raises(SpecError, match=r"cannot be read .*No such file"):
            read(WholeFile(tmp_path / "missing"))
    (tmp_path / "x").write_bytes(b"\xff{}")
    with pytest.raises(SpecError, match="is not a UTF-8 text file"):
        WholeFile(tmp_path / "x").json()
    for damaged in ("{", "[" * 100_000):
        (tmp_path / "x").write_text(damaged)
        with pytest.raises(SpecError, match=r"cannot be read as JSON|nested too deeply"):
            WholeFile(tmp_path / "x").json()

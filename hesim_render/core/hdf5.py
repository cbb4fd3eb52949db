"""HDF5 files: writing that survives a full disk, and data sets of untrusted files."""

import contextlib
import math
import mmap
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import MOST_BYTES, reading, require_memory

# Where HDF5_PLUGIN_PATH leads to Blosc, HDF5 loads it by itself, without what hdf5plugin gives it, and can make no data
# set: it is loaded once more.
hdf5plugin.register("blosc")

#: HDF5 filters that may be needed to read: deflate, shuffle, fletcher32, LZF, Blosc.
_FILTERS = {1, 2, 3, 32000, 32001}
LARGEST_CHUNK_BYTES = 1 << 26
#: Largest chunk of pictures and cubes of others, bytes.
_LARGEST_CHUNK = 1 << 28
#: How data sets are packed.
COMPRESSION = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)
#: The same for readers that have no plugin of Blosc.
PLAIN_COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_KINDS = {"ui": "whole numbers", "V": "records"}


class Disk:
    """File object for HDF5 that never reports a write error, because HDF5 crashes if it cannot close its file.

    `check` raises the first error. After an error, further data are dropped; the file is useless then and is removed.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._error: OSError | None = None
        self.read, self.seek, self.tell, self.close = (
            getattr(self._file, name) for name in ("read", "seek", "tell", "close")
        )

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        place, done = self._file.tell(), 0
        try:
            while done < len(view):
                done += self._file.write(view[done:])
        except OSError as error:
            self._error = self._error or error
            self._file.seek(place + len(view))
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        count = self._file.readinto(view) or 0
        view[count:] = bytes(len(view) - count)  # data that were dropped
        return len(view)

    def truncate(self, size: int) -> int:
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size

    def flush(self) -> None:
        """Nothing is buffered."""

    @contextlib.contextmanager
    def own_errors(self) -> Iterator[None]:
        """Raise an error of the disk in place of the error that HDF5 makes of it."""
        try:
            yield
        except (OSError, RuntimeError):
            self.check()
            raise
        self.check()

    def check(self) -> None:
        """Raise the error that was kept from HDF5."""
        if self._error is not None:
            raise self._error


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """A new file that is closed at the end of the with statement, on a full disk as well, whose error is raised then.

    Bytes are the same each time if data sets that are written piece by piece are flushed after each piece: chunks get
    their places when they are packed, which is else when HDF5 likes to.
    """
    disk = Disk(path)
    file = h5py.File(disk, "w")
    try:
        with disk.own_errors():
            yield file
            file.close()
            disk.close()
    except BaseException:
        file.close()
        disk.close()
        raise


#: Begin of a global heap, which holds texts of variable length: signature, version 1 and three zeros.
_HEAP = b"GCOL\x01\0\0\0"


def require_sound_heaps(path: Path) -> None:
    """Refuse a file whose heaps are damaged, before a text of variable length is read: HDF5 may walk along such a heap
    without end.

    Raises
    ------
    SpecError
        If the entries of a heap do not fill it.
    """
    with reading(path), path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = -1
        while (at := data.find(_HEAP, at + 1)) >= 0:
            end = at + int.from_bytes(data[at + 8 : at + 16], "little")
            place = at + 16
            while place + 16 <= end <= len(data):
                size = int.from_bytes(data[place + 8 : place + 16], "little")
                is_free = data[place : place + 2] == b"\0\0"
                if is_free and size < 16:
                    break
                place += size if is_free else 16 + -(-size // 8) * 8
            if not end - 16 < place <= end <= len(data):
                raise SpecError(f"has a damaged heap of texts at byte {at}", file=path)


def dataset_of(file: Any, name: str, path: Path, kinds: str = "ui", also: Collection[int] = ()) -> Any:
    """A data set of numbers that is stored in this file itself; `kinds` are NumPy's letters of the kinds that it may
    hold, and `also` filters that the caller unpacks by itself.
    """
    parts = name.split("/")
    for k in range(len(parts)):
        part = "/".join(parts[: k + 1])
        link = file.get(part, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise SpecError(f"has no data set {name}" if link is None else f"{part} is a link to elsewhere", file=path)
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.dtype.kind not in kinds:
        raise SpecError(f"{name} is no data set of {_KINDS.get(kinds, 'numbers')}", file=path)
    layout = data.id.get_create_plist()
    if data.is_virtual or layout.get_external_count():
        raise SpecError(f"{name} has its values in another file", file=path)
    if data.chunks is not None:  # one is read whole, whatever part of it is asked for
        require_memory(math.prod(data.chunks) * data.dtype.itemsize, f"a chunk of {name}", path, _LARGEST_CHUNK)
    for k in range(layout.get_nfilters()):
        if (used := layout.get_filter(k)[0]) not in {*_FILTERS, *also}:
            raise SpecError(f"{name} is packed by filter {used}; expected one of {sorted(_FILTERS)}", file=path)
    return data


def is_whole(data: Any) -> bool:
    """True if all values of a one-dimensional data set are stored; HDF5 reads the others as fill values."""
    if data.chunks is None:
        return data.id.get_storage_size() >= data.shape[0] * data.dtype.itemsize
    return data.id.get_num_chunks() >= -(-data.shape[0] // data.chunks[0])


def read_dataset(path: Path, what: str, name: str, number: int | None = None, kinds: str = "fui") -> Any:
    """The values of a data set (`dataset_of`), or of one entry of it.

    Parameters
    ----------
    path : the file.
    what : how it is read (``as truth``), for errors.
    name : of the data set.
    number : of the entry; None reads all.
    kinds : NumPy's letters of the kinds that it may hold.

    Raises
    ------
    RangeError
        If there is no such entry.
    SpecError
        If the file cannot be read, has no such data set, or it is too large.
    """
    with reading(path, what), h5py.File(path, "r") as file:
        if name not in file:
            raise SpecError(f"has no {name}", file=path)
        data = dataset_of(file, name, path, kinds)
        if number is not None and not 0 <= number < (data.shape or (0,))[0]:
            raise RangeError("number", number, f"0 to {(data.shape or (0,))[0] - 1}")
        shape = data.shape if number is None else data.shape[1:]
        require_memory(math.prod(shape) * data.dtype.itemsize, name, path, MOST_BYTES)
        return data[()] if number is None else data[number]

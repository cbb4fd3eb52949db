"""``.npz`` and ``.npy`` files: written in pieces, and read without trust in their headers.

The header of an array is checked before its data are read, and no more data are read than it states.
"""

import io
import math
import struct
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import MOST_BYTES, reading, require_memory

_WHAT = "as an .npz file of plain arrays"
#: Longest header of an array; NumPy's own are of 128 bytes.
_LONGEST_HEADER = 1 << 16
_KINDS = {"b": "true or false", "u": "whole numbers", "i": "whole numbers", "f": "numbers"}


class NpzWriter:
    """Writes an ``.npz`` file in pieces; use it as a context manager.

    Members are stored without compression: noise hardly compresses, and a reader of a session larger than memory would
    lose time on decompression.

    Parameters
    ----------
    path : file to write, replaced if it exists; or an open file.
    """

    def __init__(self, path: Path | IO[bytes]) -> None:
        self._archive = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True)

    def add(self, name: str, array: NDArray) -> None:
        """Add a whole array."""
        self.add_pieces(name, array.shape, array.dtype, [array])

    def add_pieces(self, name: str, shape: tuple[int, ...], dtype: DTypeLike, pieces: Iterable[NDArray]) -> None:
        """Add an array of `shape` as consecutive pieces in C order; only one piece is in memory at a time.

        Raises
        ------
        RangeError
            If the pieces do not make up the whole array.
        """
        kind = np.dtype(dtype)
        header = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": shape}
        # a fixed date: the same session gives the same bytes
        member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
        written = 0
        with self._archive.open(member, "w", force_zip64=True) as stream:
            np.lib.format.write_array_header_1_0(stream, header)
            for piece in pieces:
                block = np.ascontiguousarray(piece, dtype=kind)
                written += block.size
                stream.write(block.reshape(-1).view(np.uint8).data)
        if written != int(np.prod(shape)):
            raise RangeError(f"values of {name}", written, f"{int(np.prod(shape))}, for the shape {shape}")

    def __enter__(self) -> "NpzWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()


def read_arrays(
    file: Path,
    required: Iterable[str] = (),
    *,
    only: Iterable[str] | None = None,
    skip: Iterable[str] = (),
    shapes: Mapping[str, tuple[int, ...]] | None = None,
    kinds: str = "",
) -> dict[str, NDArray]:
    """Read arrays of an ``.npz`` file.

    Parameters
    ----------
    file : the file.
    required : names that must exist.
    only : names to read, as far as they exist; default all.
    skip : names not to read.
    shapes : required shapes, by name.
    kinds : allowed kinds of value (`numpy.dtype.kind`); default all.

    Raises
    ------
    SpecError
        If the file or a `required` array is missing, unreadable, of the wrong shape or kind, or larger than the memory
        limit of a map.
    """
    arrays: dict[str, NDArray] = {}
    total = 0
    with reading(file, _WHAT), zipfile.ZipFile(file) as archive:
        names = require_names(archive, file, required)
        for member in dict.fromkeys(names):
            if member in skip or (only is not None and member not in only):
                continue
            with archive.open(f"{member}.npy") as stream:
                shape, fortran_order, dtype = read_header(stream, member, file)
                _require_kind(shape, dtype, member, file, (shapes or {}).get(member), kinds)
                total += math.prod(shape) * dtype.itemsize
                require_memory(total, "all arrays together", file)
                arrays[member] = _values(stream, shape, fortran_order, dtype, member, file)
    return arrays


def read_array(file: Path, shape: tuple[int, ...] | None = None, kinds: str = "") -> NDArray:
    """The array of an ``.npy`` file; shape and kind are checked if given.

    Raises
    ------
    SpecError
        If it cannot be read or fails a check.
    """
    with reading(file, "as an .npy file of numbers"), file.open("rb") as stream:
        header = read_header(stream, "the array", file)
        _require_kind(header[0], header[2], "the array", file, shape, kinds)
        return _values(stream, *header, "the array", file)


def require_names(archive: zipfile.ZipFile, file: Path, required: Iterable[str]) -> list[str]:
    """Names of all arrays of an ``.npz`` file; the required ones must be among them."""
    names = [name.removesuffix(".npy") for name in archive.namelist()]
    for name in required:
        if name not in names:
            raise SpecError(f"holds no array {name!r} (found: {', '.join(names) or 'none'})", file=file)
    return names


def member_header(file: Path, member: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an array of an ``.npz`` file that is in C order."""
    with reading(file, _WHAT), zipfile.ZipFile(file) as archive, archive.open(f"{member}.npy") as stream:
        return _in_c_order(stream, member, file)


def stream_member(file: Path, member: str, count: int, shape: tuple[int, ...]) -> Iterator[NDArray]:
    """`count` consecutive arrays of `shape` from a member, through one buffer.

    Raises
    ------
    SpecError
        If the member cannot be read, or is in Fortran order.
    """
    with reading(file, _WHAT), zipfile.ZipFile(file) as archive, archive.open(f"{member}.npy") as stream:
        _, dtype = _in_c_order(stream, member, file)
        require_memory(math.prod(shape) * dtype.itemsize, member, file, MOST_BYTES)
        buffer = bytearray(math.prod(shape) * dtype.itemsize)
        for _ in range(count):
            _fill(stream, memoryview(buffer))
            yield np.frombuffer(buffer, dtype=dtype).reshape(shape)


def stream_list(file: Path, member: str, size: int) -> Iterator[NDArray]:
    """Pieces of at most `size` values of a one-dimensional member.

    Raises
    ------
    SpecError
        If the member cannot be read.
    """
    with reading(file, _WHAT), zipfile.ZipFile(file) as archive, archive.open(f"{member}.npy") as stream:
        (total,), dtype = _in_c_order(stream, member, file)
        for first in range(0, total, size):
            buffer = bytearray(min(size, total - first) * dtype.itemsize)
            _fill(stream, memoryview(buffer))
            yield np.frombuffer(buffer, dtype=dtype)


def read_header(stream: IO[bytes], name: str, file: Path) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order (True or False), and type of the array at the begin of a stream.

    Raises
    ------
    SpecError
        If it is an array of objects.
    """
    version = np.lib.format.read_magic(stream)
    size_bytes = 2 if version == (1, 0) else 4
    start = stream.read(size_bytes)
    (length,) = struct.unpack("<H" if size_bytes == 2 else "<I", start)
    if length > _LONGEST_HEADER:
        raise ValueError("the header of an array is too long")
    read = np.lib.format.read_array_header_1_0 if size_bytes == 2 else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read(io.BytesIO(start + stream.read(length)))
    if dtype.hasobject:
        raise SpecError(
            f"{name} is an array of objects, as NumPy makes of frames of different sizes; save numbers of one size",
            file=file,
        )
    if any(n < 0 for n in shape):
        raise ValueError("an array has a negative size")
    return tuple(int(n) for n in shape), bool(fortran_order), dtype


def _require_kind(
    shape: tuple[int, ...], dtype: np.dtype, name: str, file: Path, wanted: tuple[int, ...] | None, kinds: str
) -> None:
    if kinds and dtype.kind not in kinds:
        raise SpecError(f"{name} holds {dtype.name}; expected {_KINDS[kinds[-1]]}", file=file)
    if wanted is not None and shape != wanted:
        raise SpecError(f"{name} has shape {shape}; expected {wanted}", file=file)


def _values(
    stream: IO[bytes], shape: tuple[int, ...], fortran_order: bool, dtype: np.dtype, name: str, file: Path
) -> NDArray:
    """The data after a header that has been checked."""
    size = math.prod(shape) * dtype.itemsize
    require_memory(size, name, file, MOST_BYTES)
    buffer = bytearray(size)
    _fill(stream, memoryview(buffer))
    values = np.frombuffer(buffer, dtype=dtype)
    return values.reshape(shape[::-1]).T if fortran_order else values.reshape(shape)


def _in_c_order(stream: IO[bytes], name: str, file: Path) -> tuple[tuple[int, ...], np.dtype]:
    shape, fortran_order, dtype = read_header(stream, name, file)
    if fortran_order and len(shape) > 1:
        raise SpecError("arrays must be in C order (use numpy.ascontiguousarray before saving)", file=file)
    return shape, dtype


def _fill(stream: IO[bytes], view: memoryview, piece: int = 1 << 18) -> None:
    filled = 0
    while filled < len(view):
        data = stream.read(min(piece, len(view) - filled))
        if not data:
            raise EOFError("the file ends early")
        view[filled : filled + len(data)] = data
        filled += len(data)

"""An ``.npz`` file whose arrays are written piece by piece, so that they need not fit into memory."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hesim_render.errors import RangeError


class NpzWriter:
    """Use as a context manager. Members are stored without compression: noise hardly shrinks, and a reader of
    a session larger than memory is not held up by inflating.

    Parameters
    ----------
    path : file to write, replaced if it is there.
    """

    def __init__(self, path: Path) -> None:
        self._archive = zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True)

    def add(self, name: str, array: NDArray) -> None:
        """A whole array."""
        self.add_pieces(name, array.shape, array.dtype, [array])

    def add_pieces(self, name: str, shape: tuple[int, ...], dtype: DTypeLike, pieces: Iterable[NDArray]) -> None:
        """An array of `shape`, given as consecutive pieces in C order; only one of them is held at a time.

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

    def __enter__(self) -> NpzWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

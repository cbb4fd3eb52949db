"""Reader of tables in FlatBuffers (flatbuffers.dev), with every position checked."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray


class FlatTable:
    """A table in a buffer.

    Parameters
    ----------
    data : the buffer.
    position : of the table, byte.

    Raises
    ------
    ValueError
        If a part of it lies outside of the buffer; so do all methods.
    """

    def __init__(self, data: bytes, position: int) -> None:
        self._data, self._position = data, position
        fields = position - self._at(position, "<i")
        size = self._at(fields, "<H")
        self._fields = [self._at(fields + at, "<H") for at in range(4, size - 1, 2)]

    @classmethod
    def root(cls, data: bytes, identifier: bytes) -> FlatTable:
        """The root table of a buffer without a size in front, which must have an identifier of 4 bytes."""
        if data[4:8] != identifier:
            raise ValueError(f"a part says {data[4:8]!r}; expected {identifier!r}")
        (position,) = struct.unpack_from("<I", data)
        return cls(data, position)

    def _at(self, position: int, form: str) -> int:
        if not 0 <= position <= len(self._data) - struct.calcsize(form):
            raise ValueError("a position lies outside of its part")
        return struct.unpack_from(form, self._data, position)[0]

    def _field(self, number: int) -> int | None:
        offset = self._fields[number] if number < len(self._fields) else 0
        return self._position + offset if offset else None

    def number(self, field: int, form: str, default: int) -> int:
        """A field with a number of the `struct` format `form`."""
        position = self._field(field)
        return default if position is None else self._at(position, form)

    def text(self, field: int) -> str:
        """A field with a text; empty without one."""
        return self.structures(field, np.dtype("u1")).tobytes().decode("utf-8")

    def structures(self, field: int, dtype: np.dtype) -> NDArray:
        """A field with a vector of numbers or structures; empty without one."""
        position = self._field(field)
        if position is None:
            return np.empty(0, dtype=dtype)
        position += self._at(position, "<I")
        count = self._at(position, "<I")
        # NumPy checks that the vector ends within the buffer
        return np.frombuffer(self._data, dtype, count, position + 4)

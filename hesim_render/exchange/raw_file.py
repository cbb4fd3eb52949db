"""Header and words of Prophesee RAW files (EVT2, EVT3).

Lines ``% key value`` state format and size of the sensor; ``% end`` closes them. Some programs leave ``% end`` out, so
the header also ends before the first line that does not begin with ``% ``.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading
from hesim_render.exchange.stream import EventStream
from hesim_render.exchange.triggers import merged

#: Coordinates have 11 bits in EVT2 and EVT3.
LARGEST_SIDE = 1 << 11
_LONGEST_LINE = 1000
_MOST_LINES = 1000
#: Formats by the version number of the header.
_VERSIONS = {"2.0": "EVT2", "2.1": "EVT21", "3.0": "EVT3"}
#: Words of one piece.
_PIECE = 1 << 18


def write(
    stream: EventStream,
    file: IO[bytes],
    target: str | Path,
    name: str,
    encode: Callable[[NDArray, NDArray | None, NDArray[np.bool_] | None], NDArray],
    channels: int,
    latest_us: int | None = None,
) -> None:
    """Write the header of a format, and the words of events and triggers.

    Parameters
    ----------
    stream, file, target : the events, where to write them, and its name for errors.
    name : the format, ``EVT2`` or ``EVT3``.
    encode : turns entries of `merged`, the entry before them (None before the first), and what of them are triggers
        into words.
    channels : number of trigger lines that the format has.
    latest_us : last time that the format has, µs; None for no limit.

    Raises
    ------
    SpecError
        If events or triggers do not fit the format.
    """
    stream.require_side(LARGEST_SIDE, name, target)
    write_header(file, name, stream.shape)
    before = None
    for entries, is_trigger in merged(stream, stream.triggers(), stream.source, channels):
        last_us = int(entries["t_us"][-1])
        if latest_us is not None and last_us > latest_us:
            raise SpecError(f"{name} ends at {latest_us} µs; an event is at {last_us} µs", file=stream.source)
        file.write(encode(entries, before, is_trigger).data)
        before = entries[-1]


def write_header(file: IO[bytes], name: str, shape: tuple[int, int]) -> None:
    """Write the header of a format, ``EVT2`` or ``EVT3``, for a sensor of so many rows and columns."""
    rows, cols = shape
    version = next(number for number, known in _VERSIONS.items() if known == name)
    lines = (
        "camera_integrator_name hesim_render", f"evt {version}", f"format {name};height={rows};width={cols}",
        f"geometry {cols}x{rows}", "integrator_name hesim_render", "plugin_name hal_plugin_prophesee", "end",
    )  # fmt: skip
    file.write("".join(f"% {line}\n" for line in lines).encode("ascii"))


def read_lines(path: Path) -> tuple[dict[str, str], int]:
    """Keys and values of the lines with % at the begin of a file, and the byte behind them.

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    keys: dict[str, str] = {}
    with reading(path, "as a Prophesee RAW file"), path.open("rb") as file:
        begin = 0
        for _ in range(_MOST_LINES):
            line = file.readline(_LONGEST_LINE)
            if not line.startswith(b"% ") or not line.endswith(b"\n") or not line.isascii():
                break
            begin = file.tell()
            key, _, value = line[2:].decode("ascii").strip().partition(" ")
            if key == "end":
                break
            keys[key] = value
    return keys, begin


def read_header(path: Path) -> tuple[str, tuple[int, int] | None, int]:
    """Format (``EVT2``, ``EVT3``, …), shape (rows, columns; None if the header has none), and first byte of the words.

    Raises
    ------
    SpecError
        If the file has no such header.
    """
    keys, begin = read_lines(path)
    if not keys:
        raise SpecError("is not a Prophesee RAW file (no header of lines with %)", file=path)
    stated, *details = keys.get("format", "").split(";")
    name = stated or _VERSIONS.get(keys.get("evt", ""), keys.get("evt", ""))
    return name, _shape(keys, details, path), begin


def _shape(keys: dict[str, str], details: list[str], path: Path) -> tuple[int, int] | None:
    result = dict(detail.partition("=")[::2] for detail in details)
    size = re.fullmatch(r"(\d{1,5})x(\d{1,5})", keys.get("geometry", ""))
    width, height = size.groups() if size else (result.get("width", ""), result.get("height", ""))
    if not (width or height):
        return None
    return stated_size(width, height, LARGEST_SIDE, path)


def stated_size(width: str, height: str, largest: int, path: Path) -> tuple[int, int]:
    """Rows and columns that a header states in digits.

    Raises
    ------
    SpecError
        If one of them is no number from 1 to `largest`.
    """
    if not all(side.isdecimal() and len(side) < 6 and 0 < int(side) <= largest for side in (width, height)):
        shown = printable(f"{width}x{height}")
        raise SpecError(f"has the size {shown}; expected 1x1 to {largest}x{largest} px", file=path)
    return int(height), int(width)


def words(path: Path, begin: int, dtype: DTypeLike) -> Iterator[NDArray]:
    """Words of a file from byte `begin`, in pieces.

    Raises
    ------
    SpecError
        If the file ends within a word.
    """
    size = np.dtype(dtype).itemsize
    with reading(path), path.open("rb") as file:
        file.seek(begin)
        while data := file.read(_PIECE * size):
            if len(data) % size:
                raise SpecError(f"ends within a word of {8 * size} bits; the file is cut short", file=path)
            yield np.frombuffer(data, dtype=dtype)


def require_types(types: NDArray[np.uint8], known: NDArray[np.bool_], name: str, path: Path) -> None:
    """Raise an error for word types that a format does not have.

    Parameters
    ----------
    types : [word], type of each word, 0 to 15.
    known : [16], which types the format has.
    name, path : format and file, for the error.
    """
    unknown = ~known[types]
    if unknown.any():
        result = int(types[unknown.argmax()])
        raise SpecError(
            f"holds a word of type {result:#x}, which {name} does not have; the file is damaged or of another format",
            file=path,
        )


def latest(positions_of: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Index of the latest True at or before each element; the first element must be True."""
    index = np.where(positions_of, np.arange(positions_of.size), 0)
    return np.maximum.accumulate(index)

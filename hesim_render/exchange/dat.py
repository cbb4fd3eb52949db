"""Prophesee DAT, version 2: 8 bytes an event, little endian, after lines with % and the type and the size of an entry.

An event is its time in µs (32 bits), then x (bits 13 to 0), y (27 to 14) and polarity (28, 1 is ON).
"""

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading
from hesim_render.exchange import raw_file
from hesim_render.exchange.stream import EventStream
from hesim_render.pixels.evs.events import events_of

_ENTRY = np.dtype([("t", "<u4"), ("word", "<u4")])
_PLACE_BITS = 14
#: Coordinates have 14 bits.
LARGEST_SIDE = 1 << _PLACE_BITS
_LATEST_US = (1 << 32) - 1
#: Types of entries that are events: of older and of newer files.
_OLD_EVENTS, _EVENTS = 0, 12
_VERSION = "2"


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as a DAT file.

    Raises
    ------
    SpecError
        If the sensor has more than 16384 rows or columns, or an event lies at 2³² µs (71 minutes) or later.
    """
    stream.require_side(LARGEST_SIDE, "DAT", target)
    rows, cols = stream.shape
    lines = ("Data file containing CD events.", f"Version {_VERSION}", f"Height {rows}", f"Width {cols}")
    file.write("".join(f"% {line}\n" for line in lines).encode("ascii") + bytes((_EVENTS, _ENTRY.itemsize)))
    stream.encode_into(file, "DAT", lambda events, _: _encoded(events), _LATEST_US)


def _encoded(events: NDArray) -> NDArray:
    made = np.empty(events.size, dtype=_ENTRY)
    made["t"] = events["t_us"]
    made["word"] = (events["polarity"] > 0).astype(np.uint32) << np.uint32(2 * _PLACE_BITS)
    made["word"] |= events["y"].astype(np.uint32) << np.uint32(_PLACE_BITS) | events["x"]
    return made.view(np.uint8)


def is_dat(path: Path) -> bool:
    """True if the lines with % at the begin of a file are those of DAT: a version, and no format of RAW files.

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    keys, _ = raw_file.read_lines(path)
    return ("Version" in keys or keys.get("Data", "").startswith("file")) and not {"evt", "format"} & set(keys)


def read_header(path: Path) -> tuple[tuple[int, int] | None, int]:
    """Shape (rows, columns; None if the header has none), and first byte of the events.

    Raises
    ------
    SpecError
        If the file is of another version, or holds something other than events.
    """
    keys, begin = raw_file.read_lines(path)
    if (version := keys.get("Version", _VERSION)) != _VERSION:
        raise SpecError(f"is a DAT file of version {printable(version)}; expected {_VERSION}", file=path)
    with reading(path), path.open("rb") as file:
        file.seek(begin)
        kind = file.read(2)
    if len(kind) < 2 or kind[0] not in (_OLD_EVENTS, _EVENTS) or kind[1] != _ENTRY.itemsize:
        kinds = " of ".join(map(str, kind)) or "nothing"
        raise SpecError(
            f"holds entries of type {kinds} bytes at byte {begin}; expected type {_OLD_EVENTS} or {_EVENTS} (events) "
            f"of {_ENTRY.itemsize}",
            file=path,
        )
    return _shape(keys, path), begin + 2


def _shape(keys: dict[str, str], path: Path) -> tuple[int, int] | None:
    width, height = keys.get("Width", ""), keys.get("Height", "")
    if not (width or height):
        return None
    return raw_file.stated_size(width, height, LARGEST_SIDE, path)


def read(path: Path, begin: int) -> Iterator[NDArray]:
    """Blocks of events of a DAT file, from byte `begin`.

    Raises
    ------
    SpecError
        If the file ends within an event.
    """
    for piece in raw_file.words(path, begin, _ENTRY):
        word = piece["word"]
        x, y = (word >> np.uint32(bits) & np.uint32(LARGEST_SIDE - 1) for bits in (0, _PLACE_BITS))
        yield events_of(piece["t"], x, y, word >> np.uint32(2 * _PLACE_BITS) & np.uint32(1))

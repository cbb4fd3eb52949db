"""Events as text in the form of E2VID, and as plain arrays in an ``.npz`` file.

Text: ``width height`` on the first line, then ``t x y p`` for each event, t in seconds, p 1 (ON) or 0 (OFF).
Arrays: ``t`` int64 µs, ``x`` and ``y`` uint16, ``p`` uint8, and ``width`` and ``height``.
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading
from hesim_render.core.npz import NpzWriter, member_header, require_names, stream_list, stream_member
from hesim_render.exchange.stream import BLOCK, EventStream
from hesim_render.pixels.evs.events import events_of

_COLUMNS = {"t": "<i8", "x": "<u2", "y": "<u2", "p": "u1"}
#: Lines that are formatted together; a line is 44 bytes while it is made.
_LINES = 1 << 18


def write_text(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as text."""
    rows, cols = stream.shape
    file.write(f"{cols} {rows}\n".encode("ascii"))
    for block in stream:
        for first in range(0, block.size, _LINES):
            file.write(_lines(block[first : first + _LINES]).data)


def _lines(events: NDArray) -> NDArray[np.uint8]:
    """ASCII text of events, one line each."""
    seconds, rest = np.divmod(events["t_us"], 1_000_000)
    columns = [(seconds, 13, 1, "."), (rest, 6, 6, " "), (events["x"], 5, 1, " "), (events["y"], 5, 1, " ")]
    columns += [(events["polarity"] > 0, 1, 1, "\n")]
    parts, kept = [], []
    for numbers, width, least, end in columns:
        power = 10 ** np.arange(width - 1, -1, -1)
        digits = numbers.astype(np.int64)[:, None] // power % 10
        # zeros in front are left out, but for those that belong to the fraction, or stand for 0
        keep = np.maximum.accumulate(digits > 0, axis=1)
        keep[:, width - least :] = True
        used = max(int(keep.any(axis=0).sum()), 1)
        parts += [(digits[:, -used:] + ord("0")).astype(np.uint8), np.full((events.size, 1), ord(end), dtype=np.uint8)]
        kept += [keep[:, -used:], np.ones((events.size, 1), dtype=bool)]
    return np.concatenate(parts, axis=1)[np.concatenate(kept, axis=1)]


def write_arrays(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as an ``.npz`` file; the stream is read five times, so that no array is in memory."""
    count, (rows, cols) = stream.count(), stream.shape
    with NpzWriter(file) as archive:
        for name, dtype in _COLUMNS.items():
            pieces = (_column(events, name) for events in stream)
            archive.add_pieces(name, (count,), dtype, pieces)
        archive.add("width", np.array(cols, dtype=np.int64))
        archive.add("height", np.array(rows, dtype=np.int64))


def _column(events: NDArray, name: str) -> NDArray:
    if name == "p":
        return events["polarity"] > 0
    return events["t_us" if name == "t" else name]


def read_arrays_header(path: Path) -> tuple[tuple[int, int] | None, dict[str, str]]:
    """Shape (rows, columns; None if not stated) and the arrays' names for t, x, y and p.

    Files with ``timestamp`` and ``polarity`` instead of t and p are taken too.

    Raises
    ------
    SpecError
        If an array is missing, or their lengths or types do not fit.
    """
    with reading(path, "as an .npz file of events"), zipfile.ZipFile(path) as archive:
        present = require_names(archive, path, ())
        other = {"t": "timestamp", "p": "polarity"}
        names = {key: other[key] if key in other and key not in present else key for key in _COLUMNS}
        require_names(archive, path, names.values())
    headers = {name: member_header(path, name) for name in names.values()}
    if len(shapes := {shape for shape, _ in headers.values()}) > 1 or len(next(iter(shapes))) != 1:
        shapes_text = ", ".join(f"{name} {shape}" for name, (shape, _) in headers.items())
        raise SpecError(f"must hold four lists of one length ({shapes_text})", file=path)
    for key, name in names.items():
        kind = headers[name][1].kind
        if kind not in ("uib" if key == "p" else "ui"):
            raise SpecError(f"{name} holds {headers[name][1].name}; expected whole numbers", file=path)
    shape = None
    if {"width", "height"} <= set(present):
        for name in ("height", "width"):
            own, stored = member_header(path, name)
            if own != () or stored.kind not in "ui":
                raise SpecError(f"{name} holds {stored.name} {own}; expected one whole number", file=path)
        size = [int(next(stream_member(path, name, 1, ())).astype(np.int64)) for name in ("height", "width")]
        shape = (size[0], size[1])
    return shape, names


def read_arrays(path: Path, names: dict[str, str]) -> Iterator[NDArray]:
    """Blocks of events of an ``.npz`` file, as `read_arrays_header` describes it.

    Raises
    ------
    SpecError
        If a coordinate or a polarity has an impossible value.
    """
    pieces = {key: stream_list(path, name, BLOCK) for key, name in names.items()}
    for parts in zip(*pieces.values(), strict=True):
        columns = dict(zip(pieces, parts, strict=True))
        for key, least, most in (("t", 0, 2**63 - 1), ("x", 0, 2**16 - 1), ("y", 0, 2**16 - 1), ("p", -1, 1)):
            low, high = int(columns[key].min()), int(columns[key].max())
            if low < least or high > most:
                value = low if low < least else high
                raise SpecError(f"{names[key]} holds {value}; expected {least} to {most}", file=path)
        yield events_of(*(columns[key] for key in _COLUMNS))

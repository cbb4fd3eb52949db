"""Events in HDF5, in the layout of the DSEC data set [gehrig2021], Blosc LZ4.

``events/t`` uint32 µs after ``t_offset``, ``events/x``, ``events/y`` uint16, ``events/p`` uint8 (1 ON,
0 OFF); ``ms_to_idx[k]`` is the index of the first event at or after k ms, ``t_offset`` int64 µs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory
from hesim_render.core.hdf5 import LARGEST_CHUNK_BYTES, dataset_of, is_whole
from hesim_render.exchange.dsec_writer import COLUMNS, LONGEST_US, EventFileWriter, write, write_plain
from hesim_render.exchange.stream import BLOCK
from hesim_render.pixels.evs.events import EVENT_DTYPE, no_events

__all__ = [
    "EventFileWriter", "read_events", "read_numbered_events", "read_shape", "stream_events", "write", "write_plain",
]  # fmt: skip

_LATEST_US = 2**53  # 285 years
_LAST_PX = 2**16 - 1
_BYTES_IN_ALL = EVENT_DTYPE.itemsize + 12  # an event, and its columns while they are read


def read_events(
    path: Path,
    begin_us: int | None = None,
    end_us: int | None = None,
    *,
    shape: tuple[int, int] | None = None,
    count: int | None = None,
) -> NDArray:
    """Events with begin_us <= t_us < end_us (default: all); only that part of the file is read.

    Parameters
    ----------
    path : the file.
    begin_us, end_us : the interval, µs.
    shape : rows and columns of the event grid, which must contain all coordinates.
    count : number of events that the file must hold.

    Returns
    -------
    Structured array [event] of `EVENT_DTYPE`, in order of time.

    Raises
    ------
    SpecError
        If the file cannot be read, links to other files, or its parts do not fit each other.
    """
    return read_numbered_events(path, begin_us, end_us, shape=shape, count=count)[0]


def read_numbered_events(
    path: Path,
    begin_us: int | None = None,
    end_us: int | None = None,
    *,
    shape: tuple[int, int] | None = None,
    count: int | None = None,
) -> tuple[NDArray, int]:
    """As `read_events`, with the number of the first of these events in the file."""
    with reading(path, "as events"), h5py.File(path, "r") as file:
        columns, total = _columns(file, path, count)
        offset = _offset(file, path)
        first, last = _range(_index(file, total, path), offset, total, begin_us, end_us)
        require_memory((last - first) * _BYTES_IN_ALL, f"{last - first} events", path)
        if last <= first:
            return no_events(), first
        _check_index(columns["t"], first, last, offset, begin_us, end_us, path)
        events = _block(columns, first, last, shape, path)
    if np.any(events["t_us"][1:] < events["t_us"][:-1]):
        raise SpecError("events/t goes back in time", file=path)
    events["t_us"] += offset
    low = 0 if begin_us is None else int(np.searchsorted(events["t_us"], begin_us, side="left"))
    high = events.size if end_us is None else int(np.searchsorted(events["t_us"], end_us, side="left"))
    return events[low:high], first + low


def stream_events(path: Path, count: int | None = None) -> Iterator[NDArray]:
    """All events in blocks, whose order and coordinates are not checked; `count` as for `read_events`.

    Raises
    ------
    SpecError
        If the file cannot be read, links to other files, or its parts do not fit each other.
    """
    with reading(path, "as events"), h5py.File(path, "r") as file:
        columns, total = _columns(file, path, count, any_integers=True)
        offset = _offset(file, path) if "t_offset" in file else 0
        for first in range(0, total, BLOCK):
            events = _block(columns, first, min(first + BLOCK, total), None, path)
            events["t_us"] += offset
            yield events


def read_shape(path: Path) -> tuple[int, int] | None:
    """Rows and columns of the event grid, px; None if the file does not state them, as those of DSEC.

    Raises
    ------
    SpecError
        If the file cannot be read, or states an impossible size.
    """
    with reading(path, "as events"), h5py.File(path, "r") as file:
        if not {"height", "width"} <= set(file.attrs):
            return None
        rows, cols = (int(file.attrs[name]) for name in ("height", "width"))
    if not (0 <= rows <= 1 << 16 and 0 <= cols <= 1 << 16):
        raise SpecError(f"has the size {cols}x{rows}; expected at most 65536x65536 px", file=path)
    return rows, cols


def _columns(file: Any, path: Path, count: int | None, any_integers: bool = False) -> tuple[dict[str, Any], int]:
    """The data sets of the events, and the number of events; other programs write integers of other sizes."""
    columns = {
        name: _column(file, f"events/{name}", path, np.uint64 if any_integers else kind, any_integers)
        for name, kind in COLUMNS.items()
    }
    sizes = {name: column.shape[0] for name, column in columns.items()}
    if len(set(sizes.values())) > 1:
        lengths = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise SpecError(f"the columns of events are of different lengths ({lengths})", file=path)
    total = sizes["t"]
    if count is not None and count != total:
        raise SpecError(f"holds {total} events; the recording has {count}", file=path)
    return columns, total


def _block(columns: Any, first: int, last: int, shape: tuple[int, int] | None, path: Path) -> NDArray:
    """Events first to last (not included), with times relative to ``t_offset``."""
    events = np.empty(last - first, dtype=EVENT_DTYPE)
    events["t_us"] = _in_range(columns["t"][first:last], "t", _LATEST_US, path)
    for name in ("x", "y"):
        values = _in_range(columns[name][first:last], name, _LAST_PX, path)
        if shape is not None and values.max() >= shape[name == "x"]:
            raise SpecError(f"events/{name} holds {values.max()}, outside the event grid", file=path)
        events[name] = values
    polarity = columns["p"][first:last]
    if polarity.min() < 0 or polarity.max() > 1:
        raise SpecError(f"events/p holds {polarity.min()} to {polarity.max()}; expected 0 and 1", file=path)
    events["polarity"] = polarity.astype(np.int8) * 2 - 1
    return events


def _in_range(values: NDArray, name: str, last: int, path: Path) -> NDArray:
    """Values that are no smaller than 0 and no larger than the last one."""
    if values.min() < 0 or values.max() > last:
        raise SpecError(f"events/{name} holds {values.min()} to {values.max()}; expected 0 to {last}", file=path)
    return values


def _column(file: Any, name: str, path: Path, kind: Any = np.uint64, signed: bool = False) -> Any:
    """A one-dimensional data set whose values are all stored, without fill values."""
    column = dataset_of(file, name, path, "uib" if signed else "ui")
    if column.dtype.kind not in ("uib" if signed else "u") or column.dtype.itemsize > np.dtype(kind).itemsize:
        raise SpecError(f"{name} holds {column.dtype.name}; expected {np.dtype(kind).name}", file=path)
    if column.ndim != 1:
        raise SpecError(f"{name} has shape {column.shape}; expected one dimension", file=path)
    if column.chunks is not None:
        require_memory(column.chunks[0] * column.dtype.itemsize, f"a chunk of {name}", path, LARGEST_CHUNK_BYTES)
    if not is_whole(column):
        raise SpecError(f"{name} holds fewer values than the {column.shape[0]} it says", file=path)
    return column


def _offset(file: Any, path: Path) -> int:
    stored = dataset_of(file, "t_offset", path)
    offset = int(stored[()]) if stored.shape == () else -1
    if not 0 <= offset <= _LATEST_US:
        raise SpecError(f"t_offset must be one whole number of µs from 0 to {_LATEST_US}", file=path)
    return offset


def _index(file: Any, total: int, path: Path) -> NDArray[np.int64]:
    """``ms_to_idx``: starts at 0, ends at the number of events, and never decreases."""
    entries = _column(file, "ms_to_idx", path)
    if not 0 < entries.shape[0] <= LONGEST_US // 1000 + 3:
        raise SpecError(f"ms_to_idx holds {entries.shape[0]} values; expected one for each ms", file=path)
    index = entries[:]
    if np.any(index[1:] < index[:-1]) or index[-1] > total:
        raise SpecError(f"ms_to_idx must run from 0 to the number of events, {total}, without going back", file=path)
    return index.astype(np.int64)


def _range(
    index: NDArray[np.int64], offset: int, count: int, begin_us: int | None, end_us: int | None
) -> tuple[int, int]:
    """Indices of the events in the wanted whole milliseconds."""
    last_ms = index.size - 1
    first, last = 0, count
    if begin_us is not None:
        first = int(index[min(max(0, (begin_us - offset) // 1000), last_ms)])
    if end_us is not None and (end_us - offset) // 1000 + 1 <= last_ms:
        last = int(index[max(0, (end_us - offset) // 1000 + 1)])
    return first, last


def _check_index(
    times: Any, first: int, last: int, offset: int, begin_us: int | None, end_us: int | None, path: Path
) -> None:
    """Check that the events just outside the indexed range lie outside the wanted time."""
    early = begin_us is not None and first > 0 and int(times[first - 1]) + offset >= begin_us
    late = end_us is not None and last < times.shape[0] and int(times[last]) + offset < end_us
    if early or late:
        raise SpecError("ms_to_idx does not fit the times of the events", file=path)

"""Events in HDF5, in the layout of the DSEC data set [gehrig2021], Blosc LZ4.

``events/t`` uint32 µs after ``t_offset``, ``events/x``, ``events/y`` uint16, ``events/p`` uint8 (1 ON,
0 OFF); ``ms_to_idx[k]`` is the index of the first event at or after k ms, ``t_offset`` int64 µs.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory
from hesim_render.core.hdf5 import COMPRESSION, LARGEST_CHUNK_BYTES, PLAIN_COMPRESSION, Disk, dataset_of, is_whole
from hesim_render.exchange.stream import BLOCK, EventStream
from hesim_render.pixels.evs.events import EVENT_DTYPE, no_events

_LATEST_US = 2**53  # 285 years
_LAST_PX = 2**16 - 1
_BYTES_IN_ALL = EVENT_DTYPE.itemsize + 12  # an event, and its columns while they are read
_CHUNK = 1 << 16
#: Data sets of the events, and the types of their values.
COLUMNS = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
#: Longest recording, µs.
LONGEST_US = 2**32 - 1


def read_events(
    path: Path,
    begin_us: float | None = None,
    end_us: float | None = None,
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
    begin_us: float | None = None,
    end_us: float | None = None,
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
    index: NDArray[np.int64], offset: int, count: int, begin_us: float | None, end_us: float | None
) -> tuple[int, int]:
    """Indices of the events in the wanted whole milliseconds."""
    last_ms = index.size - 1
    first, last = 0, count
    if begin_us is not None:
        first = int(index[int(min(max(0, begin_us - offset), 1000 * last_ms) // 1000)])
    if end_us is not None and end_us - offset < 1000 * last_ms:
        last = int(index[int(max(-1000, end_us - offset) // 1000 + 1)])
    return first, last


def _check_index(
    times: Any, first: int, last: int, offset: int, begin_us: float | None, end_us: float | None, path: Path
) -> None:
    """Check that the events just outside the indexed range lie outside the wanted time."""
    early = begin_us is not None and first > 0 and int(times[first - 1]) + offset >= begin_us
    late = end_us is not None and last < times.shape[0] and int(times[last]) + offset < end_us
    if early or late:
        raise SpecError("ms_to_idx does not fit the times of the events", file=path)


class EventFileWriter:
    """Appends events in order of time, with memory for one chunk only.

    Parameters
    ----------
    path : the file.
    shape : rows and columns of the event grid.
    begin_us, end_us : time range of the recording, µs; `begin_us` becomes ``t_offset``.
    packing : how data sets are packed, as h5py has it; None: Blosc LZ4.

    Raises
    ------
    SpecError
        If the range does not fit the format's 32 bits (71 minutes).
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        begin_us: int,
        end_us: int,
        packing: Mapping[str, Any] | None = None,
    ) -> None:
        packed = {"compression": COMPRESSION} if packing is None else packing
        if end_us - begin_us > LONGEST_US:
            raise SpecError(f"a recording of events holds at most {LONGEST_US} µs, not {end_us - begin_us}")
        self._begin_us, self._duration_us = begin_us, end_us - begin_us
        self._pending: list[NDArray] = []
        self._pending_count = 0
        self._written = 0
        self._last_us = begin_us
        self._first_of_ms = np.zeros(1, dtype=np.uint64)
        self._disk = Disk(path)
        self._file = h5py.File(self._disk, "w")
        for name, kind in COLUMNS.items():
            self._file.create_dataset(
                f"events/{name}", shape=(0,), maxshape=(None,), chunks=(_CHUNK,), dtype=kind, **packed
            )
        self._file["t_offset"] = np.int64(begin_us)
        self._file.attrs.update({"height": shape[0], "width": shape[1], "time_unit": "µs", "begin_us": begin_us})
        self._file.attrs["end_us"] = end_us

    def append(self, events: NDArray) -> None:
        """Append events (`EVENT_DTYPE`), which must not be earlier than those before."""
        if events.size == 0:
            return
        times = events["t_us"]
        if times[0] < self._last_us or np.any(times[1:] < times[:-1]):
            raise ValueError("events must come in order of time")
        self._last_us = int(times[-1])
        self._pending.append(events)
        self._pending_count += events.size
        if self._pending_count >= _CHUNK:
            with self._disk.own_errors():
                self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        block = np.concatenate(self._pending)
        self._pending, self._pending_count = [], 0
        relative = block["t_us"] - self._begin_us
        columns = {"t": relative, "x": block["x"], "y": block["y"], "p": block["polarity"] > 0}
        for name, kind in COLUMNS.items():
            dataset = self._file[f"events/{name}"]
            dataset.resize((self._written + block.size,))
            dataset[self._written :] = columns[name].astype(kind)
            dataset.flush()  # its chunks have their place in the file now, whoever else refers to the data set
        # milliseconds after the last indexed one, up to the last event of this block
        new_ms = np.arange(self._first_of_ms.size, relative[-1] // 1000 + 1)
        index = self._written + np.searchsorted(relative, new_ms * 1000, side="left")
        self._first_of_ms = np.concatenate([self._first_of_ms, index.astype(np.uint64)])
        self._written += block.size

    def close(self) -> None:
        """Write the pending events and the millisecond index."""
        with self._disk.own_errors():
            self._flush()
            missing = self._duration_us // 1000 + 2 - self._first_of_ms.size
            rest = np.full(max(0, missing), self._written, dtype=np.uint64)
            self._file["ms_to_idx"] = np.concatenate([self._first_of_ms, rest])
            self._file.close()
            self._disk.close()

    def abandon(self) -> None:
        """Close the unfinished file before it is removed."""
        self._file.close()
        self._disk.close()


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events in the layout of DSEC; if the stream does not state its interval, it is read twice.

    Raises
    ------
    SpecError
        If the events do not fit into 32 bits (71 minutes).
    """
    _write(stream, file, None)


def write_plain(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """As `write`, packed with deflate, which every reader of HDF5 unpacks without a plugin; it takes longer."""
    _write(stream, file, PLAIN_COMPRESSION)


def _write(stream: EventStream, file: IO[bytes], packing: Mapping[str, Any] | None) -> None:
    writer = EventFileWriter(Path(file.name), stream.shape, *stream.span_us(), packing)
    try:
        for events in stream:
            writer.append(events)
        writer.close()
    except BaseException:
        writer.abandon()
        raise

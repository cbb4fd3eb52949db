"""Writing of events in the layout of DSEC [gehrig2021], in order of time and with memory for one chunk."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.exchange.stream import EventStream

_CHUNK = 1 << 16
#: Data sets of the events, and the types of their values.
COLUMNS = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
#: Longest recording, µs.
LONGEST_US = 2**32 - 1


class _Disk:
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
        found = self._file.readinto(view) or 0
        view[found:] = bytes(len(view) - found)  # data that were dropped
        return len(view)

    def truncate(self, size: int) -> int:
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size

    def flush(self) -> None:
        """Nothing is buffered."""

    def check(self) -> None:
        """Raise the error that was kept from HDF5."""
        if self._error is not None:
            raise self._error


class EventFileWriter:
    """Appends events in order of time, with memory for one chunk only.

    Parameters
    ----------
    path : the file.
    shape : rows and columns of the event grid.
    begin_us, end_us : time range of the recording, µs; `begin_us` becomes ``t_offset``.

    Raises
    ------
    SpecError
        If the range does not fit the format's 32 bits (71 minutes).
    """

    def __init__(self, path: Path, shape: tuple[int, int], begin_us: int, end_us: int) -> None:
        if end_us - begin_us > LONGEST_US:
            raise SpecError(f"a recording of events holds at most {LONGEST_US} µs, not {end_us - begin_us}")
        self._begin_us, self._duration_us = begin_us, end_us - begin_us
        self._pending: list[NDArray] = []
        self._pending_count = 0
        self._written = 0
        self._last_us = begin_us
        self._first_of_ms = np.zeros(1, dtype=np.uint64)
        self._disk = _Disk(path)
        self._file = h5py.File(self._disk, "w")
        compression = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)
        for name, kind in COLUMNS.items():
            self._file.create_dataset(
                f"events/{name}", shape=(0,), maxshape=(None,), chunks=(_CHUNK,), dtype=kind, compression=compression
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
            with self._told():
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
        # milliseconds after the last indexed one, up to the last event of this block
        new_ms = np.arange(self._first_of_ms.size, relative[-1] // 1000 + 1)
        index = self._written + np.searchsorted(relative, new_ms * 1000, side="left")
        self._first_of_ms = np.concatenate([self._first_of_ms, index.astype(np.uint64)])
        self._written += block.size

    def close(self) -> None:
        """Write the pending events and the millisecond index."""
        with self._told():
            self._flush()
            missing = self._duration_us // 1000 + 2 - self._first_of_ms.size
            rest = np.full(max(0, missing), self._written, dtype=np.uint64)
            self._file["ms_to_idx"] = np.concatenate([self._first_of_ms, rest])
            self._file.close()
            self._disk.close()

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """Raise an error of the disk in place of the error that HDF5 makes of it."""
        try:
            yield
        except (OSError, RuntimeError):
            self._disk.check()
            raise
        self._disk.check()

    def abandon(self) -> None:
        """Close the unfinished file before it is removed."""
        self._file.close()
        self._disk.close()


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events in the layout of DSEC; if the stream does not state its interval, it is read twice.

    Parameters
    ----------
    stream : the events.
    file : where to write; HDF5 opens it again by its name.
    target : name of the file, for errors.

    Raises
    ------
    SpecError
        If the events do not fit into 32 bits (71 minutes).
    """
    writer = EventFileWriter(Path(file.name), stream.shape, *stream.span_us())
    try:
        for events in stream:
            writer.append(events)
        writer.close()
    except BaseException:
        writer.abandon()
        raise

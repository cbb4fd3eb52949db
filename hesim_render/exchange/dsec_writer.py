"""Writing of events in the layout of DSEC [gehrig2021], in order of time and with memory for one chunk."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.hdf5 import COMPRESSION, PLAIN_COMPRESSION, Disk
from hesim_render.exchange.stream import EventStream

_CHUNK = 1 << 16
#: Data sets of the events, and the types of their values.
COLUMNS = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
#: Longest recording, µs.
LONGEST_US = 2**32 - 1


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

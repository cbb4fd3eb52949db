"""Events in HDF5, in the layout of the DSEC data set (Gehrig et al. 2021), Blosc LZ4.

``events/t`` uint32 µs after ``t_offset``, ``events/x``, ``events/y`` uint16, ``events/p`` uint8 (1 ON,
0 OFF); ``ms_to_idx[k]`` is the index of the first event at or after k ms, ``t_offset`` int64 µs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from hesim_render.errors import SpecError
from hesim_render.events import EVENT_DTYPE, no_events

_CHUNK = 1 << 16
_COLUMNS = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
_LONGEST_US = 2**32 - 1


class EventFileWriter:
    """Appends events, in order of time, with memory for one chunk only.

    Parameters
    ----------
    shape : rows and columns of the event grid.
    begin_us, end_us : time range of the recording; `begin_us` becomes ``t_offset``.

    Raises
    ------
    SpecError
        If the range does not fit the format's 32 bits (71 minutes).
    """

    def __init__(self, path: Path, shape: tuple[int, int], begin_us: int, end_us: int) -> None:
        if end_us - begin_us > _LONGEST_US:
            raise SpecError(f"a recording of events holds at most {_LONGEST_US} µs, not {end_us - begin_us}")
        self._begin_us, self._duration_us = begin_us, end_us - begin_us
        self._pending: list[NDArray] = []
        self._pending_count = 0
        self._written = 0
        self._last_us = begin_us
        self._first_of_ms = np.zeros(1, dtype=np.uint64)
        self._file = h5py.File(path, "w")
        compression = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)
        for name, kind in _COLUMNS.items():
            self._file.create_dataset(
                f"events/{name}", shape=(0,), maxshape=(None,), chunks=(_CHUNK,), dtype=kind, compression=compression
            )
        self._file["t_offset"] = np.int64(begin_us)
        self._file.attrs.update({"height": shape[0], "width": shape[1], "time_unit": "µs", "begin_us": begin_us})
        self._file.attrs["end_us"] = end_us

    def append(self, events: NDArray) -> None:
        """Add events; times must not go back."""
        if events.size == 0:
            return
        times = events["t_us"]
        if times[0] < self._last_us or np.any(times[1:] < times[:-1]):
            raise ValueError("events must come in order of time")
        self._last_us = int(times[-1])
        self._pending.append(events)
        self._pending_count += events.size
        if self._pending_count >= _CHUNK:
            self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        block = np.concatenate(self._pending)
        self._pending, self._pending_count = [], 0
        relative = block["t_us"] - self._begin_us
        columns = {"t": relative, "x": block["x"], "y": block["y"], "p": block["polarity"] > 0}
        for name, kind in _COLUMNS.items():
            dataset = self._file[f"events/{name}"]
            dataset.resize((self._written + block.size,))
            dataset[self._written :] = columns[name].astype(kind)
        # milliseconds that begin after the last one settled and not after this block's last event
        new_ms = np.arange(self._first_of_ms.size, relative[-1] // 1000 + 1)
        index = self._written + np.searchsorted(relative, new_ms * 1000, side="left")
        self._first_of_ms = np.concatenate([self._first_of_ms, index.astype(np.uint64)])
        self._written += block.size

    def close(self) -> None:
        """Write what is pending and the millisecond index."""
        try:
            self._flush()
            missing = self._duration_us // 1000 + 2 - self._first_of_ms.size
            rest = np.full(max(0, missing), self._written, dtype=np.uint64)
            self._file["ms_to_idx"] = np.concatenate([self._first_of_ms, rest])
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close without finishing; the file is about to be removed."""
        try:
            self._file.close()
        except (OSError, RuntimeError):
            return  # the disk is full: there is nothing left to save


def read_events(path: Path, begin_us: int | None = None, end_us: int | None = None) -> NDArray:
    """Events with begin_us <= t_us < end_us (default: all), read from disk in that part only.

    Returns
    -------
    `EVENT_DTYPE`, in order of time.

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    try:
        with h5py.File(path, "r") as file:
            offset = int(file["t_offset"][()])
            first, last = _range(file, offset, begin_us, end_us)
            if last <= first:
                return no_events()
            events = np.empty(last - first, dtype=EVENT_DTYPE)
            events["t_us"] = file["events/t"][first:last]
            events["x"], events["y"] = file["events/x"][first:last], file["events/y"][first:last]
            events["polarity"] = file["events/p"][first:last].astype(np.int8) * 2 - 1
    except (OSError, KeyError, RuntimeError) as error:
        raise SpecError(f"cannot be read as events ({str(error).splitlines()[0]})", file=path) from None
    events["t_us"] += offset
    low = 0 if begin_us is None else int(np.searchsorted(events["t_us"], begin_us, side="left"))
    high = events.size if end_us is None else int(np.searchsorted(events["t_us"], end_us, side="left"))
    return events[low:high]


def _range(file: Any, offset: int, begin_us: int | None, end_us: int | None) -> tuple[int, int]:
    """Indices that hold the wanted times, by whole milliseconds."""
    index, count = file["ms_to_idx"], int(file["events/t"].shape[0])
    last_ms = index.shape[0] - 1
    first, last = 0, count
    if begin_us is not None:
        first = int(index[min(max(0, (begin_us - offset) // 1000), last_ms)])
    if end_us is not None and (end_us - offset) // 1000 + 1 <= last_ms:
        last = int(index[max(0, (end_us - offset) // 1000 + 1)])
    return first, last

"""Labels of events: one file of labels and lost events, the noise-free events in the layout of events.h5, and the
object that each event's pixel shows.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside, reading, require_memory
from hesim_render.core.hdf5 import COMPRESSION, dataset_of, new_file
from hesim_render.exchange.dsec import EventFileWriter, read_events, stream_events
from hesim_render.pixels.evs.events import EVENT_DTYPE, EventLabels, Label, LabelBlock, Lost

LABEL_FILE, CLEAN_FILE = "truth/event_labels.h5", "truth/clean_events.h5"
OBJECT_FILE = "truth/event_objects.h5"
_COLUMNS = {"t_us": "i8", "x": "u2", "y": "u2", "polarity": "i1"}
#: A lost event while it waits.
_LOST = np.dtype([*_COLUMNS.items(), ("in", "u1")])
#: Entries that are read at once.
_PIECE = 1 << 18
_ALL = slice(None)


class LabelFileWriter:
    """Takes labels block by block, with memory for one chunk only.

    Labels may change until the end of the run, which packed data sets cannot. So both lists wait in files without
    packing, which become data sets of known size at the end.

    Parameters
    ----------
    folder : of the recording.
    shape : rows and columns of the event grid.
    begin_us, end_us : time of the recording, µs.
    """

    def __init__(self, folder: Path, shape: tuple[int, int], begin_us: int, end_us: int) -> None:
        self._path = folder / LABEL_FILE
        self._parts = [self._path.with_suffix(suffix) for suffix in (".label", ".lost")]
        self._count = 0
        with contextlib.ExitStack() as opened:
            self._label, self._lost = (opened.enter_context(part.open("w+b", buffering=0)) for part in self._parts)
            self._clean = EventFileWriter(folder / CLEAN_FILE, shape, begin_us, end_us)
            self._files = opened.pop_all()

    def append(self, block: LabelBlock) -> None:
        """Append a block."""
        self._label.seek(0, os.SEEK_END)
        _write(self._label, block.label)
        self._count += block.label.size
        self._change(block.changed, block.changed_to)
        lost = np.empty(block.lost.size, _LOST)
        for name in _COLUMNS:
            lost[name] = block.lost[name]
        lost["in"] = block.lost_in
        _write(self._lost, lost)
        self._clean.append(block.clean)

    def _change(self, event: NDArray[np.int64], to: NDArray[np.uint8]) -> None:
        """Change labels where they lie, one piece of the file at a time."""
        order = np.argsort(event, kind="stable")
        event, to = event[order], to[order]
        piece = event // _PIECE
        for these in np.split(np.arange(event.size), np.flatnonzero(np.diff(piece)) + 1):
            if these.size == 0:
                continue
            begin, end = int(event[these[0]]), int(event[these[-1]]) + 1
            self._label.seek(begin)
            values = np.frombuffer(_read(self._label, end - begin), np.uint8).copy()
            values[event[these] - begin] = to[these]
            self._label.seek(begin)
            _write(self._label, values)

    def close(self) -> None:
        """Write both files."""
        with new_file(self._path) as file:
            self._pack(file, "label", self._label, np.dtype([("label", "u1")]))
            for column in ("in", *_COLUMNS):
                self._pack(file, f"lost/{column}", self._lost, _LOST)
            file["label"].attrs.update({label.name.lower(): int(label) for label in Label})
            file["lost/in"].attrs.update({place.name.lower(): int(place) for place in Lost})
        self._clean.close()
        self._drop_parts()

    @staticmethod
    def _pack(file: Any, name: str, stored: IO[bytes], rows: np.dtype) -> None:
        """Make a data set of one column of a file of rows."""
        column = name.rsplit("/")[-1]
        count = stored.seek(0, os.SEEK_END) // rows.itemsize
        stored.seek(0)
        chunks = {"chunks": True, "compression": COMPRESSION} if count else {}
        made = file.create_dataset(name, (count,), rows[column], **chunks)
        # whole chunks, so that none is packed twice
        step = made.chunks[0] * max(1, _PIECE // made.chunks[0]) if count else 1
        for begin in range(0, count, step):
            size = min(step, count - begin)
            made[begin : begin + size] = np.frombuffer(_read(stored, size * rows.itemsize), rows)[column]
        made.flush()

    def abandon(self) -> None:
        """Close the unfinished files before they are removed."""
        self._clean.abandon()
        self._drop_parts()

    def _drop_parts(self) -> None:
        self._files.close()
        for part in self._parts:
            part.unlink(missing_ok=True)


def _write(file: IO[bytes], values: NDArray) -> None:
    """Write all bytes; a file without a buffer may take only some of them at a time."""
    view = memoryview(values.tobytes())
    while len(view):
        view = view[file.write(view) :]


def _read(file: IO[bytes], size: int) -> bytes:
    """Read this many bytes, which are there."""
    parts = []
    while size:
        parts.append(file.read(size))
        size -= len(parts[-1])
    return b"".join(parts)


def write_objects(folder: Path, objects_at: Callable[[NDArray, NDArray, NDArray], NDArray[np.uint16]]) -> None:
    """Write the object of each event, block by block.

    Parameters
    ----------
    folder : of the recording, whose ``events.h5`` is complete.
    objects_at : numbers of the objects at times, columns and rows of events.
    """
    with new_file(folder / OBJECT_FILE) as file:
        made = file.create_dataset(
            "object", (0,), np.uint16, maxshape=(None,), chunks=(_PIECE,), compression=COMPRESSION
        )
        waiting, done = np.empty(0, np.uint16), 0
        for events in stream_events(folder / "events.h5"):
            waiting = np.concatenate([waiting, objects_at(events["t_us"], events["x"], events["y"])])
            whole = waiting.size // _PIECE * _PIECE
            if whole:
                made.resize((done + whole,))
                made[done:] = waiting[:whole]
                made.flush()
                waiting, done = waiting[whole:], done + whole
        made.resize((done + waiting.size,))
        made[done:] = waiting
        made.flush()


def read_objects(folder: Path, count: int, part: slice = _ALL) -> NDArray[np.uint16]:
    """The object of each event of a recording, [event].

    Parameters
    ----------
    folder : of the recording.
    count : number of its events.
    part : the events that are wanted.

    Raises
    ------
    SpecError
        If the file is damaged, or does not fit the recording.
    """
    path = inside(folder, OBJECT_FILE)
    with reading(path, "as objects of events"), h5py.File(path, "r") as file:
        return _of_events(file, "object", path, np.uint16, count, part)


def read_causes(folder: Path, count: int, part: slice = _ALL) -> NDArray[np.uint8]:
    """The cause of each event, numbers of `Label`, [event]; parameters as for `read_objects`.

    Raises
    ------
    SpecError
        If the file is missing or damaged, or does not fit the recording.
    """
    path = inside(folder, LABEL_FILE)
    with reading(path, "as labels"), h5py.File(path, "r") as file:
        label = _of_events(file, "label", path, np.uint8, count, part)
    if label.size and label.max() > max(Label):
        raise SpecError(f"label holds {label.max()}; expected 0 to {int(max(Label))}", file=path)
    return label


def read_labels(folder: Path, shape: tuple[int, int], count: int) -> EventLabels:
    """Labels of a recording.

    Parameters
    ----------
    folder : of the recording.
    shape : rows and columns of the event grid.
    count : number of its events.

    Raises
    ------
    SpecError
        If a file is missing or damaged, or does not fit the recording.
    """
    path, label = inside(folder, LABEL_FILE), read_causes(folder, count)
    with reading(path, "as labels"), h5py.File(path, "r") as file:
        lost_in = _column(file, "lost/in", path, np.uint8)
        lost = np.empty(lost_in.size, EVENT_DTYPE)
        for name, kind in _COLUMNS.items():
            values = _column(file, f"lost/{name}", path, np.dtype(kind))
            if values.size != lost_in.size:
                raise SpecError("the columns of lost events are of different lengths", file=path)
            lost[name] = values
    return EventLabels(label, lost, lost_in, read_events(inside(folder, CLEAN_FILE), shape=shape))


def _of_events(file: Any, name: str, path: Path, kind: Any, count: int, part: slice) -> NDArray:
    """Part of a column that has one entry for each event."""
    size = dataset_of(file, name, path).size
    if size != count:
        raise SpecError(f"holds {size} {name}s; the recording has {count} events", file=path)
    return _column(file, name, path, kind, part)


def _column(file: Any, name: str, path: Path, kind: Any, part: slice = _ALL) -> NDArray:
    dataset = dataset_of(file, name, path)
    if dataset.dtype != np.dtype(kind) or dataset.ndim != 1:
        held, wanted = f"{dataset.dtype.name} {dataset.shape}", np.dtype(kind).name
        raise SpecError(f"{name} holds {held}; expected one column of {wanted}", file=path)
    begin, end, _ = part.indices(dataset.shape[0])
    require_memory((end - begin) * dataset.dtype.itemsize, name, path)
    return dataset[begin:end]

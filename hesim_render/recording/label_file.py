"""Labels of events: one file of labels and lost events, and the noise-free events in the layout of events.h5."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside, reading, require_memory
from hesim_render.core.hdf5 import COMPRESSION, Disk, dataset_of
from hesim_render.exchange.dsec import EventFileWriter, read_events
from hesim_render.pixels.evs.events import EVENT_DTYPE, EventLabels, Label, Lost

LABEL_FILE, CLEAN_FILE = "truth/event_labels.h5", "truth/clean_events.h5"
_COLUMNS = {"t_us": "i8", "x": "u2", "y": "u2", "polarity": "i1"}


def write_labels(folder: Path, labels: EventLabels, shape: tuple[int, int], begin_us: int, end_us: int) -> None:
    """Write both files.

    Parameters
    ----------
    folder : of the recording.
    labels : of its events.
    shape : rows and columns of the event grid.
    begin_us, end_us : time of the recording, µs.
    """
    disk = Disk(folder / LABEL_FILE)
    file = h5py.File(disk, "w")
    try:
        with disk.told():
            chunks = {"chunks": True, "compression": COMPRESSION}
            for name, values in (
                ("label", labels.label),
                ("lost/in", labels.lost_in),
                *((f"lost/{column}", labels.lost[column]) for column in _COLUMNS),
            ):
                file.create_dataset(name, data=np.ascontiguousarray(values), **(chunks if values.size else {})).flush()
            file["label"].attrs.update({label.name.lower(): int(label) for label in Label})
            file["lost/in"].attrs.update({place.name.lower(): int(place) for place in Lost})
            file.close()
            disk.close()
    except BaseException:
        file.close()
        disk.close()
        raise
    clean = EventFileWriter(folder / CLEAN_FILE, shape, begin_us, end_us)
    try:
        clean.append(labels.clean)
        clean.close()
    except BaseException:
        clean.abandon()
        raise


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
    path = inside(folder, LABEL_FILE)
    with reading(path, "as labels"), h5py.File(path, "r") as file:
        label = _column(file, "label", path, np.uint8)
        if label.size != count:
            raise SpecError(f"holds {label.size} labels; the recording has {count} events", file=path)
        if label.size and label.max() > max(Label):
            raise SpecError(f"label holds {label.max()}; expected 0 to {int(max(Label))}", file=path)
        lost_in = _column(file, "lost/in", path, np.uint8)
        lost = np.empty(lost_in.size, EVENT_DTYPE)
        for name, kind in _COLUMNS.items():
            values = _column(file, f"lost/{name}", path, np.dtype(kind))
            if values.size != lost_in.size:
                raise SpecError("the columns of lost events are of different lengths", file=path)
            lost[name] = values
    return EventLabels(label, lost, lost_in, read_events(inside(folder, CLEAN_FILE), shape=shape))


def _column(file: Any, name: str, path: Path, kind: Any) -> NDArray:
    found = dataset_of(file, name, path)
    if found.dtype != np.dtype(kind) or found.ndim != 1:
        raise SpecError(f"{name} holds {found.dtype.name} {found.shape}; expected one column of {np.dtype(kind).name}",
                        file=path)  # fmt: skip
    require_memory(found.shape[0] * found.dtype.itemsize, name, path)
    return found[()]

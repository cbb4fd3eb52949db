"""Events in HDF5 as Metavision writes them: records x, y, p, t in ``CD/events``, packed with ECF.

``CD/indexes`` has an entry for every 2 ms: number and time of the first event of the period before. ``EXT_TRIGGER`` has
the edges of trigger lines in the same form, not packed. No HDF5 plugin is needed: chunks are packed and unpacked by
`ecf`.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory
from hesim_render.core.hdf5 import LARGEST_CHUNK_BYTES, dataset_of, is_whole, new_file, require_sound_heaps
from hesim_render.exchange import ecf
from hesim_render.exchange.stream import EventStream
from hesim_render.exchange.triggers import MOST_TRIGGERS, TRIGGER_DTYPE, no_triggers
from hesim_render.pixels.evs.events import events_of, no_events

EVENTS, TRIGGERS = "CD/events", "EXT_TRIGGER/events"
_CHUNK, _PERIOD_US = 1 << 14, 2000
_RECORD = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"],
                    "offsets": [0, 2, 4, 8], "itemsize": 16})  # fmt: skip
_EDGE = np.dtype({"names": ["p", "t", "id"], "formats": ["<i2", "<i8", "<i2"], "offsets": [0, 8, 16], "itemsize": 24})
_INDEX = np.dtype([("id", "<u8"), ("ts", "<i8")])


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events and triggers.

    Raises
    ------
    SpecError
        If the sensor has more than 2048 rows or columns.
    """
    rows, cols = stream.shape
    stream.require_side(ecf.LARGEST_SIDE, "ECF", target)
    text = h5py.string_dtype("ascii")
    with new_file(Path(file.name)) as made:
        for key, value in {
            "version": "1.0", "geometry": f"{cols}x{rows}", "camera_integrator_name": "hesim_render",
        }.items():  # fmt: skip
            made.attrs.create(key, value, dtype=text)
        stored = _packed_records(made)
        count, index = 0, _Index()
        waiting = no_events()
        for events in stream:
            index.add(events["t_us"])
            waiting = np.concatenate([waiting, events])
            whole = waiting.size // _CHUNK * _CHUNK
            for k in range(0, whole, _CHUNK):
                count += _append(stored, count, waiting[k : k + _CHUNK])
            waiting = waiting[whole:]
        if waiting.size:
            _append(stored, count, waiting)
        index.write(made, "CD")
        _write_triggers(made, stream.triggers())


def _packed_records(made: Any) -> Any:
    """An empty data set for chunks of ECF. Its filter is optional, so that HDF5 need not have it."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((_CHUNK,))
    layout.set_filter(ecf.FILTER, h5py.h5z.FLAG_OPTIONAL, ())
    layout.set_obj_track_times(False)  # the same events give the same bytes at any time
    space = h5py.h5s.create_simple((0,), (h5py.h5s.UNLIMITED,))
    return h5py.h5d.create(
        made.create_group("CD").id, b"events", h5py.h5t.py_create(_RECORD, logical=True), space, layout
    )


def _append(stored: Any, count: int, events: NDArray) -> int:
    stored.set_extent((count + events.size,))
    stored.write_direct_chunk((count,), ecf.encoded(events))
    stored.flush()  # its chunk has its place in the file now
    return events.size


def _write_triggers(made: Any, triggers: NDArray) -> None:
    edges = np.zeros(triggers.size, _EDGE)
    edges["t"], edges["p"], edges["id"] = triggers["t_us"], triggers["edge"] > 0, triggers["channel"]
    made.create_dataset(TRIGGERS, data=edges, chunks=(_CHUNK,), maxshape=(None,))
    index = _Index()
    index.add(triggers["t_us"])
    index.write(made, "EXT_TRIGGER")


class _Index:
    """Number and time of the first event of each period, counted from the first event."""

    def __init__(self) -> None:
        self._begin: int | None = None
        self._done = 0
        self._first: list[NDArray] = [np.empty(0, _INDEX)]

    def add(self, times_us: NDArray[np.int64]) -> None:
        if times_us.size == 0:
            return
        self._begin = int(times_us[0]) if self._begin is None else self._begin
        since = times_us - self._begin
        known = sum(part.size for part in self._first)
        periods = np.arange(known, int(since[-1]) // _PERIOD_US + 1)
        at = np.searchsorted(since, periods * _PERIOD_US)
        result = np.empty(periods.size, _INDEX)
        result["id"], result["ts"] = at + self._done, since[at]
        self._first.append(result)
        self._done += times_us.size

    def write(self, made: Any, group: str) -> None:
        """Write the entries as OpenEB's writer has them: each names the first event of the last period with events
        before its own (none: 0 at −1), and one more the last of all.
        """
        first = np.concatenate(self._first)
        rows = np.zeros(first.size + 1 if first.size else 0, _INDEX)
        if first.size:
            _, at = np.unique(first["id"], return_index=True)
            distinct = np.concatenate([np.array([(0, -1)], _INDEX), first[at]])
            rows[:-1] = distinct[np.searchsorted(first["id"][at], first["id"], side="left")]
            rows[-1] = first[-1]
        stored = made.create_dataset(f"{group}/indexes", data=rows, chunks=(_CHUNK,), maxshape=(None,))
        if self._begin is not None:
            stored.attrs.create("offset", str(-self._begin), dtype=h5py.string_dtype("ascii"))


def holds(path: Path) -> bool:
    """True if an HDF5 file has ``CD/events``.

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    with reading(path, "as an HDF5 file"), h5py.File(path, "r") as file:
        return isinstance(file.get("CD", getlink=True), h5py.HardLink) and "events" in file["CD"]


def read_shape(path: Path) -> tuple[int, int] | None:
    """Rows and columns of the sensor, px; None if the file does not state them.

    Raises
    ------
    SpecError
        If the file cannot be read, or states an impossible size.
    """
    require_sound_heaps(path)
    with reading(path, "as events"), h5py.File(path, "r") as file:
        stated = file.attrs.get("geometry")
    text = stated.decode("ascii", "replace") if isinstance(stated, bytes) else stated
    if text is None:
        return None
    sides = str(text).split("x")
    if len(sides) != 2 or not all(s.isdecimal() and len(s) < 6 and 0 < int(s) <= 1 << 16 for s in sides):
        raise SpecError(f"has the geometry {str(text)[:40]!r}; expected WIDTHxHEIGHT", file=path)
    return int(sides[1]), int(sides[0])


def read(path: Path) -> Iterator[NDArray]:
    """Blocks of events, one a chunk.

    Raises
    ------
    SpecError
        If the file is damaged, or packed in a way that is not known.
    """
    with reading(path, "as events"), h5py.File(path, "r") as file:
        stored = _records(file, EVENTS, "xypt", path)
        count = int(stored.shape[0])
        chunk = int(stored.chunks[0]) if stored.chunks else max(1, min(count, 1 << 20))
        is_packed = _is_packed(stored)
        if is_packed and chunk > ecf.MOST_EVENTS:
            raise SpecError(f"{EVENTS} has chunks of {chunk} events; ECF has at most {ecf.MOST_EVENTS}", file=path)
        for first in range(0, count, chunk):
            size = min(chunk, count - first)
            if is_packed:
                yield _unpacked(stored, first, size, path)
                continue
            rows = stored[first : first + size]
            if rows["p"].min() < -1 or rows["p"].max() > 1 or min(rows["x"].min(), rows["y"].min()) < 0:
                raise SpecError(f"{EVENTS} has events that are none, from number {first}", file=path)
            yield events_of(rows["t"], rows["x"], rows["y"], rows["p"])


def _unpacked(stored: Any, first: int, size: int, path: Path) -> NDArray:
    where = f"the chunk of {EVENTS} from event {first}"
    place = stored.id.get_chunk_info_by_coord((first,))
    if place.byte_offset is None:
        raise SpecError(f"{where} is missing", file=path)
    require_memory(place.size, where, path, LARGEST_CHUNK_BYTES)
    skipped, data = stored.id.read_direct_chunk((first,))
    if skipped:
        raise SpecError(f"{where} is not packed with ECF, as the file says", file=path)
    return ecf.decoded(data, size, path, where)


def read_triggers(path: Path) -> NDArray:
    """All edges of trigger lines, [edge] of `TRIGGER_DTYPE`; none if the file has no such data set.

    Raises
    ------
    SpecError
        If the file is damaged.
    """
    with reading(path, "as triggers"), h5py.File(path, "r") as file:
        if not isinstance(file.get("EXT_TRIGGER", getlink=True), h5py.HardLink) or TRIGGERS not in file:
            return no_triggers()
        stored = _records(file, TRIGGERS, ("p", "t", "id"), path)
        if _is_packed(stored) or stored.shape[0] > MOST_TRIGGERS:
            problem = f"{TRIGGERS} is packed with ECF, or has more than {MOST_TRIGGERS} edges"
            raise SpecError(problem, file=path)
        rows = stored[:]
    if rows.size and not 0 <= rows["id"].min() <= rows["id"].max() < 256:
        raise SpecError(f"{TRIGGERS} names a line that is none; expected 0 to 255", file=path)
    result = np.empty(rows.size, TRIGGER_DTYPE)
    result["t_us"], result["channel"], result["edge"] = rows["t"], rows["id"], np.where(rows["p"] > 0, 1, -1)
    return result


def _records(file: Any, name: str, fields: Any, path: Path) -> Any:
    stored = dataset_of(file, name, path, "V", also=(ecf.FILTER,))
    kinds = stored.dtype.fields or {}
    if stored.ndim != 1 or not set(fields) <= set(kinds) or any(kinds[k][0].kind not in "ui" for k in fields):
        raise SpecError(
            f"{name} holds {stored.dtype}; expected records of whole numbers {', '.join(fields)}", file=path
        )
    require_memory((stored.chunks or stored.shape)[0] * stored.dtype.itemsize, f"a chunk of {name}", path,
                   LARGEST_CHUNK_BYTES if stored.chunks else None)  # fmt: skip
    if not is_whole(stored):
        raise SpecError(f"{name} holds fewer records than the {stored.shape[0]} it says", file=path)
    return stored


def _is_packed(stored: Any) -> bool:
    layout = stored.id.get_create_plist()
    used = [layout.get_filter(k)[0] for k in range(layout.get_nfilters())]
    if ecf.FILTER in used and len(used) > 1:
        raise SpecError(f"{stored.name} has other filters beside ECF", file=stored.file.filename)
    return ecf.FILTER in used

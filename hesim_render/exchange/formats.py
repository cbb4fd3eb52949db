"""The formats by name, and the opening of event files."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import inside, printable, reading
from hesim_render.exchange import (
    aedat4,
    dat,
    dsec,
    e2vid,
    event_packets,
    evt2,
    evt3,
    frame_files,
    mcap_file,
    nmnist,
    prophesee_hdf5,
    raw_file,
    text_events,
    text_form,
)
from hesim_render.exchange.stream import EventStream


@dataclass(frozen=True)
class EventFormat:
    """A format of events.

    Parameters
    ----------
    suffix : end of the names of its files.
    write : writes a stream into an open file; the third argument is its name, for errors. HDF5 opens it again by its
        name. Raises `SpecError` if the events do not fit into the format.
    """

    suffix: str
    write: Callable[[EventStream, IO[bytes], str | Path], None]


@dataclass(frozen=True)
class FrameFormat:
    """Suffix of a format's files, and the function that writes one: of its path and a frame [row, col], DN."""

    suffix: str
    write: Callable[[Path, NDArray[Any]], None]


#: Formats of Prophesee's RAW files, which one header is common to.
_RAW = {"evt2": evt2, "evt3": evt3}
EVENT_FORMATS = {
    **{name: EventFormat(".raw", kind.write) for name, kind in _RAW.items()},
    "dat": EventFormat(".dat", dat.write),
    "prophesee": EventFormat(".hdf5", prophesee_hdf5.write),
    "aedat4": EventFormat(".aedat4", aedat4.write),
    "dsec": EventFormat(".h5", dsec.write),
    "dsec-gzip": EventFormat(".h5", dsec.write_plain),
    "npz": EventFormat(".npz", e2vid.write_arrays),
    "txt": EventFormat(".txt", e2vid.write_text),
    "nmnist": EventFormat(".bin", nmnist.write),
}
FRAME_FORMATS = {
    "tiff": FrameFormat(".tiff", frame_files.write_tiff),
    "png": FrameFormat(".png", frame_files.write_png),
    "npy": FrameFormat(".npy", frame_files.write_npy),
    "mipi": FrameFormat(".bin", frame_files.write_mipi),
}
#: Formats that can be read, by the first bytes of their files.
_BEGINS = {b"% ": "raw", b"#!AER-DAT": "aedat4", b"\x89HDF\r\n\x1a\n": "dsec", b"PK": "npz", mcap_file.BEGIN: "mcap"}
READABLE = (*_RAW, "dat", "prophesee", "aedat4", "dsec", "npz", "mcap", "txt")


def open_events(
    path: str | Path, format: str | None = None, shape: tuple[int, int] | None = None, *, keep_stated: bool = False
) -> EventStream:
    """Open an event file of any known format; the events are read when the stream is used.

    Parameters
    ----------
    path : the file: EVT2 or EVT3 RAW, DAT, AEDAT4, HDF5 in the layout of DSEC or of Prophesee, ``.npz`` with t, x, y
        and p, MCAP with messages of type EventArray or EventPacket, or text with a line t x y p for each event; or the
        folder of a recording, whose ``events.h5`` is read.
    format : ``evt2``, ``evt3``, ``dat``, ``prophesee``, ``aedat4``, ``dsec``, ``npz``, ``mcap`` or ``txt``; default:
        what the begin of the file says.
    shape : rows and columns of the event grid, px; needed if the file does not state them.
    keep_stated : let the shape that the file states, if it does, come before `shape`.

    Returns
    -------
    The stream.

    Raises
    ------
    RangeError
        If `format` cannot be read.
    SpecError
        If the file is not of the format, is damaged, or has no size and `shape` is not given.
    """
    file = Path(path).expanduser()
    if file.is_dir():
        file = inside(file, "events.h5")
    if format is not None and format not in READABLE:
        raise RangeError("format", format, f"one of {', '.join(READABLE)}")
    result = _detect(file)
    if format is not None and result != format:
        actual = f"which is {result}" if result else "which has another begin"
        raise SpecError(f"was to be read as {format}, {actual}", file=file)
    if result is None:
        raise SpecError(f"is of no known event format; expected one of {', '.join(READABLE)}", file=file)
    stream = _OPENERS[result](file)
    if shape is not None and not (keep_stated and stream.shape != (0, 0)):
        return replace(stream, shape=shape)
    if stream.shape == (0, 0):
        raise SpecError("does not state the size of the sensor; give it (--size WIDTHxHEIGHT, shape)", file=file)
    return stream


def is_event_file(path: str | Path) -> bool:
    """True if the begin of a file is that of an event format, and it holds no arrays of a frame (``.npz``).

    Raises
    ------
    SpecError
        If the file cannot be read.
    """
    file = Path(path).expanduser()
    with reading(file), file.open("rb") as opened:
        begin = opened.read(16)
    name = next((name for start, name in _BEGINS.items() if begin.startswith(start)), None)
    if name != "npz":
        return name is not None or _is_text(file)
    with reading(file, "as arrays"), np.load(file) as arrays:
        return not {"raw", "aps_raw"} & set(arrays.files)


def _is_text(file: Path) -> bool:
    """Whether a file is a list of events as text, by its suffix and its begin."""
    return file.suffix.lower() in text_form.TEXT_SUFFIXES and text_form.is_text(file)


def _detect(file: Path) -> str | None:
    with reading(file), file.open("rb") as opened:
        begin = opened.read(16)
    if _is_text(file):
        return "txt"
    result = next((name for start, name in _BEGINS.items() if begin.startswith(start)), None)
    if result == "raw" and dat.is_dat(file):
        return "dat"
    if result == "raw":
        name = raw_file.read_header(file)[0]
        if name.lower() not in _RAW or not name.isupper():
            expected = " or ".join(_RAW).upper()
            raise SpecError(f"has the format {printable(name)!r}; expected {expected}", file=file)
        return name.lower()
    return "prophesee" if result == "dsec" and prophesee_hdf5.holds(file) else result


def _open_raw(file: Path) -> EventStream:
    name, shape, begin = raw_file.read_header(file)
    kind = _RAW[name.lower()]
    return EventStream(
        lambda: kind.read(file, begin), shape or (0, 0), file, triggers=lambda: kind.read_triggers(file, begin)
    )


def _open_dat(file: Path) -> EventStream:
    shape, begin = dat.read_header(file)
    return EventStream(lambda: dat.read(file, begin), shape or (0, 0), file)


def _open_prophesee(file: Path) -> EventStream:
    shape = prophesee_hdf5.read_shape(file) or (0, 0)
    triggers = lambda: prophesee_hdf5.read_triggers(file)  # noqa: E731
    return EventStream(lambda: prophesee_hdf5.read(file), shape, file, triggers=triggers)


def _open_aedat4(file: Path) -> EventStream:
    shape, *where = aedat4.read_header(file)
    return EventStream(lambda: aedat4.read(file, *where), shape, file)


def _open_dsec(file: Path) -> EventStream:
    return EventStream(lambda: dsec.stream_events(file), dsec.read_shape(file) or (0, 0), file)


def _open_npz(file: Path) -> EventStream:
    shape, names = e2vid.read_arrays_header(file)
    return EventStream(lambda: e2vid.read_arrays(file, names), shape or (0, 0), file)


def _open_mcap(file: Path) -> EventStream:
    if mcap_file.first_type(file) == mcap_file.PACKET_TYPES:
        shape, topic = event_packets.read_header(file)
        triggers = lambda: event_packets.read_triggers(file, topic)  # noqa: E731
        return EventStream(lambda: event_packets.read(file, topic), shape, file, triggers=triggers)
    shape, topic = mcap_file.read_header(file)
    return EventStream(lambda: mcap_file.read(file, topic), shape, file)


def _open_text(file: Path) -> EventStream:
    form = text_form.read_form(file)
    return EventStream(lambda: text_events.read(file, form), form.shape or (0, 0), file)


_OPENERS: dict[str, Callable[[Path], EventStream]] = {
    **dict.fromkeys(_RAW, _open_raw),
    "dat": _open_dat,
    "prophesee": _open_prophesee,
    "aedat4": _open_aedat4,
    "dsec": _open_dsec,
    "npz": _open_npz,
    "mcap": _open_mcap,
    "txt": _open_text,
}

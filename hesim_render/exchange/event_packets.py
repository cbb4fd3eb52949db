"""Events in MCAP as drivers of ROS 2 send them: ``event_camera_msgs/msg/EventPacket`` with the encoding ``evt3``.

A packet holds the words of EVT3 as bytes. A decoder keeps its state from packet to packet. The writer begins each
packet with time and row, so that a reader can start with any.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable
from hesim_render.exchange import evt3, mcap_file
from hesim_render.exchange.stream import EventStream
from hesim_render.exchange.triggers import joined, merged

TYPE = "event_camera_msgs/msg/EventPacket"
DEFINITION = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    f"bool is_bigendian\nuint8[] events\n{mcap_file.HEADER}"
)
_ENCODING = "evt3"
_LARGEST_SIDE = 1 << 11


def packets(stream: EventStream, target: str | Path) -> Iterator[tuple[int, bytes]]:
    """Time, µs, and content of each message; edges of triggers are among the words.

    Parameters
    ----------
    stream : the events.
    target : name of the file, for errors.

    Raises
    ------
    SpecError
        If the sensor has more than 2048 rows or columns, or an event lies after 2⁴⁴ µs.
    """
    stream.require_side(_LARGEST_SIDE, "EVT3", target)
    before, sent = None, 0
    for entries, is_trigger in merged(stream, stream.triggers(), stream.source, evt3.CHANNELS):
        if entries["t_us"][-1] > evt3.LATEST_US:
            raise SpecError(f"EVT3 ends at {evt3.LATEST_US} µs; an event is at {entries['t_us'][-1]} µs", file=target)
        for part in mcap_file.packet_slices(entries["t_us"]):
            here = entries[part]
            words = evt3.encoded(here, before, None if is_trigger is None else is_trigger[part], is_whole=True)
            t_us = int(here["t_us"][0])
            yield int(here["t_us"][-1]), _message(t_us, stream.shape, sent, words)
            before, sent = here[-1], sent + 1


def _message(t_us: int, shape: tuple[int, int], number: int, words: NDArray[np.uint16]) -> bytes:
    data = mcap_file.head(t_us) + struct.pack("<II", *shape)
    data += bytes(-(len(data) - 4) % 8) + struct.pack("<QQ", number, 0)
    name = _ENCODING.encode() + b"\0"
    data += struct.pack("<I", len(name)) + name + b"\0"  # the last is is_bigendian
    return data + bytes(-len(data) % 4) + struct.pack("<I", words.nbytes) + words.tobytes()


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Shape (rows, columns) and topic of the packets, of the first topic if there are several.

    Raises
    ------
    SpecError
        If the file is no MCAP file, is damaged, or has no packets.
    """
    mcap_file.holds(path)
    for topic, data in mcap_file.messages(path, None, mcap_file.PACKET_TYPES):
        shape, _ = _parts(data, path)
        return shape, topic
    raise SpecError("has no messages of type EventPacket (event_camera_msgs)", file=path)


def read(path: Path, topic: str) -> Iterator[NDArray]:
    """Blocks of events of a topic, one a message.

    Raises
    ------
    SpecError
        If the file is damaged, or its packets are of another encoding than EVT3.
    """
    return (events for events, _ in evt3.decoded(_words(path, topic), path))


def read_triggers(path: Path, topic: str) -> NDArray:
    """All edges of triggers of a topic, [edge] of `TRIGGER_DTYPE`; errors as for `read`."""
    return joined((triggers for _, triggers in evt3.decoded(_words(path, topic), path)), path)


def _words(path: Path, topic: str) -> Iterator[NDArray[np.uint16]]:
    """The words of each packet that is not empty."""
    first: tuple[int, int] | None = None
    for number, (_, data) in enumerate(mcap_file.messages(path, topic, mcap_file.PACKET_TYPES)):
        shape, words = _parts(data, path)
        first = first or shape
        if shape != first:
            problem = f"packet {number} is of {shape[1]}x{shape[0]} px; the first one of {first[1]}x{first[0]}"
            raise SpecError(problem, file=path)
        if words.size:
            yield words


def _parts(data: bytes, path: Path) -> tuple[tuple[int, int], NDArray[np.uint16]]:
    """Rows and columns, and words of a packet."""
    place = mcap_file.behind_header(data, path)
    try:
        rows, cols = struct.unpack_from("<II", data, place)
        place += 8
        place += -(place - 4) % 8 + 16  # seq and time_base, which EVT3 does not use
        (length,) = struct.unpack_from("<I", data, place)
        name, place = data[place + 4 : place + 4 + length], place + 4 + length
        is_big, place = data[place], place + 1
        place += -place % 4
        (size,) = struct.unpack_from("<I", data, place)
    except (struct.error, IndexError):
        raise SpecError("a packet of events ends early; the file is damaged", file=path) from None
    encoding = name.rstrip(b"\0").decode("ascii", "replace")
    if encoding != _ENCODING:
        problem = f"has packets of encoding {printable(encoding[:40])!r}; expected {_ENCODING}"
        raise SpecError(problem, file=path)
    if not (0 < rows <= _LARGEST_SIDE and 0 < cols <= _LARGEST_SIDE):
        raise SpecError(f"has the size {cols}x{rows}; expected 1x1 to {_LARGEST_SIDE}x{_LARGEST_SIDE} px", file=path)
    if is_big or size % 2 or len(data) < place + 4 + size:
        raise SpecError("a packet of events ends early or within a word; the file is damaged", file=path)
    return (rows, cols), np.frombuffer(data, "<u2", size // 2, place + 4)

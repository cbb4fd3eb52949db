"""AEDAT4 of iniVation: packets of events as FlatBuffers, packed with LZ4.

``#!AER-DAT4.0``, a header (compression, place of the table of packets, XML that describes the streams), packets
(stream, size, content), and the table of packets, whose places are those behind the packets' own headers. All parts
are FlatBuffers (flatbuffers.dev) with the size in front. A packet of events is one vector of 16-byte structures, so
NumPy writes and reads it without a library for FlatBuffers.

Reader of tables in FlatBuffers (flatbuffers.dev), with every position checked.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading, require_memory
from hesim_render.exchange.stream import EventStream
from hesim_render.pixels.evs.events import events_of


class FlatTable:
    """A table in a buffer.

    Parameters
    ----------
    data : the buffer.
    position : of the table, byte.

    Raises
    ------
    ValueError
        If a part of it lies outside of the buffer; so do all methods.
    """

    def __init__(self, data: bytes, position: int) -> None:
        self._data, self._position = data, position
        fields = position - self._at(position, "<i")
        size = self._at(fields, "<H")
        self._fields = [self._at(fields + at, "<H") for at in range(4, size - 1, 2)]

    @classmethod
    def root(cls, data: bytes, identifier: bytes) -> "FlatTable":
        """The root table of a buffer without a size in front, which must have an identifier of 4 bytes."""
        if data[4:8] != identifier:
            raise ValueError(f"a part says {data[4:8]!r}; expected {identifier!r}")
        (position,) = struct.unpack_from("<I", data)
        return cls(data, position)

    def _at(self, position: int, form: str) -> int:
        if not 0 <= position <= len(self._data) - struct.calcsize(form):
            raise ValueError("a position lies outside of its part")
        return struct.unpack_from(form, self._data, position)[0]

    def _field(self, number: int) -> int | None:
        offset = self._fields[number] if number < len(self._fields) else 0
        return self._position + offset if offset else None

    def number(self, field: int, form: str, default: int) -> int:
        """A field with a number of the `struct` format `form`."""
        position = self._field(field)
        return default if position is None else self._at(position, form)

    def text(self, field: int) -> str:
        """A field with a text; empty without one."""
        return self.structures(field, np.dtype("u1")).tobytes().decode("utf-8")

    def structures(self, field: int, dtype: np.dtype) -> NDArray:
        """A field with a vector of numbers or structures; empty without one."""
        position = self._field(field)
        if position is None:
            return np.empty(0, dtype=dtype)
        position += self._at(position, "<I")
        count = self._at(position, "<I")
        # NumPy checks that the vector ends within the buffer
        return np.frombuffer(self._data, dtype, count, position + 4)


_MAGIC = b"#!AER-DAT4.0\r\n"
_EVENT = np.dtype({
    "names": ["t_us", "x", "y", "on"], "formats": ["<i8", "<i2", "<i2", "u1"], "offsets": [0, 8, 10, 12],
    "itemsize": 16,
})  # fmt: skip
_PACKET = struct.Struct("<ii")
#: Events of one packet; readers seek by packets.
_PACKET_EVENTS = 1 << 16
_LARGEST_SIDE = 1 << 15
#: Content of a packet before its structures: size, root, identifier, a table with one vector, and the vector's length.
_EVENTS_HEAD = struct.Struct("<IIIHHHHiII")
#: One packet in the table of packets; its first field is the distance to the description of the fields.
_ENTRY = np.dtype([
    ("fields", "<i4"), ("stream", "<i4"), ("size", "<i4"), ("place", "<i8"), ("count", "<i8"), ("begin", "<i8"),
    ("end", "<i8"), ("pad", "<u4"),
])  # fmt: skip
_ENTRY_FIELDS = (14, 44, 12, 4, 20, 28, 36)
_LZ4, _UNPACKED = (1, 2), 0
_ZSTD = (3, 4)
_PIECE = 1 << 20
#: Largest packet, 8 million events; cameras send packets of some ms.
_LARGEST_PACKET = 1 << 27

_INFO = """<dv version="2.0">
    <node name="outInfo" path="/outInfo/">
        <node name="0" path="/outInfo/0/">
            <attr key="compression" type="string">LZ4</attr>
            <attr key="originalModuleName" type="string">hesim_render</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/outInfo/0/info/">
                <attr key="sizeX" type="int">{cols}</attr>
                <attr key="sizeY" type="int">{rows}</attr>
                <attr key="source" type="string">hesim_render</attr>
            </node>
        </node>
    </node>
</dv>
"""


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as an AEDAT4 file with one stream.

    Raises
    ------
    SpecError
        If the sensor has more than 32768 rows or columns.
    """
    import lz4.frame

    if max(stream.shape) > _LARGEST_SIDE:
        raise SpecError(f"AEDAT4 addresses at most {_LARGEST_SIDE} rows and columns", file=target)
    info = _INFO.format(rows=stream.shape[0], cols=stream.shape[1]).encode("ascii")
    file.write(_MAGIC + _header(info, -1))
    entries = []
    for block in stream:
        for first in range(0, block.size, _PACKET_EVENTS):
            events = block[first : first + _PACKET_EVENTS]
            packed = lz4.frame.compress(_packet(events), store_size=False)
            file.write(_PACKET.pack(0, len(packed)) + packed)
            place = file.tell() - len(packed)  # behind the packet's own header
            span = int(events["t_us"][0]), int(events["t_us"][-1])
            entries.append((0, 0, len(packed), place, events.size, *span, 0))
    table = file.tell()
    file.write(lz4.frame.compress(_table(np.array(entries, dtype=_ENTRY)), store_size=False))
    file.seek(0)
    file.write(_MAGIC + _header(info, table))


def _header(info: bytes, table: int) -> bytes:
    """The header, with the place of the table of packets; -1 while it is unknown."""
    text = struct.pack("<I", len(info)) + info + b"\0"
    text += bytes(-len(text) % 8)
    # a table with the fields compression (at 4), place of the table (at 12), and offset of the text (at 8)
    body = struct.pack("<I4s6xHHHHH", 24, b"IOHE", 10, 20, 4, 12, 8)
    return struct.pack("<I", len(body) + 20 + len(text)) + body + struct.pack("<iiIq", 10, 1, 12, table) + text


def _packet(events: NDArray) -> bytes:
    made = np.zeros(events.size, dtype=_EVENT)
    made["t_us"], made["x"], made["y"] = events["t_us"], events["x"], events["y"]
    made["on"] = events["polarity"] > 0
    size = _EVENTS_HEAD.size - 4 + made.nbytes
    identifier = int.from_bytes(b"EVTS", "little")
    return _EVENTS_HEAD.pack(size, 16, identifier, 0, 6, 8, 4, 6, 4, events.size) + made.tobytes()


def _table(entries: NDArray) -> bytes:
    """The table of packets."""
    head = struct.pack("<I4sHHHHiII", 16, b"FTAB", 0, 6, 8, 4, 6, 4, entries.size)
    fields = struct.pack(f"<{len(_ENTRY_FIELDS)}H", *_ENTRY_FIELDS)
    at = len(head) + 4 * entries.size  # place of the fields' description, from behind the size
    first = at + len(fields)
    first += -first % 8  # numbers of 8 bytes begin 12, 20, … bytes after it, where the size in front counts as well
    place = first + _ENTRY.itemsize * np.arange(entries.size)
    entries["fields"] = place - at
    offsets = (place - (len(head) + 4 * np.arange(entries.size))).astype("<u4")
    body = head + offsets.tobytes() + fields + bytes(first - at - len(fields)) + entries.tobytes()
    return struct.pack("<I", len(body)) + body


def read_header(path: Path) -> tuple[tuple[int, int], int, int, int, int]:
    """Shape (rows, columns), stream of the events, compression, first byte of the packets and the byte behind them.

    The first stream of events is taken if there are several.

    Raises
    ------
    SpecError
        If the file is not AEDAT4, is cut short, or has no events.
    """
    with reading(path, "as an AEDAT4 file"), path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise SpecError("is not an AEDAT4 file (it does not begin with #!AER-DAT4.0)", file=path)
        (size,) = struct.unpack("<I", _exactly(file, 4, path))
        require_memory(size, "the header", path, 1 << 26)
        header = FlatTable.root(_exactly(file, size, path), b"IOHE")
        table = header.number(1, "<q", -1)
        end = path.stat().st_size if table < 0 else table
        if end > path.stat().st_size:
            raise SpecError("ends before its table of packets; the file is cut short", file=path)
        shape, number = _events_stream(header.text(2), path)
        return shape, number, header.number(0, "<i", 0), file.tell(), end


def _events_stream(info: str, path: Path) -> tuple[tuple[int, int], int]:
    """Shape and number of the first stream of events."""
    from xml.etree import ElementTree

    if "<!" in info:
        raise SpecError("declares a document type or entities in its XML, as no such file does", file=path)
    for node in ElementTree.fromstring(info).iterfind("./node/node"):
        result = {attribute.get("key"): attribute.text or "" for attribute in node.iter("attr")}
        if result.get("typeIdentifier") == "EVTS":
            name, cols, rows = node.get("name", ""), result.get("sizeX", ""), result.get("sizeY", "")
            if not all(re.fullmatch(r"\d{1,6}", value) for value in (name, cols, rows)):
                entry = printable(f"{name!r} of {cols!r} x {rows!r}")
                raise SpecError(f"has a stream of events without number and size ({entry[:80]})", file=path)
            return (int(rows), int(cols)), int(name)
    raise SpecError("has no stream of events", file=path)


def read(path: Path, number: int, compression: int, begin: int, end: int) -> Iterator[NDArray]:
    """Blocks of events of a file, as `read_header` describes it; one block a packet.

    Raises
    ------
    SpecError
        If the file is cut short or a packet is damaged.
    """
    with reading(path, "as an AEDAT4 file"), path.open("rb") as file:
        file.seek(begin)
        while file.tell() < end:
            stream, size = _PACKET.unpack(_exactly(file, _PACKET.size, path))
            if not 0 <= size <= min(_LARGEST_PACKET, end - file.tell()):
                raise SpecError("a packet is larger than the rest of the file; the file is cut short", file=path)
            if stream != number:
                file.seek(size, 1)
                continue
            content = _unpacked(_exactly(file, size, path), compression, path)
            if len(content) < 4:
                raise SpecError("a packet of events is empty", file=path)
            made = FlatTable.root(content[4:], b"EVTS").structures(0, _EVENT)
            # a negative coordinate becomes one above 32767, which no grid has
            yield events_of(made["t_us"], made["x"], made["y"], made["on"])


def _unpacked(content: bytes, compression: int, path: Path) -> bytes:
    """The content of a packet; one that would not fit into memory is refused before it is unpacked."""
    if compression == _UNPACKED:
        return content
    if compression in _LZ4:
        import lz4.frame

        with lz4.frame.LZ4FrameDecompressor() as unpack:
            result = unpack.decompress(content, max_length=_LARGEST_PACKET)
            whole = unpack.eof
    elif compression in _ZSTD:
        import zstandard

        # a frame that ends early gives too few bytes, which the reader of the packet finds
        unpacker, parts, size = zstandard.ZstdDecompressor().stream_reader(content), list[bytes](), 0
        while size <= _LARGEST_PACKET and (part := unpacker.read(_PIECE)):
            parts.append(part)
            size += len(part)
        result, whole = b"".join(parts), size <= _LARGEST_PACKET
    else:
        raise SpecError(f"has the compression {compression}; expected 0 to 4", file=path)
    if not whole:
        raise SpecError(f"a packet ends early, or is larger than {_LARGEST_PACKET >> 20} MiB", file=path)
    return result


def _exactly(file: IO[bytes], size: int, path: Path) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise SpecError("ends early; the file is cut short", file=path)
    return data

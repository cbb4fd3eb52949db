"""MCAP of ROS 2: events as ``dvs_msgs/msg/EventArray``, frames as ``sensor_msgs/msg/Image``.

Messages are in CDR, little endian, with every number at a multiple of its size. An event is x, y (16 bits), seconds,
nanoseconds (32 bits) and polarity (8 bits), so that the events after the first are 16 bytes apart, and NumPy writes
and reads a packet as one array. The container is that of the package mcap.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.exchange.mcap_records import records, require_mcap
from hesim_render.exchange.stream import EventStream
from hesim_render.pixels.evs.events import events_of

BEGIN = b"\x89MCAP0\r\n"
EVENT_TOPIC, FRAME_TOPIC, FRAME_ID = "/camera/events", "/camera/image_raw", "camera"
#: Longest time and most events of one packet.
_PACKET_US, _PACKET_EVENTS = 10_000, 1 << 16
_LATEST_US = (1 << 31) * 1_000_000
_LONGEST_TOPIC = 1000
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
#: What follows x and y of an event: its time and polarity, and x and y of the next one.
_BLOCK = np.dtype([("sec", "<i4"), ("nanosec", "<u4"), ("p", "u1"), ("pad", "u1"), ("x", "<u2"), ("y", "<u2"),
                   ("pad2", "<u2")])  # fmt: skip
_BEHIND_LAST = 7  # bytes of the last block that are not there
_RULE = "=" * 80
HEADER = (
    f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
#: Ends of the names of types, of whichever package.
_EVENT_TYPES, PACKET_TYPES, _FRAME_TYPES = "/EventArray", "/EventPacket", "/Image"
EVENT_TYPE, FRAME_TYPE = "dvs_msgs/msg/EventArray", "sensor_msgs/msg/Image"
_TYPES = {
    EVENT_TYPE: "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"
    f"{_RULE}\nMSG: dvs_msgs/Event\nuint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n{HEADER}",
    FRAME_TYPE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    f"uint32 step\nuint8[] data\n{HEADER}",
}


#: Name and definition of a type of messages, and the function that makes them of events and the name of the file.
Packed = tuple[str, str, Callable[[EventStream, "str | Path"], Iterator[tuple[int, bytes]]]]


def write(
    events: EventStream | None,
    frames: Iterable[tuple[int, NDArray[np.uint16]]],
    encoding: str,
    file: IO[bytes],
    target: str | Path,
    packed: Packed | None = None,
) -> None:
    """Write events and frames in order of time.

    Parameters
    ----------
    events : None where there are none.
    frames : time, µs, and DN [row, col] of each frame, in order of time.
    encoding : name of the mosaic, of ``sensor_msgs/image_encodings``: ``mono16``, ``bayer_rggb16``, …
    file : where to write.
    target : name of the file, for errors.
    packed : messages of the events of another type; default: EventArray.

    Raises
    ------
    SpecError
        If the package mcap is not installed, or an event lies at 2³¹ s or later.
    """
    event_type, definition, packets = packed or (EVENT_TYPE, _TYPES[EVENT_TYPE], _event_arrays)
    require_mcap(target)
    from mcap.writer import Writer

    writer = Writer(file)
    writer.start(profile="ros2", library="hesim_render")
    channels = {}
    for topic, kind, text in (
        (EVENT_TOPIC, event_type, definition), (FRAME_TOPIC, FRAME_TYPE, _TYPES[FRAME_TYPE]),
    ):  # fmt: skip
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        channels[topic] = writer.register_channel(topic, "cdr", schema)

    def send(topic: str, t_us: int, data: bytes) -> None:
        writer.add_message(channels[topic], 1000 * t_us, data, 1000 * t_us)

    waiting = iter(frames)
    frame = next(waiting, None)
    for t_us, data in () if events is None else packets(events, target):
        while frame is not None and frame[0] <= t_us:
            send(FRAME_TOPIC, frame[0], _image(*frame, encoding))
            frame = next(waiting, None)
        send(EVENT_TOPIC, t_us, data)
    while frame is not None:
        send(FRAME_TOPIC, frame[0], _image(*frame, encoding))
        frame = next(waiting, None)
    writer.finish()


def _event_arrays(events: EventStream, target: str | Path) -> Iterator[tuple[int, bytes]]:
    """Time of the last event, µs, and content of each message."""
    for block in events:
        if block["t_us"][-1] >= _LATEST_US:
            raise SpecError(f"ROS ends at {_LATEST_US} µs; an event is at {block['t_us'][-1]} µs", file=target)
        for part in packet_slices(block["t_us"]):
            yield int(block["t_us"][part][-1]), _event_array(block[part], events.shape)


def packet_slices(times_us: NDArray[np.int64]) -> Iterator[slice]:
    """Parts of at most `_PACKET_US` and `_PACKET_EVENTS` of events in order of time."""
    period = times_us // _PACKET_US
    starts = np.flatnonzero(np.diff(period, prepend=period[0] - 1))
    for first, last in zip(starts, [*starts[1:], times_us.size], strict=True):
        for k in range(first, last, _PACKET_EVENTS):
            yield slice(k, min(k + _PACKET_EVENTS, last))


def head(t_us: int) -> bytes:
    """Byte order, time and frame of a message, up to a multiple of 4 bytes."""
    name = FRAME_ID.encode() + b"\0"
    text = struct.pack("<iII", t_us // 1_000_000, t_us % 1_000_000 * 1000, len(name)) + name
    return _LITTLE_ENDIAN + text + bytes(-len(text) % 4)


def _event_array(events: NDArray, shape: tuple[int, int]) -> bytes:
    made = np.zeros(events.size, dtype=_BLOCK)
    made["sec"], micro = np.divmod(events["t_us"], 1_000_000)
    made["nanosec"] = micro * 1000
    made["p"] = events["polarity"] > 0
    made["x"][:-1], made["y"][:-1] = events["x"][1:], events["y"][1:]
    sizes = struct.pack("<IIIHH", *shape, events.size, events["x"][0], events["y"][0])
    return head(int(events["t_us"][0])) + sizes + made.tobytes()[:-_BEHIND_LAST]


def _image(t_us: int, raw: NDArray[np.uint16], encoding: str) -> bytes:
    rows, cols = raw.shape
    name = encoding.encode() + b"\0"
    body = struct.pack("<III", rows, cols, len(name)) + name + b"\0"  # the last is is_bigendian
    body += bytes(-len(body) % 4) + struct.pack("<II", 2 * cols, raw.size * 2)
    return head(t_us) + body + raw.astype("<u2").tobytes()


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Shape (rows, columns) and topic of the events; of the first topic if there are several.

    Raises
    ------
    SpecError
        If the file is no MCAP file, is damaged, has a part that unpacks to more than it says, or has no events.
    """
    for topic, data in messages(path, None, _EVENT_TYPES):
        rows, cols, _, _ = _parts(data, path)
        return (rows, cols), topic
    raise SpecError(
        "has no messages of type EventArray (dvs_msgs, prophesee_event_msgs) or EventPacket (event_camera_msgs)",
        file=path,
    )


def read(path: Path, topic: str) -> Iterator[NDArray]:
    """Blocks of events of a topic, one a message.

    Raises
    ------
    SpecError
        If the file is damaged.
    """
    for _, data in messages(path, topic, _EVENT_TYPES):
        _, _, count, begin = _parts(data, path)
        if not count:
            continue
        if len(data) < begin + 4 + _BLOCK.itemsize * count - _BEHIND_LAST:
            raise SpecError("a packet of events ends early; the file is damaged", file=path)
        padded = data[begin + 4 :] + bytes(_BEHIND_LAST)
        made = np.frombuffer(padded, dtype=_BLOCK, count=count)
        first = struct.unpack_from("<HH", data, begin)
        x, y = (np.append(np.uint16(own), made[name][:-1]) for own, name in zip(first, "xy", strict=True))
        yield events_of(made["sec"].astype(np.int64) * 1_000_000 + made["nanosec"] // 1000, x, y, made["p"])


def holds(path: Path) -> tuple[bool, bool]:
    """Whether a file has messages of events, and messages of images.

    Raises
    ------
    SpecError
        If the file is no MCAP file, or is damaged.
    """
    events: Any = (_EVENT_TYPES, PACKET_TYPES)
    return tuple(next(messages(path, None, kind), None) is not None for kind in (events, _FRAME_TYPES))  # type: ignore[return-value]


def read_frames(path: Path) -> Iterator[tuple[int, NDArray[np.uint16], str]]:
    """Time, µs, values [row, col] and encoding of each image of the first topic of type Image.

    Raises
    ------
    SpecError
        If the file is damaged, or an image is not of one grey or Bayer mosaic of 8 or 16 bits.
    """
    first: str | None = None
    for topic, data in messages(path, None, _FRAME_TYPES):
        first = first or topic
        if topic == first:
            yield _frame(data, path)


def _frame(data: bytes, path: Path) -> tuple[int, NDArray[np.uint16], str]:
    place = behind_header(data, path)
    try:
        sec, nanosec = struct.unpack_from("<iI", data, 4)
        rows, cols, length = struct.unpack_from("<III", data, place)
        place += 12
        encoding, place = data[place : place + length].rstrip(b"\0").decode("ascii", "replace"), place + length
        is_big, place = data[place], place + 1
        place += -(place - len(_LITTLE_ENDIAN)) % 4
        step, size = struct.unpack_from("<II", data, place)
    except (struct.error, IndexError):
        raise SpecError("an image ends early; the file is damaged", file=path) from None
    bits = 16 if encoding.endswith("16") else 8
    if not (encoding in ("mono8", "mono16") or encoding.startswith("bayer_")):
        raise SpecError(f"has images of encoding {encoding!r}; expected mono8, mono16 or bayer_…", file=path)
    values = data[place + 8 : place + 8 + size]
    if len(values) < size or size < rows * step or step < cols * bits // 8 or step * 8 % bits:
        raise SpecError("an image is shorter than its size; the file is damaged", file=path)
    kind = np.dtype(f"{'>' if is_big else '<'}u{bits // 8}")
    lines = np.frombuffer(values, kind, rows * step // kind.itemsize).reshape(rows, -1)
    return sec * 1_000_000 + nanosec // 1000, lines[:, :cols].astype(np.uint16), encoding


def behind_header(data: bytes, path: Path) -> int:
    """Place behind the header of a message."""
    if data[:2] != _LITTLE_ENDIAN[:2]:
        raise SpecError("has messages that are not little-endian CDR", file=path)
    try:
        (length,) = struct.unpack_from("<I", data, 12)
    except struct.error:
        raise SpecError("a message ends early; the file is damaged", file=path) from None
    place = 16 + length
    return place + -place % 4


def _parts(data: bytes, path: Path) -> tuple[int, int, int, int]:
    """Rows, columns and number of events of a message, and where they begin."""
    place = behind_header(data, path)
    try:
        rows, cols, count = struct.unpack_from("<III", data, place)
    except struct.error:
        raise SpecError("a packet of events ends early; the file is damaged", file=path) from None
    return rows, cols, count, place + 12


def messages(path: Path, topic: str | None, kind: str) -> Iterator[tuple[str, bytes]]:
    """Topic and content of the messages of a topic, or of all, whose type ends with `kind`, in the order of the file.

    One part of the file is in memory at a time. The reader of the package sorts messages by their times, for which it
    holds as many parts as say that they are of the same time, and believes their sizes.
    """
    from mcap.records import Channel, Message, Schema

    fitting: set[int] = set()
    topics: dict[int, str] = {}
    for record in records(path):
        if isinstance(record, Schema):
            if record.name.endswith(kind):
                fitting.add(record.id)
        elif isinstance(record, Channel):
            if record.schema_id in fitting and topic in (None, record.topic):
                if len(record.topic) > _LONGEST_TOPIC:
                    raise SpecError(f"has a topic of {len(record.topic)} characters", file=path)
                topics[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record.data


def first_type(path: Path) -> str | None:
    """The end of the type's name of the first message of events, ``/EventArray`` or ``/EventPacket``; None without any.

    Raises
    ------
    SpecError
        If the file is no MCAP file, or is damaged.
    """
    from mcap.records import Channel, Message, Schema

    ends: dict[int, str] = {}
    channels: dict[int, str] = {}
    for record in records(path):
        if isinstance(record, Schema) and record.name.endswith((_EVENT_TYPES, PACKET_TYPES)):
            ends[record.id] = "/" + record.name.rpartition("/")[2]
        elif isinstance(record, Channel) and record.schema_id in ends:
            channels[record.id] = ends[record.schema_id]
        elif isinstance(record, Message) and record.channel_id in channels:
            return channels[record.channel_id]
    return None

"""What cameras and their drivers write: triggers in EVT2 and EVT3, packets of ROS 2, HDF5 of Prophesee."""

import os
import struct

import evt3
import h5py
import numpy as np
import pytest
import recordings
from event_files import DATA, SHAPE, columns, joined, made, many, raw, written
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_round_trips import lists_of_events

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.hdf5 import require_sound_heaps
from hesim_render.exchange import EVENT_FORMATS, EventStream, ecf, event_packets, mcap_file, open_events, prophesee_hdf5
from hesim_render.exchange.triggers import TRIGGER_DTYPE, exposure_triggers, exposures_of_pulses
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording.imports import import_recording

QUICK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def edges(*items):
    return np.array(list(items), dtype=TRIGGER_DTYPE)


@pytest.mark.parametrize("shape", [(5, 2048), (2048, 5)])
def test_the_largest_sensor_of_the_packed_form(tmp_path, shape):
    path = written(made((7, 4, 4, 1)), "prophesee", tmp_path, shape)
    assert open_events(path).shape == shape


@pytest.mark.parametrize("geometry", ["640x480", np.bytes_(b"640x480")])
def test_the_size_in_an_hdf5_file_may_be_text_or_bytes(tmp_path, geometry):
    with h5py.File(tmp_path / "e.hdf5", "w") as file:
        file.attrs["geometry"] = geometry
    assert prophesee_hdf5.read_shape(tmp_path / "e.hdf5") == (480, 640)


def test_exposures_are_pulses_of_line_0():
    """Rising at its begin, falling at its end, as `import --trigger-channel 0` reads them (docs/formats.md)."""
    found = exposure_triggers([100, 5_000], [1_300, 6_200])
    assert found["t_us"].tolist() == [100, 1_300, 5_000, 6_200] and found["edge"].tolist() == [1, -1, 1, -1]
    begin, end = exposures_of_pulses(found, 0, 2, "e.raw")
    assert (begin.tolist(), end.tolist()) == ([100, 5_000], [1_300, 6_200])


def stream_of(events, triggers, shape=SHAPE):
    return EventStream(lambda: EventStream.of(events, shape), shape, triggers=lambda: triggers)


def file_of(events, triggers, name, folder):
    path = folder / f"t{EVENT_FORMATS[name].suffix}"
    with path.open("wb") as file:
        EVENT_FORMATS[name].write(stream_of(events, triggers), file, path)
    return path


# ---- triggers ------------------------------------------------------------------------------------------------------

EVENTS = many(3000, 1 << 22)
AT = int(EVENTS["t_us"][100])
#: Before, at and behind events, two at one time, behind the last event, over a start of the counter of EVT3.
EDGES = edges(
    (0, 1, 0), (3, -1, 0), (AT, 1, 2), (AT, -1, 2), (1 << 21, 1, 0), ((1 << 22) + 77, -1, 0), ((1 << 25) + 5, 1, 13)
)


def triggers_by_others(path):
    """By the package evt3; edge, time and line."""
    found, triggers = evt3.decode_file_with_triggers(str(path))
    events = columns(found.timestamp.astype(np.int64), found.x, found.y, found.polarity)
    return events, edges(*zip(triggers.timestamp, np.where(triggers.value, 1, -1), triggers.id, strict=True))


@pytest.mark.parametrize("name", ["evt2", "evt3", "prophesee"])
@pytest.mark.parametrize("piece", [1000, 7])
def test_triggers_come_back_and_leave_the_events_alone(name, piece, tmp_path, monkeypatch):
    monkeypatch.setattr("hesim_render.exchange.raw_file._PIECE", piece)
    monkeypatch.setattr("hesim_render.exchange.stream.BLOCK", piece)
    events = EVENTS[: 100 * piece]
    path = file_of(events, EDGES, name, tmp_path)
    opened = open_events(path)
    np.testing.assert_array_equal(opened.triggers(), EDGES)
    np.testing.assert_array_equal(joined(opened), events)
    if name == "evt3":
        found, triggers = triggers_by_others(path)
        np.testing.assert_array_equal(found, events)
        np.testing.assert_array_equal(triggers, EDGES)


def test_words_of_triggers_are_those_of_the_definition(tmp_path):
    events = made((70, 5, 6, 1), (70, 7, 6, -1))
    triggers = edges((70, 1, 3), (71, -1, 11))
    body = file_of(events, triggers, "evt2", tmp_path).read_bytes().partition(b"% end\n")[2]
    assert [hex(word) for word in np.frombuffer(body, "<u4")] == [
        "0x80000001", hex(0xA << 28 | 6 << 22 | 3 << 8 | 1), hex(1 << 28 | 6 << 22 | 5 << 11 | 6),
        hex(6 << 22 | 7 << 11 | 6), hex(0xA << 28 | 7 << 22 | 11 << 8),
    ]  # fmt: skip
    body = file_of(events, triggers, "evt3", tmp_path).read_bytes().partition(b"% end\n")[2]
    assert [hex(word) for word in np.frombuffer(body, "<u2")] == [
        "0x8000", hex(0x6000 | 70), "0x0", hex(0xA000 | 3 << 8 | 1), "0x6", hex(0x2000 | 1 << 11 | 5), hex(0x2000 | 7),
        hex(0x6000 | 71), hex(0xA000 | 11 << 8),
    ]  # fmt: skip


@pytest.mark.parametrize(("triggers", "told"), [
    (edges((5, 1, 0), (4, -1, 0)), "triggers that are not in order of time"),
    (edges((-5, 1, 0)), "triggers that are not in order of time"),
    (edges((5, 1, 16)), "a trigger on line 16; the format has lines 0 to 15"),
    (edges(((1 << 44) + 1, 1, 0)), "EVT3 ends at 17592186044416"),
])  # fmt: skip
def test_triggers_that_do_not_fit_are_refused(triggers, told, tmp_path):
    with pytest.raises(SpecError, match=told):
        file_of(made((5, 0, 0, 1)), triggers, "evt3", tmp_path)


def test_more_triggers_than_a_camera_gives_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hesim_render.exchange.triggers.MOST_TRIGGERS", 3)
    path = raw(tmp_path, [0x8000, 0x6001, *[0xA001] * 4])
    with pytest.raises(SpecError, match="more than 3 edges of triggers"):
        open_events(path).triggers()
    monkeypatch.setattr("hesim_render.exchange.triggers.MOST_TRIGGERS", 4)
    assert open_events(path).triggers().size == 4


def test_a_line_must_have_a_pulse_for_each_frame():
    given_ = exposure_triggers([5, 50], [19, 73])
    assert given_.tolist() == [(5, 1, 0), (19, -1, 0), (50, 1, 0), (73, -1, 0)]
    both = np.sort(np.concatenate([given_, edges((7, -1, 1), (51, 1, 1))]), order="t_us")
    begin, end = exposures_of_pulses(both, 0, 2, "file")
    assert (begin.tolist(), end.tolist()) == ([5, 50], [19, 73])
    for line, count, told in ((0, 3, "has 4 edges"), (1, 1, "has 2 edges"), (2, 1, r"lines with triggers: 0, 1")):
        with pytest.raises(SpecError, match=told):
            exposures_of_pulses(both, line, count, "file")


@pytest.mark.parametrize("name", ["evt2", "evt3", "prophesee", "mcap-evt3"])
def test_frames_have_the_clock_of_the_events(name, tmp_path):
    """Exposures of another length and at another rate than those of the sensor file come back by the triggers alone."""
    given_ = recordings.make("davis346", tmp_path / "r", frames=3)
    for number, frame in enumerate(given_.manifest["frames"]):
        frame["exposure_start_us"], frame["exposure_us"] = 111 + 30_003 * number, 2_000 + number
    path = given_.export(name, tmp_path / f"e{'.mcap' if 'mcap' in name else EVENT_FORMATS[name].suffix}")
    given_.export("npy", tmp_path / "f")
    files = sorted((tmp_path / "f").glob("*.npy"))
    sensor = recordings.sensor_like("davis346")
    made_ = import_recording(tmp_path / "a", sensor, events=path, frames=files, trigger_channel=0)
    np.testing.assert_array_equal(made_.events, given_.events)
    found = [(frame.exposure_start_us, frame.exposure_us, frame.t_us) for frame in made_.frames]
    assert found == [(111, 2000, 2111), (30_114, 2001, 32_115), (60_117, 2002, 62_119)]
    with pytest.raises(SpecError, match="has 6 edges of triggers on line 0"):
        import_recording(tmp_path / "b", sensor, events=path, frames=files[:2], trigger_channel=0)
    with pytest.raises(RangeError, match="unless both events and frames"):
        import_recording(tmp_path / "b", sensor, frames=files, trigger_channel=0)
    assert not (tmp_path / "b").exists()


# ---- packets of ROS 2 ----------------------------------------------------------------------------------------------

STORE = get_typestore(Stores.ROS2_HUMBLE)
_PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events\n"
)
STORE.register(get_types_from_msg(_PACKET, event_packets.TYPE))


def packets_in(path):
    """Messages by the reader of mcap, decoded by rosbags with the definitions of ROS."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema.name == event_packets.TYPE:
                assert channel.topic == mcap_file.EVENT_TOPIC
                yield message.log_time, STORE.deserialize_cdr(message.data, schema.name)


def mcap_of(events, triggers, path):
    with path.open("wb") as file:
        kind = (event_packets.TYPE, event_packets.DEFINITION, event_packets.packets)
        mcap_file.write(stream_of(events, triggers), (), "mono16", file, path, kind)
    return path


def by_evt3(words, path):
    """Events and triggers of words, by the package evt3."""
    path.write_bytes(b"% evt 3.0\n% geometry 1280x720\n% end\n" + words)
    return triggers_by_others(path)


def test_packets_come_back_exactly(tmp_path):
    @QUICK
    @given(lists_of_events(1 << 40), st.lists(st.integers(0, 1 << 25), max_size=3))
    def check(events, times):
        triggers = exposure_triggers(np.sort(times), np.sort(times))
        path = mcap_of(events, triggers, tmp_path / "e.mcap")
        if events.size + triggers.size == 0:
            with pytest.raises(SpecError, match="no messages of type EventArray"):
                open_events(path)
            return
        opened = open_events(path)
        assert opened.shape == SHAPE
        np.testing.assert_array_equal(joined(opened), events)
        np.testing.assert_array_equal(opened.triggers(), triggers)
        found = [message for _, message in packets_in(path)]
        theirs = by_evt3(b"".join(message.events.tobytes() for message in found), tmp_path / "w.raw")
        np.testing.assert_array_equal(theirs[0], events)
        np.testing.assert_array_equal(theirs[1], triggers)

    check()


def test_each_packet_can_be_read_alone_and_names_its_time(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_file, "_PACKET_EVENTS", 300)
    events = many(5000, 1 << 20)
    events["y"] = 7  # the row and the upper bits of the time repeat from packet to packet
    path = mcap_of(events, EDGES[:0], tmp_path / "e.mcap")
    done = 0
    for number, (log_ns, message) in enumerate(packets_in(path)):
        assert (message.encoding, message.is_bigendian, message.seq) == ("evt3", False, number)
        assert (message.height, message.width, message.header.frame_id) == (*SHAPE, "camera")
        found, _ = by_evt3(message.events.tobytes(), tmp_path / "w.raw")
        np.testing.assert_array_equal(found, events[done : done + found.size])
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert (stamp, log_ns) == (found["t_us"][0] * 1000, found["t_us"][-1] * 1000)
        assert found.size <= 300 and log_ns - stamp < 10_000_000
        done += found.size
    assert done == 5000


def packet(words, encoding="evt3", big=False, shape=SHAPE, cut=None):
    """A message by rosbags."""
    kind = STORE.types
    header = kind["std_msgs/msg/Header"](stamp=kind["builtin_interfaces/msg/Time"](sec=3, nanosec=7), frame_id="0109")
    data = np.frombuffer(np.asarray(words, "<u2").tobytes()[:cut], np.uint8)
    message = kind[event_packets.TYPE](
        header=header, height=shape[0], width=shape[1], seq=5, time_base=9, encoding=encoding, is_bigendian=big,
        events=data,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, event_packets.TYPE))


def mcap_with(path, *messages):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(event_packets.TYPE, "ros2msg", _PACKET.encode())
        channel = writer.register_channel("/event_camera/events", "cdr", schema)
        for number, message in enumerate(messages):
            writer.add_message(channel, number, message, number)
        writer.finish()
    return path


def test_packets_of_other_writers_keep_the_state_of_the_decoder(tmp_path):
    """As drivers cut them: within a time, a row and a vector, with words before the first time and an empty packet."""
    first = [0x0009, 0x2003, 0x8FFF, 0x6123, 0x0010, 0x2805, 0x3864]
    path = mcap_with(tmp_path / "d.mcap", packet(first), packet([]), packet([0x4003, 0xA201, 0x8000]), packet([0x2807]))
    t = (0xFFF << 12) + 0x123
    opened = open_events(path)
    expected = made((t, 5, 16, 1), (t, 100, 16, 1), (t, 101, 16, 1), (1 << 24, 7, 16, 1))
    np.testing.assert_array_equal(joined(opened), expected)
    np.testing.assert_array_equal(opened.triggers(), edges((t, 1, 2)))


@pytest.mark.parametrize(("messages", "told"), [
    ([packet([0x8000], encoding="libcaer_cmp")], "has packets of encoding 'libcaer_cmp'; expected evt3"),
    ([packet([0x8000], big=True)], "ends early or within a word"),
    ([packet([0x8000, 0x8001], cut=3)], "ends early or within a word"),
    ([packet([0x8000])[:-1]], "ends early or within a word"),
    ([packet([0x8000])[:20]], "ends early"),
    ([packet([0x8000])[:40]], "ends early"),
    ([packet([0x8000], shape=(1, 1 << 30))], "has the size 1073741824x1; expected"),
    ([packet([0x8000]), packet([0x8000], shape=(3, 4))], "packet 1 is of 4x3 px; the first one of 1280x720"),
    ([packet([0x8000, 0x1000])], "word of type 0x1, which EVT3 does not have"),
    ([packet([0x8FF0]), packet([0x8010, 0x8FF0]), packet([0x8050])], "goes back in time"),
])  # fmt: skip
def test_damaged_packets_are_one_clear_error(messages, told, tmp_path):
    with pytest.raises(SpecError, match=rf"p\.mcap: .*{told}"):
        open_events(mcap_with(tmp_path / "p.mcap", *messages)).count()


# ---- HDF5 of Prophesee ---------------------------------------------------------------------------------------------


def ecf_events():
    """For each of the codec's three ways to pack places 1000 events, and some more; no random numbers."""
    k = np.arange(3300)
    t = np.cumsum(np.select([k % 7 == 0, k % 100 == 3, k % 1000 == 9, k % 13 < 9], [1, 15, 70_000, 0], 14))
    scattered, rows = k < 1000, k < 2000
    y = np.select([scattered, rows, k < 3000], [k * 37 % 720, k // 40, 700 - k // 35], 719)
    x = np.select([scattered, rows], [k * 211 % 1280, k * 97 % 1280], k * 3 // 2 % 1280)
    return columns(t + 123_456_789, x, y, k % 61 < 30)


def test_a_file_of_their_codec_is_read():
    """`ecf.hdf5` has the chunks of Prophesee's own encoder (hdf5_ecf 1.0.1), which packs three of them differently."""
    path = DATA / "ecf.hdf5"
    with h5py.File(path) as file:
        heads = [file["CD/events"].id.read_direct_chunk((first,))[1][:4] for first in (0, 1000, 2000, 3000)]
    assert {struct.unpack("<I", head)[0] & 3 for head in heads} == {0, 1, 2}
    opened = open_events(path)
    assert opened.shape == SHAPE and opened.triggers().size == 0
    np.testing.assert_array_equal(joined(opened), ecf_events())


def test_chunks_come_back_exactly():
    @QUICK
    @given(lists_of_events(1 << 60, (2048, 2048)).filter(len))
    def check(events):
        np.testing.assert_array_equal(ecf.decoded(ecf.encoded(events), events.size, "file", "chunk"), events)

    check()
    for count in (1, 14, 15, 16, 255, 256, 65535):  # runs of one time, at both sides of each length's code
        events = np.zeros(count, EVENT_DTYPE)
        events["polarity"], events["x"] = 1, np.arange(count) % 2048
        np.testing.assert_array_equal(ecf.decoded(ecf.encoded(events), count, "file", "chunk"), events)


def test_the_file_is_laid_out_as_metavision_writes_it(tmp_path, monkeypatch):
    monkeypatch.setattr("hesim_render.exchange.stream.BLOCK", 7001)
    events = many(40_000, 90_000)
    events["t_us"] += 1500
    events["t_us"][events["t_us"] > 50_000] += 7777  # periods without an event
    path = file_of(events, EDGES, "prophesee", tmp_path)
    with h5py.File(path) as file:
        stored, index = file["CD/events"], file["CD/indexes"]
        assert dict(file.attrs) == {"version": "1.0", "geometry": "1280x720", "camera_integrator_name": "hesim_render"}
        assert stored.shape == (40_000,) and stored.chunks == (16384,) and stored.id.get_num_chunks() == 3
        assert {name: stored.dtype.fields[name][1] for name in "xypt"} == {"x": 0, "y": 2, "p": 4, "t": 8}
        assert stored.dtype.names == ("x", "y", "p", "t") and stored.dtype.itemsize == 16
        assert stored.id.get_create_plist().get_filter(0)[0] == 0x8ECF
        parts = [ecf.decoded(stored.id.read_direct_chunk((k,))[1], min(16384, 40_000 - k), path, "c")
                 for k in range(0, 40_000, 16384)]  # fmt: skip
        np.testing.assert_array_equal(np.concatenate(parts), events)
        rows, offset = index[:], int(index.attrs["offset"])
        edges_ = file["EXT_TRIGGER/events"][:]
    assert edges_["t"].tolist() == EDGES["t_us"].tolist() and edges_["id"].tolist() == EDGES["channel"].tolist()
    assert edges_["p"].tolist() == (EDGES["edge"] > 0).astype(int).tolist()
    np.testing.assert_array_equal(rows, indexes_by_the_loop(events["t_us"]))
    assert offset == -events["t_us"][0]


def indexes_by_the_loop(times):
    """The entries, event by event, as OpenEB's writer makes them."""
    rows, last, now, number, t0 = [], (0, -1), (0, -1), 0, int(times[0])
    while number < len(times):
        t = int(times[number]) - t0
        if t // 2000 + 1 <= len(rows):
            number += 1
            continue
        if number != now[0]:
            last = now
        rows.append(last)
        now = (number, t)
    return np.array([*rows, now], dtype=[("id", "<u8"), ("ts", "<i8")])


def test_packed_triggers_and_too_many_are_refused(tmp_path, monkeypatch):
    """ECF is a codec of events: what a chunk of triggers behind its filter holds is not known."""
    path = file_of(made((5, 3, 0, 1)), EDGES, "prophesee", tmp_path)
    monkeypatch.setattr("hesim_render.exchange.prophesee_hdf5.MOST_TRIGGERS", EDGES.size)
    np.testing.assert_array_equal(open_events(path).triggers(), EDGES)
    monkeypatch.setattr("hesim_render.exchange.prophesee_hdf5.MOST_TRIGGERS", EDGES.size - 1)
    with pytest.raises(SpecError, match=f"more than {EDGES.size - 1} edges"):
        open_events(path).triggers()
    monkeypatch.undo()
    with h5py.File(path, "a") as file:
        rows = file["EXT_TRIGGER/events"][:]
        del file["EXT_TRIGGER/events"]
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((rows.size,))
        layout.set_filter(ecf.FILTER, h5py.h5z.FLAG_OPTIONAL, ())
        kind = h5py.h5t.py_create(rows.dtype, logical=True)
        stored = h5py.h5d.create(file["EXT_TRIGGER"].id, b"events", kind, h5py.h5s.create_simple(rows.shape), layout)
        # left out for this chunk, as an optional filter may be: HDF5 reads it, and would read a packed one as it stands
        stored.write_direct_chunk((0,), rows.tobytes(), 1)
    with pytest.raises(SpecError, match="packed with ECF"):
        open_events(path).triggers()


def test_other_packings_of_prophesees_layout_are_read(tmp_path):
    """Records with deflate, in another order, without size: by h5py alone."""
    events = many(500, 1 << 20)
    rows = np.zeros(500, [("t", "<i8"), ("p", "<i2"), ("y", "<u2"), ("x", "<u2")])
    rows["t"], rows["x"], rows["y"], rows["p"] = events["t_us"], events["x"], events["y"], events["polarity"] > 0
    path = tmp_path / "o.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("CD/events", data=rows, compression="gzip", chunks=(99,))
    with pytest.raises(SpecError, match="does not state the size"):
        open_events(path)
    np.testing.assert_array_equal(joined(open_events(path, "prophesee", SHAPE)), events)
    for polarity in (2, -2):  # −1 is OFF in some files, as 0 is
        with h5py.File(path, "r+") as file:
            file["CD/events"][301, "p"] = polarity
        with pytest.raises(SpecError, match="events that are none, from number 297"):
            joined(open_events(path, "prophesee", SHAPE))


def damaged(path, change):
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def with_chunk(file, data, skipped=0):
    file["CD/events"].id.write_direct_chunk((0,), data, skipped)


@pytest.mark.parametrize(("change", "told"), [
    (lambda f: with_chunk(f, b"\0"), "ends at byte 1, within its values"),
    (lambda f: with_chunk(f, ecf.encoded(made((1, 2, 3, 1)))), "says 1 events; expected 50"),
    (lambda f: with_chunk(f, struct.pack("<Iq", 50 << 2, 0) + b"\x12" * 30), "another number of values"),
    (lambda f: with_chunk(f, struct.pack("<Iq", 50 << 2, 0) + b"\x1f\x33\0"), "another number of values"),
    (lambda f: with_chunk(f, struct.pack("<Iq", 50 << 2 | 2, 0) + b"\x1f\x32\0" + bytes(155)), "within its values"),
    (lambda f: with_chunk(f, struct.pack("<Iq", 50 << 2, 0) + b"\x1f\x32\0" + b"\xff\x00"), "another number of values"),
    (lambda f: with_chunk(f, struct.pack("<Iq", 50 << 2, 0) + b"\xf1" * 16 + b"\x1f\x32\0"), "more than 60 bits"),
    (lambda f: with_chunk(f, bytes(800), 1), "is not packed with ECF, as the file says"),
    (lambda f: f.attrs.create("geometry", "9x"), "has the geometry '9x'"),
    (lambda f: f["CD"].__delitem__("events") or f.__setitem__("CD/events", np.arange(3)), "is no data set of records"),
    (lambda f: f["CD"].__delitem__("events") or f["CD"].__setitem__("events", h5py.ExternalLink("x", "y")),
     "is a link"),
    (lambda f: f["CD"].__delitem__("events") or f["CD"].create_dataset(
        "events", (0,), prophesee_hdf5._RECORD, maxshape=(None,), chunks=(1 << 23,)), "would take 0.134 GB of memory"),
])  # fmt: skip
def test_damaged_files_are_one_clear_error(change, told, tmp_path):
    path = damaged(file_of(many(50, 1 << 20), EDGES[:0], "prophesee", tmp_path), change)
    with pytest.raises(SpecError, match=told):
        open_events(path).count()


@pytest.mark.parametrize(("place", "value"), [(921, 15), (920, 0), (904, 255), (905, 1)])
def test_a_heap_that_hdf5_would_walk_without_end_is_refused(place, value, tmp_path):
    """Its first entry reaches beyond it, or into zeros, or it is longer than its entries or than the file."""
    path = file_of(many(50, 1 << 20), EDGES[:0], "prophesee", tmp_path)
    data = bytearray(path.read_bytes())
    heap = data.index(b"GCOL")
    require_sound_heaps(path)
    data[place - 896 + heap] = value
    path.write_bytes(data)
    if place == 920:  # a shorter entry: the next ones begin within it
        data[heap + 16 : heap + 32] = bytes(16)
        path.write_bytes(data)
    with pytest.raises(SpecError, match=f"has a damaged heap of texts at byte {heap}"):
        open_events(path)


def test_damaged_chunks_never_raise_another_error():
    """Bytes of our and of their encoder, changed or cut."""
    with h5py.File(DATA / "ecf.hdf5") as file:
        chunks = [file["CD/events"].id.read_direct_chunk((first,))[1] for first in (0, 1000, 2000)]
    rng = np.random.default_rng(8)
    refused = 0
    for number in range(300):
        wrong = bytearray(chunks[number % 3])
        at = int(rng.integers(4, len(wrong) if number % 2 else 60))
        if number % 5 == 0:
            del wrong[at:]
        else:
            wrong[at] = int(rng.integers(256))
        try:
            assert ecf.decoded(bytes(wrong), 1000, "file", "chunk").size == 1000
        except SpecError:
            refused += 1
    assert refused > 60


# ---- DAT -----------------------------------------------------------------------------------------------------------

_DAT = b"% Data file containing CD events.\n% Version 2\n"


@pytest.mark.parametrize(("content", "told"), [
    (_DAT.replace(b"2", b"1") + b"\x0c\x08", "is a DAT file of version 1; expected 2"),
    (_DAT + b"\x0e\x18", "entries of type 14 of 24 bytes at byte 46; expected type 0 or 12"),
    (_DAT, "entries of type nothing"),
    (_DAT + b"% Width 99999\n% Height 3\n\x0c\x08", "has the size 99999x3"),
    (_DAT + b"% Width 9\n% Height 3\n\x0c\x08" + bytes(9), "ends within a word of 64 bits"),
    (_DAT + b"\x0c\x08", "does not state the size"),
])  # fmt: skip
def test_dat_files_that_are_none(content, told, tmp_path):
    path = tmp_path / "f.dat"
    path.write_bytes(content)
    with pytest.raises(SpecError, match=told):
        open_events(path).count()


def test_dat_files_of_other_writers_are_read(tmp_path):
    """By faery, and by hand with the type of older files and the line that newer ones end with."""
    import faery

    events = many(3000, 1 << 31)
    path = written(events, "dat", tmp_path)
    faery.events_stream_from_file(path).to_file(tmp_path / "f.dat", zero_t0=False)
    np.testing.assert_array_equal(joined(open_events(tmp_path / "f.dat")), events)
    body = path.read_bytes()[-8 * 3000 :]
    (tmp_path / "o.dat").write_bytes(_DAT + b"% Width 1280\n% Height 720\n% end\n\x00\x08" + body)
    np.testing.assert_array_equal(joined(open_events(tmp_path / "o.dat", "dat")), events)


# ---- real recordings -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_real_recording_goes_through_event_for_event(tmp_path):
    """HESIM_REAL_EVT2 is an EVT2 file of a camera of 640x480 px: import, view, export, and the readers of others."""
    import faery

    from hesim_render.cli import main

    path = os.environ.get("HESIM_REAL_EVT2")
    if path is None:
        pytest.skip("HESIM_REAL_EVT2 names no recording")

    def by_faery(file, version="evt2"):
        parts = faery.events_stream_from_file(file, dimensions_fallback=(640, 480), version_fallback=version)
        return joined(columns(*(part[key] for key in ("t", "x", "y", "on"))) for part in parts)

    expected = by_faery(path)
    assert expected.size > 100_000
    rec, out = str(tmp_path / "rec"), tmp_path / "out"
    out.mkdir()
    for words in (
        ["import", path, "--sensor", "gen31-vga", "--out", rec],
        ["view", rec, "--no-viewer"],
        ["export", rec, "--format", "evt3", "--out", str(out / "e.raw")],
        ["export", rec, "--format", "evt2", "--out", str(out / "e2.raw")],
        ["export", rec, "--format", "dat", "--out", str(out / "e.dat")],
        ["export", rec, "--format", "prophesee", "--out", str(out / "e.hdf5")],
        ["export", rec, "--format", "mcap-evt3", "--out", str(out / "e.mcap")],
    ):
        with pytest.raises(SystemExit, match="0"):
            main(words)
    np.testing.assert_array_equal(triggers_by_others(out / "e.raw")[0], expected)
    np.testing.assert_array_equal(by_faery(out / "e2.raw"), expected)
    np.testing.assert_array_equal(by_faery(out / "e.dat", "dat2"), expected)
    words = b"".join(message.events.tobytes() for _, message in packets_in(out / "e.mcap"))
    np.testing.assert_array_equal(by_evt3(words, tmp_path / "w.raw")[0], expected)
    for file in out.iterdir():
        np.testing.assert_array_equal(joined(open_events(file)), expected)
    if h5py.h5z.filter_avail(ecf.FILTER):  # HDF5_PLUGIN_PATH leads to Prophesee's own plugin
        with h5py.File(out / "e.hdf5") as file:
            rows = file["CD/events"][:]
        np.testing.assert_array_equal(columns(rows["t"], rows["x"], rows["y"], rows["p"]), expected)


@pytest.mark.slow
def test_packets_of_a_driver_are_read_event_for_event(tmp_path):
    """HESIM_EVENT_PACKETS is an MCAP file of EventPackets in EVT3; their words are also decoded by the package evt3."""
    path = os.environ.get("HESIM_EVENT_PACKETS")
    if path is None:
        pytest.skip("HESIM_EVENT_PACKETS names no file")
    with open(path, "rb") as file:
        words = [
            STORE.deserialize_cdr(message.data, schema.name).events.tobytes()
            for schema, _, message in make_reader(file).iter_messages()
            if schema.name == event_packets.TYPE
        ]
    events, triggers = by_evt3(b"".join(words), tmp_path / "w.raw")
    opened = open_events(path)
    found = joined(opened)
    np.testing.assert_array_equal(found, events[events.size - found.size :])  # theirs has events before the first time
    np.testing.assert_array_equal(opened.triggers(), triggers)

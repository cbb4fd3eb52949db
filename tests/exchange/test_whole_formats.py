"""Events and frames in one file: MCAP read by libraries of others, the npz of H-ESIM, and videos."""

from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import recordings
from event_files import SHAPE, columns, joined, made, many
from hypothesis import HealthCheck, example, given, settings
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_round_trips import lists_of_events

import hesim_render as hr
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.exchange import EventStream, mcap_file, mcap_records, open_events
from hesim_render.recording import exports, movie
from hesim_render.recording.imports import import_recording

QUICK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
STORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in (
    ("dvs_msgs/msg/Event", "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity\n"),
    ("dvs_msgs/msg/EventArray", "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n"),
):
    STORE.register(get_types_from_msg(_text, _name))


def by_others(path):
    """Messages by the reader of mcap, decoded by rosbags with the definitions of ROS."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            yield channel.topic, message.log_time, STORE.deserialize_cdr(message.data, schema.name)


def events_by_others(path):
    found = [
        (e.ts.sec * 1_000_000 + e.ts.nanosec // 1000, e.x, e.y, e.polarity)
        for topic, _, array in by_others(path)
        if topic == mcap_file.EVENT_TOPIC
        for e in array.events
    ]
    return columns(*np.array(found, dtype=np.int64).reshape(-1, 4).T)


def write(events, path, frames=(), shape=SHAPE, encoding="mono16"):
    with path.open("wb") as file:
        mcap_file.write(EventStream.of(events, shape), frames, encoding, file, path)
    return path


def test_events_of_mcap_come_back_exactly(tmp_path):
    @QUICK
    @example(made((0, 0, 0, 1)))
    @example(made((5, 1279, 719, -1), (5, 0, 0, -1), (5, 1279, 0, 1)))
    @example(made(((1 << 24) - 1, 1, 2, 1), (1 << 24, 3, 4, -1), (1 << 40, 1279, 719, 1)))
    @given(lists_of_events(1 << 42))
    def check(events):
        path = write(events, tmp_path / "e.mcap")
        np.testing.assert_array_equal(events_by_others(path), events)
        if events.size:
            opened = open_events(path)
            assert opened.shape == SHAPE
            np.testing.assert_array_equal(joined(opened), events)
        else:
            with pytest.raises(SpecError, match="no messages of type EventArray"):
                open_events(path)

    check()


def test_packets_are_short_and_in_order_and_name_their_times(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_file, "_PACKET_EVENTS", 300)
    events = many(20_000, 1 << 18)
    raw = np.arange(48, dtype=np.uint16).reshape(6, 8)
    frames = [(1000 * k, raw + np.uint16(k)) for k in range(1, 300, 40)]
    path = write(events, tmp_path / "e.mcap", frames, encoding="bayer_rggb16")
    np.testing.assert_array_equal(events_by_others(path), events)
    np.testing.assert_array_equal(joined(open_events(path)), events)
    times, images = [], []
    for topic, log_ns, message in by_others(path):
        times.append(log_ns)
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if topic == mcap_file.FRAME_TOPIC:
            assert stamp == log_ns and (message.height, message.width, message.step) == (6, 8, 16)
            assert (message.encoding, message.is_bigendian, message.header.frame_id) == ("bayer_rggb16", 0, "camera")
            images.append((stamp // 1000, message.data.view("<u2").reshape(6, 8)))
        else:
            assert len(message.events) <= 300 and 0 <= log_ns - stamp < 10_000_000
    assert times == sorted(times) and [t for t, _ in images] == [t for t, _ in frames]
    for (_, found), (_, given_) in zip(images, frames, strict=True):
        np.testing.assert_array_equal(found, given_)


@pytest.mark.parametrize("cut", [8, 40, 300, 0.5, -1])
def test_a_cut_file_is_one_clear_error(cut, tmp_path):
    data = write(many(2000, 1 << 16), tmp_path / "e.mcap").read_bytes()
    place = int(cut * len(data)) if isinstance(cut, float) else cut
    (tmp_path / "cut.mcap").write_bytes(data[:place])
    with pytest.raises(SpecError, match=r"cut\.mcap: "):
        open_events(tmp_path / "cut.mcap").count()


def test_damaged_bytes_are_a_clear_error_or_no_matter(tmp_path):
    """300 files with wrong, set or missing bytes; 1500 with other seeds were tried."""
    data = write(many(300, 40_000, (24, 32)), tmp_path / "e.mcap", shape=(24, 32)).read_bytes()
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(300):
        wrong = bytearray(data)
        at, kind = int(rng.integers(len(wrong))), rng.integers(3)
        if kind == 2:
            del wrong[at : at + int(rng.integers(1, 50))]
        else:
            wrong[at : at + 1 + 7 * int(kind)] = rng.integers(0, 256, 1 + 7 * int(kind), dtype=np.uint8).tobytes()
        (tmp_path / "w.mcap").write_bytes(wrong)
        try:
            open_events(tmp_path / "w.mcap").count()
        except SpecError:
            refused += 1
    assert refused > 150


def test_what_is_damaged_or_too_late(tmp_path):
    data = bytearray(write(many(2000, 1 << 16), tmp_path / "e.mcap").read_bytes())
    data[len(data) // 3] ^= 0xFF
    (tmp_path / "e.mcap").write_bytes(data)
    with pytest.raises(SpecError, match=r"e\.mcap: "):
        open_events(tmp_path / "e.mcap").count()
    with pytest.raises(SpecError, match="ROS ends at"):
        write(made((1 << 52, 0, 0, 1)), tmp_path / "late.mcap")
    with pytest.raises(SpecError, match="comes after one at"):
        write(made((5, 0, 0, 1), (4, 0, 0, 1)), tmp_path / "back.mcap")


def test_without_the_package_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mcap.writer", None)
    recording = recordings.make("davis346")
    with pytest.raises(SpecError, match=r"pip install 'mcap[<>]"):
        recording.export("mcap", tmp_path / "e.mcap")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["eiger", "davis346", "reference-bayer"])
def test_a_recording_as_mcap(name, tmp_path):
    recording = recordings.make(name, tmp_path / "r")
    path = recording.export("mcap", tmp_path / "r.mcap")
    images = [m for topic, _, m in by_others(path) if topic == mcap_file.FRAME_TOPIC]
    assert {m.encoding for m in images} == {"bayer_rggb16" if name == "reference-bayer" else "mono16"}
    for frame, image in zip(recording.frames, images, strict=True):
        np.testing.assert_array_equal(image.data.view("<u2").reshape(frame.raw.shape), frame.raw)
    if min(recording.event_shape):
        np.testing.assert_array_equal(events_by_others(path), recording.events)


@pytest.mark.slow
def test_the_npz_of_h_esim_hold_every_event_of_each_tick(tmp_path):
    recording = recordings.make("gen2", tmp_path / "r")
    tick_us = recording.manifest["sensor"]["spec"]["evs"]["tick_us"]
    folder = recording.export("raw-npz", tmp_path / "n")
    frames = sorted(folder.glob("*_aps_raw.npz"))
    for frame, file in zip(recording.frames, frames, strict=True):
        assert int(file.name[:9]) == frame.t_us
        with np.load(file) as arrays:
            np.testing.assert_array_equal(arrays["raw"], frame.raw)
            np.testing.assert_array_equal(arrays["aps_raw"], frame.raw)
    for number, file in enumerate(sorted(folder.glob("*_evs.npz")), 1):
        assert int(file.name[:9]) == number * tick_us
        events = recording.event_slice((number - 1) * tick_us + 1, number * tick_us + 1)
        last = {(int(e["y"]), int(e["x"])): int(e["polarity"]) for e in events}
        with np.load(file) as arrays:
            assert {(y, x): arrays["events"][y, x] for y, x in np.argwhere(arrays["events"]).tolist()} == last
            np.testing.assert_array_equal(np.array([1, 0, 2])[arrays["events"] + 1], arrays["event_raw"])
    sensor = hr.load_sensor("gen2").crop(*reversed(recording.frames[0].raw.shape))
    again = import_recording(tmp_path / "again", sensor, frames=frames)
    np.testing.assert_array_equal(again.frames[1].raw, recording.frames[1].raw)


@pytest.mark.parametrize("name", [pytest.param("eiger", marks=pytest.mark.slow), "davis346"])
def test_videos_are_read_by_opencv(name, tmp_path):
    recording = recordings.make(name, tmp_path / "r")
    for kind in ("mp4", "mp4-colour", "mp4-events"):
        path = recording.export(kind, tmp_path / f"{kind}.mp4")
        capture = cv2.VideoCapture(str(path))
        pictures = [picture for ok, picture in iter(capture.read, (False, None)) if ok]
        # two frames alone would be gone in 0.08 s: each has 25 pictures
        assert len(pictures) == 50 and round(capture.get(cv2.CAP_PROP_FPS)) == 25
        assert pictures[0].shape[:2] == tuple(5 * size for size in recording.frames[0].raw.shape)
        strongest = pictures[-1].astype(int).max(axis=(0, 1))
        assert strongest.max() > 60
    assert movie.write_movie(recording, tmp_path / "colour.mp4", "mp4-colour") == 50
    with pytest.raises(RangeError, match="there are no events"):
        recordings.make("reference-bayer").export("mp4-events", tmp_path / "x.mp4")
    with pytest.raises(RangeError, match="there are no frames"):
        recordings.make("davis346", frames=0).export("mp4-colour", tmp_path / "x.mp4")
    assert not (tmp_path / "x.mp4").exists()


def test_a_picture_of_a_video_has_the_events_of_its_own_time():
    """Steps of a short recording share its frames; together they show every event once, a long one has one a frame."""
    recording = recordings.make("davis346", frames=3, duration_us=45_000)
    shown = []

    class Watched:
        def __getattr__(self, name):
            return getattr(recording, name)

        def event_slice(self, first, last):
            shown.append((first, last))
            return recording.event_slice(first, last)

    ends = [0, *(entry["t_us"] for entry in recording.manifest["frames"])]
    assert len(list(movie._pictures(Watched(), "mp4"))) == 51  # 17 for each frame
    assert shown[0][0] == 1 and shown[-1][1] == ends[-1] + 1
    assert all(before[1] == after[0] for before, after in pairwise(shown))
    assert {end + 1 for end in ends[1:]} <= {last for _, last in shown}
    long = recordings.make("davis346", frames=0, duration_us=600_001)
    assert len(list(movie._pictures(long, "mp4-events"))) == 61  # of 10 ms each, and the rest
    colour = list(movie._pictures(recording, "mp4-colour"))
    assert len(colour) == 51 and all(picture is colour[0] for picture in colour[:17])
    assert not np.array_equal(colour[16], colour[17])


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("says", [100, 1 << 33])
def test_a_part_that_unpacks_to_more_than_it_says_or_than_can_be_held_is_refused(
    tmp_path, monkeypatch, compression, says
):
    """64 MB of zeros in some ten kB, where 16 MB can be held."""
    monkeypatch.setattr(mcap_records, "_MOST_CHUNK_BYTES", 16 << 20)
    import lz4.frame
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk, Footer, Header

    zeros = bytes(64 << 20)
    data = zstandard.compress(zeros) if compression == "zstd" else lz4.frame.compress(zeros, store_size=False)
    builder = RecordBuilder()
    Header(profile="ros2", library="x").write(builder)
    Chunk(
        compression=compression, data=data, message_start_time=0, message_end_time=0, uncompressed_crc=0,
        uncompressed_size=says,
    ).write(builder)  # fmt: skip
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    magic = bytes((137, 77, 67, 65, 80, 48, 13, 10))
    (tmp_path / "bomb.mcap").write_bytes(magic + builder.end() + magic)
    with pytest.raises(
        SpecError, match=r"bomb\.mcap: has a part (that unpacks to \d+ bytes or more|of 8589934592 bytes)"
    ):
        open_events(tmp_path / "bomb.mcap")


@pytest.mark.parametrize("compression", ["ZSTD", "LZ4", "NONE"])
def test_parts_of_the_same_time_are_not_all_held(tmp_path, compression):
    """Of a few kB a sorting reader made some GB: each part may be small, their sum is not."""
    import struct
    import tracemalloc

    from mcap.writer import CompressionType, Writer

    with (tmp_path / "e.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=1 << 22, compression=CompressionType[compression])
        writer.start(profile="ros2", library="x")
        schema = writer.register_schema(mcap_file.EVENT_TYPE, "ros2msg", b"")
        channel = writer.register_channel("/e", "cdr", schema)
        for k in range(30):
            data = mcap_file.head(0) + struct.pack("<III", 4, 6, 1) + struct.pack("<HHiIB", 5, 3, k, 7000, 1)
            writer.add_message(channel, 10**9, data + bytes(4 << 20), 10**9)
        writer.finish()
    tracemalloc.start()
    try:
        events = np.concatenate(list(open_events(tmp_path / "e.mcap")))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert events["t_us"].tolist() == [1_000_000 * k + 7 for k in range(30)]
    assert set(events["x"]) == {5} and set(events["y"]) == {3}
    assert peak < 50e6


@pytest.mark.parametrize(("shape", "has_events"), [((1, 9), True), ((9, 1), True), ((0, 0), False)])
def test_sensors_of_one_row_have_events_in_their_file(shape, has_events, monkeypatch, tmp_path):
    written = []
    monkeypatch.setattr(exports, "event_stream", lambda recording: "events")
    monkeypatch.setattr(
        exports.mcap_file, "write", lambda events, frames, code, *more: written.append((events, list(frames), code))
    )
    mosaic = SimpleNamespace(tile_code=np.array([[1, 0], [2, 1]]), tile_shape=(2, 2))
    frame = SimpleNamespace(t_us=70, raw="raw")
    recording = SimpleNamespace(event_shape=shape, frames=[frame], mosaic=mosaic)
    exports._write_mcap(recording, tmp_path / "a.mcap", tmp_path / "b.mcap", None)
    assert written == [("events" if has_events else None, [(70, "raw")], "bayer_grbg16")]
    for code, tile in (([[1, 0], [1, 2]], (2, 2)), ([[1, 3], [2, 1]], (2, 2)), ([[0, 1, 1, 2]], (1, 4))):
        mosaic.tile_code, mosaic.tile_shape = np.array(code), tile
        assert exports.mosaic_encoding(mosaic) == "mono16"

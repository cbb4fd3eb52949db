"""Event files, read back by us and by libraries of others, to the exact event."""

import os
import re
import struct
import subprocess
import sys
import time

import aedat
import evt3
import faery
import h5py
import hdf5plugin
import lz4.frame
import numpy as np
import pytest
import zstandard
from event_files import DATA, SHAPE, columns, joined, made, many, raw, written
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from hesim_render.core.errors import SpecError
from hesim_render.exchange import EventStream, aedat4, open_events, stream
from hesim_render.exchange.aedat4 import FlatTable
from hesim_render.exchange.dsec import read_events as read_dsec

READABLE = ("evt2", "evt3", "dat", "aedat4", "dsec", "dsec-gzip", "npz", "txt")
QUICK = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
#: Times at which the counters of EVT3 (2^12, 2^24) and EVT2 (2^6, 2^34) start again, and one of days.
TURNS = [0, 1 << 6, 1 << 12, 1 << 24, 1 << 25, 1 << 32, 1 << 34, 1 << 40]


def times(latest_us):
    near = st.builds(lambda turn, step: max(0, turn + step), st.sampled_from(TURNS), st.integers(-3, 3))
    return st.one_of(near, st.integers(0, 200), st.integers(0, latest_us)).filter(lambda t: t <= latest_us)


def lists_of_events(latest_us, shape=SHAPE):
    """Also empty, of one event, of equal times, of the corners of the sensor."""
    rows, cols = shape
    x = st.one_of(st.sampled_from([0, cols - 1]), st.integers(0, cols - 1))
    y = st.one_of(st.sampled_from([0, rows - 1]), st.integers(0, rows - 1))
    event = st.tuples(times(latest_us), x, y, st.sampled_from([-1, 1]))
    return st.lists(event, max_size=40).map(lambda items: made(*sorted(items, key=lambda item: item[0])))


def aedat4_by_others(path):
    decoder = aedat.Decoder(str(path))
    assert decoder.id_to_stream() == {0: {"type": "events", "width": SHAPE[1], "height": SHAPE[0]}}
    for packet in decoder:
        if packet["stream_id"] == 0:
            yield columns(*(packet["events"][key] for key in ("t", "x", "y", "on")))


def read_by_others(path, name):
    """Events by a library that is not ours; of the simple forms, by their definition."""
    if name in ("evt2", "dat"):
        parts = faery.events_stream_from_file(path)
        return joined(columns(*(part[key] for key in ("t", "x", "y", "on"))) for part in parts)
    if name == "evt3":
        found = evt3.decode_file(str(path))
        assert (found.sensor_height, found.sensor_width) == SHAPE
        return columns(found.timestamp.astype(np.int64), found.x, found.y, found.polarity)
    if name == "aedat4":
        return joined(aedat4_by_others(path))
    if name in ("dsec", "dsec-gzip"):
        with h5py.File(path) as file:
            t = file["events/t"][:].astype(np.int64) + file["t_offset"][()]
            return columns(t, *(file[f"events/{key}"][:] for key in "xyp"))
    if name == "npz":
        with np.load(path) as file:
            assert (file["height"], file["width"]) == SHAPE
            return columns(*(file[key] for key in "txyp"))
    if name == "txt":
        first, *lines = path.read_text(encoding="ascii").splitlines()
        assert first == f"{SHAPE[1]} {SHAPE[0]}"
        rows = [line.split(" ") for line in lines]
        whole = [[int(t.replace(".", "")), int(x), int(y), int(p)] for t, x, y, p in rows]
        assert all(re.fullmatch(r"(0|[1-9]\d*)\.\d{6}", t) for t, *_ in rows)
        return columns(*np.array(whole, dtype=np.int64).reshape(-1, 4).T)
    assert name == "nmnist"
    data = np.frombuffer(path.read_bytes(), dtype=np.uint8).reshape(-1, 5).astype(np.int64)
    return columns((data[:, 2] & 127) << 16 | data[:, 3] << 8 | data[:, 4], data[:, 0], data[:, 1], data[:, 2] >> 7)


LATEST = {
    "evt2": 1 << 40, "evt3": 1 << 40, "dat": (1 << 32) - 1, "aedat4": 1 << 40, "dsec": (1 << 32) - 1,
    "dsec-gzip": (1 << 32) - 1, "npz": 1 << 40, "txt": 1 << 42,
}  # fmt: skip


@pytest.mark.parametrize("name", LATEST)
def test_events_come_back_exactly(name, tmp_path):
    @QUICK
    @example(made())
    @example(made((0, 0, 0, 1)))
    @example(made((5, 1279, 719, -1), (5, 0, 0, -1), (5, 1279, 0, 1)))
    @given(lists_of_events(LATEST[name]))
    def check(events):
        path = written(events, name, tmp_path)
        # the readers of other programs refuse files without events, or stop at them
        if events.size or name in ("dsec", "dsec-gzip", "npz", "txt"):
            found = read_by_others(path, name)
            np.testing.assert_array_equal(found, events)
        if name in READABLE:
            opened = open_events(path)
            assert opened.shape == SHAPE
            np.testing.assert_array_equal(joined(opened), events)

    check()


@pytest.mark.parametrize("name", [*LATEST, "nmnist"])
def test_many_events_in_several_blocks_come_back_exactly(name, tmp_path, monkeypatch):
    """Blocks of 1000 events, so that state is carried from block to block; pieces of readers are smaller too."""
    monkeypatch.setattr(stream, "BLOCK", 1000)
    monkeypatch.setattr("hesim_render.exchange.raw_file._PIECE", 777)
    monkeypatch.setattr("hesim_render.exchange.aedat4._PACKET_EVENTS", 300)
    monkeypatch.setattr("hesim_render.exchange.e2vid._LINES", 700)
    shape = (256, 256) if name == "nmnist" else SHAPE
    events = many(20_000, 1 << 23 if name == "nmnist" else 1 << 26, shape)
    path = written(events, name, tmp_path, shape)
    np.testing.assert_array_equal(read_by_others(path, name), events)
    if name in READABLE:
        np.testing.assert_array_equal(joined(open_events(path)), events)


@pytest.mark.parametrize("name", ["evt2", "evt3", "dat", "prophesee", "dsec", "npz", "txt"])
def test_the_bytes_do_not_depend_on_the_blocks(name, tmp_path, monkeypatch):
    """State that is carried wrongly, a row say, would cost words that repeat what is known."""
    events = many(5000, 1 << 20, (4, 4))
    whole = written(events, name, tmp_path, (4, 4)).read_bytes()
    monkeypatch.setattr(stream, "BLOCK", 7)
    if name in ("prophesee", "dsec"):
        time.sleep(1.1)  # HDF5 keeps times in whole seconds, if it is let
    assert written(events, name, tmp_path, (4, 4)).read_bytes() == whole


def test_vectors_of_evt3_are_read(tmp_path, monkeypatch):
    """Words made by hand, with vectors, TIME_HIGH without TIME_LOW, triggers and a start again; also piece by piece."""
    words = [
        0x2005, 0x8FFF, 0x6123, 0x0010, 0x3805, 0x4803, 0x5081, 0x4001, 0x2007, 0x0011, 0x3064, 0x5FFF, 0x8FFF, 0x6124,
        0x2009, 0xA101, 0x8000, 0x2808, 0x6001, 0x2809, 0x7123, 0xE000, 0x30C8, 0x4FFF, 0x4000, 0x4800,
    ]  # fmt: skip
    t = (0xFFF << 12) + 0x123
    up = 1 << 24
    expected = made(
        *[(t, x, 16, 1) for x in (5, 6, 16, 17, 24, 25)], (t, 7, 16, -1), *[(t, 100 + k, 17, -1) for k in range(8)],
        (t + 1, 9, 17, -1), (up, 8, 17, 1), (up + 1, 9, 17, 1), *[(up + 1, 200 + k, 17, -1) for k in range(12)],
        (up + 1, 235, 17, -1),
    )  # fmt: skip
    path = raw(tmp_path, words)
    theirs = evt3.decode_file(str(path))
    others = columns(theirs.timestamp.astype(np.int64), theirs.x, theirs.y, theirs.polarity)
    for piece in (1, 2, 3, 7, 1000):
        monkeypatch.setattr("hesim_render.exchange.raw_file._PIECE", piece)
        np.testing.assert_array_equal(joined(open_events(path)), expected)
    np.testing.assert_array_equal(others[others["t_us"] > 0], expected)  # theirs has the event before the first time


def test_evt2_words_are_those_of_the_definition(tmp_path):
    path = written(made((63, 1, 2, -1), (64, 3, 4, 1), (1 << 34, 2047, 2047, 1)), "evt2", tmp_path, (2048, 2048))
    words = np.frombuffer(path.read_bytes().partition(b"% end\n")[2], dtype="<u4")
    assert [hex(word) for word in words] == [
        "0x80000000", hex(63 << 22 | 1 << 11 | 2), "0x80000001", hex(1 << 28 | 3 << 11 | 4),
        "0x8fffffff", "0x80000000", "0x80000000", hex(1 << 28 | 2047 << 11 | 2047),
    ]  # fmt: skip


@pytest.mark.parametrize(("name", "events", "shape", "told"), [
    ("evt2", made(), (720, 2049), "at most 2048 rows and columns"),
    ("evt3", made(), (2049, 10), "at most 2048 rows and columns"),
    ("evt3", made(((1 << 44) + 1, 0, 0, 1)), SHAPE, "ends at 17592186044416"),
    ("nmnist", made(), (34, 257), "at most 256 rows and columns"),
    ("nmnist", made((1 << 23, 0, 0, 1)), (34, 34), "ends at 8388607"),
    ("dat", made(), (720, 16385), "at most 16384 rows and columns"),
    ("dat", made((1 << 32, 0, 0, 1)), SHAPE, "ends at 4294967295"),
    ("prophesee", made(), (2049, 10), "at most 2048 rows and columns"),
    ("dsec", made((0, 0, 0, 1), (1 << 32, 0, 0, 1)), SHAPE, "at most 4294967295"),
    ("aedat4", made(), (1 << 16, 10), "at most 32768"),
])  # fmt: skip
def test_what_does_not_fit_a_format_is_refused(name, events, shape, told, tmp_path):
    with pytest.raises(SpecError, match=told):
        written(events, name, tmp_path, shape)


def test_files_of_dv_processing_are_read():
    """`dv.aedat4` was written by dv-processing 2.0.4 (MonoCameraWriter), packed with LZ4."""
    opened = open_events(DATA / "dv.aedat4")
    expected = made(*[(1000 + 70 * k, 3 * k, 2 * k, 1 if k % 2 else -1) for k in range(5)])
    assert opened.shape == (260, 346)
    np.testing.assert_array_equal(joined(opened), expected)


@pytest.mark.parametrize("whose", ["dv-processing's", "ours"])
def test_the_table_of_packets_says_where_they_are(whose, tmp_path, monkeypatch):
    """Readers seek by it; the file of dv-processing shows that the test has the right idea of it."""
    monkeypatch.setattr("hesim_render.exchange.aedat4._PACKET_EVENTS", 300)
    events = many(1000, 1 << 20)
    path = written(events, "aedat4", tmp_path) if whose == "ours" else DATA / "dv.aedat4"
    data = path.read_bytes()
    table = lz4.frame.decompress(data[aedat4.read_header(path)[-1] :])
    head = FlatTable.root(table[4:], b"FTAB")
    offsets = head.structures(0, np.dtype("<u4"))
    assert offsets.size == (4 if whose == "ours" else 1)
    vector = 28  # place of the offsets behind the size, as in packets of events: after root, identifier, fields, count
    done = 0
    for k, offset in enumerate(offsets):
        entry = FlatTable(table[4:], vector + 4 * k + int(offset))
        place, count = entry.number(0, "<q", -1), entry.number(2, "<q", -1)
        stream_and_size = entry.number(1, "<q", -1)  # two numbers of 32 bits
        assert data[place - 8 : place] == stream_and_size.to_bytes(8, "little")
        found = FlatTable.root(lz4.frame.decompress(data[place : place + (stream_and_size >> 32)])[4:], b"EVTS")
        t = found.structures(0, np.dtype([("t", "<i8"), ("rest", "V8")]))["t"]
        assert (t.size, t[0], t[-1]) == (count, entry.number(3, "<q", -1), entry.number(4, "<q", -1))
        done += t.size
    assert done == (1000 if whose == "ours" else 5)


@pytest.mark.parametrize("kind", ["zstd", "none"])
def test_other_packings_of_aedat4_are_read(kind, tmp_path):
    events = many(1000, 1 << 20)
    data = written(events, "aedat4", tmp_path).read_bytes()
    _, _, _, begin, end = aedat4.read_header(tmp_path / "events.aedat4")
    (size,) = struct.unpack("<i", data[begin + 4 : begin + 8])
    content = lz4.frame.decompress(data[begin + 8 : begin + 8 + size])
    packed = {"zstd": zstandard.compress(content), "none": content}[kind]
    # compression is the number after the distance to the description of the fields, in the table at byte 24
    place = len("#!AER-DAT4.0\r\n") + 4 + 24 + 4
    assert begin + 8 + size == end and data[place : place + 4] == b"\x01\0\0\0"
    header = data[:place] + struct.pack("<i", {"zstd": 3, "none": 0}[kind]) + data[place + 4 : begin]
    path = tmp_path / "other.aedat4"
    for other in (b"", struct.pack("<ii", 5, 3) + b"abc"):  # a stream of something else, which is passed over
        body = other + struct.pack("<ii", 0, len(packed)) + packed
        table = (begin + len(body)).to_bytes(8, "little")
        path.write_bytes(header.replace(end.to_bytes(8, "little"), table) + body)
        np.testing.assert_array_equal(joined(open_events(path)), events)
        if not other:  # aedat refuses a stream that the header does not have
            np.testing.assert_array_equal(joined([*aedat4_by_others(path)]), events)


def test_files_of_dsec_are_read(tmp_path):
    """Their layout, written by h5py alone: Blosc with Zstandard, no attributes, an offset."""
    events = many(5000, 1 << 20, (480, 640))
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        packing = hdf5plugin.Blosc(cname="zstd", clevel=5)
        on = events["polarity"] > 0
        columns_of = {"t": events["t_us"], "x": events["x"], "y": events["y"], "p": on}
        for (name, values), kind in zip(columns_of.items(), ("u4", "u2", "u2", "u1"), strict=True):
            file.create_dataset(f"events/{name}", data=values.astype(kind), compression=packing)
        file["ms_to_idx"] = np.searchsorted(events["t_us"], np.arange(0, 1050) * 1000).astype(np.uint64)
        file["t_offset"] = np.int64(49_599_300_523)
    with pytest.raises(SpecError, match="does not state the size"):
        open_events(path)
    events["t_us"] += 49_599_300_523
    np.testing.assert_array_equal(joined(open_events(path, shape=(480, 640))), events)


def test_an_interval_of_a_file_of_dsec_is_read_by_its_index(tmp_path):
    """Times count from `t_offset`: the events of an interval, and an index that does not fit in either direction."""
    events, offset = many(3000, 1 << 16, (48, 64)), 7_300_523
    on = (events["polarity"] > 0).astype("u1")
    starts = np.searchsorted(events["t_us"], np.arange(0, 67) * 1000)

    def written(name, shift):
        with h5py.File(tmp_path / name, "w") as file:
            for key, values, kind in (("t", events["t_us"], "u4"), ("x", events["x"], "u2"), ("y", events["y"], "u2")):
                file[f"events/{key}"] = values.astype(kind)
            file["events/p"] = on
            file["ms_to_idx"] = np.clip(starts + shift, 0, events.size).astype(np.uint64)
            file["t_offset"] = np.int64(offset)
        return tmp_path / name

    moved = events.copy()
    moved["t_us"] += offset
    begin, end = offset + 21_304, offset + 40_777
    part = moved[(moved["t_us"] >= begin) & (moved["t_us"] < end)]
    assert 500 < part.size < 1500
    np.testing.assert_array_equal(read_dsec(written("good.h5", 0), begin, end, shape=(48, 64)), part)
    for name, shift, interval in (("late.h5", 300, (begin, None)), ("early.h5", -300, (None, end))):
        with pytest.raises(SpecError, match="ms_to_idx does not fit the times"):
            read_dsec(written(name, shift), *interval, shape=(48, 64))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evt2", "evt3", "dat", "prophesee", "aedat4", "dsec"])
def test_a_hundred_million_events_take_bounded_memory(name, tmp_path):
    """Peak memory of a process that writes and reads them; as one array they would take 1.3 GB.

    Without the comparison, with a block of the input, the peaks were 111 (AEDAT4) to 143 MB (EVT2).
    """
    code = (
        "import resource, sys; import numpy as np\n"
        "from pathlib import Path\n"
        "from hesim_render.exchange import EVENT_FORMATS, EventStream, open_events\n"
        "from event_files import many\n"
        "block = many(1 << 20, 1 << 20)\n"
        "def blocks():\n"
        "    for k in range(96):\n"
        "        part = block.copy(); part['t_us'] += k << 20; yield part\n"
        "path = Path(sys.argv[1]); stream = EventStream(blocks, (720, 1280))\n"
        "with path.open('wb') as file: EVENT_FORMATS[sys.argv[2]].write(stream, file, path)\n"
        "read = open_events(path); same = all((a == b).all() for a, b in zip(aligned(read), blocks()))\n"
        "print(same, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10)\n"
    )
    aligned = (
        "def aligned(stream):\n"
        "    parts, size = [], 0\n"
        "    for part in stream:\n"
        "        while part.size:\n"
        "            taken = part[: (1 << 20) - size]; part = part[taken.size :]\n"
        "            parts.append(taken); size += taken.size\n"
        "            if size == 1 << 20: yield np.concatenate(parts); parts, size = [], 0\n"
        "    assert not parts\n"
    )
    place = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, [*sys.path]))}
    program = aligned + code
    done = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "events", name],
        env=place,
        capture_output=True,
        text=True,
        check=True,
    )
    same, peak_mb = done.stdout.split()
    assert same == "True" and int(peak_mb) < 500


def test_a_field_that_a_table_leaves_out_has_its_default():
    """A table of its own layout: two fields, the second one left out, behind its list of offsets."""
    table = FlatTable(struct.pack("<HHHHii", 8, 8, 4, 0, 8, 42), 8)
    assert [table.number(field, "<i", 7) for field in (0, 1, 5)] == [42, 7, 7]
    assert table.structures(1, np.dtype("u1")).size == 0 and table.text(5) == ""


def test_sizes_and_places_within_an_aedat4_file_are_those_of_its_parts(tmp_path, monkeypatch):
    """Each FlatBuffer says the bytes that follow its size; a packet's structures begin 8 bytes after its table."""
    monkeypatch.setattr("hesim_render.exchange.aedat4._PACKET_EVENTS", 300)
    events = many(700, 1 << 20, (48, 64))
    path = tmp_path / "e.aedat4"
    with path.open("wb") as file:
        aedat4.write(EventStream.of(events, (48, 64), path), file, path)
    data = path.read_bytes()
    begin = data.index(b"\r\n") + 2
    (size,) = struct.unpack_from("<I", data, begin)
    table = struct.unpack_from("<q", data, begin + 4 + struct.unpack_from("<I", data, begin + 4)[0] + 12)[0]
    place, counts = begin + 4 + size, []
    while place < table:
        stream, packed = struct.unpack_from("<ii", data, place)
        content = lz4.frame.decompress(data[place + 8 : place + 8 + packed])
        said, root = struct.unpack_from("<I", content)[0], 4 + struct.unpack_from("<I", content, 4)[0]
        assert stream == 0 and said == len(content) - 4 and content[8:12] == b"EVTS"
        vector = root + 4 + struct.unpack_from("<I", content, root + 4)[0]
        counts.append(struct.unpack_from("<I", content, vector)[0])
        assert len(content) == vector + 4 + 16 * counts[-1]
        place += 8 + packed
    assert place == table and counts == [300, 300, 100]
    ends = lz4.frame.decompress(data[table:])
    assert struct.unpack_from("<I", ends)[0] == len(ends) - 4 and ends[8:12] == b"FTAB"

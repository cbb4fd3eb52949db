"""Damaged and foreign event files, and outputs that exist: one clear line, and nothing is changed."""

import io
import json
import os
import struct

import h5py
import lz4.frame
import numpy as np
import pytest
import recordings
from event_files import DATA, SHAPE, columns, made, many, raw, written

import hesim_render as hr
from hesim_render.cli import main
from hesim_render.core.errors import HesimError, OutputError, RangeError, SpecError
from hesim_render.exchange import EVENT_FORMATS, EventStream, aedat4, dsec, open_events, raw_file
from hesim_render.exchange.dsec import EventFileWriter
from hesim_render.recording.exports import SUFFIXES, import_events

READABLE = ("evt2", "evt3", "dat", "prophesee", "aedat4", "dsec", "npz")


def read_all(path, *options):
    return sum(block.size for block in open_events(path, *options))


@pytest.mark.parametrize("name", READABLE)
def test_a_file_cut_anywhere_is_one_error_or_fewer_events(name, tmp_path):
    """RAW files have no end mark: cut between two words, one is a shorter file."""
    path = written(many(3000, 1 << 20), name, tmp_path)
    whole, cut = path.read_bytes(), tmp_path / "cut"
    for size in np.random.default_rng(1).integers(0, len(whole), 25):
        cut.write_bytes(whole[:size])
        try:
            found = read_all(cut)
        except HesimError as error:
            assert str(error).startswith(str(cut)) and "\n" not in str(error)
        else:
            assert name in ("evt2", "evt3", "dat") and found < 3000


def test_an_hdf5_file_of_something_else_names_what_it_lacks(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["cd/time"] = np.arange(3)
    with pytest.raises(SpecError, match=r"other\.h5: has no data set events/\w"):
        read_all(tmp_path / "other.h5", "dsec", (4, 5))


@pytest.mark.parametrize("name", READABLE)
def test_damaged_bytes_never_raise_another_error(name, tmp_path):
    path = written(many(500, 1 << 20), name, tmp_path)
    whole, bad = np.frombuffer(path.read_bytes(), dtype=np.uint8), tmp_path / "bad"
    rng = np.random.default_rng(2)
    for _ in range(60):
        changed = whole.copy()
        # half of the changes in the first bytes, where the headers are
        places = rng.integers(0, changed.size if rng.random() < 0.5 else min(1000, changed.size), rng.integers(1, 6))
        changed[places] = rng.integers(0, 256, places.size)
        bad.write_bytes(changed.tobytes())
        try:
            read_all(bad)
        except HesimError as error:
            assert "\n" not in str(error)


def swapped(path, old, new):
    path.write_bytes(path.read_bytes().replace(old, new))
    return path


def test_an_evt2_file_called_evt3_is_told(tmp_path):
    path = written(many(3000, 1 << 20), "evt2", tmp_path)
    with pytest.raises(SpecError, match="was to be read as evt3, which is evt2"):
        open_events(path, "evt3")
    lying = swapped(swapped(path, b"% evt 2.0", b"% evt 3.0"), b"EVT2", b"EVT3")
    with pytest.raises(SpecError, match="which EVT3 does not have; the file is damaged or of another format"):
        read_all(lying)
    path = written(many(3000, 1 << 20), "evt3", tmp_path)
    lying = swapped(swapped(path, b"% evt 3.0", b"% evt 2.0"), b"EVT3", b"EVT2")
    with pytest.raises(SpecError, match="which EVT2 does not have; the file is damaged or of another format"):
        read_all(lying)


@pytest.mark.parametrize(("header", "dtype", "words"), [
    ("% evt 3.0\n% geometry 9x9\n% end\n", "<u2", [0x8FF0, 0x6001, 0x0003, 0x2005, 0x8010, 0x2005]),
    ("% evt 2.0\n% geometry 9x9\n% end\n", "<u4", [0x8FFFFFF0, 0x00000801, 0x80000010, 0x00000801]),
])  # fmt: skip
def test_time_that_goes_back_is_no_new_start(header, dtype, words, tmp_path):
    """A counter that ends starts again near 0; from elsewhere, time goes back."""
    with pytest.raises(SpecError, match=r"goes back in time \(TIME_HIGH from \d+ to 16\)"):
        read_all(raw(tmp_path, words, dtype, header))


@pytest.mark.parametrize(("content", "told"), [
    (b"", "of no known event format"),
    (b"II*\0 a TIFF file", "of no known event format"),
    (b"% evt 2.1\n% end\n", "has the format 'EVT21'"),
    (b"% evt 4\n", "has the format '4'"),
    (b"% format EVT3;height=9999;width=10\n", "has the size 10x9999"),
    (b"% geometry 0x20\n% evt 3.0\n% end\n", "has the size 0x20"),
    (b"% format EVT3;width=640\n% end\n", "has the size 640x"),
    (b"% evt 3.0\n% end\n", "does not state the size"),
    (b"#!AER-DAT4.0\r\n", "cut short"),
    (b"#!AER-DAT3.1\r\n", "not an AEDAT4 file"),
])  # fmt: skip
def test_foreign_files_are_told(content, told, tmp_path):
    path = tmp_path / "foreign"
    path.write_bytes(content)
    with pytest.raises(SpecError, match=told):
        open_events(path)


def test_aedat4_with_entities_or_impossible_coordinates(tmp_path, monkeypatch):
    from hesim_render.exchange import aedat4

    path = written(made((1, 3, 4, 1)), "aedat4", tmp_path)
    packet = lz4.frame.decompress(path.read_bytes()[aedat4.read_header(path)[3] + 8 :])
    assert packet[-6:-4] == b"\4\0"  # y, before the polarity and its padding
    monkeypatch.setattr(aedat4, "_packet", lambda events: packet[:-6] + b"\xff\xff" + packet[-4:])
    with pytest.raises(SpecError, match=r"event 0 \(x 3, y 65535\) is outside of 1280x720 px"):
        read_all(written(made((1, 3, 4, 1)), "aedat4", tmp_path))
    monkeypatch.setattr(aedat4, "_INFO", '<!DOCTYPE dv [<!ENTITY a "aaaa">]>' + aedat4._INFO)
    with pytest.raises(SpecError, match="declares a document type or entities"):
        open_events(written(made((1, 3, 4, 1)), "aedat4", tmp_path))


@pytest.mark.parametrize(("name", "missing", "told"), [
    ("evt2", 2, "ends within a word of 32 bits; the file is cut short"),
    ("evt3", 1, "ends within a word of 16 bits; the file is cut short"),
    ("aedat4", 1000, "ends before its table of packets; the file is cut short"),
])  # fmt: skip
def test_files_cut_short_are_told(name, missing, told, tmp_path):
    path = written(many(3000, 1 << 20), name, tmp_path)
    path.write_bytes(path.read_bytes()[:-missing])
    with pytest.raises(SpecError, match=told):
        read_all(path)


def test_events_in_blocks_that_go_back_are_refused_as_they_are_written(tmp_path):
    writer = EventFileWriter(tmp_path / "events.h5", (3, 5), 20, 900)
    writer.append(made((30, 4, 1, 1), (80, 2, 2, -1)))
    with pytest.raises(ValueError, match="in order of time"):
        writer.append(made((50, 1, 0, 1)))
    writer.abandon()


def test_arrays_of_events_may_lack_their_size_and_have_polarities_as_bool(tmp_path):
    columns_ = {"t": np.uint64([5, 9]), "x": np.uint16([3, 1]), "y": np.uint16([0, 2]), "p": np.array([True, False])}
    np.savez(tmp_path / "e.npz", **columns_)
    with pytest.raises(SpecError, match="does not state the size of the sensor"):
        open_events(tmp_path / "e.npz")
    stream = open_events(tmp_path / "e.npz", shape=(3, 5))
    assert stream.shape == (3, 5) and np.concatenate(list(stream))["polarity"].tolist() == [1, -1]


def test_blocks_are_encoded_behind_their_predecessors(tmp_path):
    blocks = [made((30, 4, 1, 1), (80, 2, 2, -1)), made((90, 1, 0, 1))]
    out, seen = io.BytesIO(), []

    def encode(events, before):
        seen.append(None if before is None else int(before["t_us"]))
        return events["t_us"].astype("<u4")

    stream = EventStream(lambda: iter(blocks), (3, 5))
    stream.encode_into(out, "words", encode, 90)
    assert seen == [None, 80] and np.frombuffer(out.getvalue(), "<u4").tolist() == [30, 80, 90]
    assert stream.span_us() == (30, 90) and EventStream(lambda: iter(()), (3, 5)).span_us() == (0, 0)
    with pytest.raises(SpecError, match="words ends at 89 µs; an event is at 90 µs"):
        stream.encode_into(io.BytesIO(), "words", encode, 89)
    (tmp_path / "words.raw").write_bytes(b"\x01\x80% end\n")
    assert raw_file.read_lines(tmp_path / "words.raw") == ({}, 0)
    # words without a time have that of the latest word before them that has one
    assert raw_file.latest(np.array([True, False, False, True, False])).tolist() == [0, 0, 0, 3, 3]


def test_a_file_of_events_holds_32_bits_of_us_from_its_own_begin_on(tmp_path):
    EventFileWriter(tmp_path / "late.h5", (3, 5), 700, 700 + (1 << 32) - 1).abandon()
    with pytest.raises(SpecError, match="at most 4294967295 µs, not 4294967296"):
        EventFileWriter(tmp_path / "long.h5", (3, 5), 700, 700 + (1 << 32))


def test_the_index_of_milliseconds_counts_from_the_begin_and_goes_to_the_end(tmp_path):
    writer = EventFileWriter(tmp_path / "e.h5", (3, 5), 700, 6_900)
    writer.append(made((900, 4, 1, 1), (1700, 2, 2, -1), (1701, 1, 0, 1)))
    writer.append(made((4703, 1, 0, 1)))
    writer.close()
    with h5py.File(tmp_path / "e.h5") as file:
        assert list(file["ms_to_idx"]) == [0, 1, 3, 3, 3, 4, 4, 4]
        assert list(file["events/t"]) == [200, 1000, 1001, 4003] and file["t_offset"][()] == 700
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        columns_ = file["events/x"][:].astype("<i2")
        del file["events/x"]
        file["events/x"] = columns_
    # other programs write integers of other sizes, and no index of milliseconds
    assert read_all(tmp_path / "e.h5", None, (3, 5)) == 4
    with pytest.raises(SpecError, match="events/x holds int16; expected uint16"):
        dsec.read_events(tmp_path / "e.h5")
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        for name, kind in (("t", "<i8"), ("y", "<u4"), ("p", "?")):
            values = file[f"events/{name}"][:].astype(kind)
            del file[f"events/{name}"]
            file[f"events/{name}"] = values
        del file["ms_to_idx"], file["t_offset"]
    (block,) = open_events(tmp_path / "e.h5", None, (3, 5))
    assert block["t_us"].tolist() == [200, 1000, 1001, 4003]
    for name, value, expected in (("y", 1 << 20, "0 to 65535"), ("x", -1, "0 to 65535"), ("t", -5, "0 to 9007")):
        with h5py.File(tmp_path / "e.h5", "r+") as file:
            before = file[f"events/{name}"][2]
            file[f"events/{name}"][2] = value
        with pytest.raises(SpecError, match=rf"events/{name} holds .*; expected {expected}"):
            read_all(tmp_path / "e.h5", None, (3, 5))
        with h5py.File(tmp_path / "e.h5", "r+") as file:
            file[f"events/{name}"][2] = before
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        file["t_offset"] = 700
        file["ms_to_idx"] = np.array([0, 1, 3, 3, 3, 4, 4, 4], "<u8")
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        del file["events/x"]
        file.create_dataset("events/x", data=columns_.astype("<u2"), chunks=(1 << 26,), maxshape=(None,))
    with pytest.raises(SpecError, match=r"a chunk of events/x would take 0\.134 GB"):
        read_all(tmp_path / "e.h5", None, (3, 5))


def test_blocks_of_a_file_of_events_follow_each_other(tmp_path, monkeypatch):
    events = many(50, 1 << 20)
    path = written(events, "dsec", tmp_path)
    monkeypatch.setattr("hesim_render.exchange.dsec.BLOCK", 7)
    blocks = list(open_events(path))
    assert [block.size for block in blocks] == [7] * 7 + [1]
    np.testing.assert_array_equal(np.concatenate(blocks), events)
    # the folder of a recording stands for the events in it
    np.testing.assert_array_equal(np.concatenate(list(open_events(tmp_path))), events)


def test_no_file_and_no_such_format(tmp_path):
    with pytest.raises(SpecError, match=r"events\.h5: no such file"):
        open_events(tmp_path)
    with pytest.raises(SpecError, match=r"missing.*No such file"):
        open_events(tmp_path / "missing.raw")
    with pytest.raises(RangeError, match="expected one of evt2"):
        open_events(DATA / "dv.aedat4", "evt4")


def test_headers_of_other_programs_are_read(tmp_path):
    """Without ``% end``, without geometry, and with a size that the caller knows."""
    words = [0x8000, 0x6001, 0x0003, 0x2805]
    expected = made((1, 5, 3, 1))
    for header in ("% evt 3.0\n% format EVT3;height=720;width=1280\n", "% geometry 1280x720\n% evt 3.0\n% date x y\n"):
        path = raw(tmp_path, words, header=header)
        opened = open_events(path)
        assert opened.shape == SHAPE
        np.testing.assert_array_equal(next(iter(opened)), expected)
    path = raw(tmp_path, words, header="% evt 3.0\n")
    assert read_all(path, None, (10, 10)) == 1
    with pytest.raises(SpecError, match=r"event 0 \(x 5, y 3\) is outside of 5x10 px"):
        read_all(path, None, (10, 5))


@pytest.mark.parametrize("name", EVENT_FORMATS)
def test_events_out_of_order_or_outside_are_not_written(name, tmp_path):
    shape = (200, 200)
    for events, told in (
        (made((5, 0, 0, 1), (4, 0, 0, 1)), "event 1, at 4 µs, comes after one at 5 µs"),
        (made(*((t, 0, 0, 1) for t in (3, 5, 4, 6, 2))), "event 2, at 4 µs, comes after one at 5 µs"),  # the first one
        (made((-1, 0, 0, 1)), "event 0, at -1 µs, lies before 0"),
        (made((0, 0, 0, 1), (1, 200, 3, 1), (2, 201, 3, 1)), r"event 1 \(x 200, y 3\) is outside of 200x200 px"),
        (made((0, 3, 200, 1)), r"event 0 \(x 3, y 200\) is outside of 200x200 px"),
    ):
        with pytest.raises(SpecError, match=told):
            written(events, name, tmp_path, shape)
    blocks = EventStream(lambda: [made((2, 0, 0, 1), (5, 0, 0, 1)), made(), made((4, 0, 0, 1), (3, 0, 0, 1))], shape)
    with pytest.raises(SpecError, match="event 2, at 4 µs, comes after one at 5 µs"):
        list(blocks)


@pytest.mark.parametrize(("arrays", "told"), [
    ({"t": [1], "x": [1], "y": [1]}, "holds no array 'polarity'"),
    ({"t": [1, 2], "x": [1], "y": [1], "p": [1]}, "four lists of one length"),
    ({"t": [0.5], "x": [1], "y": [1], "p": [1]}, "t holds float64; expected whole numbers"),
    ({"t": [1], "x": [-1], "y": [1], "p": [1]}, "x holds -1; expected 0 to 65535"),
    ({"t": [1], "x": [1], "y": [70000], "p": [1]}, "y holds 70000"),
    ({"t": [1], "x": [1], "y": [1], "p": [2]}, "p holds 2; expected -1 to 1"),
])  # fmt: skip
def test_arrays_that_are_no_events(arrays, told, tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **{name: np.array(values) for name, values in arrays.items()})
    with pytest.raises(SpecError, match=told):
        read_all(path, None, SHAPE)


def test_arrays_with_the_other_names_are_read(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, timestamp=[3, 4], x=[1, 2], y=[5, 6], polarity=[-1, 1])
    np.testing.assert_array_equal(next(iter(open_events(path, shape=SHAPE))), columns([3, 4], [1, 2], [5, 6], [0, 1]))


def test_nothing_is_overwritten_unless_asked(tmp_path):
    recording = recordings.make("davis346", tmp_path / "r")
    before = (tmp_path / "r" / "events.h5").read_bytes()
    for name, out in (("evt3", tmp_path / "out.raw"), ("dsec", tmp_path / "out.h5")):
        out.write_bytes(b"precious")
        with pytest.raises(OutputError, match="exists; give another name, or overwrite it"):
            recording.export(name, out)
        assert out.read_bytes() == b"precious"
        recording.export(name, out, overwrite=True)
        assert read_all(out) == 20_000
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="is the file of the events itself"):
            recording.export("dsec", tmp_path / "r" / "events.h5", overwrite)
    assert (tmp_path / "r" / "events.h5").read_bytes() == before
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").touch()
    (tmp_path / "folder.raw").mkdir()
    with pytest.raises(OutputError, match="is a folder"):
        recording.export("evt2", tmp_path / "folder.raw", overwrite=True)
    with pytest.raises(OutputError, match="holds other things"):
        recording.export("tiff", tmp_path / "folder", overwrite=True)
    # an error on the way leaves the old file, and no other
    with pytest.raises(SpecError, match="at most 4294967295"):
        source = written(made((0, 0, 0, 1), (1 << 33, 0, 0, 1)), "evt2", tmp_path)
        import_events(source, out, overwrite=True)
    assert read_all(out) == 20_000
    assert sorted(os.listdir(tmp_path)) == ["events.raw", "folder", "folder.raw", "out.h5", "out.raw", "r"]


def test_a_name_that_says_another_format_is_refused(tmp_path, capsys):
    """Of every format: one file has its own end, a folder has the end of no file."""
    recording = recordings.make("davis346", tmp_path / "r")
    files = {"evt2": ".raw", "evt3": ".raw", "dat": ".dat", "prophesee": ".h5 or .hdf5", "aedat4": ".aedat4",
             "dsec": ".h5 or .hdf5", "dsec-gzip": ".h5 or .hdf5", "npz": ".npz", "txt": ".txt", "nmnist": ".bin",
             "mcap": ".mcap", "mcap-evt3": ".mcap", "mp4": ".mp4", "mp4-colour": ".mp4",
             "mp4-events": ".mp4"}  # fmt: skip
    for name, end in files.items():
        for given in ("out", "out.tiff", "out.raw" if end != ".raw" else "out.h5"):
            with pytest.raises(OutputError, match=rf"{given}: {name} is a file; give a name that ends in {end}$"):
                recording.export(name, tmp_path / given)
    for name in ("tiff", "png", "npy", "mipi", "raw-npz", "exr", "tum", "kalibr", "opencv", "dsec-flow",
                 "prophesee-boxes", "dsec-det", "coco"):  # fmt: skip
        for given in (".png", ".raw", ".exr"):
            with pytest.raises(OutputError, match=rf"out\{given}: {name} is a folder of files; give a name without"):
                recording.export(name, tmp_path / f"out{given}")
    assert set(files) == set(SUFFIXES) and os.listdir(tmp_path) == ["r"]
    for more in (["tum", "out.csv"], ["evt3", "out.RAW.gz"]):
        status, _, err = command(capsys, "export", tmp_path / "r", "--format", more[0], "--out", tmp_path / more[1])
        assert status == 2 and err.count("\n") == 1 and "give a name" in err
    source = recording.export("evt3", tmp_path / "e.RAW")  # in capitals as well
    with pytest.raises(OutputError, match=r"e\.raw2: dsec is a file"):
        import_events(source, tmp_path / "e.raw2")


def test_an_import_says_how_many_events_it_has(tmp_path, capsys):
    source = written(made((3, 1, 0, 1), (5, 2, 1, -1), (9, 0, 3, 1)), "evt3", tmp_path)
    status, told, _ = command(capsys, "import", source, "--out", tmp_path / "e.h5", "--size", "7x5")
    assert status == 0 and "3 events (2 ON, 1 OFF) of 7x5 px in" in told
    told = json.loads(command(capsys, "import", source, "--out", tmp_path / "f.h5", "--size", "7x5", "--json")[1])
    assert (told["events"], told["events_on"], told["events_off"]) == (3, 2, 1)
    assert told["event_grid"] == {"width": 7, "height": 5}


def test_what_a_recording_does_not_have(tmp_path):
    with pytest.raises(RangeError, match="there are no events"):
        recordings.make("reference-bayer").export("evt3", tmp_path / "e.raw")
    with pytest.raises(RangeError, match="there are no frames"):
        recordings.make("davis346", frames=0).export("png", tmp_path / "e")
    with pytest.raises(RangeError, match=r"did you mean 'tiff'"):
        recordings.make("davis346").export("tif", tmp_path / "e")
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_a_packet_that_unpacks_to_more_than_can_be_held_is_refused(kind, tmp_path):
    """Half a GiB of zeros in some kB; no more is unpacked than is allowed."""
    import tracemalloc

    import zstandard

    data = written(many(10, 1000), "aedat4", tmp_path).read_bytes()
    begin = aedat4.read_header(tmp_path / "events.aedat4")[3]
    packer = zstandard.ZstdCompressor().compressobj() if kind == "zstd" else lz4.frame.LZ4FrameCompressor()
    packed = packer.begin() if kind == "lz4" else b""
    packed += b"".join(packer.compress(bytes(1 << 24)) for _ in range(32)) + packer.flush()
    place = len("#!AER-DAT4.0\r\n") + 4 + 24 + 4
    number = {"zstd": 3, "lz4": 1}[kind].to_bytes(4, "little")
    table = (begin + 8 + len(packed)).to_bytes(8, "little")
    header = data[:place] + number + data[place + 4 : place + 8] + table + data[place + 16 : begin]
    (tmp_path / "bomb.aedat4").write_bytes(header + struct.pack("<ii", 0, len(packed)) + packed)
    tracemalloc.start()
    try:
        with pytest.raises(SpecError, match=r"bomb\.aedat4: a packet ends early, or is larger than 128 MiB"):
            open_events(tmp_path / "bomb.aedat4").count()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 300e6


def command(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    return int(ended.value.code or 0), *capsys.readouterr()


def test_the_commands(capsys, tmp_path):
    recording = recordings.make("davis346", tmp_path / "r")
    status, told, _ = command(capsys, "export", tmp_path / "r", "--format", "evt3", "--out", tmp_path / "e.raw")
    assert (status, told) == (0, f"20000 events in {tmp_path / 'e.raw'}\n")
    status, told, _ = command(capsys, "import", tmp_path / "e.raw", "--out", tmp_path / "e.h5")
    counts, (rows, cols) = recording.manifest["counts"], recording.event_shape
    told_counts = (
        f"{counts['events']} events ({counts['events_on']} ON, {counts['events_off']} OFF) of {cols}x{rows} px"
    )
    assert (status, told) == (0, f"{told_counts} in {tmp_path / 'e.h5'}\n")
    np.testing.assert_array_equal(np.concatenate(list(open_events(tmp_path / "e.h5"))), recording.events)
    status, told, error = command(capsys, "import", tmp_path / "e.raw", "--format", "evt2", "--out", tmp_path / "f.h5")
    assert (status, told) == (2, "") and error.count("\n") == 1 and "which is evt3" in error
    status, _, error = command(capsys, "import", tmp_path / "e.raw", "--size", "12", "--out", tmp_path / "f.h5")
    assert status == 2 and "expected WIDTHxHEIGHT, such as 1280x720" in error
    assert not (tmp_path / "f.h5").exists()


def test_the_commands_complete_the_formats_that_exist():
    from hesim_render.cli import exchange
    from hesim_render.exchange import FRAME_FORMATS, formats
    from hesim_render.recording.exports import WHOLE_FORMATS
    from hesim_render.recording.truth_export import FORMATS

    assert exchange._complete_export("") == [*EVENT_FORMATS, *FRAME_FORMATS, *WHOLE_FORMATS, *FORMATS]
    assert exchange._complete_export("mp4-") == ["mp4-colour", "mp4-events"]
    assert exchange._complete_import("") == [*formats.READABLE] == [*formats._OPENERS]
    for name in (*EVENT_FORMATS, *FRAME_FORMATS, *WHOLE_FORMATS):
        assert f"``{name}``" in hr.Recording.export.__doc__

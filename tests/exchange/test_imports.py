"""Captures as recordings: what goes in comes out, and what does not fit the sensor is refused."""

from dataclasses import replace

import numpy as np
import pytest
import recordings
from event_files import made, written
from test_bad_files import command

from hesim_render.core.errors import HesimError, SpecError
from hesim_render.recording.imports import import_recording
from hesim_render.recording.outline import parameters
from hesim_render.recording.recording import Recording


@pytest.mark.parametrize(("name", "suffix"), [("tiff", "tiff"), ("png", "png"), ("npy", "npy"), ("dng", "dng")])
def test_frames_and_events_come_back(name, suffix, tmp_path):
    given = recordings.make("eiger", tmp_path / "r", frames=2)
    folder = tmp_path / "r" / "frames" if name == "dng" else given.export(name, tmp_path / "frames")
    events = given.export("evt3", tmp_path / "e.raw")
    files = sorted(folder.glob(f"*.{suffix}"))
    sensor = recordings.sensor_like("eiger")
    import_recording(tmp_path / "again", sensor, events=events, frames=files)
    again = Recording.load(tmp_path / "again")
    np.testing.assert_array_equal(again.events, given.events)
    assert len(again.frames) == 2
    for found, frame in zip(again.frames, given.frames, strict=True):
        np.testing.assert_array_equal(found.raw, frame.raw)
        assert found.times == frame.times and np.isnan(found.electrons_mean).all()
    assert again.manifest["settings"]["imported"] == {"events": "e.raw", "frames": [file.name for file in files]}
    aps = sensor.spec.aps
    last_us = frame.exposure_start_us + aps.exposure_us + round(95 * aps.line_time_us)
    assert again.manifest["time"]["end_us"] == max(last_us, given.events["t_us"][-1])


def test_what_does_not_fit_the_sensor_is_refused(tmp_path):
    sensor = recordings.sensor_like("eiger")
    events = written(made((0, 0, 0, 1)), "evt2", tmp_path)
    (tmp_path / "text.txt").touch()
    np.save(tmp_path / "large.npy", np.full(sensor.layout.shape, 1024, dtype=np.uint16))
    np.save(tmp_path / "small.npy", np.zeros((4, 4), dtype=np.uint16))
    np.save(tmp_path / "float.npy", np.zeros(sensor.layout.shape))
    for options, told in (
        ({}, "expected events, frames or both"),
        ({"events": events}, "is of 1280x720 px; the event grid of .* has 64x48"),
        ({"frames": [tmp_path / "text.txt"]}, "is no frame; expected .dng"),
        ({"frames": [tmp_path / "large.npy"]}, "holds 1024 DN; the sensor has 10 bit"),
        ({"frames": [tmp_path / "small.npy"]}, r"expected \(96, 128\)"),
        ({"frames": [tmp_path / "float.npy"]}, "expected whole numbers"),
        ({"frames": [tmp_path / "missing.png"]}, "No such file"),
        ({"events": events, "format": "evt3"}, "was to be read as evt3, which is evt2"),
        ({"frames": [tmp_path / "small.npy"], "format": "evt2"}, "expected nothing, unless events are given"),
    ):
        with pytest.raises(HesimError, match=told):
            import_recording(tmp_path / "out", sensor, **options)
    assert not (tmp_path / "out").exists()


def test_the_command_makes_a_recording(capsys, tmp_path):
    given = recordings.make("davis346", tmp_path / "r", frames=1)
    events, frames = given.export("aedat4", tmp_path / "e.aedat4"), given.export("png", tmp_path / "frames")
    words = (
        "import",
        events,
        frames / "000000.png",
        "--sensor",
        "davis346",
        "--roi",
        "128x96",
        "--out",
        tmp_path / "new",
    )
    status, told, error = command(capsys, *words)
    assert (status, error) == (0, "") and "RAW frames: 1 of 128x96 px" in told and "events: 20000" in told
    np.testing.assert_array_equal(Recording.load(tmp_path / "new").events, given.events)
    for format, wanted in (("evt3", (2, "was to be read as evt3, which is aedat4")), ("aedat4", (0, ""))):
        status, _, error = command(capsys, *words[:-1], tmp_path / "of-format", "--format", format)
        assert status == wanted[0] and wanted[1] in error
    status, _, error = command(capsys, *words[:-1], tmp_path / "x", "--size", "128x96")
    assert status == 2 and "with --sensor, the size is that of the sensor; --roi takes a part of it" in error
    status, _, error = command(capsys, "import", events, events, "--out", tmp_path / "x")
    assert (status, error) == (
        2,
        "hesim-render: more than one file, --roi, --trigger-channel or --from-zero needs --sensor\n",
    )


@pytest.mark.parametrize("name", ["davis346", "reference-bayer", "eiger"])
def test_events_and_images_of_an_mcap_file_come_back(name, tmp_path, capsys):
    given = recordings.make(name, tmp_path / "r", frames=2)
    file, sensor = given.export("mcap", tmp_path / "c.mcap"), recordings.sensor_like(name)
    again = import_recording(tmp_path / "again", sensor, events=file)
    np.testing.assert_array_equal(again.events, given.events)
    assert len(again.frames) == len(given.frames) == 2
    for found, frame in zip(again.frames, given.frames, strict=True):
        np.testing.assert_array_equal(found.raw, frame.raw)
        assert found.times == frame.times
    words = ("import", file, "--sensor", name, "--roi", "128x96", "--out", tmp_path / "x")
    status, told, _ = command(capsys, *words)
    assert status == 0 and "RAW frames: 2 of 128x96 px" in told
    np.testing.assert_array_equal(Recording.load(tmp_path / "x").events, given.events)


def test_images_of_other_writers(tmp_path):
    """By rosbags: mono8 with padded lines, big-endian mono16, and mosaics that are not the sensor's."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    sensor = recordings.sensor_like("davis346")
    rows, cols = sensor.layout.shape
    rng = np.random.default_rng(0)

    def image(encoding, values, step, big=0, t_us=70_000):
        kind = store.types
        stamp = kind["builtin_interfaces/msg/Time"](sec=t_us // 10**6, nanosec=t_us % 10**6 * 1000)
        header = kind["std_msgs/msg/Header"](stamp=stamp, frame_id="a longer name")
        data = np.frombuffer(values.tobytes(), np.uint8)
        message = kind["sensor_msgs/msg/Image"](
            header=header, height=rows, width=cols, encoding=encoding, is_bigendian=big, step=step, data=data
        )
        return bytes(store.serialize_cdr(message, "sensor_msgs/msg/Image"))

    def file_of(*messages):
        from mcap.writer import Writer

        with (tmp_path / "i.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="test")
            schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
            channel = writer.register_channel("/image", "cdr", schema)
            for number, message in enumerate(messages):
                writer.add_message(channel, number, message, number)
            writer.finish()
        return tmp_path / "i.mcap"

    small = rng.integers(0, 256, (rows, cols), dtype=np.uint8)
    padded = np.pad(small, ((0, 0), (0, 3)))
    large = rng.integers(0, 1 << 10, (rows, cols), dtype=np.uint16)
    messages = image("mono8", padded, cols + 3), image("mono16", large.astype(">u2"), 2 * cols, 1, 3_000_000)
    made_of = import_recording(tmp_path / "r", sensor, frames=[file_of(*messages)])
    assert [frame.t_us for frame in made_of.frames] == [70_000, 3_000_000]
    for frame, values in zip(made_of.frames, (small, large), strict=True):
        np.testing.assert_array_equal(frame.raw[frame.valid], values[frame.valid])
    assert made_of.events is None or made_of.events.size == 0
    cut = image("mono16", large, 2 * cols)[:-7]
    for given, told in (
        ([image("bayer_rggb8", small, cols)], "encoding bayer_rggb8; the region of the sensor is mono16"),
        ([image("rgb8", small, cols)], "encoding 'rgb8'; expected mono8"),
        ([cut], "shorter than its size|not little|damaged"),
        ([cut[:40]], "ends early"),
        ([image("mono16", large, cols)], "shorter than its size"),
        ([image("mono16", large | 1024, 2 * cols)], "the sensor has 10 bit"),
        (messages[::-1], "not in order of time"),
        ([], "has no messages of type Image"),
    ):
        with pytest.raises(HesimError, match=told):
            import_recording(tmp_path / "s", sensor, frames=[file_of(*given)])
    with pytest.raises(HesimError, match="give no other files"):
        import_recording(tmp_path / "s", sensor, frames=[file_of(*messages), tmp_path / "x.png"])
    assert not (tmp_path / "s").exists()


def test_a_recording_begins_where_its_events_do(tmp_path):
    """The clock of a camera that has run for hours is no part of the recording; times stay those of the file."""
    sensor = recordings.sensor_like("eiger")
    first_us = 2 * 3600 * 1_000_000 + 3_000  # more than what 32 bits hold
    events = made((first_us, 1, 2, 1), (first_us + 97_000, 3, 4, -1))
    file = written(events, "evt3", tmp_path, sensor.layout.evs_shape)
    recording = import_recording(tmp_path / "r", sensor, events=file)
    assert recording.manifest["time"] == {"begin_us": first_us - 1000, "end_us": first_us + 97_000}
    np.testing.assert_array_equal(recording.events["t_us"], [first_us, first_us + 97_000])
    assert ("time", "0.098 s from 7200.002 s on") in parameters(recording)
    (axes,) = (axes for axes in recording.plot().axes if "Events" in axes.get_title("left") + axes.get_title())
    assert axes.get_xlabel() == "time, s after 7200.002 s" and axes.dataLim.x1 == pytest.approx(0.098, abs=1e-5)
    assert (tmp_path / "r" / "events.h5").stat().st_size < 100_000  # its index does not begin at 0
    ticks = recording.export("raw-npz", tmp_path / "ticks")
    assert sum(np.abs(np.load(name)["events"]).sum() for name in ticks.glob("*_evs.npz")) == 2
    # what is written from it is an event file of the same times
    again = import_recording(tmp_path / "again", sensor, events=recording.export("dsec", tmp_path / "e.h5"))
    assert again.manifest["time"] == recording.manifest["time"]
    np.testing.assert_array_equal(again.events, recording.events)


def test_times_of_the_day_can_be_counted_from_zero(tmp_path, capsys):
    """MCAP files of ROS have the time of day, which EVT3 cannot hold; frames move with the events."""
    given = recordings.make("davis346", tmp_path / "r", frames=2)
    now_us = 1_760_000_000_000_000
    frames = [
        replace(frame, t_us=frame.t_us + now_us, exposure_start_us=frame.exposure_start_us + now_us)
        for frame in given.frames
    ]
    time = {name: us + now_us for name, us in given.manifest["time"].items()}
    events = given.events.copy()
    events["t_us"] += now_us
    day = Recording(frames, {**given.manifest, "time": time, "frames": [f.times for f in frames]}, events=events)
    file = day.export("mcap", tmp_path / "day.mcap")
    words = ("import", file, "--sensor", "davis346", "--roi", "128x96", "--out")
    assert command(capsys, *words, tmp_path / "late")[0] == 0
    late = Recording.load(tmp_path / "late")
    np.testing.assert_array_equal(late.events, events)
    with pytest.raises(SpecError, match="EVT3 ends at"):
        late.export("evt3", tmp_path / "late.raw")
    assert command(capsys, *words, tmp_path / "new", "--from-zero")[0] == 0
    new = Recording.load(tmp_path / "new")
    begin_us = late.manifest["time"]["begin_us"]
    assert new.manifest["time"] == {"begin_us": 0, "end_us": late.manifest["time"]["end_us"] - begin_us}
    np.testing.assert_array_equal(new.events["t_us"] + begin_us, events["t_us"])
    for moved, frame in zip(new.frames, frames, strict=True):
        assert moved.exposure_start_us + begin_us == frame.exposure_start_us and moved.t_us + begin_us == frame.t_us
    new.export("evt3", tmp_path / "new.raw")
    status, _, error = command(capsys, "import", file, "--from-zero", "--out", tmp_path / "x.h5")
    assert status == 2 and "needs --sensor" in error

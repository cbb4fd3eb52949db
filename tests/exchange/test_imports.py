"""Captures as recordings: what goes in comes out, and what does not fit the sensor is refused."""

import numpy as np
import pytest
import recordings
from event_files import made, written
from test_bad_files import command

from hesim_render.core.errors import HesimError
from hesim_render.recording.imports import import_recording
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
    status, _, error = command(capsys, "import", events, events, "--out", tmp_path / "x")
    assert (status, error) == (2, "hesim-render: more than one file, or --roi, needs --sensor\n")

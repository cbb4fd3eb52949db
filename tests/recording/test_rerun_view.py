"""The file for rerun, read back by rerun's own reader: times, DN, events and poses are those of the recording.

rerun has 170 MB and is not part of the test extra; tried with rerun-sdk 0.41.
"""

import re
import sys

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render.cli import main
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording import live_view, rerun_view
from hesim_render.recording.writer import RecordingWriter

rerun = pytest.importorskip("rerun")


def call(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    out, err = capsys.readouterr()
    return ended.value.code, out, err


def fails(capsys, *words):
    status, out, err = call(capsys, *words)
    assert status == 2 and out == "" and err.count("\n") == 1
    return err


def read(path):
    """{entity: [(time in µs or None, {component: values})]} of a file."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        times = (
            batch.column(rerun_view.TIMELINE).cast("int64").to_pylist()
            if rerun_view.TIMELINE in batch.schema.names
            else None
        )
        for row in range(batch.num_rows):
            values = {
                name.rpartition(":")[2]: batch.column(name)[row].as_py() for name in batch.schema.names if ":" in name
            }
            at = None if times is None else round(times[row] / 1000)
            found.setdefault(chunk.entity_path.strip("/"), []).append((at, values))
    return {entity: sorted(rows, key=lambda row: -1 if row[0] is None else row[0]) for entity, rows in found.items()}


def buffer(values, dtype, shape):
    return np.array(values["buffer"][0], dtype=np.uint8).view(dtype).reshape(shape)


def test_everything_is_at_its_time(capsys, tmp_path):
    moving = hr.load_sensor("gen2").crop(64, 48)
    out = tmp_path / "r"
    rec = hr.simulate(hr.load_scene("rotating-star"), moving, duration_s=0.07, samples=2, truth="depth,poses", out=out)
    status, text, _ = call(capsys, "view", out, "--rrd", tmp_path / "r.rrd")
    assert status == 0 and f"for rerun: {tmp_path / 'r.rrd'}" in text
    found = read(tmp_path / "r.rrd")
    for entity, dtype in (("camera/raw", "<u2"), ("truth/electrons", "<f4")):
        rows = [row for row in found[entity] if row[0] is not None]
        assert [at for at, _ in rows] == [frame.t_us for frame in rec.frames]
        for (_, values), frame in zip(rows, rec.frames, strict=True):
            wanted = frame.raw if dtype == "<u2" else np.nan_to_num(frame.electrons_mean)
            np.testing.assert_array_equal(buffer(values, dtype, frame.raw.shape), wanted)
    steps = [at for at, _ in found["events/rate"] if at is not None]
    assert steps == [*range(10_000, 70_000, 10_000), 70_000]
    counts = np.array([values["scalars"] for at, values in found["events/rate"] if at is not None]) * 0.01
    on = int((rec.events["polarity"] > 0).sum())
    assert np.round(counts.sum(axis=0)).tolist() == [on, rec.events.size - on] and on > 0
    _, picture = next(row for row in found["events/pictures"] if row[0] == 30_000)
    events = rec.event_slice(20_001, 30_001)
    wanted = np.zeros(rec.event_shape, np.uint8)
    for event in events:
        wanted[event["y"], event["x"]] = 1 if event["polarity"] > 0 else 2
    np.testing.assert_array_equal(buffer(picture, "u1", rec.event_shape), wanted)
    depth = next(values for at, values in found["truth/depth"] if at == rec.frames[0].t_us)
    stored = rec.stored_truth.read("frames/depth_m", 0)
    np.testing.assert_allclose(buffer(depth, "<f4", stored.shape), np.where(np.isfinite(stored), stored, 0), rtol=1e-6)
    poses = {at: values for at, values in found["world/camera"] if at is not None}
    for t_us in (0, 35_000, 70_000):
        pose = rec.truth.camera_pose(t_us)
        np.testing.assert_allclose(poses[t_us]["translation"][0], pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(np.reshape(poses[t_us]["mat3x3"][0], (3, 3)).T, pose[:3, :3], atol=1e-6)
    assert any(entity.startswith("world/objects/") for entity in found)


def test_recordings_without_frames_or_events(tmp_path):
    rerun_view.write_rrd(recordings.make("reference-bayer"), tmp_path / "a.rrd")
    rerun_view.write_rrd(recordings.make("davis346", frames=0), tmp_path / "b.rrd")
    assert "camera/raw" in read(tmp_path / "a.rrd") and "events/rate" not in read(tmp_path / "a.rrd")
    assert "camera/raw" not in read(tmp_path / "b.rrd") and "events/rate" in read(tmp_path / "b.rrd")


def test_nothing_is_overwritten_and_the_viewer_is_opened_on_request_alone(capsys, tmp_path, monkeypatch):
    recordings.make("davis346", tmp_path / "r")
    (tmp_path / "r.rrd").write_bytes(b"mine")
    assert "exists; give another name" in fails(capsys, "view", tmp_path / "r", "--rrd", tmp_path / "r.rrd")
    assert (tmp_path / "r.rrd").read_bytes() == b"mine"
    opened = []
    monkeypatch.setattr(rerun_view, "show", lambda recording, progress: opened.append(recording.path))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert call(capsys, "view", tmp_path / "r")[0] == 0 and not opened
    monkeypatch.setenv("DISPLAY", ":0")
    assert call(capsys, "view", tmp_path / "r", "--no-viewer")[0] == 0 and not opened
    assert call(capsys, "view", tmp_path / "r")[0] == 0 and opened == [tmp_path / "r"]
    assert "not both" in fails(capsys, "view", tmp_path / "r", "--viewer", "--rrd", tmp_path / "x.rrd")


def test_a_run_is_shown_while_it_goes_on(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(live_view, "_SHARE", np.inf)
    sensor = recordings.sensor_like("davis346", width=40, height=28)
    out, rng, steps = tmp_path / "r", np.random.default_rng(3), (7_000, 13_000, 45_000, 52_000)
    with RecordingWriter(out, sensor, seed=7, duration_us=57_000, live=True) as writer:
        (file,) = tmp_path.glob(".r.*.partial/live.rrd")
        blocks = []
        for last in steps:
            times = np.sort(rng.integers(last - 6_000, last + 1, 90))
            if last == 13_000:
                times[np.searchsorted(times, 10_000)] = 10_000  # the end of a step belongs to it
            block = np.zeros(90, EVENT_DTYPE)
            block["t_us"], block["x"], block["y"] = times, rng.integers(0, 40, 90), rng.integers(0, 28, 90)
            block["polarity"] = rng.choice([-1, 1], 90)
            writer.add_events(block)
            blocks.append(block)
        frame = recordings.frame_of(sensor, 1)
        writer.add_frame(frame)
        writer._live._stream.flush()
        begun = read(file)
        assert [at for at, _ in begun["events/rate"] if at is not None] == [10_000, 20_000, 30_000, 40_000, 50_000]
        assert [at for at, _ in begun["camera/colour"]] == [frame.t_us]
        rec = writer.finish()
    found, events = read(out / "live.rrd"), np.concatenate(blocks)
    rates = {at: values["scalars"] for at, values in found["events/rate"] if at is not None}
    assert list(rates) == [10_000, 20_000, 30_000, 40_000, 50_000, 57_000]
    for (last, values), first in zip(rates.items(), [-1, *rates], strict=False):
        here = events[(events["t_us"] > first) & (events["t_us"] <= last)]
        wanted = [(here["polarity"] > 0).sum(), (here["polarity"] < 0).sum()]
        assert np.round(np.array(values) * (last - max(first, 0)) * 1e-6).tolist() == wanted
        picture = next(values for at, values in found["events/pictures"] if at == last)
        shown = np.zeros(rec.event_shape, np.uint8)
        for event in here:
            shown[event["y"], event["x"]] = 1 if event["polarity"] > 0 else 2
        np.testing.assert_array_equal(buffer(picture, "u1", rec.event_shape), shown)
    assert not list(tmp_path.glob(".r.*"))


def test_pictures_that_cost_too_much_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(live_view, "_SHARE", 0.0)
    monkeypatch.setattr(rerun_view, "can_show", lambda: False)
    recordings.make("davis346", tmp_path / "r", frames=3, duration_us=57_000, width=24, height=20, live=True)
    found = read(tmp_path / "r" / "live.rrd")
    assert len(found["camera/colour"]) == 1 and "events/pictures" not in found  # the first frame alone
    assert [at for at, _ in found["events/rate"] if at is not None] == [*range(10_000, 60_000, 10_000), 57_000]


def test_a_live_view_needs_a_place_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_view, "can_show", lambda: False)
    sensor = recordings.sensor_like("davis346", width=16, height=12)
    with pytest.raises(RangeError, match=r"live is True; expected a run with a folder \(out\)"):
        RecordingWriter(None, sensor, seed=7, duration_us=1000, live=True)
    with pytest.raises(ZeroDivisionError), RecordingWriter(tmp_path / "r", sensor, seed=7, duration_us=9, live=True):
        1 / 0  # noqa: B018
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SpecError, match=r"^the viewer needs rerun"):
        RecordingWriter(tmp_path / "r", sensor, seed=7, duration_us=9, live=True)
    assert not list(tmp_path.iterdir())


def test_the_command_says_where_the_live_view_is(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_view, "can_show", lambda: False)
    np.save(tmp_path / "v.npy", np.linspace(0, 250, 3 * 24 * 32).astype(np.uint8).reshape(3, 24, 32))
    keys = ("fps=200", "transfer=srgb", "white_lux=500")
    given = [
        "simulate",
        tmp_path / "v.npy",
        "--sensor",
        "davis346",
        "--roi",
        "30x22",
        "--live",
        "--out",
        tmp_path / "o",
    ]
    status, text, _ = call(capsys, *given, *(word for key in keys for word in ("--set", key)))
    assert status == 0 and re.search(r"live view: rerun \S+/\.o\.\S+\.partial/live\.rrd\n", text)
    assert read(tmp_path / "o" / "live.rrd")["events/rate"]

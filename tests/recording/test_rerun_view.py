"""The file for rerun, read back by rerun's own reader: times, DN, events and poses are those of the recording.

rerun has 170 MB and is not part of the test extra; tried with rerun-sdk 0.41.
"""

import numpy as np
import pytest
import recordings

import hesim_render as hr
from hesim_render.cli import main
from hesim_render.recording import rerun_view

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

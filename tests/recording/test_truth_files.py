"""Truth in recordings: what is stored, what is computed again, and the formats of others."""

import json
import struct
import tracemalloc
import zlib

import cv2
import h5py
import numpy as np
import OpenEXR
import pytest
import rendering
from ruamel.yaml import YAML

import hesim_render as hr
from hesim_render.capture.simulate import simulate
from hesim_render.core.errors import OutputError, RangeError, SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE, EventLabels, LabelBlock
from hesim_render.recording.camera_files import write_kalibr_aprilgrid, write_kalibr_camchain, write_opencv_camera
from hesim_render.recording.label_file import LabelFileWriter, read_labels
from hesim_render.recording.truth_export import dsec_flow_image, export_truth, tum_lines
from hesim_render.recording.truth_file import TRUTH_KINDS, StoredTruth, TruthRequest, truth_kinds, write_truth
from hesim_render.sources.render.truth.scene_truth import SceneTruth

GEOMETRY = TRUTH_KINDS[:-1]


def moving_scene():
    card = {"name": "card", "shape": "rectangle", "size_m": [0.3, 0.2, 0], "position_m": [0, 0, 0.1]}
    wall = {"name": "wall", "shape": "rectangle", "size_m": [9, 9, 0]}
    track = [{"t_us": 0}, {"t_us": 60_000, "translation_m": [0.1, 0.05, 0], "rotation_deg": 30}]
    camera = [{"t_us": 0}, {"t_us": 60_000, "translation_m": [0.0, 0.02, -0.1]}]
    return rendering.make_scene(
        objects=[card, wall], light=rendering.D65_1000_LUX,
        motion=[{"object": "card", "keyframes": track}, {"object": "camera", "keyframes": camera}],
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 14},
    )  # fmt: skip


def sensor():
    rolling = {"aps.shutter": "rolling", "aps.line_time_us": 50.0, "aps.exposure_us": 2000}
    return hr.load_sensor("reference-mono", rolling).crop(32, 24)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    out = tmp_path_factory.mktemp("truth") / "rec"
    return simulate(moving_scene(), sensor(), duration_s=0.06, samples=2, out=out, truth=GEOMETRY)


def test_what_is_stored_is_what_is_computed_at_the_middle_of_each_rows_exposure(recorded):
    stored, truth = recorded.stored_truth, recorded.truth
    assert stored.kinds == GEOMETRY and len(recorded.frames) >= 2
    rows = np.arange(24) * 50.0
    for number, frame in enumerate(recorded.frames):
        np.testing.assert_array_equal(frame.row_times_us, frame.t_us - 1000 + rows)
        np.testing.assert_array_equal(stored.read("frames/row_time_us", number), frame.row_times_us)
        for name, values in (
            ("depth_m", truth.depth(frame)), ("distance_m", truth.distance(frame)), ("normal", truth.normals(frame)),
            ("position_m", truth.position(frame)), ("mixed", truth.mixed(frame)), ("object", truth.ids(frame).object),
            ("boxes_visible_px", truth.boxes(frame).visible_px),
        ):  # fmt: skip
            np.testing.assert_array_equal(stored.read(f"frames/{name}", number), values)
    first, second = recorded.frames[:2]
    for name, flow, number in (
        ("forward", truth.flow(first, second), 0), ("backward", truth.flow(second, first), 1),
    ):  # fmt: skip
        np.testing.assert_array_equal(stored.read(f"frames/flow_{name}_px", number), flow.flow_px)
        np.testing.assert_array_equal(stored.read(f"frames/visible_{name}", number), flow.visible)
    assert np.isnan(stored.read("frames/flow_forward_px", len(recorded.frames) - 1)).all()
    assert np.isnan(stored.read("frames/flow_backward_px", 0)).all()
    assert list(stored.read("names/objects")) == ["background", "card", "wall"]
    times = stored.read("events/time_us")
    np.testing.assert_allclose(times, [frame.row_times_us.mean() for frame in recorded.frames])
    np.testing.assert_array_equal(stored.read("events/depth_m", 1), truth.depth(times[1], "events"))
    np.testing.assert_array_equal(stored.read("camera/mosaic"), truth.camera().k)
    times = stored.read("poses/time_us")
    np.testing.assert_array_equal(stored.read("poses/camera"), truth.camera_pose(times))
    np.testing.assert_array_equal(stored.read("poses/objects")[:, 0], truth.object_poses(times)["card"])
    np.testing.assert_array_equal(stored.read("imu/gyro_rad_per_s"), truth.imu(0, 60_000, seed=7).gyro_rad_per_s)
    assert stored.read("light/level").shape == (61, 1) and list(stored.read("light/units")) == ["lx"]


def test_a_loaded_recording_knows_its_scene(recorded):
    """The manifest holds the scene; nothing else does after loading."""
    loaded = hr.Recording.load(recorded.path)
    np.testing.assert_array_equal(loaded.truth.depth(3_000.0), hr.SceneTruth(moving_scene(), sensor()).depth(3_000.0))
    np.testing.assert_array_equal(loaded.truth_with(moving_scene()).depth(0), loaded.truth.depth(0))
    with pytest.raises(SpecError, match="is not the one of the recording"):
        loaded.truth_with(hr.load_scene("flat-field"))


@pytest.mark.slow
def test_a_recording_in_memory_saves_the_truth_that_was_asked_for(recorded, tmp_path):
    kept = simulate(moving_scene(), sensor(), duration_s=0.06, samples=2, truth=["all"])
    assert kept.stored_truth is None
    saved = hr.Recording.load(kept.save(tmp_path / "again"))
    twice = hr.Recording.load(saved.save(tmp_path / "twice"))
    for name in recorded.stored_truth.names:
        for other in (saved, twice):
            np.testing.assert_array_equal(other.stored_truth.read(name), recorded.stored_truth.read(name))


def test_nothing_is_written_that_was_not_asked_for(tmp_path):
    found = simulate(
        moving_scene(), sensor(), duration_s=0.03, samples=2, out=tmp_path / "r", truth=["depth"], truth_every_us=5_000
    )
    assert {name.split("/")[1] for name in found.stored_truth.names if name.startswith("frames")} == {
        "row_time_us", "depth_m", "distance_m",
    }  # fmt: skip
    np.testing.assert_array_equal(found.stored_truth.read("events/time_us"), np.arange(0, 30_001, 5_000))
    none = simulate(moving_scene(), sensor(), duration_s=0.03, samples=2, out=tmp_path / "none")
    assert none.stored_truth is None and "truth" not in none.manifest["settings"]


def test_a_run_shorter_than_an_inertial_sample_and_a_lamp_of_a_long_name(tmp_path):
    name = "größte " * 20
    glow = {"name": name, "shape": "rectangle", "size_m": [0.3, 0.2, 0], "emission": {"luminance_cd_m2": 30}}
    scene = rendering.make_scene(
        objects=[glow], light={"type": "none"}, camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0]}
    )
    request = TruthRequest(("imu", "light"), 900, np.empty((0, 24)), None, 3)
    write_truth(tmp_path / "t.h5", SceneTruth(scene, sensor()), request)
    stored = StoredTruth(tmp_path / "t.h5")
    assert stored.read("light/names").tolist() == [f"objects.{name}"]
    assert stored.read("imu/time_us").shape == (0,) and stored.read("imu/gyro_rad_per_s").shape == (0, 3)


def test_kinds_and_intervals_that_are_none_are_refused_before_rendering():
    assert truth_kinds(["flow", "depth"]) == truth_kinds("flow, depth") == ("depth", "flow")
    with pytest.raises(RangeError, match=r"truth is 'deepth'; expected one of depth, .* \(did you mean 'depth'"):
        simulate(moving_scene(), sensor(), duration_s=0.03, truth=["deepth"])
    with pytest.raises(RangeError, match="truth_every_us"):
        simulate(moving_scene(), sensor(), duration_s=0.03, truth=["depth"], truth_every_us=40_000)


def test_scenes_that_cannot_be_made_again_say_why(tmp_path):
    video = hr.Recording.load(simulate(moving_scene(), sensor(), duration_s=0.002, samples=2, out=tmp_path / "v").path)
    video.manifest["scene"] = None
    with pytest.raises(SpecError, match="made from a video, which has no geometry"):
        _ = video.truth
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    (tmp_path / "scenes" / "mesh.yaml").write_text(
        "schema_version: 1\nname: mesh\ndescription: one triangle\n"
        "objects: [{name: thing, shape: mesh, mesh: a.ply, size_m: [1, 1, 0]}]\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {origin_m: [0, 0, 2], target_m: [0, 0, 0]}\n"
    )
    scene = hr.load_scene(tmp_path / "scenes" / "mesh.yaml")
    made = simulate(scene, sensor(), duration_s=0.005, samples=2, out=tmp_path / "rec")
    assert np.isfinite(made.truth.depth(0)).any()  # the run knows where its files are
    loaded = hr.Recording.load(made.path)
    with pytest.raises(SpecError, match=r"needs files that are not in the recording \(a.ply\): give the scene"):
        _ = loaded.truth
    np.testing.assert_array_equal(loaded.truth_with(scene).depth(0), made.truth.depth(0))


def test_a_damaged_file_is_one_error(recorded, tmp_path):
    copy = hr.Recording.load(hr.Recording.load(recorded.path).save(tmp_path / "copy"))
    file = copy.path / "truth" / "geometry.h5"
    with pytest.raises(RangeError, match="did you mean 'frames/depth_m'"):
        copy.stored_truth.read("frames/depth_n")
    with pytest.raises(RangeError, match="number is 99; expected 0 to"):
        copy.stored_truth.read("frames/depth_m", 99)
    with h5py.File(file, "r+") as opened:
        opened["frames/elsewhere"] = h5py.ExternalLink("/etc/hostname", "x")
        opened.attrs["layout"] = 2
    with pytest.raises(SpecError, match=r"geometry.h5: layout is .*2.*; this version reads 1"):
        _ = hr.Recording.load(copy.path).stored_truth
    file.write_bytes(file.read_bytes()[:3000])
    with pytest.raises(SpecError, match=r"geometry.h5: cannot be read as truth"):
        _ = hr.Recording.load(copy.path).stored_truth


# ---- labels of events ----------------------------------------------------------------------------------------------


def test_labels_of_a_recording_are_kept_saved_and_checked(tmp_path):
    run = {"duration_s": 0.03, "samples": 2, "seed": 3}
    plain = simulate(moving_scene(), sensor(), **run)
    kept = simulate(moving_scene(), sensor(), truth=["events"], **run)
    stored = simulate(moving_scene(), sensor(), truth=["events"], out=tmp_path / "stored", **run)
    clean = simulate(moving_scene(), sensor(), clean=True, **run)
    again = hr.Recording.load(kept.save(tmp_path / "again"))
    assert plain.event_labels is None and stored.stored_truth is None
    for other in (kept, stored, again):
        np.testing.assert_array_equal(other.events, plain.events)
        labels = other.event_labels
        np.testing.assert_array_equal(labels.label, kept.event_labels.label)
        np.testing.assert_array_equal(labels.clean, clean.events)
        np.testing.assert_array_equal(labels.lost, kept.event_labels.lost)
        assert labels.counts()["signal"] > 20 and labels.label.size == plain.events.size
    file = again.path / "truth" / "event_labels.h5"
    with h5py.File(file, "r+") as opened:
        values = opened["label"][:]
        del opened["label"]
        opened["label"] = values[:-1]
    with pytest.raises(SpecError, match=rf"event_labels.h5: holds {values.size - 1} labels; the recording has"):
        _ = hr.Recording.load(again.path).event_labels
    with h5py.File(file, "r+") as opened:
        del opened["label"]
        opened["label"] = np.full(values.size, 9, np.uint8)
    with pytest.raises(SpecError, match="label holds 9; expected 0 to 4"):
        _ = hr.Recording.load(again.path).event_labels


def label_blocks(count, size, seed=2):
    """Blocks of a run, which change labels of earlier ones all over the run."""
    rng, t_us = np.random.default_rng(seed), 0
    for number in range(count):
        events = np.zeros(size // 4, EVENT_DTYPE)
        events["t_us"], events["x"], events["polarity"] = t_us + np.arange(events.size), 3, 1
        changed = rng.integers(0, (number + 1) * size, 50)
        yield LabelBlock(
            rng.integers(0, 5, size).astype(np.uint8), changed, rng.integers(0, 5, 50).astype(np.uint8),
            events, rng.integers(0, 2, events.size).astype(np.uint8), events,
        )  # fmt: skip
        t_us += size


def written_labels(folder, blocks):
    (folder / "truth").mkdir(parents=True)
    writer = LabelFileWriter(folder, (8, 8), 0, 10**9)
    for block in blocks:
        writer.append(block)
    writer.close()
    return folder


def test_the_first_and_the_last_label_are_changed_where_they_lie(tmp_path):
    whole = EventLabels.of(list(label_blocks(70, 901))).as_block()
    (tmp_path / "truth").mkdir()
    writer = LabelFileWriter(tmp_path, (8, 8), 0, 10**9)
    writer.append(whole)
    wanted = np.array(whole.label)
    wanted[[0, 5, -1]] = 4, 2, 3
    writer._change(np.array([wanted.size - 1, 0, 5]), np.array([3, 4, 2], np.uint8))
    writer._label.seek(0)
    np.testing.assert_array_equal(np.frombuffer(writer._label.read(), np.uint8), wanted)
    writer.abandon()


def test_labels_written_block_by_block_are_those_written_at_once(tmp_path):
    blocks = list(label_blocks(70, 9_001))
    whole = EventLabels.of(blocks)
    streamed = written_labels(tmp_path / "a", blocks)
    at_once = written_labels(tmp_path / "b", [whole.as_block()])
    assert (streamed / "truth/event_labels.h5").read_bytes() == (at_once / "truth/event_labels.h5").read_bytes()
    assert sorted(path.name for path in (streamed / "truth").iterdir()) == ["clean_events.h5", "event_labels.h5"]
    found = read_labels(streamed, (8, 8), 70 * 9_001)
    for name in ("label", "lost", "lost_in", "clean"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    # the last change of each event holds
    last = dict(zip(blocks[-1].changed.tolist(), blocks[-1].changed_to.tolist(), strict=True))
    assert all(found.label[event] == label for event, label in last.items()) and len(last) > 40


def test_writing_labels_takes_memory_for_one_chunk(tmp_path):
    """4 M events and 1 M lost ones, 38 MB in all."""
    most = []
    for count in (15, 60):
        tracemalloc.start()
        written_labels(tmp_path / str(count), label_blocks(count, 1 << 16))
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] < most[0] + 1e6 and most[1] < 25e6


# ---- formats of others ---------------------------------------------------------------------------------------------


def read_png16(path):
    """16-bit PNG by the file's own rules, without a library of images."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, packed, size = 8, b"", None
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        body = data[place + 8 : place + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", body[:10])
            assert (depth, colour) == (16, 2)
            size = height, width
        packed += body if kind == b"IDAT" else b""
        place += 12 + length
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(size[0], 1 + 6 * size[1])
    out = np.zeros((size[0], 6 * size[1]), np.uint8)
    for number, (kind, row) in enumerate(zip(rows[:, 0], rows[:, 1:].astype(int), strict=True)):
        above = out[number - 1].astype(int) if number else np.zeros_like(row)
        line = np.zeros_like(row)
        for k in range(row.size):
            left, corner = (line[k - 6], above[k - 6]) if k >= 6 else (0, 0)
            guess = left + above[k] - corner
            nearest = min((left, above[k], corner), key=lambda v, guess=guess: abs(guess - v))
            line[k] = (row[k] + (0, left, above[k], (left + above[k]) // 2, nearest)[kind]) % 256
        out[number] = line
    return out.view(">u2").reshape(*size, 3).astype(int)


def test_flow_in_the_encoding_of_dsec(recorded, tmp_path):
    folder = export_truth(recorded, "dsec-flow", tmp_path / "flow", every_us=20_000)
    lines = (folder / "forward_timestamps.txt").read_text().splitlines()
    assert [tuple(map(int, line.split(","))) for line in lines[1:]] == [(0, 20_000), (20_000, 40_000), (40_000, 60_000)]
    flow = recorded.truth.flow(20_000.0, 40_000.0, "events").flow_px
    image = read_png16(folder / "forward" / "000001.png")
    assert image.shape == (24, 32, 3) and (image[..., 2] == 1).all()
    decoded = (image[..., :2] - 2**15) / 128  # as DSEC's own reader does it
    assert np.abs(decoded - flow).max() <= 0.5 / 128 + 1e-6 and np.abs(flow).max() > 1
    assert json.loads((folder / "export.json").read_text())["every_us"] == 20_000


def test_flow_that_the_encoding_cannot_hold_is_not_valid():
    flow = np.array([[[np.nan, 0], [255.99, -256.0], [256.0, 0], [-3.5, 0.01]]], np.float32)
    image = dsec_flow_image(flow)
    assert image[0, :, 2].tolist() == [0, 1, 0, 1]
    assert image[0, 0].tolist() == [0, 0, 0] and image[0, 1].tolist() == [65535, 0, 1]
    assert image[0, 3].tolist() == [2**15 - 448, 2**15 + 1, 1]


def test_exr_images_have_named_channels(recorded, tmp_path):
    folder = export_truth(recorded, "exr", tmp_path / "exr")
    truth, frame = recorded.truth, recorded.frames[1]
    with OpenEXR.File(str(folder / "000001.exr"), separate_channels=True) as file:
        found = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    np.testing.assert_array_equal(found["Z"], truth.depth(frame))
    np.testing.assert_array_equal(found["normal.Y"], truth.normals(frame)[..., 1])
    np.testing.assert_array_equal(found["backward.v"], truth.flow(frame, recorded.frames[0]).flow_px[..., 1])
    np.testing.assert_array_equal(found["instance"], truth.ids(frame).instance)
    assert found["instance"].dtype == np.uint32
    told = json.loads((folder / "export.json").read_text())
    assert (
        told["names"]["objects"] == ["background", "card", "wall"] and told["camera"]["k"] == truth.camera().k.tolist()
    )


def test_trajectories_of_tum(recorded, tmp_path):
    folder = export_truth(recorded, "tum", tmp_path / "tum", every_us=10_000)
    rows = np.loadtxt(folder / "object_001.txt")
    np.testing.assert_allclose(rows[:, 0], np.arange(0, 0.0601, 0.01))
    share = rows[:, 0] / 0.06
    np.testing.assert_allclose(rows[:, 1:4], share[:, None] * [0.1, 0.05, 0], atol=1e-9)
    half = np.radians(15) * share  # 30° about z: (0, 0, sin θ/2, cos θ/2)
    np.testing.assert_allclose(
        rows[:, 4:], np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1), atol=1e-8
    )
    # the camera's axes: half a turn about x from y up and −z forward
    camera = np.loadtxt(folder / "camera.txt")
    np.testing.assert_allclose(np.abs(camera[0, 4:]), [1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(camera[-1, 1:4], [0, 0.02, 1.9], atol=1e-9)
    assert tum_lines(np.array([1.5e6]), np.eye(4)[None]) == ["1.500000 0 0 0 0 0 0 1"]
    with pytest.raises(SpecError, match="to_world mirrors its picture"):
        tum_lines(np.array([1.5e6]), np.diag([-1.0, 1, 1, 1])[None])


def test_calibration_of_kalibr(recorded, tmp_path):
    folder = export_truth(recorded, "kalibr", tmp_path / "kalibr")
    chain = YAML(typ="safe").load(folder / "camchain.yaml")
    k = recorded.truth.camera().k
    assert list(chain) == ["cam0", "cam1"]
    assert chain["cam0"]["intrinsics"] == [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    assert chain["cam0"]["resolution"] == [32, 24] and chain["cam0"]["camera_model"] == "pinhole"
    assert chain["cam0"]["distortion_model"] == "radtan" and len(chain["cam0"]["distortion_coeffs"]) == 4
    np.testing.assert_array_equal(chain["cam1"]["T_cn_cnm1"], np.eye(4))
    assert YAML(typ="safe").load(folder / "imu.yaml")["update_rate"] == 1000.0
    grid = YAML(typ="safe").load(write_kalibr_aprilgrid(tmp_path / "grid.yaml", 6, 5, 0.03, 0.3))
    assert grid == {"target_type": "aprilgrid", "tagCols": 6, "tagRows": 5, "tagSize": 0.03, "tagSpacing": 0.3}
    with pytest.raises(RangeError, match="tagSize"):
        write_kalibr_aprilgrid(tmp_path / "grid.yaml", 6, 5, 0.0, 0.3)


def test_cameras_of_opencv(recorded, tmp_path):
    folder = export_truth(recorded, "opencv", tmp_path / "opencv")
    for grid in ("mosaic", "events"):
        camera = recorded.truth.camera(grid)
        storage = cv2.FileStorage(str(folder / f"camera_{grid}.yaml"), cv2.FileStorage_READ)
        np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), camera.k)
        np.testing.assert_array_equal(storage.getNode("distortion_coefficients").mat(), np.zeros((1, 5)))
        assert storage.getNode("image_width").real() == camera.width
    assert storage.getNode("distortion_model").string() == "none"


@pytest.mark.slow
def test_cameras_with_distortion_in_both_formats(tmp_path):
    def truth(model):
        scene = rendering.make_scene(light=rendering.FURNACE, camera={"origin_m": [0, 0, 1]}, objects=[
            {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0]}])  # fmt: skip
        return SceneTruth(scene, hr.load_sensor("eiger", {"lens.distortion": model}))

    radial = truth({"model": "opencv", "k1": -0.2, "k2": 0.03, "p1": 1e-3, "p2": 2e-3})
    wide = truth({"model": "fisheye", "k1": -0.02, "k2": 0.003, "k3": 4e-4, "k4": -5e-5})
    chain = YAML(typ="safe").load(write_kalibr_camchain(tmp_path / "chain.yaml", [radial, wide], ["mosaic", "events"]))
    assert chain["cam0"]["distortion_model"] == "radtan"
    assert chain["cam0"]["distortion_coeffs"] == [-0.2, 0.03, 1e-3, 2e-3]
    assert chain["cam1"]["distortion_model"] == "equidistant"
    assert chain["cam1"]["distortion_coeffs"] == [-0.02, 0.003, 4e-4, -5e-5]
    k = wide.camera("events").k
    assert chain["cam1"]["intrinsics"] == [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    rational = truth({"model": "opencv", "k1": 0.1, "p2": 2e-3, "k4": 0.2})
    file = write_opencv_camera(tmp_path / "camera.yaml", rational.camera())
    storage = cv2.FileStorage(str(file), cv2.FileStorage_READ)
    found = storage.getNode("distortion_coefficients").mat()
    np.testing.assert_array_equal(found, [[0.1, 0, 0, 2e-3, 0, 0.2, 0, 0]])
    # both programs put a point where the truth has it
    point = np.array([0.11, 0.07, 0.1])
    local = np.linalg.inv(rational.camera_pose(0.0)) @ [*point, 1]
    there, _ = cv2.projectPoints(local[:3], np.zeros(3), np.zeros(3), rational.camera().k, found)
    np.testing.assert_allclose(there.ravel(), rational.project(point, 0.0), atol=1e-6)
    with pytest.raises(SpecError, match="radtan has k1, k2, p1 and p2 only"):
        write_kalibr_camchain(tmp_path / "none.yaml", [rational], ["mosaic"])
    assert not (tmp_path / "none.yaml").exists()


def test_exports_that_cannot_be_made_leave_nothing(recorded, tmp_path):
    with pytest.raises(RangeError, match="did you mean 'kalibr'"):
        export_truth(recorded, "kalibre", tmp_path / "x")
    with pytest.raises(RangeError, match="exr has none"):
        export_truth(recorded, "exr", tmp_path / "x", every_us=5)
    with pytest.raises(RangeError, match="1 to 60000 µs"):
        export_truth(recorded, "tum", tmp_path / "x", every_us=60_001)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    with pytest.raises(OutputError, match="holds other things"):
        export_truth(recorded, "tum", tmp_path / "full")
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


def test_files_are_the_same_if_somebody_holds_on_to_their_data_sets(recorded, tmp_path, monkeypatch):
    """A profiler that samples the stack does. HDF5 places a chunk when the last reference to its data set goes."""
    held, plain = [], h5py.Group.__getitem__

    def held_item(group, name):
        held.append(plain(group, name))
        return held[-1]

    monkeypatch.setattr(h5py.Group, "__getitem__", held_item)
    simulate(moving_scene(), sensor(), duration_s=0.06, samples=2, out=tmp_path / "r", truth=GEOMETRY)
    for name in ("truth/geometry.h5", "events.h5"):
        assert (tmp_path / "r" / name).read_bytes() == (recorded.path / name).read_bytes(), name
    assert len(held) > 20

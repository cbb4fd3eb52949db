"""Recording folders: what is written is what is read, by us and by others; all of it or nothing."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import rawpy
import recordings
import tifffile

import hesim_render as hr
from hesim_render.core.errors import OutputError, SpecError
from hesim_render.mosaic.description import describe
from hesim_render.pixels.evs.events import EVENT_DTYPE
from hesim_render.recording import manifest as manifests
from hesim_render.recording.recording import Recording
from hesim_render.recording.showcase import binned
from hesim_render.recording.writer import RecordingWriter
from hesim_render.specs import SensorSpec, read_scene
from hesim_render.spectral.spectrum import illuminant

ROOT = Path(__file__).parents[2]
SENSORS = ("eiger", "gen2", "mipi-hybridevs", "davis346", "reference-mono", "reference-bayer")
LINEAR_RAW, CFA = 34892, 32803


def assert_same(one, other):
    assert len(one.frames) == len(other.frames)
    for a, b in zip(one.frames, other.frames, strict=True):
        for name in ("raw", "valid", "electrons_mean", "electrons_stderr"):
            left, right = getattr(a, name), getattr(b, name)
            assert left.dtype == right.dtype
            np.testing.assert_array_equal(left, right)
        assert a.times == b.times
    assert one.events.dtype == other.events.dtype == EVENT_DTYPE
    np.testing.assert_array_equal(one.events, other.events)
    assert (one.event_truth is None) == (other.event_truth is None)
    if one.event_truth is not None:
        np.testing.assert_array_equal(one.event_truth.flux_mean_e_per_s, other.event_truth.flux_mean_e_per_s)
        np.testing.assert_array_equal(one.event_truth.flux_stderr_e_per_s, other.event_truth.flux_stderr_e_per_s)


@pytest.mark.parametrize("name", SENSORS)
def test_memory_save_and_load_agree(name, tmp_path):
    made = recordings.make(name)
    loaded = Recording.load(made.save(tmp_path / "r"))
    assert_same(made, loaded)
    assert loaded.manifest["counts"] == made.manifest["counts"]
    assert loaded.mosaic == made.mosaic
    assert (tmp_path / "r" / "preview.png").stat().st_size > 1000


def test_streamed_and_saved_folders_are_the_same_bytes(tmp_path):
    recordings.make("gen2", tmp_path / "streamed")
    recordings.make("gen2").save(tmp_path / "saved")
    names = sorted(p.relative_to(tmp_path / "saved") for p in (tmp_path / "saved").rglob("*") if p.is_file())
    assert Path("frames/000001.dng") in names and Path("truth/events.npz") in names
    for name in names:
        # HDF5 stores no time stamps here, so even that file is equal
        assert (tmp_path / "streamed" / name).read_bytes() == (tmp_path / "saved" / name).read_bytes(), name


def test_writer_in_memory_and_on_disk_agree(tmp_path):
    assert_same(recordings.make("eiger"), recordings.make("eiger", tmp_path / "r"))


def test_stored_frames_are_read_one_at_a_time(tmp_path):
    recording = recordings.make("eiger", tmp_path / "r", frames=3)
    assert recording.frames[0] is not recording.frames[0]
    assert [frame.index for frame in recording.frames] == [0, 1, 2]
    assert [frame.index for frame in recording.frames[1:]] == [1, 2]
    assert recording.frames[-1].index == 2
    with pytest.raises(IndexError):
        recording.frames[3]


@pytest.mark.parametrize("name", SENSORS)
def test_dng_is_exact_through_rawpy_and_tifffile(name, tmp_path):
    made = recordings.make(name, frames=1)
    path = made.save(tmp_path / "r") / "frames" / "000000.dng"
    expected = made.frames[0].raw
    np.testing.assert_array_equal(tifffile.imread(path), expected)
    with rawpy.imread(str(path)) as raw:
        np.testing.assert_array_equal(raw.raw_image, expected)
        assert set(raw.black_level_per_channel) == {made.mosaic.black_level_dn}
        assert raw.white_level == made.mosaic.white_level_dn
        assert raw.extract_thumb().format == rawpy.ThumbFormat.BITMAP


def test_dng_holds_the_true_colour_pattern(tmp_path):
    made = recordings.make("gen2", frames=1)
    with tifffile.TiffFile(made.save(tmp_path / "r") / "frames" / "000000.dng") as file:
        tags = file.pages[0].tags
        assert tags[262].value == CFA
        assert tuple(tags[33421].value) == (4, 4)
        red, green, blue, white = 0, 1, 2, 6
        row = [red, red, green, green, red, red, white, green, green, green, blue, blue, green, green, blue, blue]
        assert list(tags[33422].value) == row
        assert list(tags[50710].value) == [red, green, blue, white]
        assert tags[50706].value == bytes((1, 4, 0, 0)) or tuple(tags[50706].value) == (1, 4, 0, 0)
        assert json.loads(tags[270].value)["t_us"] == made.frames[0].t_us
        exposure = tags[34665].value["ExposureTime"]
        assert exposure[0] / exposure[1] == pytest.approx(0.01)
        assert file.pages[1].subfiletype == 1


def test_mono_dng_is_linear_raw(tmp_path):
    path = recordings.make("reference-mono", frames=1).save(tmp_path / "r") / "frames" / "000000.dng"
    with tifffile.TiffFile(path) as file:
        assert file.pages[0].tags[262].value == LINEAR_RAW
        assert 33422 not in file.pages[0].tags


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
@pytest.mark.parametrize("name", ["eiger", "gen2", "reference-bayer", "reference-mono"])
def test_exiftool_reads_dng_without_an_error(name, tmp_path):
    folder = recordings.make(name, frames=1).save(tmp_path / "r")
    files = [folder / "frames" / "000000.dng", *folder.glob("preview.dng")]
    done = subprocess.run(
        ["exiftool", "-j", "-error", "-FileType", "-ExposureTime", *files], capture_output=True, text=True, check=True
    )
    for found in json.loads(done.stdout):
        assert found["FileType"] == "DNG" and found["ExposureTime"] == "1/100" and "Error" not in found


def test_preview_dng_is_the_binned_quad(tmp_path):
    made = recordings.make("eiger", frames=1)
    folder = made.save(tmp_path / "r")
    frame = made.frames[0]
    with rawpy.imread(str(folder / "preview.dng")) as raw:
        found = raw.raw_image.copy()
        assert raw.raw_pattern.tolist() in ([[0, 1], [3, 2]], [[0, 1], [1, 2]])
    # written out again: a 2×2 cell holds one colour, event pixels do not count
    cells = frame.raw.astype(float).reshape(48, 2, 64, 2).transpose(0, 2, 1, 3).reshape(48, 64, 4)
    valid = frame.valid.reshape(48, 2, 64, 2).transpose(0, 2, 1, 3).reshape(48, 64, 4)
    expected = np.rint(np.where(valid, cells, 0).sum(-1) / valid.sum(-1))
    np.testing.assert_array_equal(found, expected)
    # a mean of three pixels, as one of four is an event pixel, has a third of the noise; the pitch is twice as large
    own, smaller = made.mosaic, binned(frame.raw, made.mosaic)[1]
    assert smaller.noise_profile == pytest.approx(np.array(own.noise_profile) / 3, rel=1e-12)
    assert smaller.pitch_um == 2 * own.pitch_um
    assert binned(frame.raw, recordings.make("reference-bayer", frames=0).mosaic) is None


def test_cells_of_a_tile_are_binned_wherever_their_event_pixels_are():
    """A tile of 2 rows and 6 columns; the first pixel of one cell, and two of another, have no value."""
    tile = {"tile": "e R G G B e\nR R G G e B", "evs_grid": {"rows_per_tile": 1, "cols_per_tile": 3}}
    mosaic = describe(hr.load_sensor("mipi-hybridevs", tile | {"geometry.rows": 20, "geometry.cols": 60}))
    mosaic = mosaic.model_copy(update={"noise_profile": (2e-4, 3e-6)})
    raw = np.random.default_rng(2).integers(100, 900, (20, 60), np.uint16)
    found, smaller = binned(raw, mosaic)
    assert [[mosaic.channels.index(name) for name in row] for row in smaller.tile_filter] == [[0, 1, 2]]
    one = raw.reshape(10, 2, 10, 6).astype(float)
    red, blue = one[:, [0, 1, 1], :, [1, 0, 1]].mean(axis=0), one[:, [0, 1], :, [4, 5]].mean(axis=0)
    expected = np.stack([red, one[..., 2:4].mean(axis=(1, 3)), blue], axis=-1)
    np.testing.assert_array_equal(found, np.rint(expected).reshape(10, 30))
    shares = (1 / 3 + 1 / 4 + 1 / 2) / 3
    assert smaller.noise_profile == pytest.approx(np.array([2e-4, 3e-6]) * shares, rel=1e-12)


@pytest.mark.parametrize("block", [1, 977, 70_000])
def test_events_file_has_the_layout_of_dsec(block, tmp_path):
    sensor = recordings.sensor_like("eiger")
    events = recordings.events_of(sensor, 90_500, count=70_000 if block > 1 else 300)
    with RecordingWriter(tmp_path / "r", sensor, seed=1, duration_us=90_500) as writer:
        for first in range(0, events.size, block):
            writer.add_events(events[first : first + block])
        recording = writer.finish()
    with h5py.File(tmp_path / "r" / "events.h5") as file:
        assert {name: file["events"][name].dtype.str for name in "txyp"} == {
            "t": "<u4", "x": "<u2", "y": "<u2", "p": "|u1"
        }  # fmt: skip
        t, ms_to_idx = file["events/t"][:], file["ms_to_idx"][:]
        assert "32001" in file["events/t"]._filters  # Blosc
        assert file["events/t"].maxshape == (None,)
        assert int(file["t_offset"][()]) == 0
        assert (file.attrs["width"], file.attrs["height"]) == (64, 48)
        np.testing.assert_array_equal(file["events/p"][:], events["polarity"] > 0)
    # ms_to_idx[k] is the first event at or after k ms, up to and beyond the end
    assert ms_to_idx.size == 92
    np.testing.assert_array_equal(ms_to_idx, np.searchsorted(t, np.arange(92) * 1000))
    np.testing.assert_array_equal(recording.events, events)


def test_event_slice_is_the_part_asked_for(tmp_path):
    recording = recordings.make("eiger", tmp_path / "r")
    everything = recordings.events_of(recordings.sensor_like("eiger"), 250_000)
    whole = ((0, 1), (999, 1000), (1000, 1001), (12_345, 54_321), (249_000, 250_001), (0, 10**9), (5, 5), (-9, -3))
    # the interval does not begin and end with whole µs
    broken = ((999.5, 1000.5), (12_345.0, 5.4321e4), (-2.5, float("inf")), (249_999.5, 1e12), (np.float32(700), 900))
    for begin, end in (*whole, *broken):
        part = Recording.load(tmp_path / "r").event_slice(begin, end)
        wanted = everything[(everything["t_us"] >= begin) & (everything["t_us"] < end)]
        np.testing.assert_array_equal(part, wanted)
        np.testing.assert_array_equal(recordings.make("eiger").event_slice(begin, end), wanted)
    assert everything.size == recording.manifest["counts"]["events"]


def test_events_out_of_order_are_refused(tmp_path):
    sensor = recordings.sensor_like("eiger")
    events = recordings.events_of(sensor, 1000, count=10)
    with (
        pytest.raises(ValueError, match="order of time"),
        RecordingWriter(tmp_path / "r", sensor, seed=1, duration_us=1000) as writer,
    ):
        writer.add_events(events[::-1])
    assert list(tmp_path.iterdir()) == []


def test_manifest_says_what_made_the_recording(tmp_path):
    scene = read_scene("colorchecker")
    recording = recordings.make("eiger", tmp_path / "r", scene=scene, settings={"clean": False, "samples": 16})
    text = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert text == recording.manifest
    assert text["schema_version"] == 1 and text["seed"] == 7 and text["settings"]["samples"] == 16
    assert text["roi"] == {"x": 1568, "y": 1176, "width_px": 128, "height_px": 96}
    assert set(text["software"]) >= {"hesim_render", "mitsuba", "drjit", "numpy"}
    assert text["counts"] == {
        "frames": 2,
        "events": 20_000,
        **{k: text["counts"][k] for k in ("events_on", "events_off")},
        "events_dropped": 0,
    }
    assert text["counts"]["events_on"] == int((recording.events["polarity"] > 0).sum())
    for part in ("sensor", "scene"):
        assert len(text[part]["sha256"]) == 64 and text[part]["spec"]["name"]
    for name in ("t_us", "electrons_mean", "exposure_us", "line_time_us", "raw", "x", "y", "polarity"):
        assert text["units"][name]
    np.testing.assert_array_equal(np.load(tmp_path / "r" / "truth" / "valid.npy"), recording.frames[0].valid)


def test_manifest_spec_alone_gives_the_sensor_back(tmp_path):
    """A CSV filter is written out, so the dump (and the hash) hold its numbers."""
    (tmp_path / "sensors").mkdir()
    text = (ROOT / "sensors" / "reference-mono.yaml").read_text()
    text = text.replace("clear: {flat: 1.0, band_nm: [400, 700]}", "clear: curve.csv")
    (tmp_path / "sensors" / "a.yaml").write_text(text)
    hashes = []
    for peak in (0.9, 0.8):
        (tmp_path / "sensors" / "curve.csv").write_text(f"400,0\n550,{peak}\n700,0\n")
        sensor = recordings.sensor_like(tmp_path / "sensors" / "a.yaml", 64, 64)
        with RecordingWriter(None, sensor, seed=1, duration_us=1000) as writer:
            manifest = json.loads(manifests.to_text(writer.finish().manifest))
        hashes.append(manifest["sensor"]["sha256"])
        rebuilt = SensorSpec.model_validate(manifest["sensor"]["spec"])
        assert rebuilt.filters["clear"].load().at(550) == pytest.approx(peak)
    assert hashes[0] != hashes[1]


def test_existing_targets_are_refused_or_replaced(tmp_path):
    target = tmp_path / "r"
    recordings.make("eiger", target, frames=1)
    before = (target / "recording.json").read_bytes()
    with pytest.raises(OutputError, match="exists"):
        recordings.make("eiger", target, frames=2)
    assert (target / "recording.json").read_bytes() == before
    assert len(recordings.make("eiger", target, frames=2, overwrite=True).frames) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def test_other_folders_and_files_are_never_replaced(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.txt").write_text("x")
    (tmp_path / "file").write_text("x")
    for name, message in (("precious", "holds other things"), ("file", "is a file"), ("file/r", "is not a folder")):
        with pytest.raises(OutputError, match=message):
            recordings.make("eiger", tmp_path / name, overwrite=True)
    assert (tmp_path / "precious" / "thesis.txt").read_text() == "x"
    (tmp_path / "empty").mkdir()
    assert len(recordings.make("eiger", tmp_path / "empty").frames) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "file", "precious"]


def test_an_error_on_the_way_leaves_nothing(tmp_path):
    sensor = recordings.sensor_like("eiger")
    with (
        pytest.raises(ZeroDivisionError),
        RecordingWriter(tmp_path / "r", sensor, seed=1, duration_us=100) as writer,
    ):
        writer.add_frame(recordings.frame_of(sensor))
        assert any(p.name.endswith(".partial") for p in tmp_path.iterdir())
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def run(code, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tests" / "support")}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip


@pytest.mark.parametrize("limit", [*(pytest.param(n, marks=pytest.mark.slow) for n in (20_000, 300_000)), 120_000])
def test_a_full_disk_is_one_clear_error(limit, tmp_path):
    """A limit on file size stands in for it: writes fail in the kernel, at a frame, the truth or the events."""
    code = """
import resource, signal, sys
import recordings
from hesim_render.core.errors import OutputError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    recordings.make("eiger", sys.argv[1], width=256, height=192, frames=0 if sys.argv[2] == "20000" else 1)
except OutputError as error:
    print(error)
else:
    sys.exit("no error")
"""
    child = run(code, tmp_path / "r", limit)
    out, err = child.communicate(timeout=60)
    assert child.returncode == 0, err
    assert len(out.splitlines()) == 1 and "cannot be written" in out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("limit", [*(pytest.param(n, marks=pytest.mark.slow) for n in (20_000, 900_000)), 250_000])
def test_a_disk_that_is_full_of_events_is_one_clear_error(limit, tmp_path):
    """HDF5 by itself cannot close such a file: it ends in messages of its own, and in a crash."""
    code = """
import resource, signal, sys
import recordings
from hesim_render.core.errors import OutputError
from hesim_render.recording import RecordingWriter
sensor = recordings.sensor_like("eiger")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    with RecordingWriter(sys.argv[1], sensor, seed=1, duration_us=10**6) as writer:
        recordings.fill(writer, sensor, 0, 10**6, count=300_000)
except OutputError as error:
    print(error)
else:
    sys.exit("no error")
"""
    child = run(code, tmp_path / "r", limit)
    out, err = child.communicate(timeout=60)
    assert child.returncode == 0 and err == ""
    assert len(out.splitlines()) == 1 and "cannot be written (File too large)" in out
    assert list(tmp_path.iterdir()) == []


def test_a_killed_run_leaves_no_recording_and_the_next_one_tidies_up(tmp_path):
    code = """
import sys, time
import recordings
from hesim_render.recording import RecordingWriter
sensor = recordings.sensor_like("eiger")
with RecordingWriter(sys.argv[1], sensor, seed=1, duration_us=10**6) as writer:
    writer.add_frame(recordings.frame_of(sensor))
    print("ready", flush=True)
    time.sleep(60)
"""
    child = run(code, tmp_path / "r")
    assert child.stdout.readline() == "ready\n", child.stderr.read()
    child.send_signal(signal.SIGKILL)
    child.wait(timeout=10)
    assert not (tmp_path / "r").exists()
    assert [p.name.endswith(".partial") for p in tmp_path.iterdir()] == [True]
    recordings.make("eiger", tmp_path / "r")
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


def test_folders_that_are_no_recordings_are_one_clear_error(tmp_path):
    with pytest.raises(SpecError, match="no such folder"):
        Recording.load(tmp_path / "nowhere")
    with pytest.raises(SpecError, match="not a recording"):
        Recording.load(tmp_path)
    folder = tmp_path / "r"
    recordings.make("eiger", folder)
    text = (folder / "recording.json").read_text()
    (folder / "recording.json").write_text(text.replace('"schema_version": 1', '"schema_version": 99'))
    with pytest.raises(SpecError, match="schema_version is 99"):
        Recording.load(folder)
    (folder / "recording.json").write_text("{")
    with pytest.raises(SpecError, match=r"recording\.json: cannot be read"):
        Recording.load(folder)
    (folder / "recording.json").write_text(text)
    (folder / "events.h5").write_bytes(b"nonsense")
    with pytest.raises(SpecError, match=r"events\.h5"):
        _ = Recording.load(folder).events


def test_manifest_knows_the_files_a_scene_is_made_of(tmp_path):
    mesh = tmp_path / "plate.obj"
    mesh.write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n")
    (tmp_path / "scene.yaml").write_text(
        "schema_version: 1\nname: plate\ndescription: one triangle\n"
        "objects:\n  - {name: plate, shape: mesh, mesh: plate.obj}\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {origin_m: [0, 0, 1]}\n"
    )
    scene, sensor = hr.load_scene(tmp_path / "scene.yaml"), hr.load_sensor("reference-mono").crop(8, 8)
    manifest = hr.simulate(scene, sensor, duration_s=0.001, samples=2).manifest
    assert manifest["scene"]["files_sha256"] == {"plate.obj": hashlib.sha256(mesh.read_bytes()).hexdigest()}


SKY = """light: {type: environment, file: sky.exr, illuminance_lux: 100}
camera: {fit: target}
target: {type: patch-chart, width_m: 0.2, height_m: 0.1, rows: 1, cols: 2, patches: patches.csv}
"""
BOX = "mitsuba: {file: box.xml}\ncamera: {origin_m: [0, 0, 1]}\n"


@pytest.mark.parametrize(("scene", "files"), [
    (SKY, {"sky.exr": "a sky", "patches.csv": "name,L,a,b\none,50,1,2\nother,60,3,4\n"}),
    (BOX, {"box.xml": "<scene/>"}),
])  # fmt: skip
def test_manifest_knows_the_files_of_lights_charts_and_mitsuba_scenes(scene, files, tmp_path):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "s.yaml").write_text(f"schema_version: 1\nname: s\ndescription: files\n{scene}")
    hashes = manifests._file_hashes(read_scene(tmp_path / "s.yaml"))
    assert hashes == {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()}


def test_white_is_that_of_lamps_where_nothing_else_shines():
    sensor, given = hr.load_sensor("eiger").crop(16, 16), {"seed": 1, "duration_us": 10, "settings": {"clean": True}}
    scene = read_scene("integrating-sphere", {"light": {"type": "none"}, "target.illuminant": "A"})
    neutral = manifests.build(sensor, scene=scene, **given)["mosaic"]["neutral"]
    assert neutral == describe(sensor, illuminant("A")).neutral
    assert neutral != manifests.build(sensor, scene=None, **given)["mosaic"]["neutral"]
    # a light of the scene comes first
    light = {"type": "uniform", "illuminance_lux": 9, "illuminant": "A"}
    scene = read_scene("integrating-sphere", {"light": light, "target.illuminant": "D65"})
    assert manifests.build(sensor, scene=scene, **given)["mosaic"]["neutral"] == neutral

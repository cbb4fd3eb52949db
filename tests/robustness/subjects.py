"""What is damaged: valid inputs of every kind of file, small, and what reads each of them, as users do."""

import contextlib
import io
import shutil
import tempfile
from pathlib import Path

import capture_sets
import event_files
import more_subjects as more
import numpy as np
import recordings
import reset_captures
from PIL import Image

import hesim_render as hr

#: Light of the small scenes.
_LIGHT = "light: {type: uniform, illuminance_lux: 100}\n"


def recording(folder):
    recordings.make("eiger", folder / "r", width=32, height=32, duration_us=60_000)


def read_recording(folder):
    from hesim_render.cli.terminal import summary
    from hesim_render.recording.showcase import write_previews

    loaded = hr.Recording.load(folder / "r")
    summary(loaded)
    for frame in loaded.frames:
        assert frame.raw.shape == frame.valid.shape == frame.electrons_mean.shape
    _ = loaded.events, loaded.event_truth
    hr.Recording.load(folder / "r").event_slice(12_000, 40_000)
    with tempfile.TemporaryDirectory() as other:
        write_previews(loaded, Path(other))


def develop(folder):
    from hesim_render.isp.develop import develop_recording

    with tempfile.TemporaryDirectory() as other:
        develop_recording(folder / "r", Path(other) / "out")


def captures_aps(folder):
    capture_sets.write_frames(folder / "set", size=16, frames=8, sensor="reference-bayer", bit_depth=12)


def captures_evs(folder):
    capture_sets.write_events(folder / "set", size=16, trials=4000)
    contrast = np.linspace(-0.4, 0.4, 7)
    on = np.random.default_rng(1).binomial(200, (contrast[:, None, None] > 0) * 0.8 + np.zeros((7, 16, 16)) + 0.1)
    np.savez(folder / "set" / "evs_steps.npz", contrast=contrast, signal_dn=20.0, n_on=on, n_off=(200 - on) // 2,
             n_trials=200)  # fmt: skip


def captures_trials(folder):
    reset_captures.write(folder / "set", reset_captures.Pixels(), np.random.default_rng(2), (16, 16), steps=5)
    file = folder / "set" / "evs_noise_rate.npz"
    data = dict(np.load(file))
    np.savez(file, **data, **reset_captures.parts_of(data, 8, 2, 0.07))


def calibrate_aps(folder):
    from hesim_render.calibrate import calibrate_aps as run

    with tempfile.TemporaryDirectory() as other:
        run(folder / "set", Path(other) / "c.yaml", Path(other) / "r.html")


def calibrate_evs(folder):
    from hesim_render.calibrate import calibrate_evs as run

    with tempfile.TemporaryDirectory() as other:
        run(folder / "set", Path(other) / "c.yaml", Path(other) / "r.html")


def calibration(folder):
    """A calibration of a whole small sensor, and the sensor that points at it."""
    from hesim_render.calibrate import calibrate_aps as frames
    from hesim_render.calibrate import calibrate_evs as events

    capture_sets.write_frames(folder / "set", size=32, frames=16)
    capture_sets.write_events(folder / "set", size=32, trials=100000)
    text = (Path(__file__).parents[2] / "sensors" / "reference-mono.yaml").read_text()
    for old, new in (("rows: 1024", "rows: 32"), ("cols: 1024", "cols: 32"), ("bit_depth: 12", "bit_depth: 10")):
        assert old in text
        text = text.replace(old, new)
    (folder / "plain.yaml").write_text(text)
    with (folder / "set" / "capture.yaml").open("a") as stream:
        stream.write("signal_reference: {k: 0.25, t_ref_us: 1000, filter: own}\n")
    lines = (folder / "set" / "capture.yaml").read_text().replace("tile_rows: 2", "tile_rows: 1")
    (folder / "set" / "capture.yaml").write_text(lines.replace("tile_cols: 2", "tile_cols: 1"))
    frames(folder / "set", folder / "c.yaml")
    events(folder / "set", folder / "c.yaml")
    shutil.rmtree(folder / "set")
    (folder / "s.yaml").write_text(text + "\nnoise: c.yaml\n")


def use_calibration(folder):
    from hesim_render.calibrate import write_report
    from hesim_render.calibrate.summary import summary_lines
    from hesim_render.calibration.file import as_written, read_calibration
    from hesim_render.isp.frame_noise import FrameNoise

    data = read_calibration(folder / "c.yaml")
    with as_written(folder / "c.yaml"):
        for section in ("aps", "evs"):
            summary_lines(data, section)
    write_report(folder / "c.yaml", folder / "r.html", overwrite=True)
    FrameNoise.of_calibration(folder / "c.yaml", 1000).corrected(np.zeros((32, 32), np.float32))
    use_sensor(folder, "s.yaml")


def sensor(folder):
    text = (Path(__file__).parents[2] / "sensors" / "reference-mono.yaml").read_text()
    (folder / "s.yaml").write_text(text.replace("clear: {flat: 1.0, band_nm: [400, 700]}", "clear: curve.csv"))
    (folder / "curve.csv").write_text("# nm, 1\nnm,a\n400,0\n450,0.5\n550,0.9\n700,0\n")


def use_sensor(folder, name="s.yaml"):
    made = hr.load_sensor(folder / name)
    if made.spec.geometry.rows > 8 and made.spec.geometry.cols > 8:
        made = made.crop(8, 8)
    if made.aps is not None:
        raw = made.aps.sample(np.full(made.layout.shape, 100.0), made.spec.aps.exposure_us, seed=1)
        assert raw.max() < 2**made.spec.aps.bit_depth
    if made.evs is not None:
        _ = made.evs.threshold_on_map, made.evs.threshold_off_map


def scene(folder):
    (folder / "plate.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n")
    (folder / "curve.csv").write_text("360,0.4\n830,0.5\n")
    (folder / "s.yaml").write_text(
        "schema_version: 1\nname: plate\ndescription: one triangle\nobjects:\n"
        "  - {name: plate, shape: mesh, mesh: plate.obj, reflectance: curve.csv}\n"
        "  - {name: ball, shape: sphere, size_m: [0.1, 0.1, 0.1], position_m: [0, 0, 0.2]}\n"
        "motion:\n  - object: ball\n    keyframes:\n      - {t_us: 0}\n"
        "      - {t_us: 1000, translation_m: [0.1, 0, 0], rotation_axis: [0, 1, 0], rotation_deg: 90}\n"
        f"{_LIGHT}camera:\n  origin_m: [0, 0, 1]\n  target_m: [0, 0, 0]\n  f_number: 4\nmax_depth: 3\n"
    )


def build_scene(folder):
    from hesim_render.sources.render.scene.builder import build
    from hesim_render.sources.render.scene.mitsuba_version import mitsuba

    made = build(mitsuba(), hr.load_scene(folder / "s.yaml").spec)
    made.pose(500)


def foreign_scene(folder):
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(folder / "t.png")
    (folder / "plate.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n")
    (folder / "part.xml").write_text(
        '<scene version="3.0.0">\n<shape type="sphere"><float name="radius" value="0.3"/>\n'
        '<emitter type="area"><spectrum name="radiance" value="2"/></emitter></shape>\n</scene>\n'
    )
    (folder / "main.xml").write_text(
        '<scene version="3.0.0">\n<default name="part" value="part.xml"/>\n<include filename="$part"/>\n'
        '<integrator type="path"><integer name="max_depth" value="4"/></integrator>\n'
        '<shape type="obj"><string name="filename" value="plate.obj"/>\n<bsdf type="diffuse">\n'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="t.png"/></texture>\n</bsdf></shape>\n'
        '<sensor type="perspective"><float name="fov" value="45"/></sensor>\n</scene>\n'
    )
    (folder / "s.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: d\nmitsuba: {file: main.xml, radiance_scale: 0.5}\n"
        "camera: {origin_m: [0, 0, 2]}\n"
    )


def pictures(folder):
    rng = np.random.default_rng(4)
    (folder / "pictures").mkdir()
    for k in range(3):
        Image.fromarray(rng.integers(0, 255, (16, 16, 3), dtype=np.uint8)).save(folder / "pictures" / f"{k:04d}.png")


def array_video(folder):
    np.save(folder / "v.npy", np.random.default_rng(4).integers(0, 255, (3, 16, 16), dtype=np.uint8))


def video(folder):
    import av

    with av.open(str(folder / "v.mkv"), "w") as out:
        stream = out.add_stream("ffv1", rate=100)
        stream.width = stream.height = 16
        stream.pix_fmt = "yuv420p"
        for k in range(4):
            image = np.full((16, 16, 3), 60 * k, np.uint8)
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode())


def play(folder):
    source = next(p for p in folder.iterdir() if p.name in ("v.npy", "v.mkv", "pictures"))
    tags = {"transfer": "srgb", "primaries": "bt709", "matrix": "bt709", "range": "limited"}
    own = hr.load_sensor("reference-mono").crop(8, 8)
    fps = None if source.name == "v.mkv" else 1000
    given = tags if source.name == "v.mkv" else {"transfer": "srgb"}
    hr.simulate_video(source, own, fps=fps, duration_s=0.002, white_lux=300, **given)


def pipeline(folder):
    np.savez(folder / "maps.npz", rows=np.zeros(16), pixels=np.zeros((16, 16)))
    (folder / "p.yaml").write_text(
        "schema_version: 1\nsteps:\n  - step: black_level\n    row_map: {file: maps.npz, name: rows}\n"
        "    pixel_map: {file: maps.npz, name: pixels}\n  - {step: white_balance, method: given, gains: [1, 1, 1]}\n"
        "  - {step: demosaic}\n  - {step: colour_matrix}\n  - {step: exposure, auto: true}\n  - {step: encode}\n"
    )
    (folder / "c.yaml").write_text(
        "channels: [red, green, blue]\ntile: |\n  red green\n  green blue\nblack_level_dn: 64\nwhite_level_dn: 1023\n"
        "white_balance: [2, 1, 1.5]\nmatrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntransfer: srgb\n"
    )


def run_pipeline(folder):
    from hesim_render.isp import load_pipeline, process
    from hesim_render.mosaic.colour_profile import load_camera

    raw = np.random.default_rng(1).integers(64, 1023, (16, 16), dtype=np.uint16)
    process(raw, load_camera(folder / "c.yaml"), load_pipeline(folder / "p.yaml"))


def target_scene(folder):
    """A hyperspectral picture, meshes of two kinds, and a track from a file; and a chart of measured patches."""
    import trimesh

    rng = np.random.default_rng(5)
    np.save(folder / "cube.npy", rng.random((4, 6, 5), dtype=np.float32))
    box = trimesh.creation.box((1, 1, 0.2))
    (folder / "a.glb").write_bytes(trimesh.Scene(box).export(file_type="glb"))
    (folder / "b.stl").write_bytes(box.export(file_type="stl"))
    (folder / "way.csv").write_text(
        "t_us,x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n500,0.1,0,0,0,0.1,0,1\n1000,0.2,0,0,0,0,0,1\n"
    )
    (folder / "way.tum").write_text("# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n0.001 0.1 0 0 0 0 0 1\n")
    (folder / "patches.csv").write_text("name,400,500,600,700\nwhite,0.9,0.9,0.9,0.9\nred,0.05,0.05,0.5,0.7\n")
    meshes = "".join(
        f"  - {{name: {name}, shape: mesh, mesh: {file}, size_m: [0.1, 0.1, 0.1], position_m: [0, 0, 0.2]}}\n"
        for name, file in (("a", "a.glb"), ("b", "b.stl"))
    )
    head = "schema_version: 1\nname: x\ndescription: d\n"
    (folder / "s.yaml").write_text(
        f"{head}target: {{type: image, file: cube.npy, wavelength_nm: [400, 475, 550, 625, 700], beyond: hold}}\n"
        f"objects:\n{meshes}motion:\n  - {{object: a, file: way.csv}}\n  - {{object: b, file: way.tum}}\n"
        f"{_LIGHT}camera: {{fit: target}}\n"
    )
    (folder / "chart.yaml").write_text(
        f"{head}target: {{type: patch-chart, patches: patches.csv, rows: 1, cols: 2}}\n{_LIGHT}"
        "camera: {fit: target}\n"
    )


def build_targets(folder):
    from hesim_render.sources.render.scene.builder import build
    from hesim_render.sources.render.scene.mitsuba_version import mitsuba

    for name in ("s.yaml", "chart.yaml"):
        build(mitsuba(), hr.load_scene(folder / name).spec).pose(500)


def event_files_of_others(folder):
    events = event_files.many(300, 40_000, (24, 32))
    for name in ("evt2", "evt3", "dat", "prophesee", "aedat4", "dsec", "npz", "txt"):
        (folder / name).mkdir()
        event_files.written(events, name, folder / name, (24, 32))


def import_events(folder):
    from hesim_render.exchange import open_events

    for file in sorted(folder.glob("*/events.*")):
        for events in open_events(file, file.parent.name, (24, 32), keep_stated=True):
            assert events["x"].max(initial=0) < 32


def labelled(folder):
    """A recording with geometric truth and labels of its events."""
    made = hr.load_sensor("gen2").crop(16, 16)
    hr.simulate(hr.load_scene("rotating-star"), made, duration_s=0.04, out=folder / "r", truth="all", quality=4)


def read_labelled(folder):
    loaded = hr.Recording.load(folder / "r")
    if (stored := loaded.stored_truth) is not None:
        for name in stored.names:
            stored.read(name)
    if (labels := loaded.event_labels) is not None:
        labels.counts()
    assert loaded.event_objects.size == loaded.events.size


#: name: (makes valid files in a folder, reads them, files that are damaged)
SUBJECTS = {
    "recording": (recording, read_recording, "r/*.json r/events.h5 r/frames/*.dng r/truth/*"),
    "developed": (recording, develop, "r/*.json r/frames/*.dng"),
    "aps": (captures_aps, calibrate_aps, "set/*"),
    "evs": (captures_evs, calibrate_evs, "set/*"),
    "trials": (captures_trials, calibrate_evs, "set/*"),
    "calibration": (calibration, use_calibration, "c.yaml c_*.npz s.yaml"),
    "sensor": (sensor, use_sensor, "s.yaml curve.csv"),
    "scene": (scene, build_scene, "s.yaml plate.obj curve.csv"),
    "mitsuba": (foreign_scene, build_scene, "s.yaml main.xml part.xml plate.obj t.png"),
    "pictures": (pictures, play, "pictures/*"),
    "array": (array_video, play, "v.npy"),
    "video": (video, play, "v.mkv"),
    "isp": (pipeline, run_pipeline, "p.yaml c.yaml maps.npz"),
    "targets": (target_scene, build_targets, "s.yaml chart.yaml cube.npy a.glb b.stl way.csv way.tum patches.csv"),
    "exchange": (event_files_of_others, import_events, "*/events.*"),
    "labelled": (labelled, read_labelled, "r/truth/*.h5 r/recording.json"),
    "surfaces": (more.surfaces, build_scene, "s.yaml t.png cube.npy sky.exr curve.csv"),
    "lens": (more.lens, more.use_lens, "s.yaml psf.npy sheet.yaml"),
    "studies": (more.studies, more.read_studies, "*.yaml"),
    "cubes": (more.cubes, more.read_cubes, "a.hdr a.img b.mat c.mat"),
    "benchmark": (more.benchmark, more.read_plan, "b.yaml"),
    "built": (more.built, more.use_built, "b/*.json b/clips/*/clip.json"),
    "shards": (more.shards, more.verify_packed, "s/index.json s/*.tar"),
    "run": (more.run_file, more.read_run, "r.yaml"),
}


def files_of(name, folder):
    """The files of a subject that are damaged, in order."""
    return sorted(path for pattern in SUBJECTS[name][2].split() for path in folder.glob(pattern) if path.is_file())


def quiet():
    """Nothing that libraries print stands in the way of what is to be seen."""
    return contextlib.redirect_stdout(io.StringIO())

"""Files from a stranger: what is damaged, leads elsewhere or asks for too much is one clear error."""

import io
import json
import os
import shutil
import time
import zipfile
from pathlib import Path

import capture_sets
import h5py
import hdf5plugin  # noqa: F401  (registers the filters of events.h5)
import numpy as np
import pytest
import recordings
import tifffile
from damage import LIT, refused, scene_file

import hesim_render as hr
from hesim_render import cli
from hesim_render.calibrate import calibrate_aps, calibrate_evs, read_calibration, read_maps
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.core.yaml_file import read_yaml
from hesim_render.recording.recording import Recording

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "r"
    recordings.make("eiger", folder, width=32, height=32, duration_us=60_000)
    return folder


@pytest.fixture
def folder(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "r")


def change_manifest(folder, change):
    manifest = json.loads((folder / "recording.json").read_text())
    change(manifest)
    (folder / "recording.json").write_text(json.dumps(manifest))


# ---- the manifest -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("roi", "width_px"), "32", "roi.width_px: expected a number, not a text"),
        (("roi", "width_px"), 0, "roi.width_px"),
        (("roi", "width_px"), 2**40, "roi.width_px: Input should be|roi: more than|roi.width_px"),
        (("event_grid", "height"), -1, "event_grid.height"),
        (("event_grid", "width"), 0, "event_grid: .*both 0 or neither|event_grid.width"),
        (("time", "end_us"), True, "time.end_us: expected a number, not true or false"),
        (("time", "begin_us"), 10**9, "end_us: lies before begin_us|lies before"),
        (("counts", "events"), 5, "events_on and events_off together"),
        (("counts", "frames"), 7, "counts.frames: is 7, but frames lists 2"),
        (("frames", 0, "exposure_us"), None, "frames.0.exposure_us"),
        (("frames", 1, "t_us"), 0, "order of time"),
        (("frames", 0, "extra"), 1, "frames.0.extra: unknown key"),
        (("mosaic", "tile_filter"), [["red", "red"], ["red"]], "tables of one size"),
        (("mosaic", "channels"), [], "channels"),
        (("mosaic", "neutral"), [0, 0, 0], "neutral"),
        (("mosaic", "camera_to_srgb"), [[1]], "camera_to_srgb"),
        (("mosaic", "bit_depth"), 99, "mosaic.bit_depth"),
        (("lens", "f_number"), 0, "lens.f_number"),
        (("sensor", "sha256"), "zz", "sensor.sha256"),
        (("sensor", "spec"), {"filters": {"a": "/dev/zero.csv"}}, "names a CSV file"),
        (("settings", "render"), {"error_noise": {"frames": {"rms": "x"}}}, "settings.render.error_noise.frames"),
        (("surplus",), 1, "surplus: unknown key"),
        (("units",), [], "units"),
    ],
)
def test_a_manifest_that_is_wrong_names_its_key(folder, keys, value, message):
    def change(manifest):
        node = manifest
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] = value

    change_manifest(folder, change)
    refused(lambda: Recording.load(folder), rf"recording\.json: .*({message})")


@pytest.mark.parametrize("text", ["[" * 100_000, "null", "[]", '{"schema_version": true}', '{"schema_version": 1}', ""])
def test_a_manifest_that_is_none(folder, text):
    (folder / "recording.json").write_text(text)
    refused(lambda: Recording.load(folder), r"recording\.json")


def test_a_sensor_in_the_manifest_that_is_wrong_is_an_error_of_that_file(folder, tmp_path):
    change_manifest(folder, lambda manifest: manifest["sensor"]["spec"].pop("aps"))
    from hesim_render.isp import develop_recording

    refused(lambda: develop_recording(folder, tmp_path / "out"), r"recording\.json: sensor\.spec")
    assert not (tmp_path / "out").exists()


# ---- paths ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["file", "truth"])
@pytest.mark.parametrize("way", ["up", "absolute", "link", "nul", "folder"])
def test_names_in_a_manifest_stay_in_the_folder(folder, tmp_path, key, way):
    outside = tmp_path / "outside"
    name = json.loads((folder / "recording.json").read_text())["frames"][0][key]
    outside.write_bytes((folder / name).read_bytes())
    given = {"up": "../outside", "absolute": str(outside), "link": name, "nul": "a\0b", "folder": "frames"}[way]
    if way == "link":
        (folder / name).unlink()
        (folder / name).symlink_to(outside)
    change_manifest(folder, lambda manifest: manifest["frames"][0].update({key: given}))
    refused(lambda: Recording.load(folder).frames[0], rf"frames\.0\.{key}")
    if way in ("link", "folder"):
        assert Recording.load(folder).frames[1].raw.shape == (32, 32)


@pytest.mark.parametrize(("index", "told"), [(10**300, "less than 1000000000"), (1, "two have the same index")])
def test_numbers_of_frames_name_files_of_an_export(folder, index, told):
    """Each has a file of its own; two of one number would be one file."""
    change_manifest(folder, lambda manifest: manifest["frames"][0].update({"index": index}))
    refused(lambda: Recording.load(folder), told)


@pytest.mark.parametrize("name", ["events.h5", "truth/valid.npy", "truth/events.npz", "recording.json"])
def test_files_of_fixed_names_are_no_links_to_elsewhere(folder, tmp_path, name):
    (folder / name).rename(tmp_path / "outside")
    (folder / name).symlink_to(tmp_path / "outside")

    def use():
        loaded = Recording.load(folder)
        return loaded.events, loaded.event_truth, loaded.frames[0]

    refused(use, "leads out of its folder")


@pytest.mark.parametrize(
    "body",
    [
        f"objects: [{{name: a, shape: mesh, mesh: ../plate.obj}}]\n{LIT}",
        f"objects: [{{name: a, shape: mesh, mesh: link.obj}}]\n{LIT}",
        f"target: {{type: flat, reflectance: ../curve.csv}}\n{LIT}",
        f"target: {{type: flat, reflectance: {{csv: ../curve.csv}}}}\n{LIT}",
        "mitsuba: {file: ../main.xml}",
        "mitsuba: {inline: {a: {type: obj, filename: ../plate.obj}, b: {type: constant}}}",
    ],
)
def test_scenes_name_files_of_their_own_folder(tmp_path, body):
    (tmp_path / "plate.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nf 1 2 3\n")
    (tmp_path / "curve.csv").write_text("360,0.4\n830,0.5\n")
    (tmp_path / "main.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>')
    file = scene_file(tmp_path / "scene", body)
    (tmp_path / "scene" / "link.obj").symlink_to(tmp_path / "plate.obj")
    refused(lambda: hr.load_scene(file), r"s\.yaml:4: .*lies outside of the scene's folder.*--allow-outside")
    assert hr.load_scene(file, allow_outside=True).spec.allow_outside
    # what stands in the file cannot give the leave itself
    file = scene_file(tmp_path / "scene", f"{body}\nallow_outside: true")
    refused(lambda: hr.load_scene(file, allow_outside=True), "unknown key|allow_outside")


def test_captures_name_a_sensor_that_ships_or_lies_beside_them(tmp_path):
    (tmp_path / "mine.yaml").write_text((ROOT / "sensors" / "reference-bayer.yaml").read_text())
    capture_sets.write_frames(tmp_path / "set", size=16, frames=8, bit_depth=12, sensor="../mine.yaml")
    refused(lambda: calibrate_aps(tmp_path / "set", tmp_path / "c.yaml"), r"capture\.yaml: sensor: .*leads out")


# ---- sizes ------------------------------------------------------------------------------------------


def bomb(file, name, shape, dtype="<f4"):
    """12 MB that inflate to 12 GB."""
    block = bytes(1 << 24)
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(f"{name}.npy", "w") as out,
    ):
        np.lib.format.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
        for _ in range(20):
            out.write(block)


def test_truth_that_inflates_without_end_is_refused_by_its_header(folder):
    bomb(folder / "truth" / "000000.npz", "electrons_mean", (1 << 17, 1 << 15))
    begin = time.process_time()
    refused(lambda: Recording.load(folder).frames[0], r"no array 'electrons_stderr'")
    refused(
        lambda: read_arrays(folder / "truth" / "000000.npz", shapes={"electrons_mean": (32, 32)}),
        "expected \\(32, 32\\)",
    )
    refused(lambda: read_arrays(folder / "truth" / "000000.npz"), "GB of memory")
    assert time.process_time() - begin < 5  # inflated it would take a minute


def test_headers_of_arrays_are_short_and_say_what_is_there(tmp_path):
    long = io.BytesIO()
    long.write(b"\x93NUMPY\x02\x00" + (2**31 - 1).to_bytes(4, "little") + b" " * 1000)
    (tmp_path / "a.npy").write_bytes(long.getvalue())
    refused(lambda: read_array(tmp_path / "a.npy"), "header of an array is too long")
    np.save(tmp_path / "b.npy", np.array([None, 1], dtype=object))
    refused(lambda: read_array(tmp_path / "b.npy"), "array of objects")
    np.save(tmp_path / "c.npy", np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(read_array(tmp_path / "c.npy", (2, 3), "f"), np.arange(6.0).reshape(2, 3))
    np.save(tmp_path / "d.npy", np.asfortranarray(np.arange(6).reshape(2, 3)))
    np.testing.assert_array_equal(read_array(tmp_path / "d.npy"), np.arange(6).reshape(2, 3))
    refused(lambda: read_array(tmp_path / "d.npy", (3, 2)), "shape")
    refused(lambda: read_array(tmp_path / "d.npy", (2, 3), "b"), "expected true or false")


def test_a_dng_of_another_kind(folder):
    file = folder / "frames" / "000000.dng"
    whole = file.read_bytes()
    for array, options in (
        (np.zeros((32, 64), np.uint16), {}),
        (np.zeros((32, 32), np.uint8), {}),
        (np.zeros((32, 32, 3), np.uint16), {"photometric": "rgb"}),
        (np.zeros((32, 32), np.uint16), {"compression": "zlib"}),
    ):
        tifffile.imwrite(file, array, **options)
        refused(lambda: Recording.load(folder).frames[0], r"000000\.dng: holds|000000\.dng: cannot be read")
    for broken in (b"", whole[:100], whole[: len(whole) // 3], b"II*\0" + b"\xff" * 100):
        file.write_bytes(broken)
        refused(lambda: Recording.load(folder).frames[0], r"000000\.dng: ")


# ---- events -----------------------------------------------------------------------------------------


def exchange(name, make):
    def change(file):
        values = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        del file[name]
        make(file, name, values)

    return change


def put(function):
    return lambda file, name, values: file.__setitem__(name, function(values))


def virtual(file, name, values):
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource("other.h5", "t", shape=values.shape)
    file.create_virtual_dataset(name, layout)


EVENTS = {
    "short column": (exchange("events/x", put(lambda v: v[:10])), "different lengths"),
    "group": (exchange("events/t", lambda file, name, _: file.create_group(name)), "no data set"),
    "missing": (lambda file: file.__delitem__("events/p"), "events/p|no data set|link"),
    "text": (exchange("events/t", put(lambda v: "x")), "no data set of whole numbers"),
    "signed": (exchange("events/x", put(lambda v: v.astype("i4") - 40)), "expected uint16"),
    "two dimensions": (exchange("events/y", put(lambda v: v[:, None])), "expected one dimension"),
    "outside the grid": (exchange("events/x", put(lambda v: v + np.uint16(9999))), "outside the event grid"),
    "polarity": (exchange("events/p", put(lambda v: v + np.uint8(3))), "expected 0 and 1"),
    "back in time": (exchange("events/t", put(lambda v: v[::-1])), "goes back in time|does not fit"),
    "NaN index": (exchange("ms_to_idx", put(lambda v: np.full(v.shape, np.nan))), "no data set of whole numbers"),
    "index too high": (exchange("ms_to_idx", put(lambda v: v + np.uint64(10**12))), "ms_to_idx must run"),
    "index back": (exchange("ms_to_idx", put(lambda v: v[::-1].copy())), "ms_to_idx must run"),
    "empty index": (exchange("ms_to_idx", put(lambda v: v[:0])), "ms_to_idx holds 0"),
    "offset": (exchange("t_offset", put(lambda v: np.int64(2**62))), "t_offset must be"),
    "offset list": (exchange("t_offset", put(lambda v: np.array([1, 2]))), "t_offset must be"),
    "soft link": (exchange("events/x", lambda f, n, _: f.__setitem__(n, h5py.SoftLink("/events/y"))), "is a link"),
    "external link": (exchange("events", lambda f, n, _: f.__setitem__(n, h5py.ExternalLink("o", "/"))), "is a link"),
    "virtual": (exchange("events/t", virtual), "values in another file"),
    "external": (
        exchange("events/p", lambda f, n, v: f.create_dataset(n, v.shape, "u1", external=[("/etc/hosts", 0, 2**40)])),
        "values in another file",
    ),
    "filter": (
        exchange("events/p", lambda f, n, v: f.create_dataset(n, data=v, chunks=(64,), compression=32015)),
        "packed by filter 32015",
    ),
    "nothing stored": (
        exchange("events/t", lambda f, n, v: f.create_dataset(n, v.shape, "u4", chunks=(64,))), "fewer values"
    ),
    "huge": (
        exchange("events/t", lambda f, n, v: f.create_dataset(n, (2**40,), "u4", chunks=(1 << 20,))),
        "fewer values|different lengths",
    ),
    "huge chunk": (
        exchange("events/t", lambda f, n, v: f.create_dataset(n, (1 << 28,), "u4", chunks=(1 << 28,))),
        "a chunk of events/t would take",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EVENTS)
def test_events_that_are_damaged_or_elsewhere(folder, name):
    change, message = EVENTS[name]
    with h5py.File(folder / "events.h5", "r+") as file:
        change(file)
    refused(lambda: Recording.load(folder).events, rf"events\.h5: .*({message})")


def test_an_index_of_milliseconds_that_does_not_fit_is_seen_where_it_matters(folder):
    whole = Recording.load(folder).events
    with h5py.File(folder / "events.h5", "r+") as file:
        index = file["ms_to_idx"][:]
        del file["ms_to_idx"]
        file["ms_to_idx"] = np.minimum(index + np.uint64(50), np.uint64(whole.size))
    refused(lambda: Recording.load(folder).event_slice(20_000, 30_000), "ms_to_idx does not fit")


def test_events_must_be_as_many_as_the_manifest_says(folder):
    def change(manifest):
        manifest["counts"]["events"] += 1
        manifest["counts"]["events_on"] += 1

    change_manifest(folder, change)
    refused(lambda: Recording.load(folder).events, "holds 20000 events; the recording has 20001")


# ---- YAML, names ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(f"a{k}: &a{k} [{','.join(9 * [f'*a{k - 1}'])}]\n" for k in range(1, 12)),
        "a0: &a0 {k: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [{','.join(9 * [f'*a{k - 1}'])}]}}\n" for k in range(1, 12)),
        "a: &a [*a]\n", "a: &a {b: *a}\n", f"a: {1000 * '['}", "a: 2001-99-99\n", "a: !!int x\n", "a: !!omap [1]\n",
    ],
)  # fmt: skip
def test_yaml_that_means_more_than_it_says(tmp_path, text):
    (tmp_path / "s.yaml").write_text(text)
    begin = time.process_time()
    refused(lambda: read_yaml(tmp_path / "s.yaml"), r"s\.yaml")
    assert time.process_time() - begin < 5
    (tmp_path / "s.yaml").write_text("a: &a {b: 1}\nc: *a\nd: {<<: *a, e: 2*3}\n")
    assert read_yaml(tmp_path / "s.yaml")["c"]["b"] == 1


def test_names_are_printed_without_what_a_terminal_obeys(folder, capsys):
    """A manifest with such a name is refused, and no message obeys it."""
    evil = "\x1b[31mred\x07\u202e\nline"
    change_manifest(folder, lambda manifest: manifest["mosaic"].update(sensor=evil))
    with pytest.raises(SystemExit) as end:
        cli.main(["view", str(folder)])
    out, err = capsys.readouterr()
    assert end.value.code == 2 and "mosaic.sensor: " in err and "holds a control character" in err
    assert not any(c in out + err for c in "\x1b\x07\u202e")
    with pytest.raises(SystemExit) as end:
        cli.main(["view", "no\x1b[2Jthing"])
    assert end.value.code == 2 and "\x1b" not in capsys.readouterr().err


def test_names_in_a_report_are_text(tmp_path):
    evil = "<script>alert(1)</script>"
    capture_sets.write_frames(tmp_path / "set", size=16, frames=8, notes=f"'{evil}'")
    calibrate_aps(tmp_path / "set", tmp_path / "c.yaml")
    text = (tmp_path / "c.yaml").read_text().replace("unit: ", f"unit: {evil}")
    (tmp_path / "c.yaml").write_text(text)
    from hesim_render.calibrate import write_report

    write_report(tmp_path / "c.yaml", tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "<script" not in page and "&lt;script&gt;" in page


def test_a_sensor_of_any_name_gives_readable_frames(tmp_path):
    recordings.make("eiger", tmp_path / "r", width=32, height=32, duration_us=60_000)
    made = Recording.load(tmp_path / "r")
    made.manifest["mosaic"]["sensor"] = "Grün 相机"
    other = made.save(tmp_path / "s")
    np.testing.assert_array_equal(Recording.load(other).frames[0].raw, made.frames[0].raw)


# ---- calibrations -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A small sensor that points at its calibration."""
    folder = tmp_path_factory.mktemp("calibrated")
    capture_sets.write_frames(folder / "set", size=32, frames=16, tile_rows=1, tile_cols=1)
    calibrate_aps(folder / "set", folder / "c.yaml")
    text = (ROOT / "sensors" / "reference-mono.yaml").read_text()
    for old, new in (("rows: 1024", "rows: 32"), ("cols: 1024", "cols: 32"), ("bit_depth: 12", "bit_depth: 10")):
        text = text.replace(old, new)
    (folder / "s.yaml").write_text(text + "\nnoise: c.yaml\n")
    return folder


@pytest.fixture
def own(calibrated, tmp_path):
    for path in calibrated.glob("[cs]*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def sample(folder):
    sensor = hr.load_sensor(folder / "s.yaml")
    return sensor.aps.sample(np.full(sensor.layout.shape, 100.0), 10_000, seed=1)


def map_path(folder):
    return folder / read_calibration(folder / "c.yaml")["aps"]["maps"]["file"]


def rewrite_maps(folder, **arrays):
    """Other maps, and a calibration that says they are its own."""
    file = map_path(folder)
    capture_sets.change(file, **arrays)
    import hashlib

    old = read_calibration(folder / "c.yaml")["aps"]["maps"]["sha256"]
    new = hashlib.sha256(file.read_bytes()).hexdigest()
    (folder / "c.yaml").write_text((folder / "c.yaml").read_text().replace(old, new))


def test_a_calibration_without_its_maps_says_so(own):
    assert sample(own).max() < 1024
    map_path(own).unlink()
    refused(lambda: sample(own), r"c_aps_maps-.*: no such file; it belongs to c\.yaml: copy it along")


def test_maps_of_another_calibration_are_refused(own):
    capture_sets.change(map_path(own), n_blc=np.zeros((32, 32)))
    refused(lambda: sample(own), r"is not the one that c\.yaml was written with")


@pytest.mark.parametrize("name", ["../m.npz", "absolute", "link", '"m\\0"'])
def test_maps_lie_beside_their_calibration(own, tmp_path_factory, name):
    outside = tmp_path_factory.mktemp("outside") / "m.npz"
    outside.write_bytes(map_path(own).read_bytes())
    old = map_path(own).name
    (own.parent / "m.npz").write_bytes(outside.read_bytes())
    if name == "link":
        map_path(own).unlink()
        (own / old).symlink_to(outside)
    else:
        given = str(outside) if name == "absolute" else name
        (own / "c.yaml").write_text((own / "c.yaml").read_text().replace(old, given))
    told = "leads out of its folder" if name == "link" else "is not the name of a file"
    refused(lambda: sample(own), rf"c\.yaml(:\d+)?: aps\.maps\.file: .*{told}")
    (own.parent / "m.npz").unlink()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("name", ["n_row", "n_blc", "n_dp"])
def test_maps_must_be_finite(own, name, bad):
    values = np.array(read_maps(own / "c.yaml", "aps")[name])
    values.ravel()[3] = bad
    rewrite_maps(own, **{name: values})
    refused(lambda: sample(own), f"map {name} holds values that are not finite")


def test_a_level_that_is_no_number_is_no_white():
    """The ADC's own bound, were such a map to come through."""
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    offset = np.full((8, 8), 64.0, np.float32)
    offset[0, :4] = np.nan, np.inf, -np.inf, 1e30
    sensor.aps.fixed_pattern.__dict__["offset_dn"] = offset  # in place of what the property finds
    raw = sensor.aps.sample(100.0, 1000, seed=1)
    assert raw[0, :4].tolist() == [0, 4095, 0, 4095]
    assert (raw[1:] > 60).all() and (raw[1:] < 110).all()


@pytest.mark.parametrize("old", ["  K:", "capture:", "  maps:", "schema_version: 1", "  black_dn:"])
def test_a_calibration_that_lacks_a_part(own, old):
    (own / "c.yaml").write_text((own / "c.yaml").read_text().replace(old, old.replace(":", "x:"), 1))
    refused(lambda: sample(own), r"c\.yaml")


# ---- captures ---------------------------------------------------------------------------------------


def test_frames_must_be_of_the_region(tmp_path):
    capture_sets.write_frames(tmp_path / "set", size=16, frames=8, roi="{x: 0, y: 0, width_px: 32, height_px: 16}")
    refused(lambda: calibrate_aps(tmp_path / "set", tmp_path / "c.yaml"), "frames of 16×16 pixels are not the roi")


def test_events_must_be_of_the_region(tmp_path):
    capture_sets.write_events(tmp_path / "set", size=16, roi="{x: 0, y: 0, width_px: 32, height_px: 16}")
    refused(lambda: calibrate_evs(tmp_path / "set", tmp_path / "c.yaml"), r"capture\.yaml: roi: event maps of 16×16")
    text = (tmp_path / "set" / "capture.yaml").read_text()
    (tmp_path / "set" / "capture.yaml").write_text(text + "evs_tile_rows: 2\nevs_tile_cols: 1\n")
    calibrate_evs(tmp_path / "set", tmp_path / "c.yaml")


@pytest.mark.parametrize("line", ["bit_depth: '10'", "bit_depth: true", "tile_rows: yes", "theta_hardware_v: '0.1'"])
def test_text_and_truth_values_are_no_numbers(tmp_path, line):
    key, value = line.split(": ")
    capture_sets.write_events(tmp_path / "set", size=16, **({key: value} if key != "theta_hardware_v" else {}))
    if key == "theta_hardware_v":
        text = (tmp_path / "set" / "capture.yaml").read_text()
        (tmp_path / "set" / "capture.yaml").write_text(text.replace("theta_hardware_v: 0.00075", line))
    refused(lambda: calibrate_evs(tmp_path / "set", tmp_path / "c.yaml"), rf"capture\.yaml:\d: {key}: (expected|Input)")


@pytest.mark.parametrize(
    ("file", "arrays", "message"),
    [
        ("evs_static", {"n_off": -5}, "n_off"),
        ("evs_static", {"n_off": np.full((16, 16), -5)}, "n_off holds counts outside"),
        ("evs_static", {"signal_dn": np.full((16, 16), -1.0)}, "signal_dn must be 0 or above"),
        ("evs_static", {"n_trials": 1e300}, "n_trials must be one whole number"),
        ("evs_static", {"n_trials": True}, "n_trials must be one whole number"),
        ("evs_steps", {"n_trials": "many"}, "n_trials must be one whole number"),
        ("evs_steps", {"n_trials": np.array([200, 200])}, "n_trials must be one whole number"),
        ("evs_steps", {"signal_dn": -4.0}, "signal_dn must be 0 or above"),
        ("evs_steps", {"contrast": np.array(["a", "b", "c"])}, "contrast must be"),
        ("evs_steps", {"contrast": np.array([0.1, np.nan, 0.3])}, "contrast must be"),
    ],
)
def test_counts_that_cannot_be(tmp_path, file, arrays, message):
    capture_sets.write_events(tmp_path / "set", size=16, trials=20000)
    steps = np.zeros((3, 16, 16), np.int64)
    np.savez(tmp_path / "set" / "evs_steps.npz", contrast=[-0.3, 0.0, 0.3], signal_dn=20.0, n_on=steps, n_off=steps,
             n_trials=200)  # fmt: skip
    capture_sets.change(tmp_path / "set" / f"{file}.npz", **arrays)
    refused(lambda: calibrate_evs(tmp_path / "set", tmp_path / "c.yaml"), rf"{file}\.npz: .*{message}")


def test_nothing_is_left_open(folder):
    """A thousand damaged files must not use up the files a process may have open."""
    before = len(os.listdir("/proc/self/fd"))
    (folder / "events.h5").write_bytes((folder / "events.h5").read_bytes()[:5000])
    (folder / "frames" / "000000.dng").write_bytes(b"II*\0")
    for _ in range(5):
        for call in (lambda: Recording.load(folder).events, lambda: Recording.load(folder).frames[0]):
            refused(call, "cannot be read")
    assert len(os.listdir("/proc/self/fd")) <= before + 1


@pytest.mark.parametrize("where", ["xml", "inline"])
def test_numbers_in_names_that_would_end_the_process(tmp_path, where):
    from hesim_render.sources.render.scene.builder import build
    from hesim_render.sources.render.scene.mitsuba_version import mitsuba

    body = "mitsuba: {file: main.xml}"
    if where == "inline":
        body = "mitsuba: {inline: {a: {type: sphere, '4611686018427387904': 1.0}, b: {type: constant}}}"
    file = scene_file(tmp_path, body)
    (tmp_path / "main.xml").write_text(
        '<scene version="3.0.0"><shape type="sphere"><float name="4611686018427387904" value="1"/></shape></scene>'
    )
    refused(lambda: build(mitsuba(), hr.load_scene(file, allow_outside=True).spec), "too large a number")

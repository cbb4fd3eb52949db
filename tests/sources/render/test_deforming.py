"""Meshes that change their shape, against the same motion of a rigid object, closed forms and NumPy."""

import json

import numpy as np
import pytest
from rendering import FURNACE, flux_image, make_scene, mono

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import mitsuba

CAMERA = {"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62}  # 0.8 m across at z = 0
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
SUN = {"type": "directional", "direction": [0.3, -0.4, -1], "illuminant": FURNACE["illuminant"], "irradiance_w_m2": 600}

FAR = {"name": "far", "shape": "sphere", "size_m": [0.1, 0.1, 0.1], "position_m": [0, 9, 0]}


def write_ply(path, vertices, faces=FACES):
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{x:.7g}" for x in vertex) for vertex in vertices]
    lines += ["3 " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join(lines) + "\n")


def plate(tmp_path, t_us, shapes, **keys):
    """A plate of 0.3 m × 0.2 m whose file has corners at ±1, as an object; its shapes in those coordinates."""
    write_ply(tmp_path / "plate.ply", CORNERS)
    np.savez(tmp_path / "shapes.npz", t_us=np.asarray(t_us), vertices=np.asarray(shapes))
    return {"name": "plate", "shape": "mesh", "mesh": str(tmp_path / "plate.ply"), "size_m": [0.3, 0.2, 0.0],
            "reflectance": 0.0, "deformation": {"file": str(tmp_path / "shapes.npz")}, **keys}  # fmt: skip


def scene_of(item, light=FURNACE, **sections):
    return make_scene(objects=[item], light=light, camera=CAMERA, **sections)


def test_a_plate_that_is_pushed_by_its_vertices_is_the_plate_that_moves(tmp_path):
    """In file coordinates 1 is 0.15 m along x and 0.1 m along y. Rays, wavelengths and slices are the same."""
    shift = np.array([0.8, -0.6, 0.0])
    item = plate(tmp_path, [0, 10_000], [CORNERS, CORNERS + shift])
    rigid = {key: value for key, value in item.items() if key != "deformation"}
    frames = [{"t_us": 0}, {"t_us": 10_000, "translation_m": [0.12, -0.06, 0.0]}]
    moved = scene_of(rigid, motion=[{"object": "plate", "keyframes": frames}])
    for begin, end in ((2000.0, 2100.0), (0.0, 5000.0), (12_000.0, 13_000.0)):
        images = [flux_image(scene, mono(), 16, begin_us=begin, end_us=end) for scene in (scene_of(item), moved)]
        (a, b, source), (c, d, other) = images
        np.testing.assert_array_equal(source.slice_edges_us(0, 10_000), other.slice_edges_us(0, 10_000))
        assert np.mean(~np.isclose(a + b, c + d, rtol=1e-4)) < 2e-3  # rays at a rim, by rounding of corners
        assert not np.allclose(a + b, flux_image(scene_of(rigid), mono(), 16)[0] * 2, rtol=0.1)


def test_a_plate_that_grows_hides_as_much_as_its_area_says(tmp_path):
    """Black on an even sky: what is missing is its area, 0.06 m² at first and four times as much at the end, in pixels
    of 12.5 mm. A slice has the shape of its middle.
    """
    item = plate(tmp_path, [0, 20_000], [CORNERS, 2 * CORNERS])
    sensor = mono()
    source = RenderedFlux(scene_of(item), sensor, 64, 3)
    pixel = np.arange(sensor.rows * sensor.cols, dtype=np.uint32)
    empty = RenderedFlux(make_scene(light=FURNACE, camera=CAMERA, objects=[FAR]), sensor, 2, 3)
    whole = np.array(empty.mean_flux(pixel, 0.0, 1.0)[0], dtype=np.float64)  # falls off towards the corners
    edges = [0.0, *source.slice_edges_us(0, 20_000), 20_000.0]
    assert len(edges) == 30  # the corners move by 0.18 m, 14.4 pixels
    for begin, end in (edges[:2], edges[14:16], (20_000.0, 30_000.0)):
        half_a, half_b = (np.array(half, dtype=np.float64) for half in source.mean_flux(pixel, begin, end))
        missing = float(np.sum(1 - (half_a + half_b) / 2 / whole))
        growth = 1 + np.clip((begin + end) / 2, 0, 20_000) / 20_000
        assert missing == pytest.approx(0.06 * growth**2 / 0.0125**2, rel=0.01)


def test_shapes_between_those_of_the_file_are_on_straight_lines(tmp_path):
    rng = np.random.default_rng(4)
    times = np.array([100, 1000, 1001, 5000])
    shapes = CORNERS + rng.normal(0, 0.3, (4, 4, 3))
    item = plate(tmp_path, times, shapes, position_m=[0.1, 0.2, 0.3], rotation_axis=[0, 0, 1], rotation_deg=90)
    placed = shapes * [0.15, 0.1, 1.0]
    placed = placed[..., [1, 0, 2]] * [-1, 1, 1] + [0.1, 0.2, 0.3]
    for repeat in (False, True):
        item["deformation"] = {**item["deformation"], "repeat": repeat}
        found = build(mitsuba(), scene_of(item).spec).deformations["plate"]
        asked = np.array([-50.0, 100.0, 700.0, 1000.4, 3333.0, 5000.0, 6000.0])
        wrapped = 100 + np.mod(asked - 100, 4900) if repeat else asked
        expected = np.array([[[np.interp(t, times, placed[:, k, axis]) for axis in range(3)] for k in range(4)]
                             for t in wrapped])  # fmt: skip
        np.testing.assert_allclose(found.at(asked), expected, atol=1e-6)


@pytest.mark.parametrize("track", [False, True])
def test_no_vertex_moves_farther_than_the_limit_within_a_slice(track, tmp_path):
    """Projected here by the pinhole alone. The middle vertex swings while its box hardly changes."""
    corners = np.concatenate([CORNERS, [[0, 0, 0]]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    swung = np.repeat(corners[None], 3, axis=0)
    swung[1, 4], swung[2, 4] = [0.9, 0.5, 0.4], [-0.9, 0.0, 0.0]
    item = plate(tmp_path, [0, 3000, 8000], swung)
    write_ply(tmp_path / "plate.ply", corners, faces)
    frames = [{"t_us": 0}, {"t_us": 6000, "rotation_axis": [0, 0, 1], "rotation_deg": 80}]
    motion = [{"object": "plate", "keyframes": frames}] if track else []
    scene = scene_of(item, motion=motion)
    source = RenderedFlux(scene, mono(), 2, 0)
    edges = np.concatenate([[0.0], source.slice_edges_us(0, 8000), [8000.0]])
    times = np.linspace(edges[:-1], edges[1:], 9, axis=1)  # [slice, time]
    places = np.array([[[np.interp(t, [0, 3000, 8000], swung[:, k, axis]) for axis in range(3)] for k in range(5)]
                       for t in times.ravel()]) * [0.15, 0.1, 1.0]  # fmt: skip
    if track:
        turn = np.radians(80) * np.clip(times.ravel(), 0, 6000) / 6000
        x, y, z = (places[..., axis] for axis in range(3))
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        places = np.stack([c * x - s * y, s * x + c * y, z], axis=-1)
    px = places[..., :2] / (2 - places[..., 2:]) * 2 / 0.0125
    px = px.reshape(*times.shape, 5, 2)
    moved = np.linalg.norm(px - px[:, :1], axis=-1).max(axis=(1, 2))
    assert moved.max() <= 0.5 * 1.05  # slices have equal lengths, and the fastest part is measured in 16 steps
    assert moved.max() > 0.4 and np.median(moved[moved > 0.05]) > 0.2


def test_a_smooth_mesh_is_shaded_by_the_normals_of_its_new_shape(tmp_path):
    """An egg turned by its vertices and the same egg turned by a track, both at rest then."""
    polar, around = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 17), np.arange(24) * np.pi / 12, indexing="ij")
    egg = np.stack([np.sin(polar) * np.cos(around), 0.5 * np.sin(polar) * np.sin(around), 0.7 * np.cos(polar)], axis=-1)
    row, col = (index.ravel() for index in np.mgrid[:16, :24])
    corner = [(row + r) * 24 + (col + c) % 24 for r, c in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([corner[k] for k in order], axis=1) for order in ((0, 1, 2), (0, 2, 3))])
    vertices = egg.reshape(-1, 3)
    c, s = np.cos(np.radians(50)), np.sin(np.radians(50))
    write_ply(tmp_path / "egg.ply", vertices, faces)
    np.savez(tmp_path / "egg.npz", t_us=[0, 1000], vertices=[vertices, vertices @ [[c, s, 0], [-s, c, 0], [0, 0, 1]]])
    size = np.ptp(vertices, axis=0) * 0.2
    item = {
        "name": "egg",
        "shape": "mesh",
        "mesh": str(tmp_path / "egg.ply"),
        "size_m": size.tolist(),
        "reflectance": 0.6,
    }
    turned = [{"t_us": 0}, {"t_us": 1000, "rotation_axis": [0, 0, 1], "rotation_deg": 50}]
    scenes = [
        scene_of({**item, "deformation": {"file": str(tmp_path / "egg.npz")}}, SUN),
        scene_of(item, SUN, motion=[{"object": "egg", "keyframes": turned}]),
        scene_of(item, SUN),
    ]
    own, rigid, before = (flux_image(scene, mono(), 32, begin_us=2000, end_us=2100)[0] for scene in scenes)
    assert np.mean(np.abs(own - rigid)) < 2e-3 * np.mean(rigid) < 0.05 * np.mean(np.abs(rigid - before))


def test_a_run_says_that_it_is_exact_and_names_the_files(tmp_path):
    item = plate(tmp_path, [0, 4000], [CORNERS, CORNERS + np.array([0.5, 0, 0])])
    item |= {"mesh": "plate.ply", "deformation": {"file": "shapes.npz"}}
    content = {"schema_version": 1, "name": "pushed", "description": "", "objects": [item], "light": FURNACE,
               "camera": CAMERA}  # fmt: skip
    (tmp_path / "scene.yaml").write_text(json.dumps(content))
    scene, sensor = hr.load_scene(tmp_path / "scene.yaml"), mono(16, 12, aps__exposure_us=1000)
    assert "moving: plate" in repr(scene)
    recording = hr.simulate(
        scene, sensor, duration_s=0.004, samples=4, out=tmp_path / "out", truth=["events"], progress=False
    )
    manifest = json.loads((tmp_path / "out" / "recording.json").read_text())
    assert recording.events.size > 0 and recording.event_labels.counts()["signal"] > 0
    assert set(manifest["scene"]["files_sha256"]) == {"plate.ply", "shapes.npz"}
    settings = hr.simulate(scene, sensor, duration_s=0.001, progress=False).manifest["settings"]
    assert settings["mode"] == "exact" and settings["exact_because"] == "object 'plate' changes its shape"
    with pytest.raises(SpecError, match="geometric truth follows rigid motion, and 'plate' changes its shape"):
        hr.simulate(scene, sensor, duration_s=0.001, truth=["depth"], progress=False)


def test_a_folder_of_meshes_is_the_same_as_their_numbers(tmp_path):
    shapes = [CORNERS, CORNERS * [1.5, 1, 1], CORNERS + np.array([0, 0.3, 0.1])]
    item = plate(tmp_path, [500, 800, 1100], shapes)
    (tmp_path / "frames").mkdir()
    for number, shape in enumerate(shapes):
        write_ply(tmp_path / "frames" / f"{number:03d}.ply", shape)
    folder = {**item, "deformation": {"file": str(tmp_path / "frames"), "every_us": 300, "begin_us": 500}}
    one, other = (build(mitsuba(), scene_of(each).spec).deformations["plate"] for each in (item, folder))
    np.testing.assert_array_equal(one.knots_us, other.knots_us)
    np.testing.assert_allclose(one.vertices_m, other.vertices_m, atol=1e-6)


MISTAKES = {
    "repeated": (
        {"t_us": [0, 5, 5], "vertices": [CORNERS] * 3},
        {},
        "times must increase by 1 µs or more: 5 µs follows 5",
    ),
    "vertices": ({"t_us": [0, 5], "vertices": [CORNERS[:3]] * 2}, {}, "as the mesh has 4 vertices"),
    "times": ({"t_us": [0, 5, 6], "vertices": [CORNERS] * 2}, {}, "expected [times] and [times, 4, 3]"),
    "one": ({"t_us": [0], "vertices": [CORNERS]}, {}, "a deformation needs at least two shapes"),
    "nan": ({"t_us": [0, 1], "vertices": [CORNERS, CORNERS * np.nan]}, {}, "has values that are not finite"),
    "no array": ({"t_us": [0, 1]}, {}, "holds no array 'vertices'"),
    "file": ({"t_us": [0]}, {"file": "none.npz"}, "no such file or folder"),
    "every": ({"t_us": [0]}, {"every_us": 5}, "every_us goes with a folder of meshes"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_deformation_is_one_line(mistake, tmp_path):
    arrays, keys, told = MISTAKES[mistake]
    item = plate(tmp_path, [0, 1], [CORNERS] * 2)
    np.savez(tmp_path / "shapes.npz", **{name: np.asarray(value) for name, value in arrays.items()})
    item |= {"mesh": "plate.ply", "deformation": {"file": "shapes.npz", **keys}}
    content = {"schema_version": 1, "name": "pushed", "description": "", "objects": [item], "light": FURNACE,
               "camera": CAMERA}  # fmt: skip
    (tmp_path / "scene.yaml").write_text(json.dumps(content))
    with pytest.raises(SpecError) as caught:
        build(mitsuba(), hr.load_scene(tmp_path / "scene.yaml").spec)
    assert told in str(caught.value) and len(str(caught.value).splitlines()) == 1


def test_other_faces_and_other_meshes_are_refused(tmp_path):
    (tmp_path / "frames").mkdir()
    write_ply(tmp_path / "frames" / "0.ply", CORNERS)
    write_ply(tmp_path / "frames" / "1.ply", CORNERS, FACES[:, ::-1])
    item = plate(tmp_path, [0, 1], [CORNERS] * 2)
    item["deformation"] = {"file": str(tmp_path / "frames"), "every_us": 300}
    with pytest.raises(
        SpecError, match=r"1.ply.*its faces are not those of the mesh, which has 4 vertices and 2 faces"
    ):
        build(mitsuba(), scene_of(item).spec)
    with pytest.raises(ValueError, match="it is for meshes of PLY and OBJ files"):
        scene_of({**item, "mesh": "plate.stl"})

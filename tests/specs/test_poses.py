"""Trajectories from files: the same motion as keyframes, and one line for each mistake."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.camera import look_at
from hesim_render.sources.render.scene.trajectory import Trajectory

SCENE = """\
schema_version: 1
name: moving
description: a camera on a recorded path
target: {type: flat, position_m: [0, 0, -1]}
light: {type: uniform, illuminance_lux: 100}
camera: {origin_m: [0, 0, 0], target_m: [0, 0, -1]}
motion:
  - {object: camera, %s}
"""
#: A turn by 90° about y with a move, then a turn by 40° about x.
HALF = np.sqrt(0.5)
ROWS = [
    (0, 0, 0, 0, 0, 0, 0, 1),
    (0.01, 1, 2, 3, 0, HALF, 0, HALF),
    (0.025, 1, 2, 4, np.sin(0.349), 0, 0, np.cos(0.349)),
]


def track(tmp_path, name, text, keys=""):
    (tmp_path / name).write_text(text)
    (tmp_path / "scene.yaml").write_text(SCENE % f"file: {name}{keys}")
    return hr.load_scene(tmp_path / "scene.yaml").spec.motion[0]


def text_of(is_csv):
    if is_csv:
        lines = [",".join(map(str, (round(1e6 * row[0]), *row[1:]))) for row in ROWS]
        return "# a path\nt_us,x_m,y_m,z_m,qx,qy,qz,qw\n" + "\n".join(lines)
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(" ".join(map(str, row)) for row in ROWS)


@pytest.mark.parametrize("name", ["path.csv", "path.tum", "path.txt"])
def test_poses_of_a_file_are_reached_at_their_times(name, tmp_path):
    spec = track(tmp_path, name, text_of(name.endswith("csv")))
    found = Trajectory(spec).matrix(np.array([0.0, 10_000.0, 25_000.0]))
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    turned = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(found[1], turned, atol=1e-9)
    c, s = np.cos(0.698), np.sin(0.698)
    np.testing.assert_allclose(found[2], [[1, 0, 0, 1], [0, c, -s, 2], [0, s, c, 4], [0, 0, 0, 1]], atol=1e-9)


def test_poses_in_the_axes_of_opencv_turn_the_camera_at_rest_into_theirs(tmp_path):
    """A pose of OpenCV without rotation looks along +z with y downwards."""
    text = "0 0 0 0 0 0 0 1\n0.01 0.5 0 0 0 0 0 1\n"
    spec = track(tmp_path, "path.tum", text, ", axes: opencv")
    at_rest = look_at((0, 0, 0), (0, 0, -1), (0, 1, 0))
    camera = Trajectory(spec).matrix(10_000.0) @ at_rest
    np.testing.assert_allclose(camera[:3, 3], [0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(-camera[:3, 2], [0, 0, 1], atol=1e-12)  # forward
    np.testing.assert_allclose(-camera[:3, 1], [0, 1, 0], atol=1e-12)  # down


def test_the_manifest_has_the_numbers_and_not_the_file(tmp_path):
    spec = track(tmp_path, "path.csv", text_of(True))
    dumped = spec.model_dump(mode="json")
    assert "path.csv" not in str(dumped) and len(dumped["keyframes"]) == 3


MISTAKES = {
    "repeated": ("path.tum", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n", "path.tum:3: times must increase"),
    "backwards": ("path.tum", "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "path.tum:2: times must increase by 1 µs or more"),
    "columns": ("path.tum", "0 0 0 0 0 0 1\n", "path.tum:1: expected a time, three coordinates and a quaternion"),
    "text": ("path.tum", "0 0 0 zero 0 0 0 1\n", "path.tum:1: expected a time"),
    "length": ("path.tum", "0 0 0 0 0 0 0 2\n", "path.tum:1: a quaternion must have the length 1; this one has 2"),
    "one": ("path.tum", "0 0 0 0 0 0 0 1\n", "path.tum: a trajectory needs at least two poses"),
    "header": ("path.csv", "t,x,y,z\n", "path.csv:1: the header must be t_us,x_m,y_m,z_m,qx,qy,qz,qw"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_file_is_one_line(mistake, tmp_path):
    name, text, told = MISTAKES[mistake]
    with pytest.raises(SpecError) as caught:
        track(tmp_path, name, text)
    assert told in str(caught.value) and "scene.yaml:8" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ("file: none.tum", "no such file: "),
        ("file: ../path.tum", "lies outside of the scene's folder"),
        ("file: path.tum, axes: ros", "expected scene or opencv"),
        ("axes: opencv", "give keyframes or file, exactly one of them"),
        ("file: path.tum, keyframes: [{t_us: 0}, {t_us: 1}]", "give keyframes or file, exactly one of them"),
    ],
)
def test_a_wrong_track_is_one_line(keys, told, tmp_path):
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    (tmp_path / "scene.yaml").write_text(SCENE % keys)
    with pytest.raises(SpecError) as caught:
        hr.load_scene(tmp_path / "scene.yaml")
    assert told in str(caught.value) and "scene.yaml:8" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1

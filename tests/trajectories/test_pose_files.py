"""Trajectories from files: the same motion as keyframes, and one line for each mistake."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.camera import look_at
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.trajectories.pose_files import PoseFile, read_poses

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


#: Of the EuRoC data sets: ns since 1970, scalar first, further columns.
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x []\n"
    "1403636579763555584,0,0,0,1,0,0,0,0.5\n"
    f"1403636579773556384,1,2,3,{HALF},0,{HALF},0,0.5\n"
)


def test_a_file_of_euroc_has_whole_nanoseconds_and_the_scalar_first(tmp_path):
    spec = track(tmp_path, "data.csv", EUROC, ", begin_us: 500")
    # 763555.584 and 773556.384 µs after the second; float64 has steps of 256 ns there
    assert [frame.t_us for frame in spec.keyframes] == [500, 500 + 10_000]
    turned = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(Trajectory(spec).matrix(10_500.0), turned, atol=1e-9)


def test_kalibr_writes_x_y_z_w_of_the_inverse_rotation_under_that_header(tmp_path):
    """quat2r of its `quaternion_algebra.cpp`, for a turn by 90° about y: R(2,0) = -1 = 2·q0·q2 + 2·q1·q3."""
    text = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    text += f"0,0,0,0,0.0,0.0,0.0,1.0\n10000000,1,2,3,0.0,{-HALF},0.0,{HALF}\n"
    spec = track(tmp_path, "poses.csv", text, ", quaternion: kalibr")
    turned = [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(Trajectory(spec).matrix(10_000.0), turned, atol=1e-9)


@pytest.mark.parametrize("ending", ["yaml", "json"])
def test_poses_of_opencv_put_points_where_opencv_projects_them(ending, tmp_path):
    """Written by OpenCV itself; `cv2.projectPoints` against a camera and against a board on such a track."""
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(3)
    rvecs, tvecs = rng.normal(0, 0.3, (2, 3)), rng.normal(0, 0.1, (2, 3))
    tvecs[:, 2] += 1
    file = cv2.FileStorage(str(tmp_path / f"poses.{ending}"), cv2.FILE_STORAGE_WRITE)
    file.write("rvecs", rvecs)
    file.write("tvecs", tvecs[:, None])  # as three channels of one column
    file.write("t_us", np.array([0.0, 10_000.0]))
    file.release()
    points = rng.uniform(-0.2, 0.2, (7, 3)) * [1, 1, 0]  # on the board, in the axes of scenes
    expected = cv2.projectPoints(points * [1, -1, -1], rvecs[1], tvecs[1], np.eye(3), None)[0][:, 0]
    for name in ("camera", "target"):
        text = (SCENE % f"file: poses.{ending}").replace("object: camera", f"object: {name}")
        (tmp_path / "scene.yaml").write_text(text)
        pose = Trajectory(hr.load_scene(tmp_path / "scene.yaml").spec.motion[0]).matrix(10_000.0)
        matrix = np.linalg.inv(pose) if name == "camera" else pose  # the other one rests at the origin
        x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
        np.testing.assert_allclose(np.stack([x / -z, -y / -z], axis=1), expected, atol=1e-9)


def test_opencv_files_without_times_have_even_ones(tmp_path):
    (tmp_path / "out.yml").write_text(
        "%YAML:1.0\n---\nextrinsic_parameters: !!opencv-matrix\n   rows: 2\n   cols: 6\n"
        "   dt: d\n   data: [ 0., 0., 0., 0., 0., 1., 0., 0., 0., 0.5, 0., 1. ]\n"
    )
    (tmp_path / "scene.yaml").write_text(SCENE % "file: out.yml, every_us: 2000, begin_us: 300")
    spec = hr.load_scene(tmp_path / "scene.yaml").spec.motion[0]
    assert [frame.t_us for frame in spec.keyframes] == [300, 2300]
    moved = Trajectory(spec).matrix(np.array([300.0, 2300.0]))[:, :3, 3]
    np.testing.assert_allclose(moved, [[0, 0, 1], [-0.5, 0, 1]], atol=1e-12)  # the camera is in front of the board


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
    "dates": ("path.tum", "1305031102 0 0 0 0 0 0 1\n1305031103 0 0 0 0 0 0 1\n", "path.tum:1: its times are dates"),
    "euroc": ("path.csv", "#timestamp,p_RS_R_x [m]\n0,0\n", "path.csv:1: the header of a EuRoC file begins with"),
    "euroc numbers": (
        "path.csv",
        EUROC.split("\n")[0] + "\n0,0,0\n",
        "path.csv:2: expected a time, three coordinates and a quaternion (w, x, y, z)",
    ),
    "no matrices": ("path.yaml", "%YAML:1.0\n---\na: 1\n", "path.yaml: expected rvecs and tvecs, or extrinsic_"),
    "no times": (
        "path.json",
        '{"rvecs": [[0,0,0],[0,0,0]], "tvecs": [[0,0,1],[0,0,1]]}',
        "give the times of its poses",
    ),
    "uneven": (
        "path.json",
        '{"rvecs": [[0,0,0]], "tvecs": [[0,0,1],[0,0,1]], "t_us": [0,1]}',
        "has 1 rvecs and 2 tvecs",
    ),
    "ragged": ("path.json", '{"rvecs": [[0,0,0],[0,0]], "tvecs": [0,0,1]}', "rvecs: expected rows of 3 numbers"),
    "no json": ("path.json", "{", "path.json: cannot be read as JSON"),
    "repeated in opencv": (
        "path.json",
        '{"extrinsic_parameters": [[0,0,0,0,0,1],[0,0,0,0,0,1]], "t_us": [5, 5]}',
        "path.json: times must increase by 1 µs or more: 5 µs follows 5 µs",
    ),
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
        ("file: path.tum, quaternion: ros", "quaternion: expected hamilton or kalibr"),
        ("file: path.tum, begin_us: soon", "begin_us: expected a whole number of microseconds"),
        ("file: path.tum, every_us: 100", "every_us is for files of OpenCV"),
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


@pytest.mark.parametrize(("length", "is_right"), [(0.9901, True), (1.0099, True), (0.9899, False), (1.0101, False)])
def test_rounding_is_allowed_to_a_quaternion_in_both_directions(length, is_right, tmp_path):
    """A hundredth of its length; the rotation is that of the quaternion of length 1."""
    half = length * HALF
    (tmp_path / "path.tum").write_text(f"0 0 0 0 0 0 0 1\n1 0 0 0 0 {half:.9f} 0 {half:.9f}\n")
    if not is_right:
        with pytest.raises(SpecError, match=f"must have the length 1; this one has {length:.4g}"):
            read_poses(tmp_path / "path.tum")
        return
    found = np.array(read_poses(tmp_path / "path.tum")[1]["matrix"])
    np.testing.assert_allclose(found[:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-8)


@pytest.mark.parametrize(("last_us", "begin_us", "is_right"), [
    (10**13, None, True), (10**13 + 1, None, False), (10**13 + 7, 1, True), (10**13 + 8, 1, True),
    (10**13 + 9, 1, False), (4 * 10**13, 0, False),
])  # fmt: skip
def test_times_beyond_116_days_are_dates(last_us, begin_us, is_right, tmp_path):
    """10 million seconds, counted from the begin that was asked for."""
    rows = "".join(f"{t},0,0,0,0,0,0,1\n" for t in (9, last_us))
    (tmp_path / "path.csv").write_text(f"t_us,x_m,y_m,z_m,qx,qy,qz,qw\n{rows}")
    how = PoseFile(begin_us=begin_us)
    if is_right:
        begin = 9 if begin_us is None else begin_us
        assert [pose["t_us"] for pose in read_poses(tmp_path / "path.csv", how)] == [begin, last_us - 9 + begin]
    else:
        with pytest.raises(SpecError, match="its times are dates, from 9 µs on"):
            read_poses(tmp_path / "path.csv", how)


def test_nanoseconds_are_rounded_to_the_next_microsecond(tmp_path):
    """Whole ones exactly, also where float64 has no such number; halves up."""
    header = "#timestamp,p_RS_R_x [m],p_RS_R_y,p_RS_R_z,q_RS_w,q_RS_x,q_RS_y,q_RS_z\n"
    times = (1403636579758555499, 1403636579758556500, 1403636579758558499)
    (tmp_path / "path.csv").write_text(header + "".join(f"{t},0,0,0,1,0,0,0\n" for t in times))
    found = read_poses(tmp_path / "path.csv", PoseFile(begin_us=0))
    assert [pose["t_us"] for pose in found] == [0, 2, 3]

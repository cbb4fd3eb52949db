"""Trajectory files: times with a pose each, as CSV, TUM, EuRoC, Kalibr and OpenCV write them."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import WholeFile, reading
from hesim_render.core.units import US_PER_S
from hesim_render.core.yaml_file import parse_yaml

#: Columns of a CSV file of this package; those of TUM files are the same, with the time in seconds.
CSV_COLUMNS = ("t_us", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
#: Columns with which EuRoC's files begin, without their units; the scalar comes first and times are in ns.
_EUROC = ("#timestamp", "p_rs_r_x", "p_rs_r_y", "p_rs_r_z", "q_rs_w", "q_rs_x", "q_rs_y", "q_rs_z")
#: Suffixes of files that OpenCV's `FileStorage` writes.
_OPENCV = (".yaml", ".yml", ".json")
#: Largest deviation of a quaternion's length from 1 that counts as rounding.
_UNIT = 1e-2
#: Later times are taken for dates, µs: 116 days.
_A_DATE_US = 10**13
#: From OpenCV's axes (y down, view along +z) to those of this package (y up, view along -z), and back.
_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


class PoseFile(NamedTuple):
    """How a trajectory file is read.

    Parameters
    ----------
    axes : ``scene``: x to the right, y up, view along -z; ``opencv``: x to the right, y down, view along +z.
    quaternion : ``hamilton``, or ``kalibr``: x, y, z, w of the inverse rotation, whatever the header of the file says.
    begin_us : time of the first pose, µs; None: as in the file.
    every_us : time from pose to pose of a file without times, µs.
    """

    axes: str = "scene"
    quaternion: str = "hamilton"
    begin_us: int | None = None
    every_us: int | None = None


#: A file of this package's axes, with times as they are.
AS_IN_THE_FILE = PoseFile()


def read_poses(file: Path, how: PoseFile = AS_IN_THE_FILE, of_camera: bool = False) -> list[dict[str, Any]]:
    """Keyframes of a trajectory file, as they may stand in a scene file. Times are rounded to whole microseconds.

    A CSV file has the header ``t_us,x_m,y_m,z_m,qx,qy,qz,qw``, or that of the EuRoC data sets (time in ns, scalar
    first; further columns are not used). A YAML or JSON file is one of OpenCV's, see `_opencv`. Any other file is one
    of the TUM RGB-D benchmark: time in seconds and the same seven numbers, separated by blanks. Other lines that begin
    with ``#`` are comments.

    Parameters
    ----------
    file, how : the file, and how it is read.
    of_camera : True for the motion of the camera, False for that of an object.

    Raises
    ------
    SpecError
        If the file is not valid or times do not increase; the message names file and line.
    """
    if file.suffix.lower() in _OPENCV:
        lines, times, poses = _opencv(file, how, of_camera)
    else:
        if how.every_us is not None:
            raise SpecError("every_us is for files of OpenCV, which have no times; this one has its own", file=file)
        lines, times, poses = _rows(file, how.quaternion)
        poses = poses @ _FROM_OPENCV if how.axes == "opencv" else poses
    if len(times) < 2:
        raise SpecError("a trajectory needs at least two poses", file=file)
    for line, before, after in zip(lines[1:], times[:-1], times[1:], strict=True):
        if after <= before:
            raise SpecError(
                f"times must increase by 1 µs or more: {after} µs follows {before} µs", file=file, line=line
            )
    shift = 0 if how.begin_us is None else how.begin_us - times[0]
    if abs(times[-1] + shift) > _A_DATE_US:
        raise SpecError(f"its times are dates, from {times[0]} µs on; begin_us: 0 lets the first pose be at the "
                        "start of the run", file=file, line=lines[0])  # fmt: skip
    return [{"t_us": t + shift, "matrix": pose.tolist()} for t, pose in zip(times, poses, strict=True)]


_PoseRows = tuple[list[int | None], list[int], NDArray[np.float64]]


def _rows(file: Path, quaternion: str) -> _PoseRows:
    """Lines, times in µs and poses [n, 4, 4] of a file with one pose in a line."""
    every = [(number, line.strip()) for number, line in enumerate(WholeFile(file).text().splitlines(), 1)]
    is_csv = file.suffix.lower() == ".csv"
    rows = [(number, line) for number, line in every if line and not line.startswith("#")]
    euroc = next((row for row in every if row[1].lower().startswith(_EUROC[0])), None) if is_csv else None
    if euroc is not None:
        header = tuple(cell.split("[")[0].strip().lower() for cell in euroc[1].split(","))
        if header[: len(_EUROC)] != _EUROC:
            raise SpecError(f"the header of a EuRoC file begins with {', '.join(_EUROC)}", file=file, line=euroc[0])
    elif is_csv:
        first = rows.pop(0) if rows else (1, "")
        if tuple(cell.strip() for cell in first[1].split(",")) != CSV_COLUMNS:
            expected = f"the header must be {','.join(CSV_COLUMNS)}, or that of a EuRoC file"
            raise SpecError(expected, file=file, line=first[0])
    lines: list[int | None] = []
    times, numbers = [], []
    for number, line in rows:
        cells = line.split("#", 1)[0].split("," if is_csv else None)
        values = _numbers(cells if euroc is None else cells[: len(_EUROC)], file, number, euroc is not None)
        if euroc is None:
            times.append(round(values[0] * (1 if is_csv else US_PER_S)))
        else:  # whole nanoseconds exceed the exact range of float64
            times.append((int(cells[0]) + 500) // 1000 if cells[0].strip().isdigit() else round(values[0] / 1000))
        lines.append(number)
        numbers.append(values)
    table = np.array(numbers).reshape(-1, len(CSV_COLUMNS))
    turn = table[:, 4:]
    if quaternion == "kalibr":
        turn = turn * [-1, -1, -1, 1]
    elif euroc is not None:
        turn = turn[:, [1, 2, 3, 0]]
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    if len(table):
        poses[:, :3, :3] = Rotation.from_quat(turn).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return lines, times, poses


def _numbers(cells: list[str], file: Path, line: int, is_euroc: bool) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != len(CSV_COLUMNS) or not np.isfinite(values).all():
        order = "w, x, y, z" if is_euroc else "x, y, z, w"
        raise SpecError(f"expected a time, three coordinates and a quaternion ({order})", file=file, line=line)
    length = float(np.linalg.norm(values[4:]))
    if abs(length - 1) > _UNIT:
        raise SpecError(f"a quaternion must have the length 1; this one has {length:.4g}", file=file, line=line)
    return values


def _opencv(file: Path, how: PoseFile, of_camera: bool) -> _PoseRows:
    """Poses of a file of OpenCV's `FileStorage`: ``rvecs`` and ``tvecs`` [n, 3] of `cv2.calibrateCamera`, or
    ``extrinsic_parameters`` [n, 6], and perhaps ``t_us`` [n].

    They take points of a board, in the axes of OpenCV, to those of the camera. A camera therefore gets their inverse,
    around a board in the plane z = 0; an object gets the pose itself, in front of a camera at rest at the origin.
    """
    if how.axes != "scene" or how.quaternion != "hamilton":
        raise SpecError("axes and quaternion are not for files of OpenCV, which have no choice of them", file=file)
    text = WholeFile(file).text()
    if file.suffix.lower() == ".json":
        with reading(file, "as JSON"):
            content = json.loads(text)
    else:
        # the directive %YAML:1.0 of OpenCV is not valid YAML, and its tags only repeat what the keys say
        plain = re.sub(r"!!opencv-(nd-)?matrix", "", re.sub(r"\A%YAML[^\n]*\n(---)?", "", text))
        content = parse_yaml(plain, file, with_lines=False)
    if not isinstance(content, Mapping):
        raise SpecError("expected a mapping of names to matrices at the top level", file=file)
    if "extrinsic_parameters" in content:
        both = _matrix(content, "extrinsic_parameters", 6, file)
    elif "rvecs" in content and "tvecs" in content:
        parts = [_matrix(content, key, 3, file) for key in ("rvecs", "tvecs")]
        if len(parts[0]) != len(parts[1]):
            raise SpecError(f"has {len(parts[0])} rvecs and {len(parts[1])} tvecs", file=file)
        both = np.hstack(parts)
    else:
        raise SpecError(
            "expected rvecs and tvecs, or extrinsic_parameters, as OpenCV's calibration has them", file=file
        )
    if ("t_us" in content) == (how.every_us is not None):
        raise SpecError(
            "give the times of its poses: t_us in the file or every_us of the track, one of them", file=file
        )
    if how.every_us is not None:
        times = [how.every_us * number for number in range(len(both))]
    else:
        times = [round(t) for t in _matrix(content, "t_us", 1, file).ravel().tolist()]
        if len(times) != len(both):
            raise SpecError(f"has {len(times)} times and {len(both)} poses", file=file, key="t_us")
    poses = np.tile(np.eye(4), (len(both), 1, 1))
    if len(both):
        poses[:, :3, :3] = Rotation.from_rotvec(both[:, :3]).as_matrix()
    poses[:, :3, 3] = both[:, 3:]
    wanted = np.asarray(np.linalg.inv(poses) if of_camera else poses, dtype=np.float64)
    return [None] * len(times), times, _FROM_OPENCV @ wanted @ _FROM_OPENCV


def _matrix(content: Mapping[str, Any], key: str, width: int, file: Path) -> NDArray[np.float64]:
    """A matrix of OpenCV, a list of them, or plain numbers, as rows of a width."""

    def numbers(node: Any) -> Any:
        if isinstance(node, Mapping):
            return node.get("data", [])
        return [numbers(item) for item in node] if isinstance(node, list) else node

    try:
        result = np.array(numbers(content[key]), dtype=np.float64)
        rows = result.reshape(-1, width)
    except (TypeError, ValueError):
        rows = np.full((1, width), np.nan)
    if not np.isfinite(rows).all():
        raise SpecError(f"expected rows of {width} numbers", file=file, key=key)
    return rows

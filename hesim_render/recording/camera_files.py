"""Cameras and targets in the calibration files of OpenCV and Kalibr."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.output import output_errors
from hesim_render.core.yaml_file import yaml_text
from hesim_render.sources.render.truth.poses import CameraModel
from hesim_render.sources.render.truth.raster import Grid
from hesim_render.sources.render.truth.scene_truth import SceneTruth


def write_opencv_camera(path: str | Path, camera: CameraModel) -> Path:
    """Write a camera as `cv2.FileStorage` reads it: camera matrix, distortion coefficients, size; returns the file.

    Parameters
    ----------
    path : YAML file to write.
    camera : the camera, as from `SceneTruth.camera`. Coefficients of a ``fisheye`` belong to `cv2.fisheye`.
    """
    target = Path(path)
    matrices = {"camera_matrix": camera.k, "distortion_coefficients": np.atleast_2d([*camera.distortion] or [0.0] * 5)}
    lines = ["%YAML:1.0", "---", f"image_width: {camera.width}", f"image_height: {camera.height}"]
    lines += [f"distortion_model: {camera.distortion_model}"]
    for name, matrix in matrices.items():
        rows, cols = matrix.shape
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d"]
        lines += [f"   data: [ {', '.join(f'{value:.17g}' for value in matrix.ravel())} ]"]
    with output_errors(target):
        target.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return target


def _kalibr_camera(
    camera: CameraModel, topic: str, from_imu: NDArray[np.float64], from_previous: NDArray[np.float64] | None
) -> dict[str, Any]:
    k, given = camera.k, camera.distortion
    if camera.distortion_model == "opencv" and any(given[4:]):
        raise SpecError("Kalibr's radtan has k1, k2, p1 and p2 only, not k3 to k6", key="lens.distortion")
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [k[0, 0], k[1, 1], k[0, 2], k[1, 2]],
        "distortion_model": "equidistant" if camera.distortion_model == "fisheye" else "radtan",
        "distortion_coeffs": [*given, 0.0, 0.0, 0.0, 0.0][:4],
        "resolution": [camera.width, camera.height],
        "rostopic": topic,
        "T_cam_imu": from_imu.tolist(),
        "timeshift_cam_imu": 0.0,
    }
    return entry if from_previous is None else {**entry, "T_cn_cnm1": from_previous.tolist()}


def write_kalibr_camchain(path: str | Path, truths: Sequence[SceneTruth], grids: Sequence[Grid]) -> Path:
    """Write the cameras of a rig for Kalibr; the inertial unit is in the first one; returns the file.

    Parameters
    ----------
    path : YAML file to write.
    truths : scene of each camera, as from `rig_scenes`.
    grids : grid of each, ``mosaic`` or ``events``.

    Raises
    ------
    SpecError
        If a lens has a distortion that Kalibr does not know.
    """
    target, poses = Path(path), [truth.camera_pose(0.0) for truth in truths]
    chain = {}
    for number, (truth, grid, pose) in enumerate(zip(truths, grids, poses, strict=True)):
        before = None if number == 0 else np.linalg.inv(pose) @ poses[number - 1]
        topic, from_imu = f"/cam{number}/image_raw", np.linalg.inv(pose) @ poses[0]
        chain[f"cam{number}"] = _kalibr_camera(truth.camera(grid), topic, from_imu, before)
    with output_errors(target):
        write_kalibr(target, chain)
    return target


def write_kalibr_aprilgrid(
    path: str | Path, tag_cols: int, tag_rows: int, tag_size_m: float, tag_spacing: float
) -> Path:
    """Write the description of an AprilGrid for Kalibr; returns the file.

    Parameters
    ----------
    path : YAML file to write.
    tag_cols, tag_rows : number of tags.
    tag_size_m : edge of a tag, m.
    tag_spacing : gap between tags over their edge.

    Raises
    ------
    RangeError
        If a number is not above 0.
    """
    values = {"tagCols": tag_cols, "tagRows": tag_rows, "tagSize": tag_size_m, "tagSpacing": tag_spacing}
    for name, value in values.items():
        if not 0 < value < float("inf"):
            raise RangeError(name, value, "a number above 0")
    target = Path(path)
    with output_errors(target):
        write_kalibr(target, {"target_type": "aprilgrid", **values})
    return target


def write_kalibr(path: Path, content: dict[str, Any]) -> None:
    """Write plain values as YAML, each list on one line."""
    path.write_text(yaml_text(json.loads(json.dumps(content)), width=200), encoding="utf-8")

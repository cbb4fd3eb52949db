"""Geometric truth in formats that others read: EXR, flow of DSEC, trajectories of TUM, cameras, boxes and masks.

Every format is a folder with ``export.json``, which states what was written. docs/ground-truth.md has the conventions.
"""

import csv
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hesim_render.core.errors import RangeError, SpecError, did_you_mean
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.core.units import S_PER_US
from hesim_render.recording.box_export import write_coco, write_dsec_det, write_prophesee_boxes
from hesim_render.recording.camera_files import write_kalibr, write_kalibr_camchain, write_opencv_camera
from hesim_render.recording.recorded import Recorded
from hesim_render.recording.truth_file import IMAGES, POSE_STEP_US, images_at
from hesim_render.sources.render.truth.imu import ImuModel
from hesim_render.sources.render.truth.raster import Grid
from hesim_render.sources.render.truth.scene_truth import SceneTruth

MARKER = "export.json"
#: DSEC's flow: 16 bit, 1/128 px, zero at 2¹⁵; interval of its flow, µs.
_DSEC_ZERO, _DSEC_STEPS, DSEC_EVERY_US = 1 << 15, 128.0, 100_000


def export_truth(
    recording: Recorded, format_: str, out: str | Path, *, every_us: int | None = None, overwrite: bool = False
) -> Path:
    """Write the geometric truth of a recording in a format that others read; returns the folder.

    Parameters
    ----------
    recording : the recording.
    format_ : ``exr``: images of every frame; ``dsec-flow``: forward flow of the event pixels; ``tum``: trajectories of
        camera and objects; ``kalibr``: cameras and the inertial unit; ``opencv``: cameras for `cv2.FileStorage`;
        ``prophesee-boxes`` and ``dsec-det``: boxes and tracks on the event grid; ``coco``: boxes and masks of frames.
    out : folder to write.
    every_us : interval of flow (default 100 000), of poses (default 1000) or of boxes (default 50 000), µs.
    overwrite : replace an existing export.

    Raises
    ------
    RangeError
        If the format is unknown, or the interval does not fit it or the recording.
    SpecError
        If the scene of the recording is not known.
    OutputError
        If the folder exists or cannot be written.
    """
    write = FORMATS.get(format_)
    if write is None:
        raise RangeError("format", format_, f"one of {', '.join(FORMATS)}{did_you_mean(format_, FORMATS)}")
    if every_us is not None and format_ not in _TIMED:
        raise RangeError("every_us", every_us, f"no interval: {format_} has none")
    if every_us is not None and not 1 <= every_us <= recording.duration_us:
        raise RangeError("every_us", every_us, f"1 to {recording.duration_us} µs, the length of the recording")
    truth = recording.truth
    with OutputFolder(out, MARKER, overwrite) as folder, output_errors(folder.target):
        facts = write(recording, truth, folder.path, every_us)
        text = json.dumps({"format": format_, **facts}, indent=2, ensure_ascii=False)
        (folder.path / MARKER).write_text(text + "\n", encoding="utf-8")
    return folder.target


# ---- EXR -----------------------------------------------------------------------------------------------------------

#: Channels of each image, by the name of its data set.
_XYZ, _UV = ("X", "Y", "Z"), ("u", "v")
_CHANNELS = {
    "depth_m": ("Z",),
    "distance_m": ("distance",),
    "normal": tuple(f"normal.{axis}" for axis in _XYZ),
    "position_m": tuple(f"position.{axis}" for axis in _XYZ),
    "object": ("object",),
    "instance": ("instance",),
    "material": ("material",),
    "mixed": ("mixed",),
    "flow_forward_px": tuple(f"forward.{axis}" for axis in _UV),
    "flow_backward_px": tuple(f"backward.{axis}" for axis in _UV),
    "visible_forward": ("forward.visible",),
    "visible_backward": ("backward.visible",),
}


def _exr(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    import OpenEXR

    frames = recording.manifest["frames"]
    rows = np.array([_row_times_us(frame, truth.sensor.rows) for frame in frames])
    for number in range(len(frames)):
        channels = {}
        for name, image in images_at(truth, "mosaic", IMAGES, rows, number):
            kind = np.float32 if image.dtype.kind == "f" else np.uint32
            layers = image[..., None] if image.ndim == 2 else image
            for k, channel in enumerate(_CHANNELS[name]):
                channels[channel] = np.ascontiguousarray(layers[..., k], dtype=kind)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(folder / f"{number:06d}.exr"))
    names = {kind: list(getattr(truth.names, kind)) for kind in ("objects", "instances", "materials")}
    return {"frames": len(frames), "names": names, "camera": truth.camera().as_dict()}


def _row_times_us(frame: dict[str, Any], rows: int) -> NDArray[np.float64]:
    """As `Frame.row_times_us`, from the manifest."""
    middle = float(frame["exposure_start_us"] + frame["exposure_us"] / 2)
    return np.asarray(middle + np.arange(rows) * frame["line_time_us"], dtype=np.float64)


# ---- flow of DSEC --------------------------------------------------------------------------------------------------


def dsec_flow_image(flow_px: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Flow in the encoding of DSEC [gehrig2021]: red and green are 2¹⁵ + 128·flow, blue is 1 where the flow is valid.

    Parameters
    ----------
    flow_px : [row, col, 2], px, to the right and downwards; NaN where there is none.

    Returns
    -------
    uint16 [row, col, 3]; flow that is not finite or outside of ±256 px is not valid, and 0.
    """
    steps = np.rint(flow_px.astype(np.float64) * _DSEC_STEPS) + _DSEC_ZERO
    valid = np.all(np.isfinite(steps) & (steps >= 0) & (steps < 1 << 16), axis=-1)
    image = np.zeros((*valid.shape, 3), np.uint16)
    image[valid, :2] = steps[valid]
    image[valid, 2] = 1
    return image


def _png16(path: Path, image: NDArray[np.uint16]) -> None:
    """Write [row, col, 3] as a PNG of 16 bits."""
    import av

    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb48le").reformat(format="rgb48be")
    codec: Any = av.CodecContext.create("png", "w")
    codec.width, codec.height, codec.pix_fmt, codec.time_base = frame.width, frame.height, "rgb48be", Fraction(1)
    path.write_bytes(b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)]))


def _dsec_flow(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    step = every_us or min(DSEC_EVERY_US, recording.duration_us)
    times = np.arange(0, recording.duration_us + 1, step)
    (folder / "forward").mkdir()
    with (folder / "forward_timestamps.txt").open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["# from_timestamp_us", " to_timestamp_us"])
        for number, (begin, end) in enumerate(zip(times[:-1], times[1:], strict=True)):
            flow = truth.flow(float(begin), float(end), "events")
            _png16(folder / "forward" / f"{number:06d}.png", dsec_flow_image(flow.flow_px))
            table.writerow([int(begin), f" {int(end)}"])
    return {"every_us": int(step), "camera": truth.camera("events").as_dict()}


# ---- trajectories --------------------------------------------------------------------------------------------------


def tum_lines(t_us: NDArray[np.float64], poses: NDArray[np.float64]) -> list[str]:
    """Lines of TUM's format: time in s, position in m, unit quaternion with the real part last.

    Parameters
    ----------
    t_us : [n], µs.
    poses : [n, 4, 4], to world.

    Raises
    ------
    SpecError
        If a pose mirrors, as that of a Mitsuba camera may.
    """
    if np.any(np.linalg.det(poses[:, :3, :3]) <= 0):
        raise SpecError(
            "the camera's to_world mirrors its picture, which no quaternion says; the other formats have it"
        )
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.concatenate([poses[:, :3, 3], quaternion], axis=1)
    return [
        f"{t * S_PER_US:.6f} " + " ".join(f"{value:.9g}" for value in row) for t, row in zip(t_us, rows, strict=True)
    ]


def _tum(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    times = np.arange(0, recording.duration_us + 1, every_us or POSE_STEP_US, dtype=np.float64)
    files = {"camera.txt": ("camera in world", truth.camera_pose(times))}
    for number, (name, poses) in enumerate(truth.object_poses(times).items(), start=1):
        files[f"object_{number:03d}.txt"] = (f"{name}: from its place in the scene file to its place in world", poses)
    for name, (what, poses) in files.items():
        head = ["# " + " ".join(what.split()), "# timestamp tx ty tz qx qy qz qw"]
        (folder / name).write_text("\n".join([*head, *tum_lines(times, poses), ""]), encoding="utf-8")
    return {"files": {name: what for name, (what, _) in files.items()}}


# ---- cameras --------------------------------------------------------------------------------------------------------


def _grids(truth: SceneTruth) -> list[Grid]:
    """Grids that a sensor has."""
    grids: list[Grid] = ["mosaic"] if truth.sensor.spec.aps is not None else []
    return grids + (["events"] if 0 not in truth.sensor.layout.evs_shape else [])


def _opencv(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    names = {grid: f"camera_{grid}.yaml" for grid in _grids(truth)}
    for grid, name in names.items():
        write_opencv_camera(folder / name, truth.camera(grid))
    return {"files": {name: f"camera of the grid {grid!r}" for grid, name in names.items()}}


def _kalibr(recording: Recorded, truth: SceneTruth, folder: Path, every_us: int | None) -> dict[str, Any]:
    grids = _grids(truth)
    write_kalibr_camchain(folder / "camchain.yaml", [truth] * len(grids), grids)
    model = ImuModel()
    unit = {
        "rostopic": "/imu0",
        "update_rate": model.rate_hz,
        "accelerometer_noise_density": model.accelerometer_noise_density,
        "accelerometer_random_walk": model.accelerometer_random_walk,
        "gyroscope_noise_density": model.gyro_noise_density,
        "gyroscope_random_walk": model.gyro_random_walk,
    }
    write_kalibr(folder / "imu.yaml", unit)
    return {"cameras": {f"cam{number}": grid for number, grid in enumerate(grids)}}


#: Writers by the name of their format.
FORMATS: dict[str, Callable[[Recorded, SceneTruth, Path, int | None], dict[str, Any]]] = {
    "exr": _exr,
    "dsec-flow": _dsec_flow,
    "tum": _tum,
    "kalibr": _kalibr,
    "opencv": _opencv,
    "prophesee-boxes": write_prophesee_boxes,
    "dsec-det": write_dsec_det,
    "coco": write_coco,
}
#: Formats with an interval.
_TIMED = ("dsec-flow", "tum", "prophesee-boxes", "dsec-det")

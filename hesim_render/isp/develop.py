"""Pictures of all frames of a recording, in a folder that appears whole or not at all."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.pipeline import DENOISED_PICTURE, Pipeline, develop
from hesim_render.mosaic.colour_profile import Camera
from hesim_render.mosaic.layout import Layout
from hesim_render.recording import manifest as manifests
from hesim_render.recording.recording import Recording, as_recording
from hesim_render.sensor.lens import Lens, relative_illumination

#: File by which a folder of pictures is recognised.
MARKER = "isp.json"


def develop_recording(
    folder: str | Path | Recording,
    out: str | Path | None = None,
    pipeline: Pipeline | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    overwrite: bool = False,
    calibration: str | Path | None = None,
) -> Path:
    """Write a picture of every frame of a recording, and ``isp.json`` with the settings used.

    Depth 8 gives PNG. Depth 16 gives TIFF, as does float32 (without an encode step, or where that step says ``float``).
    Automatic exposure is measured on the middle frame and kept for all frames, so that a sequence does not flicker.
    Noise reduction uses the noise model and the maps of the sensor that made the recording. Noise terms that were
    switched off in the recording are not reduced, so frames without noise stay unchanged.

    Parameters
    ----------
    folder : the recording, or its folder.
    out : folder to write; default: beside the recording, with its name and ``-pictures``.
    pipeline : default `DENOISED_PICTURE`; `PICTURE` is the same without noise reduction.
    progress : called with (done, total, what).
    overwrite : replace an earlier folder of pictures.
    calibration : ``calibration.yaml`` of a calibrated sensor, whose maps the recording does not hold. Without it,
        row offsets are estimated from the frames.

    Returns
    -------
    Path : the folder of pictures.

    Raises
    ------
    SpecError
        If the folder is not a recording, or has no frames, or the calibration belongs to another sensor.
    RangeError
        If a calibration is given, but no step of the pipeline reduces noise.
    OutputError
        If the pictures cannot be written.
    """
    recording = as_recording(folder)
    if recording.path is None:
        raise SpecError("the recording is in memory: save it first (Recording.save)")
    if len(recording.frames) == 0:
        raise SpecError("the recording has no frames", file=str(recording.path))
    chain = pipeline or DENOISED_PICTURE
    camera = Camera.of(recording.mosaic)
    noise = None
    if any(item.step == "denoise" for item in chain.steps):
        noise = FrameNoise.of_recording(recording.manifest, calibration, recording.path)
    elif calibration is not None:
        raise RangeError("calibration", str(calibration), "none, as no step of the pipeline reduces noise")
    with OutputFolder(out or recording.path.with_name(f"{recording.path.name}-pictures"), MARKER, overwrite) as target:
        illumination = _illumination(recording) if any(item.step == "lens_shading" for item in chain.steps) else None
        total = len(recording.frames)
        gain, entries = None, []
        if any(item.step == "exposure" and item.auto for item in chain.steps):
            middle = recording.frames[total // 2]
            gain = develop(middle, camera, chain, illumination=illumination, noise=noise).exposure_gain
        for number, frame in enumerate(recording.frames):
            done = develop(frame, camera, chain, illumination=illumination, exposure_gain=gain, noise=noise)
            name = f"{number:06d}.png" if done.image.dtype == np.uint8 else f"{number:06d}.tif"
            with output_errors(target.target):
                write_picture(target.path / name, done.image)
            entries.append({"file": name, "t_us": frame.t_us, **(done.report or {})})
            if progress is not None:
                progress(number + 1, total, "pictures")
        about = {
            "schema_version": 1,
            "recording": recording.path.name,
            "pipeline": chain.model_dump(mode="json", exclude_none=True),
            "camera": camera.model_dump(mode="json"),
            "noise": None if noise is None else noise.describe(),
            "software": manifests.software_versions(),
            "pictures": entries,
        }
        with output_errors(target.target):
            (target.path / MARKER).write_text(manifests.to_text(about) + "\n", encoding="utf-8")
    return target.target


def write_picture(path: Path, picture: NDArray) -> None:
    """Write a picture: uint8 as PNG or TIFF, uint16 and float32 as TIFF.

    Parameters
    ----------
    path : file to write; its ending selects the format.
    picture : [row, col, 3].

    Raises
    ------
    RangeError
        If the ending of the file name does not suit the depth.
    """
    if path.suffix == ".png":
        from PIL import Image

        if picture.dtype != np.uint8:
            raise RangeError("picture file", path.name, "a .tif file for 16 bit and float")
        Image.fromarray(np.ascontiguousarray(picture)).save(path, compress_level=3)
        return
    if path.suffix not in (".tif", ".tiff"):
        raise RangeError("picture file", path.name, "a name ending in .png or .tif")
    import tifffile

    tifffile.imwrite(path, np.ascontiguousarray(picture), photometric="rgb", metadata=None)


def _illumination(recording: Recording) -> NDArray[np.float32]:
    """Relative illumination of the recording's own lens over its region, computed from the manifest."""
    spec = manifests.sensor_spec(recording.manifest, recording.path)
    roi, used = recording.manifest["roi"], recording.manifest["lens"]
    layout = Layout(spec, roi["y"], roi["x"], roi["height_px"], roi["width_px"])
    axis_x, axis_y = used.get("axis_mm", (0.0, 0.0))  # older recordings do not state the axis: it is in the middle
    off = frozenset(term.removeprefix("lens.") for term in manifests.lens_terms_off(recording.manifest))
    lens = Lens(used["f_number"], used["focal_length_mm"], used["magnification"], (axis_x, axis_y), off)
    return relative_illumination(layout, lens)

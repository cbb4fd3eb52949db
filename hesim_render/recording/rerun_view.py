"""A recording in the viewer rerun: frames, events, truth and poses on one timeline, or as a file for another machine.

The timeline ``recording`` is the time of the recording. Entities: ``camera/colour`` and ``camera/raw`` (the DN
themselves) at the end of each frame, ``truth/electrons`` and, where they were written, ``truth/depth``,
``events/pictures`` (the last polarity of each pixel in a step) and ``events/rate``, and the poses ``world/camera`` and
``world/objects/…``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.extras import how_to_install
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.recording.colour_view import OFF_COLOUR, ON_COLOUR, colour_picture

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded

TIMELINE = "recording"
#: Length of a step of events, µs.
STEP_US = 10_000
_ON, _OFF = 1, 2
_WIDEST_PX = 1024


def can_show() -> bool:
    """True if rerun is installed and this machine has a display."""
    from importlib.util import find_spec

    return find_spec("rerun") is not None and bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def write_rrd(recording: Recorded, path: Path, progress: Progress | None = None) -> None:
    """Write a file that rerun opens (``rerun FILE``).

    Parameters
    ----------
    recording, path : recording, and file to write.
    progress : called with (done, total, what).

    Raises
    ------
    SpecError
        If rerun is not installed, or the recording is damaged.
    """
    stream = _stream(recording)
    stream.save(path)
    _log(stream, recording, progress)
    stream.flush()
    stream.disconnect()


def show(recording: Recorded, progress: Progress | None = None) -> None:
    """Open the viewer with a recording; it stays open when this program ends.

    Parameters
    ----------
    recording, progress : as for `write_rrd`.

    Raises
    ------
    SpecError
        If rerun is not installed, or the recording is damaged.
    """
    stream = _stream(recording)
    stream.spawn()
    _log(stream, recording, progress)
    stream.flush()


def _stream(recording: Recorded) -> Any:
    try:
        import rerun
    except ImportError:
        raise SpecError(
            f"the viewer needs rerun: {how_to_install('view')}", file=str(recording.path or "recording")
        ) from None
    name = None if recording.path is None else recording.path.name
    return rerun.RecordingStream("hesim_render", recording_id=name)


def _log(stream: Any, recording: Recorded, progress: Progress | None) -> None:
    import rerun

    time = recording.manifest["time"]
    begin_us, end_us = time["begin_us"], time["end_us"]
    has_events = min(recording.event_shape) > 0
    if has_events:
        colours = [(_ON, "ON", ON_COLOUR), (_OFF, "OFF", OFF_COLOUR)]
        known = [rerun.AnnotationInfo(id=k, label=label, color=colour.astype(np.uint8)) for k, label, colour in colours]
        stream.log("events", rerun.AnnotationContext(known), static=True)
    _log_poses(stream, recording)
    truth = recording.stored_truth
    has_depth = truth is not None and "frames/depth_m" in truth.names
    times = [entry["t_us"] for entry in recording.manifest["frames"]]
    shown = 0
    edges = [*range(begin_us, end_us, STEP_US), end_us]
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        while shown < len(times) and times[shown] <= last:
            _log_frame(stream, recording, shown)
            if has_depth:
                assert truth is not None
                stream.log("truth/depth", rerun.DepthImage(_finite(truth.read("frames/depth_m", shown)), meter=1.0))
            shown += 1
        if has_events:
            # an event at 0 is before the first step's begin, which is not part of a step
            events = recording.event_slice(first + 1 if first > begin_us else first, last + 1)
            _log_events(stream, events, recording.event_shape, first, last)
        if progress is not None:
            progress(last - begin_us, end_us - begin_us, "recorded µs")


def _at(stream: Any, t_us: float) -> None:
    stream.set_time(TIMELINE, duration=t_us * S_PER_US)


def _log_frame(stream: Any, recording: Recorded, number: int) -> None:
    import rerun

    frame = recording.frames[number]
    _at(stream, frame.t_us)
    stream.log("camera/colour", rerun.Image(colour_picture(frame.raw, recording.mosaic, _WIDEST_PX)))
    stream.log("camera/raw", rerun.Image(frame.raw, rerun.ColorModel.L))
    if np.isfinite(frame.electrons_mean).any():
        stream.log("truth/electrons", rerun.Image(_finite(frame.electrons_mean), rerun.ColorModel.L))


def _finite(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _log_events(stream: Any, events: NDArray, shape: tuple[int, int], first_us: int, last_us: int) -> None:
    import rerun

    _at(stream, last_us)
    picture = np.zeros(shape, np.uint8)
    picture[events["y"], events["x"]] = np.where(events["polarity"] > 0, _ON, _OFF)
    stream.log("events/pictures", rerun.SegmentationImage(picture))
    on = int(np.count_nonzero(events["polarity"] > 0))
    rates = [count / ((last_us - first_us) * S_PER_US) for count in (on, events.size - on)]
    stream.log("events/rate", rerun.Scalars(rates))


def _log_poses(stream: Any, recording: Recorded) -> None:
    """Poses of the camera (x right, y down, z forward) and of the objects, in the world of the scene."""
    import rerun

    truth = recording.stored_truth
    if truth is None or "poses/camera" not in truth.names:
        return
    times, camera = truth.read("poses/time_us"), truth.read("poses/camera")
    objects = truth.read("poses/objects") if "poses/objects" in truth.names else np.empty((len(times), 0, 4, 4))
    model, roi = recording.manifest["lens"], recording.manifest["roi"]
    pitch_mm = (recording.mosaic.pitch_um or 1.0) / 1000
    size = [roi["width_px"], roi["height_px"]]
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    focal_px = model["focal_length_mm"] * (1 + abs(model["magnification"])) / pitch_mm
    stream.log("world/camera", rerun.Pinhole(focal_length=focal_px, resolution=size), static=True)
    for number, t_us in enumerate(times):
        _at(stream, float(t_us))
        every = [("world/camera", camera[number])]
        every += [(f"world/objects/{k}", pose) for k, pose in enumerate(objects[number])]
        for entity, pose in every:
            stream.log(entity, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

"""A recording in the viewer rerun: frames, events, truth and poses on one timeline, or as a file for another machine.

The timeline ``recording`` is the time of the recording. Entities: ``camera/colour`` and ``camera/raw`` (the DN
themselves) at the end of each frame, ``truth/electrons`` and, where they were written, ``truth/depth``,
``events/pictures`` (the last polarity of each pixel in a step) and ``events/rate``, and the poses ``world/camera`` and
``world/objects/…``.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError, how_to_install
from hesim_render.core.progress import Progress
from hesim_render.core.units import S_PER_US
from hesim_render.recording.colour_view import OFF_COLOUR, ON_COLOUR, colour_picture
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
    stream = _of(recording)
    send_to(stream, path)
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
    stream = _of(recording)
    send_to(stream, None)
    _log(stream, recording, progress)
    stream.flush()


def _of(recording: Recorded) -> Any:
    name = None if recording.path is None else recording.path.name
    return viewer_module().RecordingStream("hesim_render", recording_id=name)


def viewer_module() -> Any:
    """The module of the viewer."""
    try:
        import rerun
    except ImportError:
        raise SpecError(f"the viewer needs rerun: {how_to_install('view')}") from None
    return rerun


def send_to(stream: Any, path: Path | None) -> None:
    """Where a stream goes: a file, or the viewer."""
    if path is None:
        stream.spawn()
    else:
        stream.save(path)


def _log(stream: Any, recording: Recorded, progress: Progress | None) -> None:
    import rerun

    time = recording.manifest["time"]
    begin_us, end_us = time["begin_us"], time["end_us"]
    _log_poses(stream, recording)
    truth = recording.stored_truth
    has_depth = truth is not None and "frames/depth_m" in truth.names
    times = [entry["t_us"] for entry in recording.manifest["frames"]]
    shown = 0
    steps = EventSteps(stream, recording.event_shape, begin_us, end_us)
    for last in [*range(begin_us + STEP_US, end_us, STEP_US), end_us]:
        while shown < len(times) and times[shown] <= last:
            _log_frame(stream, recording, shown)
            if has_depth:
                assert truth is not None
                stream.log("truth/depth", rerun.DepthImage(_finite(truth.read("frames/depth_m", shown)), meter=1.0))
            shown += 1
        if steps.are_there:
            first = steps.first_us
            steps.add(recording.event_slice(first if first == begin_us else first + 1, last + 1))
        steps.end(last)
        if progress is not None:
            progress(last - begin_us, end_us - begin_us, "recorded µs")


class EventSteps:
    """Events as a picture and a rate for each step of time.

    Parameters
    ----------
    stream : where they are shown.
    shape : rows and columns of the event grid; nothing is shown of one without pixels.
    begin_us, end_us : of the recording, µs.
    has_picture : asked at the end of each step whether its picture is shown.
    """

    def __init__(
        self,
        stream: Any,
        shape: tuple[int, int],
        begin_us: int,
        end_us: int,
        has_picture: Callable[[], bool] = lambda: True,
    ) -> None:
        import rerun

        #: Begin of the step at work, µs; an event at the begin of the run belongs to the first one.
        self.first_us = begin_us
        self._stream, self._end_us, self._has_picture = stream, end_us, has_picture
        self.are_there = min(shape) > 0
        self._picture, self._on, self._off = np.zeros(shape, np.uint8), 0, 0
        if self.are_there:
            colours = [(_ON, "ON", ON_COLOUR), (_OFF, "OFF", OFF_COLOUR)]
            known = [rerun.AnnotationInfo(id=k, label=label, color=c.astype(np.uint8)) for k, label, c in colours]
            stream.log("events", rerun.AnnotationContext(known), static=True)

    def add(self, events: NDArray) -> None:
        """Add a block, and show the steps that it ends."""
        while events.size:
            last_us = min(self.first_us + STEP_US, self._end_us)
            count = int(np.searchsorted(events["t_us"], last_us, side="right"))
            here, events = events[:count], events[count:]
            is_on = here["polarity"] > 0
            self._picture[here["y"], here["x"]] = np.where(is_on, _ON, _OFF)
            on = int(np.count_nonzero(is_on))
            self._on, self._off = self._on + on, self._off + count - on
            if events.size:
                self.end(last_us)

    def end(self, last_us: int) -> None:
        """Show the step at work, which ends at a time, and begin the next one."""
        import rerun

        if self.are_there:
            set_time(self._stream, last_us)
            if self._has_picture():
                self._stream.log("events/pictures", rerun.SegmentationImage(self._picture))
            length_s = (last_us - self.first_us) * S_PER_US
            self._stream.log("events/rate", rerun.Scalars([self._on / length_s, self._off / length_s]))
        self._picture = np.zeros_like(self._picture)
        self.first_us, self._on, self._off = last_us, 0, 0

    def close(self) -> None:
        """Show all steps to the end."""
        while self.first_us < self._end_us:
            self.end(min(self.first_us + STEP_US, self._end_us))


def set_time(stream: Any, t_us: float) -> None:
    stream.set_time(TIMELINE, duration=t_us * S_PER_US)


def _log_frame(stream: Any, recording: Recorded, number: int) -> None:
    import rerun

    frame = recording.frames[number]
    set_time(stream, frame.t_us)
    stream.log("camera/colour", rerun.Image(colour_picture(frame.raw, recording.mosaic, _WIDEST_PX)))
    stream.log("camera/raw", rerun.Image(frame.raw, rerun.ColorModel.L))
    if np.isfinite(frame.electrons_mean).any():
        stream.log("truth/electrons", rerun.Image(_finite(frame.electrons_mean), rerun.ColorModel.L))


def _finite(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


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
        set_time(stream, float(t_us))
        every = [("world/camera", camera[number])]
        every += [(f"world/objects/{k}", pose) for k, pose in enumerate(objects[number])]
        for entity, pose in every:
            stream.log(entity, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))

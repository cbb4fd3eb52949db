"""A run in the viewer rerun while it goes on, or in a file that grows."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from time import monotonic
from typing import Any

from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.mosaic.description import Mosaic
from hesim_render.recording import rerun_view
from hesim_render.recording.colour_view import thumbnail
from hesim_render.recording.frame import Frame
from hesim_render.recording.rerun_view import EventSteps, send_to, set_time, viewer_module

#: File of the live view, in the folder of a recording.
LIVE_FILE = "live.rrd"
#: Share of a run's time that its live view may take.
_SHARE = 0.01
_WIDEST_PX = 512


def live_file(folder: Path | None) -> Path | None:
    """File that shows a run which writes into a folder while it goes on; None where the viewer does.

    Parameters
    ----------
    folder : of the recording; None for one in memory.

    Raises
    ------
    SpecError
        If rerun is not installed.
    RangeError
        If there is neither a display nor a folder.
    """
    viewer_module()
    if rerun_view.can_show():
        return None
    if folder is None:
        raise RangeError("live", True, "a run with a folder (out): without a display, the live view is a file in it")
    return folder / LIVE_FILE


class LiveView:
    """Shows what a run gives while it goes on: in the viewer, or in a file that grows, which rerun opens at any time.

    Frames are shown as ``camera/colour``, events as in a recording. A picture is left out where showing has taken more
    than `_SHARE` of the time since the begin, so that fast runs stay fast; rates are all there.

    Parameters
    ----------
    manifest : of the recording that is being written.
    path : file to write; None opens the viewer.

    Raises
    ------
    SpecError
        If rerun is not installed.
    """

    def __init__(self, manifest: Mapping[str, Any], path: Path | None) -> None:
        self._stream = viewer_module().RecordingStream("hesim_render")
        send_to(self._stream, path)
        self._mosaic = Mosaic.model_validate(manifest["mosaic"])
        grid, time = manifest["event_grid"], manifest["time"]
        shape = grid["height"], grid["width"]
        self._steps = EventSteps(self._stream, shape, time["begin_us"], time["end_us"], self._is_cheap)
        self._begin_s, self._spent_s = monotonic(), 0.0

    def _is_cheap(self) -> bool:
        return self._spent_s <= _SHARE * (monotonic() - self._begin_s)

    @contextlib.contextmanager
    def _counted(self) -> Iterator[None]:
        """Count the time that is spent on showing."""
        begin_s = monotonic()
        yield
        self._spent_s += monotonic() - begin_s

    def add_frame(self, frame: Frame) -> None:
        """Show the next frame."""
        if self._is_cheap():
            with self._counted():
                import rerun

                set_time(self._stream, frame.t_us)
                # binned by tiles, at a tenth of the cost of a colour at every pixel
                self._stream.log("camera/colour", rerun.Image(thumbnail(frame.raw, self._mosaic, _WIDEST_PX)))

    def add_events(self, events: NDArray) -> None:
        """Show the next block of events, in order of time."""
        with self._counted():
            self._steps.add(events)

    def close(self, is_whole: bool = True) -> None:
        """Show the last step of a whole run, and end the file."""
        if is_whole:
            self._steps.close()
        self._stream.flush()
        self._stream.disconnect()

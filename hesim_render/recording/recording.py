"""A recording, and what can be made of it: a folder, files of other programs, drawings.

The content is in `recorded`. The methods here call functions over it; what draws or exports is loaded with the first
call.
"""

import contextlib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hesim_render.core.errors import HesimWarning, RangeError, SpecError
from hesim_render.core.guard import inside
from hesim_render.recording.folder import FolderWriter
from hesim_render.recording.label_file import OBJECT_FILE
from hesim_render.recording.recorded import Recorded
from hesim_render.recording.truth_file import TRUTH_FILE, TruthRequest, write_truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Share of the pixels of a frame that is judged as dark where its signal is below the read noise.
_DARK_SHARE = 0.99
#: Share of saturated pixels that gives a warning.
_WHITE_SHARE = 0.5


class Recording(Recorded):
    """Frames, events and manifest of one run.

    Parameters
    ----------
    frames : a list, or the `StoredFrames` of a folder.
    manifest : what `recording.json` holds, see `hesim_render.recording.manifest`.
    events : structured array [event] of `EVENT_DTYPE`; None reads the events of `path` on first use.
    event_truth : noise-free flux of the event pixels; None reads the truth of `path` on first use.
    path : the folder, None for a recording in memory.
    labels : what caused each event; None reads the labels of `path` on first use, where there are any.
    scene : the scene that was rendered, where it is known; None makes it from the manifest when `truth` asks for it.

    Examples
    --------
    >>> import tempfile
    >>> import hesim_render as hr
    >>> rec = hr.simulate(hr.load_scene("dark"), hr.load_sensor("reference-mono").crop(32, 24), duration_s=0.02)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = rec.save(f"{folder}/dark")
    ...     again = hr.Recording.load(f"{folder}/dark")
    ...     again.frames[0], bool((again.events == rec.events).all())
    (<Frame 0: 32x24 px, t_us=10000, exposure_us=10000>, True)
    """

    def __repr__(self) -> str:
        from hesim_render.recording.outline import text_summary

        return text_summary(self)

    def _repr_html_(self) -> str:
        from hesim_render.recording.page import html_summary

        return html_summary(self)

    def plot(self) -> "Figure":
        """Draw the middle frame, the events around it, the event rates over time, and the histogram of RAW values.

        Returns
        -------
        A matplotlib figure, which notebooks show; `savefig` writes it.
        """
        from hesim_render.recording.page import figure_of

        return figure_of(self)

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the recording as a folder, which appears whole or not at all.

        Parameters
        ----------
        path : folder to write.
        overwrite : replace an existing recording.

        Returns
        -------
        The folder, absolute.

        Raises
        ------
        OutputError
            If the folder exists (and `overwrite` is not set) or cannot be written.
        """
        return save(self, path, overwrite)

    def export(self, format: str, path: str | Path, overwrite: bool = False) -> Path:
        """Write the events, the RAW frames or the geometric truth in the format of another program (docs/formats.md).

        Parameters
        ----------
        format : of events ``evt2``, ``evt3``, ``dat``, ``prophesee``, ``aedat4``, ``dsec``, ``dsec-gzip``, ``npz``,
            ``txt`` or ``nmnist``; of frames ``tiff``, ``png``, ``npy`` or ``mipi``; of both ``mcap``, ``mcap-evt3``,
            ``raw-npz``, and as videos ``mp4``, ``mp4-colour`` and ``mp4-events``; of the truth ``exr``, ``dsec-flow``,
            ``tum``, ``kalibr`` or ``opencv``, and boxes and masks of it ``prophesee-boxes``, ``dsec-det`` or ``coco``.
        path : file of the events, or folder of the frames or of the truth.
        overwrite : replace an existing file, or an existing folder of exported frames.

        Returns
        -------
        The file or folder, absolute.

        Raises
        ------
        OutputError
            If it exists (and `overwrite` is not set) or cannot be written; nothing is left then.
        RangeError
            If the format is unknown, or the recording has no such data.
        SpecError
            If the events do not fit into the format, or the recording is damaged.
        """
        from hesim_render.recording.exports import export

        return export(self, format, path, overwrite)


def as_recording(given: Recording | str | Path) -> Recording:
    """A recording as it is, or opened by its folder.

    Raises
    ------
    RangeError
        If something else is given.
    SpecError
        If the folder is not a recording that this version reads.
    """
    if isinstance(given, str | Path):
        return Recording.load(given)
    if not isinstance(given, Recording):
        raise RangeError("recording", given, "a recording, or the path of its folder")
    return given


def save(recording: Recorded, path: str | Path, overwrite: bool = False) -> Path:
    """Write a recording as a folder; see `Recording.save`."""
    with FolderWriter(path, recording.manifest, overwrite) as writer:
        for frame in recording.frames:
            writer.add_frame(frame)
        writer.add_events(recording.events)
        if recording.event_truth is not None:
            writer.set_event_truth(recording.event_truth)
        writer.set_events_dropped(recording.manifest["counts"].get("events_dropped", 0))
        if recording.event_labels is not None:
            writer.add_event_labels(recording.event_labels.as_block())
        _save_truth(recording, writer)
        return writer.finish()


def _save_truth(recording: Recorded, writer: FolderWriter) -> None:
    """Write the geometric truth that the run was asked for; a copy of a file, or computed again."""
    if recording.path is not None:
        if recording.has_event_objects:
            writer.copy_in(inside(recording.path, OBJECT_FILE), OBJECT_FILE)
        if (recording.path / TRUTH_FILE).is_file():
            writer.copy_in(inside(recording.path, TRUTH_FILE), TRUTH_FILE)
        return
    request = TruthRequest.of(recording.manifest)
    if recording.event_labels is not None and recording.scene is not None:
        with contextlib.suppress(SpecError):  # of a scene without geometric truth
            writer.set_event_objects(recording.truth.objects_at)
    if request.geometry:
        writer.write_in(TRUTH_FILE, lambda path: write_truth(path, recording.truth, request))


def warn_of_exposure(recording: Recording) -> Recording:
    """The recording; warns, by its middle frame, if nearly all signal is below the read noise, or most is saturated.

    A scene without light is dark by intent, which gives no warning.
    """
    if not len(recording.frames):
        return recording
    frame, aps = recording.frames[len(recording.frames) // 2], recording.manifest["sensor"]["spec"]["aps"]
    signal_e = frame.electrons_mean[frame.valid]
    if signal_e.size == 0:
        return recording
    typical_e = float(np.quantile(signal_e, _DARK_SHARE))
    white = float(np.mean(frame.raw[frame.valid] >= recording.mosaic.white_level_dn))
    where = f"frame {frame.index}, exposed for {frame.exposure_us} µs"
    if signal_e.max() > 0 and typical_e < aps["read_noise_e"]:
        warnings.warn(
            f"{where}, is nearly dark: {100 * _DARK_SHARE:g} % of its pixels have fewer than {typical_e:.2g} e⁻, at a "
            f"read noise of {aps['read_noise_e']:g} e⁻; give more light or a longer exposure",
            HesimWarning, stacklevel=3,
        )  # fmt: skip
    elif white > _WHITE_SHARE:
        warnings.warn(
            f"{where}, is overexposed: {100 * white:.0f} % of its pixels are saturated; give less light or a shorter "
            "exposure",
            HesimWarning, stacklevel=3,
        )  # fmt: skip
    return recording

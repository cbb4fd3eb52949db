"""A recording: frames, events, their truth and a manifest; in memory or as a folder on disk.

On disk (docs/formats.md)::

    recording.json   manifest
    frames/000000.dng …
    events.h5
    truth/000000.npz …   electrons_mean, electrons_stderr; float32, uncompressed
    truth/valid.npy, truth/events.npz
    preview.*

Frames are written as they come and read back one at a time: a long recording is never in memory.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import inside
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.exchange.dsec import read_events
from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import no_events
from hesim_render.recording import manifest as manifests
from hesim_render.recording.dng import read_dng
from hesim_render.recording.folder import FolderWriter
from hesim_render.recording.frame import EventTruth, Frame
from hesim_render.recording.label_file import LABEL_FILE, OBJECT_FILE, read_labels, read_objects

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hesim_render.pixels.evs.events import EventLabels
    from hesim_render.recording.truth_file import StoredTruth
    from hesim_render.sources.render.truth.scene_truth import SceneTruth
    from hesim_render.sources.scene import Scene


class StoredFrames(Sequence[Frame]):
    """Frames of a recording on disk. Each frame is read when it is asked for and is not kept.

    Parameters
    ----------
    folder : the recording's folder.
    entries : the manifest's list of frames.
    shape : rows and columns of a frame, px.
    """

    def __init__(self, folder: Path, entries: Sequence[Mapping[str, Any]], shape: tuple[int, int]) -> None:
        self._folder, self._entries, self._shape = folder, list(entries), shape

    def __repr__(self) -> str:
        rows, cols = self._shape
        return f"<{len(self)} frame{'' if len(self) == 1 else 's'} of {cols}x{rows} px in {self._folder}>"

    @cached_property
    def _valid(self) -> NDArray[np.bool_]:
        return read_array(inside(self._folder, "truth/valid.npy"), self._shape, "b")

    def __len__(self) -> int:
        return len(self._entries)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> StoredFrames: ...
    def __getitem__(self, index: int | slice) -> Frame | StoredFrames:
        if isinstance(index, slice):
            return StoredFrames(self._folder, self._entries[index], self._shape)
        entry = dict(self._entries[index])
        manifest, key = self._folder / manifests.MANIFEST_NAME, f"frames.{range(len(self))[index]}"
        truth_file = inside(self._folder, entry.pop("truth"), file=manifest, key=f"{key}.truth")
        raw = read_dng(inside(self._folder, entry.pop("file"), file=manifest, key=f"{key}.file"), self._shape)
        mean, stderr = _read_maps(truth_file, ("electrons_mean", "electrons_stderr"), self._shape)
        return Frame(raw, self._valid, mean, stderr, **entry)


class Recording:
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

    def __init__(
        self,
        frames: Sequence[Frame],
        manifest: dict[str, Any],
        *,
        events: NDArray | None = None,
        event_truth: EventTruth | None = None,
        path: Path | None = None,
        labels: EventLabels | None = None,
        scene: Scene | None = None,
    ) -> None:
        self.frames, self.manifest, self.path, self._scene = frames, manifest, path, scene
        self._events, self._event_truth, self._labels = events, event_truth, labels

    def __repr__(self) -> str:
        from hesim_render.recording.outline import text_summary

        return text_summary(self)

    def _repr_html_(self) -> str:
        return import_module("hesim_render.recording.page").html_summary(self)

    def plot(self) -> Figure:
        """Draw the middle frame, the events around it, the event rates over time, and the histogram of RAW values.

        Returns
        -------
        A matplotlib figure, which notebooks show; `savefig` writes it.
        """
        # by name: what draws recordings knows them, a recording does not depend on what draws it
        return import_module("hesim_render.recording.plots").figure_of(self)

    @property
    def events(self) -> NDArray:
        """All events, structured array [event] of `EVENT_DTYPE`, in order of time; `event_slice` reads only a part."""
        if self._events is None:
            self._events = no_events() if self.path is None else self._read_events(None, None)
        return self._events

    def _read_events(self, begin_us: int | None, end_us: int | None) -> NDArray:
        assert self.path is not None
        count = self.manifest["counts"]["events"]
        return read_events(inside(self.path, "events.h5"), begin_us, end_us, shape=self.event_shape, count=count)

    def event_slice(self, begin_us: int, end_us: int) -> NDArray:
        """Events of a time interval; from disk, only the events of that interval are read.

        Parameters
        ----------
        begin_us, end_us : the interval begin_us <= t_us < end_us, µs.

        Returns
        -------
        Structured array [event] of `EVENT_DTYPE`, in order of time.

        Raises
        ------
        SpecError
            If the event file is missing, damaged or does not match the manifest.
        """
        if self._events is None and self.path is not None:
            return self._read_events(begin_us, end_us)
        low, high = np.searchsorted(self.events["t_us"], [begin_us, end_us], side="left")
        return self.events[low:high]

    @property
    def event_truth(self) -> EventTruth | None:
        """Noise-free flux of the event pixels, e⁻/s; None where the sensor has no event pixels."""
        if self._event_truth is None and self.path is not None and (self.path / "truth" / "events.npz").is_file():
            names = ("flux_mean_e_per_s", "flux_stderr_e_per_s")
            maps = _read_maps(inside(self.path, "truth/events.npz"), names, self.event_shape)
            self._event_truth = EventTruth(*maps)
        return self._event_truth

    @property
    def event_labels(self) -> EventLabels | None:
        """What caused each event, lost events and the events without noise; None where the run was not asked for them.

        Raises
        ------
        SpecError
            If the file is damaged or does not fit the recording.
        """
        if self._labels is None and self.path is not None and (self.path / LABEL_FILE).is_file():
            self._labels = read_labels(self.path, self.event_shape, self.manifest["counts"]["events"])
        return self._labels

    @property
    def has_event_objects(self) -> bool:
        """True if the run has written the object of each event."""
        return self.path is not None and (self.path / OBJECT_FILE).is_file()

    @cached_property
    def event_objects(self) -> NDArray[np.uint16]:
        """The object that the pixel of each event shows at the event's time, uint16 [event]: that of the chief ray
        through the pixel's centre. 0 is the background; `SceneTruth.names` of `truth` has the names.

        Read where ``--truth events`` has written it, else computed from the scene.

        Raises
        ------
        SpecError
            If the file is damaged, or the scene is not known.
        """
        if self.path is not None and self.has_event_objects:
            return read_objects(self.path, self.manifest["counts"]["events"])
        events = self.events
        return self.truth.objects_at(events["t_us"], events["x"], events["y"])

    @cached_property
    def truth(self) -> SceneTruth:
        """Geometric truth at any time: depth, flow, poses and more, computed from the scene when it is asked for.

        Raises
        ------
        SpecError
            If the recording is of a video, or its scene needs files that the recording does not hold (`truth_with`).
        """
        return self._geometry(self._scene)

    def truth_with(self, scene: Scene) -> SceneTruth:
        """Geometric truth at any time, for a scene that needs files besides its own.

        Parameters
        ----------
        scene : the scene of this recording, from `load_scene`.

        Returns
        -------
        As `truth`.

        Raises
        ------
        SpecError
            If it is another scene.
        """
        return self._geometry(scene)

    def _geometry(self, scene: Scene | None) -> SceneTruth:
        from hesim_render.recording.geometry import geometry_of

        return geometry_of(self.manifest, self.path, scene)

    @cached_property
    def stored_truth(self) -> StoredTruth | None:
        """Geometric truth that the run has written; None where it was not asked for, or the recording is in memory."""
        from hesim_render.recording.truth_file import TRUTH_FILE, StoredTruth

        if self.path is None or not (self.path / TRUTH_FILE).is_file():
            return None
        return StoredTruth(inside(self.path, TRUTH_FILE))

    @cached_property
    def mosaic(self) -> Mosaic:
        """Tile, filters, levels and colour profile of the sensor, from the manifest."""
        return Mosaic.model_validate(self.manifest["mosaic"])

    @property
    def event_shape(self) -> tuple[int, int]:
        """Rows and columns of the event grid."""
        grid = self.manifest["event_grid"]
        return grid["height"], grid["width"]

    @property
    def duration_us(self) -> int:
        """Length of the recording, µs."""
        return self.manifest["time"]["end_us"] - self.manifest["time"]["begin_us"]

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
        with FolderWriter(path, self.manifest, overwrite) as writer:
            for frame in self.frames:
                writer.add_frame(frame)
            writer.add_events(self.events)
            if self.event_truth is not None:
                writer.set_event_truth(self.event_truth)
            writer.set_events_dropped(self.manifest["counts"].get("events_dropped", 0))
            if self.event_labels is not None:
                writer.add_event_labels(self.event_labels.as_block())
            self._save_truth(writer)
            return writer.finish()

    def _save_truth(self, writer: FolderWriter) -> None:
        """Write the geometric truth that the run was asked for; a copy of a file, or computed again."""
        from hesim_render.recording.truth_file import TRUTH_FILE, TruthRequest, write_truth

        if self.path is not None:
            if self.has_event_objects:
                writer.copy_in(inside(self.path, OBJECT_FILE), OBJECT_FILE)
            if (self.path / TRUTH_FILE).is_file():
                writer.copy_in(inside(self.path, TRUTH_FILE), TRUTH_FILE)
            return
        request = TruthRequest.of(self.manifest)
        if self._labels is not None and self._scene is not None:
            with contextlib.suppress(SpecError):  # of a scene without geometric truth
                writer.set_event_objects(self.truth.objects_at)
        if request.geometry:
            writer.write_in(TRUTH_FILE, lambda path: write_truth(path, self.truth, request))

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

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Open a recording folder. Frames and events are read when they are used.

        Parameters
        ----------
        path : the folder.

        Returns
        -------
        The recording.

        Raises
        ------
        SpecError
            If the folder is missing, or is not a recording that this version reads.
        """
        folder = Path(path).expanduser().resolve()
        if not folder.is_dir():
            raise SpecError("no such folder", file=str(path))
        manifest = manifests.read(folder)
        shape = manifest["roi"]["height_px"], manifest["roi"]["width_px"]
        return cls(StoredFrames(folder, manifest["frames"], shape), manifest, path=folder)


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


def _read_maps(file: Path, names: tuple[str, ...], shape: tuple[int, int]) -> list[NDArray[np.float32]]:
    """float32 maps of one shape from an `.npz` file, in the order of `names`."""
    found = read_arrays(file, names, only=names, shapes=dict.fromkeys(names, shape), kinds="f")
    return [found[name].astype(np.float32, copy=False) for name in names]

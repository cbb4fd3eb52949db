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

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside
from hesim_render.exchange.dsec import read_events, read_numbered_events
from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import EVENT_DTYPE, LABELLED_DTYPE, no_events
from hesim_render.recording import manifest as manifests
from hesim_render.recording.frame import EventTruth, Frame, StoredFrames, read_frame_maps
from hesim_render.recording.label_file import LABEL_FILE, OBJECT_FILE, read_causes, read_labels, read_objects

if TYPE_CHECKING:
    from hesim_render.pixels.evs.events import EventLabels
    from hesim_render.recording.truth_file import StoredTruth
    from hesim_render.sources.render.truth.scene_truth import SceneTruth
    from hesim_render.sources.scene import Scene


class Recorded:
    """Frames, events and manifest of one run: the content of a `Recording`, which adds what can be made of it.

    Its parameters are those of a `Recording`.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        manifest: dict[str, Any],
        *,
        events: NDArray | None = None,
        event_truth: EventTruth | None = None,
        path: Path | None = None,
        labels: "EventLabels | None" = None,
        scene: "Scene | None" = None,
    ) -> None:
        self.frames, self.manifest, self.path, self.scene = frames, manifest, path, scene
        self._events, self._event_truth, self._labels = events, event_truth, labels

    @property
    def events(self) -> NDArray:
        """All events, structured array [event] of `EVENT_DTYPE`, in order of time; `event_slice` reads only a part."""
        if self._events is None:
            self._events = no_events() if self.path is None else self._read_events(None, None)
        return self._events

    def _read_events(self, begin_us: float | None, end_us: float | None) -> NDArray:
        assert self.path is not None
        count = self.manifest["counts"]["events"]
        return read_events(inside(self.path, "events.h5"), begin_us, end_us, shape=self.event_shape, count=count)

    def event_slice(self, begin_us: float, end_us: float) -> NDArray:
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
            maps = read_frame_maps(inside(self.path, "truth/events.npz"), names, self.event_shape)
            self._event_truth = EventTruth(*maps)
        return self._event_truth

    @property
    def event_labels(self) -> "EventLabels | None":
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

    def labelled_slice(self, begin_us: float, end_us: float) -> NDArray:
        """Events of a time interval with their causes and objects; from disk, only those of the interval are read.

        Parameters
        ----------
        begin_us, end_us : the interval begin_us <= t_us < end_us, µs.

        Returns
        -------
        Structured array [event] of `LABELLED_DTYPE`, in order of time: an event with ``cause`` and ``object``, as in
        `event_labels` and `event_objects`.

        Raises
        ------
        SpecError
            If the run was not asked for labels (``--truth events``), a file is damaged, or the scene is not known.
        """
        path, count = self.path, self.manifest["counts"]["events"]
        if self._events is None and path is not None:
            events, first = read_numbered_events(
                inside(path, "events.h5"), begin_us, end_us, shape=self.event_shape, count=count
            )
        else:
            first = int(np.searchsorted(self.events["t_us"], begin_us, side="left"))
            events = self.event_slice(begin_us, end_us)
        part, result = slice(first, first + events.size), np.empty(events.size, LABELLED_DTYPE)
        for name in EVENT_DTYPE.names or ():
            result[name] = events[name]
        if path is not None and (path / LABEL_FILE).is_file():
            result["cause"] = read_causes(path, count, part)
        elif self._labels is not None:
            result["cause"] = self._labels.label[part]
        else:
            raise SpecError("events have no labels; simulate with --truth events (truth='events')", file=path)
        if path is not None and self.has_event_objects:
            result["object"] = read_objects(path, count, part)
        else:
            result["object"] = self.truth.objects_at(events["t_us"], events["x"], events["y"])
        return result

    @cached_property
    def truth(self) -> "SceneTruth":
        """Geometric truth at any time: depth, flow, poses and more, computed from the scene when it is asked for.

        Raises
        ------
        SpecError
            If the recording is of a video, or its scene needs files that the recording does not hold (`truth_with`).
        """
        return self.truth_with(self.scene)

    def truth_with(self, scene: "Scene | None") -> "SceneTruth":
        """Geometric truth at any time, for a scene that needs files besides its own.

        Parameters
        ----------
        scene : the scene of this recording, from `load_scene`; None makes it from the manifest.

        Returns
        -------
        As `truth`.

        Raises
        ------
        SpecError
            If it is another scene.
        """
        from hesim_render.recording.rebuilt_scene import geometry_of

        return geometry_of(self.manifest, self.path, scene)

    @cached_property
    def stored_truth(self) -> "StoredTruth | None":
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

    @classmethod
    def load(cls, path: str | Path) -> Self:
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

"""Takes what a run makes, as it comes, into a folder or into memory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import no_events
from hesim_render.recording import manifest as manifests
from hesim_render.recording.folder import FolderWriter
from hesim_render.recording.frame import EventTruth, Frame
from hesim_render.recording.recording import Recording

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor


class RecordingWriter:
    """Takes frames and events as they come; into a folder, or into memory without `path`.

    Use as a context manager and end with `finish`; leaving without it (an error, an interrupt)
    removes what was written.

    Parameters
    ----------
    path : folder to write, None to collect in memory.
    sensor : region and lens as used.
    scene : the scene file's model, None where there is none (a video).
    duration_us : length of the recording.
    settings : what else was asked for (``clean``, ``without``, ``samples``, ``backend``); plain values.
    overwrite : replace an existing recording.
    mosaic : instead of the sensor's under the scene's light, where that says too little (a video's light).

    Raises
    ------
    OutputError
        If `path` exists (without `overwrite`) or cannot be written, at once and at any later step.
    """

    def __init__(
        self,
        path: str | Path | None,
        sensor: Sensor,
        *,
        scene: Any = None,
        seed: int,
        duration_us: int,
        settings: Mapping[str, Any] | None = None,
        overwrite: bool = False,
        mosaic: Mosaic | None = None,
    ) -> None:
        self._manifest = manifests.build(
            sensor, scene=scene, seed=seed, duration_us=duration_us, settings=settings or {}
        )
        if mosaic is not None:
            self._manifest["mosaic"] = mosaic.model_dump(mode="json")
        self._folder = None if path is None else FolderWriter(path, self._manifest, overwrite)
        self._frames: list[Frame] = []
        self._events: list[NDArray] = []
        self._truth: EventTruth | None = None
        self._dropped = 0

    def add_frame(self, frame: Frame) -> None:
        """The next frame, in order of time."""
        if self._folder is not None:
            self._folder.add_frame(frame)
        else:
            self._frames.append(frame)

    def add_events(self, events: NDArray) -> None:
        """The next block of events (`EVENT_DTYPE`), in order of time."""
        if self._folder is not None:
            self._folder.add_events(events)
        elif events.size:
            self._events.append(events)

    def set_event_truth(self, flux_mean_e_per_s: NDArray, flux_stderr_e_per_s: NDArray) -> None:
        """Noise-free flux of the event pixels, [y, x] or flat, e⁻/s."""
        grid = self._manifest["event_grid"]
        shape = (grid["height"], grid["width"])
        truth = EventTruth(
            np.asarray(flux_mean_e_per_s, dtype=np.float32).reshape(shape),
            np.asarray(flux_stderr_e_per_s, dtype=np.float32).reshape(shape),
        )
        if self._folder is not None:
            self._folder.set_event_truth(truth)
        else:
            self._truth = truth

    def set_events_dropped(self, count: int) -> None:
        """How many events were lost in the read-out; they are in no other count."""
        if self._folder is not None:
            self._folder.set_events_dropped(count)
        self._dropped = int(count)

    def add_settings(self, settings: Mapping[str, Any]) -> None:
        """What only the run itself could tell, beside the settings given at the start."""
        for manifest in (self._manifest, *([self._folder.manifest] if self._folder is not None else [])):
            manifest["settings"] = {**manifest["settings"], **settings}

    def finish(self) -> Recording:
        """The recording; a folder is complete and has its name now."""
        if self._folder is not None:
            return Recording.load(self._folder.finish())
        events = np.concatenate(self._events) if self._events else no_events()
        on = int(np.count_nonzero(events["polarity"] > 0))
        self._manifest["frames"] = [frame.times for frame in self._frames]
        self._manifest["counts"] = {
            "frames": len(self._frames), "events": events.size, "events_on": on, "events_off": events.size - on,
            "events_dropped": self._dropped,
        }  # fmt: skip
        return Recording(self._frames, self._manifest, events=events, event_truth=self._truth)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._folder is not None:
            self._folder.__exit__(*error)

"""Writer of a run's frames and events, into a folder or into memory."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import EventLabels, LabelBlock, no_events
from hesim_render.recording import manifest as manifests
from hesim_render.recording.folder import FolderWriter
from hesim_render.recording.frame import EventTruth, Frame
from hesim_render.recording.live_view import LiveView, live_file
from hesim_render.recording.recording import Recording
from hesim_render.recording.truth_file import TRUTH_FILE, TruthRequest, write_truth
from hesim_render.specs.scene import SceneSpec

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor
    from hesim_render.sources.render.truth.scene_truth import SceneTruth


class RecordingWriter:
    """Takes frames and events as they come, and writes them into a folder, or keeps them in memory without `path`.

    Use it as a context manager and end with `finish`. Leaving it without `finish` (an error, an interrupt) removes
    what was written.

    Parameters
    ----------
    path : folder to write, None to collect in memory.
    sensor : with the region and lens in use.
    scene : model of the scene file, None where there is none (a video).
    seed : seed of the run, for the manifest.
    duration_us, begin_us : length of the recording, and its begin on the clock of its events, µs.
    settings : further settings of the run (``clean``, ``without``, ``samples``, ``backend``); plain values.
    overwrite : replace an existing recording.
    mosaic : description of the mosaic; default: that of the sensor under the light of the scene. A video gives its own.
    live : show frames and events as they come, in the viewer rerun or, without a display, in `LIVE_FILE` of the folder.

    Raises
    ------
    SpecError
        If `live` is asked for and rerun is not installed.
    OutputError
        If `path` exists (without `overwrite`) or cannot be written, at once and at any later step.
    """

    def __init__(
        self,
        path: str | Path | None,
        sensor: "Sensor",
        *,
        scene: SceneSpec | None = None,
        seed: int,
        duration_us: int,
        settings: Mapping[str, Any] | None = None,
        overwrite: bool = False,
        mosaic: Mosaic | None = None,
        live: bool = False,
        begin_us: int = 0,
    ) -> None:
        self._manifest = manifests.build(
            sensor, scene=scene, seed=seed, duration_us=duration_us, settings=settings or {}, begin_us=begin_us
        )
        if mosaic is not None:
            noise = self._manifest["mosaic"]["noise_profile"]
            self._manifest["mosaic"] = mosaic.model_dump(mode="json") | {"noise_profile": noise}
        self._folder = None if path is None else FolderWriter(path, self._manifest, overwrite)
        self._live: LiveView | None = None
        if live:
            try:
                self._live = LiveView(self._manifest, live_file(None if self._folder is None else self._folder.path))
            except BaseException as error:
                self.__exit__(type(error))
                raise
        self._scene = scene
        self._frames: list[Frame] = []
        self._events: list[NDArray] = []
        self._truth: EventTruth | None = None
        self._labels: list[LabelBlock] = []
        self._dropped = 0

    @property
    def run(self) -> dict[str, Any]:
        """All that decides what is recorded, by name; plain values."""
        named = {
            name: self._manifest[name] for name in ("scene", "sensor", "roi", "time", "seed", "settings", "software")
        }
        for name in ("scene", "sensor"):
            named[name] = {key: value for key, value in (named[name] or {}).items() if key != "spec"}
        return named

    def add_frame(self, frame: Frame) -> None:
        """Add the next frame, with its truth; frames come in order of time."""
        if self._folder is not None:
            self._folder.add_frame(frame)
        else:
            self._frames.append(frame)
        if self._live is not None:
            self._live.add_frame(frame)

    def add_events(self, events: NDArray) -> None:
        """Add the next block of events; blocks come in order of time.

        Parameters
        ----------
        events : structured array [event] of `EVENT_DTYPE`, in order of time.
        """
        if self._folder is not None:
            self._folder.add_events(events)
        elif events.size:
            self._events.append(events)
        if self._live is not None:
            self._live.add_events(events)

    def set_event_truth(self, flux_mean_e_per_s: NDArray, flux_stderr_e_per_s: NDArray) -> None:
        """Set the noise-free flux of the event pixels, mean over the recording.

        Parameters
        ----------
        flux_mean_e_per_s : [y, x] or flat, e⁻/s.
        flux_stderr_e_per_s : its standard error, same shape, e⁻/s.
        """
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

    def add_event_labels(self, block: LabelBlock) -> None:
        """Add the labels of the events since the previous block, after these events; earlier ones may change."""
        if self._folder is not None:
            self._folder.add_event_labels(block)
        else:
            self._labels.append(block)

    def write_event_objects(self, truth: "SceneTruth") -> None:
        """Have the object that each event's pixel shows written at the end; nothing in memory, where
        `Recording.event_objects` computes it.

        Parameters
        ----------
        truth : the scene that was rendered, and its sensor.
        """
        if self._folder is not None:
            self._folder.set_event_objects(truth.objects_at)

    def set_events_dropped(self, count: int) -> None:
        """Set how many events were lost in the read-out. No other count includes them."""
        if self._folder is not None:
            self._folder.set_events_dropped(count)
        self._dropped = int(count)

    def add_settings(self, settings: Mapping[str, Any]) -> None:
        """Add settings (names and plain values) that are known only after the run, to those given at the start."""
        for manifest in (self._manifest, *([self._folder.manifest] if self._folder is not None else [])):
            manifest["settings"] = {**manifest["settings"], **settings}

    def write_truth(self, truth: "SceneTruth", progress: Callable[[int, int], None] | None = None) -> None:
        """Write the geometric truth that the settings ask for, after the last frame; nothing in memory, where
        `Recording.truth` computes it.

        Parameters
        ----------
        truth : the scene that was rendered, and its sensor.
        progress : called with numbers of images done and of all.
        """
        if self._folder is not None:
            request = TruthRequest.of(self._folder.manifest)
            self._folder.write_in(TRUTH_FILE, lambda path: write_truth(path, truth, request, progress))

    def finish(self) -> Recording:
        """Finish and return the recording. A folder is now complete and has its final name."""
        from hesim_render.sources.scene import Scene

        self._end_live(is_whole=True)
        scene = None if self._scene is None else Scene(self._scene)
        if self._folder is not None:
            recording = Recording.load(self._folder.finish())
            return Recording(recording.frames, recording.manifest, path=recording.path, scene=scene)
        events = np.concatenate(self._events) if self._events else no_events()
        on = int(np.count_nonzero(events["polarity"] > 0))
        self._manifest["frames"] = [frame.times for frame in self._frames]
        self._manifest["counts"] = {
            "frames": len(self._frames), "events": events.size, "events_on": on, "events_off": events.size - on,
            "events_dropped": self._dropped,
        }  # fmt: skip
        return Recording(
            self._frames, self._manifest, events=events, event_truth=self._truth, scene=scene,
            labels=EventLabels.of(self._labels) if self._labels else None,
        )  # fmt: skip

    def _end_live(self, is_whole: bool) -> None:
        if self._live is not None:
            self._live.close(is_whole)
            self._live = None

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *error: Any) -> None:
        self._end_live(is_whole=False)
        if self._folder is not None:
            self._folder.__exit__(*error)

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import no_events
from hesim_render.recording import manifest as manifests
from hesim_render.recording.dng import read_dng, write_dng
from hesim_render.recording.event_file import EventFileWriter, read_events
from hesim_render.recording.frame import Frame

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

__all__ = ["EventTruth", "Frame", "Recording", "RecordingWriter"]


@dataclass(frozen=True, eq=False)
class EventTruth:
    """Noise-free flux of the event pixels, mean over the recording, float32 [y, x], e⁻/s."""

    flux_mean_e_per_s: NDArray[np.float32]
    flux_stderr_e_per_s: NDArray[np.float32]


class StoredFrames(Sequence[Frame]):
    """Frames of a recording on disk; each is read when asked for and not kept."""

    def __init__(self, folder: Path, entries: Sequence[Mapping[str, Any]], shape: tuple[int, int]) -> None:
        self._folder, self._entries, self._shape = folder, list(entries), shape

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
    frames : a list, or `StoredFrames` of a folder.
    manifest : see `hesim_render.recording.manifest`.
    events : structured array; None reads those of `path` on first use.
    event_truth : None reads those of `path`.
    path : the folder, None for a recording in memory.

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
    ) -> None:
        self.frames, self.manifest, self.path = frames, manifest, path
        self._events, self._event_truth = events, event_truth

    @property
    def events(self) -> NDArray:
        """All events, `EVENT_DTYPE`, in order of time; `event_slice` reads a part of them."""
        if self._events is None:
            self._events = no_events() if self.path is None else self._read_events(None, None)
        return self._events

    def _read_events(self, begin_us: int | None, end_us: int | None) -> NDArray:
        assert self.path is not None
        count = self.manifest["counts"]["events"]
        return read_events(inside(self.path, "events.h5"), begin_us, end_us, shape=self.event_shape, count=count)

    def event_slice(self, begin_us: int, end_us: int) -> NDArray:
        """Events with begin_us <= t_us < end_us; from disk, only that part is read."""
        if self._events is None and self.path is not None:
            return self._read_events(begin_us, end_us)
        low, high = np.searchsorted(self.events["t_us"], [begin_us, end_us], side="left")
        return self.events[low:high]

    @property
    def event_truth(self) -> EventTruth | None:
        """Noise-free flux of the event pixels, None where the sensor has none."""
        if self._event_truth is None and self.path is not None and (self.path / "truth" / "events.npz").is_file():
            names = ("flux_mean_e_per_s", "flux_stderr_e_per_s")
            maps = _read_maps(inside(self.path, "truth/events.npz"), names, self.event_shape)
            self._event_truth = EventTruth(*maps)
        return self._event_truth

    @cached_property
    def mosaic(self) -> Mosaic:
        return Mosaic.model_validate(self.manifest["mosaic"])

    @property
    def event_shape(self) -> tuple[int, int]:
        """Rows and columns of the event grid."""
        grid = self.manifest["event_grid"]
        return grid["height"], grid["width"]

    @property
    def duration_us(self) -> int:
        return self.manifest["time"]["end_us"] - self.manifest["time"]["begin_us"]

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the recording as a folder; it appears whole or not at all.

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
            return writer.finish()

    @classmethod
    def load(cls, path: str | Path) -> Recording:
        """Open a recording folder; frames and events are read when they are used.

        Raises
        ------
        SpecError
            If it is not a recording that this version reads.
        """
        folder = Path(path).expanduser().resolve()
        if not folder.is_dir():
            raise SpecError("no such folder", file=str(path))
        manifest = manifests.read(folder)
        shape = manifest["roi"]["height_px"], manifest["roi"]["width_px"]
        return cls(StoredFrames(folder, manifest["frames"], shape), manifest, path=folder)


class FolderWriter:
    """Streams a recording into a folder; see `RecordingWriter` for the face to use.

    Parameters
    ----------
    manifest : without frames and counts (those of another recording are dropped).
    """

    def __init__(self, path: str | Path, manifest: Mapping[str, Any], overwrite: bool = False) -> None:
        self._folder = OutputFolder(path, manifests.MANIFEST_NAME, overwrite)
        self.manifest: dict[str, Any] = {**manifest, "frames": [], "counts": {}}
        self._on = self._off = self._dropped = 0
        self._mosaic = Mosaic.model_validate(manifest["mosaic"])
        self._finished = False
        time, grid = manifest["time"], manifest["event_grid"]
        try:
            with output_errors(self._folder.target):
                for name in ("frames", "truth"):
                    (self._folder.path / name).mkdir()
                self._valid = self._mosaic_mask()
                np.save(self._folder.path / "truth" / "valid.npy", self._valid)
                self._events = EventFileWriter(
                    self._folder.path / "events.h5",
                    (grid["height"], grid["width"]),
                    time["begin_us"],
                    time["end_us"],
                )
        except BaseException:
            self._folder.discard()
            raise

    def _mosaic_mask(self) -> NDArray[np.bool_]:
        roi = self.manifest["roi"]
        return self._mosaic.tiled(np.array(self._mosaic.tile_aps), (roi["height_px"], roi["width_px"]))

    def add_frame(self, frame: Frame) -> None:
        from hesim_render.recording.preview import thumbnail

        number = len(self.manifest["frames"])
        file, truth = f"frames/{number:06d}.dng", f"truth/{number:06d}.npz"
        with output_errors(self._folder.target):
            write_dng(
                self._folder.path / file,
                np.ascontiguousarray(frame.raw, dtype=np.uint16),
                self._mosaic,
                exposure_us=frame.exposure_us,
                description=frame.times,
                thumbnail=thumbnail(frame.raw, self._mosaic),
            )
            np.savez(
                self._folder.path / truth,
                electrons_mean=np.asarray(frame.electrons_mean, dtype=np.float32),
                electrons_stderr=np.asarray(frame.electrons_stderr, dtype=np.float32),
            )
        self.manifest["frames"].append({**frame.times, "file": file, "truth": truth})

    def add_events(self, events: NDArray) -> None:
        with output_errors(self._folder.target):
            self._events.append(events)
        on = int(np.count_nonzero(events["polarity"] > 0))
        self._on, self._off = self._on + on, self._off + events.size - on

    def set_event_truth(self, truth: EventTruth) -> None:
        with output_errors(self._folder.target):
            np.savez(
                self._folder.path / "truth" / "events.npz",
                flux_mean_e_per_s=np.asarray(truth.flux_mean_e_per_s, dtype=np.float32),
                flux_stderr_e_per_s=np.asarray(truth.flux_stderr_e_per_s, dtype=np.float32),
            )

    def set_events_dropped(self, count: int) -> None:
        self._dropped = int(count)

    def finish(self) -> Path:
        """Write manifest and previews and give the folder its name; returns it."""
        from hesim_render.recording.showcase import write_previews

        with output_errors(self._folder.target):
            self._events.close()
            self.manifest["counts"] = {
                "frames": len(self.manifest["frames"]),
                "events": self._on + self._off,
                "events_on": self._on,
                "events_off": self._off,
                "events_dropped": self._dropped,
            }
            text = manifests.to_text(self.manifest) + "\n"
            (self._folder.path / manifests.MANIFEST_NAME).write_text(text, encoding="utf-8")
            write_previews(Recording.load(self._folder.path), self._folder.path)
        target = self._folder.commit()
        self._finished = True
        return target

    def __enter__(self) -> FolderWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if not self._finished:
            self._events.abandon()
            self._folder.discard()


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


def _read_maps(file: Path, names: tuple[str, ...], shape: tuple[int, int]) -> list[NDArray[np.float32]]:
    """Maps of float32 of one size, in the order of their names."""
    found = read_arrays(file, names, only=names, shapes=dict.fromkeys(names, shape), kinds="f")
    return [found[name].astype(np.float32, copy=False) for name in names]

"""Writer of a recording's folder."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.exchange.dsec import EventFileWriter
from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import LabelBlock
from hesim_render.recording import manifest as manifests
from hesim_render.recording.colour_view import thumbnail
from hesim_render.recording.dng import write_dng
from hesim_render.recording.frame import EventTruth, Frame
from hesim_render.recording.label_file import LabelFileWriter, write_objects
from hesim_render.recording.recorded import Recorded
from hesim_render.recording.showcase import write_previews


class FolderWriter:
    """Streams a recording into a folder; `RecordingWriter` is the public interface.

    Parameters
    ----------
    path : folder to write.
    manifest : the manifest; its frames and counts (those of another recording) are dropped.
    overwrite : replace an existing recording.
    """

    def __init__(self, path: str | Path, manifest: Mapping[str, Any], overwrite: bool = False) -> None:
        self._folder = OutputFolder(path, manifests.MANIFEST_NAME, overwrite)
        self.manifest: dict[str, Any] = {**manifest, "frames": [], "counts": {}}
        self._on = self._off = self._dropped = 0
        self._mosaic = Mosaic.model_validate(manifest["mosaic"])
        self._finished = False
        self._labels: LabelFileWriter | None = None
        self._objects_at: Callable[[NDArray, NDArray, NDArray], NDArray[np.uint16]] | None = None
        time, grid = manifest["time"], manifest["event_grid"]
        self._grid_and_time = (grid["height"], grid["width"]), time["begin_us"], time["end_us"]
        try:
            with output_errors(self._folder.target):
                for name in ("frames", "truth"):
                    (self._folder.path / name).mkdir()
                self._valid = self._mosaic_mask()
                np.save(self._folder.path / "truth" / "valid.npy", self._valid)
                self._events = EventFileWriter(self._folder.path / "events.h5", *self._grid_and_time)
        except BaseException:
            self._folder.discard()
            raise

    @property
    def path(self) -> Path:
        """The folder, which has another name until it is complete."""
        return self._folder.path

    def _mosaic_mask(self) -> NDArray[np.bool_]:
        roi = self.manifest["roi"]
        return self._mosaic.tiled(np.array(self._mosaic.tile_aps), (roi["height_px"], roi["width_px"]))

    def add_frame(self, frame: Frame) -> None:
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

    def add_event_labels(self, block: LabelBlock) -> None:
        with output_errors(self._folder.target):
            if self._labels is None:
                self._labels = LabelFileWriter(self._folder.path, *self._grid_and_time)
            self._labels.append(block)

    def set_event_objects(self, objects_at: Callable[[NDArray, NDArray, NDArray], NDArray[np.uint16]]) -> None:
        """Have the object of each event written when all events are there, as `write_objects` does."""
        self._objects_at = objects_at

    def set_events_dropped(self, count: int) -> None:
        self._dropped = int(count)

    def write_in(self, name: str, write: Callable[[Path], object]) -> None:
        """Have a function write one more file, whose path it gets."""
        with output_errors(self._folder.target):
            write(self._folder.path / name)

    def copy_in(self, source: Path, name: str) -> None:
        """Copy one more file."""
        self.write_in(name, lambda path: shutil.copyfile(source, path))

    def finish(self) -> Path:
        """Write the manifest, draw the previews, and rename the folder to its final name, which is returned."""
        with output_errors(self._folder.target):
            self._events.close()
            if self._labels is not None:
                self._labels.close()
            if self._objects_at is not None:
                write_objects(self._folder.path, self._objects_at)
            self.manifest["counts"] = {
                "frames": len(self.manifest["frames"]),
                "events": self._on + self._off,
                "events_on": self._on,
                "events_off": self._off,
                "events_dropped": self._dropped,
            }
            text = manifests.to_text(self.manifest) + "\n"
            (self._folder.path / manifests.MANIFEST_NAME).write_text(text, encoding="utf-8")
            write_previews(Recorded.load(self._folder.path), self._folder.path)
        target = self._folder.commit()
        self._finished = True
        return target

    def __enter__(self) -> "FolderWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if not self._finished:
            self._events.abandon()
            if self._labels is not None:
                self._labels.abandon()
            self._folder.discard()

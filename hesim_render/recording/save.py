"""A recording as a folder on disk."""

from __future__ import annotations

import contextlib
from pathlib import Path

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import inside
from hesim_render.recording.folder import FolderWriter
from hesim_render.recording.label_file import OBJECT_FILE
from hesim_render.recording.recorded import Recorded
from hesim_render.recording.truth_file import TRUTH_FILE, TruthRequest, write_truth


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

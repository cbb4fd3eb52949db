"""Recordings and event files in the formats of other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from hesim_render.core.errors import OutputError, RangeError, did_you_mean
from hesim_render.core.output import OutputFolder, check_place, output_errors, replacing
from hesim_render.exchange import EVENT_FORMATS, FRAME_FORMATS, EventStream, open_events
from hesim_render.exchange.dsec import stream_events

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording

#: File that says what the frames of a folder are, and marks the folder for `overwrite`.
FRAMES_NAME = "frames.json"


def event_stream(recording: Recording) -> EventStream:
    """The events of a recording; from disk, one block at a time."""
    grid, time = recording.event_shape, recording.manifest["time"]
    interval = time["begin_us"], time["end_us"]
    if recording.path is None:
        return EventStream(lambda: EventStream.of(recording.events, grid), grid, "recording", interval)
    file, count = recording.path / "events.h5", recording.manifest["counts"]["events"]
    return EventStream(lambda: stream_events(file, count), grid, file, interval)


def export(recording: Recording, format: str, path: str | Path, overwrite: bool = False) -> Path:
    """Write the events of a recording as a file, its frames or its geometric truth as a folder; see
    `Recording.export`.
    """
    from hesim_render.recording.truth_export import FORMATS as TRUTH_FORMATS
    from hesim_render.recording.truth_export import export_truth

    check_format(format, 0 not in recording.event_shape, bool(len(recording.frames)))
    if format in TRUTH_FORMATS:
        return export_truth(recording, format, path, overwrite=overwrite)
    if format in EVENT_FORMATS:
        return write_events(event_stream(recording), format, path, overwrite)
    return _write_frames(recording, format, path, overwrite)


def check_format(format: str, has_events: bool, has_frames: bool) -> None:
    """Refuse a format that does not exist, or of what a recording does not have.

    Raises
    ------
    RangeError
        With the formats that can be used.
    """
    from hesim_render.recording.truth_export import FORMATS as TRUTH_FORMATS

    known = (*EVENT_FORMATS, *FRAME_FORMATS, *TRUTH_FORMATS)
    if format not in known:
        raise RangeError("format", format, f"one of {', '.join(known)}{did_you_mean(format, known)}")
    if format in EVENT_FORMATS and not has_events:
        raise RangeError("format", format, f"a format of frames ({', '.join(FRAME_FORMATS)}): there are no events")
    if format in FRAME_FORMATS and not has_frames:
        raise RangeError("format", format, f"a format of events ({', '.join(EVENT_FORMATS)}): there are no frames")


def write_events(stream: EventStream, format: str, path: str | Path, overwrite: bool = False) -> Path:
    """Write a stream of events as a file, which appears whole or not at all.

    Raises
    ------
    OutputError
        If the file exists (and `overwrite` is not set), is the source of the stream, or cannot be written.
    SpecError
        If the events do not fit into the format.
    """
    target = check_place(path)
    with output_errors(target):
        exists = target.exists() or target.is_symlink()
        if exists and target.resolve() == Path(stream.source).resolve():
            raise OutputError(f"{path}: is the file of the events itself; give another name")
    if exists and not overwrite:
        raise OutputError(f"{path}: exists; give another name, or overwrite it (--overwrite, overwrite=True)")
    with replacing(target) as temporary, temporary.open("wb") as file:
        EVENT_FORMATS[format].write(stream, file, target)
    return target


def import_events(
    source: str | Path,
    path: str | Path,
    *,
    format: str | None = None,
    shape: tuple[int, int] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the events of another program's file as HDF5 in the layout of a recording's ``events.h5``.

    Parameters
    ----------
    source : the file, of a format that `open_events` reads.
    path : file to write.
    format : format of `source`; default: what its begin says.
    shape : rows and columns of the event grid, px; needed if the file does not state them.
    overwrite : replace an existing file.

    Returns
    -------
    The file written, absolute.

    Raises
    ------
    OutputError
        If `path` exists (and `overwrite` is not set) or cannot be written.
    SpecError
        If `source` is damaged, of another format, or has events out of order or outside of the grid.
    """
    return write_events(open_events(source, format, shape), "dsec", path, overwrite)


def _write_frames(recording: Recording, format: str, path: str | Path, overwrite: bool) -> Path:
    """Write all frames as files of one folder, with `FRAMES_NAME` beside them."""
    kind, mosaic = FRAME_FORMATS[format], recording.mosaic
    folder = OutputFolder(path, FRAMES_NAME, overwrite)
    try:
        entries = []
        for frame in recording.frames:
            name = f"{frame.index:06d}{kind.suffix}"
            with output_errors(folder.target):
                kind.write(folder.path / name, frame.raw)
            entries.append({"file": name, **frame.times})
        facts = {
            "format": format,
            "black_level_dn": mosaic.black_level_dn,
            "white_level_dn": mosaic.white_level_dn,
            "bit_depth": mosaic.bit_depth,
            "tile_filter": mosaic.tile_filter,
            "tile_aps": mosaic.tile_aps,
            "frames": entries,
        }
        with output_errors(folder.target):
            (folder.path / FRAMES_NAME).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
        return folder.commit()
    except BaseException:
        folder.discard()
        raise

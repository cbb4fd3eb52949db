"""Recordings and event files in the formats of other programs."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import OutputError, RangeError, did_you_mean
from hesim_render.core.output import OutputFolder, check_place, free_place, output_errors, replacing
from hesim_render.exchange import EVENT_FORMATS, FRAME_FORMATS, EventStream, event_packets, mcap_file, open_events
from hesim_render.exchange.dsec import stream_events
from hesim_render.exchange.triggers import exposure_triggers
from hesim_render.mosaic.description import Mosaic
from hesim_render.recording.movie import write_movie
from hesim_render.recording.recorded import Recorded

#: File that says what the frames of a folder are, and marks the folder for `overwrite`.
FRAMES_NAME = "frames.json"
#: Formats of events and frames together.
WHOLE_FORMATS = ("mcap", "mcap-evt3", "raw-npz", "mp4", "mp4-colour", "mp4-events")
#: Ends of the names of formats that are one file; all others are folders.
SUFFIXES: dict[str, tuple[str, ...]] = {
    **{name: (kind.suffix,) for name, kind in EVENT_FORMATS.items()},
    **{name: (".h5", ".hdf5") for name in ("dsec", "dsec-gzip", "prophesee")},
    **{name: (".mcap" if name.startswith("mcap") else ".mp4",) for name in WHOLE_FORMATS if name != "raw-npz"},
}
_FILES = {end for ends in SUFFIXES.values() for end in ends} | {kind.suffix for kind in FRAME_FORMATS.values()}
_FILES |= {".tif", ".exr", ".yaml", ".csv", ".json"}
_NEED_FRAMES = (*FRAME_FORMATS, "mp4-colour")


def event_stream(recording: Recorded) -> EventStream:
    """The events of a recording; from disk, one block at a time. Its triggers are the exposures of the frames' first
    rows.
    """
    grid, time = recording.event_shape, recording.manifest["time"]
    interval = time["begin_us"], time["end_us"]
    if recording.path is None:
        return EventStream(
            lambda: EventStream.of(recording.events, grid), grid, "recording", interval, lambda: _triggers(recording)
        )
    file, count = recording.path / "events.h5", recording.manifest["counts"]["events"]
    return EventStream(lambda: stream_events(file, count), grid, file, interval, lambda: _triggers(recording))


def _triggers(recording: Recorded) -> NDArray:
    """Edges at the begin and the end of the exposure of each frame's first row."""
    begin = np.array([frame["exposure_start_us"] for frame in recording.manifest["frames"]], np.int64)
    return exposure_triggers(begin, begin + [frame["exposure_us"] for frame in recording.manifest["frames"]])


def export(recording: Recorded, format: str, path: str | Path, overwrite: bool = False) -> Path:
    """Write the events of a recording as a file, its frames or its geometric truth as a folder; see
    `Recording.export`.
    """
    from hesim_render.recording.truth_export import FORMATS as TRUTH_FORMATS
    from hesim_render.recording.truth_export import export_truth

    check_format(format, 0 not in recording.event_shape, bool(len(recording.frames)))
    check_name(format, path)
    if format in TRUTH_FORMATS:
        return export_truth(recording, format, path, overwrite=overwrite)
    if format in EVENT_FORMATS:
        return write_events(event_stream(recording), format, path, overwrite)
    if format == "raw-npz":
        return _write_ticks(recording, path, overwrite)
    if format in WHOLE_FORMATS:
        target = free_place(path, overwrite)
        with replacing(target) as temporary:
            if format in ("mcap", "mcap-evt3"):
                packed = None if format == "mcap" else (
                    event_packets.TYPE, event_packets.DEFINITION, event_packets.packets,
                )  # fmt: skip
                _write_mcap(recording, temporary, target, packed)
            else:
                write_movie(recording, temporary, format)
        return target
    return _write_frames(recording, format, path, overwrite)


def every_format() -> tuple[str, ...]:
    """Names of all formats: of events, of frames, of both, of geometric truth."""
    from hesim_render.recording.truth_export import FORMATS as TRUTH_FORMATS

    return (*EVENT_FORMATS, *FRAME_FORMATS, *WHOLE_FORMATS, *TRUTH_FORMATS)


def check_format(format: str, has_events: bool, has_frames: bool) -> None:
    """Refuse a format that does not exist, or of what a recording does not have.

    Raises
    ------
    RangeError
        With the formats that can be used.
    """
    known = every_format()
    if format not in known:
        raise RangeError("format", format, f"one of {', '.join(known)}{did_you_mean(format, known)}")
    if format in (*EVENT_FORMATS, "mp4-events") and not has_events:
        raise RangeError("format", format, f"a format of frames ({', '.join(FRAME_FORMATS)}): there are no events")
    if format in _NEED_FRAMES and not has_frames:
        raise RangeError("format", format, f"a format of events ({', '.join(EVENT_FORMATS)}): there are no frames")


def check_name(format: str, path: str | Path) -> None:
    """Refuse a name that says something else than the format: another kind of file, or a file where a folder comes.

    Raises
    ------
    OutputError
        With the end that the name has to have.
    """
    own, given = SUFFIXES.get(format, ()), Path(path).suffix.lower()
    if own and given not in own:
        raise OutputError(f"{path}: {format} is a file; give a name that ends in {' or '.join(own)}")
    if not own and given in _FILES:
        raise OutputError(f"{path}: {format} is a folder of files; give a name without {given}")


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
        if target.exists() and target.resolve() == Path(stream.source).resolve():
            raise OutputError(f"{path}: is the file of the events itself; give another name")
    free_place(path, overwrite)
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

    Raises
    ------
    OutputError
        If `path` exists (and `overwrite` is not set) or cannot be written.
    SpecError
        If `source` is damaged, of another format, or has events out of order or outside of the grid.
    """
    check_name("dsec", path)
    return write_events(open_events(source, format, shape), "dsec", path, overwrite)


def _write_mcap(recording: Recorded, path: Path, target: Path, packed: mcap_file.Packed | None) -> None:
    """Events and frames as messages of ROS 2."""
    events = event_stream(recording) if min(recording.event_shape) > 0 else None
    frames = ((frame.t_us, frame.raw) for frame in recording.frames)
    with path.open("wb") as file:
        mcap_file.write(events, frames, mosaic_encoding(recording.mosaic), file, target, packed)


def mosaic_encoding(mosaic: Mosaic) -> str:
    """Name of a mosaic in ``sensor_msgs/image_encodings``; ``mono16`` where it has none."""
    letters = "".join("RGB"[code] if code < len("RGB") else "?" for code in mosaic.tile_code.ravel())
    known = mosaic.tile_shape == (2, 2) and letters in ("RGGB", "BGGR", "GRBG", "GBRG")
    return f"bayer_{letters.lower()}16" if known else "mono16"


def _write_ticks(recording: Recorded, path: str | Path, overwrite: bool) -> Path:
    """The npz files of H-ESIM and RGB-Event-ISP, with `FRAMES_NAME` to mark the folder."""
    tick_us = (recording.manifest["sensor"]["spec"].get("evs") or {}).get("tick_us")
    if tick_us is None and not len(recording.frames):
        raise RangeError("format", "raw-npz", "a format of events: there are no frames, and no ticks")
    with OutputFolder(path, FRAMES_NAME, overwrite) as folder, output_errors(folder.target):
        write_tick_files(recording, folder.path, tick_us)
        facts = {"format": "raw-npz", "tick_us": tick_us, "frames": [frame.times for frame in recording.frames]}
        (folder.path / FRAMES_NAME).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    return folder.target


def _write_frames(recording: Recorded, format: str, path: str | Path, overwrite: bool) -> Path:
    """Write all frames as files of one folder, with `FRAMES_NAME` beside them."""
    kind, mosaic = FRAME_FORMATS[format], recording.mosaic
    with OutputFolder(path, FRAMES_NAME, overwrite) as folder:
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
    return folder.target


def write_tick_files(recording: Recorded, folder: Path, tick_us: int | None) -> int:
    """Write ``TTTTTTTTT_aps_raw.npz`` and ``TTTTTTTTT_evs.npz``, with the time in µs in nine digits.

    H-ESIM has frames as ``raw`` and events as ``events``, -1, 0 or +1; RGB-Event-ISP has ``aps_raw`` and ``event_raw``,
    0, 1 (OFF) or 2 (ON). Each file has both. Of two events of a pixel in one tick the later one counts.
    Returns the number of frames.

    Parameters
    ----------
    recording, folder : the recording, and a folder, which is made.
    tick_us : interval of the comparisons, µs; None writes frames alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for frame in recording.frames:
        np.savez_compressed(folder / f"{frame.t_us:09d}_aps_raw.npz", raw=frame.raw, aps_raw=frame.raw)
    if tick_us is None:
        return len(recording.frames)
    begin_us, end_us = (recording.manifest["time"][name] for name in ("begin_us", "end_us"))
    if recording.event_slice(end_us // tick_us * tick_us + 1, end_us + 1).size:  # a camera's, within a tick
        end_us += tick_us
    for tick in range((begin_us // tick_us + 1) * tick_us, end_us + 1, tick_us):
        result = recording.event_slice(tick - tick_us + 1, tick + 1)
        signs = np.zeros(recording.event_shape, np.int8)
        signs[result["y"], result["x"]] = result["polarity"]
        codes = np.select([signs > 0, signs < 0], [2, 1], 0).astype(np.uint8)
        np.savez_compressed(folder / f"{tick:09d}_evs.npz", events=signs, event_raw=codes)
    return len(recording.frames)

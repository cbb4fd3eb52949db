"""Captures of real sensors as recordings."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.exchange import EventStream, mcap_file, open_events
from hesim_render.exchange.triggers import exposures_of_pulses
from hesim_render.mosaic.description import describe
from hesim_render.recording.camera_raw import CAMERA_SUFFIXES, read_camera_raw, read_raw
from hesim_render.recording.dng import is_packed
from hesim_render.recording.exports import mosaic_encoding
from hesim_render.recording.frame import Frame
from hesim_render.recording.recording import Recording
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor


def import_recording(
    path: str | Path,
    sensor: Sensor,
    *,
    events: str | Path | None = None,
    frames: Sequence[str | Path] = (),
    format: str | None = None,
    trigger_channel: int | None = None,
    from_zero: bool = False,
    overwrite: bool = False,
) -> Recording:
    """Write a capture as a recording, for the ISP and the viewers. Its truth is unknown: the maps of frames are NaN.

    Parameters
    ----------
    path : folder to write.
    sensor : the sensor file that describes the camera, cropped to the region that was read out.
    events : event file of a format that `open_events` reads, with the event grid of the sensor. Of an MCAP file the
        images are taken as well, unless `frames` are given.
    frames : RAW frames in order of time, uint16 [row, col], DN: DNG and TIFF files (the mosaic as first image), PNG,
        NPY, npz of H-ESIM and RGB-Event-ISP, or RAW files of cameras, through rawpy, as DNG of cameras. Frame k begins
        at k / frame rate of the sensor file, and has the exposure of that file. Or one MCAP file, whose images are
        taken with their own times, which are those of the ends of their first rows' exposures.
    format : of the event file, such as ``evt3``; a file of another one is refused. Default: as the file states.
    trigger_channel : line of the event file whose triggers are the exposures of the frames' first rows: a rising edge
        at the begin and a falling one at the end of each, so that frames and events have one clock. None: the times
        above.
    from_zero : count times from the begin of the recording, not by the camera's clock, which may be the time of day.
    overwrite : replace an existing recording.

    Raises
    ------
    OutputError
        If `path` exists (and `overwrite` is not set) or cannot be written.
    RangeError
        If neither events nor frames are given, frames of a sensor that has none, a line of triggers without both, or
        a format that is unknown or without events.
    SpecError
        If a file is damaged, does not fit the sensor, or has other triggers than a pulse for each frame.
    """
    aps, layout = sensor.spec.aps, sensor.layout
    events, frames = _of_mcap(events, frames, sensor)
    if events is None and not frames:
        raise RangeError("frames", list(frames), "events, frames or both")
    if frames and aps is None:
        raise RangeError("frames", len(frames), f"none, because {sensor.spec.name} has no frame pixels")
    if format is not None and events is None:
        raise RangeError("format", format, "nothing, unless events are given")
    stream = None if events is None else _events(events, sensor, format)
    if trigger_channel is not None and (stream is None or not frames):
        raise RangeError("trigger_channel", trigger_channel, "nothing, unless both events and frames are given")
    # begin and length of each exposure, µs; the recording ends with the last row, or with the events
    spans = [] if stream is None else [_span_us(stream)]
    times: list[tuple[int, int]] = []
    if aps is not None and frames:
        if stream is not None and trigger_channel is not None:
            times = _triggered(stream, trigger_channel, frames)
        else:
            starts = _starts_us(frames, aps.frame_rate_hz, aps.exposure_us)
            times = [(start, aps.exposure_us) for start in starts]
        spans.append((times[0][0], sum(times[-1]) + round((layout.rows - 1) * aps.line_time_us)))
    begin_us, end_us = min(begin for begin, _ in spans), max(end for _, end in spans)
    zero_us = begin_us if from_zero else 0
    settings = {"imported": {"events": _name(events), "frames": [_name(file) for file in frames]}}
    with RecordingWriter(
        path, sensor, seed=0, begin_us=begin_us - zero_us, duration_us=end_us - begin_us, settings=settings,
        overwrite=overwrite,
    ) as writer:  # fmt: skip
        valid = layout.aps_mask
        unknown = np.full(layout.shape, np.nan, dtype=np.float32)
        for index, (raw, (start_us, exposure_us)) in enumerate(zip(_frames(frames, sensor), times, strict=True)):
            assert aps is not None
            start_us -= zero_us
            writer.add_frame(
                Frame(
                    raw=np.where(valid, raw, 0).astype(np.uint16), valid=valid, electrons_mean=unknown,
                    electrons_stderr=unknown, t_us=start_us + exposure_us, exposure_start_us=start_us,
                    exposure_us=exposure_us, line_time_us=aps.line_time_us, index=index,
                )
            )  # fmt: skip
        for block in stream or ():
            if zero_us:
                block = block.copy()
                block["t_us"] -= zero_us
            writer.add_events(block)
        return writer.finish()


def _of_mcap(
    events: str | Path | None, frames: Sequence[str | Path], sensor: Sensor
) -> tuple[str | Path | None, Sequence[str | Path]]:
    """Events and frames of what is given: an MCAP file of events may hold the frames as well, or alone."""
    if events is None or Path(events).suffix.lower() != ".mcap":
        return events, frames
    has_events, has_frames = mcap_file.holds(Path(events).expanduser())
    if has_frames and sensor.spec.aps is not None and not frames:
        frames = [events]
    return (events if has_events and sensor.spec.evs is not None else None), frames


def _name(file: str | Path | None) -> str | None:
    return None if file is None else Path(file).name


def _events(file: str | Path, sensor: Sensor, format: str | None) -> EventStream:
    """The events of a file, whose grid, where it states one, must be that of the sensor."""
    grid = sensor.layout.evs_shape
    stream = open_events(file, format, shape=grid, keep_stated=True)
    if stream.shape != grid:
        (rows, cols), (wanted_rows, wanted_cols) = stream.shape, grid
        problem = f"is of {cols}x{rows} px; the event grid of {sensor.spec.name} has {wanted_cols}x{wanted_rows}"
        raise SpecError(problem, file=file)
    return stream


def _span_us(stream: EventStream) -> tuple[int, int]:
    """Begin and end of the events, µs: the begin that the file states, or the whole ms before the first event, since
    the clock of a camera may have run for long.
    """
    begin_us, end_us = stream.span_us()
    return (max(0, begin_us - 1) // 1000 * 1000 if stream.interval_us is None else begin_us), end_us


def _triggered(stream: EventStream, channel: int, frames: Sequence[str | Path]) -> list[tuple[int, int]]:
    """Begin and length of each exposure, µs, by the triggers of a line: a pulse for each frame."""
    images = _images_of(frames)
    count = len(frames) if images is None else sum(1 for _ in mcap_file.read_frames(images))
    begin, end = exposures_of_pulses(stream.triggers(), channel, count, stream.source)
    if np.any(end <= begin):
        raise SpecError(f"has pulses of triggers on line {channel} without length", file=stream.source)
    return list(zip(begin.tolist(), (end - begin).tolist(), strict=True))


def _images_of(frames: Sequence[str | Path]) -> Path | None:
    """The MCAP file that holds the frames; None where each has a file."""
    files = [Path(file).expanduser() for file in frames]
    messages = next((file for file in files if file.suffix.lower() == ".mcap"), None)
    if messages is not None and len(files) > 1:
        raise SpecError("has all frames or none; give no other files of frames", file=messages)
    return messages


def _starts_us(frames: Sequence[str | Path], frame_rate_hz: float, exposure_us: int) -> list[int]:
    """Begin of each frame, µs."""
    messages = _images_of(frames)
    if messages is None:
        return [round(k * 1e6 / frame_rate_hz) for k in range(len(frames))]
    starts = [max(0, t_us - exposure_us) for t_us, *_ in mcap_file.read_frames(messages)]
    if not starts:
        raise SpecError("has no messages of type Image", file=messages)
    if np.any(np.diff(starts) < 0):
        raise SpecError("has images that are not in order of time", file=messages)
    return starts


def _frames(frames: Sequence[str | Path], sensor: Sensor) -> Iterator[NDArray[np.uint16]]:
    """The DN of each frame, [row, col]."""
    messages = _images_of(frames)
    if messages is None:
        yield from (_frame(Path(file).expanduser(), sensor) for file in frames)
        return
    own = mosaic_encoding(describe(sensor, None))
    for _, raw, encoding in mcap_file.read_frames(messages):
        if encoding.startswith("bayer_") and encoding.removesuffix("8").removesuffix("16") != own.removesuffix("16"):
            raise SpecError(f"has images of encoding {encoding}; the region of the sensor is {own}", file=messages)
        if raw.shape != sensor.layout.shape:
            problem = f"has an image of {raw.shape[1]}x{raw.shape[0]} px"
            raise SpecError(f"{problem}; the region has {sensor.cols}x{sensor.rows}", file=messages)
        yield _checked(raw, sensor, messages)


def _frame(file: Path, sensor: Sensor) -> NDArray[np.uint16]:
    """The DN of a frame, [row, col]."""
    suffix, shape = file.suffix.lower(), sensor.layout.shape
    if suffix in CAMERA_SUFFIXES or (suffix == ".dng" and is_packed(file)):
        raw = read_camera_raw(file, sensor)
    else:
        raw = read_raw(file, shape)
    return _checked(raw, sensor, file)


def _checked(raw: NDArray[np.uint16], sensor: Sensor, file: Path) -> NDArray[np.uint16]:
    """A frame, which must fit the bit depth of the sensor."""
    assert sensor.spec.aps is not None
    bit_depth = sensor.spec.aps.bit_depth
    if raw.max() >= 1 << bit_depth:
        raise SpecError(f"holds {raw.max()} DN; the sensor has {bit_depth} bit", file=file)
    return raw

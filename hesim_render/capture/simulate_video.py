"""Simulate a sensor in front of a video: RAW frames and events from pictures instead of a rendered scene.

What a run has given so far, and its state then, go into a journal: an interrupted run goes on without asking its source
again for what has passed.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import checked_seed, noise_models
from hesim_render.capture.scene_run import require_short
from hesim_render.core import backend
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.journal import Journal, journal_of, key_of
from hesim_render.core.plain import from_bytes, to_bytes
from hesim_render.core.progress import Progress, expect, shown
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.mosaic.description import Mosaic, describe
from hesim_render.mosaic.schedule import require_countable
from hesim_render.pixels.arrays import SavedState
from hesim_render.recording.frame import Frame
from hesim_render.recording.recording import Recording, warn_of_exposure
from hesim_render.recording.writer import RecordingWriter
from hesim_render.sensor.sensor import Sensor, as_sensor
from hesim_render.sources.video import VideoFlux, VideoOptions
from hesim_render.sources.video.digest import stamp_of
from hesim_render.sources.video.estimate import VideoEstimate
from hesim_render.sources.video.flux import Source
from hesim_render.spectral import spectrum as spectra

#: Tolerance of a duration that is given as the rounded length of the video, µs.
_SLACK_US = 1.0
#: Estimated time of a run above which it is kept for another one to go on from, and time between its states, s.
_LONG_S, _PART_S = 20.0, 10.0
#: Events that are held before they are kept.
_MOST_EVENTS = 1 << 20


def simulate_video(
    source: Source,
    sensor: Sensor | str | Path,
    *,
    duration_s: float | None = None,
    seed: int = 7,
    clean: bool = False,
    without: Sequence[str] = (),
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
    max_minutes: float | None = None,
    on_estimate: Callable[[VideoEstimate], None] | None = None,
    resume: bool = False,
    live: bool = False,
    **options: object,
) -> Recording:
    """Simulate a sensor in front of a video: RAW frames, events, and their noise-free truth.

    Parameters
    ----------
    source : path of a video file, of a folder of numbered pictures or of a ``.npy`` file, or an array
        [time, row, col] or [time, row, col, channel].
    sensor : from `load_sensor` (crop it for a region of interest), or its name or path.
    duration_s : simulated time from the video's first picture, s; default: the whole video.
    seed, clean, without, out, overwrite, progress, max_minutes, on_estimate : as for `simulate`.
    resume : keep the frames and events of a run of more than about 20 s in a file beside `out`, until the recording is
        complete. The same call goes on from what an interrupted one has left there, and gives the same bytes.
    live : as for `simulate`.
    options : options of `sources.video.VideoOptions`: ``fps``, ``slow_motion``, ``duty``, ``interpolation``, colour
        tags, ``mode``, ``white_lux`` or ``white_e_per_s`` with ``white_filter``, ``fit``, ``lens_shading``, …

    Examples
    --------
    Each of these four pictures is brighter than the one before, so every pixel sees three steps up.

    >>> import numpy as np
    >>> import hesim_render as hr
    >>> clip = np.repeat([60, 90, 120, 150], 48 * 64 * 3).reshape(4, 48, 64, 3).astype(np.uint8)
    >>> sensor = hr.load_sensor("reference-mono").crop(32, 24)
    >>> tags = {"transfer": "srgb", "primaries": "bt709"}
    >>> rec = hr.simulate_video(clip, sensor, fps=200, white_lux=500, clean=True, **tags)
    >>> len(rec.events) == 3 * 32 * 24, set(rec.events["polarity"].tolist())
    (True, {1})

    Returns
    -------
    Recording
        As from `simulate`; the standard errors of the truth are 0. ``settings.video`` of its manifest holds the
        hash of the input and all processing options.

    Raises
    ------
    SpecError
        If the video cannot be read, is damaged, or lacks colour tags or a clock.
    RangeError
        If a value is out of range, or the duration is longer than the video.
    TooLongError
        If the run would take longer than `max_minutes`.
    OutputError
        If `out` exists or cannot be written, or, with `resume`, if another run was interrupted there. No partial
        output is left.
    """
    sensor = as_sensor(sensor)
    seed, clean = checked_seed(seed), bool(clean)
    backend.jit()
    aps, evs = noise_models(sensor, clean, without)
    flux = VideoFlux(source, sensor, VideoOptions.of(**options))
    try:
        duration_us = _duration_us(duration_s, flux)
        require_countable(sensor.spec.aps, sensor.spec.evs, duration_us)
        capture = Capture(flux, sensor, aps, evs, duration_us, seed)
        expected = flux.estimate(capture.demand)
        if on_estimate is not None:
            on_estimate(expected)
        if max_minutes is not None:
            require_short(expected, max_minutes, "a shorter --duration or a smaller --roi")
        settings = {
            "clean": clean,
            "without": list(without),
            "backend": backend.select().label,
        }
        with (
            RecordingWriter(
                out,
                sensor,
                seed=seed,
                duration_us=duration_us,
                settings=settings,
                overwrite=overwrite,
                mosaic=_mosaic(sensor, flux.options),
                live=live,
            ) as writer,
            _journal(resume, source, flux, expected, out, writer, overwrite) as journal,
        ):
            with shown(progress, f"{Path(flux.name).name} → {sensor.name}") as report:
                expect(report, expected.seconds)
                flux.start_digest()
                kept = None if journal is None else KeptRun(capture, journal, _PART_S)
                if kept is not None:
                    kept.go_on(writer, report)
                capture.record(writer, report, None if kept is None else kept.keep)
            writer.add_settings({"video": flux.describe()})
            return warn_of_exposure(writer.finish())
    finally:
        flux.close()


def _journal(
    is_kept: bool,
    source: Source,
    flux: VideoFlux,
    expected: VideoEstimate,
    out: str | Path | None,
    writer: RecordingWriter,
    overwrite: bool,
) -> AbstractContextManager[Journal | None]:
    """The journal of a long run, or of any that was interrupted; nothing where none is kept."""
    if not is_kept or out is None or (expected.seconds < _LONG_S and not journal_of(out).is_file()):
        return nullcontext()
    made_by = writer.run["software"] | {"av": version("av")}
    return Journal(out, {**writer.run, "software": made_by, **flux.settings, "input": stamp_of(source)}, overwrite)


def _duration_us(duration_s: float | None, flux: VideoFlux) -> int:
    """Length of the run in whole µs, within the video."""
    length_us = flux.clock.end_us
    if duration_s is None:
        if flux.cut_short:
            raise SpecError(
                f"ends after {length_us * S_PER_US:.6g} s, but it once was longer ({flux.cut_short}): copy it again, "
                "or give a duration within that time",
                file=flux.name,
            )
        duration_us = int(length_us + 1e-3)
        if duration_us < 1:
            raise SpecError(f"lasts {length_us:g} µs, less than one", file=flux.name)
        return duration_us
    if not 0 < duration_s < float("inf"):
        raise RangeError("duration_s", duration_s, "a time above 0, in seconds")
    duration_us = round(duration_s * US_PER_S)
    if duration_us < 1 or duration_us > length_us + _SLACK_US:
        raise RangeError("duration_s", duration_s, f"at most the video's {length_us * S_PER_US:.6g} s")
    return duration_us


def _mosaic(sensor: Sensor, options: VideoOptions) -> Mosaic:
    """The sensor's mosaic under the light of the video, with the balance and matrix of the camera, if one was given."""
    mosaic = describe(sensor, spectra.illuminant(options.illuminant))
    camera = options.camera
    if camera is None or sorted(camera.channels) != sorted(mosaic.channels):
        return mosaic
    order = [camera.channels.index(name) for name in mosaic.channels]
    neutral = 1 / np.array(camera.white_balance)[order]
    return mosaic.model_copy(
        update={
            "neutral": (neutral / neutral.max()).tolist(),
            "camera_to_srgb": np.array(camera.matrix)[:, order].tolist(),
        }
    )


class KeptRun:
    """Keeps the frames and events of a capture in a journal, with the state of the capture after each part.

    Frames are kept when they come, events at the end of a part at the latest. What was kept after the last whole part
    is not used again.

    Parameters
    ----------
    capture : a run that has not begun, without labels. Its source computes both halves alike: standard errors are 0.
    journal : where to keep it.
    part_s : length of a part in time of the clock, s; a kill costs one at most.
    """

    def __init__(self, capture: Capture, journal: Journal, part_s: float) -> None:
        self._capture, self._journal, self._part_s = capture, journal, part_s
        self._parts = self._frames = self._chunks = 0
        self._blocks: list[NDArray] = []
        self._end_s = time.monotonic() + part_s

    def go_on(self, writer: RecordingWriter, progress: Progress | None = None) -> None:
        """Give a writer what the journal holds, and let the capture begin after it; see `Capture.record`."""
        state = None
        while part := self._read("part", self._parts):
            frames, chunks = range(self._frames, part["frames"]), range(self._chunks, part["chunks"])
            whole = [("frame", k) for k in frames] + [("events", k) for k in chunks]
            if any(self._journal.read(key_of(*name)) is None for name in whole):  # before any of it is written
                break
            for k in chunks:
                stored = self._read("events", k)
                # in the blocks in which they came, which decide the bytes of the file
                for block in np.split(stored["events"], np.cumsum(stored["sizes"])[:-1]):
                    writer.add_events(block)
            for k in frames:
                writer.add_frame(self._frame(self._read("frame", k)))
            state, self._frames, self._chunks = part["capture"], part["frames"], part["chunks"]
            self._parts += 1
            if progress is not None:
                done_us, end_us = part["progress"]
                progress(done_us, end_us, "simulated µs")
        if state is not None:
            self._capture.go_on(state)
        self._end_s = time.monotonic() + self._part_s

    def keep(self, item: Frame | NDArray) -> None:
        """Keep what `Capture.run` yields, a frame or a block of events, before it is asked for more."""
        match item:
            case Frame():
                assert not np.any(item.electrons_stderr > 0)
                frame = {"times": item.times, "raw": item.raw, "electrons": item.electrons_mean}
                self._write("frame", self._frames, frame)
                self._frames += 1
            case events if events.size:
                self._blocks.append(events)
                if sum(block.size for block in self._blocks) >= _MOST_EVENTS:
                    self._keep_events()
        if time.monotonic() >= self._end_s:
            self._keep_events()
            part = {"frames": self._frames, "chunks": self._chunks, "progress": self._capture.progress}
            self._write("part", self._parts, {**part, "capture": self._capture.state()})
            self._parts += 1
            self._end_s = time.monotonic() + self._part_s

    def _keep_events(self) -> None:
        if self._blocks:
            sizes = np.array([block.size for block in self._blocks], np.int64)
            self._write("events", self._chunks, {"sizes": sizes, "events": np.concatenate(self._blocks)})
            self._blocks = []
            self._chunks += 1

    def _frame(self, stored: SavedState) -> Frame:
        valid = self._capture.frame_mask
        return Frame(
            raw=stored["raw"],
            valid=valid,
            electrons_mean=stored["electrons"],
            electrons_stderr=np.where(valid, np.float32(0), np.float32(np.nan)),
            **stored["times"],
        )

    def _read(self, *name: object) -> SavedState:
        """What was kept under a name; empty where there is nothing."""
        data = self._journal.read(key_of(*name))
        return {} if data is None else from_bytes(data)

    def _write(self, kind: str, number: int, value: SavedState) -> None:
        self._journal.keep(key_of(kind, number), [np.frombuffer(to_bytes(value), np.uint8)])

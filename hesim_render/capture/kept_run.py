"""What a run has given so far, and its state then, in a journal: an interrupted run goes on without asking its source
again for what has passed.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.loop import Capture
from hesim_render.core.journal import Journal, key_of
from hesim_render.core.plain import from_bytes, to_bytes
from hesim_render.core.progress import Progress
from hesim_render.pixels.arrays import SavedState
from hesim_render.recording.frame import Frame
from hesim_render.recording.writer import RecordingWriter

#: Events that are held before they are kept.
_MOST_EVENTS = 1 << 20


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

"""Recordings of event pixels on a bench, opened: what the estimators of the report read."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.recordings.tally import EventTally, tally
from hesim_render.core.errors import SpecError
from hesim_render.core.guard import leads_out, printable, require_memory
from hesim_render.exchange import EventStream, open_events
from hesim_render.specs.event_bench import BenchRecording, EventBenchSpec, LightSteps
from hesim_render.specs.files import read_spec

BENCH_NAME = "bench.yaml"
#: Bytes for one step of one pixel, with all copies.
_BYTES_PER_RESPONSE = 12


@dataclass(frozen=True, eq=False)
class Responses:
    """First answers of pixels to jumps of the light.

    Parameters
    ----------
    steps : the recording.
    rises : [jump], True where the light rises.
    latency_us : [jump, pixel], time from the jump to the first event of its polarity, µs; 0 where there is none.
    window_us : time in which an answer counts.
    """

    steps: LightSteps
    rises: NDArray[np.bool_]
    latency_us: NDArray[np.int32]
    window_us: int

    @property
    def size(self) -> float:
        """Size of the jumps, ln units."""
        return float(np.log1p(self.steps.contrast))

    def of(self, polarity: int) -> NDArray[np.int32]:
        """Latencies of the rises (polarity 0, ON) or of the falls (1, OFF)."""
        return self.latency_us[self.rises == (polarity == 0)]


class EventBench:
    """The recordings of a bench.

    Parameters
    ----------
    folder : holds ``bench.yaml``.

    Raises
    ------
    SpecError
        If ``bench.yaml`` is wrong, or names a file that is outside of the folder or cannot be read.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.file = self.folder / BENCH_NAME
        self.spec: EventBenchSpec = read_spec(EventBenchSpec, self.file)
        self._tallies: dict[str, EventTally] = {}

    def path(self, name: str) -> Path:
        """The file of a recording."""
        if leads_out(self.folder, name):
            raise SpecError(f"{printable(name[:100])!r} leads out of the folder", file=self.file)
        if not (self.folder / name).exists():
            raise SpecError(f"no such file: {printable(name[:100])!r}", file=self.file)
        return self.folder / name

    def stream(self, name: str) -> EventStream:
        """Events of a recording; all must be of the same sensor."""
        interval_us = {one.file: one.interval_us for one in self.recorded}.get(name)
        stated = None if self.spec.rows is None or self.spec.cols is None else (self.spec.rows, self.spec.cols)
        stream = open_events(self.path(name), shape=stated, keep_stated=True)
        if stream.shape != self.shape:
            (rows, cols), (first_rows, first_cols) = stream.shape, self.shape
            raise SpecError(
                f"is of {cols}x{rows} px; expected {first_cols}x{first_rows} as before", file=self.path(name)
            )
        return stream if interval_us is None else replace(stream, interval_us=interval_us)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the event grid."""
        stated = None if self.spec.rows is None or self.spec.cols is None else (self.spec.rows, self.spec.cols)
        return open_events(self.path(self.names[0]), shape=stated, keep_stated=True).shape

    @property
    def pixels(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def names(self) -> list[str]:
        """Files of all recordings."""
        return [*(one.file for one in self.recorded), *self.spec.busy]

    @property
    def recorded(self) -> list[BenchRecording]:
        """All recordings of known light."""
        return [*self.spec.steady, *self.spec.steps, *self.spec.modulation]

    def tally(self, name: str) -> EventTally:
        """Sums over the events of a recording."""
        if name not in self._tallies:
            self._tallies[name] = tally(self.stream(name))
        return self._tallies[name]

    def temperature_c(self, one: BenchRecording) -> float | None:
        """Temperature of the sensor in a recording, if it is stated."""
        return self.spec.temperature_c if one.temperature_c is None else one.temperature_c

    @cached_property
    def responses(self) -> list[Responses]:
        """Answers to the jumps of each recording of steps."""
        return [self.answers_to(one) for one in self.spec.steps]

    def answers_to(self, steps: LightSteps) -> Responses:
        """Answers to the jumps of one of the recordings."""
        stream = self.stream(steps.file)
        jumps_us, rises = self._jumps(steps, stream)
        window_us = int(np.diff(jumps_us).min())
        if steps.window_us is not None:
            window_us = min(window_us, steps.window_us)
        require_memory(_BYTES_PER_RESPONSE * rises.size * self.pixels, f"{rises.size} jumps", self.path(steps.file))
        outcome = np.zeros((rises.size, self.pixels), np.int32)
        for events in stream:
            number = np.searchsorted(jumps_us, events["t_us"], side="left") - 1
            after_us = events["t_us"] - jumps_us[np.maximum(number, 0)]
            right = (events["polarity"] > 0) == rises[np.maximum(number, 0)]
            kept = np.flatnonzero((number >= 0) & (after_us <= window_us) & right)
            pixel = events["y"][kept].astype(np.int64) * self.shape[1] + events["x"][kept]
            place, first = np.unique(number[kept] * self.pixels + pixel, return_index=True)
            new = outcome.flat[place] == 0
            outcome.flat[place[new]] = after_us[kept][first][new]
        return Responses(steps, rises, outcome, window_us)

    def _jumps(self, steps: LightSteps, stream: EventStream) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times of the jumps, and whether the light rises; only those that a whole window follows."""
        path = self.path(steps.file)
        if steps.trigger is not None:
            edges = stream.triggers()
            edges = edges[edges["channel"] == steps.trigger]
            if edges.size < 3 or np.any(edges["edge"][1:] == edges["edge"][:-1]) or np.any(np.diff(edges["t_us"]) <= 0):
                raise SpecError(
                    f"has {edges.size} edges of triggers on line {steps.trigger}; expected three or more, rising and "
                    "falling in turn",
                    file=path,
                )
            return edges["t_us"][:-1].astype(np.int64), edges["edge"][:-1] > 0
        assert steps.begin_us is not None and steps.period_us is not None
        half_us = steps.period_us // 2
        end_us = stream.span_us()[1]
        count = int((end_us - steps.begin_us) // half_us)
        if count < 2:
            raise SpecError(
                f"ends at {end_us} µs, before a rise and a fall: begin_us {steps.begin_us}, period_us "
                f"{steps.period_us}", file=path,
            )  # fmt: skip
        number = np.arange(count)
        return steps.begin_us + number // 2 * steps.period_us + number % 2 * half_us, number % 2 == 0

"""What a recording of events holds in numbers of bounded size, taken block by block."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import US_PER_S
from hesim_render.exchange.stream import EventStream

#: Parts of the time and groups of the pixels, whose scatter gives errors.
SLICES, GROUPS = 20, 20
#: Intervals between events of a pixel that are counted to the µs; longer ones count as this.
LONG_US = 20_000
#: Windows in which the load of the read-out is counted, µs.
WINDOW_US = 1000
#: Steps of the logarithmic histograms of a moving target's intervals in a factor of two, from 1 µs, and their number.
STEPS_PER_OCTAVE, STEPS = 32, 32 * 26
#: Lamps on alternating current flicker with twice its frequency.
LAMPS_HZ = (100.0, 120.0)
#: Times between turns that are kept, and part of them near their median where they are those of one period.
TURNS, _ONE_PERIOD = 200_000, 0.6
#: Pixels whose events are kept, of the sensor's, and most events of them.
_KEPT_PIXELS, _KEPT = 4096, 2_000_000
#: A recording needs this much time for figures of the scatter between its parts, µs.
_LEAST_US = 10 * SLICES


@dataclass(eq=False)
class EventTally:
    """Sums over the events of a recording.

    Parameters
    ----------
    source : name of the recording, for errors.
    shape : rows and columns, px.
    begin_us, end_us : time of the recording, µs.
    only : [pixel], pixels whose `same`, `gaps`, `turns_us` and `kept` events count; None: all.

    Attributes
    ----------
    counts : [polarity, half of the time, pixel], ON first.
    slices : [polarity, slice of the time, group of pixels], events.
    intervals : [µs], intervals between successive events of a pixel, of any polarity; the last entry has all longer.
    variation, pairs : [pixel], sums of the local variation over pairs of successive ON intervals; pairs.
    waves : [frequency, slice of the time], complex sums of the ON events' phases at each of `LAMPS_HZ`.
    used : [pixel], pixels that rates, their spread and the local variation are taken of; all, but for hot ones.
    windows : [k], number of windows of `WINDOW_US` that hold k events; windows without events are left out.
    same, gaps : [first polarity, group of pixels, step], intervals between successive events of a pixel of the same
        polarity, and of different ones, in logarithmic steps.
    turns_us : first times between successive turns of a pixel from OFF to ON events, at most `TURNS`.
    gap_us : [first polarity, pixel], longest of the intervals between events of different polarity.
    """

    source: str
    shape: tuple[int, int]
    begin_us: int
    end_us: int
    only: NDArray[np.bool_] | None = None
    counts: NDArray[np.int64] = field(init=False)
    slices: NDArray[np.int64] = field(init=False)
    intervals: NDArray[np.int64] = field(init=False)
    variation: NDArray[np.float64] = field(init=False)
    pairs: NDArray[np.int64] = field(init=False)
    windows: NDArray[np.int64] = field(init=False)
    waves: NDArray[np.complex128] = field(init=False)
    used: NDArray[np.bool_] = field(init=False)
    same: NDArray[np.int64] = field(init=False)
    gaps: NDArray[np.int64] = field(init=False)
    turns_us: list[NDArray[np.int64]] = field(init=False)
    gap_us: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        pixels = self.pixels
        self.counts, self.slices = np.zeros((2, 2, pixels), np.int64), np.zeros((2, SLICES, GROUPS), np.int64)
        self.intervals, self.windows = np.zeros(LONG_US + 1, np.int64), np.zeros(1, np.int64)
        self.variation, self.pairs = np.zeros(pixels), np.zeros(pixels, np.int64)
        self.waves, self.used = np.zeros((len(LAMPS_HZ), SLICES), np.complex128), np.ones(pixels, np.bool_)
        self.same, self.gaps = np.zeros((2, 2, GROUPS, STEPS), np.int64)
        self.gap_us = np.zeros((2, pixels), np.int64)
        self.turns_us, self._turns, self._turn_us = [], 0, np.full(pixels, -1, np.int64)
        among = np.arange(pixels) if self.only is None else np.flatnonzero(self.only)
        self._is_kept, self._kept_size = np.zeros(pixels, np.bool_), 0
        self._kept: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]] = []
        self._is_kept[np.random.default_rng(1).permutation(among)[:_KEPT_PIXELS]] = True
        # group of each pixel: neighbours and columns are spread over all groups
        self.group = (np.arange(pixels, dtype=np.uint64) * np.uint64(2654435761) >> np.uint64(16)) % np.uint64(GROUPS)
        self._last_us, self._last_on = np.full((2, pixels), -1, np.int64), np.zeros(pixels, np.bool_)
        self._interval_us = np.zeros(pixels, np.int64)  # the last ON interval, 0 before it
        self._window, self._in_window = -1, 0

    @property
    def pixels(self) -> int:
        return self.shape[0] * self.shape[1]

    @property
    def seconds(self) -> float:
        return (self.end_us - self.begin_us) / US_PER_S

    def add(self, events: NDArray[np.void]) -> None:
        """Take the next block of events, in order of time."""
        t_us, on = events["t_us"], events["polarity"] > 0
        pixel = events["y"].astype(np.int64) * self.shape[1] + events["x"]
        part = (t_us - self.begin_us) / (self.end_us - self.begin_us)
        half, piece = (np.clip((part * n).astype(np.int64), 0, n - 1) for n in (2, SLICES))
        group = self.group[pixel].astype(np.int64)
        for k, chosen in enumerate((on, ~on)):
            place = half[chosen] * self.pixels + pixel[chosen]
            self.counts[k] += np.bincount(place, minlength=2 * self.pixels).reshape(2, -1)
            place = piece[chosen] * GROUPS + group[chosen]
            self.slices[k] += np.bincount(place, minlength=SLICES * GROUPS).reshape(SLICES, GROUPS)
        self._load(t_us)
        self._light(t_us[on] - self.begin_us, piece[on])
        order = np.argsort(pixel, kind="stable")
        pixel, t_us, on = pixel[order], t_us[order], on[order]
        first, last, before_us = self._before(pixel, t_us, 0)
        known = before_us >= 0
        self.intervals += np.bincount(np.minimum((t_us - before_us)[known], LONG_US), minlength=LONG_US + 1)
        was_on = np.where(first, self._last_on[pixel], np.append(False, on[:-1]))
        for k, is_turn in enumerate((known & was_on & ~on, known & ~was_on & on)):
            np.maximum.at(self.gap_us[k], pixel[is_turn], (t_us - before_us)[is_turn])
        if self.only is not None:
            known = known & self.only[pixel]
        self._keep(pixel, t_us, on)
        self._successions(known, was_on, on, pixel, t_us - before_us)
        turn = known & on & ~was_on
        self._take_turns(pixel[turn], t_us[turn])
        self._last_us[0, pixel[last]], self._last_on[pixel[last]] = t_us[last], on[last]
        self._regularity(pixel[on], t_us[on])

    def _before(
        self, pixel: NDArray[np.int64], t_us: NDArray[np.int64], kind: int
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]:
        """Whether events sorted by pixel are the first, the last of it in the block; time of the one before, or −1."""
        first = np.diff(pixel, prepend=-1) != 0
        last = np.append(first[1:], True)[: pixel.size]
        return first, last, np.where(first, self._last_us[kind, pixel], np.append(0, t_us[:-1])[: pixel.size])

    def _regularity(self, pixel: NDArray[np.int64], t_us: NDArray[np.int64]) -> None:
        if pixel.size == 0:
            return
        first, last, before_us = self._before(pixel, t_us, 1)
        interval = np.where(before_us >= 0, t_us - before_us, 0)
        earlier = np.where(first, self._interval_us[pixel], np.append(0, interval[:-1]))
        both = (interval > 0) & (earlier > 0)
        a, b = interval[both], earlier[both]
        self.variation += np.bincount(pixel[both], 3 * ((a - b) / (a + b)) ** 2, self.pixels)
        self.pairs += np.bincount(pixel[both], minlength=self.pixels)
        self._last_us[1, pixel[last]], self._interval_us[pixel[last]] = t_us[last], interval[last]

    def _successions(
        self, known: NDArray[np.bool_], was_on: NDArray, on: NDArray, pixel: NDArray[np.int64], interval_us: NDArray
    ) -> None:
        step = np.log2(np.maximum(interval_us[known], 1)) * STEPS_PER_OCTAVE
        place = self.group[pixel[known]].astype(np.int64) * STEPS + np.minimum(step.astype(np.int64), STEPS - 1)
        place += np.where(was_on[known], 0, GROUPS * STEPS)
        is_same = was_on[known] == on[known]
        for total, chosen in ((self.same, is_same), (self.gaps, ~is_same)):
            total += np.bincount(place[chosen], minlength=total.size).reshape(total.shape)

    def _take_turns(self, pixel: NDArray[np.int64], t_us: NDArray[np.int64]) -> None:
        if pixel.size == 0 or self._turns >= TURNS:
            return
        first = np.diff(pixel, prepend=-1) != 0
        before_us = np.where(first, self._turn_us[pixel], np.append(0, t_us[:-1]))
        self._turn_us[pixel[np.append(first[1:], True)]] = t_us[np.append(first[1:], True)]
        result = (t_us - before_us)[before_us >= 0]
        self.turns_us.append(result)
        self._turns += result.size

    def _keep(self, pixel: NDArray[np.int64], t_us: NDArray[np.int64], on: NDArray[np.bool_]) -> None:
        if self._kept_size < _KEPT:
            own = self._is_kept[pixel]
            self._kept.append((pixel[own], t_us[own], on[own]))
            self._kept_size += int(np.count_nonzero(own))

    def kept(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Pixel, time in µs and polarity of the first events of some of the pixels, by pixel and time."""
        if not self._kept:
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.bool_)
        pixel, t_us, on = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        order = np.argsort(pixel, kind="stable")
        return pixel[order], t_us[order], on[order]

    def period_s(self) -> float | None:
        """Time between two turns of a pixel from OFF to ON events, s; those that noise splits or joins are left out.

        None where most are such: of random events, a third is within 30 % of the median.
        """
        if not self._turns:
            return None
        every = np.concatenate(self.turns_us)
        near = np.abs(every / np.median(every) - 1) < 0.3
        return float(every[near].mean()) / US_PER_S if near.mean() > _ONE_PERIOD else None

    def _light(self, t_us: NDArray[np.int64], piece: NDArray[np.int64]) -> None:
        for k, hz in enumerate(LAMPS_HZ):
            phase = (2 * np.pi * hz / US_PER_S) * t_us
            self.waves[k] += np.bincount(piece, np.cos(phase), SLICES) + 1j * np.bincount(piece, np.sin(phase), SLICES)

    def by_group(self, values: NDArray) -> NDArray[np.float64]:
        """Sums of values [pixel] over the pixels of each group that are used."""
        sums = np.bincount(self.group[self.used].astype(np.int64), values[self.used], GROUPS)
        return np.asarray(sums, np.float64)

    def _load(self, t_us: NDArray[np.int64]) -> None:
        window = (t_us - self.begin_us) // WINDOW_US
        begins = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
        count = np.diff(np.append(begins, window.size))
        if window[0] == self._window:
            count[0] += self._in_window
        elif self._in_window:
            count, begins = np.append(self._in_window, count), np.append(0, begins)
        self._window, self._in_window = int(window[-1]), int(count[-1])
        self._count_windows(count[:-1])

    def _count_windows(self, count: NDArray[np.int64]) -> None:
        if count.size:
            size = max(self.windows.size, int(count.max()) + 1)
            self.windows = np.bincount(count, minlength=size) + np.pad(self.windows, (0, size - self.windows.size))

    def finish(self) -> None:
        """Count the last window."""
        if self._in_window:
            self._count_windows(np.array([self._in_window]))

    def per_pixel(self) -> NDArray[np.int64]:
        """Events [polarity, pixel]."""
        return cast(NDArray[np.int64], self.counts.sum(axis=1))


def tally(stream: EventStream, only: NDArray[np.bool_] | None = None) -> EventTally:
    """The tally of a recording, which is read twice, block by block.

    Parameters
    ----------
    stream : events; those after its end, where it has one of its own, are left out.
    only : see `EventTally`.

    Raises
    ------
    SpecError
        If the recording has no events, is too short for figures of its scatter, or its events are not in order.
    """
    begin_us, end_us = stream.span_us()
    if end_us - begin_us < _LEAST_US:
        problem = "has no events" if end_us == begin_us == 0 else f"lasts {end_us - begin_us} µs"
        raise SpecError(f"{problem}; expected a recording of at least {_LEAST_US} µs", file=stream.source)
    result = EventTally(str(stream.source), stream.shape, begin_us, end_us, only)
    for block in stream:
        events = block[: np.searchsorted(block["t_us"], end_us, side="right")]
        if events.size:
            result.add(events)
        if events.size < block.size:
            break
    result.finish()
    return result

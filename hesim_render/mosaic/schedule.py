"""Times of row exposures and of event comparisons, in µs from the start."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError
from hesim_render.core.units import US_PER_S
from hesim_render.specs.event_pixels import EvsSpec
from hesim_render.specs.frame_pixels import ApsSpec

#: Longest run with events, µs (times are stored in 32 bit); without events; and most frames and comparisons.
_MOST_EVENT_US, _MOST_US = 2**32 - 1, 10**12
_MOST_FRAMES, _MOST_TICKS = 2_000_000, 20_000_000


def require_countable(aps: ApsSpec | None, evs: EvsSpec | None, duration_us: int) -> None:
    """Refuse a run with too many frames or comparisons, before any of them is listed.

    Raises
    ------
    RangeError
        The message states the longest possible duration.
    """
    limits = {"a run": _MOST_US}
    if evs is not None:
        limits["a recording of events"] = _MOST_EVENT_US
        if evs.tick_us is not None:
            limits[f"{_MOST_TICKS} comparisons, one every {evs.tick_us} µs"] = _MOST_TICKS * evs.tick_us
    if aps is not None:
        limits[f"{_MOST_FRAMES} frames at {aps.frame_rate_hz:g} Hz"] = int(_MOST_FRAMES * US_PER_S / aps.frame_rate_hz)
    what, most_us = min(limits.items(), key=lambda item: item[1])
    if duration_us > most_us:
        raise RangeError("duration_s", duration_us / US_PER_S, f"at most {most_us / US_PER_S:.10g}: so long is {what}")


@dataclass(frozen=True)
class Exposure:
    """One frame: row r integrates over [start_us + r·line_time_us, … + exposure_us].

    Parameters
    ----------
    index : frame number, 0 first.
    start_us : begin of row 0's exposure, µs.
    exposure_us : exposure of every row, µs.
    rows : rows that are read out.
    line_time_us : delay from row to row, µs; 0 for a global shutter.
    """

    index: int
    start_us: int
    exposure_us: int
    rows: int
    line_time_us: float

    @property
    def t_us(self) -> int:
        """Time stamp: the end of row 0's exposure, µs."""
        return self.start_us + self.exposure_us

    @property
    def end_us(self) -> float:
        """End of the last row's exposure, µs."""
        return self.start_us + (self.rows - 1) * self.line_time_us + self.exposure_us

    def row_begin_us(self, row: NDArray) -> NDArray[np.float64]:
        return self.start_us + row * self.line_time_us


def exposures(spec: ApsSpec, rows: int, duration_us: int) -> list[Exposure]:
    """All frames whose last row is fully exposed within the run.

    Frame k begins at k / frame_rate_hz. A region of fewer rows is read out as a window: its first
    row starts the frame.
    """
    line_time_us = spec.line_time_us if spec.shutter == "rolling" else 0.0
    result: list[Exposure] = []
    while True:
        start_us = round(len(result) * US_PER_S / spec.frame_rate_hz)
        exposure = Exposure(len(result), start_us, spec.exposure_us, rows, line_time_us)
        if exposure.end_us > duration_us:
            return result
        result.append(exposure)


#: Number of intervals between ticks in a block; interpolation never crosses the border of a block.
BLOCK_INTERVALS = 16
#: Number of cells of sample times in a block, before it is cut where it has too many.
BLOCK_CELLS = 32
#: Number of stretches of time, of one block of ticks or of cells each, that stand for a run of more of them.
_STRETCHES = 1024
#: Sample times of sensors without a tick are computed in cells of this length, µs. Cells begin at its
#: multiples, which are also sample times.
CELL_US = 1000


@dataclass(frozen=True)
class Block:
    """Successive windows in which event pixels are sampled.

    Blocks begin and end at fixed times, independent of the run. The flux at a time therefore does not depend on when
    the run begins or ends. The last window of a block is the first of the next.

    Parameters
    ----------
    begin_us, end_us : [w], in order of time, µs.
    wanted : [w], True for windows that the run asks for; the others are needed for interpolation.
    """

    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    wanted: NDArray[np.bool_]


def tick_blocks(spec: EvsSpec, begin_us: float, end_us: float) -> Iterator[Block]:
    """Windows of the fixed comparisons after one time and up to another; window k ends at k·tick_us."""
    assert spec.tick_us is not None
    first, last = int(begin_us // spec.tick_us) + 1, int(end_us // spec.tick_us)
    for number in range((first - 1) // BLOCK_INTERVALS, -(-last // BLOCK_INTERVALS)):
        ticks = np.arange(BLOCK_INTERVALS * number, BLOCK_INTERVALS * (number + 1) + 1)
        wanted = (ticks >= first) & (ticks <= last)
        wanted[0] = False  # it is the last window of the previous block
        ends = ticks.astype(np.float64) * spec.tick_us
        yield Block(ends - spec.window_us, ends, wanted)


def instant_blocks(
    instants_us: Callable[[float, float], NDArray[np.int64]],
    window_us: int,
    begin_us: float,
    end_us: float,
    intervals: int = BLOCK_INTERVALS,
) -> Iterator[Block]:
    """Windows that end at the instants of a source, after one time and up to another.

    The instants of every `BLOCK_CELLS` cells are cut into blocks of at most `intervals` intervals.

    Parameters
    ----------
    instants_us : whole µs from one time to another, both included, with the multiples of `CELL_US`.
    window_us : length of a window, µs.
    begin_us, end_us : the times, µs.
    intervals : largest number of intervals of a block.
    """
    length = BLOCK_CELLS * CELL_US
    for number in range(int(begin_us // length), -(-int(np.ceil(end_us)) // length)):
        instants = instants_us(number * length, (number + 1) * length)
        for first in range(0, instants.size - 1, intervals):
            ends = instants[first : first + intervals + 1].astype(np.float64)
            wanted = (ends > begin_us) & (ends <= end_us)
            wanted[0] = False
            if wanted.any():
                yield Block(ends - window_us, ends, wanted)


def blocks_of_run(
    instants_us: Callable[[float, float], NDArray[np.int64]],
    window_us: int,
    begin_us: int,
    end_us: int,
    intervals: int = BLOCK_INTERVALS,
) -> Iterator[Block]:
    """Windows of a run as in `instant_blocks`: the first begins with the run, the last ends with it or just after.

    Parameters
    ----------
    instants_us, intervals : see `instant_blocks`.
    window_us : length of a window, µs.
    begin_us, end_us : begin and end of the run, µs.
    """
    first = begin_us + window_us
    yield Block(np.array([begin_us], np.float64), np.array([first], np.float64), np.ones(1, np.bool_))
    # up to the first instant at or after the end, because events before the end need its sample
    cell = end_us // CELL_US * CELL_US
    instants = instants_us(cell, cell + CELL_US)
    beyond = int(instants[np.searchsorted(instants, end_us)])
    yield from instant_blocks(instants_us, window_us, first, beyond, intervals)


@dataclass(frozen=True)
class BlockSample:
    """Blocks from random stretches of a run, or all blocks of a short run.

    Parameters
    ----------
    blocks : in order of time.
    share : fraction of the run's time that they cover; 1 for a short run.
    """

    blocks: list[Block]
    share: float

    @property
    def count(self) -> float:
        """Estimated number of blocks of the run."""
        return len(self.blocks) / self.share

    @property
    def windows(self) -> float:
        """Estimated number of wanted windows of the run."""
        return sum(int(np.count_nonzero(block.wanted)) for block in self.blocks) / self.share


def sample_of_blocks(
    blocks: Callable[[float, float], Iterator[Block]], stretch_us: int, begin_us: int, end_us: int, seed: int
) -> BlockSample:
    """Sample the blocks of a run in a time that does not grow with its length.

    A run of up to 1024 stretches is listed whole. Of a longer one, the stretches at one random time in each of 1024
    equal parts are listed.

    Parameters
    ----------
    blocks : yields the blocks between two times, µs.
    stretch_us : length of a stretch, µs; blocks of the source begin and end at its multiples.
    begin_us, end_us : begin and end of the run, µs.
    seed : seed of the choice.
    """
    if end_us - begin_us <= _STRETCHES * stretch_us:
        return BlockSample(list(blocks(begin_us, end_us)), 1.0)
    part = np.arange(_STRETCHES) + np.random.default_rng(seed).random(_STRETCHES)
    chosen = ((begin_us + part / _STRETCHES * (end_us - begin_us)) // stretch_us).astype(np.int64)
    result = [block for k in chosen.tolist() for block in blocks(k * stretch_us, (k + 1) * stretch_us)]
    # a source adds a single window where a run begins, and these stretches are not runs
    result = [block for block in result if block.wanted.size > 1]
    return BlockSample(result, _STRETCHES * stretch_us / (end_us - begin_us))


def without_first(blocks: Iterable[Block], count: int) -> Iterator[Block]:
    """Blocks that want all but the first `count` windows; one of which nothing is wanted any more is left out."""
    for block in blocks:
        places = np.flatnonzero(block.wanted)
        if count:
            wanted = block.wanted.copy()
            wanted[places[:count]] = False
            block = replace(block, wanted=wanted)
        count -= min(count, places.size)
        if block.wanted.any() or not places.size:
            yield block


def wanted_windows(blocks: Iterable[Block]) -> Iterator[tuple[float, float]]:
    """Begin and end of every wanted window, in order of time."""
    for block in blocks:
        ends = np.rint(block.end_us[block.wanted])
        yield from zip(block.begin_us[block.wanted].tolist(), ends.tolist(), strict=True)

"""Prophesee EVT3: words of 16 bits, little endian, whose type is in bits 15 to 12.

| Type | Word | Content |
|---|---|---|
| 0 | ADDR_Y | y, bits 10 to 0 |
| 2 | ADDR_X | one event: x, bits 10 to 0; polarity, bit 11 |
| 3 | VECT_BASE_X | first column of the next vector, and its polarity |
| 4, 5 | VECT_12, VECT_8 | a bit for each of the next 12 or 8 columns, which has an event where it is 1 |
| 6, 8 | TIME_LOW, TIME_HIGH | lower and upper 12 bits of the time, which starts again after 2²⁴ µs |
| 10 | EXT_TRIGGER | an edge of a trigger line: number of the line, bits 11 to 8; 1 in bit 0 where it rises |

A word is left out where it would repeat the one before. The writer uses no vectors: they hold events of one polarity,
and would change the order of events whose time is the same.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.exchange import raw_file
from hesim_render.exchange.evt2 import unwrapped
from hesim_render.exchange.stream import EventStream
from hesim_render.exchange.triggers import TRIGGER_DTYPE, joined
from hesim_render.pixels.evs.events import EVENT_DTYPE

_LOW_BITS = 12
_PART = (1 << _LOW_BITS) - 1
_PERIOD_BITS = 24
#: The words that say that time has started again would take more than 4 MB.
LATEST_US = 1 << 44
_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH, _TRIGGER = 0, 2, 3, 4, 5, 6, 8, 10
#: Number of trigger lines.
CHANNELS = 16
_COLUMN = 0x7FF
#: With TIME_HIGH of 10 steps before its end and after its begin: so far a decrease is a new start.
_NEAR_THE_END = 10
# besides: continued (4 and 12 bits), other
_KNOWN = np.isin(
    np.arange(16), (_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8, _TIME_LOW, _TIME_HIGH, _TRIGGER, 7, 0xE, 0xF)
)


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as an EVT3 RAW file.

    Raises
    ------
    SpecError
        If the sensor has more than 2048 rows or columns, or an event lies after 2⁴⁴ µs (203 days).
    """
    raw_file.write(stream, file, target, "EVT3", encoded, CHANNELS, LATEST_US)


def encoded(
    events: NDArray, before: NDArray | None, is_trigger: NDArray[np.bool_] | None = None, *, is_whole: bool = False
) -> NDArray[np.uint16]:
    """Words of events and triggers.

    Parameters
    ----------
    events, is_trigger : entries of `triggers.merged`.
    before : the entry before them; None before the first.
    is_whole : begin with time and row, also where they repeat the entry before, so that a reader can start here.
    """
    time_before, row_before = (-1, -1) if before is None else (int(before["t_us"]), int(before["y"]))
    times, rows = events["t_us"], events["y"]
    high = times >> _LOW_BITS
    new_high = np.diff(high, prepend=-1 if time_before < 0 else time_before >> _LOW_BITS) > 0
    new_low = new_high | (np.diff(times, prepend=time_before) > 0)
    new_row = np.diff(rows.astype(np.int32), prepend=row_before) != 0
    if is_whole:
        new_high[0] = new_low[0] = new_row[0] = True
    # all ones and then 0 tell a reader that TIME_HIGH starts again
    starts = np.diff(times >> _PERIOD_BITS, prepend=max(time_before, 0) >> _PERIOD_BITS)
    size = new_high.astype(np.int8) + new_low + new_row + np.int8(1)
    count = size + 2 * starts if starts.any() else size
    place = np.cumsum(count, dtype=np.int64) - 1
    words = np.empty(int(place[-1]) + 1, dtype="<u2")
    for k in np.flatnonzero(starts):
        last = place[k] - size[k] + 1
        words[last - 2 * starts[k] : last] = np.tile(
            np.array([_PART, 0], dtype=np.uint16) | np.uint16(_TIME_HIGH << 12), starts[k]
        )
    x_word = events["x"] | np.uint16(_ADDR_X << 12)
    is_on = (events["polarity"] > 0).astype(np.uint16)
    x_word |= is_on << np.uint16(11)
    if is_trigger is not None:
        x_word = np.where(is_trigger, np.uint16(_TRIGGER << 12) | events["x"] << np.uint16(8) | is_on, x_word)
    words[place] = x_word
    before = place - new_row
    words[place[new_row] - 1] = rows[new_row]
    words[before[new_low] - 1] = (times[new_low] & _PART) | (_TIME_LOW << 12)
    words[before[new_high] - 2] = (high[new_high] & _PART) | (_TIME_HIGH << 12)
    return words


def read(path: Path, begin: int) -> Iterator[NDArray]:
    """Blocks of events of a RAW file, from byte `begin`, without those before the first TIME_HIGH (no time).

    Raises
    ------
    SpecError
        If the file ends within a word, or holds words that EVT3 does not have.
    """
    return (events for events, _ in decoded(raw_file.words(path, begin, "<u2"), path))


def read_triggers(path: Path, begin: int) -> NDArray:
    """All triggers of a RAW file, [edge] of `TRIGGER_DTYPE`; parameters and errors as for `read`."""
    return joined((triggers for _, triggers in decoded(raw_file.words(path, begin, "<u2"), path)), path)


def decoded(pieces: Iterable[NDArray[np.uint16]], path: Path) -> Iterator[tuple[NDArray, NDArray]]:
    """Events and triggers of words, piece by piece, without those before the first TIME_HIGH.

    Parameters
    ----------
    pieces : the words; pieces may begin and end anywhere.
    path : file, for errors.

    Raises
    ------
    SpecError
        If there are words that EVT3 does not have, or time goes back.
    """
    state: NDArray[np.uint16] | None = None
    loops = 0
    for piece in pieces:
        raw_file.require_types((piece >> np.uint16(12)).astype(np.uint8), _KNOWN, "EVT3", path)
        if state is None:
            first = np.flatnonzero(piece >> np.uint16(12) == _TIME_HIGH)
            if first.size == 0:
                continue
            piece = piece[first[0] :]
            state = np.array([piece[0], _TIME_LOW << 12, _ADDR_Y << 12, _BASE_X << 12], dtype=np.uint16)
        # the state of the decoder as words before the piece: one code for the begin and for all other pieces
        events, triggers, state, loops = _decoded(np.concatenate([state, piece]), loops, path)
        yield events, triggers


def _decoded(words: NDArray[np.uint16], loops: int, path: Path) -> tuple[NDArray, NDArray, NDArray[np.uint16], int]:
    """Events and triggers of words that begin with the state; the state after them, and how often time has started
    again.
    """
    kind = (words >> np.uint16(12)).astype(np.uint8)
    is_high = kind == _TIME_HIGH
    highs, loops = unwrapped((words[is_high] & _PART).astype(np.int64), loops, _PART + 1, _NEAR_THE_END, path)
    low = np.where(kind == _TIME_LOW, words & np.uint16(_PART), np.uint16(0))
    # after each TIME_HIGH the lower part is 0 until a TIME_LOW comes, as other decoders have it
    low_at = raw_file.latest((kind == _TIME_LOW) | is_high)
    y_at = raw_file.latest((kind == _ADDR_Y) | (np.arange(kind.size) == 0))
    base_at = raw_file.latest((kind == _BASE_X) | (np.arange(kind.size) == 0))
    width = np.where(kind == _VECT_12, 12, np.where(kind == _VECT_8, 8, 0))
    passed = np.cumsum(width) - width
    base = (words[base_at] & np.uint16(_COLUMN)).astype(np.int64) + passed - passed[base_at]

    vectors = np.flatnonzero(width)
    bits = words[vectors, None] >> np.arange(12, dtype=np.uint16) & np.uint16(1)
    bits[:, 8:] *= (width[vectors] == 12)[:, None]
    count = (kind == _ADDR_X).astype(np.int64)
    count[vectors] = bits.sum(axis=1)
    source = np.repeat(np.arange(kind.size), count)

    number = np.cumsum(is_high) - 1
    at = np.flatnonzero(kind == _TRIGGER)
    triggers = np.empty(at.size, dtype=TRIGGER_DTYPE)
    triggers["t_us"] = (highs[number[at]] << _LOW_BITS) | low[low_at[at]]
    triggers["channel"] = words[at] >> np.uint16(8) & np.uint16(CHANNELS - 1)
    triggers["edge"] = np.where(words[at] & np.uint16(1), 1, -1)

    events = np.empty(source.size, dtype=EVENT_DTYPE)
    events["t_us"] = (highs[number[source]] << _LOW_BITS) | low[low_at[source]]
    events["y"] = words[y_at[source]] & np.uint16(_COLUMN)
    single = kind[source] == _ADDR_X
    column = np.empty(source.size, dtype=np.int64)
    column[single] = words[source[single]] & np.uint16(_COLUMN)
    row, bit = np.nonzero(bits)
    column[~single] = base[vectors[row]] + bit
    if column.size and column.max() > _COLUMN:
        raise SpecError(f"a vector of events reaches column {column.max()}, beyond {_COLUMN}", file=path)
    events["x"] = column
    polarity = np.where(single, words[source], words[base_at[source]]) >> np.uint16(11) & np.uint16(1)
    events["polarity"] = polarity.astype(np.int8) * 2 - 1

    next_base = int(base[-1] + width[-1]) if kind[-1] != _BASE_X else int(words[-1]) & _COLUMN
    if next_base > _COLUMN:  # no event there: such columns are an error only if an event uses them
        next_base = _COLUMN
    state = np.array(
        [
            _TIME_HIGH << 12 | int(highs[-1]) & _PART,
            _TIME_LOW << 12 | int(low[low_at[-1]]),
            words[y_at[-1]] & np.uint16(_COLUMN),
            _BASE_X << 12 | int(words[base_at[-1]]) & 0x800 | next_base,
        ],
        dtype=np.uint16,
    )
    return events, triggers, state, loops

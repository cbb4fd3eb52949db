"""Prophesee EVT2: words of 32 bits, little endian.

An event: type 0 (OFF) or 1 (ON) in bits 31 to 28, time 27 to 22, x 21 to 11, y 10 to 0. TIME_HIGH (type 8) has the time
above its lowest 6 bits in 28 bits, which start again after 2³⁴ µs. EXT_TRIGGER (type 10): time as above, number of the
line in bits 12 to 8, and 1 in bit 0 where the edge rises.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.exchange import raw_file
from hesim_render.exchange.stream import EventStream
from hesim_render.exchange.triggers import TRIGGER_DTYPE, joined
from hesim_render.pixels.evs.events import events_of

_LOW_BITS = 6
_HIGH_BITS = 28
_LAST_HIGH = (1 << _HIGH_BITS) - 1
_OFF, _ON, _TIME_HIGH, _TRIGGER = 0x0, 0x1, 0x8, 0xA
#: Bits of the number of a trigger line, above bit 8.
_LINE_BITS = 5
#: With TIME_HIGH of 10 steps before its end and after its begin: so far a decrease is a new start.
_NEAR_THE_END = 10
_KNOWN = np.isin(np.arange(16), (_OFF, _ON, _TIME_HIGH, _TRIGGER, 0xE, 0xF))  # other, continued


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as an EVT2 RAW file.

    Raises
    ------
    SpecError
        If the sensor has more than 2048 rows or columns.
    """
    raw_file.write(stream, file, target, "EVT2", _encoded, 1 << _LINE_BITS)


def _encoded(events: NDArray, before: NDArray | None, is_trigger: NDArray[np.bool_] | None) -> NDArray[np.uint32]:
    """Words of events and triggers, as `raw_file.write` has them; `before` is the entry before them."""
    high_before = -1 if before is None else int(before["t_us"] >> _LOW_BITS)
    high = events["t_us"] >> _LOW_BITS
    step = np.diff(high, prepend=high_before)
    added = (step > 0).astype(np.int64)
    # all ones and then 0 tell a reader that TIME_HIGH starts again
    starts = np.diff(high >> _HIGH_BITS, prepend=max(high_before, 0) >> _HIGH_BITS)
    added += 2 * starts
    place = np.arange(high.size) + np.cumsum(added)
    words = np.empty(high.size + int(added.sum()), dtype="<u4")
    for k in np.flatnonzero(starts):
        words[place[k] - added[k] : place[k]] = np.resize(
            np.array([_LAST_HIGH, 0], dtype=np.uint32) | np.uint32(_TIME_HIGH << _HIGH_BITS), added[k]
        )
    new = added > 0
    words[place[new] - 1] = (high[new] & _LAST_HIGH) | (_TIME_HIGH << _HIGH_BITS)
    word = (events["t_us"] & ((1 << _LOW_BITS) - 1)).astype(np.uint32) << np.uint32(22)
    word |= (events["polarity"] > 0).astype(np.uint32) << np.uint32(28)
    word |= events["x"].astype(np.uint32) << np.uint32(11)
    word |= events["y"]
    if is_trigger is not None:
        edge = word & np.uint32(63 << 22 | 1 << 28)
        edge = (edge & np.uint32(63 << 22)) | edge >> np.uint32(28) | np.uint32(_TRIGGER << 28)
        word = np.where(is_trigger, edge | events["x"].astype(np.uint32) << np.uint32(8), word)
    words[place] = word
    return words


def read(path: Path, begin: int) -> Iterator[NDArray]:
    """Blocks of events of a RAW file, from byte `begin`, without those before the first TIME_HIGH (no time).

    Raises
    ------
    SpecError
        If the file ends within a word, or holds words that EVT2 does not have.
    """
    return (events for events, _ in _decoded(path, begin))


def read_triggers(path: Path, begin: int) -> NDArray:
    """All triggers of a RAW file, [edge] of `TRIGGER_DTYPE`; parameters and errors as for `read`."""
    return joined((triggers for _, triggers in _decoded(path, begin)), path)


def _decoded(path: Path, begin: int) -> Iterator[tuple[NDArray, NDArray]]:
    """Events and triggers, piece by piece."""
    high, loops = -1, 0
    for piece in raw_file.words(path, begin, "<u4"):
        kind = (piece >> np.uint32(28)).astype(np.uint8)
        raw_file.require_types(kind, _KNOWN, "EVT2", path)
        if high < 0:
            first = np.flatnonzero(kind == _TIME_HIGH)
            if first.size == 0:
                continue
            piece, kind = piece[first[0] :], kind[first[0] :]
            high = int(piece[0]) & _LAST_HIGH
        piece = np.concatenate([np.array([high | _TIME_HIGH << _HIGH_BITS], dtype=np.uint32), piece])
        kind = np.concatenate([np.array([_TIME_HIGH], dtype=np.uint8), kind])
        is_high = kind == _TIME_HIGH
        highs = (piece[is_high] & np.uint32(_LAST_HIGH)).astype(np.int64)
        times, loops = unwrapped(highs, loops, _LAST_HIGH + 1, _NEAR_THE_END, path)
        high = int(highs[-1])
        number = np.cumsum(is_high) - 1
        is_event = kind <= _ON
        word = piece[is_event]
        t_us = (times[number[is_event]] << _LOW_BITS) | (word >> np.uint32(22) & np.uint32(63))
        x, y = word >> np.uint32(11) & np.uint32(0x7FF), word & np.uint32(0x7FF)
        events = events_of(t_us, x, y, kind[is_event] == _ON)
        at = np.flatnonzero(kind == _TRIGGER)
        triggers = np.empty(at.size, dtype=TRIGGER_DTYPE)
        triggers["t_us"] = (times[number[at]] << _LOW_BITS) | (piece[at] >> np.uint32(22) & np.uint32(63))
        triggers["channel"] = piece[at] >> np.uint32(8) & np.uint32((1 << _LINE_BITS) - 1)
        triggers["edge"] = np.where(piece[at] & np.uint32(1), 1, -1)
        yield events, triggers


def unwrapped(
    values: NDArray[np.int64], loops: int, period: int, near: int, path: Path
) -> tuple[NDArray[np.int64], int]:
    """Values of a counter that starts again at `period`, continued; and how often it has started again by the end.

    Parameters
    ----------
    values : [word], the counter.
    loops : how often it had started again before.
    period : number of values of the counter.
    near : a decrease from within `near` of its end to within `near` of 0 is a new start; another one is an error.
    path : file, for the error.

    Raises
    ------
    SpecError
        If the counter goes back without a new start.
    """
    back = values[1:] < values[:-1]
    wrong = back & (values[:-1] - values[1:] < period - 2 * near)
    if wrong.any():
        k = int(wrong.argmax())
        raise SpecError(
            f"goes back in time (TIME_HIGH from {values[k]} to {values[k + 1]}); the file is damaged, of another "
            "format, or its events are out of order",
            file=path,
        )
    starts = loops + np.concatenate([[0], np.cumsum(back)])
    return values + starts * period, int(starts[-1])

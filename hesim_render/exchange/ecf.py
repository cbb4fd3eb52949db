"""ECF, the packing of event chunks in HDF5 files of Prophesee (its HDF5 filter has the number 0x8ECF).

| Part | Content |
|---|---|
| head | 32 bits: number of events, times 4; 2 if rows, columns and polarities are packed together; 1 if columns and polarities are |
| times | the first time, 64 bits; then runs of equal times: step of the time (4 bits, below 15), number of events (4 bits; 15: the number follows in 16 bits). A byte with 15 as step adds the next 4 bits, lowest first, of a longer step |
| packed | of 4 events each: rows (12 bits), columns (11) and polarities (1) in three words of 32 bits, or columns and polarities in three words of 16 bits |
| rows | runs: row (11 bits), number of events (5 bits; 31: it follows in 16 bits) |
| columns | column (11 bits), and a bit for each of the next 5 columns, which has the next event where it is 1 |
| polarities | runs: polarity (1 bit), number of events (7 bits; 127: it follows in 16 bits) |

Written from the description that Prophesee's own codec is (Apache-2.0). The writer packs rows, columns and polarities together.
"""  # noqa: E501

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.events import EVENT_DTYPE

#: Number of the HDF5 filter, and most events of a chunk.
FILTER, MOST_EVENTS = 0x8ECF, 65535
#: Coordinates have 11 bits.
LARGEST_SIDE = 1 << 11
_ALL_PACKED, _COLUMNS_PACKED = 2, 1
_LONG_STEP, _LONG_RUN = 15, 15


def encoded(events: NDArray) -> bytes:
    """One chunk.

    Parameters
    ----------
    events : [event] of `EVENT_DTYPE`, 1 to `MOST_EVENTS` in order of time, at places below `LARGEST_SIDE`.
    """
    head = np.array([events.size << 2 | _ALL_PACKED], "<u4").tobytes() + events["t_us"][:1].astype("<i8").tobytes()
    return head + _encoded_times(events["t_us"]) + _encoded_places(events)


def _encoded_times(times: NDArray[np.int64]) -> bytes:
    first = np.flatnonzero(np.diff(times, prepend=times[0] - 1))
    count = np.diff(np.append(first, times.size))
    step = np.diff(times[first], prepend=times[0])
    is_long = step >= _LONG_STEP
    digits = np.zeros(step.size, np.int64)
    for k in range(16):
        digits += is_long & (step >> 4 * k > 0)
    many = count >= _LONG_RUN
    size = digits + 1 + 2 * many
    place = np.cumsum(size) - size
    made = np.zeros(int(size.sum()), np.uint8)
    for k in range(int(digits.max())):
        part = digits > k
        made[place[part] + k] = 0xF0 | (step[part] >> 4 * k & 15)
    run = place + digits
    made[run] = np.where(is_long, 0, step) << 4 | np.minimum(count, _LONG_RUN)
    made[run[many] + 1], made[run[many] + 2] = count[many] & 255, count[many] >> 8
    return made.tobytes()


def _encoded_places(events: NDArray) -> bytes:
    value = np.zeros(-(-events.size // 4) * 4, np.uint32)
    value[: events.size] = events["y"].astype(np.uint32) << np.uint32(12) | events["x"].astype(np.uint32) << np.uint32(
        1
    )
    value[: events.size] |= events["polarity"] > 0
    a, b, c, d = value.reshape(-1, 4).T
    words = np.stack(
        [a << np.uint32(8) | b & np.uint32(0xFF), b >> np.uint32(8) << np.uint32(16) | c & np.uint32(0xFFFF),
         c >> np.uint32(16) << np.uint32(24) | d], axis=-1,
    )  # fmt: skip
    return words.astype("<u4").tobytes()


def decoded(data: bytes, count: int, path: Path, where: str) -> NDArray:
    """Events of one chunk.

    Parameters
    ----------
    data : the chunk.
    count : number of events that the chunk must hold.
    path, where : file and name of the chunk, for errors.

    Returns
    -------
    [event] of `EVENT_DTYPE`, whose order is not checked.

    Raises
    ------
    SpecError
        If the chunk holds another number of events, or its parts do not fit each other.
    """
    chunk = _Chunk(data, count, path, where)
    head = int(chunk.numbers("<u4", 1)[0])
    if head >> 2 != count:
        raise chunk.problem(f"says {head >> 2} events; expected {count}")
    events = np.empty(count, dtype=EVENT_DTYPE)
    events["t_us"] = chunk.times()
    if head & _ALL_PACKED:
        a, b, c = chunk.numbers("<u4", -(-count // 4) * 3).reshape(-1, 3).T
        value = np.stack(
            [a >> np.uint32(8), a & np.uint32(0xFF) | b >> np.uint32(16) << np.uint32(8),
             b & np.uint32(0xFFFF) | c >> np.uint32(24) << np.uint32(16), c & np.uint32(0xFFFFFF)], axis=-1,
        ).ravel()[:count]  # fmt: skip
        events["y"], value = value >> np.uint32(12) & np.uint32(LARGEST_SIDE - 1), value & np.uint32(0xFFF)
        events["x"], on = value >> np.uint32(1), value & np.uint32(1)
    else:
        events["y"] = chunk.runs("<u2", 5)
        if head & _COLUMNS_PACKED:
            a, b, c = chunk.numbers("<u2", -(-count // 4) * 3).reshape(-1, 3).T
            value = np.stack(
                [a >> np.uint16(4), a & np.uint16(0xF) | b >> np.uint16(8) << np.uint16(4),
                 b & np.uint16(0xFF) | c >> np.uint16(12) << np.uint16(8), c & np.uint16(0xFFF)], axis=-1,
            ).ravel()[:count]  # fmt: skip
            events["x"], on = value >> np.uint16(1), value & np.uint16(1)
        else:
            events["x"] = chunk.columns()
            on = chunk.runs("u1", 7).astype(np.uint32)
    events["polarity"] = np.where(on, 1, -1)
    return events


class _Chunk:
    """The bytes of a chunk, read part by part; parameters as for `decoded`."""

    def __init__(self, data: bytes, count: int, path: Path, where: str) -> None:
        self._data, self._count, self._path, self._where, self._at = data, count, path, where, 0

    def problem(self, message: str) -> SpecError:
        return SpecError(f"{self._where} {message}; the file is damaged", file=self._path)

    def numbers(self, kind: str, count: int) -> NDArray:
        """The next numbers."""
        size = np.dtype(kind).itemsize * count
        if len(self._data) < self._at + size:
            raise self.problem(f"ends at byte {len(self._data)}, within its values")
        result = np.frombuffer(self._data, kind, count, self._at)
        self._at += size
        return result

    def _rest(self, kind: str, per_event: int) -> NDArray:
        """All numbers that the next part can have at most, which are not yet taken."""
        item = np.dtype(kind).itemsize
        return np.frombuffer(
            self._data, kind, min((len(self._data) - self._at) // item, per_event * self._count), self._at
        )

    def _taken(self, counts: NDArray[np.int64], ends: NDArray[np.int64], item: int, spare: int = 0) -> int:
        """How many entries hold all events; `counts` are those of the entries, `ends` the numbers behind each."""
        total = np.cumsum(counts)
        last = int(np.searchsorted(total, self._count))
        if last == total.size or total[last] > self._count + spare:
            raise self.problem(f"has another number of values at byte {self._at} than the {self._count} of its head")
        self._at += int(ends[last]) * item
        if self._at > len(self._data):
            raise self.problem(f"ends at byte {len(self._data)}, within its values")
        return last + 1

    def times(self) -> NDArray[np.int64]:
        begin = int(self.numbers("<i8", 1)[0])
        value = self._rest("u1", 19)  # at most 16 bytes of a long step, and 3 of a run
        step, number = (value >> np.uint8(4)).astype(np.int64), (value & np.uint8(15)).astype(np.int64)
        is_digit: NDArray[np.bool_] = step == _LONG_STEP
        follows = ~is_digit & (number == _LONG_RUN)
        at = _chain(np.where(follows, 3, 1))
        value, step, number, is_digit, follows = value[at], step[at], number[at], is_digit[at], follows[at]
        number[follows] = self._behind("u1", at[follows])
        number[is_digit] = 0
        taken = self._taken(number, at + np.where(follows, 3, 1), 1)
        at, step, number, is_digit = at[:taken], step[:taken], number[:taken], is_digit[:taken]
        # the digits of a long step are counted from the first byte that is one
        place = np.arange(taken)
        digit = place - np.maximum.accumulate(np.where(is_digit, 0, place + 1))
        if np.any(digit[is_digit] > 14):
            raise self.problem("has a step of time of more than 60 bits")
        low = (value[:taken] & np.uint8(15)).astype(np.int64)
        step = np.where(is_digit, low << 4 * np.where(is_digit, digit, 0), step)
        times: NDArray[np.int64] = np.repeat(begin + np.cumsum(step), number)
        return times

    def _behind(self, kind: str, at: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of 16 bits behind entries of the next part."""
        data = np.frombuffer(self._data + bytes(4), np.uint8)
        place = self._at + (at + 1) * np.dtype(kind).itemsize
        return data[place].astype(np.int64) | data[place + 1].astype(np.int64) << 8

    def runs(self, kind: str, bits: int) -> NDArray[np.int64]:
        """Values of runs, whose length has `bits`."""
        most, item = (1 << bits) - 1, np.dtype(kind).itemsize
        long = 1 + 2 // item
        value = self._rest(kind, long).astype(np.int64)
        follows = value & most == most
        at = _chain(np.where(follows, long, 1))
        value, follows = value[at], follows[at]
        number = value & most
        number[follows] = self._behind(kind, at[follows])
        taken = self._taken(number, at + np.where(follows, long, 1), item)
        return np.repeat(value[:taken] >> bits, number[:taken])

    def columns(self) -> NDArray[np.int64]:
        value = self._rest("<u2", 1).astype(np.int64)
        bits = np.concatenate([np.ones((value.size, 1), np.int64), value[:, None] >> np.arange(4, -1, -1) & 1], axis=1)
        # the last entry may have bits of columns that only stood in the writer's memory
        taken = self._taken(bits.sum(axis=1), np.arange(1, value.size + 1), 2, spare=5)
        entry, beside = np.nonzero(bits[:taken])
        return ((value[entry] >> 5) + beside)[: self._count]


def _chain(size: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places of the entries, the first of which is at 0, where entry at place k has `size[k]`."""
    end = size.size
    follower = np.append(np.minimum(np.arange(end) + size, end), end)
    reached = np.zeros(end + 1, np.bool_)
    reached[0] = True
    # after k steps, followers are 2^k entries away, and all that are nearer have been reached
    while True:
        result = follower[reached]
        if reached[result].all():
            return np.flatnonzero(reached[:end])
        reached[result] = True
        follower = follower[follower]

"""The event read-out: a first-in, first-out buffer that a clocked bus empties."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.units import US_PER_S

#: Rows by which the start of the scan moves per microsecond, as a fraction of all rows: the golden section × 2³².
_GOLDEN = 2654435769


def scan_start_row(t_us: NDArray[np.int64], rows: int) -> NDArray[np.int64]:
    """Row at which the arbiter's scan begins at each time: a golden-section (Weyl) sequence over the rows."""
    return ((t_us.astype(np.uint64) * np.uint64(_GOLDEN) % np.uint64(2**32)) * np.uint64(rows) >> np.uint64(32)).astype(
        np.int64
    )


class EventReadout:
    """Which events get through to the outside.

    The bus takes one event at each tick k/rate of its clock from a buffer of `capacity` events. An event
    that finds the buffer full is lost. Events queue by time; events of one microsecond queue by rows, from a row
    that moves on with time (`scan_start_row`), so that no part of the sensor is favoured. An event keeps the
    time at which its pixel fired. The loss of an event does not change the state of its pixel.

    Parameters
    ----------
    rate_hz : events the bus takes per second.
    capacity : events the buffer holds.
    rows : rows of the event grid.

    Attributes
    ----------
    dropped : events lost so far.
    """

    STATE = ("_waiting", "_clock", "dropped")

    def __init__(self, rate_hz: float, capacity: int, rows: int) -> None:
        self._rate_hz, self._capacity, self._rows = float(rate_hz), int(capacity), rows
        self._waiting = 0
        self._clock = 0  # clock ticks up to the last event seen
        self.dropped = 0

    def take(self, events: NDArray[np.void]) -> NDArray[np.void]:
        """The events that get through, in the order given; see `admitted`."""
        return events[self.admitted(events)]

    def admitted(self, events: NDArray[np.void]) -> NDArray[np.bool_]:
        """Whether each event gets through.

        Parameters
        ----------
        events : `EVENT_DTYPE`, sorted by time and then row-major, none before those of earlier calls.
        """
        if events.size == 0:
            return np.zeros(0, np.bool_)
        t_us = events["t_us"].astype(np.int64)
        row = (events["y"] - scan_start_row(t_us, self._rows)) % self._rows
        order = np.lexsort((events["x"], row, t_us))
        clock = np.floor(t_us * self._rate_hz / US_PER_S).astype(np.int64)
        kept = np.empty(events.size, dtype=bool)
        kept[order] = self._admit(clock[order])
        self.dropped += int(np.count_nonzero(~kept))
        return kept

    def _admit(self, clock: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the buffer has room for each event, in order; `clock` [event] is the time in clock ticks."""
        served = np.diff(clock, prepend=self._clock)
        added = np.cumsum(1 - served)
        # content of the buffer just after each event if it had no limit; it is never negative
        after = added + np.maximum(self._waiting, np.maximum.accumulate(1 - added))
        if after.max() > self._capacity:
            # each event adds 1 to the content left after serving, and the buffer stays within its capacity
            add, low, high = _running(1 - served, np.ones_like(served), np.full_like(served, self._capacity))
            after = np.clip(self._waiting + add, low, high)
        before = np.maximum(np.concatenate([[self._waiting], after[:-1]]) - served, 0)
        self._waiting, self._clock = int(after[-1]), int(clock[-1])
        return before < self._capacity


def _running(
    add: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Each map w → clip(w + add, low, high) after all maps before it, as one such map; log₂ n passes.

    Clips of sums are closed under composition, so the buffer is a prefix scan [hillis1986].

    Parameters
    ----------
    add, low, high : [n], one map each.

    Returns
    -------
    add, low, high : [n], the composed maps.
    """
    reach = 1
    while reach < add.size:
        first = tuple(v[:-reach] for v in (add, low, high))
        second = tuple(v[reach:] for v in (add, low, high))
        together = (
            first[0] + second[0],
            np.clip(first[1] + second[0], second[1], second[2]),
            np.clip(first[2] + second[0], second[1], second[2]),
        )
        add, low, high = (np.concatenate([v[:reach], w]) for v, w in zip((add, low, high), together, strict=True))
        reach *= 2
    return add, low, high

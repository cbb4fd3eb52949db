"""A stream of events: blocks in order of time, with the size of the event grid."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.exchange.triggers import no_triggers
from hesim_render.pixels.evs.events import EVENT_DTYPE

#: Events of one block; with all copies that a format makes of it, a block takes less than 100 MB.
BLOCK = 1 << 20


@dataclass(frozen=True)
class EventStream:
    """Events of a file or of a recording, block by block; every iteration starts at the first event.

    Iteration checks each block: times never decrease and are not negative, and coordinates lie on the event grid.

    Parameters
    ----------
    blocks : function that returns a new iterator over arrays [event] of `EVENT_DTYPE`.
    shape : rows and columns of the event grid, px.
    source : file or folder of the events, for errors.
    interval_us : begin and end of the recording, µs; None if only its events are known.
    triggers : function that returns the edges of trigger lines, [edge] of `TRIGGER_DTYPE`, in order of time; formats
        that have none leave them out.

    Examples
    --------
    >>> import numpy as np
    >>> from hesim_render.exchange import EventStream
    >>> from hesim_render.pixels.evs.events import EVENT_DTYPE
    >>> events = np.array([(5, 1, 0, 1), (9, 3, 2, -1)], dtype=EVENT_DTYPE)
    >>> stream = EventStream.of(events, (4, 4))
    >>> [block.size for block in stream], stream.count()
    ([2], 2)
    """

    blocks: Callable[[], Iterable[NDArray]]
    shape: tuple[int, int]
    source: str | Path = "events"
    interval_us: tuple[int, int] | None = None
    triggers: Callable[[], NDArray] = no_triggers

    @classmethod
    def of(cls, events: NDArray, shape: tuple[int, int], source: str | Path = "events") -> "EventStream":
        """The stream of an array.

        Parameters
        ----------
        events : structured array [event] of `EVENT_DTYPE`, in order of time.
        shape : rows and columns of the event grid, px.
        source : name of the events, for errors.
        """
        return cls(lambda: (events[k : k + BLOCK] for k in range(0, events.size, BLOCK)), shape, source)

    def __iter__(self) -> Iterator[NDArray]:
        rows, cols = self.shape
        last_us, done = 0, 0
        for events in self.blocks():
            if events.size == 0:
                continue
            assert events.dtype == EVENT_DTYPE
            times = events["t_us"]
            back = np.flatnonzero(times[1:] < times[:-1])
            if times[0] < last_us or back.size:
                k = 0 if times[0] < last_us else int(back[0]) + 1
                before = last_us if k == 0 else int(times[k - 1])
                problem = f"comes after one at {before} µs" if done + k else "lies before 0"
                raise SpecError(
                    f"event {done + k}, at {times[k]} µs, {problem}; expected order of time", file=self.source
                )
            outside = (events["x"] >= cols) | (events["y"] >= rows)
            if outside.any():
                k = int(outside.argmax())
                where = f"x {events['x'][k]}, y {events['y'][k]}"
                raise SpecError(f"event {done + k} ({where}) is outside of {cols}x{rows} px", file=self.source)
            yield events
            last_us, done = int(times[-1]), done + events.size

    def require_side(self, largest: int, name: str, target: str | Path) -> None:
        """Refuse a sensor with more rows or columns than a format can address.

        Parameters
        ----------
        largest : most of each.
        name, target : the format, and the name of the file, for the error.

        Raises
        ------
        SpecError
            If it has more.
        """
        rows, cols = self.shape
        if max(rows, cols) > largest:
            raise SpecError(f"{name} addresses at most {largest} rows and columns, not {cols}x{rows} px", file=target)

    def encode_into(
        self,
        file: IO[bytes],
        name: str,
        encode: Callable[[NDArray, NDArray | None], NDArray],
        latest_us: int | None = None,
    ) -> None:
        """Write the events in the words of a format, block by block.

        Parameters
        ----------
        file : where to write.
        name : the format, for the error.
        encode : turns events, and the event before them (None before the first), into words.
        latest_us : last time that the format has, µs; None for no limit.

        Raises
        ------
        SpecError
            If an event is later than that.
        """
        before = None
        for events in self:
            last_us = int(events["t_us"][-1])
            if latest_us is not None and last_us > latest_us:
                raise SpecError(f"{name} ends at {latest_us} µs; an event is at {last_us} µs", file=self.source)
            file.write(encode(events, before).data)
            before = events[-1]

    def count(self) -> int:
        """Number of events; it reads all of them."""
        return sum(events.size for events in self)

    def span_us(self) -> tuple[int, int]:
        """Begin and end of the recording, or else the times of the first and the last event, for which it reads all.

        Returns
        -------
        The two times, µs; 0 and 0 without events.
        """
        if self.interval_us is not None:
            return self.interval_us
        first: int | None = None
        last = 0
        for events in self:
            first, last = int(events["t_us"][0]) if first is None else first, int(events["t_us"][-1])
        return first or 0, last

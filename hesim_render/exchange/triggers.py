"""Edges of trigger lines among the events of a file: the times of exposures, in the clock of the events."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import SpecError
from hesim_render.pixels.evs.events import events_of, no_events

#: t_us: time of the edge, µs; edge: +1 rising, −1 falling; channel: number of the line.
TRIGGER_DTYPE = np.dtype([("t_us", "i8"), ("edge", "i1"), ("channel", "u1")])
#: Line of the frames' exposures in the files that are written: high while the first row is exposed.
EXPOSURE_CHANNEL = 0
#: Most edges that are read of one file.
MOST_TRIGGERS = 1 << 22


def no_triggers() -> NDArray:
    """An empty array of edges."""
    return np.empty(0, dtype=TRIGGER_DTYPE)


def exposure_triggers(begin_us: ArrayLike, end_us: ArrayLike) -> NDArray:
    """Two edges for each exposure, in order of time: a rising one at its begin, a falling one at its end.

    Parameters
    ----------
    begin_us, end_us : [frame], µs; exposures do not overlap.

    Returns
    -------
    [edge] of `TRIGGER_DTYPE`, on `EXPOSURE_CHANNEL`.
    """
    times = np.stack([np.asarray(begin_us, np.int64), np.asarray(end_us, np.int64)], axis=-1)
    edges = np.zeros(times.size, dtype=TRIGGER_DTYPE)
    edges["t_us"], edges["channel"] = times.ravel(), EXPOSURE_CHANNEL
    edges["edge"] = np.tile(np.array([1, -1], np.int8), len(times))
    return edges


def exposures_of_pulses(triggers: NDArray, channel: int, count: int, file: str | Path) -> tuple[NDArray, NDArray]:
    """Begin and end of each exposure, µs: those of the pulses of a line.

    Parameters
    ----------
    triggers : [edge] of `TRIGGER_DTYPE`.
    channel : number of the line.
    count : number of exposures.
    file : of the triggers, for the error.

    Raises
    ------
    SpecError
        If the line does not have `count` pulses that begin with a rising edge and end with a falling one.
    """
    edges = triggers[triggers["channel"] == channel]
    begin, end = edges[::2], edges[1::2]
    if edges.size != 2 * count or np.any(begin["edge"] != 1) or np.any(end["edge"] != -1):
        lines = ", ".join(map(str, np.unique(triggers["channel"]))) or "none"
        raise SpecError(
            f"has {edges.size} edges of triggers on line {channel} (lines with triggers: {lines}); expected a rising "
            f"and a falling one for each of {count} frames",
            file=file,
        )
    return begin["t_us"], end["t_us"]


def joined(parts: Iterable[NDArray], file: str | Path) -> NDArray:
    """All edges of a file.

    Raises
    ------
    SpecError
        If there are more than `MOST_TRIGGERS`.
    """
    every, count = [no_triggers()], 0
    for part in parts:
        count += part.size
        if count > MOST_TRIGGERS:
            raise SpecError(f"has more than {MOST_TRIGGERS} edges of triggers", file=file)
        every.append(part)
    return np.concatenate(every)


def merged(
    blocks: Iterable[NDArray], triggers: NDArray, file: str | Path, channels: int
) -> Iterator[tuple[NDArray, NDArray[np.bool_] | None]]:
    """Blocks of events with the edges among them, each before the events of its own time.

    Parameters
    ----------
    blocks : events in order of time.
    triggers : [edge] of `TRIGGER_DTYPE`.
    file : of the triggers, for the error.
    channels : number of lines that the format has.

    Yields
    ------
    `EVENT_DTYPE` in which an edge has its line as x, the row of the event before as y and itself as polarity; and True
    where an entry is an edge, or None if none is.

    Raises
    ------
    SpecError
        If edges are out of order, lie before 0, or on a line that the format does not have.
    """
    times = triggers["t_us"]
    if times.size and (times[0] < 0 or np.any(times[1:] < times[:-1])):
        raise SpecError("has triggers that are not in order of time", file=file)
    if times.size and triggers["channel"].max() >= channels:
        problem = f"has a trigger on line {triggers['channel'].max()}; the format has lines 0 to {channels - 1}"
        raise SpecError(problem, file=file)
    done, row = 0, 0
    for events in blocks:
        last = int(np.searchsorted(times, events["t_us"][-1], side="right"))
        yield _inserted(events, triggers[done:last], row)
        done, row = last, int(events["y"][-1])
    if done < triggers.size:
        yield _inserted(no_events(), triggers[done:], row)


def _inserted(events: NDArray, triggers: NDArray, row: int) -> tuple[NDArray, NDArray[np.bool_] | None]:
    if triggers.size == 0:
        return events, None
    place = np.searchsorted(events["t_us"], triggers["t_us"], side="left")
    rows = np.concatenate([np.array([row], np.uint16), events["y"]])
    edges = events_of(triggers["t_us"], triggers["channel"], rows[place], triggers["edge"])
    return np.insert(events, place, edges), np.insert(np.zeros(events.size, np.bool_), place, True)

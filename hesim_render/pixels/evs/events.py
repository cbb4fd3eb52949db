"""The form of events: one structured array, in order of time."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: t_us: end of the event's integration window, µs; x, y: column and row on the event grid, (0, 0) at
#: the top left; polarity: +1 (ON) or -1 (OFF).
EVENT_DTYPE = np.dtype([("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])

#: An event with its cause (number of `Label`) and the object that its pixel shows (0 is the background).
LABELLED_DTYPE = np.dtype([*((name, EVENT_DTYPE[name]) for name in EVENT_DTYPE.names or ()), ("cause", "u1"),
                           ("object", "u2")])  # fmt: skip


class Origin(IntEnum):
    """What in the pixel gave an event."""

    COMPARATOR = 1
    LEAK = 2
    DEFECT = 3
    DRIFT = 4  # of the comparator, but at least half of it from the drift of the leak
    COMPARATOR_NOISE = 5


def no_events() -> NDArray:
    """An empty event array."""
    return np.empty(0, dtype=EVENT_DTYPE)


def events_of(t_us: ArrayLike, x: ArrayLike, y: ArrayLike, is_on: ArrayLike) -> NDArray[np.void]:
    """Structured array of events [event] of `EVENT_DTYPE`; ON where `is_on` is above 0, else OFF."""
    events = np.empty(np.size(x), EVENT_DTYPE)
    events["t_us"], events["x"], events["y"] = t_us, x, y
    events["polarity"] = np.where(np.asarray(is_on) > 0, 1, -1)
    return events


def events_at(t_us: ArrayLike, pixel: NDArray[np.integer], polarity: ArrayLike, cols: int) -> NDArray[np.void]:
    """Structured array of events at flat pixel indices of an event grid `cols` wide."""
    events = np.empty(len(pixel), EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us, polarity
    events["y"], events["x"] = np.divmod(pixel.astype(np.uint32), np.uint32(cols))
    return events


class Label(IntEnum):
    """Causes of events; the numbers are those of the file."""

    SIGNAL = 0
    MISMATCH = 1
    LEAK = 2
    HOT = 3
    NOISE = 4


class Lost(IntEnum):
    """Where events were lost."""

    READOUT = 0
    REFRACTORY = 1


@dataclass(frozen=True, eq=False)
class LabelBlock:
    """Labels of the next events of a run, and what has become of earlier ones.

    Parameters
    ----------
    label : uint8 [event], numbers of `Label`, of the events since the previous block.
    changed, changed_to : int64 [k] and uint8 [k], numbers of events from the start of the run that have another label
        now, and that; later entries hold.
    lost : events (`EVENT_DTYPE`) that the read-out or the dead time has lost since then, in order of time.
    lost_in : uint8 [lost], numbers of `Lost`.
    clean : events of the noise-free pixels since the previous block, `EVENT_DTYPE`, in order of time.
    """

    label: NDArray[np.uint8]
    changed: NDArray[np.int64]
    changed_to: NDArray[np.uint8]
    lost: NDArray[np.void]
    lost_in: NDArray[np.uint8]
    clean: NDArray[np.void]

    @classmethod
    def empty(cls) -> "LabelBlock":
        """Nothing."""
        none = np.empty(0, np.uint8)
        return cls(none, np.empty(0, np.int64), none, no_events(), none, no_events())


@dataclass(frozen=True, eq=False, repr=False)
class EventLabels:
    """Labels of all events of a run.

    Parameters
    ----------
    label : uint8 [event], numbers of `Label`, in the order of the events.
    lost : events (`EVENT_DTYPE`) that the read-out or the dead time has lost, in order of time.
    lost_in : uint8 [lost], numbers of `Lost`.
    clean : events of the noise-free pixels, `EVENT_DTYPE`, in order of time.
    """

    label: NDArray[np.uint8]
    lost: NDArray[np.void]
    lost_in: NDArray[np.uint8]
    clean: NDArray[np.void]

    def __repr__(self) -> str:
        return f"<EventLabels of {self.label.size} events; {self.lost.size} lost, {self.clean.size} without noise>"

    @classmethod
    def of(cls, blocks: Sequence[LabelBlock]) -> "EventLabels":
        """The labels of a whole run from all its blocks, which are in order of time."""
        every = [LabelBlock.empty(), *blocks]
        label = np.concatenate([block.label for block in every])
        for block in every:
            label[block.changed] = block.changed_to
        return cls(label, *(np.concatenate([getattr(b, name) for b in every]) for name in ("lost", "lost_in", "clean")))

    def as_block(self) -> LabelBlock:
        """All labels as one block."""
        return LabelBlock(self.label, np.empty(0, np.int64), np.empty(0, np.uint8), self.lost, self.lost_in, self.clean)

    def counts(self) -> dict[str, int]:
        """Number of events of each cause, of lost ones, and of noise-free ones."""
        per_label = {label.name.lower(): int(np.count_nonzero(self.label == label)) for label in Label}
        lost = {f"lost_{place.name.lower()}": int(np.count_nonzero(self.lost_in == place)) for place in Lost}
        return {**per_label, **lost, "noise_free": int(self.clean.size)}

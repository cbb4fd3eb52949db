"""The form of events: one structured array, in order of time."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

#: t_us: end of the event's integration window, µs; x, y: column and row on the event grid, (0, 0) at
#: the top left; polarity: +1 (ON) or -1 (OFF).
EVENT_DTYPE = np.dtype([("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("polarity", "i1")])


class Origin(IntEnum):
    """What in the pixel gave an event."""

    COMPARATOR = 1
    LEAK = 2
    DEFECT = 3


def no_events() -> NDArray:
    """An empty event array."""
    return np.empty(0, dtype=EVENT_DTYPE)

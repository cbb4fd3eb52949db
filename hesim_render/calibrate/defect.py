"""What a bad event pixel does."""

from __future__ import annotations

from enum import IntEnum


class Defect(IntEnum):
    """What a pixel does; values are those of the map ``defect``."""

    NONE = 0
    STUCK = 1  # gives no event at all
    HOT = 2  # gives events at a steady rate of its own
    FLICKERING = 3  # gives events at a rate that comes and goes
    OTHER = 4  # its counts are unlike those of any threshold; nothing more is known

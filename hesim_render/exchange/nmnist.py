"""N-MNIST ``.bin``: five bytes for an event.

x; y; polarity in bit 7 and the upper 7 bits of the time; the middle and the lower 8 bits of the time, in µs.
"""

from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from hesim_render.exchange.stream import EventStream

_LARGEST_SIDE = 1 << 8
_TIME_BITS = 23


def write(stream: EventStream, file: IO[bytes], target: str | Path) -> None:
    """Write events as an N-MNIST file.

    Raises
    ------
    SpecError
        If the sensor has more than 256 rows or columns, or an event lies at 2²³ µs (8.4 s) or later.
    """
    stream.require_side(_LARGEST_SIDE, "N-MNIST", target)
    stream.encode_into(file, "N-MNIST", _encoded, (1 << _TIME_BITS) - 1)


def _encoded(events: NDArray, _: NDArray | None) -> NDArray[np.uint8]:
    """Five bytes of each event."""
    made = np.empty((events.size, 5), dtype=np.uint8)
    made[:, 0], made[:, 1] = events["x"], events["y"]
    made[:, 2] = (events["polarity"] > 0).astype(np.uint8) << np.uint8(7) | (events["t_us"] >> 16).astype(np.uint8)
    made[:, 3] = events["t_us"] >> 8 & 0xFF
    made[:, 4] = events["t_us"] & 0xFF
    return made

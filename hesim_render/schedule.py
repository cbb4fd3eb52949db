"""When each row is exposed and when each event comparison is made, in µs from the start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.specs.sensor import ApsSpec, EvsSpec
from hesim_render.units import US_PER_S


@dataclass(frozen=True)
class Exposure:
    """One frame: row r integrates over [start_us + r·line_time_us, … + exposure_us].

    Parameters
    ----------
    index : frame number, 0 first.
    start_us : begin of row 0's exposure.
    rows : rows that are read out.
    line_time_us : delay from row to row; 0 for a global shutter.
    """

    index: int
    start_us: int
    exposure_us: int
    rows: int
    line_time_us: float

    @property
    def t_us(self) -> int:
        """Time stamp: the end of row 0's exposure."""
        return self.start_us + self.exposure_us

    @property
    def end_us(self) -> float:
        """End of the last row's exposure."""
        return self.start_us + (self.rows - 1) * self.line_time_us + self.exposure_us

    def row_begin_us(self, row: NDArray) -> NDArray[np.float64]:
        return self.start_us + row * self.line_time_us


def exposures(spec: ApsSpec, rows: int, duration_us: int) -> list[Exposure]:
    """All frames whose last row is fully exposed within the run.

    Frame k begins at k / frame_rate_hz. A region of fewer rows is read out as a window: its first
    row starts the frame.
    """
    line_time_us = spec.line_time_us if spec.shutter == "rolling" else 0.0
    found: list[Exposure] = []
    while True:
        start_us = round(len(found) * US_PER_S / spec.frame_rate_hz)
        exposure = Exposure(len(found), start_us, spec.exposure_us, rows, line_time_us)
        if exposure.end_us > duration_us:
            return found
        found.append(exposure)


def ticks_us(spec: EvsSpec, duration_us: int) -> NDArray[np.int64]:
    """Times of the fixed comparisons: k·tick_us, k = 1, 2, …; each ends a window of window_us."""
    assert spec.tick_us is not None
    return np.arange(spec.tick_us, duration_us + 1, spec.tick_us, dtype=np.int64)

"""Places at which truth is given: all mosaic pixels of a region, or its event pixels."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError
from hesim_render.sensor.sensor import Sensor

#: Names of the grids.
Grid = Literal["mosaic", "events"]


@dataclass(frozen=True)
class Raster:
    """A grid of pixels, (0, 0) at the left top.

    Parameters
    ----------
    col, row : [height, width], column and row of each pixel's centre on the full sensor, whole px.
    first : column and row of the region on the full sensor.
    step : mosaic pixels from one column, and from one row, of the grid to the next.
    """

    col: NDArray[np.int64]
    row: NDArray[np.int64]
    first: tuple[int, int]
    step: tuple[float, float]

    @classmethod
    def of(cls, sensor: Sensor, grid: str) -> "Raster":
        """The mosaic (``mosaic``) or the event grid (``events``) of a sensor.

        Raises
        ------
        RangeError
            If the grid is unknown or the sensor has no event pixels.
        """
        layout = sensor.layout
        first = layout.col0, layout.row0
        if grid == "mosaic":
            row, col = np.mgrid[: layout.rows, : layout.cols]
            return cls(col + first[0], row + first[1], first, (1.0, 1.0))
        if grid != "events":
            raise RangeError("grid", grid, "'mosaic' or 'events'")
        if 0 in layout.evs_shape:
            raise RangeError("grid", grid, f"'mosaic': sensor {sensor.name!r} has no event pixels")
        row, col = np.divmod(layout.evs_pixel.astype(np.int64), layout.cols)
        step = layout.cols / layout.evs_shape[1], layout.rows / layout.evs_shape[0]
        return cls(col + first[0], row + first[1], first, step)

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.row.shape[0], self.row.shape[1]

    @property
    def origin_px(self) -> tuple[float, float]:
        """Column and row on the full sensor that are (0, 0) of the grid: the mean of each pixel's own."""
        height, width = self.shape
        return (
            float(np.mean(self.col - self.step[0] * np.arange(width))),
            float(np.mean(self.row - self.step[1] * np.arange(height)[:, None])),
        )

    @property
    def is_even(self) -> bool:
        """True if all pixels lie exactly on the grid; where a tile has its event pixels at uneven places, they do not,
        and `col` and `row` tell where they are.
        """
        height, width = self.shape
        x0, y0 = self.origin_px
        return bool(
            np.allclose(self.col, x0 + self.step[0] * np.arange(width), atol=1e-6)
            and np.allclose(self.row, y0 + self.step[1] * np.arange(height)[:, None], atol=1e-6)
        )

    def to_grid(self, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places on the full sensor [..., 2] as column and row of this grid."""
        return (place_px - np.array(self.origin_px)) / np.array(self.step)


def row_times_us(when: Any, rows: int) -> NDArray[np.float64]:
    """Time of each mosaic row of a region, [rows], µs.

    Parameters
    ----------
    when : one time, a time for each row, or a `Frame` (the middle of each row's exposure), µs.
    rows : rows of the region.

    Raises
    ------
    RangeError
        If it is none of these.
    """
    given: ArrayLike = getattr(when, "row_times_us", when)
    try:
        times = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        times = np.full((), np.nan)
    if times.shape not in ((), (rows,)) or not np.all(np.isfinite(times)):
        raise RangeError("time", when, f"one time in µs, one for each of the {rows} rows, or a frame")
    return np.broadcast_to(times, (rows,)).copy()

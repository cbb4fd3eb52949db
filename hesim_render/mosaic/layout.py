"""Positions of pixels: the tile over the read-out region, its filters, roles and event grid."""

import operator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibration.measured import MeasuredMaps
from hesim_render.core.errors import RangeError
from hesim_render.core.plain import PlainState
from hesim_render.specs.sensor import Role, SensorSpec


@dataclass(frozen=True, repr=False)
class Layout(PlainState):
    """Read-out region of a sensor; all arrays are [row, col] with (0, 0) at the top left.

    Parameters
    ----------
    spec : the sensor file.
    row0, col0 : first row and column on the full sensor; whole tiles, so a crop keeps the tile's phase.
    rows, cols : size of the region in pixels.
    maps : of the calibration that the sensor file names, over the region that it captured; None where there is no
        calibration, or its maps are not at hand.
    """

    spec: SensorSpec
    row0: int
    col0: int
    rows: int
    cols: int
    maps: MeasuredMaps | None = None

    def __repr__(self) -> str:
        return f"<Layout {self.spec.name!r}: {self.cols}x{self.rows}+{self.col0}+{self.row0} px>"

    @classmethod
    def full(cls, spec: SensorSpec, maps: MeasuredMaps | None = None) -> "Layout":
        """The whole sensor."""
        return cls(spec, 0, 0, spec.geometry.rows, spec.geometry.cols, maps)

    def crop(self, width_px: int, height_px: int, x: int | None = None, y: int | None = None) -> "Layout":
        """A region of this region, in whole tiles; centred where `x`, `y` are not given.

        Parameters
        ----------
        width_px, height_px : size, px.
        x, y : first column and row inside this region, px.

        Raises
        ------
        RangeError
            If the region is not made of whole tiles or does not fit, or a size is not a whole number.
        """
        tile_rows, tile_cols = self.tile_shape
        starts, sizes = list[int](), list[int]()
        for name, size, whole, start, period in (
            ("width_px", width_px, self.cols, x, tile_cols),
            ("height_px", height_px, self.rows, y, tile_rows),
        ):
            size = _whole(f"roi {name}", size)
            if size <= 0 or size > whole:
                raise RangeError(f"roi {name}", size, f"1 to {whole}, the sensor's size")
            if size % period:
                raise RangeError(f"roi {name}", size, f"a multiple of the tile's {period} pixels")
            offset = ((whole - size) // 2) // period * period
            if start is not None:
                offset = _whole(f"roi offset along {name}", start)
            if offset % period:
                raise RangeError(f"roi offset along {name}", offset, f"a multiple of the tile's {period} pixels")
            if offset < 0 or offset + size > whole:
                raise RangeError(f"roi offset along {name}", offset, f"0 to {whole - size}, inside the sensor")
            starts.append(offset)
            sizes.append(size)
        return replace(self, row0=self.row0 + starts[1], col0=self.col0 + starts[0], rows=sizes[1], cols=sizes[0])

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def tile_shape(self) -> tuple[int, int]:
        return len(self.spec.tile_rows), len(self.spec.tile_rows[0])

    def tiled(self, tile: NDArray) -> NDArray:
        """A per-position table [tile_row, tile_col, …] repeated over the region: [row, col, …]."""
        rows, cols = np.ogrid[: self.rows, : self.cols]
        tile_rows, tile_cols = self.tile_shape
        return tile[rows % tile_rows, cols % tile_cols]

    @property
    def filters(self) -> list[str]:
        """Filter names in file order; `filter_index` counts in this list."""
        return list(self.spec.filters)

    def _filter_tile(self) -> NDArray[np.uint8]:
        spec = self.spec
        names = self.filters
        return np.array([[names.index(spec.pixels[c].filter) for c in row] for row in spec.tile_rows], dtype=np.uint8)

    @cached_property
    def filter_index(self) -> NDArray[np.uint8]:
        """Number of each pixel's filter, [row, col]."""
        return self.tiled(self._filter_tile())

    def has_role(self, role: Role) -> NDArray[np.bool_]:
        """True for pixels that have a role, [row, col]."""
        tile = np.zeros(self.tile_shape, dtype=bool)
        for position in self.spec.positions(role):
            tile[position] = True
        return self.tiled(tile)

    @cached_property
    def aps_mask(self) -> NDArray[np.bool_]:
        """True for frame pixels, [row, col]."""
        return self.has_role("aps")

    @cached_property
    def aps_pixel(self) -> NDArray[np.uint32]:
        """Mosaic index (row · cols + col in this region) of each frame pixel, in order, [n]."""
        return np.flatnonzero(self.aps_mask).astype(np.uint32)

    @cached_property
    def full_index(self) -> NDArray[np.uint32]:
        """Index of each pixel on the full sensor, row-major, [row, col]; it is the key of random numbers."""
        cols = self.spec.geometry.cols
        rows, columns = np.ogrid[self.row0 : self.row0 + self.rows, self.col0 : self.col0 + self.cols]
        return (rows * cols + columns).astype(np.uint32)

    @property
    def evs_shape(self) -> tuple[int, int]:
        """Rows and columns of the event grid, (0, 0) where there are no event pixels."""
        grid = self.spec.evs_grid
        if grid is None or self.spec.evs is None:
            return 0, 0
        tile_rows, tile_cols = self.tile_shape
        return self.rows // tile_rows * grid.rows_per_tile, self.cols // tile_cols * grid.cols_per_tile

    @cached_property
    def evs_pixel(self) -> NDArray[np.uint32]:
        """Mosaic index (row · cols + col in this region) of each event pixel, on the event grid [y, x]."""
        return self._evs_maps[0]

    @cached_property
    def evs_position(self) -> NDArray[np.uint8]:
        """Number of each event pixel's tile position, in reading order, on the event grid [y, x]."""
        return self._evs_maps[1]

    @cached_property
    def _evs_maps(self) -> tuple[NDArray[np.uint32], NDArray[np.uint8]]:
        pixel = np.zeros(self.evs_shape, dtype=np.uint32)
        position = np.zeros(self.evs_shape, dtype=np.uint8)
        grid = self.spec.evs_grid
        if grid is None or pixel.size == 0:
            return pixel, position
        tile_rows, tile_cols = self.tile_shape
        tiles_y, tiles_x = np.ogrid[: self.rows // tile_rows, : self.cols // tile_cols]
        for k, (i, j) in enumerate(self.spec.positions("evs")):
            a, b = divmod(k, grid.cols_per_tile)
            index = (tiles_y * tile_rows + i) * self.cols + tiles_x * tile_cols + j
            pixel[a :: grid.rows_per_tile, b :: grid.cols_per_tile] = index
            position[a :: grid.rows_per_tile, b :: grid.cols_per_tile] = k
        return pixel, position


def _whole(name: str, value: int) -> int:
    """A number of pixels, also one of NumPy's integers, as an integer of Python, which a manifest takes."""
    try:
        return operator.index(value)
    except TypeError:
        raise RangeError(name, value, "a whole number of pixels") from None

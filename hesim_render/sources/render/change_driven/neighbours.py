"""The pixels of a list and their neighbours."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_columns

#: Largest distance of a neighbour from its listed pixel, pixels.
REACH = 3


@dataclass(frozen=True)
class Sites:
    """Listed pixels and their neighbours on the mosaic of the full sensor, independent of the read-out region.

    Statistics over a pixel's neighbourhood are therefore equal to the bit for a crop and for the full sensor. Sums add
    their terms in the same order.

    Parameters
    ----------
    index : [m], numbers on the full sensor, increasing.
    listed : [n], places of the listed pixels in `index`, in the order of the list.
    shape : rows and columns of the rectangle around all sites; None where the listed pixels have no neighbours.
    cell : [m], places of the sites in that rectangle.
    """

    index: NDArray[np.uint32]
    listed: NDArray[np.int64]
    shape: tuple[int, int] | None = None
    cell: NDArray[np.int64] | None = None
    _count: list[NDArray[np.float32]] = field(default_factory=list)

    @classmethod
    def alone(cls, pixel: NDArray[np.uint32]) -> Sites:
        """Listed pixels without neighbours."""
        index, listed = np.unique(pixel, return_inverse=True)
        return cls(index, listed.astype(np.int64))

    @classmethod
    def around(cls, pixel: NDArray[np.uint32], rows: int, cols: int) -> Sites:
        """Listed pixels with their neighbours up to `REACH` away, on a full sensor of the given size."""
        # the smallest rectangle [row, col] with all listed pixels and their neighbours, cut to the sensor
        row, col = np.divmod(pixel.astype(np.int64), cols)
        top, bottom = max(0, int(row.min()) - REACH), min(rows, int(row.max()) + REACH + 1)
        left, right = max(0, int(col.min()) - REACH), min(cols, int(col.max()) + REACH + 1)
        shape = bottom - top, right - left
        wanted = np.zeros((shape[0] + 2 * REACH, shape[1] + 2 * REACH), np.bool_)
        inner = wanted[REACH:-REACH, REACH:-REACH]
        inner[row - top, col - left] = True
        # sites are the cells of the rectangle with a listed pixel within reach, in row-major order
        near = np.zeros(shape, np.bool_)
        for down in range(2 * REACH + 1):
            for right_ in range(2 * REACH + 1):
                near |= wanted[down : down + shape[0], right_ : right_ + shape[1]]
        # number of each cell among the sites, where it is one
        cell = np.flatnonzero(near)
        place = np.cumsum(near.ravel()) - 1
        site_row, site_col = np.divmod(cell, shape[1])
        index = ((site_row + top) * cols + site_col + left).astype(np.uint32)
        return cls(index, place[(row - top) * shape[1] + col - left], shape, cell)

    @property
    def size(self) -> int:
        return self.index.size

    def mean(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean of `values` [m] over the sites in the 3×3 neighbourhood of each listed pixel, [n]."""
        if self.shape is None:
            return values[self.listed]
        # near the rim of the sensor there are fewer than nine
        if not self._count:
            self._count.append(self._sum(np.ones(self.size, np.float32)))
        return self._sum(values) / self._count[0]

    def _sum(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        image = self._image(values, 1, 0.0)
        across = image[:, :-2] + image[:, 1:-1] + image[:, 2:]
        return self._at_listed(across[:-2] + across[1:-1] + across[2:])

    def most(self, values: NDArray, radius: int) -> NDArray:
        """Largest of `values` [m] at most `radius` pixels away from each listed pixel, also diagonally, [n]."""
        if self.shape is None:
            return values[self.listed]
        lowest = False if values.dtype == np.bool_ else -np.inf
        image = self._image(values, radius, lowest)
        # along rows, then along columns: 4r steps in place of (2r + 1)²
        cols, rows = image.shape[1] - 2 * radius, image.shape[0] - 2 * radius
        across = image[:, :cols]
        for shift in range(1, 2 * radius + 1):
            across = np.maximum(across, image[:, shift : shift + cols])
        within = across[:rows]
        for shift in range(1, 2 * radius + 1):
            within = np.maximum(within, across[shift : shift + rows])
        return self._at_listed(within)

    def near(self, marked: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
        """True at sites [m] at most `radius` pixels away from a marked one [m], also diagonally."""
        if self.shape is None or self.cell is None:
            return marked
        image = self._image(marked, radius, False)
        rows, cols = self.shape
        across = image[:, :cols].copy()
        for shift in range(1, 2 * radius + 1):
            across |= image[:, shift : shift + cols]
        within = across[:rows].copy()
        for shift in range(1, 2 * radius + 1):
            within |= across[shift : shift + rows]
        return within.ravel()[self.cell]

    def _image(self, values: NDArray, margin: int, empty: float | bool) -> NDArray:
        assert self.shape is not None
        rows, cols = self.shape
        image = np.full((rows + 2 * margin, cols + 2 * margin), empty, values.dtype)
        inner = np.full(rows * cols, empty, values.dtype)
        inner[self.cell] = values
        image[margin : margin + rows, margin : margin + cols] = inner.reshape(rows, cols)
        return image

    def _at_listed(self, image: NDArray) -> NDArray:
        assert self.cell is not None
        return image.ravel()[self.cell[self.listed]]


def turns(row: NDArray[np.integer], window: NDArray[np.integer]) -> NDArray[np.int64]:
    """For each pair: the number of other windows of its row that come first, [n]."""
    # distinct pairs in order of row, then of window: the rank of each counts from the first of its row
    pairs, place = distinct_columns(np.stack([row.astype(np.int64), window.astype(np.int64)]))
    if pairs.shape[1] == 0:
        return np.empty(0, np.int64)
    starts = np.flatnonzero(np.diff(pairs[0], prepend=pairs[0][0] - 1))
    rank = np.arange(pairs.shape[1]) - np.repeat(starts, np.diff(starts, append=pairs.shape[1]))
    return rank[place]


def of_own_row(sites: Sites, window: NDArray[np.integer], cols: int) -> NDArray[np.int64]:
    """Window of each site: that of the listed pixels in its row, or in the nearest row that has any."""
    row, listed = sites.index.astype(np.int64) // cols, sites.index[sites.listed].astype(np.int64) // cols
    rows, first = np.unique(listed, return_index=True)
    # the middle between two rows parts the sites of one from those of the other
    nearest = np.searchsorted((rows[1:] + rows[:-1]) / 2, row)
    return window[first[nearest]].astype(np.int64)

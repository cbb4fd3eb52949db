"""Which listed pixels lie next to which: lists of pixels as pictures, and what happens around each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError


class Neighbours:
    """A list of mosaic pixels, spread about evenly over a region, on a map of cells of about one pixel each.

    Parameters
    ----------
    pixel : [n], mosaic indices (row · cols + col).
    shape : rows and columns of the region.
    """

    def __init__(self, pixel: NDArray[np.integer], shape: tuple[int, int]) -> None:
        rows, cols = shape
        self.cell_px = max(1, int(np.sqrt(rows * cols / max(1, pixel.size))))
        row, col = np.divmod(pixel.astype(np.int64), cols)
        self._shape = -(-rows // self.cell_px), -(-cols // self.cell_px)
        self._cell = (row // self.cell_px) * self._shape[1] + col // self.cell_px
        self._count = ndimage.uniform_filter(self._image(np.ones(pixel.size)), 3, mode="constant").ravel()[self._cell]

    def _image(self, values: NDArray) -> NDArray:
        flat = np.zeros(self._shape[0] * self._shape[1], dtype=values.dtype)
        flat[self._cell] = values
        return flat.reshape(self._shape)

    def mean(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean over the listed pixels among each one's 3×3 cells, [n]."""
        total = ndimage.uniform_filter(self._image(values), 3, mode="constant").ravel()[self._cell]
        return np.maximum(total, 0.0) / self._count

    def most(self, values: NDArray, radius: int) -> NDArray:
        """Largest value within `radius` cells of each pixel, diagonally too, [n]."""
        return ndimage.maximum_filter(self._image(values), size=2 * radius + 1).ravel()[self._cell]

    def inside(self, outlines_px: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
        """Pixels within a cell of the convex hull of any of some sets of points (column, row; mosaic pixels), [n]."""
        found = np.zeros(self._shape, np.bool_)
        for points in outlines_px:
            low = np.floor(points.min(axis=0) / self.cell_px).astype(np.int64) - 1
            high = np.ceil(points.max(axis=0) / self.cell_px).astype(np.int64) + 2
            (left, top), (right, bottom) = np.maximum(low, 0), np.minimum(high, self._shape[::-1])
            if right <= left or bottom <= top:
                continue
            x = (np.arange(left, right) + 0.5)[None, :] * self.cell_px
            y = (np.arange(top, bottom) + 0.5)[:, None] * self.cell_px
            within = np.ones((bottom - top, right - left), np.bool_)
            try:
                for a, b, c in ConvexHull(points).equations:
                    within &= a * x + b * y + c <= 1.5 * self.cell_px
            except QhullError:
                pass  # points on a line, seen edge-on: the box around them will do
            found[top:bottom, left:right] |= within
        return found.ravel()[self._cell]

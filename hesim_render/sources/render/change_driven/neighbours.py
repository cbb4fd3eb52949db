"""The pixels of a list and their neighbours."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_columns

#: Largest distance of a neighbour from its listed pixel, pixels.
REACH = 3


@dataclass(frozen=True)
class Lattice:
    """Pixels of a role on the mosaic of the full sensor, where they lie on a regular lattice.

    Parameters
    ----------
    rows, cols : number of rows and columns of the lattice.
    first : row and column of its first pixel on the full sensor, each below the step.
    step : distance of its rows, and of its columns, pixels.
    sensor_cols : columns of the full sensor.
    """

    rows: int
    cols: int
    first: tuple[int, int]
    step: tuple[int, int]
    sensor_cols: int

    @classmethod
    def whole(cls, rows: int, cols: int) -> "Lattice":
        """All pixels of a sensor."""
        return cls(rows, cols, (0, 0), (1, 1), cols)

    def place(self, index: NDArray[np.uint32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column on the lattice of some of its pixels."""
        row, col = np.divmod(index.astype(np.int64), self.sensor_cols)
        return row // self.step[0], col // self.step[1]

    def index(self, row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Numbers on the full sensor of the pixels in some rows and columns of the lattice."""
        number = (row * self.step[0] + self.first[0]) * self.sensor_cols + col * self.step[1] + self.first[1]
        return number.astype(np.uint32)


@dataclass(frozen=True)
class Board:
    """A rectangle of a lattice, some fields of which are sites.

    Parameters
    ----------
    shape : rows and columns.
    cell : [m], places of the sites in the rectangle, in row-major order.
    odd : [m], True where row and column on the lattice add up to an odd number, as on a chequered board.
    """

    shape: tuple[int, int]
    cell: NDArray[np.int64]
    odd: NDArray[np.bool_]

    @cached_property
    def _whole(self) -> tuple[slice, slice]:
        """The longest run of rows of which all fields are sites, and the places of these among the sites."""
        rows, cols = self.shape
        # place of the first site of each row
        first = np.searchsorted(self.cell, np.arange(rows + 1) * cols)
        is_whole = np.diff(first) == cols
        edges = np.flatnonzero(np.diff(is_whole, prepend=False, append=False))
        if edges.size == 0:
            return slice(0, 0), slice(0, 0)
        begins, ends = edges[::2], edges[1::2]
        longest = int(np.argmax(ends - begins))
        begin, end = int(begins[longest]), int(ends[longest])
        return slice(begin, end), slice(int(first[begin]), int(first[end]))

    def image(self, values: NDArray, margin: int, empty: float | bool) -> NDArray:
        """Values of the sites [m] in the rectangle, with a margin around; `empty` in all other fields."""
        rows, cols = self.shape
        image = np.full((rows + 2 * margin, cols + 2 * margin), empty, values.dtype)
        inner = image[margin : margin + rows, margin : margin + cols]
        # most sites of a band lie in whole rows, which are copied as they are; the others go to their fields
        whole, sites = self._whole
        inner[whole] = values[sites].reshape(-1, cols)
        for others in (slice(0, sites.start), slice(sites.stop, None)):
            row, col = np.divmod(self.cell[others], cols)
            inner[row, col] = values[others]
        return image

    def near(self, marked: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
        """True at sites [m] at most `radius` fields away from a marked one [m], also diagonally."""
        image = self.image(marked, radius, False)
        rows, cols = self.shape
        # along rows, then along columns: 4r steps in place of (2r + 1)²
        across = image[:, :cols].copy()
        for shift in range(1, 2 * radius + 1):
            across |= image[:, shift : shift + cols]
        within = across[:rows].copy()
        for shift in range(1, 2 * radius + 1):
            within |= across[shift : shift + rows]
        return within.ravel()[self.cell]


@dataclass(frozen=True)
class Sites:
    """Listed pixels and their neighbours on the mosaic of the full sensor, independent of the read-out region.

    Statistics over a pixel's neighbourhood are therefore equal to the bit for a crop and for the full sensor. Sums add
    their terms in the same order. Pixels that lie apart have no statistics of others; what happens to those around them
    on the lattice may be known all the same.

    Parameters
    ----------
    index : [m], numbers on the full sensor, increasing.
    listed : [n], places of the listed pixels in `index`, in the order of the list.
    board : the sites on their lattice; None if there is none.
    apart : True where the listed pixels have no direct neighbours.
    """

    index: NDArray[np.uint32]
    listed: NDArray[np.int64]
    board: Board | None = None
    apart: bool = True
    _count: list[NDArray[np.float32]] = field(default_factory=list)
    #: Cells of the listed pixels, where many statistics of a few of them are asked for.
    _cells: NDArray[np.int64] | None = None

    @classmethod
    def alone(cls, pixel: NDArray[np.uint32]) -> "Sites":
        """Listed pixels without neighbours, on no lattice."""
        index, listed = np.unique(pixel, return_inverse=True)
        return cls(index, listed.astype(np.int64))

    @classmethod
    def around(cls, pixel: NDArray[np.uint32], lattice: Lattice, more: int = 0) -> "Sites":
        """Listed pixels with their neighbours up to `REACH` away and some `more`, or, where they lie apart, with the
        next ones.
        """
        apart = lattice.step != (1, 1)
        reach = (1 if apart else REACH) + more
        # the smallest rectangle [row, col] with all listed pixels and their neighbours, cut to the sensor
        row, col = lattice.place(pixel)
        top, bottom = max(0, int(row.min()) - reach), min(lattice.rows, int(row.max()) + reach + 1)
        left, right = max(0, int(col.min()) - reach), min(lattice.cols, int(col.max()) + reach + 1)
        shape = bottom - top, right - left
        wanted = np.zeros((shape[0] + 2 * reach, shape[1] + 2 * reach), np.bool_)
        inner = wanted[reach:-reach, reach:-reach]
        inner[row - top, col - left] = True
        # sites are the cells of the rectangle with a listed pixel within reach, in row-major order
        near = np.zeros(shape, np.bool_)
        for down in range(2 * reach + 1):
            for right_ in range(2 * reach + 1):
                near |= wanted[down : down + shape[0], right_ : right_ + shape[1]]
        # number of each cell among the sites, where it is one
        cell = np.flatnonzero(near)
        place = np.cumsum(near.ravel()) - 1
        site_row, site_col = np.divmod(cell, shape[1])
        board = Board(shape, cell, (site_row + top + site_col + left) % 2 == 1)
        index = lattice.index(site_row + top, site_col + left)
        return cls(index, place[(row - top) * shape[1] + col - left], board, apart)

    @property
    def size(self) -> int:
        return self.index.size

    def only(self, some: NDArray[np.int64]) -> "Sites":
        """The same sites, with some of the listed pixels as the list."""
        listed = self.listed[some]
        only = replace(self, listed=listed, _count=[], _cells=None if self.board is None else self.board.cell[listed])
        if not self.apart:
            only._count.append(self._counted()[some])
        return only

    def mean(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean of `values` [m] over the sites in the 3×3 neighbourhood of each listed pixel, [n]."""
        if self.apart:
            return values[self.listed]
        return self._sum(values) / self._counted()

    def _counted(self) -> NDArray[np.float32]:
        """Sites in the 3×3 neighbourhood of each listed pixel, [n]; near the rim of the sensor fewer than nine."""
        if not self._count:
            self._count.append(self._sum(np.ones(self.size, np.float32)))
        return self._count[0]

    def _sum(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        assert self.board is not None
        image = self.board.image(values, 1, 0.0)
        # sums over three columns, then over three rows of these: the order of terms is the same for every crop
        across = image[:, :-2] + image[:, 1:-1] + image[:, 2:]
        return self._at_listed(across[:-2] + across[1:-1] + across[2:])

    def most(self, values: NDArray, radius: int) -> NDArray:
        """Largest of `values` [m] at most `radius` pixels away from each listed pixel, also diagonally, [n]."""
        if self.apart or self.board is None:
            return values[self.listed]
        lowest = False if values.dtype == np.bool_ else -np.inf
        image = self.board.image(values, radius, lowest)
        # along rows, then along columns
        return self._at_listed(_most_along(_most_along(image.T, 2 * radius + 1).T, 2 * radius + 1))

    def near(self, marked: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
        """True at sites [m] at most `radius` pixels away from a marked one [m], also diagonally."""
        return marked if self.apart or self.board is None else self.board.near(marked, radius)

    def _at_listed(self, image: NDArray) -> NDArray:
        assert self.board is not None
        return image.ravel()[self.board.cell[self.listed] if self._cells is None else self._cells]


def _most_along(image: NDArray, length: int) -> NDArray:
    """Largest of each `length` successive rows [rows - length + 1, col]; in two steps for three rows, in three for five
    or seven, since the largest of a span follows from those of two shorter spans.
    """
    span = 1
    while span < length:
        # a span that begins where the other ends, or within it
        shift = min(span, length - span)
        image, span = np.maximum(image[: image.shape[0] - shift], image[shift:]), span + shift
    return image


def squares(row: NDArray[np.integer], col: NDArray[np.integer], most: int) -> list[NDArray[np.int64]]:
    """Parts of a list of pixels that are about square, so that few neighbours lie around them; places in the list.

    Parameters
    ----------
    row, col : [n], rows and columns of the pixels.
    most : largest number of pixels in a part.
    """
    if row.size <= most:
        # by row, then by column
        return [np.lexsort((col, row))] if row.size else []
    height, width = int(np.ptp(row)) + 1, int(np.ptp(col)) + 1
    # strips of columns, as wide as a square in which so many pixels lie
    side = np.sqrt(most * height * width / row.size)
    count = max(1, round(width / side))
    strip = (col.astype(np.int64) - int(col.min())) * count // width
    order = np.lexsort((col, row, strip))
    parts = []
    for own in np.split(order, np.flatnonzero(np.diff(strip[order])) + 1):
        # parts of a strip are equal in number
        parts += np.array_split(own, -(-own.size // most))
    return parts


def turns(row: NDArray[np.integer], window: NDArray[np.integer]) -> NDArray[np.int64]:
    """For each pair: the number of other windows of its row that come first, [n]."""
    # distinct pairs in order of row, then of window: the rank of each counts from the first of its row
    pairs, place = distinct_columns(np.stack([row.astype(np.int64), window.astype(np.int64)]))
    if pairs.shape[1] == 0:
        return np.empty(0, np.int64)
    starts = np.flatnonzero(np.diff(pairs[0], prepend=pairs[0][0] - 1))
    rank = np.arange(pairs.shape[1]) - np.repeat(starts, np.diff(starts, append=pairs.shape[1]))
    return rank[place]


class RowWindows:
    """Windows of the rows of listed pixels, of which each row has one. They hold for the whole list, so that no value
    depends on how the list is divided.

    Parameters
    ----------
    row : [n], row on the full sensor of each listed pixel.
    window : [n], window of each.
    """

    def __init__(self, row: NDArray[np.integer], window: NDArray[np.integer]) -> None:
        self._rows = np.flatnonzero(np.bincount(row))
        of_row = np.zeros(int(self._rows[-1]) + 1, np.int64)
        of_row[row] = window
        self._window = of_row[self._rows]

    def at(self, row: NDArray[np.integer]) -> NDArray[np.int64]:
        """Window of pixels in some rows [m]: that of listed pixels in the row, or in the nearest row that has any."""
        # the middle between two rows parts the pixels of one from those of the other
        return self._window[np.searchsorted((self._rows[1:] + self._rows[:-1]) / 2, row)]

"""A mosaic as planes, one for each position of a block of whole tiles. Each plane has one colour and one noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError

#: Number of block rows that are processed at once.
BAND_BLOCKS = 8
_LEAST_PX = 4


def block_of(tile: ArrayLike) -> NDArray[np.int64]:
    """The tile repeated until it measures at least 4×4. Blocks of that size are processed at once.

    Parameters
    ----------
    tile : [tile_row, tile_col], channel number of each position from 0 on, -1 where there is no value.

    Raises
    ------
    RangeError
        If the tile has no samples, or leaves out a channel number.
    """
    given = np.atleast_2d(np.asarray(tile, dtype=np.int64))
    if given.ndim != 2 or given.size == 0 or given.max() < 0:
        raise RangeError("tile", np.asarray(tile).tolist(), "rows of channel numbers with at least one >= 0")
    missing = sorted(set(range(int(given.max()))) - set(given.ravel().tolist()))
    if missing:
        raise RangeError("tile", given.tolist(), f"channel numbers without gaps ({missing[0]} does not occur)")
    return np.tile(given, [-(-_LEAST_PX // size) for size in given.shape])


def split(image: NDArray[np.float32], block: tuple[int, ...]) -> NDArray[np.float32]:
    """Planes [block position, block row, block col] with a border of one block on each side.

    The border repeats the outermost whole block, so that every colour stays in its place.
    """
    rows, cols = (_padded_index(size, period) for size, period in zip(image.shape, block, strict=True))
    padded_rows, padded_cols = rows.size // block[0], cols.size // block[1]
    planes = np.empty((*block, padded_rows, padded_cols), dtype=np.float32)

    def work(part: slice) -> None:
        band = image[rows[part.start * block[0] : part.stop * block[0]]][:, cols]
        planes[:, :, part] = band.reshape(-1, block[0], padded_cols, block[1]).transpose(1, 3, 0, 2)

    in_bands(padded_rows, work, BAND_BLOCKS)
    return planes.reshape(-1, padded_rows, padded_cols)


def _padded_index(size: int, period: int) -> NDArray[np.int64]:
    """Indices into a line of `size`, with one block before it and whole blocks up to one block after its end."""
    index = np.arange(-period, -(-size // period) * period + period)
    index[index < 0] += period
    over = index - size + 1
    index -= np.where(over > 0, -(-over // period) * period, 0)
    return np.where(index < 0, np.arange(index.size) % max(1, min(size, period)), index)


def join(planes: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Planes [row in block, col in block, block row, block col], without border, back into an image."""
    height, width, block_rows, block_cols = planes.shape
    cols = out.shape[1]

    def work(part: slice) -> None:
        image = planes[:, :, part].transpose(2, 0, 3, 1).reshape(-1, block_cols * width)
        rows = slice(part.start * height, min(part.stop * height, out.shape[0]))
        out[rows] = image[: rows.stop - rows.start, :cols]

    in_bands(block_rows, work, BAND_BLOCKS)


def bordered(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Planes [position, block row, block col] with their outermost blocks repeated once."""
    return np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")

"""Row offsets without a map, estimated from the frame itself by comparing each row with the rows around it.

Every sample is compared with the linear interpolation of the nearest samples of its colour above and below it in its
column. The mean of these differences over a row, robust against edges, measures the offset of the row relative to its
neighbours. Offsets with a known spread are then the most likely ones that explain all rows together (a banded linear
system with a Gaussian prior).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solveh_banded

from hesim_render.isp.frame_noise import FrameNoise

#: Scale of a Cauchy weight, in standard deviations of noise: larger differences count as edges.
_EDGE = 2.0
#: Length over which picture content is correlated, so that its differences do not average out, px.
_ALIKE_PX = 8.0
#: A row that differs by more than this many standard deviations of the prior shows picture, not an offset.
_FAR = 4.0
_ROUNDS = 3


@dataclass(frozen=True)
class _Comparison:
    """Comparison of rows with the rows `up` above and `down` below, in columns of one tile position."""

    rows: NDArray[np.int64]
    up: int
    down: int
    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


def row_offsets(
    signal_dn: NDArray[np.float32], tile: ArrayLike, noise: FrameNoise, row_std_dn: float
) -> NDArray[np.float32]:
    """Offset of each row, float32 [row], DN.

    Parameters
    ----------
    signal_dn : [row, col], DN above black.
    tile : channel of each position, -1 where there is no value.
    noise : temporal noise of the samples.
    row_std_dn : standard deviation of the offsets; 0 gives none.
    """
    channels = np.asarray(tile)
    height = signal_dn.shape[0]
    if row_std_dn <= 0 or height < 3:
        return np.zeros(height, dtype=np.float32)
    result = [
        comparison
        for row, col in np.argwhere(channels >= 0)
        for comparison in _compared(signal_dn, channels, (int(row), int(col)), noise, row_std_dn)
    ]
    return _likeliest(result, height, row_std_dn).astype(np.float32)


def _nearest(column: NDArray, row: int, step: int) -> int:
    """Distance in rows to the next sample of the same channel in a column of the tile; `step` is the direction."""
    distance = 1
    while column[(row + step * distance) % len(column)] != column[row]:
        distance += 1
    return distance


def _compared(
    signal_dn: NDArray[np.float32], tile: NDArray, place: tuple[int, int], noise: FrameNoise, row_std_dn: float
) -> list[_Comparison]:
    """Comparisons of rows from the samples at one position of the tile."""
    row, col = place
    up, down = (_nearest(tile[:, col], row, step) for step in (-1, 1))
    rows = np.arange(row, signal_dn.shape[0], tile.shape[0])
    rows = rows[(rows >= up) & (rows + down < signal_dn.shape[0])]
    values = signal_dn[:, col :: tile.shape[1]]
    if rows.size == 0 or values.shape[1] < 2:
        return []
    # a sample against those of its channel above and below, on a line between them
    share = down / (up + down)
    expected = share * values[rows - up] + (1 - share) * values[rows + down]
    difference = (values[rows] - expected).astype(np.float64)
    a, b, c = noise.variance(place)
    level = np.maximum(expected, 0)
    # noise of the difference of the three
    sigma = np.sqrt((a + level * (b + level * c)) * (1 + share**2 + (1 - share) ** 2))
    # mean over the row that edges do not move: weights of a Cauchy law, in rounds from the median
    centre = np.median(difference, axis=1)
    weight = np.ones_like(difference)
    for _ in range(_ROUNDS):
        weight = 1 / (sigma**2 * (1 + ((difference - centre[:, None]) / (_EDGE * sigma)) ** 2))
        centre = (weight * difference).sum(axis=1) / weight.sum(axis=1)
    # what the differences scatter beyond noise is picture, whose neighbours are alike: it averages out more slowly
    scatter = (weight * (difference - centre[:, None]) ** 2).sum(axis=1) / weight.sum(axis=1)
    even = (weight * sigma**2).sum(axis=1) / weight.sum(axis=1)
    count = weight.sum(axis=1) ** 2 / (weight**2).sum(axis=1)
    picture = np.maximum(scatter - even, 0) * max(_ALIKE_PX / tile.shape[1], 1)
    variance = (even + picture) / count
    spread = row_std_dn**2 * (1 + share**2 + (1 - share) ** 2)
    # a row this far off shows picture: it says nothing of the offset
    variance[centre**2 > _FAR**2 * (spread + variance)] = np.inf
    return [_Comparison(rows, up, down, centre, variance)]


def _likeliest(result: list[_Comparison], height: int, row_std_dn: float) -> NDArray[np.float64]:
    """Offsets that minimise Σ (difference - predicted difference)² / variance + Σ offset² / prior variance."""
    reach = max((item.up + item.down for item in result), default=0)
    # the normal equations couple rows at most `reach` apart: a band matrix, with the prior on its diagonal
    band = np.zeros((reach + 1, height))  # lower form of solveh_banded
    band[0] = 1 / row_std_dn**2
    right = np.zeros(height)
    for item in result:
        share = item.down / (item.up + item.down)
        weight = 1 / item.variance
        parts = ((-item.up, -share), (0, 1.0), (item.down, share - 1))
        for at, factor in parts:
            right[item.rows + at] += factor * weight * item.mean
            for other, second in parts:
                if other <= at:
                    band[at - other, item.rows + other] += factor * second * weight
    return solveh_banded(band, right, lower=True)

"""Interpolated values for pixels without one: event pixels, which form a regular pattern, and bad pixels, which do not.

A value is a weighted mean over pairs of same-colour neighbours on both sides, along a row, a column and the two
diagonals. A pair (a "bridge") has the larger weight the smaller its difference is, so that nothing is interpolated
across an edge.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.errors import RangeError

#: Difference within a bridge that counts as zero, units of white.
_EVEN = 0.01
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_Offset = tuple[int, int]


def fill_positions(raw: NDArray[np.float32], tile: ArrayLike, filled: ArrayLike) -> NDArray[np.float32]:
    """RAW data with values at the positions that `filled` has and `tile` lacks, float32 [row, col].

    Parameters
    ----------
    raw : [row, col], black at 0, white at 1.
    tile, filled : channel of each tile position before and after, -1 where there is none.
    """
    before, after = np.asarray(tile), np.asarray(filled)
    out = raw.copy()
    period = before.shape
    # the frame with a margin, in which the tile goes on, so that offsets reach beyond the edges
    margin = 2 * max(period)
    rows, cols = (_kept_in_phase(size, p, margin) for size, p in zip(raw.shape, period, strict=True))
    padded = raw[rows][:, cols]
    for row, col in np.argwhere((before < 0) & (after >= 0)):
        part = (slice(row, None, period[0]), slice(col, None, period[1]))
        size = out[part].shape

        def neighbour(
            offset: _Offset, row: int = row, col: int = col, size: tuple[int, ...] = size
        ) -> NDArray[np.float32]:
            top, left = margin + row + offset[0], margin + col + offset[1]
            return padded[top : top + size[0] * period[0] : period[0], left : left + size[1] * period[1] : period[1]][
                : size[0], : size[1]
            ]

        bridges = _bridges(before, after[row, col], row, col)
        if not bridges:
            raise RangeError("tile", before.tolist(), f"neighbours of channel {after[row, col]} around ({row}, {col})")
        value, weight = _mean_of_bridges(bridges, neighbour)
        out[part] = value / weight
    return out


def fill_pixels(raw: NDArray[np.float32], tile: ArrayLike, bad: NDArray[np.bool_]) -> NDArray[np.float32]:
    """RAW data with new values where `bad` [row, col] is set; positions without a channel stay unchanged.

    Raises
    ------
    RangeError
        If a bad pixel has no good pixel of its channel nearby, not even through pixels that were filled before.
    """
    channels = np.asarray(tile)
    if bad.shape != raw.shape:
        raise RangeError("shape of the bad-pixel mask", bad.shape, str(raw.shape))
    out = raw.copy()
    unknown = bad & (channels[np.ix_(*(np.arange(n) % p for n, p in zip(raw.shape, channels.shape, strict=True)))] >= 0)
    while unknown.any():
        # from the rim inwards: what was filled in one round is a neighbour in the next
        still = unknown.copy()
        for row, col in np.ndindex(*channels.shape):
            if channels[row, col] >= 0:
                _fill_phase(out, unknown, still, channels, row, col)
        if np.array_equal(still, unknown):
            raise RangeError("bad pixels", int(unknown.sum()), "at least one good neighbour pair of the same channel")
        unknown = still
    return out


def _fill_phase(
    image: NDArray[np.float32],
    unknown: NDArray[np.bool_],
    still: NDArray[np.bool_],
    channels: NDArray,
    row: int,
    col: int,
) -> None:
    """Fill the bad pixels of one tile position that have usable neighbours; `still` keeps the others marked."""
    period = channels.shape
    ys, xs = (index * p + o for index, p, o in zip(np.nonzero(unknown[row :: period[0], col :: period[1]]), period,
                                                   (row, col), strict=True))  # fmt: skip
    if ys.size == 0:
        return

    def place(offset: _Offset) -> tuple[NDArray, NDArray, NDArray]:
        y, x = ys + offset[0], xs + offset[1]
        inside = (y >= 0) & (y < image.shape[0]) & (x >= 0) & (x < image.shape[1])
        return np.where(inside, y, 0), np.where(inside, x, 0), inside

    def neighbour(offset: _Offset) -> NDArray[np.float32]:
        y, x, inside = place(offset)
        return np.where(inside & ~unknown[y, x], image[y, x], np.nan)

    value, weight = _mean_of_bridges(_bridges(channels, channels[row, col], row, col), neighbour)
    known = weight > 0
    image[ys[known], xs[known]] = value[known] / weight[known]
    still[ys[known], xs[known]] = False


def _bridges(tile: NDArray, channel: int, row: int, col: int) -> list[tuple[_Offset, _Offset]]:
    """Offsets of the nearest samples of a channel on both sides, for each direction that has them."""
    result = []
    for dy, dx in _DIRECTIONS:
        sides = []
        for sign in (1, -1):
            for step in range(1, 2 * max(tile.shape) + 1):
                y, x = sign * step * dy, sign * step * dx
                if tile[(row + y) % tile.shape[0], (col + x) % tile.shape[1]] == channel:
                    sides.append((y, x))
                    break
        if len(sides) == 2:
            result.append((sides[0], sides[1]))
    return result


def _mean_of_bridges(
    bridges: list[tuple[_Offset, _Offset]], neighbour: Callable[[_Offset], NDArray[np.float32]]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weighted sum of the bridges, and the sum of weights; a single end has little weight, a missing pair none."""
    total = weights = np.float32(0)
    for one, other in bridges:
        a, b = neighbour(one), neighbour(other)
        reach_a, reach_b = float(np.hypot(*one)), float(np.hypot(*other))
        span = np.float32(reach_a + reach_b)
        # on a line between both ends, at the place of the missing sample
        share = np.float32(reach_b) / span
        rise = np.abs(a - b)
        value = b + share * (a - b)
        # along an edge both ends are alike, across it they differ: the even direction counts most
        weight = 1 / ((rise + np.float32(_EVEN)) ** 2 * span)
        if np.isnan(value).any():
            # a single end is better than nothing, and far worse than two
            lone = np.where(np.isnan(a), b, a)
            value = np.where(np.isnan(value), lone, value)
            weight = np.where(np.isnan(weight), np.float32(1), weight)
            weight = np.where(np.isnan(value), np.float32(0), weight)
            value = np.nan_to_num(value)
        total, weights = total + weight * value, weights + weight
    return np.asarray(total, dtype=np.float32), np.asarray(weights, dtype=np.float32)


def _kept_in_phase(size: int, period: int, margin: int) -> NDArray[np.int64]:
    """Indices -margin … size + margin of a line; those outside are moved inside by whole periods."""
    index = np.arange(-margin, size + margin)
    low = index < 0
    index[low] %= period
    over = np.maximum(index - size + 1, 0)
    index -= -(-over // period) * period
    return np.clip(index, 0, size - 1)

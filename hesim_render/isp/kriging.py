"""Weights of linear demosaicing: the best unbiased prediction of a colour from the samples around it.

Universal co-kriging (Wackernagel, Multivariate Geostatistics, 3rd ed. 2003, ch. 23-24), which is the linear
minimum-mean-square demosaicing of Trussell and Hartley (IEEE TIP 11, 2002) with the constraint that planes
of any colour come out exactly. The prior says two things of pictures: nearby samples are alike,
cov = exp(-distance / length), and colours go together, cov(colour a, colour b) = cov · (1 + colour · [a = b]).
It needs no training data and knows any tile, with holes.

A stencil is an array of weights [output, input position in the block, block row - 1 … + 1, block col - 1 … + 1].
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Correlation length, px; pictures have no scale of their own, and between 10 and 100 px results hardly change.
LENGTH_PX = 24.0
#: Variance of the differences of colours over the variance of what they share, after white balance.
COLOUR = 0.06
#: Variance of noise over that of the picture; keeps the equations well posed, smooths next to nothing.
NOISE = 1e-3
#: Samples farther than this from the block take no part, px.
REACH_PX = 4
_ONE_THREAD = 1 << 18

Block = tuple[tuple[int, ...], ...]


def _solve(
    at: NDArray, channel: NDArray, to: NDArray, to_channel: NDArray, scale: NDArray, colour: float
) -> NDArray[np.float64]:
    """Kriging weights [sample, target] of samples at `at` [n, 2] for targets at `to` [m, 2]."""
    names = np.unique(channel)

    def covariance(a: NDArray, ca: NDArray, b: NDArray, cb: NDArray) -> NDArray:
        distance = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))
        return np.exp(-distance / LENGTH_PX) * (1 + colour * (ca[:, None] == cb[None]))

    def planes(points: NDArray, c: NDArray) -> NDArray:
        own = (c[:, None] == names).astype(np.float64)
        shift = (points - to.mean(axis=0)) / scale
        used = [np.ones(len(points)), *(shift[:, k] for k in range(2) if np.ptp(at[:, k]) > 0)]
        return np.concatenate([own * term[:, None] for term in used], axis=1)

    drift = planes(at, channel)
    n, p = drift.shape
    system = np.zeros((n + p, n + p))
    system[:n, :n] = covariance(at, channel, at, channel) + NOISE * np.eye(n)
    system[:n, n:], system[n:, :n] = drift, drift.T
    right = np.vstack([covariance(at, channel, to, to_channel), planes(to, to_channel).T])
    # least squares: on a sparse tile the samples in reach may not determine every plane
    return np.linalg.lstsq(system, right, rcond=1e-10)[0][:n]


def _window(block: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Samples within reach of a block: flat index into [position, 3, 3], place [n, 2] and channel."""
    rows, cols = block.shape
    y, x = np.mgrid[-rows : 2 * rows, -cols : 2 * cols]
    channel = np.tile(block, (3, 3))
    near = (y >= -REACH_PX) & (y < rows + REACH_PX) & (x >= -REACH_PX) & (x < cols + REACH_PX) & (channel >= 0)
    y, x, channel = y[near], x[near], channel[near]
    index = ((y % rows * cols + x % cols) * 3 + y // rows + 1) * 3 + x // cols + 1
    return index, np.stack([y, x], axis=1).astype(np.float64), channel


@functools.lru_cache(maxsize=64)
def stencil(tile: Block, channel: int, targets: tuple[tuple[int, int], ...]) -> NDArray[np.float32]:
    """Weights for one channel at positions of the block, from all samples around."""
    block = np.array(tile)
    index, at, seen = _window(block)
    to = np.array(targets, dtype=np.float64)
    weights = np.zeros((len(targets), block.size * 9))
    weights[:, index] = _solve(at, seen, to, np.full(len(targets), channel), np.array(block.shape), COLOUR).T
    return weights.reshape(len(targets), block.size, 3, 3).astype(np.float32)


@functools.lru_cache(maxsize=64)
def line_stencil(tile: Block, channel: int, targets: tuple[tuple[int, int], ...], along: int) -> NDArray[np.float32]:
    """Weights from the samples of the target's own column (`along` 0) or row (1) alone.

    A line on which the channel does not occur gets the weights of `stencil`.
    """
    block = np.array(tile)
    index, at, seen = _window(block)
    weights = stencil(tile, channel, targets).reshape(len(targets), -1).astype(np.float64)
    for k, target in enumerate(targets):
        line = at[:, 1 - along] == target[1 - along]
        if not (seen[line] == channel).any():
            continue
        to = np.array([target], dtype=np.float64)
        weights[k] = 0
        weights[k, index[line]] = _solve(
            at[line], seen[line], to, np.array([channel]), np.array(block.shape), COLOUR
        )[:, 0]  # fmt: skip
    return weights.reshape(len(targets), block.size, 3, 3).astype(np.float32)


@functools.lru_cache(maxsize=64)
def lone_stencil(
    shape: tuple[int, int], samples: tuple[tuple[int, int], ...], targets: tuple[tuple[int, int], ...]
) -> NDArray[np.float32]:
    """Weights from samples of one kind at these positions of each block; inputs are numbered as in `samples`."""
    block = np.full(shape, -1)
    block[tuple(np.array(samples).T)] = 0
    index, at, seen = _window(block)
    to = np.array(targets, dtype=np.float64)
    dense = np.zeros((len(targets), block.size * 9))
    dense[:, index] = _solve(at, seen, to, np.zeros(len(targets), dtype=int), np.array(shape), 0.0).T
    kept = [row * shape[1] + col for row, col in samples]
    return dense.reshape(len(targets), block.size, 3, 3)[:, kept].astype(np.float32)


@functools.lru_cache(maxsize=64)
def bilinear_stencil(shape: tuple[int, int], centre: tuple[float, float]) -> NDArray[np.float32]:
    """Weights that spread one value per block, standing at `centre` of it, to all its pixels."""

    def line(size: int, middle: float) -> NDArray:
        place = (np.arange(size) - middle) / size
        return np.stack([np.clip(-place, 0, 1), 1 - np.abs(place), np.clip(place, 0, 1)], axis=1)

    rows, cols = line(shape[0], centre[0]), line(shape[1], centre[1])
    return np.einsum("ia,jb->ijab", rows, cols).reshape(-1, 1, 3, 3).astype(np.float32)


def apply(planes: NDArray[np.float32], weights: NDArray[np.float32], rows: slice) -> NDArray[np.float32]:
    """A stencil at block rows `rows` of planes [position, block row, block col] with one block of border.

    Returns
    -------
    float32 [output, row, col] : `rows` counts without the border.
    """
    count, cols = rows.stop - rows.start, planes.shape[2] - 2
    used: Sequence[tuple[int, int, int]] = [tuple(k) for k in np.argwhere(np.abs(weights).max(axis=0) > 0)]
    matrix = np.ascontiguousarray([weights[:, p, dy, dx] for p, dy, dx in used]).T
    size = count * cols
    # OpenBLAS multiplies matrices of up to this many products on the calling thread; the bands are threads already,
    # and threads of its own would only wait for each other
    width = max(16, _ONE_THREAD // matrix.size // 16 * 16)
    pieces = -(-size // width)
    around = np.empty((len(used), pieces * width), dtype=np.float32)
    for k, (position, dy, dx) in enumerate(used):
        part = around[k, :size].reshape(count, cols)
        part[:] = planes[position, rows.start + dy : rows.start + dy + count, dx : dx + cols]
    around[:, size:] = 0
    out = np.empty((len(weights), pieces * width), dtype=np.float32)
    np.matmul(
        matrix,
        around.reshape(len(used), pieces, width).transpose(1, 0, 2),
        out=out.reshape(len(weights), pieces, width).transpose(1, 0, 2),
    )
    return out[:, :size].reshape(-1, count, cols)

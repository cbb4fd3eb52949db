"""Demosaicing of any tile: Bayer, Quad-Bayer, RGBW, with or without holes.

The guide is the channel with most samples (green or white). It is predicted from the samples around a pixel, with the
local priors of `guide`. Every other channel is a local linear function of the guide plus a residual, which is
interpolated from the channel's own samples (residual interpolation, [kiku2013]). Ridge regression towards 1 gives the
slope. All steps work on the square root of the signal, where the noise is uniform and edges overshoot less; it is odd
about black, so that a dark frame keeps its mean.
"""

import functools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError
from hesim_render.isp import kriging
from hesim_render.isp.guide import predict_guide
from hesim_render.isp.stabilise import BAND_BLOCKS, block_of, bordered, join, split
from hesim_render.spectral.transfer import from_root, to_root

#: Ridge of the regression on the guide, square-root units squared.
_RIDGE = 1e-3


def demosaic(raw: NDArray[np.float32], tile: ArrayLike, method: str = "guided") -> NDArray[np.float32]:
    """Every channel at every pixel.

    Parameters
    ----------
    raw : [row, col], linear, white-balanced, black at 0 and white near 1.
    tile : [tile_row, tile_col], channel number of each position from 0 on, -1 where there is no value.
    method : ``guided`` (edge-directed) or ``linear`` (prediction from the neighbourhood alone, in linear light).

    Returns
    -------
    float32 [row, col, channel] : a view of planes [channel, row, col].

    Raises
    ------
    RangeError
        If the tile has no samples, the frame is smaller than a tile, or `method` is unknown.
    """
    block, shape = block_of(tile), np.shape(raw)
    if method not in ("guided", "linear"):
        raise RangeError("demosaic method", method, "guided or linear")
    if len(shape) != 2 or shape[0] < np.shape(tile)[0] or shape[1] < np.shape(tile)[1]:
        raise RangeError("shape of the RAW frame", shape, f"[row, col], at least one tile {np.shape(tile)}")
    channels = int(block.max()) + 1
    if channels == 1 and (block >= 0).all():
        return np.asarray(raw, dtype=np.float32)[..., None]
    # in square roots shot noise is alike at all levels
    encoded = np.asarray(raw, dtype=np.float32) if method == "linear" else _encoded(raw)
    planes = split(encoded, block.shape)
    if method == "linear" or channels == 1:
        estimates = [_linear(planes, block, channel) for channel in range(channels)]
    else:
        # the channel with most samples guides the others: it is known at most places
        most = int(np.argmax(np.bincount(block[block >= 0])))
        green = predict_guide(planes, block, most)
        estimates = [
            green if channel == most else _guided(planes, green, block, channel) for channel in range(channels)
        ]
    out = np.empty((channels, *shape), dtype=np.float32)
    for channel, estimate in enumerate(estimates):
        join(estimate, out[channel])
    if method != "linear":

        def decode(rows: slice) -> None:
            out[:, rows] = from_root(out[:, rows])

        in_bands(shape[0], decode)
    return np.moveaxis(out, 0, -1)


def remosaic(raw: NDArray[np.float32], tile: ArrayLike, target: ArrayLike = ((0, 1), (1, 2))) -> NDArray[np.float32]:
    """The mosaic that a sensor with another tile of the same channels would give, at full size.

    Measured values stay where both tiles have the same channel.

    Parameters
    ----------
    raw, tile : as for `demosaic`.
    target : [tile_row, tile_col], channel numbers of the wanted tile, by default RGGB.

    Returns
    -------
    float32 [row, col], in the unit of `raw`.

    Raises
    ------
    RangeError
        As for `demosaic`, or if `target` has a channel number that `tile` lacks.
    """
    wanted = np.asarray(target)
    colours = demosaic(raw, tile)
    if wanted.min() < 0 or wanted.max() >= colours.shape[-1]:
        raise RangeError("target tile", wanted.tolist(), f"channel numbers 0 to {colours.shape[-1] - 1}")
    out = np.empty(raw.shape, dtype=np.float32)
    for row, col in np.ndindex(*wanted.shape):
        part = (slice(row, None, wanted.shape[0]), slice(col, None, wanted.shape[1]))
        out[part] = colours[(*part, wanted[row, col])]
    return out


def _encoded(raw: NDArray) -> NDArray[np.float32]:
    out = np.empty(raw.shape, dtype=np.float32)

    def work(rows: slice) -> None:
        out[rows] = to_root(np.asarray(raw[rows], dtype=np.float32))

    in_bands(raw.shape[0], work)
    return out


def _targets(block: NDArray, channel: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Positions of a block where a channel is known, and where it is not."""
    known = [(int(i), int(j)) for i, j in np.argwhere(block == channel)]
    return known, [(int(i), int(j)) for i, j in np.argwhere(block != channel)]


def _linear(planes: NDArray[np.float32], block: NDArray, channel: int) -> NDArray[np.float32]:
    known, wanted = _targets(block, channel)
    out = np.empty((*block.shape, planes.shape[1] - 2, planes.shape[2] - 2), dtype=np.float32)
    for row, col in known:
        out[row, col] = planes[row * block.shape[1] + col, 1:-1, 1:-1]
    # each missing place of a block is a fixed sum of the values around, one stencil for all blocks
    weights = kriging.stencil(tuple(map(tuple, block.tolist())), channel, tuple(wanted))
    rows_of, cols_of = np.array(wanted).T

    def work(rows: slice) -> None:
        out[rows_of, cols_of, rows] = kriging.apply(planes, weights, rows)

    in_bands(out.shape[2], work, BAND_BLOCKS)
    return out


def _guided(
    planes: NDArray[np.float32], guide: NDArray[np.float32], block: NDArray, channel: int
) -> NDArray[np.float32]:
    """A channel as a local linear function of the guide, plus the interpolated residual of its own samples."""
    known, wanted = _targets(block, channel)
    bh, bw = block.shape
    # a channel follows the guide within a few blocks: slope and offset of every block, spread evenly between blocks
    samples = [planes[row * bw + col, 1:-1, 1:-1] for row, col in known]
    slope, offset = (bordered(plane[None]) for plane in _regression([guide[place] for place in known], samples))
    spread = kriging.bilinear_stencil((bh, bw), tuple(float(k) for k in np.mean(known, axis=0)))
    out = np.empty_like(guide)
    residual = np.empty((len(known), *guide.shape[2:]), dtype=np.float32)

    def predict(rows: slice) -> None:
        out[:, :, rows] = kriging.apply(slope, spread, rows).reshape(bh, bw, -1, guide.shape[3])
        out[:, :, rows] *= guide[:, :, rows]
        out[:, :, rows] += kriging.apply(offset, spread, rows).reshape(bh, bw, -1, guide.shape[3])
        for k, position in enumerate(known):
            np.subtract(samples[k][rows], out[(*position, rows)], out=residual[k, rows])

    in_bands(guide.shape[2], predict, BAND_BLOCKS)
    # what the line leaves at the own samples is interpolated, so that these are met exactly
    around = bordered(residual)
    weights = kriging.lone_stencil((bh, bw), tuple(known), tuple(wanted))

    def correct(rows: slice) -> None:
        for (row, col), beyond in zip(wanted, kriging.apply(around, weights, rows), strict=True):
            out[row, col, rows] += beyond
        for k, position in enumerate(known):
            out[(*position, rows)] = samples[k][rows]

    in_bands(guide.shape[2], correct, BAND_BLOCKS)
    return out


def _regression(guide: Sequence[NDArray[np.float32]], own: Sequence[NDArray[np.float32]]) -> tuple[NDArray, NDArray]:
    """Slope and offset of a channel over the guide in each block and its neighbours (weights 1 2 1), [row, col]."""

    def around(values: Iterable[NDArray]) -> NDArray:
        wide = np.pad(functools.reduce(np.add, values), 1, mode="edge")
        lines = wide[:-2] + 2 * wide[1:-1] + wide[2:]
        return (lines[:, :-2] + 2 * lines[:, 1:-1] + lines[:, 2:]) * np.float32(1 / (16 * len(own)))

    mean_guide, mean_own = around(guide), around(own)
    covariance = around(g * o for g, o in zip(guide, own, strict=True)) - mean_guide * mean_own
    variance = around(g * g for g in guide) - mean_guide * mean_guide
    ridge = np.float32(_RIDGE)
    # the ridge draws the slope to 1 where the guide is flat: there it tells nothing
    slope = (covariance + ridge) / (np.maximum(variance, 0) + ridge)
    return slope, mean_own - slope * mean_guide

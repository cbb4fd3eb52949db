"""Bilinear demosaicing of any tile, a baseline: each channel is a mean of its samples around, weighted by a tent."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d


def bilinear(raw: NDArray, tile: ArrayLike) -> NDArray[np.float64]:
    """Every channel at every pixel.

    The tent falls to zero one tile away, so that every pixel has samples of every channel. On a Bayer tile this is the
    usual bilinear interpolation. Measured values stay as they are.

    Parameters
    ----------
    raw : [row, col], DN.
    tile : [tile_row, tile_col], channel number of each position from 0 on, -1 where there is no value.

    Returns
    -------
    float64 [row, col, channel], DN.
    """
    block = np.asarray(tile)
    rows, cols = np.ogrid[: raw.shape[0], : raw.shape[1]]
    channel = block[rows % block.shape[0], cols % block.shape[1]]
    out = np.empty((*raw.shape, int(block.max()) + 1))
    for number in range(out.shape[-1]):
        own = channel == number
        total, weight = (_tent(values.astype(np.float64), block.shape) for values in (np.where(own, raw, 0), own))
        out[..., number] = np.where(own, raw, total / np.maximum(weight, 1e-12))
    return out


def _tent(values: NDArray[np.float64], period: tuple[int, ...]) -> NDArray[np.float64]:
    for axis, width in enumerate(period):
        weights = 1 - np.abs(np.arange(1 - width, width)) / width
        values = correlate1d(values, weights, axis=axis, mode="constant")
    return values

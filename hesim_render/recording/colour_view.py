"""A simple colour view of one RAW frame, for display.

It averages each channel over its neighbourhood, balances white, and applies one matrix and the sRGB curve. It is not
a demosaicing to measure with.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.description import Mosaic
from hesim_render.spectral.colorimetry import encode_srgb

Picture = NDArray[np.uint8]  # [row, col, 3], sRGB


def colour_picture(raw: NDArray[np.uint16], mosaic: Mosaic, max_width: int = 1024) -> Picture:
    """A colour view of the valid pixels of one frame, at full size or binned by whole tiles.

    Parameters
    ----------
    raw : [row, col], DN.
    mosaic : description of the tile and its colours.
    max_width : wider frames are binned until they fit, px.

    Returns
    -------
    uint8 [row, col, 3], sRGB.
    """
    tile_cols = mosaic.tile_shape[1]
    if raw.shape[1] <= max_width:
        channels = _smoothed(raw, mosaic)
    else:
        channels = _binned(raw, mosaic, -(-raw.shape[1] // (tile_cols * max_width)))
    return encode_srgb(_developed(channels, mosaic))


def thumbnail(raw: NDArray[np.uint16], mosaic: Mosaic, max_width: int = 256) -> Picture:
    """A small colour view, binned by whole tiles."""
    tiles = max(1, -(-raw.shape[1] // (mosaic.tile_shape[1] * max_width)))
    return encode_srgb(_developed(_binned(raw, mosaic, tiles), mosaic))


def linear_view(raw: NDArray[np.uint16], mosaic: Mosaic) -> NDArray[np.float32]:
    """Linear sRGB [row, col, 3] with a pixel for each tile, exposed as `colour_picture`: white is about 1."""
    return _developed(_binned(raw, mosaic, 1), mosaic)


def _binned(raw: NDArray[np.uint16], mosaic: Mosaic, tiles: int) -> NDArray[np.float32]:
    """Mean DN above black of each channel over blocks of tiles, [row, col, channel]."""
    tile = mosaic.tile_channel
    block_rows, block_cols = tile.shape[0] * tiles, tile.shape[1] * tiles
    rows, cols = raw.shape[0] // block_rows, raw.shape[1] // block_cols
    if rows == 0 or cols == 0:
        return _smoothed(raw, mosaic)
    blocks = raw[: rows * block_rows, : cols * block_cols].reshape(rows, block_rows, cols, block_cols)
    pixels = blocks.transpose(0, 2, 1, 3).reshape(rows, cols, block_rows * block_cols)
    channel = np.tile(tile, (tiles, tiles)).ravel()
    means = [pixels[..., channel == number].mean(axis=-1, dtype=np.float32) for number in range(len(mosaic.channels))]
    return np.stack(means, axis=-1) - np.float32(mosaic.black_level_dn)


def _smoothed(raw: NDArray[np.uint16], mosaic: Mosaic) -> NDArray[np.float32]:
    """DN above black of each channel at every pixel: Gaussian-weighted mean of its valid neighbours."""
    from scipy.ndimage import gaussian_filter

    channel = mosaic.tiled(mosaic.tile_channel, raw.shape)
    signal = raw.astype(np.float32) - np.float32(mosaic.black_level_dn)
    sigma = 0.35 * max(mosaic.tile_shape)
    if sigma < 0.5:
        return signal[..., None]
    planes = []
    for number in range(len(mosaic.channels)):
        mask = (channel == number).astype(np.float32)
        weight = gaussian_filter(mask, sigma, mode="nearest", truncate=3.5)
        planes.append(gaussian_filter(signal * mask, sigma, mode="nearest", truncate=3.5) / weight)
    return np.stack(planes, axis=-1)


def _developed(channels: NDArray[np.float32], mosaic: Mosaic) -> NDArray[np.float32]:
    """Linear sRGB, exposed so that the brightest half percent reaches white; dark frames stay dark."""
    span = float(mosaic.white_level_dn - mosaic.black_level_dn)
    # saturated channels are clipped to one level, otherwise highlights would turn magenta
    balanced = np.minimum(channels / np.array(mosaic.neutral, dtype=np.float32), span)
    linear = balanced @ np.array(mosaic.camera_to_srgb, dtype=np.float32).T
    white = max(float(np.percentile(linear.max(axis=-1)[::2, ::2], 99.5)), 0.02 * span)
    return linear * (0.95 / white)

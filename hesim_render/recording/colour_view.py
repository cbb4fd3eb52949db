"""Colours of previews: raw frames and events as pictures."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.description import Mosaic
from hesim_render.recording.recorded import Recorded
from hesim_render.spectral.colorimetry import encode_srgb

Picture = NDArray[np.uint8]  # [row, col, 3], sRGB


def colour_picture(raw: NDArray[np.uint16], mosaic: Mosaic, max_width: int = 1024) -> Picture:
    """A colour view of the valid pixels of one frame, at full size or binned by whole tiles.

    Parameters
    ----------
    raw : [row, col], DN.
    mosaic : description of the tile and its colours.
    max_width : wider frames are binned until they fit, px.
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


ON_COLOUR = np.array([255, 150, 20], dtype=np.float32)
OFF_COLOUR = np.array([30, 160, 255], dtype=np.float32)


def events_picture(background: Picture, events: NDArray, event_shape: tuple[int, int]) -> Picture:
    """Events over a dimmed grey frame: ON orange, OFF blue, stronger for more events.

    Parameters
    ----------
    background : the frame, any size.
    events : structured array of the window to show.
    event_shape : rows and columns of the event grid.
    """
    size = background.shape[:2]
    grey = background.astype(np.float32) @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
    canvas = np.repeat((18 + 0.3 * grey)[..., None], 3, axis=2)
    rows, cols = event_shape
    if rows == 0 or cols == 0:
        return canvas.astype(np.uint8)
    # an event grid finer than the picture is summed over the picture's pixels, so that no event is lost
    height, width = min(rows, size[0]), min(cols, size[1])
    cell = events["y"].astype(np.int64) * height // rows * width + events["x"].astype(np.int64) * width // cols
    on = np.bincount(cell[events["polarity"] > 0], minlength=height * width).reshape(height, width)
    off = np.bincount(cell[events["polarity"] < 0], minlength=height * width).reshape(height, width)
    total = on + off
    share = (on / np.maximum(total, 1)).astype(np.float32)[..., None]
    colour = share * ON_COLOUR + (1 - share) * OFF_COLOUR
    opacity = (1 - np.exp(-2.0 * total)).astype(np.float32)[..., None]
    y, x = np.arange(size[0]) * height // size[0], np.arange(size[1]) * width // size[1]
    opacity, colour = opacity[y][:, x], colour[y][:, x]
    return (canvas * (1 - opacity) + colour * opacity).astype(np.uint8)


def black_picture(recording: Recorded, widest_px: int = 1024) -> Picture:
    """A black picture of the shape of a recording, at most about so wide: a background where there are no frames."""
    roi = recording.manifest["roi"]
    shrink = max(1, -(-roi["width_px"] // widest_px))
    return np.zeros((max(2, roi["height_px"] // shrink), max(2, roi["width_px"] // shrink), 3), dtype=np.uint8)

"""A frame as a DNG file that every RAW developer opens: a 2×2 Bayer mosaic, or linear sRGB.

Developers know 2×2 patterns of three colours. A quad mosaic is binned into one, as quad sensors do. Any other tile, of
four colours say, becomes linear sRGB with a pixel for each tile.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.description import Mosaic
from hesim_render.recording.colour_view import linear_view, thumbnail
from hesim_render.recording.dng import write_dng, write_linear_dng
from hesim_render.recording.frame import Frame

#: Colour codes red, green and blue.
_THREE = 3


def write_preview_dng(path: Path, frame: Frame, mosaic: Mosaic) -> None:
    """Write the file of a frame whose own DNG developers do not open (`needs_preview`).

    Parameters
    ----------
    path, frame, mosaic : file, frame, and its tile.
    """
    smaller = binned(frame.raw, mosaic)
    if smaller is not None and smaller[1].tile_code.max() < _THREE:
        raw, own = smaller
        small = thumbnail(raw, own)
        write_dng(path, raw, own, exposure_us=frame.exposure_us, description=frame.times, thumbnail=small)
    else:
        linear = linear_view(frame.raw, mosaic)
        write_linear_dng(path, linear, mosaic, exposure_us=frame.exposure_us, description=frame.times)


def needs_preview(mosaic: Mosaic) -> bool:
    """True for tiles other than one filter, or 2×2 of red, green and blue."""
    return not mosaic.is_mono and (mosaic.tile_shape != (2, 2) or int(mosaic.tile_code.max()) >= _THREE)


def binned(raw: NDArray[np.uint16], mosaic: Mosaic) -> tuple[NDArray[np.uint16], Mosaic] | None:
    """A quad mosaic as a 2×2 mosaic at half size: each colour cell becomes the mean of its frame pixels.

    Quad sensors bin in the same way. Event pixels do not take part. The result is None if the
    tile is not made of 2×2 cells of one filter.
    """
    channel = mosaic.tile_channel
    rows, cols = channel.shape
    if rows % 2 or cols % 2 or (rows, cols) == (2, 2):
        return None
    cells = channel.reshape(rows // 2, 2, cols // 2, 2).transpose(0, 2, 1, 3).reshape(rows // 2, cols // 2, 4)
    first = cells.max(axis=2)
    if (first < 0).any() or not ((cells == first[..., None]) | (cells < 0)).all():
        return None
    blocks = (raw.shape[0] // 2, 2, raw.shape[1] // 2, 2)
    valid = mosaic.tiled(channel >= 0, raw.shape).reshape(blocks)
    mean = np.where(valid, raw.reshape(blocks), 0).sum(axis=(1, 3), dtype=np.uint32) / valid.sum(axis=(1, 3))
    tile_filter = [[mosaic.channels[number] for number in row] for row in first]
    flags = [[True] * len(row) for row in tile_filter]
    noise, shares = mosaic.noise_profile, float(np.mean(1 / (cells >= 0).sum(axis=2)))
    smaller = mosaic.model_copy(
        update={
            "pitch_um": None if mosaic.pitch_um is None else 2 * mosaic.pitch_um,
            "noise_profile": None if noise is None else (noise[0] * shares, noise[1] * shares),
            "tile_filter": tile_filter,
            "tile_aps": flags,
            "tile_evs": [[False] * len(row) for row in tile_filter],
            "cfa_code": {name: mosaic.cfa_code[name] for name in mosaic.channels},
        }
    )
    return np.rint(mean).astype(np.uint16), smaller

"""RAW frames of one file each: PNG, TIFF, DNG, NPY and npz, without a sensor file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.recording.dng import read_dng

RAW_SUFFIXES = (".dng", ".tif", ".tiff", ".png", ".npy", ".npz")


def read_raw(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """The DN of a frame, [row, col].

    Parameters
    ----------
    file : DNG or TIFF (the first image, uncompressed uint16), grey PNG of 8 or 16 bits, NPY, or npz of H-ESIM (``raw``)
        or RGB-Event-ISP (``aps_raw``).
    shape : rows and columns that it must have.

    Raises
    ------
    SpecError
        If the file is of no such kind, is damaged, or is of another size.
    """
    suffix = file.suffix.lower()
    if suffix in (".dng", ".tif", ".tiff"):
        return read_dng(file, shape)
    if suffix == ".png":
        return _png(file, shape)
    if suffix == ".npy":
        return read_array(file, shape, "u")
    if suffix == ".npz":
        return _array_of(file, shape)
    raise SpecError("is no frame; expected .dng, .tif, .tiff, .png, .npy, .npz or a RAW file of a camera", file=file)


def _array_of(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """A frame of H-ESIM (``raw``) or RGB-Event-ISP (``aps_raw``)."""
    with reading(file, "as arrays"), np.load(file) as arrays:
        names = [name for name in ("aps_raw", "raw") if name in arrays.files]
    if not names:
        raise SpecError("holds no array 'raw' or 'aps_raw'", file=file)
    return read_arrays(file, names, only=names[:1], shapes={names[0]: shape}, kinds="u")[names[0]].astype(np.uint16)


def _png(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    from PIL import Image

    with reading(file, "as a PNG file"), Image.open(file, formats=["PNG"]) as image:
        if image.size != shape[::-1] or image.mode not in ("L", "I;16"):
            problem = f"is a {image.mode} picture of {image.size[0]}x{image.size[1]} px"
            raise SpecError(f"{problem}; expected a grey one of {shape[1]}x{shape[0]} px", file=file)
        require_memory(2 * shape[0] * shape[1], "the picture", file)
        return np.asarray(image).astype(np.uint16)

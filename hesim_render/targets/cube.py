"""Readers of pictures and of hyperspectral cubes, one for each kind of file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import reading, require_memory

#: Name of a channel of a spectral EXR file: reflectance or emission at a wavelength [fichet2021].
_CHANNEL = re.compile(r"(?:T|S0)\.(\d+(?:,\d+)?)nm")


@dataclass(frozen=True, eq=False)
class Cube:
    """A picture, or a picture for each wavelength.

    Parameters
    ----------
    values : float32 [row, col, channel], row 0 at the top.
    wavelength_nm : [channel], increasing; None for three channels of linear sRGB.
    """

    values: NDArray[np.float32]
    wavelength_nm: NDArray[np.float64] | None


def read_cube(file: Path, wavelength_nm: Sequence[float] | None = None) -> Cube:
    """A picture or a cube from a file; the end of its name tells the kind.

    Parameters
    ----------
    file : PNG, JPEG or TIFF with sRGB codes of 8 bits; EXR with linear R, G, B or with spectral channels; NPY.
    wavelength_nm : of the planes of an NPY cube, which has no place for them.

    Raises
    ------
    SpecError
        If the file cannot be read, or wavelengths are missing, or given for a file that has its own.
    """
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        raise SpecError(f"a picture must be one of {', '.join(READERS)}, not {file.suffix!r}", file=file)
    if (wavelength_nm is not None) != (reader is _npy):
        what = "needs wavelength_nm beside it" if reader is _npy else "takes no wavelength_nm"
        raise SpecError(f"a {file.suffix} file {what}", file=file, key="target.wavelength_nm")
    with reading(file, "as a picture"):
        cube = reader(file)
    if wavelength_nm is not None:
        cube = Cube(cube.values, np.asarray(wavelength_nm, dtype=np.float64))
        if cube.values.shape[2] != len(wavelength_nm):
            raise SpecError(
                f"the cube has {cube.values.shape[2]} planes and wavelength_nm {len(wavelength_nm)} values", file=file
            )
    if cube.wavelength_nm is not None and not np.all(np.diff(cube.wavelength_nm) > 0):
        raise SpecError("the wavelengths of a cube must increase", file=file, key="target.wavelength_nm")
    if not np.isfinite(cube.values).all():
        raise SpecError("holds values that are not finite", file=file)
    return cube


def _npy(file: Path) -> Cube:
    mapped = np.load(file, mmap_mode="r", allow_pickle=False)
    if mapped.ndim != 3 or mapped.dtype.kind not in "fui" or mapped.shape[2] < 2 or 0 in mapped.shape:
        raise SpecError(f"expected numbers [row, col, wavelength], found {mapped.dtype} {mapped.shape}", file=file)
    require_memory(4 * mapped.size, "the cube", file)
    return Cube(np.array(mapped, dtype=np.float32), None)


def _codes(file: Path) -> Cube:
    """8-bit sRGB codes as linear values (IEC 61966-2-1)."""
    from PIL import Image

    from hesim_render.spectral.transfer import decode

    with Image.open(file) as image:
        if image.mode not in ("RGB", "RGBA", "L", "LA", "P", "1"):
            raise SpecError(f"expected 8-bit colours, found mode {image.mode}; use EXR for more bits", file=file)
        require_memory(12 * image.width * image.height, "the picture", file)
        codes = np.asarray(image.convert("RGB"))
    table = decode(np.arange(256) / 255.0, "srgb").astype(np.float32)
    return Cube(table[codes], None)


def _exr(file: Path) -> Cube:
    import OpenEXR

    with OpenEXR.File(str(file), separate_channels=True) as opened:
        channels = opened.channels()
        spectral = sorted(
            (float(match[1].replace(",", ".")), name) for name in channels if (match := _CHANNEL.fullmatch(name))
        )
        if len(spectral) >= 2:
            planes = [channels[name].pixels for _, name in spectral]
            return Cube(np.stack(planes, axis=-1).astype(np.float32), np.array([value for value, _ in spectral]))
        if all(name in channels for name in "RGB"):
            return Cube(np.stack([channels[name].pixels for name in "RGB"], axis=-1).astype(np.float32), None)
        found = ", ".join(sorted(channels)[:8])
    raise SpecError(f"expected channels R, G, B or T.550,0nm …; found {found}", file=file)


#: Reader for each end of a file name.
READERS: dict[str, Callable[[Path], Cube]] = {
    ".png": _codes,
    ".jpg": _codes,
    ".jpeg": _codes,
    ".tif": _codes,
    ".tiff": _codes,
    ".exr": _exr,
    ".npy": _npy,
}

"""Readers of pictures and of hyperspectral cubes, one for each kind of file, and pictures as targets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.exr import exr_header, require_exr_fits
from hesim_render.core.guard import reading, require_memory
from hesim_render.specs.charts import ImageTarget
from hesim_render.specs.reflectance import PictureFile
from hesim_render.targets.cube_file import EXR_CHANNELS, open_cube
from hesim_render.targets.cube_file import READERS as CUBE_READERS
from hesim_render.targets.piece import Picture, TargetPiece, picture_piece

#: Ends of the names of files with hyperspectral cubes.
_CUBES = tuple(CUBE_READERS)
#: Wavelengths up to which the first and the last plane of a cube are held, nm; all responses lie between them.
_HELD_NM = (300.0, 1100.0)
#: Values above 1 by rounding.
_ROUNDING = 1e-6


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
    if file.suffix.lower() == ".npy" and wavelength_nm is None:
        raise SpecError("a .npy file needs wavelength_nm beside it", file=file, key="target.wavelength_nm")
    if file.suffix.lower() in _CUBES and not _is_rgb(file):
        opened = open_cube(file, wavelength_nm)
        if opened.is_absolute:
            raise SpecError("holds radiance, as it says, and a surface needs reflectances", file=file)
        return Cube(opened.whole(), opened.wavelength_nm)
    if wavelength_nm is not None:
        raise SpecError(f"a {file.suffix} file takes no wavelength_nm", file=file, key="target.wavelength_nm")
    reader = READERS.get(file.suffix.lower())
    if reader is None:
        known = ", ".join(dict.fromkeys([*READERS, *_CUBES]))
        raise SpecError(f"a picture must be one of {known}, not {file.suffix!r}", file=file)
    with reading(file, "as a picture"):
        cube = reader(file)
    if not np.isfinite(cube.values).all():
        raise SpecError("holds values that are not finite", file=file)
    return cube


def _codes(file: Path) -> Cube:
    """8-bit sRGB codes as linear values (IEC 61966-2-1), upright as their EXIF orientation says."""
    from PIL import Image, ImageOps

    from hesim_render.spectral.transfer import decode

    with Image.open(file) as image:
        if image.mode not in ("RGB", "RGBA", "L", "LA", "P", "1"):
            raise SpecError(f"expected 8-bit colours, found mode {image.mode}; use EXR for more bits", file=file)
        require_memory(12 * image.width * image.height, "the picture", file)
        if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            raise SpecError("has transparent parts, and a picture needs a colour everywhere", file=file)
        codes = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    table = decode(np.arange(256) / 255.0, "srgb").astype(np.float32)
    return Cube(table[codes], None)


def _is_rgb(file: Path) -> bool:
    """True for an EXR file with channels R, G, B and no spectral ones."""
    if file.suffix.lower() != ".exr" or not file.is_file():
        return False
    names = {channel.name for channel in exr_header(file)[1]["channels"]}
    # spectral files often hold a small picture in R, G, B besides
    return {"R", "G", "B"} <= names and not any(pattern.fullmatch(name) for pattern in EXR_CHANNELS for name in names)


def _exr(file: Path) -> Cube:
    import OpenEXR

    require_exr_fits(file)
    with OpenEXR.File(str(file), separate_channels=True) as opened:
        channels = opened.channels()
        return Cube(np.stack([channels[name].pixels for name in "RGB"], axis=-1).astype(np.float32), None)


#: Reader for each end of a file name.
READERS: dict[str, Callable[[Path], Cube]] = {
    ".png": _codes,
    ".jpg": _codes,
    ".jpeg": _codes,
    ".tif": _codes,
    ".tiff": _codes,
    ".exr": _exr,
}


def image(target: ImageTarget) -> list[TargetPiece]:
    """A rectangle with the picture of a file, from edge to edge.

    Raises
    ------
    SpecError
        If the file cannot be read, or a reflectance lies outside 0 to 1.
    """
    return [picture_piece("picture", read_picture(target, "target"), target.width_m, target.height_m)]


def read_picture(source: PictureFile, key: str) -> Picture:
    """Read a picture of reflectances.

    Parameters
    ----------
    source : names the file.
    key : place of `source` in the scene file, for errors.

    Raises
    ------
    SpecError
        If the file cannot be read, or a reflectance lies outside 0 to 1.
    """
    file = source.folder / source.file
    cube = read_cube(file, source.wavelength_nm)
    values = cube.values
    if source.scale != 1:
        if file.suffix.lower() not in (".exr", ".npy"):
            raise SpecError("scale is for cubes and EXR pictures; sRGB codes are reflectances", key=f"{key}.scale")
        values = values * np.float32(source.scale)
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 1 + _ROUNDING:
        raise SpecError(
            f"reflectances must lie in [0, 1]; these run from {low:g} to {high:g} (see scale)",
            file=file,
            key=f"{key}.file",
        )
    values, wavelength = np.minimum(values, 1), cube.wavelength_nm
    if wavelength is None:
        return Picture(values, "srgb", interpolation=source.interpolation)
    if source.beyond == "hold":
        first, last = min(_HELD_NM[0], wavelength[0] - 1), max(_HELD_NM[1], wavelength[-1] + 1)
        values = np.concatenate([values[..., :1], values, values[..., -1:]], axis=2)
        wavelength = np.concatenate([[first], wavelength, [last]])
    return Picture(values, "spectral", wavelength, source.interpolation)

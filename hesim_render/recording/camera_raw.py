"""RAW files of cameras, read by LibRaw through rawpy: the mosaic, its colours and its levels.

RAW frames of one file each: PNG, TIFF, DNG, NPY and npz, without a sensor file.
"""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import HesimWarning, SpecError, how_to_install
from hesim_render.core.guard import printable, reading, require_memory, require_picture, require_plain
from hesim_render.core.npz import read_array, read_arrays
from hesim_render.recording.dng import read_dng

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

#: Suffixes of files that are read so; DNG and TIFF only where they are packed.
CAMERA_SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".erf", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".srw"),
)
#: Letters of the colour codes of DNG, as LibRaw names them.
_LETTERS = "RGBCMYW"
#: Memory of a pixel: its value and its colour, in the file's frame and in the region, bytes.
_PIXEL_BYTES = 8
#: Black levels further apart are noted, DN.
_NEAR_DN = 1.0


def read_camera_raw(file: Path, sensor: "Sensor") -> NDArray[np.uint16]:
    """The visible part of the mosaic, [row, col], DN, with the black level in it.

    Parameters
    ----------
    file : RAW file of a camera that LibRaw knows.
    sensor : the sensor file for it, cropped to the region that was read out.

    Raises
    ------
    SpecError
        If rawpy is not installed, LibRaw cannot read the file or does not know the camera, or the file has another
        size, more than one value for a pixel, or other colours at its corner than the sensor file.
    """
    try:
        import rawpy
    except ImportError:
        raise SpecError(f"RAW files of cameras need rawpy: {how_to_install('raw')}", file=file) from None
    require_plain(file)
    try:
        opened = rawpy.imread(str(file))
    except (rawpy.LibRawError, OSError) as error:
        reason = printable(str(error.args[0] if error.args else error))
        raise SpecError(f"cannot be read as a RAW file of a camera ({reason})", file=file) from None
    with opened as raw:
        require_picture(raw.sizes.raw_width, raw.sizes.raw_height, _PIXEL_BYTES, file)
        try:
            visible = raw.raw_image_visible
        except (rawpy.LibRawError, RuntimeError):
            visible = None
        if visible is None or raw.raw_type is not rawpy.RawType.Flat or visible.ndim != 2:
            raise SpecError("has more than one value for a pixel; expected a mosaic", file=file)
        shape = sensor.layout.shape
        if visible.shape != shape:
            size, wanted = f"{visible.shape[1]}x{visible.shape[0]}", f"{shape[1]}x{shape[0]}"
            raise SpecError(f"is of {size} px; the sensor's region has {wanted} px", file=file)
        colours = raw.raw_colors_visible
        if colours.size and raw.num_colors > 1:
            _check_colours(colours, raw.color_desc.decode("ascii", "replace"), sensor, file)
        _tell_level(np.array(raw.black_level_per_channel, dtype=np.float64), sensor, file)
        return visible.astype(np.uint16)


def _check_colours(colours: NDArray[np.uint8], names: str, sensor: "Sensor", file: Path) -> None:
    """Refuse a file whose first tile has other colours than the sensor."""
    from hesim_render.mosaic.description import describe

    code = describe(sensor).tile_code
    rows, cols = code.shape
    own = [" ".join(_LETTERS[number] for number in row) for row in code]
    theirs = [" ".join(names[number] for number in row) for row in colours[:rows, :cols]]
    if own != theirs:
        raise SpecError(
            f"begins with the colours {' / '.join(theirs)}; the sensor's region has {' / '.join(own)}: choose its "
            "first row and column (--roi WIDTHxHEIGHT+X+Y), or the tile of the sensor file, to fit",
            file=file,
        )


def _tell_level(levels: NDArray[np.float64], sensor: "Sensor", file: Path) -> None:
    """Warn where the file states another black level."""
    aps = sensor.spec.aps
    if aps is not None and levels.size and abs(levels.mean() - aps.black_level_dn) > _NEAR_DN:
        warnings.warn(
            f"{file.name} states a black level of {levels.mean():g} DN; the sensor file has {aps.black_level_dn:g}",
            HesimWarning,
            stacklevel=4,
        )


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

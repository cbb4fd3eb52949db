"""One RAW frame as a DNG file: exact DN, uncompressed, with the true colour pattern of the tile.

The mosaic is the first image of the file, so every TIFF reader gets the DN themselves. A small
8-bit sRGB picture follows as a second image (NewSubfileType 1). Most readers support 2×2 patterns only and
develop a 4×4 pattern wrongly, so a recording also holds a 2×2 ``preview.dng``; `binned`
makes its pixels. Tags follow DNG 1.4 and TIFF/EP (ISO 12234-2).
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading
from hesim_render.mosaic.description import Mosaic

PHOTOMETRIC_CFA = 32803
PHOTOMETRIC_LINEAR_RAW = 34892
_BYTE, _ASCII, _SHORT, _RATIONAL, _SRATIONAL = 1, 2, 3, 5, 10
_PHOTOMETRIC_TAG = 262
_D65 = 21  # EXIF LightSource


def write_dng(
    path: Path,
    raw: NDArray[np.uint16],
    mosaic: Mosaic,
    *,
    exposure_us: int,
    description: dict[str, Any],
    thumbnail: NDArray[np.uint8] | None = None,
) -> None:
    """Write one frame.

    Parameters
    ----------
    path : the file.
    raw : [row, col], DN; row 0, column 0 is tile position (0, 0).
    mosaic : description of the tile and its colours.
    exposure_us : exposure, µs.
    description : stored in ImageDescription as JSON (time stamps and the like).
    thumbnail : sRGB [row, col, 3].

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import tifffile

    from hesim_render import __version__

    with tifffile.TiffWriter(path, byteorder="<") as file:
        file.write(
            raw,
            # tifffile wants three samples a pixel of LinearRaw, so a mono file is relabelled afterwards
            photometric="minisblack" if mosaic.is_mono else PHOTOMETRIC_CFA,
            compression=None,
            subfiletype=0,
            rowsperstrip=raw.shape[0],
            metadata=None,
            software=f"hesim_render {__version__}",
            description=json.dumps(description),
            extratags=_tags(mosaic, exposure_us),
        )
        if thumbnail is not None:
            file.write(
                thumbnail, photometric="rgb", subfiletype=1, rowsperstrip=thumbnail.shape[0], metadata=None,
                software=False,
            )  # fmt: skip
    if mosaic.is_mono:
        with tifffile.TiffFile(path, mode="r+") as written:
            page = written.pages[0].aspage()
            page.tags[_PHOTOMETRIC_TAG].overwrite(PHOTOMETRIC_LINEAR_RAW)


def read_dng(path: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """The DN of a frame that `write_dng` wrote, [row, col].

    Raises
    ------
    SpecError
        If the file cannot be read, or is not uncompressed uint16 of that `shape`.
    """
    import tifffile

    with reading(path, "as a DNG file"), _quiet("tifffile"), tifffile.TiffFile(path) as file:
        page = file.pages[0].aspage()
        if page.shape != shape or page.dtype != np.uint16 or page.compression != 1:
            raise SpecError(
                f"holds {page.dtype} of {page.shape}; expected uncompressed uint16 of {shape}, as the manifest says",
                file=path,
            )
        if sum(page.databytecounts) != 2 * shape[0] * shape[1]:
            raise SpecError("holds fewer or more pixels than it says", file=path)
        return page.asarray()


@contextlib.contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Switch off the log of a library; our own error reports a damaged file."""
    log = logging.getLogger(name)
    before = log.disabled
    log.disabled = True
    try:
        yield
    finally:
        log.disabled = before


def _tags(mosaic: Mosaic, exposure_us: int) -> list[tuple]:
    """Extra tags as tifffile takes them: (code, type, count, value, write once)."""
    exposure = Fraction(exposure_us, 1_000_000).limit_denominator(1_000_000)
    tags = [
        (271, _ASCII, 0, "hesim_render", True),
        (272, _ASCII, 0, _ascii(mosaic.sensor), True),
        (274, _SHORT, 1, 1, True),  # Orientation: row 0 at the top
        (33434, _RATIONAL, 1, (exposure.numerator, exposure.denominator), True),
        (33437, _RATIONAL, 1, _rational(mosaic.f_number), True),
        (37386, _RATIONAL, 1, _rational(mosaic.focal_length_mm), True),
        (50706, _BYTE, 4, bytes((1, 4, 0, 0)), True),  # DNGVersion
        (50707, _BYTE, 4, bytes((1, 1, 0, 0)), True),  # DNGBackwardVersion
        (50708, _ASCII, 0, f"hesim_render {_ascii(mosaic.sensor)}", True),  # UniqueCameraModel
        (50714, _RATIONAL, 1, _rational(mosaic.black_level_dn), True),
        (50717, _SHORT, 1, mosaic.white_level_dn, True),
    ]
    if mosaic.is_mono:
        return tags
    rows, cols = mosaic.tile_shape
    pattern = mosaic.tile_code
    planes = [int(code) for code in np.unique(pattern)]
    matrix, neutral = _by_plane(mosaic, planes)
    return [
        *tags,
        (33421, _SHORT, 2, (rows, cols), True),  # CFARepeatPatternDim
        (33422, _BYTE, rows * cols, pattern.tobytes(), True),  # CFAPattern
        (50710, _BYTE, len(planes), bytes(planes), True),  # CFAPlaneColor
        (50711, _SHORT, 1, 1, True),  # CFALayout: rectangular
        (50721, _SRATIONAL, matrix.size, _rationals(matrix.ravel()), True),  # ColorMatrix1
        (50728, _RATIONAL, neutral.size, _rationals(neutral), True),  # AsShotNeutral
        (50778, _SHORT, 1, _D65, True),  # CalibrationIlluminant1
    ]


def _ascii(text: str) -> str:
    """The ASCII part of a name."""
    return printable(text).encode("ascii", "backslashreplace").decode("ascii")


def _by_plane(mosaic: Mosaic, planes: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ColorMatrix [plane, 3] and AsShotNeutral [plane]; filters of one colour code share a plane.

    A plane without frame pixels (a white event pixel) has no value in the frame; it gets the mean row.
    """
    matrix, neutral = np.array(mosaic.xyz_to_camera), np.array(mosaic.neutral)
    codes = np.array([mosaic.cfa_code[name] for name in mosaic.channels])
    members = [codes == plane if (codes == plane).any() else np.ones(codes.size, bool) for plane in planes]
    return np.array([matrix[m].mean(axis=0) for m in members]), np.array([neutral[m].mean() for m in members])


def _rational(value: float) -> tuple[int, int]:
    fraction = Fraction(float(value)).limit_denominator(1_000_000)
    return fraction.numerator, fraction.denominator


def _rationals(values: NDArray[np.float64]) -> tuple[int, ...]:
    return tuple(number for value in values for number in _rational(value))


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
    smaller = mosaic.model_copy(
        update={
            "tile_filter": tile_filter,
            "tile_aps": flags,
            "tile_evs": [[False] * len(row) for row in tile_filter],
            "cfa_code": {name: mosaic.cfa_code[name] for name in mosaic.channels},
        }
    )
    return np.rint(mean).astype(np.uint16), smaller

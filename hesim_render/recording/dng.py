"""One RAW frame as a DNG file: exact DN, uncompressed, with the true colour pattern of the tile.

The mosaic is the first image of the file, so every TIFF reader gets the DN themselves. A small
8-bit sRGB picture follows as a second image (NewSubfileType 1). Most readers support 2×2 patterns of three colours
only, so a recording of another tile also holds a ``preview.dng`` (`recording.showcase`). Tags follow DNG 1.4 and
TIFF/EP (ISO 12234-2).

The noise of a sensor's frames in the two numbers that DNG has for it (tag NoiseProfile).
"""

import contextlib
import json
import logging
import struct
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import printable, reading
from hesim_render.mosaic.description import Mosaic

if TYPE_CHECKING:
    from hesim_render.sensor.sensor import Sensor

PHOTOMETRIC_CFA = 32803
PHOTOMETRIC_LINEAR_RAW = 34892
_BYTE, _ASCII, _SHORT, _RATIONAL, _SRATIONAL, _DOUBLE = 1, 2, 3, 5, 10, 12
_LONG, _UNDEFINED = 4, 7
_CENTIMETRE = 3  # FocalPlaneResolutionUnit
_UM_PER_CM = 10_000
#: From CIE XYZ (D65) to linear sRGB, IEC 61966-2-1.
_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_PHOTOMETRIC_TAG, _EXIF_TAG = 262, 34665
#: tifffile writes no tag 34665, so this one keeps its place.
_EXIF_PLACE = 34666
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
            extratags=_tags(mosaic),
        )
        if thumbnail is not None:
            file.write(
                thumbnail, photometric="rgb", subfiletype=1, rowsperstrip=thumbnail.shape[0], metadata=None,
                software=False,
            )  # fmt: skip
    _write_exif(path, mosaic, exposure_us)


def write_linear_dng(
    path: Path, linear: NDArray[np.float32], mosaic: Mosaic, *, exposure_us: int, description: dict[str, Any]
) -> None:
    """Write a picture in linear sRGB, as LinearRaw, which needs no demosaicing.

    Parameters
    ----------
    path : the file.
    linear : [row, col, 3], white is 1.
    mosaic, exposure_us, description : of the frame, as for `write_dng`.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    import tifffile

    from hesim_render import __version__

    top = (1 << 16) - 1
    colour = [
        (50721, _SRATIONAL, _SRGB.size, _rationals(_SRGB.ravel()), True),  # ColorMatrix1
        (50728, _RATIONAL, 3, (1, 1) * 3, True),  # AsShotNeutral
        (50778, _SHORT, 1, _D65, True),
    ]
    levels = [(50714, _SHORT, 3, (0, 0, 0), True), (50717, _SHORT, 3, (top,) * 3, True)]
    with tifffile.TiffWriter(path, byteorder="<") as file:
        file.write(
            np.rint(np.clip(linear, 0, 1) * top).astype(np.uint16), photometric=PHOTOMETRIC_LINEAR_RAW,
            compression=None, subfiletype=0, rowsperstrip=linear.shape[0], metadata=None,
            planarconfig="contig", software=f"hesim_render {__version__}", description=json.dumps(description),
            extratags=[*_camera_tags(mosaic), *levels, *colour],
        )  # fmt: skip
    _write_exif(path, mosaic, exposure_us, linear=True)


def read_dng(path: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """The DN of a frame that `write_dng` wrote, [row, col].

    Raises
    ------
    SpecError
        If the file cannot be read, or is not uncompressed uint16 of that `shape`.
    """
    import tifffile

    with reading(path, "as a DNG file"), quiet("tifffile"), tifffile.TiffFile(path) as file:
        page = file.pages[0].aspage()
        if page.shape != shape or page.dtype != np.uint16 or page.compression != 1:
            raise SpecError(
                f"holds {page.dtype} of {page.shape}; expected uncompressed uint16 of {shape}, as the manifest says",
                file=path,
            )
        if sum(page.databytecounts) != 2 * shape[0] * shape[1]:
            raise SpecError("holds fewer or more pixels than it says", file=path)
        return page.asarray()


def is_packed(path: Path) -> bool:
    """True if `read_dng` cannot read a DNG file because its first image is packed, in tiles or small, as of cameras.

    Raises
    ------
    SpecError
        If it is no TIFF file.
    """
    import tifffile

    with reading(path, "as a DNG file"), quiet("tifffile"), tifffile.TiffFile(path) as file:
        page = file.pages[0].aspage()
        return page.compression != 1 or page.is_tiled or page.subfiletype & 1 == 1


@contextlib.contextmanager
def quiet(name: str) -> Iterator[None]:
    """Switch off the log of a library; our own error reports a damaged file."""
    log = logging.getLogger(name)
    before = log.disabled
    log.disabled = True
    try:
        yield
    finally:
        log.disabled = before


def _write_exif(path: Path, mosaic: Mosaic, exposure_us: int, linear: bool = False) -> None:
    """Append the directory of the exposure and the lens, of which tifffile has written the place only.

    Its entries are (code, type, values); those that take more than four bytes lie behind it. A mono mosaic gets its
    photometric interpretation here as well.
    """
    exposure = Fraction(exposure_us, 1_000_000).limit_denominator(1_000_000)
    entries: list[tuple[int, int, tuple[int, ...]]] = [
        (33434, _RATIONAL, (exposure.numerator, exposure.denominator)),  # ExposureTime
        (33437, _RATIONAL, _rational(mosaic.f_number)),  # FNumber
        (36864, _UNDEFINED, tuple(b"0230")),  # ExifVersion
        (37386, _RATIONAL, _rational(mosaic.focal_length_mm)),  # FocalLength
    ]
    if mosaic.pitch_um is not None:
        per_cm = _rational(_UM_PER_CM / mosaic.pitch_um)
        # FocalPlaneXResolution, FocalPlaneYResolution and their unit
        entries += [(41486, _RATIONAL, per_cm), (41487, _RATIONAL, per_cm), (41488, _SHORT, (_CENTIMETRE,))]
    with path.open("r+b") as file:
        begin = file.seek(0, 2)
        begin += file.write(b"\0" * (begin % 2))
        behind = begin + 2 + 12 * len(entries) + 4
        fields, values = b"", b""
        for code, kind, numbers in entries:
            if kind == _RATIONAL:
                fields += struct.pack("<HHII", code, kind, 1, behind + len(values))
                values += struct.pack("<II", *numbers)
            elif kind == _SHORT:
                fields += struct.pack("<HHIHH", code, kind, 1, *numbers, 0)
            else:
                fields += struct.pack("<HHI4B", code, kind, len(numbers), *numbers)
        file.write(struct.pack("<H", len(entries)) + fields + bytes(4) + values)
        changed = {_EXIF_PLACE: struct.pack("<HHII", _EXIF_TAG, _LONG, 1, begin)}
        if mosaic.is_mono and not linear:
            changed[_PHOTOMETRIC_TAG] = struct.pack("<HHIHH", _PHOTOMETRIC_TAG, _SHORT, 1, PHOTOMETRIC_LINEAR_RAW, 0)
        file.seek(4)
        (first,) = struct.unpack("<I", file.read(4))
        file.seek(first)
        (count,) = struct.unpack("<H", file.read(2))
        codes = [struct.unpack("<H", file.read(12)[:2])[0] for _ in range(count)]
        for code, entry in changed.items():
            file.seek(first + 2 + 12 * codes.index(code))
            file.write(entry)


def _camera_tags(mosaic: Mosaic) -> list[tuple]:
    """Tags of the camera, and the place of those of the exposure: (code, type, count, value, write once)."""
    return [
        (271, _ASCII, 0, "hesim_render", True),
        (272, _ASCII, 0, _ascii(mosaic.sensor), True),
        (274, _SHORT, 1, 1, True),  # Orientation: row 0 at the top
        (_EXIF_PLACE, _LONG, 1, 0, True),
        (50706, _BYTE, 4, bytes((1, 4, 0, 0)), True),  # DNGVersion
        (50707, _BYTE, 4, bytes((1, 1, 0, 0)), True),  # DNGBackwardVersion
        (50708, _ASCII, 0, f"hesim_render {_ascii(mosaic.sensor)}", True),  # UniqueCameraModel
    ]


def _tags(mosaic: Mosaic) -> list[tuple]:
    """All further tags of a RAW frame."""
    tags = [
        *_camera_tags(mosaic),
        (50714, _RATIONAL, 1, _rational(mosaic.black_level_dn), True),
        (50717, _SHORT, 1, mosaic.white_level_dn, True),
    ]
    if mosaic.noise_profile is not None:
        tags.append((51041, _DOUBLE, 2, mosaic.noise_profile, True))
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


#: Signals between black and white at which the variance is fitted.
_SIGNALS = 65


def noise_profile(sensor: "Sensor", without: Sequence[str] = ()) -> tuple[float, float] | None:
    """S and O of the temporal variance S·x + O of a pixel, where x is 0 at the black level and 1 at the white level.

    The law of the frame noise is fitted by least squares, each signal relative to its own variance, so that dark and
    light count alike. Light alone gives S = gain / (white - black), exactly. Rounding to whole DN is in it; fixed
    patterns are not.

    Parameters
    ----------
    sensor : the sensor, with the exposure of its file.
    without : names of noise terms that are switched off, such as ``aps.read``.

    Returns
    -------
    S and O, without unit; None where there are no frames, or no noise but rounding.
    """
    aps = sensor.spec.aps
    if aps is None:
        return None
    model = sensor.aps.without(*[name[4:] for name in without if name.startswith("aps.")])
    white = min(2**aps.bit_depth - 1, round(aps.black_level_dn + aps.system_gain_dn_per_e * aps.full_well_e))
    span = white - aps.black_level_dn
    x = np.linspace(0.0, 1.0, _SIGNALS)
    electrons = x * span / aps.system_gain_dn_per_e
    variance = np.array([float(model.variance_dn2(float(e), aps.exposure_us, adc=True)) for e in electrons]) / span**2
    (slope, offset), *_ = np.linalg.lstsq(np.stack([x, np.ones_like(x)], 1) / variance[:, None], np.ones(_SIGNALS),
                                          rcond=None)  # fmt: skip
    return (_rounded(slope), _rounded(offset)) if slope > 0 and offset > 0 else None


def _rounded(value: float) -> float:
    """Six significant digits: the last ones of a fit depend on the build of NumPy, and with them the bytes of files."""
    return float(f"{value:.6g}")

"""Grey pictures with the values of an ADC in them: PNG, TIFF, BMP and PGM of 8 or 16 bits."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.guard import MOST_PIXELS, WholeFile, reading, require_memory
from hesim_render.recording.camera_raw import read_raw

PICTURE_SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".pgm")
_OPENED_AS = {".png": "PNG", ".bmp": "BMP", ".tif": "TIFF", ".tiff": "TIFF"}
_COLOUR = "a colour picture; EMVA 1288 evaluates the values of the ADC, one colour at a time: capture RAW frames"
#: Photometric interpretations of TIFF whose values grow with the light: black is zero, and a mosaic.
_RISING = (1, 32803)
#: Longest header of a PGM file, bytes.
_PGM_HEADER = 1 << 12


def read_grey(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """The DN of a grey picture, [row, col].

    Parameters
    ----------
    file : PNG, TIFF (the first image), BMP or PGM of 8 or 16 bits, grey, or of equal red, green and blue; or another
        frame that `read_raw` reads.
    shape : rows and columns that it must have.

    Raises
    ------
    SpecError
        If the file is no such picture, is damaged, has colours, or is of another size.
    """
    suffix = file.suffix.lower()
    if suffix == ".pgm":
        return _read_pgm(file, shape)
    if suffix in (".tif", ".tiff"):
        return _read_tiff(file, shape)
    if suffix in _OPENED_AS:
        return _read_picture(file, shape)
    return read_raw(file, shape)


def grey_size(file: Path) -> tuple[int, int]:
    """Rows and columns of a grey picture.

    Raises
    ------
    SpecError
        If it is none, or has more pixels than any sensor.
    """
    suffix = file.suffix.lower()
    if suffix == ".pgm":
        shape = _pgm_header(file)[1]
    elif suffix in _OPENED_AS:
        from PIL import Image

        with reading(file, _kind(file)), Image.open(file, formats=[_OPENED_AS[suffix]]) as image:
            shape = image.size[1], image.size[0]
    else:
        raise SpecError(f"is no picture of a plain folder; expected {', '.join(PICTURE_SUFFIXES)}", file=file)
    if shape[0] * shape[1] > MOST_PIXELS:
        raise SpecError(f"is of {shape[1]}x{shape[0]} px", file=file)
    return shape


def _kind(file: Path) -> str:
    return f"as a {_OPENED_AS[file.suffix.lower()]} file"


def _require(file: Path, kind: str, shape: tuple[int, int], wanted: tuple[int, int], is_grey: bool) -> None:
    if shape != wanted or not is_grey:
        problem = f"is a {kind} picture of {shape[1]}x{shape[0]} px"
        raise SpecError(f"{problem}; expected a grey one of {wanted[1]}x{wanted[0]} px", file=file)
    require_memory(8 * shape[0] * shape[1], "the picture", file)


def _read_picture(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """A PNG, BMP or packed TIFF file; pictures of equal red, green and blue are grey."""
    from PIL import Image

    with reading(file, _kind(file)), Image.open(file, formats=[_OPENED_AS[file.suffix.lower()]]) as image:
        mode, size = image.mode, (image.size[1], image.size[0])
        grey = ("L", "I;16", "I;16B", "P", "RGB", "I")
        _require(file, mode, size, shape, mode in grey)
        if mode in ("P", "RGB"):
            values = np.asarray(image.convert("RGB"))
            if not (np.array_equal(values[..., 0], values[..., 1]) and np.array_equal(values[..., 0], values[..., 2])):
                raise SpecError(f"is {_COLOUR}", file=file)
            return values[..., 0].astype(np.uint16)
        return _as_uint16(file, np.asarray(image))


def _as_uint16(file: Path, values: NDArray) -> NDArray[np.uint16]:
    if values.size and (int(values.min()) < 0 or int(values.max()) >= 1 << 16):
        raise SpecError(f"holds values of {values.min()} to {values.max()}; expected 16 bits", file=file)
    return values.astype(np.uint16)


def _read_tiff(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    import tifffile

    from hesim_render.recording.dng import quiet

    with reading(file, "as a TIFF file"), quiet("tifffile"), tifffile.TiffFile(file) as opened:
        page = opened.pages[0].aspage()
        samples = int(page.samplesperpixel)
        if samples > 1 or int(page.photometric) not in _RISING:
            what = _COLOUR if samples > 1 else "a picture whose values do not rise with the light"
            raise SpecError(f"is {what}", file=file)
        kind = "?" if page.dtype is None else page.dtype.name
        size = (int(page.imagelength), int(page.imagewidth))
        _require(file, kind, size, shape, kind in ("uint8", "uint16", "uint32", "int32"))
        if page.compression == 1:
            if not page.is_tiled and sum(page.databytecounts) != np.dtype(kind).itemsize * shape[0] * shape[1]:
                raise SpecError("holds fewer or more pixels than it says", file=file)
            return _as_uint16(file, page.asarray().reshape(shape))
    return _read_picture(file, shape)


def _pgm_header(file: Path) -> tuple[str, tuple[int, int], int, int]:
    """Kind (P2 or P5), shape, largest value, and first byte of the values."""
    with reading(file, "as a PGM file"), file.open("rb") as opened:
        begin = opened.read(_PGM_HEADER)
    if begin[:2] in (b"P3", b"P6"):
        raise SpecError(f"is {_COLOUR}", file=file)
    comment = rb"(?:\s|#[^\r\n]*[\r\n])+"
    match = re.match(rb"(P[25])" + comment + rb"(\d{1,6})" + comment + rb"(\d{1,6})" + comment + rb"(\d{1,6})\s", begin)
    if match is None:
        raise SpecError("is no PGM file (P2 or P5)", file=file)
    kind, width, height, largest = match.groups()
    if not 1 <= int(largest) < 1 << 16:
        raise SpecError(f"states the largest value {int(largest)}; expected 1 to 65535", file=file)
    return kind.decode("ascii"), (int(height), int(width)), int(largest), match.end()


def _read_pgm(file: Path, shape: tuple[int, int]) -> NDArray[np.uint16]:
    """A PGM file; its values are as stored, and not scaled by the largest value."""
    kind, size, largest, begin = _pgm_header(file)
    _require(file, "PGM", size, shape, True)
    data = WholeFile(file).read()[begin:]
    with reading(file, "as a PGM file"):
        if kind == "P2":
            values = np.array(re.sub(rb"#[^\r\n]*", b"", data).split(), np.int64)
        else:
            values = np.frombuffer(data, "u1" if largest < 256 else ">u2", -1 if largest < 256 else len(data) // 2)
    if values.size != shape[0] * shape[1]:
        raise SpecError(f"holds {values.size} values; expected {shape[0] * shape[1]}", file=file)
    if int(values.max()) > largest or int(values.min()) < 0:
        raise SpecError(f"holds a value of {values.max()}, above its largest, {largest}", file=file)
    return values.reshape(shape).astype(np.uint16)

"""Sizes that files state in their headers: Mitsuba takes memory for what a header says, before it reads the rest."""

import re
import warnings
import zlib
from pathlib import Path

from hesim_render.core.errors import SpecError
from hesim_render.core.exr import exr_header
from hesim_render.core.guard import WholeFile, reading, require_memory, require_picture

#: A header is looked for in so many bytes.
_HEAD = 1 << 16
#: Memory of a texel: four channels of float32, in the picture and in the texture that is made of it, bytes.
_TEXEL = 32
#: Memory of a vertex with normal and texture coordinates, and of a triangle, bytes.
_VERTEX, _TRIANGLE = 32, 12
_PFM = re.compile(rb"P[Ff]\s+(\d+)\s+(\d+)\s")
#: Most files have rows first, "-Y 768 +X 1024".
_RGBE = re.compile(rb"\n[-+]([XY])\s+(\d+)\s+[-+][XY]\s+(\d+)\n")
_PLY_ELEMENT = re.compile(rb"element\s+\S+\s+(\d+)\s((?:\s*(?:property|comment)[^\n]*\n)*)")
_SCALAR_BYTES = {b"char": 1, b"uchar": 1, b"int8": 1, b"uint8": 1, b"short": 2, b"ushort": 2, b"int16": 2,
                 b"uint16": 2, b"double": 8, b"float64": 8}  # fmt: skip


def require_fits(file: Path) -> None:
    """Refuse a picture, mesh or volume that is larger than memory, or larger than its file can hold.

    Parameters
    ----------
    file : a file that Mitsuba is about to read; its first bytes tell the kind. Other kinds pass.

    Raises
    ------
    SpecError
        If it would not fit.
    """
    with reading(file):
        with WholeFile(file).checked().open("rb") as stream:
            head = stream.read(_HEAD)
        if head.startswith(b"ply"):
            _ply(file, head)
        elif head.startswith(b"VOL"):
            _volume(file, head)
        elif head.startswith(b"\x1c\x04"):
            _serialized(file, head)
        else:
            width, height = _picture(file, head)
            require_picture(width, height, _TEXEL, file)


def _picture(file: Path, head: bytes) -> tuple[int, int]:
    """Width and height; 0 for a file that is no picture."""
    if head.startswith(b"\x76\x2f\x31\x01"):
        return exr_header(file)[0]
    if (match := _PFM.match(head)) is not None:
        return int(match[1]), int(match[2])
    if head.startswith(b"#?") and (match := _RGBE.search(head)) is not None:
        sides = int(match[2]), int(match[3])
        return sides if match[1] == b"X" else sides[::-1]
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(file, formats=["PNG", "JPEG", "BMP", "TGA", "PPM"]) as image:
                return image.size
        except Image.UnidentifiedImageError:
            return 0, 0


def _ply(file: Path, head: bytes) -> None:
    size, text = file.stat().st_size, head.partition(b"end_header")[0]
    for element in _PLY_ELEMENT.finditer(text):
        kinds = re.findall(rb"property\s+(list|\w+)", element[2])
        # a number of a text has a digit and a blank, a list is at least its length
        least = sum(2 if b"format ascii" in text else 1 if kind == b"list" else _SCALAR_BYTES.get(kind, 4)
                    for kind in kinds)  # fmt: skip
        if int(element[1]) * max(1, least) > size:
            raise SpecError(f"says that it has {int(element[1])} elements, which its {size} bytes cannot hold",
                            file=file)  # fmt: skip


def _volume(file: Path, head: bytes) -> None:
    numbers = [int.from_bytes(head[k : k + 4], "little") for k in range(4, 24, 4)]  # type, x, y, z, channels
    count = numbers[1] * numbers[2] * numbers[3] * numbers[4]
    if count > file.stat().st_size:
        raise SpecError(
            f"says that it has {count} values, which its {file.stat().st_size} bytes cannot hold", file=file
        )


def _serialized(file: Path, head: bytes) -> None:
    """The first mesh of a file of Mitsuba 0.6: what is packed begins with its flags, name and counts."""
    packed = zlib.decompressobj().decompress(head[4:], 4096)
    begin = packed.find(b"\0", 4) + 1 if int.from_bytes(head[2:4], "little") == 4 else 4
    vertices, triangles = (int.from_bytes(packed[begin + k : begin + k + 8], "little") for k in (0, 8))
    require_memory(vertices * _VERTEX + triangles * _TRIANGLE, "the mesh", file)
    # deflate packs to a thousandth at best
    if vertices * 12 + triangles * _TRIANGLE > 1032 * file.stat().st_size:
        raise SpecError(f"says that it has {vertices} vertices and {triangles} triangles, which its "
                        f"{file.stat().st_size} bytes cannot hold", file=file)  # fmt: skip

"""Video from a folder of numbered pictures: PNG, JPEG, TIFF, EXR and other formats that PyAV decodes."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.exr import require_exr_fits
from hesim_render.core.guard import WholeFile, reading, require_memory
from hesim_render.sources.video.arrays import picture_bits, without_alpha
from hesim_render.sources.video.colours import ColourTags
from hesim_render.sources.video.digest import Hashed
from hesim_render.sources.video.picture_layout import PictureFormat, PictureLayout, Planes, Timing, check_values
from hesim_render.sources.video.pyav import decode_picture
from hesim_render.spectral.transfer import InputTransfer

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".bmp", ".webp", ".ppm", ".pgm", ".dpx")
_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")


def numbered_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder in order of the last number in their names; other files are ignored.

    Raises
    ------
    SpecError
        If there are none, if names have no number or differ in other parts, or if a number is missing or occurs twice.
    """
    files = sorted(
        path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
    )
    if not files:
        raise SpecError(f"has no pictures ({', '.join(SUFFIXES)})", file=folder)
    result: dict[int, Path] = {}
    series: tuple[str, str] | None = None
    for path in files:
        match = _NUMBERED.fullmatch(path.stem)
        if match is None:
            raise SpecError("has no number in its name; pictures are put in order by their numbers", file=path)
        own = (match[1], match[3] + path.suffix)
        series = series or own
        if own != series:
            raise SpecError(f"is not of the same series as {files[0].name}; give one folder per series", file=path)
        number = int(match[2])
        if number in result:
            raise SpecError(f"has the same number as {result[number].name}", file=path)
        result[number] = path
    numbers = sorted(result)
    gap = next((k for k in range(numbers[0], numbers[-1]) if k not in result), None)
    if gap is not None:
        raise SpecError(
            f"picture number {gap} is missing ({len(numbers)} pictures, {numbers[0]} to {numbers[-1]})", file=folder
        )
    return [result[number] for number in numbers]


class FolderVideo(Hashed):
    """Numbered pictures of one size and type.

    Parameters
    ----------
    folder : it; see `numbered_pictures`.
    bit_depth : of integer values in TIFF; default all bits of their type.
    fps : pictures per second of the video's clock.

    Raises
    ------
    SpecError
        If a picture cannot be read or differs from the first, also later in `read`.
    """

    def __init__(self, folder: str | Path, bit_depth: int | None = None, fps: float | None = None) -> None:
        self._folder = Path(folder)
        self.name = str(folder)
        self._files = numbered_pictures(self._folder)
        self._bit_depth = bit_depth
        self.count = len(self._files)
        self.timing = None if fps is None else Timing.regular(self.count, fps)
        self.format, self.tags, planes = self._open(self._files[0])
        self._dtypes = [plane.dtype for plane in planes]
        self._kept: tuple[int, Planes] | None = (0, planes)

    def _open(self, path: Path) -> tuple[PictureFormat, ColourTags, Planes]:
        suffix = path.suffix.lower()
        if suffix not in (".exr", ".tif", ".tiff"):
            shape, tags, planes = decode_picture(path)
            if self._bit_depth not in (None, shape.bits):
                raise SpecError(f"holds {shape.bits} bits; bit_depth is for TIFF and arrays", file=path)
            return shape, tags, planes
        image = _read_exr(path) if suffix == ".exr" else _read_tiff(path)
        bits = picture_bits(image.dtype, self._bit_depth, str(path))
        image = without_alpha(image, bits, str(path))
        if image.dtype == np.float64:
            image = image.astype(np.float32)
        layout: PictureLayout = "grey" if image.ndim == 2 else "interleaved"
        transfer: InputTransfer | None = "linear" if suffix == ".exr" else None
        return (
            PictureFormat(layout, image.shape[1], image.shape[0], bits),
            ColourTags(transfer, None, "bt709", "rgb", "full"),
            check_values((image,), str(path)),
        )

    def read(self, index: int) -> Planes:
        if self._kept is not None and self._kept[0] == index:
            return self._kept[1]
        path = self._files[index]
        shape, tags, planes = self._open(path)
        if (shape, tags) != (self.format, self.tags) or [plane.dtype for plane in planes] != self._dtypes:
            raise SpecError(f"is {_words(shape)}, unlike the first picture ({_words(self.format)})", file=path)
        self._kept = (index, planes)
        return planes

    def _pieces(self) -> Iterator[bytes]:
        for path in self._files:
            yield f"{path.name} {WholeFile(path).sha256()}\n".encode()

    def describe(self) -> Mapping[str, Any]:
        return {
            "source": self.name,
            "sha256": self._sha256(),
            "pictures": self.count,
            "first": self._files[0].name,
            "last": self._files[-1].name,
            "size_px": [self.format.width, self.format.height],
            "layout": self.format.layout,
            "bits": self.format.bits,
        }

    def close(self) -> None:
        self._stop_digest()
        self._kept = None


def _words(shape: PictureFormat) -> str:
    values = f"{shape.bits} bit" if shape.bits else "floating point"
    return f"{shape.width}x{shape.height} {shape.layout}, {values}"


def _read_tiff(path: Path) -> NDArray:
    import tifffile

    with reading(path), tifffile.TiffFile(path) as file:
        page = file.pages[0].aspage()
        require_memory(3 * page.nbytes, "the picture", path)
        image = page.asarray()
    if image.ndim not in (2, 3):
        raise SpecError(f"has shape {image.shape}; expected [row, col] or [row, col, channel]", file=path)
    return image


def _read_exr(path: Path) -> NDArray:
    """[row, col] or [row, col, 3], float16 or float32; alpha is left out: colours are already times alpha."""
    import OpenEXR

    require_exr_fits(path)
    with reading(path), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.parts[0].channels.items()}
    if {"R", "G", "B"} <= set(channels):
        image = np.stack([channels[name] for name in "RGB"], axis=-1)
    elif "Y" in channels:
        image = channels["Y"]
    else:
        raise SpecError(f"has channels {', '.join(sorted(channels))}; expected R, G, B or Y", file=path)
    return image.astype(np.float32) if image.dtype.kind != "f" else image

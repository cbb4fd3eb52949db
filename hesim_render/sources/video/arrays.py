"""Video from NumPy arrays: in memory, or a ``.npy`` file read piece by piece."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.guard import reading
from hesim_render.sources.video.colours import ColourTags
from hesim_render.sources.video.digest import Hashed
from hesim_render.sources.video.picture_layout import PictureFormat, PictureLayout, Planes, Timing, check_values


def picture_bits(dtype: np.dtype, bit_depth: int | None, name: str) -> int:
    """Bits of the codes of an array or image, 0 for floating point.

    Raises
    ------
    SpecError
        For a type of values that pictures do not have.
    RangeError
        For a bit depth that the type does not hold.
    """
    if dtype.kind == "f" and dtype.itemsize <= 8:
        if bit_depth is not None:
            raise RangeError("bit_depth", bit_depth, "none for floating-point values")
        return 0
    if dtype not in (np.dtype(np.uint8), np.dtype(np.uint16)):
        raise SpecError(f"holds values of type {dtype}; expected uint8, uint16 or floating point", file=name)
    held = 8 * dtype.itemsize
    if bit_depth is None:
        return held
    if not (1 <= bit_depth <= 8 if held == 8 else 9 <= bit_depth <= 16):
        raise RangeError("bit_depth", bit_depth, f"what {dtype} values hold: {'1 to 8' if held == 8 else '9 to 16'}")
    return bit_depth


def without_alpha(image: NDArray, bits: int, where: str) -> NDArray:
    """[row, col] or [row, col, 3] of an image, without its alpha channel, which must be opaque.

    Floating-point pictures (EXR) hold colour times alpha: over a black background they need no change.

    Raises
    ------
    SpecError
        If something is transparent, or there are not 1 to 4 channels.
    """
    if image.ndim == 2:
        return image
    channels = image.shape[2]
    if channels not in (1, 2, 3, 4):
        raise SpecError(f"has {channels} channels; expected grey or RGB, each perhaps with alpha", file=where)
    if channels in (2, 4):
        if bits and image[..., -1].min() < 2**bits - 1:
            raise SpecError("has transparent pixels: put it on a background first", file=where)
        image = image[..., :-1]
    return image[..., 0] if image.shape[2] == 1 else image


class ArrayVideo(Hashed):
    """Pictures [time, row, col] or [time, row, col, channel] of an array.

    Parameters
    ----------
    source : the array, or the path of a ``.npy`` file, which is mapped and not loaded.
    bit_depth : of integer values; default all bits of their type.
    fps : pictures per second of the video's clock.

    Raises
    ------
    SpecError
        If the file cannot be read, or the shape or type is no video's.
    RangeError
        For a `bit_depth` that the values do not have.
    """

    def __init__(self, source: NDArray | str | Path, bit_depth: int | None = None, fps: float | None = None) -> None:
        self._path = None if isinstance(source, np.ndarray) else Path(source)
        self.name = "array" if self._path is None else str(self._path)
        array: Any = source
        if self._path is not None:
            with reading(self._path, "as an .npy file of numbers"):
                array = np.load(self._path, mmap_mode="r", allow_pickle=False)
        if array.ndim not in (3, 4) or (array.ndim == 4 and array.shape[3] not in (1, 3, 4)) or 0 in array.shape:
            raise SpecError(
                f"has shape {array.shape}; expected [time, row, col] or [time, row, col, 1, 3 or 4 channels]",
                file=self.name,
            )
        self._array = array
        self._bits = picture_bits(array.dtype, bit_depth, self.name)
        self.count, height, width = array.shape[:3]
        layout: PictureLayout = "grey" if array.ndim == 3 or array.shape[3] == 1 else "interleaved"
        self.format = PictureFormat(layout, width, height, self._bits)
        self.tags = ColourTags(primaries="bt709", matrix="rgb", range="full")
        self.timing = None if fps is None else Timing.regular(self.count, fps)

    def read(self, index: int) -> Planes:
        where = f"{self.name}: picture {index}"
        image = without_alpha(np.asarray(self._array[index]), self._bits, where)
        return check_values((image.astype(np.float32) if image.dtype == np.float64 else image,), where)

    def _pieces(self) -> Iterator[Any]:
        yield f"{self._array.dtype.str}{self._array.shape}".encode()
        for picture in self._array:
            yield np.ascontiguousarray(picture).data

    def describe(self) -> Mapping[str, Any]:
        return {
            "source": self.name,
            "sha256": self._sha256(),
            "pictures": self.count,
            "size_px": [self.format.width, self.format.height],
            "values": str(self._array.dtype),
            "bits": self._bits,
        }

    def close(self) -> None:
        self._stop_digest()
        self._array = None

"""Memory layout of a picture, and the reader interface that supplies a video's pictures in order."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.video.colours import ColourTags

PictureLayout = Literal["grey", "planar", "interleaved", "yuv"]
#: The arrays of one picture, see `PictureFormat`; they are read-only.
Planes = tuple[NDArray, ...]


@dataclass(frozen=True)
class PictureFormat:
    """Size and layout, the same for all pictures of a video.

    Parameters
    ----------
    layout : ``grey``: one array [row, col]; ``planar``: R, G, B, each [row, col]; ``interleaved``: one array
        [row, col, 3]; ``yuv``: Y [row, col], Cb and Cr at their own size.
    width, height : px.
    bits : of integer codes (uint8 or uint16); 0 for floating point.
    chroma_shift : log2 of the subsampling of Cb and Cr along (x, y).
    chroma_left : chroma samples sit on the left luma sample (MPEG-2, H.264, …), not between the two (JPEG, MPEG-1).
    """

    layout: PictureLayout
    width: int
    height: int
    bits: int
    chroma_shift: tuple[int, int] = (0, 0)
    chroma_left: bool = True

    @property
    def chroma_size(self) -> tuple[int, int]:
        """Width and height of Cb and Cr, rounded up for odd pictures."""
        x, y = self.chroma_shift
        return -(-self.width >> x), -(-self.height >> y)


@dataclass(frozen=True)
class Timing:
    """Begin times of the pictures of a video by its own clock.

    Parameters
    ----------
    begin_s : [picture], increasing, the first 0, s.
    end_s : end of the last picture, s.
    cut_short : evidence that the file once was longer, else empty.
    """

    begin_s: NDArray[np.float64]
    end_s: float
    cut_short: str = ""

    @classmethod
    def regular(cls, count: int, fps: float) -> "Timing":
        return cls(np.arange(count) / fps, count / fps)


class Reader(Protocol):
    """Supplies the pictures of a video. Forward reading is fast; a step back may restart the decoder."""

    name: str
    format: PictureFormat
    tags: ColourTags
    #: None if the input has no clock and needs a frame rate.
    timing: Timing | None
    count: int

    def read(self, index: int) -> Planes:
        """The picture of this number, 0 first."""

    def start_digest(self) -> None:
        """Start hashing the input in parallel to the run."""

    def describe(self) -> Mapping[str, Any]:
        """The manifest's entry for the input: name, hash, size, format; plain values. Waits for the hash."""

    def close(self) -> None: ...


def check_values(planes: Planes, where: str) -> Planes:
    """The same planes, contiguous; floating point must be finite.

    Raises
    ------
    SpecError
        If a value is not finite.
    """
    from hesim_render.core.errors import SpecError

    for plane in planes:
        # a finite sum proves that all values are finite and is much faster; it may overflow, so check values then
        if plane.dtype.kind == "f" and not np.isfinite(plane.sum(dtype=np.float64)) and not np.isfinite(plane).all():
            raise SpecError("holds values that are not finite", file=where)
    return tuple(np.ascontiguousarray(plane) for plane in planes)

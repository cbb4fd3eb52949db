"""How a picture lies in memory, and who hands out a video's pictures one after another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.video.colours import ColourTags

PictureLayout = Literal["grey", "planar", "interleaved", "yuv"]
#: The arrays of one picture, see `PictureFormat`; nobody writes into them.
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
        """Width and height of Cb and Cr: an odd picture's last sample stands alone."""
        x, y = self.chroma_shift
        return -(-self.width >> x), -(-self.height >> y)


@dataclass(frozen=True)
class Timing:
    """When the pictures of a video begin, by its own clock.

    Parameters
    ----------
    begin_s : [picture], increasing, the first 0.
    end_s : of the last picture.
    cut_short : what tells that the file once was longer, else empty.
    """

    begin_s: NDArray[np.float64]
    end_s: float
    cut_short: str = ""

    @classmethod
    def regular(cls, count: int, fps: float) -> Timing:
        return cls(np.arange(count) / fps, count / fps)


class Reader(Protocol):
    """Hands out the pictures of a video; going forward is quick, going back may begin anew."""

    name: str
    format: PictureFormat
    tags: ColourTags
    #: None where the input has no clock and needs a frame rate.
    timing: Timing | None
    count: int

    def read(self, index: int) -> Planes:
        """The picture of this number, 0 first."""
        ...

    def start_digest(self) -> None:
        """Begin to hash the input, beside what follows."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """What the manifest says of the input: name, hash, size, format; plain values. Waits for the hash."""
        ...

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
        # a sum is finite if all are, and much quicker; it may overflow where they are
        if plane.dtype.kind == "f" and not np.isfinite(plane.sum(dtype=np.float64)) and not np.isfinite(plane).all():
            raise SpecError("holds values that are not finite", file=where)
    return tuple(np.ascontiguousarray(plane) for plane in planes)

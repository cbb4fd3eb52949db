"""Mean and variance over repeated frames, per pixel and exposure, in one pass over the stream."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[str, float], None]
#: Fraction of full scale below which the first frame's value assigns a pixel to the dim or to the bright half.
_CLEAR = 0.9


class Frames(Protocol):
    """A stack of frames that is read one at a time, such as `hesim_render.recording.capture_set.FrameStack`.

    Attributes
    ----------
    file : of messages.
    exposures_us : int64 [exposure].
    shape : (exposures, frames, rows, cols).
    """

    file: Path
    exposures_us: NDArray[np.int64]
    shape: tuple[int, int, int, int]

    def __iter__(self) -> Iterator[NDArray]: ...


@dataclass(frozen=True)
class FrameMoments:
    """Statistics of a stack of frames, exposures in increasing order.

    Attributes
    ----------
    exposures_us : int64 [exposure].
    frames : frames per exposure.
    mean, variance : float32 [exposure, row, col], DN and DN² (ddof 1, the ADC's 1/12 still in).
    lowest, highest : uint16 [exposure, row, col], extremes over the frames, which show clipping.
    first : uint16 [exposure, row, col], the first frame, for distributions of single values.
    row_means : float64 [exposure, frame, row], mean over the used pixels of a row; 0 where it has none.
    half_means : float64 [exposure, frame, 2], mean over the dimmer and over the brighter half of the used pixels, by
        the first frame of the exposure; without those near an end of the ADC's range.
    half : int8 [exposure, row, col], 0 for the dimmer half, 1 for the brighter half, −1 for other pixels.
    col_means : float64 [exposure, frame, col], mean over the used pixels of a column; 0 where it has none.
    """

    exposures_us: NDArray[np.int64]
    frames: int
    mean: NDArray[np.float32]
    variance: NDArray[np.float32]
    lowest: NDArray[np.uint16]
    highest: NDArray[np.uint16]
    first: NDArray[np.uint16]
    row_means: NDArray[np.float64]
    half_means: NDArray[np.float64]
    half: NDArray[np.int8]
    col_means: NDArray[np.float64]

    @property
    def exposures_s(self) -> NDArray[np.float64]:
        return self.exposures_us.astype(np.float64) * 1e-6


def measure(
    stack: Frames, used: NDArray[np.bool_], full_scale_dn: int, progress: Progress | None = None
) -> FrameMoments:
    """Read a stack once. Sums of differences from the first frame are whole numbers, hence exact.

    Parameters
    ----------
    stack : the frames.
    used : [row, col], pixels that have an APS value.
    full_scale_dn : largest value of the ADC, DN.
    progress : called with a text and the fraction done.
    """
    exposures, frames, rows, cols = stack.shape
    place = np.argsort(np.argsort(stack.exposures_us))
    mean = np.empty((exposures, rows, cols), np.float32)
    variance = np.empty_like(mean)
    lowest, highest, first = (np.empty((exposures, rows, cols), np.uint16) for _ in range(3))
    row_means, half_means = np.empty((exposures, frames, rows)), np.empty((exposures, frames, 2))
    col_means = np.empty((exposures, frames, cols))
    half = np.empty((exposures, rows, cols), np.int8)
    total = np.empty((rows, cols), np.int32)
    squares = np.empty((rows, cols), np.int64)
    difference = np.empty((rows, cols), np.int32)
    taken = used.astype(np.int32)
    row_pixels, col_pixels = (np.maximum(used.sum(axis=axis), 1) for axis in (1, 0))
    for number, frame in enumerate(stack):
        source, index = divmod(number, frames)
        k = place[source]
        # the first frame of an exposure: what all others are compared with, and the halves of equal light
        if index == 0:
            first[k] = lowest[k] = highest[k] = frame
            total[:], squares[:] = 0, 0
            half[k] = _halves(first[k], used, full_scale_dn)
            halves = [(half[k] == side).astype(np.int32) for side in (0, 1)]
            half_pixels = [max(int(mask.sum()), 1) for mask in halves]
            row_first = (first[k] * taken).sum(axis=1) / row_pixels
            row_means[k, 0] = row_first
            col_first = (first[k] * taken).sum(axis=0) / col_pixels
            col_means[k, 0] = col_first
            half_first = [float((first[k] * m).sum()) / n for m, n in zip(halves, half_pixels, strict=True)]
            half_means[k, 0] = half_first
        else:
            # differences from it are small whole numbers, so that no sum below is rounded
            np.subtract(frame, first[k], out=difference, dtype=np.int32)
            row_means[k, index] = row_first + np.einsum("ij,ij->i", difference, taken) / row_pixels
            col_means[k, index] = col_first + np.einsum("ij,ij->j", difference, taken) / col_pixels
            for side, mask in enumerate(halves):
                change = np.einsum("ij,ij->i", difference, mask).sum(dtype=np.int64)
                half_means[k, index, side] = half_first[side] + change / half_pixels[side]
            total += difference
            np.multiply(difference, difference, out=difference)
            squares += difference
            np.minimum(lowest[k], frame, out=lowest[k], casting="unsafe")
            np.maximum(highest[k], frame, out=highest[k], casting="unsafe")
        # the last frame: the sums become mean and variance
        if index == frames - 1:
            shift = total / frames
            mean[k] = shift + first[k]
            variance[k] = (squares - shift * total) / (frames - 1)
            if progress is not None:
                progress(f"reading {stack.file.name}", (source + 1) / exposures)
    return FrameMoments(
        np.sort(stack.exposures_us), frames, mean, variance, lowest, highest, first, row_means, half_means, half,
        col_means,
    )  # fmt: skip


def _halves(first: NDArray[np.uint16], used: NDArray[np.bool_], full_scale_dn: int) -> NDArray[np.int8]:
    """Half of the used pixels to which a pixel belongs: 0 the dimmer, 1 the brighter, −1 neither."""
    clear = used & (first > 0) & (first < _CLEAR * full_scale_dn)
    middle = np.median(first[clear]) if clear.any() else 0.0
    return np.where(clear, (first > middle).astype(np.int8), np.int8(-1)).astype(np.int8)

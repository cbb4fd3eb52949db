"""Mean and variance over repeated frames, per pixel and exposure, in one pass over the stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.captures import FrameStack

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Moments:
    """Statistics of a stack of frames, exposures in increasing order.

    Attributes
    ----------
    exposures_us : int64 [exposure].
    frames : frames per exposure.
    mean, variance : float32 [exposure, row, col], DN and DN² (ddof 1, the ADC's 1/12 still in).
    lowest, highest : uint16 [exposure, row, col], extremes over the frames: they tell clipping.
    first : uint16 [exposure, row, col], the first frame, for distributions of single values.
    frame_means : float64 [exposure, frame], to see the light drift.
    """

    exposures_us: NDArray[np.int64]
    frames: int
    mean: NDArray[np.float32]
    variance: NDArray[np.float32]
    lowest: NDArray[np.uint16]
    highest: NDArray[np.uint16]
    first: NDArray[np.uint16]
    frame_means: NDArray[np.float64]

    @property
    def exposures_s(self) -> NDArray[np.float64]:
        return self.exposures_us.astype(np.float64) * 1e-6


def measure(stack: FrameStack, progress: Progress | None = None) -> Moments:
    """Read a stack once. Sums of differences from the first frame are whole numbers, hence exact."""
    exposures, frames, rows, cols = stack.shape
    place = np.argsort(np.argsort(stack.exposures_us))
    mean = np.empty((exposures, rows, cols), np.float32)
    variance = np.empty_like(mean)
    lowest, highest, first = (np.empty((exposures, rows, cols), np.uint16) for _ in range(3))
    frame_means = np.empty((exposures, frames))
    total = np.empty((rows, cols), np.int32)
    squares = np.empty((rows, cols), np.int64)
    difference = np.empty((rows, cols), np.int32)
    for number, frame in enumerate(stack):
        source, index = divmod(number, frames)
        k = place[source]
        if index == 0:
            first[k] = lowest[k] = highest[k] = frame
            total[:], squares[:] = 0, 0
        else:
            np.subtract(frame, first[k], out=difference, dtype=np.int32)
            total += difference
            np.multiply(difference, difference, out=difference)
            squares += difference
            np.minimum(lowest[k], frame, out=lowest[k], casting="unsafe")
            np.maximum(highest[k], frame, out=highest[k], casting="unsafe")
        frame_means[k, index] = frame.mean()
        if index == frames - 1:
            shift = total / frames
            mean[k] = shift + first[k]
            variance[k] = (squares - shift * total) / (frames - 1)
            if progress is not None:
                progress(f"reading {stack.file.name}", (source + 1) / exposures)
    return Moments(np.sort(stack.exposures_us), frames, mean, variance, lowest, highest, first, frame_means)

"""What a run asks of its source of flux, and the estimate of what that takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_pixels
from hesim_render.mosaic.schedule import BlockSample, Exposure


@dataclass(frozen=True)
class Demand:
    """What a run asks for.

    Parameters
    ----------
    duration_us : length of the run, µs.
    event_pixel, blocks : [n] mosaic indices of event pixels, and a sample of the run's blocks of windows.
    frame_pixel, exposures : [n] mosaic indices of frame pixels, and the exposures of the run.
    """

    duration_us: int
    event_pixel: NDArray[np.uint32]
    blocks: BlockSample
    frame_pixel: NDArray[np.uint32]
    exposures: Sequence[Exposure]

    @property
    def pixels(self) -> NDArray[np.uint32]:
        """Mosaic indices of all pixels that are asked for, each once; those of frames only where there is one."""
        return distinct_pixels(self.frame_pixel if self.exposures else self.frame_pixel[:0], self.event_pixel)


@dataclass(frozen=True)
class Estimate:
    """Estimated time and memory of a run, right to about a factor of two.

    Parameters
    ----------
    seconds : time of the rays, or of the whole run (`hesim_render.capture.overheads`), s.
    peak_bytes : peak memory, bytes.
    rays : total number of rays.
    held_bytes : part of the memory that each part of the light needs anew, bytes.
    """

    seconds: float
    peak_bytes: float
    rays: float
    held_bytes: float = 0.0

    @classmethod
    def together(cls, parts: Sequence[Estimate]) -> Estimate:
        """Of a run whose light has several parts, each of which is asked for all of it."""
        return cls(
            seconds=sum(part.seconds for part in parts),
            peak_bytes=parts[0].peak_bytes + sum(part.held_bytes for part in parts[1:]),
            rays=sum(part.rays for part in parts),
            held_bytes=sum(part.held_bytes for part in parts),
        )

    def __str__(self) -> str:
        if self.seconds < 90:
            duration = f"{max(1, round(self.seconds))} s"
        elif self.seconds < 5400:
            duration = f"{self.seconds / 60:.0f} min"
        else:
            duration = f"{self.seconds / 3600:.1f} h"
        return f"about {duration}, {self.peak_bytes / 1e9:.1f} GB, {self.rays / 1e6:.0f} million rays"

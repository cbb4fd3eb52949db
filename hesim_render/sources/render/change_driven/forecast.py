"""Forecast of the time and memory of a run, from pilot passes over a few patches of the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_pixels
from hesim_render.core.progress import Progress
from hesim_render.mosaic.schedule import BlockSample, Exposure
from hesim_render.sources.render.change_driven.anchor import anchor_us, period_us
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

#: Number of patches, side of a patch, px, and number of blocks over the run, in which rays are counted.
_PATCHES, _SIDE, _BLOCKS = 6, 12, 3
#: Memory of the program with its kernels, per event pixel and window of a block, and per event pixel and frame pixel
#: of the stages, bytes.
_BASE_BYTES, _WINDOW_BYTES, _EVENT_BYTES, _FRAME_BYTES = 0.6e9, 14, 110, 60


@dataclass(frozen=True)
class Estimate:
    """Estimated time and memory of a run, right to about a factor of two.

    Parameters
    ----------
    seconds : time of the rays, or of the whole run (`hesim_render.capture.overheads`), s.
    peak_bytes : peak memory, bytes.
    rays : total number of rays.
    """

    seconds: float
    peak_bytes: float
    rays: float

    def __str__(self) -> str:
        if self.seconds < 90:
            duration = f"{max(1, round(self.seconds))} s"
        elif self.seconds < 5400:
            duration = f"{self.seconds / 60:.0f} min"
        else:
            duration = f"{self.seconds / 3600:.1f} h"
        return f"about {duration}, {self.peak_bytes / 1e9:.1f} GB, {self.rays / 1e6:.0f} million rays"


def forecast(
    sources: Sequence[ChangeDrivenFlux],
    event_pixel: NDArray[np.uint32],
    blocks: BlockSample,
    frame_pixel: NDArray[np.uint32],
    exposures: Sequence[Exposure],
    progress: Progress | None = None,
) -> Estimate:
    """Forecast the time of the rays of a run, and its memory.

    Parameters
    ----------
    sources : renderers of one scene; the whole run is asked of each.
    event_pixel, blocks : [n] mosaic indices of event pixels, and a sample of the run's blocks of windows.
    frame_pixel, exposures : [n] mosaic indices of frame pixels, and the exposures of the run.
    progress : called with (done, total, what).

    Returns
    -------
    The estimate.
    """
    is_static = sources[0].is_static
    rng = np.random.default_rng(sources[0].seed)
    rays = rate = 0.0
    windows = 0
    for number, source in enumerate(sources):
        if progress is not None:
            progress(number, len(sources), "estimate")
        if event_pixel.size and blocks.blocks:
            every = blocks.blocks
            windows = max(block.wanted.size for block in every)
            chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, _BLOCKS).astype(int))]
            patch = _patches(event_pixel, source, rng)
            # the last block goes beyond the end of the run, which counts where all blocks are looked at
            is_all = len(chosen) == len(every)
            ends = [int(np.flatnonzero(b.wanted)[-1]) if is_all and b.wanted.any() else None for b in chosen]
            each, anchors = zip(
                *(
                    source.foretell(patch, block.begin_us, block.end_us, "events", end)
                    for block, end in zip(chosen, ends, strict=True)
                ),
                strict=True,
            )
            # all pixels are rendered in the first anchor, and in later ones those that are compared with it
            begin, end = anchor_us(every[0].begin_us, every[0].end_us)
            first, _ = source.foretell(patch, np.array([begin]), np.array([end]), "events", is_anchor=True)
            share = np.mean([np.ptp(block.end_us) / period_us(block.end_us) for block in chosen])
            more_anchors = max(0.0, float(np.ceil(blocks.count * share)) - 1)
            each_pixel = first + float(np.mean(anchors)) * more_anchors + float(np.mean(each)) * blocks.count
            rays += each_pixel * event_pixel.size
        pixel = distinct_pixels(
            frame_pixel if exposures else frame_pixel[:0], event_pixel if is_static else event_pixel[:0]
        )
        if pixel.size:
            patch = _patches(pixel, source, rng)
            begin, end = (0.0, 1000.0) if not exposures else (float(exposures[0].start_us), float(exposures[0].t_us))
            each_frame, _ = source.foretell(patch, np.array([begin]), np.array([end]), "any")
            rays += each_frame * pixel.size * (1 if is_static else len(exposures))
        rate = max(rate, source.rays_per_second())
    held = _WINDOW_BYTES * windows * event_pixel.size * len(sources)
    return Estimate(
        seconds=rays / max(rate, 1.0),
        peak_bytes=_BASE_BYTES + held + _EVENT_BYTES * event_pixel.size + _FRAME_BYTES * frame_pixel.size,
        rays=rays,
    )


def _patches(pixel: NDArray[np.uint32], source: ChangeDrivenFlux, rng: np.random.Generator) -> NDArray[np.uint32]:
    """Listed pixels in some small squares. Squares keep neighbours together, as in the run."""
    row, col = np.divmod(pixel.astype(np.int64), source.sensor.cols)
    side = _SIDE * max(1.0, np.sqrt(source.sensor.rows * source.sensor.cols / pixel.size))
    found = np.zeros(pixel.size, np.bool_)
    for centre in rng.choice(pixel.size, _PATCHES):
        found |= (np.abs(row - row[centre]) <= side / 2) & (np.abs(col - col[centre]) <= side / 2)
    return pixel[found]

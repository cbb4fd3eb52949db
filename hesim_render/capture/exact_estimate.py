"""Estimate of a run in the exact mode: its rays by count, its speed from a few rays."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hesim_render.capture.loop import Capture
from hesim_render.core.distinct import distinct_pixels
from hesim_render.sources.render.change_driven.forecast import Estimate

#: Exposures whose slices are counted; pixels that are rendered to find the speed, at most.
_EXPOSURES, _PIXELS = 16, 16384
#: Memory of the program with its kernels, and per pixel of the mosaic, bytes.
_BASE_BYTES, _PIXEL_BYTES = 0.6e9, 110


def estimate_exact(flux: Any, capture: Capture, samples: int) -> Estimate:
    """Time, memory and rays of a run in which every pixel of every slice gets the same number of rays.

    The pictures that are rendered for it are no part of the run, whose values are pure functions of seed and pixel.

    Parameters
    ----------
    flux : source of the run, from `flux_source`.
    capture : the run.
    samples : rays per pixel and slice.

    Returns
    -------
    The estimate, right to about a factor of two.
    """
    parts = getattr(flux, "sources", (flux,))
    frame_pixel, exposures = capture.frame_exposures
    events = capture.event_pixels.size
    if parts[0].is_static:
        values = float(distinct_pixels(frame_pixel if exposures else frame_pixel[:0], capture.event_pixels).size)
    else:
        values = events * capture.sample_of_event_blocks().windows
        if exposures:
            some = [exposures[k] for k in np.unique(np.linspace(0, len(exposures) - 1, _EXPOSURES).astype(int))]
            # a rolling shutter exposes a row in only some of the slices of its frame
            slices = [
                1 + len(flux.slice_edges_us(e.start_us, e.end_us)) * e.exposure_us / (e.end_us - e.start_us)
                for e in some
            ]
            values += frame_pixel.size * len(exposures) * float(np.mean(slices))
    rays = values * samples * len(parts)
    return Estimate(
        seconds=rays / _rays_per_second(parts[0], capture, samples),
        peak_bytes=_BASE_BYTES + _PIXEL_BYTES * (frame_pixel.size + events),
        rays=rays,
    )


def _rays_per_second(part: Any, capture: Capture, samples: int) -> float:
    """Speed of a small picture; a first one compiles the kernels, which the run needs as well."""
    import drjit as dr

    every = distinct_pixels(capture.frame_exposures[0], capture.event_pixels)
    count = min(every.size, max(1, _PIXELS // max(1, samples // 16)))
    pixel = every[np.linspace(0, every.size - 1, count).astype(int)]
    begin, end = np.zeros(count), np.full(count, 1.0)
    seconds = 1.0
    for _ in range(2):
        start = time.perf_counter()
        dr.eval(*part.mean_flux(pixel, begin, end))
        dr.sync_thread()
        seconds = time.perf_counter() - start
    return count * samples / max(seconds, 1e-6)

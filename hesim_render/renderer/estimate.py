"""What a run will take, from a few pixels rendered beforehand."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.coherent import CoherentFlux
from hesim_render.renderer.refinement import BYTES_PER_PAIR, chunk_length
from hesim_render.renderer.sketch import generous
from hesim_render.schedule import Exposure

#: Pixels tried, and pairs of neighbouring windows, spread over the run; pixels that measure the speed.
_PIXELS, _PLACES, _PIXELS_FOR_SPEED = 1024, 4, 16384
#: Windows that are rendered for each one in which a pixel changes, its neighbours' in space and time included.
_PER_CHANGE = 2.5
#: Memory of the program with its kernels, and per event pixel and frame pixel of the stages, bytes.
_BASE_BYTES, _EVENT_BYTES, _FRAME_BYTES = 0.55e9, 90, 60


@dataclass(frozen=True)
class Estimate:
    """What a run will take, right to about a factor of two.

    Parameters
    ----------
    seconds : of rendering.
    peak_bytes : of memory.
    rays : in all.
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


def estimate(
    flux: CoherentFlux,
    event_pixel: NDArray[np.uint32],
    begin_us: NDArray[np.float64],
    end_us: NDArray[np.float64],
    frame_pixel: NDArray[np.uint32],
    exposures: list[Exposure],
) -> Estimate:
    """Time and memory of a run.

    Parameters
    ----------
    event_pixel, begin_us, end_us : what `flux_of_windows` will be asked for.
    frame_pixel, exposures : the frames.
    """
    rng = np.random.default_rng(flux.seed)
    rays = 0.0

    def tried(pixel: NDArray[np.uint32], begin: float, end: float) -> tuple[NDArray, float]:
        """Flux of some pixels, and the rays that each of them took."""
        before = flux.rays_traced
        half_a, half_b = flux.mean_flux(pixel, begin, end)
        return 0.5 * (np.array(half_a) + np.array(half_b)), (flux.rays_traced - before) / max(1, pixel.size)

    def some(pixel: NDArray[np.uint32], most: int = _PIXELS) -> NDArray[np.uint32]:
        return np.sort(rng.choice(pixel, min(most, pixel.size), replace=False))

    if event_pixel.size and begin_us.size:
        chosen = some(event_pixel)
        if flux.is_static or begin_us.size == 1:
            rays += tried(chosen, begin_us[0], end_us[0])[1] * event_pixel.size
        else:
            per_pair, changed = [], []
            for place in np.linspace(0, begin_us.size - 2, min(_PLACES, begin_us.size - 1)).astype(int):
                first, n = tried(chosen, begin_us[place], end_us[place])
                second, m = tried(chosen, begin_us[place + 1], end_us[place + 1])
                per_pair += [n, m]
                changed.append(np.mean(np.abs(second - first) > flux.change_of_note(chosen, first)))
            share = min(1.0, 1 / chunk_length(event_pixel.size) + _PER_CHANGE * float(np.mean(changed)))
            rays += float(generous(np.mean(per_pair))) * event_pixel.size * (1 + share * (begin_us.size - 1))
    if exposures and frame_pixel.size:
        window = float(exposures[0].start_us), float(exposures[0].t_us)
        per_pair = tried(some(frame_pixel), *window)[1]
        rays += per_pair * frame_pixel.size * (1 if flux.is_static else len(exposures))
    chosen = some(event_pixel if event_pixel.size else frame_pixel, _PIXELS_FOR_SPEED)
    start = time.perf_counter()
    rate = max(1.0, tried(chosen, 0.0, 1.0)[1] * chosen.size) / (time.perf_counter() - start)
    windows = chunk_length(max(1, event_pixel.size)) + 1
    chunk = 0 if flux.is_static else BYTES_PER_PAIR * event_pixel.size * windows
    flux.forget()
    return Estimate(
        seconds=rays / rate,
        peak_bytes=_BASE_BYTES + chunk + _EVENT_BYTES * event_pixel.size + _FRAME_BYTES * frame_pixel.size,
        rays=rays,
    )

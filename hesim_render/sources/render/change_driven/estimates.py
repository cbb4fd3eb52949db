"""What the default source holds of its pixels: flux with both halves and its error, what rests, and what was done."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.error_target import NoiseUnit
from hesim_render.sources.render.change_driven.neighbours import Sites


@dataclass(frozen=True)
class Flux:
    """Flux of pixels in some windows, arrays [window, pixel].

    Parameters
    ----------
    half_a, half_b : two independent estimates, e⁻/s.
    error : expected standard error of their mean, e⁻/s.
    """

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    error: NDArray[np.float32]

    @classmethod
    def zeros(cls, windows: int, pixels: int) -> Flux:
        return cls(*(np.zeros((windows, pixels), np.float32) for _ in range(3)))

    @property
    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        return self.half_a, self.half_b, self.error

    def at(self, place: slice | NDArray) -> Flux:
        """Of some pixels."""
        return Flux(*(values[:, place] for values in self.arrays))

    def put(self, place: slice | NDArray, flux: Flux) -> None:
        """Take the flux of some pixels."""
        for values, found in zip(self.arrays, flux.arrays, strict=True):
            values[:, place] = found


@dataclass
class Still:
    """Pixels of a region whose flux is the same at all times, as far as that is known yet.

    Parameters
    ----------
    span_us : for which it is asked whether anything can come near; None where all may change, or nothing moves at all.
    known : [pixel], which are; `flux`, [1, pixel], theirs.
    """

    span_us: tuple[float, float] | None
    known: NDArray[np.bool_]
    flux: Flux


@dataclass(frozen=True)
class Band:
    """Some of the listed pixels.

    Parameters
    ----------
    place : [n], places in the list.
    sites : the pixels and their neighbours.
    unit : noise of the sites.
    apart : whether the pixels have no neighbours to ask.
    pilot_rays : of each pixel in each window.
    quality : wanted error in units of noise.
    """

    place: NDArray[np.int64]
    sites: Sites
    unit: NoiseUnit
    apart: bool
    pilot_rays: int
    quality: float

    @property
    def index(self) -> NDArray[np.uint32]:
        """Numbers of the pixels on the full sensor."""
        return self.sites.index[self.sites.listed]


@dataclass
class Counts:
    """What was done so far.

    Parameters
    ----------
    pilot_rays, rays : of pilots, and of what they asked for.
    pairs : pairs of a pixel and a window that were rendered.
    values : flux of so many pairs was given; the rest was filled in, or known.
    """

    pilot_rays: int = 0
    rays: int = 0
    pairs: int = 0
    values: int = 0

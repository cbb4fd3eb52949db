"""Data of the default source: flux with both halves and its error, pixels at rest, and counts of the work done."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

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
    def zeros(cls, windows: int, pixels: int) -> "Flux":
        """Flux 0 of all pixels in all windows."""
        return cls(*(np.zeros((windows, pixels), np.float32) for _ in range(3)))

    @property
    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        return self.half_a, self.half_b, self.error

    def at(self, place: slice | NDArray) -> "Flux":
        """Flux of the pixels at some places."""
        return Flux(*(values[:, place] for values in self.arrays))

    def put(self, place: slice | NDArray, flux: "Flux") -> None:
        """Set the flux of the pixels at some places."""
        for values, new in zip(self.arrays, flux.arrays, strict=True):
            values[:, place] = new


class Still:
    """Pixels of a region whose flux is known to be the same at all times.

    Only their flux is held: on a sensor whose event pixels lie apart, these are a small part of all pixels.

    Parameters
    ----------
    span_us : interval in which moving objects are tested for coming near, µs; None where all pixels may change, or
        nothing moves.
    count : number of pixels of the region.

    Attributes
    ----------
    span_us : as given.
    known : [pixel], True where the flux is known to be constant.
    """

    def __init__(self, span_us: tuple[float, float] | None, count: int) -> None:
        self.span_us, self.known = span_us, np.zeros(count, np.bool_)
        #: Known pixels in increasing order, and their flux; then those that came later, in any order.
        self._pixel, self._flux = np.empty(0, np.uint32), Flux.zeros(1, 0)
        self._later: list[tuple[NDArray[np.uint32], Flux]] = []

    def put(self, pixel: NDArray[np.uint32], flux: Flux) -> None:
        """Note some pixels [n] as constant, with their flux [1, n]."""
        self.known[pixel] = True
        self._later.append((pixel, flux))

    def at(self, pixel: NDArray[np.uint32]) -> Flux:
        """Flux of some known pixels, [1, n]."""
        if self._later:
            # sorted once for all that came since; a table of all pixels of the region would take more memory
            pixels, fluxes = zip((self._pixel, self._flux), *self._later, strict=True)
            every = np.concatenate(pixels)
            order = np.argsort(every, kind="stable")
            parts = zip(*(flux.arrays for flux in fluxes), strict=True)
            self._pixel, self._flux = every[order], Flux(*(np.concatenate(part, axis=1)[:, order] for part in parts))
            self._later.clear()
        return self._flux.at(np.searchsorted(self._pixel, pixel))


@dataclass(frozen=True)
class Band:
    """A part of the listed pixels.

    Parameters
    ----------
    place : [n], places in the list.
    sites : the pixels and their neighbours.
    unit : noise unit of the sites.
    apart : True if the pixels have no direct neighbours.
    pilot_rays : pilot rays per pixel and window.
    quality : wanted error in noise units.
    mild : take the mild scatter of the pilot's rays, see `PilotFlux`.
    few_first : few rays say at which sites the pilot takes all of its rays, see `seen_with_few_or_all`.
    """

    place: NDArray[np.int64]
    sites: Sites
    unit: NoiseUnit
    apart: bool
    pilot_rays: int
    quality: float
    mild: bool
    few_first: bool = False

    @property
    def index(self) -> NDArray[np.uint32]:
        """Numbers of the pixels on the full sensor."""
        return self.sites.index[self.sites.listed]


@dataclass
class Counts:
    """Work done so far.

    Parameters
    ----------
    pilot_rays, rays : rays of pilot passes, and of the final render.
    pairs : rendered pairs of a pixel and a window.
    values : pairs whose flux was given out; those not rendered were interpolated or already known.
    """

    pilot_rays: int = 0
    rays: int = 0
    pairs: int = 0
    values: int = 0

    @classmethod
    def sum(cls, parts: "Sequence[Counts]") -> "Counts":
        """Work of several renderers."""
        return cls(*(sum(getattr(part, each.name) for part in parts) for each in fields(cls)))

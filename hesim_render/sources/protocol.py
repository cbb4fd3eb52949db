"""The hinge of the house: who can say how many photo-electrons per second each pixel gets.

Every source answers the calls of `FluxSource`: renders, flickering light, crosstalk, video, what stands still. Nothing
downstream knows which one it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import Float, Halves
from hesim_render.mosaic.schedule import Block


@dataclass(frozen=True)
class Sample:
    """Φ of event pixels in one window.

    Parameters
    ----------
    half_a, half_b : Dr.Jit Float [n], e⁻/s, as `FluxSource.mean_flux` gives them.
    error : [n], e⁻/s, the standard error that the source expects; None where it has none.
    """

    half_a: Float
    half_b: Float
    error: NDArray[np.float32] | None = None


class FluxSource(Protocol):
    """Noise-free photo-electron rate Φ of physical pixels, each through its own filter.

    Frames ask for the mean over each row's exposure (`mean_flux`), piece by piece where the source has slices. Event
    pixels are asked for in many windows at once (`flux_of_blocks`).
    """

    #: True where Φ does not depend on time: one call then serves all times.
    is_static: bool

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` at which the source moves to its next state.

        Between two edges the source may be frozen where it cannot do better (object poses); no `mean_flux` call may
        straddle an edge. Empty for a source that takes intervals of any length.
        """
        ...

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` close enough together to follow the motion.

        The image moves about half a pixel, or less, from one time to the next. Empty for a static source.
        """
        ...

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval, e⁻/s.

        Parameters
        ----------
        pixel : [n] mosaic indices (row · cols + col of the read-out region), any order.
        begin_us, end_us : [n] or scalar, µs, inside one slice.

        Returns
        -------
        half_a, half_b : Dr.Jit Float [n]. Two independent estimates: their mean is the flux, half
            their difference its standard error. Both use the same random numbers at every call, so
            a static pixel is exactly static; therefore accumulate each half over time and compare
            the sums, never add the errors of slices. Exact sources return the same array twice.
        """
        ...

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """Windows in which the pixels of a sensor without a tick of its own are sampled.

        The first one begins when the run begins. The last one ends when the run ends, or at the source's next instant:
        a source whose instants do not depend on begin and end of a run gives the same at a time whatever else it is
        asked for.

        Parameters
        ----------
        window_us : length of a window.
        begin_us, end_us : of the run.
        """
        ...

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """Φ of the same pixels in the wanted windows of successive blocks, one after another.

        Parameters
        ----------
        pixel : [n] mosaic indices.
        blocks : in order of time.
        """
        ...


@runtime_checkable
class AuditableFlux(FluxSource, Protocol):
    """A source whose values can be found again by other random numbers."""

    @property
    def rays_traced(self) -> int:
        """So far."""
        ...

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Which pixels nothing that moves can come near at any time, [n], as far as that is known."""
        ...

    def reference_flux(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        events: bool,
    ) -> NDArray[np.float64]:
        """Mean Φ of each listed pixel in its own window, e⁻/s, by random numbers that the run has not.

        Parameters
        ----------
        quality : wanted error over the sensor's noise, that of events or of exposures.
        """
        ...

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """What one standard deviation of each pixel's noise is worth at a flux [..., n], e⁻/s."""
        ...

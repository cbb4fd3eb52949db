"""The hinge of the house: who can say how many photo-electrons per second each pixel gets.

The renderer and the video path implement `FluxSource`; nothing downstream knows which one it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import Float, Halves
from hesim_render.mosaic.schedule import Block


class FluxSource(Protocol):
    """Noise-free photo-electron rate Φ of physical pixels, each through its own filter."""

    #: True where Φ does not depend on time: one call then serves all times.
    is_static: bool

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` at which the source moves to its next state.

        Between two edges the source may be frozen where it cannot do better (object poses); callers
        must not let one `mean_flux` call straddle an edge.
        """
        ...

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` close enough together to follow the motion.

        For sensors without a tick of their own: the image moves about half a pixel, or less, from
        one time to the next. Empty for a static source.
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


@runtime_checkable
class SampledFlux(FluxSource, Protocol):
    """A source that is better asked for many windows at once than for one after another.

    It has no slice edges: `mean_flux` takes intervals of any length. What it gives at a time is the same whatever else
    it is asked for: `instants_us` and the cuts between blocks do not depend on begin and end of a run.
    """

    def instants_us(self, begin_us: float, end_us: float) -> NDArray[np.int64]:
        """Whole µs, from `begin_us` to `end_us` with both, at which sensors without a tick of their own are sampled.

        Multiples of `schedule.CELL_US` are among them.
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
class AuditableFlux(SampledFlux, Protocol):
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

"""The protocol of flux sources, which separates light from sensors.

Every source implements `FluxSource`: renders, flickering light, crosstalk, video, static scenes. The capture does not
know which one it uses.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.device_types import Float, Halves
from hesim_render.mosaic.schedule import Block
from hesim_render.spectral.waveform import Waveform


@dataclass(frozen=True)
class Sample:
    """Φ of event pixels in one window.

    Parameters
    ----------
    half_a, half_b : Dr.Jit Float [n], e⁻/s, as from `FluxSource.mean_flux`.
    error : [n], e⁻/s, the standard error that the source states; None where it states none.
    """

    half_a: Float
    half_b: Float
    error: NDArray[np.float32] | None = None


class FluxSource(Protocol):
    """Noise-free photo-electron rate Φ of physical pixels, each through its own filter.

    Frames use the mean over each row's exposure (`mean_flux`), piece by piece if the source has slices. Event pixels
    use many windows at once (`flux_of_blocks`).
    """

    #: True if Φ does not depend on time; one call then serves all times.
    is_static: bool

    def slice_edges_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` at which the source changes to its next state, µs.

        Between two edges a source may be frozen (object poses), so a `mean_flux` call must not span an edge. The result
        is empty for a source that takes intervals of any length.
        """

    def sample_times_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly between `begin_us` and `end_us` that are dense enough to follow the motion, µs.

        The image moves about half a pixel or less from one time to the next. The result is empty for a static source.
        """

    def mean_flux(self, pixel: NDArray[np.uint32], begin_us: ArrayLike, end_us: ArrayLike) -> Halves:
        """Mean Φ of each listed pixel over its own interval, e⁻/s.

        Parameters
        ----------
        pixel : [n] mosaic indices (row · cols + col of the read-out region), any order.
        begin_us, end_us : [n] or scalar, µs, inside one slice.

        Returns
        -------
        half_a, half_b : Dr.Jit Float [n], two independent estimates. Their mean is the flux, half their difference its
            standard error. Both use the same random numbers in every call, so a static pixel is exactly constant.
            Therefore add up each half over time and compare the sums; do not add the errors of slices. Exact sources
            return the same array twice.
        """

    def sample_blocks(self, window_us: int, begin_us: int, end_us: int) -> Iterator[Block]:
        """Windows in which the pixels of a sensor without a tick are sampled.

        The first window begins when the run begins. The last one ends when the run ends, or at the source's next
        instant. A source whose instants do not depend on the begin and end of a run gives the same flux at a time,
        whatever else it is asked for.

        Parameters
        ----------
        window_us : length of a window, µs.
        begin_us, end_us : begin and end of the run, µs.

        Yields
        ------
        Blocks of windows, in order of time.
        """

    def flux_of_blocks(self, pixel: NDArray[np.uint32], blocks: Iterable[Block]) -> Iterator[Sample]:
        """Φ of the same pixels in the wanted windows of successive blocks, one after another.

        Parameters
        ----------
        pixel : [n] mosaic indices.
        blocks : in order of time.

        Yields
        ------
        One `Sample` per wanted window.
        """


@runtime_checkable
class WeightedFlux(Protocol):
    """A source that weights its means over intervals with the waveform of its light itself; None: of steady light."""

    light: Waveform | None


@runtime_checkable
class AuditableFlux(FluxSource, Protocol):
    """A source whose values can be estimated again with other random numbers."""

    @property
    def rays_traced(self) -> int:
        """Number of rays traced so far."""

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Event pixels [n] that are known to be constant: no moving object can come near them at any time."""

    def reference_flux(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        events: bool,
    ) -> NDArray[np.float64]:
        """Mean Φ of each listed pixel in its own window, and its error, with random numbers that the run does not use.

        Parameters
        ----------
        pixel : [n], mosaic indices.
        begin_us, end_us : [n], the windows, µs.
        quality : wanted error over the sensor's noise.
        events : True for the noise of events, False for that of exposures.

        Returns
        -------
        [2, n], e⁻/s: the flux, and half the difference of its two halves.
        """

    def reference_changes(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        needed: NDArray[np.bool_],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """As `reference_flux`, of event pixels in several windows each, for the changes between these.

        Parameters
        ----------
        pixel : [n], mosaic indices.
        begin_us, end_us : [window, n], µs.
        needed : [window, n], values that are wanted; all others are 0.
        base : number of the window from which changes are counted.
        quality : wanted error of a change of ln x over the sensor's noise. The level may be off by more in all windows
            of a pixel alike.

        Returns
        -------
        [2, window, n], e⁻/s: the flux, and half the difference of its two halves.
        """

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """Change of flux equal to one standard deviation of each pixel's noise, at a flux [..., n], e⁻/s."""

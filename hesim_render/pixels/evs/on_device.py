"""Parameters of each event pixel on the device, for the event stage: thresholds, keys and coefficients."""

from collections.abc import Callable
from copy import copy

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32, device_namespace
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.arrays import take, to_device
from hesim_render.pixels.evs import formulas
from hesim_render.pixels.evs.formulas import Coefficients, ShotLaw
from hesim_render.specs.event_pixels import PhotoreceptorSpec

Map = float | NDArray[np.float32]


class EventPixels:
    """Parameters over the event pixels of a region, row-major on the event grid.

    Parameters
    ----------
    layout : the region.
    table : coefficients of each event position [position], for electrons of a window.
    law : law of the shot noise.
    thresholds : θ₊ and θ₋ in ln units, maps or numbers.
    reference_level : [position], β1 times the signal at which the photoreceptor's corner is largest; None where no
        corner follows the light.
    noise_filter : the photoreceptor, where it filters the noise as well; otherwise None.
    bandwidth_hz : of the noise that no photoreceptor has filtered.

    Attributes
    ----------
    key : full-sensor index of each pixel, UInt32; random numbers are keyed by it.
    thresholds : θ₊ and θ₋, Floats; arrays of one entry where all pixels have the same.
    """

    def __init__(
        self,
        layout: Layout,
        table: Coefficients,
        law: ShotLaw,
        thresholds: tuple[Map, Map],
        reference_level: NDArray[np.float64] | None,
        noise_filter: PhotoreceptorSpec | None,
        bandwidth_hz: float | None,
    ) -> None:
        self._law = law
        self.key: UInt32 = from_host(jit().UInt32, layout.full_index.ravel()[layout.evs_pixel.ravel()])
        self.thresholds: tuple[Float, Float] = (to_device(thresholds[0]), to_device(thresholds[1]))
        of_position = _by_position(layout)
        self._coefficients = table.each(of_position)
        self._reference_level: Float = None if reference_level is None else of_position(reference_level)
        self._noise_filter, self._bandwidth_hz = noise_filter, bandwidth_hz

    def at(self, pixel: UInt32) -> "EventPixels":
        """The same of some pixels."""
        some = copy(self)
        some.key = take(self.key, pixel)
        some.thresholds = take(self.thresholds[0], pixel), take(self.thresholds[1], pixel)
        some._coefficients = self._coefficients.each(lambda values: take(values, pixel))
        some._reference_level = None if self._reference_level is None else take(self._reference_level, pixel)
        return some

    def log_level(self, electrons: Float) -> tuple[Float, Float]:
        """`EvsNoise.log_level`."""
        xp = device_namespace()
        log, variance = formulas.log_level(self._coefficients, electrons, self._law, xp)
        if self._noise_filter is not None:
            corner_hz = self.corner_hz(log, self._noise_filter, self._bandwidth_hz or 0.0)
            variance *= xp.minimum(corner_hz / self._bandwidth_hz, 1.0)
        return log, variance

    def corner_hz(self, log: Float, spec: PhotoreceptorSpec, limit_hz: float = 0.0) -> Float:
        """Corner of each pixel's photoreceptor at ln x, Hz; `limit_hz` as for `EvsNoise.corner_hz`."""
        assert spec.min_cutoff_hz is not None
        limits = spec.min_cutoff_hz, spec.cutoff_hz
        pixels = self._coefficients, log, self._reference_level
        return formulas.corner_hz(*pixels, *limits, device_namespace(), spec.series_hz(limit_hz))

    @property
    def log_of_largest_corner(self) -> Float:
        """ln x from which on a photoreceptor's corner is its largest."""
        return dr.log(self._reference_level + self._coefficients.base)


def _by_position(layout: Layout) -> Callable[[NDArray[np.float64]], Float]:
    """Function that spreads values [position] over the pixels.

    The function gives an opaque number where all positions agree, and a look-up table by position otherwise.
    """
    position: UInt32 = None

    def spread(values: NDArray[np.float64]) -> Float:
        nonlocal position
        if np.all(values == values[0]):
            return to_device(values[0])
        if position is None:
            position = from_host(jit().UInt32, layout.evs_position)
            dr.eval(position)
        return dr.gather(jit().Float, to_device(values), position)

    return spread

"""Parameters of each event pixel on the device, for the event stage: thresholds, keys and coefficients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.namespace import device_namespace
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.arrays import to_device
from hesim_render.pixels.evs import formulas
from hesim_render.pixels.evs.formulas import Coefficients, ShotLaw
from hesim_render.specs.photoreceptor import PhotoreceptorSpec

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
    noise_level : [position], β1 times the signal above which the photoreceptor leaves the noise as it is, and least
        part of its variance that it leaves; None where it does not filter the noise.

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
        noise_level: tuple[NDArray[np.float64], float] | None,
    ) -> None:
        self._law = law
        self.key: UInt32 = jit().UInt32(layout.full_index.ravel()[layout.evs_pixel.ravel()])
        self.thresholds: tuple[Float, Float] = (to_device(thresholds[0]), to_device(thresholds[1]))
        of_position = _by_position(layout)
        self._coefficients = table.each(of_position)
        self._reference_level: Float = None if reference_level is None else of_position(reference_level)
        self._noise_level = None if noise_level is None else (of_position(noise_level[0]), noise_level[1])

    def log_level(self, electrons: Float) -> tuple[Float, Float]:
        """`EvsNoise.log_level`."""
        xp = device_namespace()
        log, variance = formulas.log_level(self._coefficients, electrons, self._law, xp)
        if self._noise_level is not None:
            variance *= formulas.corner_hz(self._coefficients, log, *self._noise_level, 1.0, xp)
        return log, variance

    def corner_hz(self, log: Float, spec: PhotoreceptorSpec) -> Float:
        """Corner of each pixel's photoreceptor at ln x: f_c·I/signal_dn between the file's two limits."""
        assert spec.min_cutoff_hz is not None
        limits = spec.min_cutoff_hz, spec.cutoff_hz
        return formulas.corner_hz(self._coefficients, log, self._reference_level, *limits, device_namespace())

    def limits_of_corner(self, spec: PhotoreceptorSpec) -> tuple[Float, Float]:
        """ln x up to which a photoreceptor's corner is its least, and from which on it is its largest."""
        import drjit as dr

        assert spec.min_cutoff_hz is not None
        base, level = self._coefficients.base, self._reference_level
        return dr.log(dr.fma(level, spec.min_cutoff_hz / spec.cutoff_hz, base)), dr.log(level + base)


def _by_position(layout: Layout) -> Callable[[NDArray[np.float64]], Float]:
    """Function that spreads values [position] over the pixels.

    The function gives an opaque number where all positions agree, and a look-up table by position otherwise.
    """
    import drjit as dr

    position: UInt32 = None

    def spread(values: NDArray[np.float64]) -> Float:
        nonlocal position
        if np.all(values == values[0]):
            return to_device(values[0])
        if position is None:
            position = jit().UInt32(layout.evs_position.ravel().astype(np.uint32))
            dr.eval(position)
        return dr.gather(jit().Float, to_device(values), position)

    return spread

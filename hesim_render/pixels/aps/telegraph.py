"""Random telegraph noise: frame pixels whose value jumps between two levels from frame to frame.

A single trap near the channel of the source follower that is filled or empty produces two levels [wang2006]. The state
of a pixel is taken when a frame begins, at frame / frame_rate_hz, and holds for its whole exposure. The mean of the
levels over time is the pixel's own mean: offset and dark current do not change.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_uniform
from hesim_render.core.units import US_PER_S
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.aps import formulas
from hesim_render.pixels.measured import telegraph_rates
from hesim_render.pixels.poisson_points import Telegraph
from hesim_render.specs.frame_pixels import ApsSpec


@dataclass(frozen=True, eq=False)
class TelegraphPixels:
    """Pixels of a region with random telegraph noise.

    Attributes
    ----------
    place, key : [n], index of each pixel in the region, row-major, and on the full sensor.
    amplitude_dn : [n], high level minus low level, DN.
    high_share : [n], fraction of the time at the high level.
    change_hz : [n], 1/(mean time high) + 1/(mean time low), Hz.
    frame_us : time from one frame to the next, µs.
    """

    place: NDArray[np.intp]
    key: NDArray[np.uint32]
    amplitude_dn: NDArray[np.float64]
    high_share: NDArray[np.float64]
    change_hz: NDArray[np.float64]
    frame_us: float

    @property
    def variance_dn2(self) -> NDArray[np.float64]:
        """[n], temporal variance, DN²."""
        return formulas.telegraph_variance(self.amplitude_dn, self.high_share)

    def values_dn(self, seed: int, frame: int) -> NDArray[np.float64]:
        """Deviations from the mean in a frame, DN [n]: a pure function of seed, device and frame."""
        every = np.arange(self.place.size)
        signal = Telegraph(seed, Stream.TELEGRAPH, self.key, self.change_hz, self.high_share)
        # two levels about a mean of 0, and which of them holds at the time of the frame
        high = signal.is_high(every, np.full(every.size, frame * self.frame_us))
        return np.where(high, *formulas.telegraph_levels(self.amplitude_dn, self.high_share)[::-1])

    def added_dn(self, seed: int, frame: int, pixels: int, index: UInt32) -> Float:
        """Deviations from the mean in a frame on the device, DN; 0 at pixels without telegraph noise.

        Parameters
        ----------
        seed, frame : seed of the noise and number of the frame.
        pixels : number of pixels of the region.
        index : pixels that are asked for.
        """
        types = jit()
        # few pixels have this noise: the host computes them, and zeros fill the region
        every = dr.zeros(types.Float, pixels)
        values = from_host(types.Float, self.values_dn(seed, frame))
        dr.scatter(every, values, from_host(types.UInt32, self.place))
        return dr.gather(types.Float, every, index)


def telegraph_pixels(spec: ApsSpec, layout: Layout, device_seed: int) -> TelegraphPixels | None:
    """Pixels of a device with telegraph noise; None without any.

    They are taken from a calibration where it has measured them, and drawn from the device seed otherwise.
    """
    frame_us, measured = US_PER_S / spec.frame_rate_hz, telegraph_rates(layout)
    if measured is not None:
        every = measured.amplitude_dn, measured.high_share, measured.change_hz
        amplitude, share, change_hz = (values.ravel().astype(np.float64) for values in every)
        # an amplitude of 0 says that a pixel has none
        place = np.flatnonzero(amplitude > 0)
        result = amplitude[place], share[place], change_hz[place]
    elif spec.telegraph is not None:
        given = spec.telegraph
        key = layout.full_index.ravel()
        # which pixels have it, and how much, is a property of the device: no value depends on the region
        place = np.flatnonzero(device_uniform(device_seed, Stream.TELEGRAPH_SHARE, key) < given.share)
        amplitude = np.full(place.size, spec.system_gain_dn_per_e * given.amplitude_e)
        if given.amplitude_law == "exponential":
            amplitude *= -np.log(device_uniform(device_seed, Stream.TELEGRAPH_AMPLITUDE, key[place]))
        # mean times in both states give the share of the high one and the rate of change
        share = np.full(place.size, given.high_s / (given.high_s + given.low_s))
        change_hz = np.full(place.size, 1.0 / given.high_s + 1.0 / given.low_s)
        result = amplitude, share, change_hz
    else:
        return None
    return TelegraphPixels(place, layout.full_index.ravel()[place], *result, frame_us) if place.size else None

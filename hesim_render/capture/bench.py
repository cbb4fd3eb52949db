"""The bench of a virtual calibration session: a sensor, a test target of many brightness levels, and its light.

The light is a closed form, without a render: a neutral target in front of a Lambertian source of a named
illuminant. The flux of each pixel is Eq. 1 through its own filter times the target's
transmittance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.noise_terms import noise_models
from hesim_render.core.errors import RangeError
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.pixels.aps.model import ApsNoise
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.sensor.photocurrent import photocurrent
from hesim_render.sensor.sensor import Sensor
from hesim_render.sources.crosstalk import mixed
from hesim_render.spectral import spectrum as spectra

#: Density from one patch of the wedge to the next, and the number of patches (4 rows of 6).
_DENSITY_STEP, _PATCHES = 0.15, 24
_DARKEST = 10 ** (-_DENSITY_STEP * _PATCHES)
#: Signal of the brightest patch over saturation, at the geometric mean of the shortest and longest exposure.
_BRIGHTEST = 0.9
#: Brightest event signal of a sensor without frames, in DN of the signal reference.
_BRIGHTEST_EVENT_DN = 1000.0


def step_target(rows: int, cols: int) -> NDArray[np.float64]:
    """Transmittance [row, col] of the target: a step wedge above a linear and a logarithmic ramp.

    The upper half holds 24 neutral patches at density steps of 0.15, in four rows of alternating direction. The third
    quarter rises linearly from almost 0 at the left to 1 at the right, the last one uniformly in density over 3.6.
    """
    y, x = np.ogrid[:rows, :cols]
    band, along = np.minimum(y * 8 // rows, 3), x * 6 // cols
    patch = band * 6 + np.where(band % 2 == 0, along, 5 - along)
    across = (x + 0.5) / cols
    ramp = np.where(y * 4 < rows * 3, _DARKEST + (1 - _DARKEST) * across, _DARKEST ** (1 - across))
    return np.where(y * 2 < rows, 10.0 ** (-_DENSITY_STEP * patch), ramp)


@dataclass(frozen=True)
class Bench:
    """A sensor in front of the target.

    Parameters
    ----------
    sensor : the sensor.
    flux_e_per_s : [row, col], noise-free flux of the lit scene through each pixel's own filter, before crosstalk, e⁻/s.
    lux : illuminance that gives the brightest patch its radiance, E = π·L over the source's spectrum, lx.
    aps, evs : noise models of the captured pixels, None for a kind that is not captured.
    """

    sensor: Sensor
    flux_e_per_s: NDArray[np.float64]
    lux: float
    aps: ApsNoise | None
    evs: EvsNoise | None

    @property
    def frame_flux_e_per_s(self) -> NDArray[np.float64]:
        """Flux of the frame pixels with their crosstalk, [row, col], e⁻/s."""
        return mixed(self.flux_e_per_s, self.aps.crosstalk if self.aps is not None else 0.0)

    @property
    def event_dn_per_e_per_s(self) -> NDArray[np.float64]:
        """I / Φ of every event pixel, [y, x]: k · t_ref of the signal reference, times the ratio of its filter's
        response to the pixel's own.
        """
        assert self.evs is not None
        reference = self.evs.spec.signal_reference
        scale = np.asarray(self.evs.signal_scale)[self.sensor.layout.evs_position]
        return reference.k_dn_per_e * reference.t_ref_us * S_PER_US * scale

    @property
    def event_signal_dn(self) -> NDArray[np.float64]:
        """Clean signal of every event pixel, [y, x], DN of the signal reference."""
        flux = mixed(self.flux_e_per_s, self.evs.crosstalk if self.evs is not None else 0.0)
        return flux.ravel()[self.sensor.layout.evs_pixel] * self.event_dn_per_e_per_s


def set_up(
    sensor: Sensor, lit_exposures_us: Sequence[int], illuminant: str = "D65", without: Sequence[str] = ()
) -> Bench:
    """Set up the target in front of the sensor, as bright as its frames can use.

    The brightest frame position reaches 90 % of saturation at the geometric mean of the shortest and the longest
    exposure. Longer exposures saturate it and raise the signal of the dark patches.

    Parameters
    ----------
    sensor : the sensor.
    lit_exposures_us : exposures of the lit frames, µs.
    illuminant : name of the light's spectrum.
    without : noise terms to switch off, as in `simulate`.

    Returns
    -------
    The bench.

    Raises
    ------
    RangeError
        If a noise term does not exist, or the sensor has nothing that can be captured.
    SpecError
        If the illuminant is unknown or does not cover the response.
    """
    aps, evs = noise_models(sensor, without=without)
    if aps is None and evs is None:
        raise RangeError("sensor", sensor.name, "a sensor with frame or event pixels")
    one_lux = spectra.scale_to_lux(spectra.illuminant(illuminant), 1.0)
    per_lux = {
        name: float(photocurrent(one_lux.values / pi, one_lux.wavelength_nm, sensor, US_PER_S, filter=name))
        for name in sensor.spec.filters
    }
    tile = np.array([[per_lux[sensor.spec.pixels[letter].filter] for letter in row] for row in sensor.spec.tile_rows])
    target = step_target(*sensor.layout.shape) * sensor.relative_illumination
    flux = sensor.layout.tiled(tile) * target
    bench = Bench(sensor, flux, 1.0, aps, evs)
    if aps is not None:
        spec = aps.spec
        saturation_e = min(spec.full_well_e, (aps.full_scale_dn - spec.black_level_dn) / spec.system_gain_dn_per_e)
        seconds = sqrt(min(lit_exposures_us) * max(lit_exposures_us)) * S_PER_US
        lux = _BRIGHTEST * saturation_e / seconds / float(bench.frame_flux_e_per_s[sensor.layout.aps_mask].max())
    else:
        lux = _BRIGHTEST_EVENT_DN / float(bench.event_signal_dn.max())
    return Bench(sensor, flux * lux, lux, aps, evs)

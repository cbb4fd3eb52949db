"""The bench of a virtual calibration session: a sensor, a test target of many brightness levels, and its light.

The light is a closed form, without a render: a neutral target in front of a Lambertian source of a named
illuminant. The flux of each pixel is Eq. 1 through its own filter times the target's
transmittance.

What a session should find are the sensor's own values, by the names that calibrations give them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from hesim_render.capture.run_settings import noise_models
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
#: Most charge of the dark current in the longest exposure, as a part of saturation, at which that is compared.
_DARK_PART = 2e-3


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


def truth_of(bench: Bench, longest_us: float) -> dict[str, dict[str, float]]:
    """Values by section (``aps``, ``evs``) and name.

    A value is left out where a calibration finds a mixture of several: positions with other coefficients, noise that
    rows, columns or patterns share, a sensor that is calibrated itself. Spreads are those of the law that the device's
    maps are drawn from.

    Parameters
    ----------
    bench : of the session, whose noise terms may be off.
    longest_us : longest exposure of the lit frames, µs.
    """
    result = {}
    if bench.aps is not None:
        result["aps"] = _frames(bench.aps, longest_us)
    if bench.evs is not None:
        result["evs"] = _events(bench.evs)
    return result


def _frames(aps: ApsNoise, longest_us: float) -> dict[str, float]:
    spec, off = aps.spec, aps.off
    gain = spec.system_gain_dn_per_e
    if spec.beta is not None:
        return {"K": gain}
    span_e = (aps.full_scale_dn - spec.black_level_dn) / gain
    dark_e_per_s = 0.0 if "dark_current" in off else spec.dark_current_now_e_per_s
    result = {
        "K": gain,
        "dark_current_e_per_s": dark_e_per_s,
        "dsnu_e": 0.0 if "dsnu" in off else spec.dsnu_e,
        "prnu_percent": 0.0 if "prnu" in off else 100 * spec.prnu_rel,
        "row_noise_dn": aps.row_noise_dn,
    }
    # the capacity that is found is that for light: dark current takes a part of it
    full_e = min(spec.full_well_e, span_e)
    if spec.nonlinearity is None and dark_e_per_s * longest_us * S_PER_US < _DARK_PART * full_e:
        result["full_well_e"] = full_e
    if not (aps.interference or aps.column_noise_dn or aps.row_noise_dn):
        read = 0.0 if "read" in off else spec.read_noise_e
        result["read_noise_e"] = math.hypot(read, 0.0 if "residual" in off else spec.residual_noise_dn / gain)
    return result


def _events(evs: EvsNoise) -> dict[str, float]:
    spec, off = evs.spec, evs.off
    theta_on, theta_off = spec.contrast_threshold_on, spec.contrast_threshold_off
    result = {
        "theta_on": theta_on, "theta_off": theta_off,
        "threshold_mismatch_rel": 0.0 if "mismatch" in off else spec.threshold_mismatch_rel,
    }  # fmt: skip
    if spec.leak is None:
        rate_hz = 0.0 if "leak" in off else spec.leak_rate_hz
        result["leak_rate_hz"] = rate_hz
        if spec.tick_us is not None:
            result["leak_per_trial"] = -math.expm1(-rate_hz * spec.tick_us * S_PER_US)
    if spec.reference == "last_event":
        if spec.photoreceptor is None or not spec.photoreceptor.filters_noise:
            result["noise_cutoff_hz"] = float(spec.noise_cutoff_hz or 0.0)
        return result
    every = {(c.beta1, c.beta2, c.beta3, c.beta4, c.beta5) for c in spec.coefficients}
    if len(every) == 1 and not off & {"shot", "dark_current"}:
        beta1, beta2, beta3, beta4, beta5 = every.pop()
        if beta4 > 0:
            beta0 = float(np.mean([theta_on, theta_off])) / (spec.threshold_hardware_v or 1.0)
            result |= {"A": beta0 * beta1 / beta4, "B": beta0 * beta2 / beta4, "C": beta3 / beta4, "D": beta5}
    return result

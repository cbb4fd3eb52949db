"""Exposures at which sensors and filter sets are compared: equal exposure, equal light, equal white."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.study import Equal
from hesim_render.spectral.spectrum import Spectrum, integrate_product, photopic, require_coverage, scale_to_lux
from hesim_render.studies.colour_noise import saturation_e


def white_rate(responses: Sequence[Spectrum], light: Spectrum, lux: float = 1.0) -> NDArray[np.float64]:
    """Electrons per second of one pixel of each channel on a perfect diffuser, ∫ R(λ) E(λ)/π dλ.

    Parameters
    ----------
    responses : e⁻/s per W m⁻² sr⁻¹ nm⁻¹.
    light : relative spectral power.
    lux : illuminance of the diffuser, lx.

    Returns
    -------
    [channel], e⁻/s.

    Raises
    ------
    SpecError
        If the light does not cover a response.
    """
    irradiance = scale_to_lux(light, lux)
    for number, response in enumerate(responses):
        require_coverage(irradiance, response, "the light", f"channel {number}")
    return np.array([integrate_product(response, irradiance) for response in responses]) / pi


def light_throughput(sensor: Sensor) -> float:
    """Luminous exposure on the sensor per lux and second in the scene's light, relative: G · ∫ τ V dλ / ∫ V dλ."""
    transmittance = sensor.spec.lens.transmittance.load()
    return sensor.lens.solid_angle_sr * integrate_product(transmittance, photopic()) / photopic().integral()


def exposure_for(
    equal: Equal, sensor: Sensor, nominal_us: float, white_e_per_s: NDArray[np.float64], reference: float, fill: float
) -> float:
    """The exposure of a sensor in a comparison, µs.

    ``exposure``: the nominal one. ``light``: that with which the pixels get the luminous exposure (lux seconds on the
    sensor) of the first sensor at the nominal exposure; filters do not count. ``white``: that with which a perfect
    white fills a part of saturation in the brightest channel.

    Parameters
    ----------
    equal : what is equal.
    sensor : the sensor.
    nominal_us : nominal exposure, µs.
    white_e_per_s : [channel], electrons per second of white.
    reference : `light_throughput` of the first sensor.
    fill : part of saturation.

    Raises
    ------
    SpecError
        If dark current alone fills the pixel.
    """
    if equal == "exposure":
        return nominal_us
    if equal == "light":
        return nominal_us * reference / light_throughput(sensor)
    dark = 0.0 if sensor.spec.aps is None else sensor.spec.aps.dark_current_now_e_per_s
    empty = saturation_e(sensor, 0.0)
    # white·t = fill · (saturation − dark·t)
    seconds = fill * empty / (float(white_e_per_s.max()) + fill * dark)
    if not seconds > 0:
        raise SpecError(f"sensor {sensor.name!r}: no exposure makes white {fill:g} of saturation")
    return seconds * US_PER_S


def electrons(rate_e_per_s: NDArray[np.float64], exposure_us: float) -> NDArray[np.float64]:
    """Electrons of an exposure."""
    return rate_e_per_s * (exposure_us * S_PER_US)

"""Noise figures of a candidate under a light: closed forms, and full simulation with intervals.

Exposures at which sensors and filter sets are compared: equal exposure, equal light, equal white.
"""

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.sensor.sensor import Sensor
from hesim_render.specs.study import Equal, StudySpec
from hesim_render.spectral.colorimetry import responses_to
from hesim_render.spectral.spectrum import (
    Spectrum,
    constant,
    integrate_product,
    photopic,
    require_coverage,
    scale_to_lux,
)
from hesim_render.studies.candidate import Seen
from hesim_render.studies.chart_noise import (
    GREYS,
    Measured,
    NoisyChart,
    measured_figures,
    measured_luminance,
    noisy_chart,
)
from hesim_render.studies.colour_error import colour_differences, noise_aware_matrix, to_srgb
from hesim_render.studies.colour_noise import (
    GREY,
    YSNR_WEIGHTS,
    ChannelNoise,
    channel_noise,
    dynamic_range_db,
    light_for_snr,
    output_noise,
    saturation_e,
)
from hesim_render.studies.table import Cell


def white_rate(responses: Sequence[Spectrum], light: Spectrum, lux: float) -> NDArray[np.float64]:
    """Electrons per second of one pixel of each channel on a perfect diffuser, ∫ R(λ) E(λ)/π dλ, [channel].

    Parameters
    ----------
    responses : e⁻/s per W m⁻² sr⁻¹ nm⁻¹.
    light : relative spectral power.
    lux : illuminance of the diffuser, lx.

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


#: Least and largest light at which an SNR of 10 is looked for, as a multiple of that of the row.
_LIGHT_RANGE = (1e-9, 1e9)


def noise_figures(
    spec: StudySpec,
    seen: Seen,
    light: Spectrum,
    chart: list[Spectrum],
    rate: NDArray[np.float64],
    lux: float,
    exposure_us: float,
) -> dict[str, Cell]:
    """Columns of noise of one row.

    Parameters
    ----------
    spec : the study.
    seen : the candidate in front of the chart.
    light : relative spectral power.
    chart : the surfaces, for the simulation.
    rate : [channel], electrons per second of a perfect white.
    lux : illuminance of the surfaces, lx.
    exposure_us : µs.

    Returns
    -------
    Figures by column: those that end in ``_noise_aware`` have the matrix of the least squared error with the noise of
    this row, the others the matrix of colour, which knows no noise. Figures of simulation where the study has repeats.
    If the grey card itself saturates, levels alone; ``white_clipped`` tells that a perfect white does.
    """
    candidate = seen.candidate
    sensor = candidate.sensor
    white_e = electrons(rate, exposure_us)
    noise = channel_noise(sensor, candidate.channels, exposure_us, spec.area_px)
    saturation = saturation_e(sensor, exposure_us)
    row: dict[str, Cell] = {
        "white_e": float(white_e.max()),
        "white_saturation": float(white_e.max() / saturation),
        "white_clipped": bool(white_e.max() > saturation),
        "dynamic_range_db": dynamic_range_db(sensor, exposure_us),
    }
    if GREY * white_e.max() >= saturation:
        return row
    aware = noise_aware_matrix(seen.samples, white_e, noise)
    row |= {
        "ysnr_noise_aware": _ysnr(_luminance(seen, aware) / white_e, GREY * white_e, noise),
        "snr10_lux_noise_aware": _light_for_snr_10(seen, white_e / lux, noise, lux),
    }
    balanced = None
    if spec.noise.repeats:
        balanced = _noisy(spec, seen, light, chart, lux, exposure_us).balanced(white_e, spec.area_px)
    if seen.colour is None:
        return row if balanced is None else row | _cells("ysnr_noise_aware", measured_luminance(balanced, aware[1]))
    for end, matrix in (("_noise_aware", aware), ("", seen.colour.matrix)):
        rgb = to_srgb(matrix, seen.samples.white_xyz)
        result = output_noise(rgb, white_e, noise)
        row |= {f"noise_amplification{end}": result.amplification, f"ysnr{end}": result.ysnr}
        if balanced is not None:
            for name, value in measured_figures(balanced, rgb, matrix, seen.samples).items():
                row |= _cells(f"{name}{end}", value)
    return row | {
        "delta_e_mean_noise_aware": float(colour_differences(seen.samples, aware).mean()),
        "snr10_lux": light_for_snr(10, _luminance(seen, seen.colour.matrix) / white_e, white_e / lux, noise),
    }


def _luminance(seen: Seen, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights of the balanced channels in the luminance; that of XYZ where sensors need not see colour."""
    if seen.colour is None:
        return matrix[1]
    return np.asarray(YSNR_WEIGHTS @ to_srgb(matrix, seen.samples.white_xyz))


def _ysnr(weights: NDArray[np.float64], signal_e: NDArray[np.float64], noise: ChannelNoise) -> float:
    """Luminance over its standard deviation, with weights of electrons."""
    return float(weights @ signal_e / np.sqrt(weights**2 @ noise.variance_e2(signal_e)))


def _light_for_snr_10(seen: Seen, white_per_lux: NDArray[np.float64], noise: ChannelNoise, near: float) -> float:
    """Light in lux at which the luminance of the grey card has an SNR of 10 with the matrix that is best there."""
    from scipy.optimize import brentq

    def missing(log_lux: float) -> float:
        white = white_per_lux * np.exp(log_lux)
        weights = _luminance(seen, noise_aware_matrix(seen.samples, white, noise)) / white
        return _ysnr(weights, GREY * white, noise) - 10

    low, high = np.log(near) + np.log(_LIGHT_RANGE)
    return float("inf") if missing(high) < 0 else float(np.exp(brentq(missing, low, high, xtol=1e-12)))


def _noisy(
    spec: StudySpec, seen: Seen, light: Spectrum, chart: list[Spectrum], lux: float, exposure_us: float
) -> NoisyChart:
    """Frames of the surfaces and of the grey card."""
    candidate, sensor = seen.candidate, seen.candidate.sensor
    every = [sensor.responses[name] for name in sensor.spec.filters]
    rates = responses_to(scale_to_lux(light, lux), [*chart, *[constant(GREY)] * GREYS], every) / np.pi
    return noisy_chart(
        sensor, candidate.channels, electrons(rates, exposure_us), exposure_us, repeats=spec.noise.repeats,
        patch_px=spec.noise.patch_px, crosstalk=candidate.crosstalk, seed=spec.noise.seed,
    )  # fmt: skip


def _cells(name: str, result: Measured) -> dict[str, Cell]:
    return {f"{name}_simulated": result.value, f"{name}_low": result.low, f"{name}_high": result.high}

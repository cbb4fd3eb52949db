"""Noise figures of a candidate under a light: closed forms, and full simulation with intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.specs.study import StudySpec
from hesim_render.spectral.colorimetry import responses_to
from hesim_render.spectral.spectrum import Spectrum, constant, scale_to_lux
from hesim_render.studies.chart_noise import (
    GREYS,
    Measured,
    NoisyChart,
    measured_figures,
    measured_luminance,
    noisy_chart,
)
from hesim_render.studies.colour_error import colour_differences
from hesim_render.studies.colour_matrix import noise_aware_matrix, to_srgb
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
from hesim_render.studies.exposure import electrons
from hesim_render.studies.seen import Seen
from hesim_render.studies.table import Cell


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
    Figures by column; those of simulation where the study has repeats. If the grey card itself saturates, levels alone.
    """
    candidate = seen.candidate
    sensor = candidate.sensor
    white_e = electrons(rate, exposure_us)
    noise = channel_noise(sensor, candidate.channels, exposure_us, spec.area_px)
    saturation = saturation_e(sensor, exposure_us)
    row: dict[str, Cell] = {
        "white_e": float(white_e.max()),
        "white_saturation": float(white_e.max() / saturation),
        "dynamic_range_db": dynamic_range_db(sensor, exposure_us),
    }
    if GREY * white_e.max() >= saturation:
        return row
    aware = noise_aware_matrix(seen.samples, white_e, noise)
    if seen.colour is None:
        row |= _of_luminance(aware[1], white_e, noise, lux)
        if spec.noise.repeats:
            balanced = _noisy(spec, seen, light, chart, lux, exposure_us).balanced(white_e, spec.area_px)
            row |= _cells("ysnr", measured_luminance(balanced, aware[1]))
        return row
    rgb = to_srgb(seen.colour.matrix, seen.samples.white_xyz)
    found = output_noise(rgb, white_e, noise)
    weights = np.array(YSNR_WEIGHTS) @ rgb / white_e
    errors = colour_differences(seen.samples, aware)
    row |= {
        "noise_amplification": found.amplification,
        "ysnr": found.ysnr,
        "snr10_lux": light_for_snr(10, weights, white_e / lux, noise),
        "ysnr_noise_aware": output_noise(to_srgb(aware, seen.samples.white_xyz), white_e, noise).ysnr,
        "delta_e_mean_noise_aware": float(errors.mean()),
    }
    if spec.noise.repeats:
        balanced = _noisy(spec, seen, light, chart, lux, exposure_us).balanced(white_e, spec.area_px)
        for end, matrix in (("", seen.colour.matrix), ("_noise_aware", aware)):
            rgb = to_srgb(matrix, seen.samples.white_xyz)
            for name, value in measured_figures(balanced, rgb, matrix, seen.samples).items():
                row |= _cells(f"{name}{end}", value)
    return row


def _of_luminance(
    weights: NDArray[np.float64], white_e: NDArray[np.float64], noise: ChannelNoise, lux: float
) -> dict[str, Cell]:
    """Figures of sensors that need not see colour, with the weights of a luminance."""
    u = weights / white_e
    signal = GREY * white_e
    sigma = float(np.sqrt(np.sum(u**2 * noise.variance_e2(signal))))
    return {"ysnr": float(u @ signal) / sigma, "snr10_lux": light_for_snr(10, u, white_e / lux, noise)}


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


def _cells(name: str, found: Measured) -> dict[str, Cell]:
    return {f"{name}_simulated": found.value, f"{name}_low": found.low, f"{name}_high": found.high}

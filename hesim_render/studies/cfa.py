"""The study of filter sets: one row of figures for each combination of a study's file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.progress import Progress
from hesim_render.specs.study import NamedLight, StudySpec, SurfacesSpec
from hesim_render.spectral.colorimetry import responses_to
from hesim_render.spectral.spectrum import Spectrum, constant, scale_to_lux
from hesim_render.studies.candidate import SPACE_NM, Candidate, candidates
from hesim_render.studies.chart_noise import GREYS, measured_figures, noisy_chart
from hesim_render.studies.colour_error import (
    ColourError,
    MatrixMethod,
    colour_differences,
    fit_matrix,
    metamerism_index,
)
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
from hesim_render.studies.colour_samples import ColourSamples, colour_samples, reflectance_set
from hesim_render.studies.event_figures import event_figures
from hesim_render.studies.exposure import electrons, exposure_for, light_throughput, white_rate
from hesim_render.studies.subspace import (
    observer,
    sampled,
    vora_value,
)
from hesim_render.studies.surfaces import reflectances_of
from hesim_render.studies.table import Cell, Table

#: Most pictures of demosaiced patterns that a study keeps.
MOST_PICTURES = 48


@dataclass(frozen=True, eq=False)
class Seen:
    """A candidate under a light, in front of reflectances.

    Parameters
    ----------
    candidate : sensor and filter set.
    surfaces, light_name : names in the results.
    samples, events : the reflectances in the channels of frames and events.
    colour : the best matrix, where colour is wanted.
    delta_e : [surface], ΔE2000 after it.
    row : figures of colour.
    """

    candidate: Candidate
    surfaces: str
    light_name: str
    samples: ColourSamples
    events: ColourSamples | None
    colour: ColourError | None
    delta_e: NDArray[np.float64]
    row: dict[str, Cell]


@dataclass(frozen=True, eq=False)
class StudyResult:
    """Results of a study.

    Parameters
    ----------
    table : a row for each combination.
    seen : each candidate under each light, for drawings.
    pictures : captions and pictures of the demosaiced patterns, linear sRGB.
    """

    table: Table
    seen: list[Seen]
    pictures: list[tuple[str, NDArray[np.float32]]]


def run_study(spec: StudySpec, progress: Progress | None = None) -> StudyResult:
    """All figures of a study.

    Parameters
    ----------
    spec : the study.
    progress : called with (done, total, what).

    Returns
    -------
    A row for each combination of sensor, filter set, crosstalk, surfaces, illuminant, illuminance, exposure and kind of
    equality.

    Raises
    ------
    SpecError
        If a file is not valid, or parts of the study do not fit together.
    """
    tried = candidates(spec)
    total = len(tried) * len(spec.surfaces) * len(spec.illuminants)
    reference = light_throughput(tried[0].sensor)
    rows: list[dict[str, Cell]] = []
    every: list[Seen] = []
    pictures: list[tuple[str, NDArray[np.float32]]] = []
    done = 0
    for item in spec.surfaces:
        for light in spec.illuminants:
            sets = _surfaces(item, tried, light, spec)
            for candidate, (surfaces, more) in zip(tried, sets, strict=True):
                if progress is not None:
                    progress(done, total, f"{candidate.set_name} on {candidate.sensor_name}")
                spectrum = light.spectrum.load()
                every.append(_seen(spec, candidate, item.label, light.name, spectrum, surfaces))
                rows += _rows(spec, every[-1], spectrum, surfaces, more, reference, pictures)
                done += 1
    return StudyResult(Table(rows), every, pictures)


def _surfaces(
    item: SurfacesSpec, tried: Sequence[Candidate], light: NamedLight, spec: StudySpec
) -> Iterator[tuple[list[Spectrum], dict[str, Cell]]]:
    """For each candidate the reflectances that its matrix is fitted to, and figures of a cube."""
    if item.reflectances is not None:
        chart = list(reflectances_of(item).values())
        yield from ((chart, {}) for _ in tried)
        return
    from hesim_render.studies.cube_colour import cube_figures

    chart = list(reflectance_set("colorchecker").values())
    if "colour" not in spec.figures:
        yield from ((chart, {}) for _ in tried)
        return
    yield from ((chart, found) for found in cube_figures(item, [c.responses for c in tried], light, chart, spec.matrix))


def _rows(
    spec: StudySpec, seen: Seen, spectrum: Spectrum, chart: list[Spectrum], more: dict[str, Cell], reference: float,
    pictures: list[tuple[str, NDArray[np.float32]]],
) -> Iterator[dict[str, Cell]]:  # fmt: skip
    candidate = seen.candidate
    for lux in spec.illuminance_lux:
        rate = white_rate(candidate.responses, spectrum, lux)
        event_rate = white_rate(candidate.event_responses, spectrum, lux)
        events: dict[str, Cell] = {}
        if "events" in spec.figures and seen.events is not None:
            events |= event_figures(
                candidate.sensor, candidate.event_filters, event_rate, seen.events.camera, seen.samples
            )
        aps = candidate.sensor.spec.aps
        for nominal_us in spec.exposures_us or [aps.exposure_us if aps is not None else 1]:
            for equal in spec.equal:
                row: dict[str, Cell] = {
                    "surfaces": seen.surfaces, "illuminant": seen.light_name, "illuminance_lux": lux,
                    "sensor": candidate.sensor_name, "filter_set": candidate.set_name,
                    "crosstalk": candidate.crosstalk, "equal": equal,
                }  # fmt: skip
                if aps is not None:
                    exposure_us = exposure_for(equal, candidate.sensor, nominal_us, rate, reference, spec.white_fill)
                    row |= {"nominal_exposure_us": nominal_us, "exposure_us": exposure_us}
                row |= seen.row | more
                if aps is not None and "noise" in spec.figures:
                    row |= _noise_row(spec, seen, spectrum, chart, rate, lux, exposure_us)
                if aps is not None and "demosaic" in spec.figures:
                    found, picture = _detail(spec, seen, spectrum, rate, lux, exposure_us)
                    row |= found
                    if len(pictures) < MOST_PICTURES:
                        text = f"{candidate.set_name}, {seen.light_name}, {lux:g} lx, equal {equal}"
                        pictures.append((text, picture))
                yield row | events


def _seen(
    spec: StudySpec, candidate: Candidate, surfaces: str, light_name: str, light: Spectrum, chart: list[Spectrum]
) -> Seen:
    every = [*candidate.responses, *candidate.event_responses]
    both = colour_samples(every, light, chart, light_name)
    count = len(candidate.responses)
    samples = ColourSamples(both.camera[:, :count], both.xyz, both.white_xyz)
    events = None
    if candidate.event_filters:
        events = ColourSamples(both.camera[:, count:], both.xyz, both.white_xyz)
    colour, row, errors = None, {}, np.empty(0)
    if {"colour", "demosaic"} & set(spec.figures):
        colour = fit_matrix(samples, spec.matrix)
        errors = colour_differences(samples, colour.matrix)
    if colour is not None and "colour" in spec.figures:
        is_determined = len(chart) >= count * (count + 1)  # twice as many surfaces as terms
        root = fit_matrix(samples, spec.matrix, "root_polynomial") if is_determined else None
        curves, wanted = sampled(candidate.responses, SPACE_NM), observer(SPACE_NM)
        checker = list(reflectance_set("colorchecker").values())
        method: MatrixMethod = "least_squares_xyz" if spec.matrix == "least_squares_xyz" else "least_delta_e_ab"
        index = metamerism_index(colour_samples(candidate.responses, light, checker, light_name), method)
        row = {
            **candidate.spaces, "vora_light": vora_value(curves, wanted, light.at(SPACE_NM)),
            "matrix": spec.matrix,
            "delta_e_mean": float(errors.mean()), "delta_e_p95": float(np.quantile(errors, 0.95)),
            "delta_e_max": float(errors.max()),
            "delta_e_mean_root_polynomial": None if root is None else float(
                colour_differences(samples, root.matrix, "root_polynomial").mean()
            ),
            "smi": index.value, "smi_method": index.method,
        }  # fmt: skip
    return Seen(candidate, surfaces, light_name, samples, events, colour, errors, row)


def _noise_row(
    spec: StudySpec, seen: Seen, light: Spectrum, chart: list[Spectrum], rate: NDArray[np.float64], lux: float,
    exposure_us: float,
) -> dict[str, Cell]:  # fmt: skip
    candidate = seen.candidate
    sensor = candidate.sensor
    white_e = electrons(rate, exposure_us)
    noise = channel_noise(sensor, candidate.channels, exposure_us, spec.area_px)
    row: dict[str, Cell] = {
        "white_e": float(white_e.max()),
        "white_saturation": float(white_e.max() / saturation_e(sensor, exposure_us)),
        "dynamic_range_db": dynamic_range_db(sensor, exposure_us),
    }
    if seen.colour is None:
        row |= _luminance_row(noise_aware_matrix(seen.samples, white_e, noise)[1], white_e, noise, lux)
        return row
    rgb = to_srgb(seen.colour.matrix, seen.samples.white_xyz)
    found = output_noise(rgb, white_e, noise)
    weights = np.array(YSNR_WEIGHTS) @ rgb / white_e
    aware = noise_aware_matrix(seen.samples, white_e, noise)
    errors = colour_differences(seen.samples, aware)
    row |= {
        "noise_amplification": found.amplification,
        "ysnr": found.ysnr,
        "snr10_lux": light_for_snr(10, weights, white_e / lux, noise),
        "ysnr_noise_aware": output_noise(to_srgb(aware, seen.samples.white_xyz), white_e, noise).ysnr,
        "delta_e_mean_noise_aware": float(errors.mean()),
    }
    if spec.noise.repeats:
        row |= _simulated(spec, seen, light, chart, lux, exposure_us, white_e, aware)
    return row


def _detail(
    spec: StudySpec, seen: Seen, light: Spectrum, rate: NDArray[np.float64], lux: float, exposure_us: float
) -> tuple[dict[str, Cell], NDArray[np.float32]]:
    """Figures of patterns after demosaicing, and their picture."""
    from hesim_render.studies.demosaic_figures import demosaic_figures

    assert seen.colour is not None
    sensor = seen.candidate.sensor
    every = [sensor.responses[name] for name in sensor.spec.filters]
    return demosaic_figures(
        sensor, light, to_srgb(seen.colour.matrix, seen.samples.white_xyz), electrons(rate, exposure_us),
        electrons(white_rate(every, light, lux), exposure_us), exposure_us, seen.candidate.crosstalk,
        spec.noise.repeats, spec.noise.seed,
    )  # fmt: skip


def _luminance_row(
    weights: NDArray[np.float64], white_e: NDArray[np.float64], noise: ChannelNoise, lux: float
) -> dict[str, Cell]:
    """Figures of sensors that need not see colour, with the weights of a luminance."""
    u = weights / white_e
    signal = GREY * white_e
    sigma = float(np.sqrt(np.sum(u**2 * noise.variance_e2(signal))))
    return {"ysnr": float(u @ signal) / sigma, "snr10_lux": light_for_snr(10, u, white_e / lux, noise)}


def _simulated(
    spec: StudySpec, seen: Seen, light: Spectrum, chart: list[Spectrum], lux: float, exposure_us: float,
    white_e: NDArray[np.float64], aware: NDArray[np.float64],
) -> dict[str, Cell]:  # fmt: skip
    """Figures of noisy frames, each with its 95 % interval over repeats."""
    assert seen.colour is not None
    candidate, sensor = seen.candidate, seen.candidate.sensor
    every = [sensor.responses[name] for name in sensor.spec.filters]
    surfaces = [*chart, *[constant(GREY)] * GREYS]
    rates = responses_to(scale_to_lux(light, lux), surfaces, every) / np.pi
    noisy = noisy_chart(
        sensor, candidate.channels, electrons(rates, exposure_us), exposure_us, repeats=spec.noise.repeats,
        patch_px=spec.noise.patch_px, crosstalk=candidate.crosstalk, seed=spec.noise.seed,
    )  # fmt: skip
    balanced = noisy.balanced(white_e, spec.area_px)
    row: dict[str, Cell] = {}
    for end, matrix in (("", seen.colour.matrix), ("_noise_aware", aware)):
        rgb = to_srgb(matrix, seen.samples.white_xyz)
        for name, found in measured_figures(balanced, rgb, matrix, seen.samples).items():
            row |= {
                f"{name}{end}_simulated": found.value,
                f"{name}{end}_low": found.low,
                f"{name}{end}_high": found.high,
            }
    return row

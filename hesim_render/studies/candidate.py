"""What a study compares: sensors with filter sets, and what each sees of surfaces under a light."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import HesimError, SpecError
from hesim_render.sensor.sensor import Sensor, load_sensor
from hesim_render.specs.filter_set import PaletteSpec, read_filter_set, read_palette
from hesim_render.specs.study import StudySpec, set_label
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies.colour_error import (
    ColourError,
    MatrixMethod,
    colour_differences,
    fit_matrix,
    metamerism_index,
)
from hesim_render.studies.colour_samples import ColourSamples, colour_samples, reflectance_set
from hesim_render.studies.filter_sets import effective_responses, filters_of, with_filter_set
from hesim_render.studies.subspace import (
    filter_quality,
    luther_residual,
    observer,
    require_colour,
    sampled,
    vora_value,
)
from hesim_render.studies.table import Cell

#: Grid on which spaces are compared, nm.
SPACE_NM = np.arange(380.0, 781.0, 1.0)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A sensor with a filter set, at one crosstalk.

    Parameters
    ----------
    sensor : the whole sensor.
    sensor_name, set_name : names in the results.
    crosstalk : part of a pixel's electrons that its neighbours collect.
    """

    sensor: Sensor
    sensor_name: str
    set_name: str
    crosstalk: float

    @cached_property
    def channels(self) -> list[str]:
        """Filters of the frame pixels."""
        return filters_of(self.sensor, "aps")

    @cached_property
    def event_filters(self) -> list[str]:
        """Filters of the event pixels."""
        return filters_of(self.sensor, "evs")

    @cached_property
    def responses(self) -> list[Spectrum]:
        """Of the frame pixels' filters, crosstalk included."""
        return effective_responses(self.sensor, self.channels, "aps", self.crosstalk)

    @cached_property
    def event_responses(self) -> list[Spectrum]:
        """Of the event pixels' filters, crosstalk included."""
        return effective_responses(self.sensor, self.event_filters, "evs", self.crosstalk)

    @cached_property
    def spaces(self) -> dict[str, Cell]:
        """Figures of the curves alone."""
        curves, wanted = sampled(self.responses, SPACE_NM), observer(SPACE_NM)
        quality = filter_quality(curves, wanted)
        return {
            "vora": vora_value(curves, wanted),
            "luther_residual": luther_residual(curves, wanted).total,
            "filter_quality_min": min(quality),
        }


def sensor_candidates(spec: StudySpec) -> list[Candidate]:
    """All sensors with all filter sets of a study.

    Raises
    ------
    SpecError
        If a file is not valid, a set does not fit a sensor, or cannot tell three primaries apart where colour is
        wanted; all sets are reported together.
    """
    palettes: dict[str, PaletteSpec] = {}

    def palette(name: str) -> PaletteSpec:
        if name not in palettes:
            palettes[name] = read_palette(spec.beside(name))
        return palettes[name]

    result, problems = [], []
    for name in spec.sensors:
        base = load_sensor(spec.beside(name), spec.sensor_keys)
        sets: Sequence[Any] = spec.filter_sets or [None]
        for number, use in enumerate(sets):
            try:
                if use is None:
                    label, sensor = "own", base
                else:
                    label = set_label(use, spec.palette)
                    filters = read_filter_set(use.beside(use.set))
                    sensor = with_filter_set(base, filters, palette(use.palette or spec.palette))
                parts = spec.crosstalk or [sensor.spec.geometry.crosstalk]
                for crosstalk in parts:
                    candidate = Candidate(sensor, base.name, label, crosstalk)
                    _check(candidate, spec)
                    result.append(candidate)
            except HesimError as error:
                if isinstance(error, SpecError) and error.file is not None:
                    raise
                key = f"sensors ({name})" if use is None else f"filter_sets.{number}"
                problems.append(SpecError(str(error), key=key))
    if problems:
        raise SpecError.together(problems)
    return result


def _check(candidate: Candidate, spec: StudySpec) -> None:
    frames = {"colour", "noise", "demosaic"} & set(spec.figures)
    if frames and not candidate.channels:
        raise SpecError(f"{candidate.set_name} on {candidate.sensor_name}: no frame pixels, but figures of frames")
    if "colour" in spec.figures or "demosaic" in spec.figures:
        require_colour(sampled(candidate.responses, SPACE_NM), f"{candidate.set_name} on {candidate.sensor_name}")


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


def seen_by(
    spec: StudySpec, candidate: Candidate, surfaces: str, light_name: str, light: Spectrum, chart: list[Spectrum]
) -> Seen:
    """A candidate in front of reflectances, with matrix and figures of colour where the study wants them.

    Parameters
    ----------
    spec : the study.
    candidate : sensor and filter set.
    surfaces, light_name : names in the results.
    light : relative spectral power.
    chart : the reflectances.
    """
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

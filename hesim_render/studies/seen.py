"""A candidate in front of surfaces under a light: its channels, its colour matrix and the figures of colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.specs.study import StudySpec
from hesim_render.spectral.spectrum import Spectrum
from hesim_render.studies.candidate import SPACE_NM, Candidate
from hesim_render.studies.colour_error import (
    ColourError,
    MatrixMethod,
    colour_differences,
    fit_matrix,
    metamerism_index,
)
from hesim_render.studies.colour_samples import ColourSamples, colour_samples, reflectance_set
from hesim_render.studies.subspace import observer, sampled, vora_value
from hesim_render.studies.table import Cell


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

"""The files of a design: its filters as a palette, its tile as a filter set."""

from __future__ import annotations

import numpy as np

from hesim_render.specs.filter_set import FilterSetSpec
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.studies.design import BANDS_NM, DesignResult, Problem
from hesim_render.studies.design_tile import counts_of, spread_tile


def designed_set(problem: Problem, result: DesignResult) -> FilterSetSpec:
    """The filter set with the tile of a result, as whole pixels; the set itself where shares are not varied."""
    own = problem.filter_set
    if problem.spec.tile_px is None or result.shares is None:
        return own
    tile, free = problem.tile(*problem.spec.tile_px)
    letters = {
        name: next(letter for letter, pixel in own.pixels.items() if pixel.filter == name and "aps" in pixel.roles)
        for name in problem.frames
    }
    counts = counts_of(np.array([result.shares[name] for name in problem.frames]), int(free.sum()))
    wanted = {letters[name]: int(count) for name, count in zip(problem.frames, counts, strict=True)}
    found = spread_tile(tile, free, wanted)
    drawn = set(found.ravel().tolist())
    return own.model_copy(update={
        "name": f"{own.name}-designed", "tile": "\n".join("".join(row) for row in found),
        "description": f"{own.description} Shares of the frame filters designed by gradients.",
        "pixels": {letter: pixel for letter, pixel in own.pixels.items() if letter in drawn},
    })  # fmt: skip


def designed_palette(problem: Problem, result: DesignResult) -> dict[str, object]:
    """The content of a palette file with the filters of a result, in place of those of the palette."""
    palette = problem.palette.model_dump(mode="json", exclude_none=True)
    filters = {}
    for name in problem.names:
        values = result.filters.get(name, problem.start_transmittance[name])
        filters[name] = {"wavelength_nm": BANDS_NM.tolist(), "value": np.round(values, 6).tolist()}
    if result.silicon_depth_um is not None:
        efficiency = with_silicon_depth(problem.sensor.spec.quantum_efficiency, round(result.silicon_depth_um, 4))
        palette["quantum_efficiency"] = efficiency.model_dump(mode="json", exclude_none=True)
    return {
        **palette, "name": problem.spec.name, "filters": filters, "sources": {},
        "description": f"{', '.join(problem.vary)} designed as {problem.spec.family}; start {problem.palette.name}",
        "assumptions": {"filters": "designed by gradients; no filter of these curves has been made"},
    }  # fmt: skip


def with_silicon_depth(efficiency: SpectrumSpec, depth_um: float) -> SpectrumSpec:
    """The same quantum efficiency with another depth of the silicon."""
    if efficiency.silicon_depth_um is not None:
        return efficiency.model_copy(update={"silicon_depth_um": depth_um})
    parts = [
        part if part.silicon_depth_um is None else part.model_copy(update={"silicon_depth_um": depth_um})
        for part in efficiency.product or []
    ]
    return efficiency.model_copy(update={"product": parts})

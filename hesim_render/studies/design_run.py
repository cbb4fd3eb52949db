"""Run a design from its file, judge the result by full simulation, and write all of it.

The files of a design: its filters as a palette, its tile as a filter set.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hesim_render.core.output import OutputFolder, output_errors
from hesim_render.core.progress import Progress, shown
from hesim_render.core.yaml_file import yaml_text
from hesim_render.specs.design import DesignSpec
from hesim_render.specs.files import read_spec
from hesim_render.specs.filter_set import FilterSetSpec, read_palette
from hesim_render.specs.spectrum import SpectrumSpec
from hesim_render.specs.study import StudySpec
from hesim_render.studies.cfa import run_study
from hesim_render.studies.demosaic_figures import CHART_PX
from hesim_render.studies.design import BANDS_NM, DesignResult, Problem, optimise
from hesim_render.studies.design_tile import counts_of, spread_tile
from hesim_render.studies.filter_sets import with_filter_set
from hesim_render.studies.report import report_page, verdict_table
from hesim_render.studies.table import Table

#: File that marks the folder of a design.
MARKER = "design.json"
#: Name of the designed set in the results.
DESIGNED = "designed"


@dataclass(frozen=True, eq=False)
class Design:
    """A finished design.

    Parameters
    ----------
    result : filters and costs of the optimiser.
    table : figures of the designed set and of those it is compared with, by full simulation.
    verdicts : for each set of the comparison, how the designed one differs.
    """

    result: DesignResult
    table: Table
    verdicts: list[dict[str, Any]]


def design(
    spec: str | Path | Mapping[str, Any] | DesignSpec,
    *,
    out: str | Path,
    overwrite: bool = False,
    progress: Progress | Literal[False] | None = None,
) -> Design:
    """Design filters by gradients, and judge them by full simulation with noise.

    Parameters
    ----------
    spec : name of a shipped design, path of a file, or its content as a dictionary (``docs/studies.md``).
    out : folder for ``sensor.yaml``, ``palette.yaml``, ``filter_set.yaml``, ``design.json``, ``results.csv`` and
        ``report.html``.
    overwrite : replace the results of another design in `out`.
    progress : called with (done, total, what). None shows a bar in notebooks only, False never shows one.

    Raises
    ------
    SpecError
        If a file is not valid, or parts do not fit.
    OutputError
        If `out` exists or cannot be written. No partial output is left.
    """
    read = read_spec(DesignSpec, spec, "studies")
    with OutputFolder(out, MARKER, overwrite) as folder:
        with shown(progress, read.name) as report:
            problem = Problem(read)
            result = optimise(problem, report)
            _write_yaml(folder.path / "palette.yaml", designed_palette(problem, result))
            palette = read_palette(folder.path / "palette.yaml")
            filters = designed_set(problem, result)
            _write_yaml(folder.path / "filter_set.yaml", filters.model_dump(mode="json", exclude_none=True))
            sensor = with_filter_set(problem.base, filters, palette).spec.model_dump(mode="json", exclude_none=True)
            sensor |= {"description": palette.description, "sources": {}, "assumptions": palette.assumptions}
            _write_yaml(folder.path / "sensor.yaml", sensor)
            judged = _judgement(read, problem, folder.path)
            outcome = run_study(judged, report)
        verdicts = _verdicts(read, outcome.table)
        with output_errors(folder.target):
            outcome.table.write(folder.path / "results.csv")
            content = {
                "design": json.loads(read.model_dump_json()), "cost": result.cost, "costs": result.costs.tolist(),
                "evaluations": result.evaluations, "shares": result.shares,
                "silicon_depth_um": result.silicon_depth_um, "verdicts": verdicts,
            }  # fmt: skip
            (folder.path / MARKER).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            summary = verdict_table(verdicts, result.costs, None if result.shares is None else filters.tile)
            (folder.path / "report.html").write_text(report_page(judged, outcome, summary), encoding="utf-8")
    return Design(result, outcome.table, verdicts)


def _judgement(spec: DesignSpec, problem: Problem, folder: Path) -> StudySpec:
    """The study that judges the result, against the sets of `compare` or that of the start."""
    own = {
        "set": str((folder / "filter_set.yaml").resolve()), "palette": str((folder / "palette.yaml").resolve()),
        "name": DESIGNED,
    }  # fmt: skip
    start = spec.filter_set.model_copy(update={"name": spec.filter_set.name or "start"})
    others = [
        {
            "set": use.beside(use.set), "palette": use.beside(use.palette or spec.palette),
            "name": use.name or f"{Path(use.set).stem} ({Path(use.palette or spec.palette).stem})",
        }
        for use in spec.compare or [start]
    ]  # fmt: skip
    figures = ["colour", "noise", "events"]
    geometry = problem.sensor.spec.geometry
    if spec.demosaic and geometry.rows >= CHART_PX[0] and geometry.cols >= CHART_PX[1]:
        figures.append("demosaic")
    exposure = [] if spec.exposure_us is None else [spec.exposure_us]
    data = {
        "schema_version": 1, "name": spec.name, "description": spec.description, "sensors": [spec.beside(spec.sensor)],
        "palette": spec.beside(spec.palette), "filter_sets": [own, *others],
        "surfaces": [spec.judge.surfaces()], "illuminants": spec.judge.illuminants,
        "figures": figures, "illuminance_lux": spec.illuminance_lux, "exposures_us": exposure, "area_px": spec.area_px,
        "noise": {"repeats": spec.repeats, "patch_px": 24, "seed": 1},
    }  # fmt: skip
    return StudySpec.model_validate(data, context={"folder": spec.folder})


def _verdicts(spec: DesignSpec, table: Table) -> list[dict[str, Any]]:
    """The designed set against each other one: ratios of figures, and the difference of the cost with its interval.

    The cost of the judgement is that of the design with measured figures: mean ΔE2000 without noise, and with the noise
    of simulated frames after the noise-aware matrix, the mean over lights and levels.
    """
    weights = spec.cost
    own = table.where(filter_set=DESIGNED)
    result = []
    for name in dict.fromkeys(table["filter_set"]):
        if name == DESIGNED:
            continue
        other = table.where(filter_set=name)
        parts = []
        # a set without event pixels cannot be judged by them
        has_events = (
            weights.events > 0
            and "event_contrast_on" in table.columns
            and all(np.isfinite(each["event_contrast_on"]).all() for each in (own, other))
        )
        for each in (own, other):
            cost = weights.colour * each["delta_e_mean"] + weights.noise * each["delta_e_noisy_noise_aware_simulated"]
            if has_events:
                cost = cost + weights.events * each["event_contrast_on"]
            half = each["delta_e_noisy_noise_aware_high"] - each["delta_e_noisy_noise_aware_simulated"]
            parts.append((float(cost.mean()), weights.noise * float(np.sqrt(np.sum(half**2))) / len(each)))
        difference = parts[0][0] - parts[1][0]
        half_width = float(np.hypot(parts[0][1], parts[1][1]))
        verdict: dict[str, Any] = {
            "against": name, "cost": parts[0][0], "cost_against": parts[1][0], "cost_difference": difference,
            "cost_difference_low": difference - half_width, "cost_difference_high": difference + half_width,
            "clipped_lux": sorted({row["illuminance_lux"] for row in own if row.get("white_clipped")}),
            "delta_e_mean": float(own["delta_e_mean"].mean()),
            "delta_e_mean_against": float(other["delta_e_mean"].mean()),
        }  # fmt: skip
        for lux in spec.illuminance_lux:
            for name, column in (("ysnr_ratio", "ysnr"), ("ysnr_noise_aware_ratio", "ysnr_noise_aware")):
                pair = [each.where(illuminance_lux=lux)[f"{column}_simulated"].mean() for each in (own, other)]
                verdict[f"{name}_{lux:g}_lux"] = float(pair[0] / pair[1])
        for figure in ("mtf50_cy_per_px", "false_colour", "zone_plate_colour", "picture_error_simulated"):
            if figure in table.columns:
                verdict[figure], verdict[f"{figure}_against"] = (
                    float(np.nanmean(each[figure])) for each in (own, other)
                )
        result.append(verdict)
    return result


def _write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    with output_errors(path):
        path.write_text(yaml_text(dict(content), width=120), encoding="utf-8")


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
    outcome = spread_tile(tile, free, wanted)
    drawn = set(outcome.ravel().tolist())
    return own.model_copy(update={
        "name": f"{own.name}-designed", "tile": "\n".join("".join(row) for row in outcome),
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

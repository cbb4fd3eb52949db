"""The HTML report of a study: one file that needs no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hesim_render.core.drawing import report_style
from hesim_render.core.html import filled, inline_picture, number
from hesim_render.specs.study import StudySpec
from hesim_render.spectral.colorimetry import encode_srgb
from hesim_render.studies.candidate import Seen
from hesim_render.studies.cfa import StudyResult
from hesim_render.studies.plots import PARETO, chart_picture, pareto_plot, patch_plot, response_plot, seen_labels
from hesim_render.studies.table import LEVELS, NOISE_AWARE, NOISE_FREE, NOTE, Cell, Table, level_text
from hesim_render.studies.verdict import (
    DESIGN_FIGURES,
    DESIGN_RATIOS,
    design_verdict,
    grouped,
    level_name,
    levels_of,
    ranking,
)

#: Columns that say which row it is; all but the first are left out if they say the same in every row.
_NAMES = {"filter_set": "filter set", "sensor": "sensor", "crosstalk": "crosstalk", "exposure_us": "exposure, ms"}
#: Columns of the tables of figures: name in the results, heading. Those of colour do not depend on the level.
_COLOUR = {
    "delta_e_mean": "ΔE2000 mean", "delta_e_p95": "95 %", "delta_e_max": "max",
    "delta_e_mean_root_polynomial": "root polynomial", "delta_e_cube_mean": "ΔE2000 of the cube",
    "delta_e_cube_p95": "95 %", "delta_e_cube_max": "max", "smi": "SMI", "vora": "Vora",
    "vora_light": "Vora, this light", "luther_residual": "Luther residual",
    "filter_quality_min": "least filter quality",
}  # fmt: skip
_DETAIL = {
    "picture_error_simulated": "rms error with noise", "mtf50_cy_per_px": "MTF50, cy/px",
    "false_colour": "false colour, C*ab", "zipper": "zipper, %", "star_error": "star, rms",
    "zone_plate_colour": "zone plate, C*ab",
}  # fmt: skip
_EVENTS = {
    "event_contrast_on": "event contrast", "event_noise_rate_hz": "event noise, Hz", "event_seen": "steps seen",
    "event_seen_isoluminant": "isoluminant steps seen",
}  # fmt: skip
#: Tables of one level: heading and columns; those that know the noise come first.
_OF_LEVEL = (
    ("Noise-aware", NOISE_AWARE | LEVELS), ("Noise-free matrix of colour", NOISE_FREE),
    ("After demosaicing; without noise but for the first column where it was simulated", _DETAIL), ("Events", _EVENTS),
)  # fmt: skip
#: End of the columns of figures that have an interval.
_SIMULATED = "_simulated"
#: Most groups that are drawn.
_MOST_GROUPS = 24


def report_page(spec: StudySpec, result: StudyResult, summary: Markup | None = None) -> str:
    """The page of a study, HTML.

    Parameters
    ----------
    spec, result : the study and its results.
    summary : HTML that comes first, after the description.
    """
    with report_style():
        responses = [*map(response_plot, _first_of_each_set(result.seen))]
        groups = grouped(result.table, ("surfaces", "illuminant"))
        drawn = [_group(*group, levels_of(result.table)) for group in groups[:_MOST_GROUPS]]
        patches = _patches(result.seen)
    noisy = (
        f"Simulated figures are means of {spec.noise.repeats} noisy frames, with 95 % intervals (Student's t)."
        if spec.noise.repeats
        else "Noise figures are closed forms."
    )
    return filled(
        "studies/report.html", title=spec.name, description=spec.description, summary=summary or "",
        ranking=ranking(result.table),
        responses=responses, groups=drawn, has_more=len(groups) > _MOST_GROUPS, patches=patches,
        pictures=[(text, inline_picture(encode_srgb(image), text)) for text, image in result.pictures],
        matrix=spec.matrix, area_px=f"{spec.area_px:g}", noisy=noisy, note=NOTE,
    )  # fmt: skip


def verdict_table(verdicts: Sequence[Mapping[str, Any]], costs: NDArray[np.float64], tile: str | None) -> Markup:
    """HTML of how a designed set compares with others.

    Parameters
    ----------
    verdicts : of each set it is compared with.
    costs : of each start before and after, [start, 2].
    tile : the designed tile, where shares were varied.
    """
    result = []
    for verdict in verdicts:
        low, high = (number(verdict[f"cost_difference_{end}"]) for end in ("low", "high"))
        pair = [number(verdict["cost"]), number(verdict["cost_against"])]
        rows = [["judged cost, noise included", *pair, f"difference {low} to {high}"]]
        for start, title in DESIGN_RATIOS.items():
            for key, value in verdict.items():
                if key.startswith(start):
                    lux = key.removeprefix(start).removesuffix("_lux")
                    rows.append([f"{title} at {lux} lx", "", "", f"{number(value)} times"])
        rows += [
            [title, number(verdict[key]), number(verdict[f"{key}_against"]), ""]
            for key, (title, _) in DESIGN_FIGURES.items()
            if key in verdict
        ]
        result.append((str(verdict["against"]), design_verdict(verdict), rows))
    changes = [f"{number(before)} to {number(after)}" for before, after in costs]
    return filled("studies/verdict.html", verdicts=result, tile=tile, costs=changes)


def _first_of_each_set(seen: Sequence[Seen]) -> list[Seen]:
    result: dict[tuple[str, str], Seen] = {}
    for each in seen:
        result.setdefault((each.candidate.sensor_name, each.candidate.set_name), each)
    return list(result.values())


def _group(named: tuple[Cell, ...], group: Table, levels: Sequence[str]) -> dict[str, object]:
    """Drawings and tables of rows in which only sensors, filter sets and crosstalk differ."""
    inner = grouped(group, levels)
    plots = [
        pareto_plot(some, level_name(levels, values))
        for values, some in inner
        if any(row.get(PARETO[0]) is not None and row.get(PARETO[1]) is not None for row in some)
    ]
    tables = [
        (
            level_name(levels, values),
            [(title, *result) for title, columns in _OF_LEVEL if (result := _table(some, columns))],
        )
        for values, some in inner
    ]
    own = [name for name in _NAMES if name != "exposure_us" and name in group.columns]
    first = {tuple(row[name] for name in own): row for row in reversed(list(group))}
    return {
        "title": ", ".join(map(str, named)), "plots": plots, "levels": [level for level in tables if level[1]],
        "colour": _table(Table(reversed(first.values())), _COLOUR),
    }  # fmt: skip


def _table(rows: Table, columns: Mapping[str, str]) -> tuple[list[str], list[list[str]]] | None:
    """Head and lines of a table of some figures; None if no row has any of them."""
    known = [name for name in columns if name in rows.columns and any(row[name] is not None for row in rows)]
    if not known:
        return None
    names = [
        name for name in _NAMES
        if name in rows.columns and (name == "filter_set" or len({row[name] for row in rows}) > 1)
        and not (name == "exposure_us" and columns is _COLOUR)
    ]  # fmt: skip
    lines = []
    for row in rows:
        cells = [_cell(_in_ms(row[name]) if name == "exposure_us" else row[name]) for name in names]
        for name in known:
            text = _cell(row[name])
            if name == "white_saturation":
                text = level_text(row, text)
            if name.endswith(_SIMULATED) and row[name] is not None:
                low, high = (row.get(f"{name.removesuffix(_SIMULATED)}_{end}") for end in ("low", "high"))
                if isinstance(low, float) and isinstance(high, float) and low == low:
                    text += f" ({number(low)} to {number(high)})"
            cells.append(text)
        lines.append(cells)
    return [*(_NAMES[name] for name in names), *(columns[name] for name in known)], lines


def _in_ms(value: Cell) -> Cell:
    return float(value) / 1000 if isinstance(value, int | float) else value


def _cell(value: object) -> str:
    if value is None:
        return "–"
    return number(float(value)) if isinstance(value, int | float) else str(value)


def _patches(seen: Sequence[Seen]) -> list[tuple[str, list[tuple[str, Markup]]]]:
    """Of all that share surfaces and light: a drawing of their patches, and each chart with its caption."""
    coloured = [each for each in seen if each.colour is not None]
    result = []
    for _, group in groupby(coloured, key=lambda each: (each.surfaces, each.light_name)):
        some = list(group)
        named = zip(some, seen_labels(some), strict=True)
        charts = [(text, inline_picture(chart_picture(each), text)) for each, text in named]
        result.append((patch_plot(some), charts))
    return result

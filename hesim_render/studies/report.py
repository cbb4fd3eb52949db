"""The HTML report of a study: one file that needs no other file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.drawing import report_style
from hesim_render.core.html import PAGE_STYLE, inline_picture, number, row_of, table
from hesim_render.specs.study import StudySpec
from hesim_render.spectral.colorimetry import encode_srgb
from hesim_render.studies.cfa import StudyResult
from hesim_render.studies.headings import LEVELS, NOISE_AWARE, NOISE_FREE, NOTE, level_text
from hesim_render.studies.plots import PARETO, chart_picture, pareto_plot, patch_plot, response_plot, seen_labels
from hesim_render.studies.seen import Seen
from hesim_render.studies.table import Cell, Table

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


def report_page(spec: StudySpec, result: StudyResult, summary: str = "") -> str:
    """The page of a study.

    Parameters
    ----------
    spec, result : the study and its results.
    summary : HTML that comes first, after the description.

    Returns
    -------
    HTML.
    """
    parts = [f"<h1>{escape(spec.name)}</h1>", f"<p>{escape(spec.description)}</p>" if spec.description else ""]
    parts.append(summary)
    with report_style():
        parts += ["<h2>Filter sets</h2>", row_of(*map(response_plot, _first_of_each_set(result.seen)))]
        parts += _groups(result.table)
        parts += _patches(result.seen)
    if result.pictures:
        parts.append("<h2>Patterns after demosaicing</h2>")
        figures = (
            f"{inline_picture(encode_srgb(image), text)}<figcaption>{escape(text)}</figcaption>"
            for text, image in result.pictures
        )
        parts.append(row_of(*figures))
    parts.append(_method(spec))
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{escape(spec.name)}</title><style>{PAGE_STYLE}</style></head><body>{body}</body></html>\n"
    )


def verdict_table(verdicts: Sequence[Mapping[str, Any]], costs: NDArray[np.float64], tile: str | None) -> str:
    """HTML of how a designed set compares with others.

    Parameters
    ----------
    verdicts : of each set it is compared with.
    costs : of each start before and after, [start, 2].
    tile : the designed tile, where shares were varied.
    """
    parts = ["<h2>Verdict</h2>"]
    named = {"delta_e_mean": "mean ΔE2000 without noise", "mtf50_cy_per_px": "MTF50, cy/px",
             "false_colour": "false colour, C*ab", "zone_plate_colour": "zone plate, C*ab",
             "picture_error_simulated": "rms error with noise"}  # fmt: skip
    ratios = {"ysnr_noise_aware_ratio_": "YSNR, noise-aware,", "ysnr_ratio_": "YSNR, matrix of colour,"}
    for verdict in verdicts:
        low, high = (number(verdict[f"cost_difference_{end}"]) for end in ("low", "high"))
        pair = [number(verdict["cost"]), number(verdict["cost_against"])]
        rows = [["judged cost, noise included", *pair, f"difference {low} to {high}"]]
        for start, title in ratios.items():
            for key, value in verdict.items():
                if key.startswith(start):
                    lux = key.removeprefix(start).removesuffix("_lux")
                    rows.append([f"{title} at {lux} lx", "", "", f"{number(value)} times"])
        rows += [
            [title, number(verdict[key]), number(verdict[f"{key}_against"]), ""]
            for key, title in named.items()
            if key in verdict
        ]
        parts.append(table(["", "designed", str(verdict["against"]), "95 % interval or ratio"], rows))
    if tile is not None:
        parts.append(f"<p>Designed tile:</p><pre>{escape(tile)}</pre>")
    changes = ", ".join(f"{number(before)} to {number(after)}" for before, after in costs)
    parts.append(f"<p>Cost of the optimiser, before and after, for each start: {changes}.</p>")
    return "\n".join(parts)


def _first_of_each_set(seen: Sequence[Seen]) -> list[Seen]:
    found: dict[tuple[str, str], Seen] = {}
    for each in seen:
        found.setdefault((each.candidate.sensor_name, each.candidate.set_name), each)
    return list(found.values())


def _groups(rows: Table) -> list[str]:
    """Drawings and tables of each group of rows in which only sensors, filter sets and crosstalk differ."""
    lights, levels = ("surfaces", "illuminant"), ["illuminance_lux", "equal"]
    of_sensor: dict[Cell, set[Cell]] = {}
    for row in rows:
        of_sensor.setdefault(row["sensor"], set()).add(row.get("nominal_exposure_us"))
    if max(map(len, of_sensor.values())) > 1:  # else each sensor has its own exposure
        levels.append("nominal_exposure_us")
    parts = []
    for number_, ((surfaces, light), group) in enumerate(_grouped(rows, lights)):
        if number_ == _MOST_GROUPS:
            parts.append("<p>More groups of rows are in results.csv.</p>")
            break
        parts.append(f"<h2>{escape(f'{surfaces}, {light}')}</h2>")
        inner = _grouped(group, levels)
        plots = [
            pareto_plot(some, _level(levels, values))
            for values, some in inner
            if any(row.get(PARETO[0]) is not None and row.get(PARETO[1]) is not None for row in some)
        ]
        parts.append(row_of(*plots) if plots else "")
        named = [name for name in _NAMES if name != "exposure_us" and name in group.columns]
        first = {tuple(row[name] for name in named): row for row in reversed(list(group))}
        for values, some in inner:
            tables = [_captioned(title, _table(some, columns)) for title, columns in _OF_LEVEL]
            if any(tables):
                parts += [f"<h3>{escape(_level(levels, values))}</h3>", *tables]
        parts.append(_captioned("Colour, without noise", _table(Table(reversed(first.values())), _COLOUR)))
    return parts


def _grouped(rows: Table, keys: Sequence[str]) -> list[tuple[tuple[Cell, ...], Table]]:
    """The rows by the values of some columns, in the order in which these first occur."""
    found: dict[tuple[Cell, ...], list[dict[str, Cell]]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in keys), []).append(row)
    return [(values, Table(group)) for values, group in found.items()]


def _level(keys: Sequence[str], values: Sequence[Cell]) -> str:
    named = dict(zip(keys, values, strict=True))
    text = f"{named['illuminance_lux']:g} lx, equal {named['equal']}"
    return text + (f", {named['nominal_exposure_us']:g} µs" if named.get("nominal_exposure_us") else "")


def _captioned(title: str, html: str) -> str:
    return html and f"<p><b>{escape(title)}</b></p>{html}"


def _table(rows: Table, columns: Mapping[str, str]) -> str:
    """A table of some figures; empty if no row has any of them."""
    known = [name for name in columns if name in rows.columns and any(row[name] is not None for row in rows)]
    if not known:
        return ""
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
    return table([*(_NAMES[name] for name in names), *(columns[name] for name in known)], lines)


def _in_ms(value: Cell) -> Cell:
    return float(value) / 1000 if isinstance(value, int | float) else value


def _cell(value: object) -> str:
    if value is None:
        return "–"
    return number(float(value)) if isinstance(value, int | float) else str(value)


def _patches(seen: Sequence[Seen]) -> list[str]:
    coloured = [each for each in seen if each.colour is not None]
    if not coloured:
        return []
    parts = ["<h2>Colours</h2>"]
    key = lambda each: (each.surfaces, each.light_name)  # noqa: E731
    for _, group in groupby(coloured, key=key):
        some = list(group)
        parts.append(row_of(patch_plot(some)))
        named = zip(some, seen_labels(some), strict=True)
        charts = (
            f"{inline_picture(chart_picture(each), text)}<figcaption>{escape(text)}</figcaption>"
            for each, text in named
        )
        parts.append(row_of(*charts))
    parts.append(
        "<p>Upper left half of a patch: its true colour. Lower right half: after the matrix of the filter set, without "
        "noise.</p>"
    )
    return parts


def _method(spec: StudySpec) -> str:
    noisy = (
        f"Simulated figures are means of {spec.noise.repeats} noisy frames, with 95 % intervals (Student's t)."
        if spec.noise.repeats
        else "Noise figures are closed forms."
    )
    return (
        f"<h2>Method</h2><p>Matrix: {escape(spec.matrix)}. Output pixels are those of {spec.area_px:g} pixels of the "
        f"mosaic. YSNR and SNR10 are of the luminance 0.299 R + 0.587 G + 0.114 B on an 18 % grey card, without fixed "
        f"patterns. {noisy} {NOTE}</p>"
    )

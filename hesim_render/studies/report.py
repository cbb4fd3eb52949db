"""The HTML report of a study, with its plots: one file that needs no other file."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from hesim_render.core.drawing import COLOURS, legend_below, new_figure, panel, report_style, svg
from hesim_render.core.html import filled, inline_picture, number
from hesim_render.specs.study import StudySpec
from hesim_render.spectral.colorimetry import encode_srgb, xyz_to_linear_srgb
from hesim_render.studies.candidate import Seen
from hesim_render.studies.cfa import StudyResult
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
_MARKERS = "osD^vP*X<>hp"
#: Wavelengths at which responses are drawn, nm.
_GRID_NM = np.arange(380.0, 731.0, 2.0)


#: Columns that are drawn against each other: colour error and luminance SNR, both with the noise-aware matrix.
PARETO = ("delta_e_mean_noise_aware", "ysnr_noise_aware")


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


def pareto_front(cost: NDArray[np.float64], gain: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points no other point beats: none has at most the cost and at least the gain, and one of them better."""
    better = (cost[None] <= cost[:, None]) & (gain[None] >= gain[:, None])
    strictly = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.asarray(~(better & strictly).any(axis=1), dtype=np.bool_)


def pareto_plot(rows: Table, title: str) -> str:
    """SVG of colour error against luminance SNR, one point a filter set; the front is a line. Hollow: white clips."""
    figure, axes = panel(title, "mean ΔE2000, noise-aware matrix", "YSNR of an 18 % grey card, noise-aware", (400, 300))
    rows = Table(row for row in rows if all(row[name] is not None for name in PARETO))
    error, snr, clipped = rows[PARETO[0]], rows[PARETO[1]], rows["white_clipped"].astype(bool)
    names = _labels([(row["filter_set"], row["sensor"], row["crosstalk"]) for row in rows])
    for k, name in enumerate(dict.fromkeys(names)):
        own = np.array([other == name for other in names])
        clips = bool(clipped[own].any())
        axes.plot(
            error[own], snr[own], linestyle="none", marker=_MARKERS[k % len(_MARKERS)], markersize=7,
            color=COLOURS[k % len(COLOURS)], fillstyle="none" if clips else "full",
            markeredgewidth=1.5 if clips else 0, label=name + (" (white clips)" if clips else ""),
        )  # fmt: skip
    front = np.flatnonzero(pareto_front(error, snr))
    order = front[np.argsort(error[front])]
    axes.plot(error[order], snr[order], color="#888888", linewidth=1, zorder=0)
    axes.set(xlim=(0, 1.06 * float(error.max())), ylim=(0, 1.06 * float(snr.max())))
    legend_below(figure, axes, 3)
    return svg(figure)


def response_plot(seen: Seen) -> str:
    """SVG of the responses of one filter set, the largest at 1; event pixels dashed."""
    candidate = seen.candidate
    figure, axes = panel(
        f"{candidate.set_name}, {candidate.sensor_name}", "wavelength, nm", "response, relative", (300, 210)
    )
    curves = [(name, each, "-") for name, each in zip(candidate.channels, candidate.responses, strict=True)]
    curves += [
        (f"{name} (events)", each, "--")
        for name, each in zip(candidate.event_filters, candidate.event_responses, strict=True)
    ]
    largest = max(float(each.values.max()) for _, each, _ in curves)
    for name, each, style in curves:
        values = each.at(_GRID_NM) / largest
        axes.plot(_GRID_NM, values, style, color=_colour_of(name), label=name)
    axes.set_ylim(0, 1.05)
    legend_below(figure, axes, 3)
    return svg(figure)


def _colour_of(name: str) -> str:
    known = {
        "red": "#d62f2f", "green": "#2f9e44", "blue": "#2255cc", "yellow": "#c9a400", "cyan": "#17a2b8",
        "magenta": "#c2369b", "clear": "#777777", "white": "#777777",
    }  # fmt: skip
    return next((colour for key, colour in known.items() if name.lower().startswith(key)), "#000000")


def patch_plot(group: Sequence[Seen]) -> str:
    """SVG of ΔE2000 of every patch (columns) behind every filter set (rows)."""
    table = np.array([each.delta_e for each in group])
    figure = new_figure((max(420, 12 * table.shape[1] + 190), 22 * len(group) + 80))
    axes = figure.subplots()
    # a mesh and no picture: programs that show SVG smooth pictures
    image = axes.pcolormesh(table, cmap="cividis", vmin=0, vmax=max(float(table.max()), 1e-9), linewidth=0)
    axes.invert_yaxis()
    axes.set_yticks(np.arange(len(group)) + 0.5, seen_labels(group))
    axes.set(title=f"ΔE2000 of each surface, {group[0].surfaces} under {group[0].light_name}", xlabel="surface")
    axes.grid(False)
    figure.colorbar(image, ax=axes)
    return svg(figure)


def chart_picture(seen: Seen) -> NDArray[np.uint8]:
    """Patches in sRGB: the true colour in the upper left half of each, that after the matrix in the lower right half.

    Parameters
    ----------
    seen : with a matrix.

    Returns
    -------
    uint8 [row, col, 3].
    """
    assert seen.colour is not None
    across, size_px = 6, 26
    samples = seen.samples
    count = min(len(samples.xyz), 4 * across)
    chosen = np.linspace(0, len(samples.xyz) - 1, count).round().astype(int)  # of many, evenly spaced ones
    true = encode_srgb(xyz_to_linear_srgb(samples.xyz[chosen], samples.white_xyz))
    camera = encode_srgb(xyz_to_linear_srgb(samples.camera[chosen] @ seen.colour.matrix.T, samples.white_xyz))
    lower = np.add.outer(np.arange(size_px), np.arange(size_px)) >= size_px
    down = -(-count // across)
    out = np.full((down * size_px, across * size_px, 3), 40, np.uint8)
    for place in range(count):
        top, left = place // across * size_px, place % across * size_px
        cell = np.where(lower[..., None], camera[place], true[place])
        out[top : top + size_px - 2, left : left + size_px - 2] = cell[:-2, :-2]
    return out


def seen_labels(group: Sequence[Seen]) -> list[str]:
    """Names of the filter sets, with sensor and crosstalk where there are several."""
    every = [each.candidate for each in group]
    return _labels([(each.set_name, each.sensor_name, each.crosstalk) for each in every])


def _labels(named: Sequence[tuple[object, ...]]) -> list[str]:
    """Texts of filter set, sensor and crosstalk, the last two where there are several."""
    _, sensors, crosstalks = map(set, zip(*named, strict=True))
    return [
        str(name) + (f", {sensor}" if len(sensors) > 1 else "")
        + (f", crosstalk {crosstalk:g}" if len(crosstalks) > 1 else "")
        for name, sensor, crosstalk in named
    ]  # fmt: skip

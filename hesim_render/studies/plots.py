"""Drawings of a study: Pareto fronts, responses, colour errors of patches, charts as the sensors see them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.drawing import COLOURS, legend_below, new_figure, panel, svg
from hesim_render.spectral.colorimetry import encode_srgb, xyz_to_linear_srgb
from hesim_render.studies.candidate import Seen
from hesim_render.studies.table import Table

_MARKERS = "osD^vP*X<>hp"
#: Wavelengths at which responses are drawn, nm.
_GRID_NM = np.arange(380.0, 731.0, 2.0)


#: Columns that are drawn against each other: colour error and luminance SNR, both with the noise-aware matrix.
PARETO = ("delta_e_mean_noise_aware", "ysnr_noise_aware")


def pareto_front(cost: NDArray[np.float64], gain: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points no other point beats: none has at most the cost and at least the gain, and one of them better."""
    better = (cost[None] <= cost[:, None]) & (gain[None] >= gain[:, None])
    strictly = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.asarray(~(better & strictly).any(axis=1), dtype=np.bool_)


def pareto_plot(rows: Table, title: str) -> str:
    """SVG of colour error against luminance SNR, one point a filter set; the front is a line. Hollow: white clips."""
    figure, axes = panel(title, "mean ΔE2000, noise-aware matrix", "YSNR of an 18 % grey card, noise-aware", (400, 300))
    rows = Table(row for row in rows if all(row[name] is not None for name in PARETO))
    error, snr, clipped, names = rows[PARETO[0]], rows[PARETO[1]], rows["white_clipped"].astype(bool), _labels(rows)
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
    for number in range(count):
        top, left = number // across * size_px, number % across * size_px
        cell = np.where(lower[..., None], camera[number], true[number])
        out[top : top + size_px - 2, left : left + size_px - 2] = cell[:-2, :-2]
    return out


def seen_labels(group: Sequence[Seen]) -> list[str]:
    """Names of the filter sets, with sensor and crosstalk where there are several."""
    several = len({each.candidate.sensor_name for each in group}) > 1
    crossed = len({each.candidate.crosstalk for each in group}) > 1
    return [
        each.candidate.set_name + (f", {each.candidate.sensor_name}" if several else "")
        + (f", crosstalk {each.candidate.crosstalk:g}" if crossed else "")
        for each in group
    ]  # fmt: skip


def _labels(rows: Table) -> list[str]:
    """Names of the filter sets, with the sensor where there are several."""
    several = len(set(rows["sensor"])) > 1
    crossed = len(set(rows["crosstalk"])) > 1
    return [
        str(row["filter_set"]) + (f", {row['sensor']}" if several else "")
        + (f", crosstalk {row['crosstalk']:g}" if crossed else "")
        for row in rows
    ]  # fmt: skip

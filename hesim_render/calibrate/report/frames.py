"""The report's section on frames."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report.parts import HEAD, findings, headline, p_text, parameter_row, with_interval
from hesim_render.core.drawing import COLOURS, legend_below, new_figure, panel, picture, points, svg
from hesim_render.core.html import filled, number
from hesim_render.pixels.aps.formulas import polynomial


def aps_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    """HTML of the section.

    Parameters
    ----------
    section : ``aps`` of a ``calibration.yaml``.
    maps : its arrays, see `read_maps`; those called ``figure_…`` are drawn.
    """
    n_row = maps["n_row"]
    band = np.repeat(n_row[:, None], max(8, len(n_row) // 3), axis=1)
    step = max(1, len(n_row) // 320)
    exposure = float(maps["figure_variance_exposure_us"]) / 1000
    of_pairs = _is_of_pairs(section)
    return filled(
        "calibrate/report/frames.html",
        headline=headline(section),
        findings=findings(section),
        maps=(
            picture("Row bias", band[::step, ::step], "DN", 390),
            _profile(n_row),
            picture(f"Temporal variance per pixel, lit, {exposure:g} ms", maps["figure_variance_map"], "DN²", 330),
        ),
        histograms=[
            _histogram(f"{name}, {'long series' if of_pairs else 'longest exposure'}", maps[f"figure_noise_{name}"])
            for name in ("dark", "lit")
        ],
        points="of a pair of frames each" if of_pairs else "pooled, one colour an exposure",
        variances=_variance_panels(section, maps["figure_variance_points"]),
        head=HEAD,
        parameters=_transfer_rows(section),
        beta_head=("position", *(f"β{k} ({t})" for k, t in enumerate(section["terms"])), "χ²/dof", "p"),
        beta=_beta_rows(section),
        notes=section["notes"],
    )


def _profile(n_row: NDArray) -> str:
    figure, axes = panel("Row bias N_row", "row", "DN")
    axes.plot(np.arange(len(n_row)), n_row, color=COLOURS[0])
    axes.set_xlim(0, len(n_row))
    return svg(figure)


def _histogram(name: str, values: NDArray) -> str:
    x, measured, predicted = values.T
    figure, axes = panel(f"Noise of single values, {name}", "deviation from the mean, DN", "density, 1/DN")
    half = (x[1] - x[0]) / 2 if len(x) > 1 else 0.5
    axes.stairs(measured, np.append(x - half, x[-1] + half), fill=True, color=COLOURS[0], alpha=0.35, label="measured")
    axes.plot(x, predicted, color=COLOURS[1], label="predicted")
    legend_below(figure, axes, 2)
    return svg(figure)


def _variance_panels(section: dict[str, Any], pooled: NDArray) -> list[str]:
    figures = []
    for i, row in enumerate(section["beta"]):
        for j, cell in enumerate(row):
            here = pooled[(pooled[:, 0] == i) & (pooled[:, 1] == j)]
            if len(here) and any(b is not None for b in cell):
                beta = np.array([0.0 if b is None else b for b in cell])
                is_one = len(section["beta"]) == len(row) == 1
                figures.append(_variance_panel("Variance" if is_one else f"Variance, ({i}, {j})", beta, here))
    return figures


def _variance_panel(title: str, beta: NDArray, here: NDArray) -> str:
    """Variances of one tile position against light, and their residuals from the polynomial `beta`."""
    exposure_s, x, y = here[:, 2], here[:, 4], here[:, 5]
    relative = 100 * (y / polynomial(beta, x, exposure_s) - 1)
    reach = max(3.0, 1.08 * float(np.abs(relative).max()))
    figure = new_figure((300, 340))
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    upper.set(title=title, ylabel="variance, DN²")
    lower.set(xlabel="light signal, DN", ylabel="residual, %", ylim=(-reach, reach))
    exposures = np.unique(exposure_s)
    for k, t in enumerate(exposures):
        colour, use = COLOURS[k % len(COLOURS)], exposure_s == t
        points(upper, x[use], y[use], colour, f"{1e3 * t:g} ms" if len(exposures) > 1 else "pairs of frames", 3.0)
        line = np.linspace(x[use].min(), x[use].max(), 60)
        upper.plot(line, polynomial(beta, line, t), color=colour)
        points(lower, x[use], relative[use], colour, size=2.6)
    upper.set_ylim(bottom=min(0.0, float(y.min())))
    legend_below(figure, upper, 4)
    return svg(figure)


def _is_of_pairs(section: dict[str, Any]) -> bool:
    """Whether it was found from captures of EMVA 1288."""
    return "quantum_efficiency" in section


def _transfer_rows(section: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    of_pairs = _is_of_pairs(section)
    names = {
        "K": "K, system gain (EMVA 1288)", "read_noise_e": "read noise", "dark_current_e_per_s": "dark current",
        "full_well_e": "saturation capacity", "prnu_percent": "PRNU",
        "dsnu_e": "DSNU" if of_pairs else "DSNU (without rows)",
        "linearity_error_percent": "linearity error", "row_noise_dn": "temporal row noise",
        "quantum_efficiency": "quantum efficiency", "responsivity": "responsivity",
        "temporal_dark_noise_e": "temporal dark noise (EMVA 1288)", "column_noise_dn": "temporal column noise",
        "read_noise_correlation": "correlation of dark noise along rows",
    }  # fmt: skip
    rows = [parameter_row(text, section[key]) for key, text in names.items() if key in section]
    rows += [
        ("black level", number(section["black_dn"]), "", "DN"),
        ("std of N_row", number(section["n_row_std_dn"]), "", "DN"),
        ("defect pixels", str(section["bad_pixels"]), "", "unlike the others in the dark or in the light")
        if of_pairs
        else ("hot / bad pixels", f"{section['hot_pixels']} / {section['bad_pixels']}", "", ""),
    ]
    if section.get("telegraph_pixels") is not None:
        rows.append(("pixels with telegraph noise", str(section["telegraph_pixels"]), "", "two levels"))
    return rows


def _beta_rows(section: dict[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for i, row in enumerate(section["beta"]):
        for j, cell in enumerate(row):
            errors = section["beta_standard_error"][i][j]
            if any(b is not None for b in cell):
                goodness = section["goodness"]
                chances = goodness.get("p_value")
                fit = f"{goodness['chi2_per_dof'][i][j]:.3f}", p_text(chances[i][j] if chances else None)
                rows.append((f"({i}, {j})", *map(with_interval, cell, errors), *fit))
    return rows

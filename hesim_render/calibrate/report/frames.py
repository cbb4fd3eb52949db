"""The report's section on frames."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report.parts import findings, p_text, parameter_row, row_of, span_of
from hesim_render.calibrate.report.svg import COLOURS, Plot, number, picture, table
from hesim_render.pixels.aps.formulas import polynomial


def aps_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    rows = np.arange(len(maps["n_row"]))
    n_row = maps["n_row"]
    band = np.repeat(n_row[:, None], max(8, len(n_row) // 3), axis=1)
    step = max(1, len(n_row) // 320)
    profile = Plot("Row bias N_row", "row", "DN", (0, len(rows)), span_of(n_row)).line(rows, n_row, COLOURS[0])
    exposure = float(maps["figure_variance_exposure_us"]) / 1000
    parts = [
        "<h2>Frames (APS)</h2>",
        findings(section),
        row_of(
            picture("Row bias", band[::step, ::step], "DN", 390),
            profile.svg(),
            picture(f"Temporal variance per pixel, lit, {exposure:g} ms", maps["figure_variance_map"], "DN²", 330),
        ),
        row_of(*(_histogram(name, maps[f"figure_noise_{name}"]) for name in ("dark", "lit"))),
        "<h2>Variance against brightness, per tile position</h2>"
        "<p>Points: pooled sample variances less the ADC's 1/12 DN², one colour an exposure. Lines: the fitted "
        "polynomial. Below each: the residual in per cent.</p>",
        _variance_panels(section, maps["figure_variance_points"]),
        "<h2>Parameters (APS)</h2>",
        _transfer_table(section),
        _beta_table(section),
        "".join(f"<p>Note: {escape(note)}</p>" for note in section["notes"]),
    ]
    return "\n".join(parts)


def _histogram(name: str, values: NDArray) -> str:
    x, measured, predicted = values.T
    plot = Plot(
        f"Noise of single values, {name}, longest exposure",
        "deviation from the mean, DN",
        "density, 1/DN",
        (x[0], x[-1]),
        (0, 1.08 * measured.max()),
    )
    return plot.bars(x, measured, COLOURS[0], "measured").line(x, predicted, COLOURS[1], "predicted").svg()


def _variance_panels(section: dict[str, Any], points: NDArray) -> str:
    figures = []
    for i, row in enumerate(section["beta"]):
        for j, cell in enumerate(row):
            here = points[(points[:, 0] == i) & (points[:, 1] == j)]
            if len(here) == 0 or all(b is None for b in cell):
                continue
            beta = np.array([0.0 if b is None else b for b in cell])
            x, y = here[:, 4], here[:, 5]
            upper = Plot(
                f"({i}, {j})",
                "light signal, DN",
                "variance, DN²",
                span_of(x),
                (0, 1.05 * y.max()),
                size=(300, 210),
            )
            relative = 100 * (y / polynomial(beta, x, here[:, 2]) - 1)
            reach = max(3.0, 1.05 * float(np.abs(relative).max()))
            lower = Plot("", "light signal, DN", "residual, %", span_of(x), (-reach, reach), size=(300, 130))
            for k, t in enumerate(np.unique(here[:, 2])):
                colour, use = COLOURS[k % len(COLOURS)], here[:, 2] == t
                upper.points(x[use], y[use], colour, f"{1e3 * t:g} ms", 1.5)
                line = np.linspace(x[use].min(), x[use].max(), 60)
                upper.line(line, polynomial(beta, line, t), colour)
                lower.points(x[use], relative[use], colour, "", 1.3)
            figures.append(upper.svg() + "<br>" + lower.svg())
    return row_of(*figures)


def _transfer_table(section: dict[str, Any]) -> str:
    names = {
        "K": "K, system gain (EMVA 1288)", "read_noise_e": "read noise", "dark_current_e_per_s": "dark current",
        "full_well_e": "saturation capacity", "dsnu_e": "DSNU (without rows)", "prnu_percent": "PRNU",
        "linearity_error": "linearity error", "row_noise_dn": "temporal row noise",
    }  # fmt: skip
    rows = [parameter_row(text, section[key]) for key, text in names.items() if key in section]
    rows += [
        ("black level", number(section["black_dn"]), "", "DN"),
        ("std of N_row", number(section["n_row_std_dn"]), "", "DN"),
        ("hot / bad pixels", f"{section['hot_pixels']} / {section['bad_pixels']}", "", ""),
    ]
    return table(("parameter", "value", "95 % interval", "unit, or why not"), rows)


def _beta_table(section: dict[str, Any]) -> str:
    rows = []
    for i, row in enumerate(section["beta"]):
        for j, cell in enumerate(row):
            errors = section["beta_standard_error"][i][j]
            if any(b is not None for b in cell):
                goodness = section["goodness"]
                chances = goodness.get("p_value")
                fit = f"{goodness['chi2_per_dof'][i][j]:.3f}", p_text(chances[i][j] if chances else None)
                texts = [
                    "not identifiable" if b is None else f"{b:.4g} ± {1.96 * e:.2g}"
                    for b, e in zip(cell, errors, strict=True)
                ]
                rows.append((f"({i}, {j})", *texts, *fit))
    return table(("position", *(f"β{k} ({t})" for k, t in enumerate(section["terms"])), "χ²/dof", "p"), rows)

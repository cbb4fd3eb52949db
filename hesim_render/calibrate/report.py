"""The calibration report: one HTML file that needs nothing else."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.result import check_report, read_calibration, read_maps, report_beginning
from hesim_render.calibrate.svg import COLOURS, Plot, number, picture, table
from hesim_render.calibrate.variance import polynomial
from hesim_render.output import replacing
from hesim_render.specs.calibration import as_written

#: Mean number of events of which a chance of 5 % is left that none is counted: −ln 0.05.
_UPPER_OF_NONE = 3.0
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;color:#1b1b1b;max-width:1320px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2.2rem;border-bottom:1px solid #ccc}
.row{display:flex;flex-wrap:wrap;gap:18px;align-items:flex-start}figure{margin:0}
figcaption{font-size:.85rem;color:#555;max-width:52rem}
table{border-collapse:collapse;font-size:.85rem;margin:.6rem 0}
td,th{padding:.15rem .6rem;border-bottom:1px solid #ddd;text-align:left;font-variant-numeric:tabular-nums}
svg text{font:11px system-ui,sans-serif;fill:#333}svg .title{font-weight:600;font-size:12px}
svg .label,svg .tick{text-anchor:middle}svg .end{text-anchor:end}svg .start{text-anchor:start}
svg .grid{stroke:#e4e4e4;fill:none}svg .axis{stroke:#555;fill:none}
"""


def write_report(calibration: str | Path, report: str | Path, overwrite: bool = False) -> Path:
    """Draw every section of a ``calibration.yaml`` into one HTML file.

    Parameters
    ----------
    overwrite : replace a report that is there.

    Raises
    ------
    SpecError
        If the calibration or its maps cannot be read.
    OutputError
        If the report cannot be written, or something is there that must not be replaced.
    """
    path = check_report(calibration, report, overwrite)
    data = read_calibration(calibration)
    with as_written(calibration):
        parts = [_introduction(data)]
        if "aps" in data:
            parts.append(_aps(data["aps"], read_maps(calibration, "aps", data)))
        if "evs" in data:
            parts.append(_evs(data["evs"], read_maps(calibration, "evs", data)))
    body = "\n".join(parts)
    page = (
        f'{report_beginning(calibration)}"><title>Noise calibration</title>'
        f"<style>{_STYLE}</style></head><body>{body}</body></html>\n"
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return Path(report)


def _introduction(data: dict[str, Any]) -> str:
    capture = data["capture"]
    rows = [(key, str(value)) for key, value in capture.items() if value not in (None, "")]
    of = f" of {escape(capture['sensor'])}" if "sensor" in capture else ""
    return f"<h1>Noise calibration{of}</h1>{table(('capture', ''), rows)}"


def _row(*figures: str) -> str:
    return '<div class="row">' + "".join(f"<figure>{f}</figure>" for f in figures if f) + "</div>"


def _aps(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    rows = np.arange(len(maps["n_row"]))
    n_row = maps["n_row"]
    band = np.repeat(n_row[:, None], max(8, len(n_row) // 3), axis=1)
    step = max(1, len(n_row) // 320)
    profile = Plot("Row bias N_row", "row", "DN", (0, len(rows)), _span(n_row)).line(rows, n_row, COLOURS[0])
    exposure = float(maps["figure_variance_exposure_us"]) / 1000
    parts = [
        "<h2>Frames (APS)</h2>",
        _row(
            picture("Row bias", band[::step, ::step], "DN", 130),
            profile.svg(),
            picture(f"Temporal variance per pixel, lit, {exposure:g} ms", maps["figure_variance_map"], "DN²", 330),
        ),
        _row(*(_histogram(name, maps[f"figure_noise_{name}"]) for name in ("dark", "lit"))),
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
                _span(x),
                (0, 1.05 * y.max()),
                size=(300, 210),
                legend="left",
            )
            relative = 100 * (y / polynomial(beta, x, here[:, 2]) - 1)
            lower = Plot("", "light signal, DN", "residual, %", _span(x), (-6, 6), size=(300, 130))
            for k, t in enumerate(np.unique(here[:, 2])):
                colour, use = COLOURS[k % len(COLOURS)], here[:, 2] == t
                upper.points(x[use], y[use], colour, f"{1e3 * t:g} ms", 1.5)
                line = np.linspace(x[use].min(), x[use].max(), 60)
                upper.line(line, polynomial(beta, line, t), colour)
                lower.points(x[use], relative[use], colour, "", 1.3)
            figures.append(upper.svg() + "<br>" + lower.svg())
    return _row(*figures)


def _transfer_table(section: dict[str, Any]) -> str:
    names = {
        "K": "K, system gain (EMVA 1288)", "read_noise_e": "read noise", "dark_current_e_per_s": "dark current",
        "full_well_e": "saturation capacity", "dsnu_e": "DSNU (without rows)", "prnu_percent": "PRNU",
        "linearity_error": "linearity error",
    }  # fmt: skip
    rows = [_parameter_row(text, section[key]) for key, text in names.items()]
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
                chi2 = section["goodness"]["chi2_per_dof"][i][j]
                texts = [
                    "not identifiable" if b is None else f"{b:.4g} ± {1.96 * e:.2g}"
                    for b, e in zip(cell, errors, strict=True)
                ]
                rows.append((f"({i}, {j})", *texts, f"{chi2:.3f}"))
    return table(("position", *(f"β{k} ({t})" for k, t in enumerate(section["terms"])), "χ²/dof"), rows)


def _parameter_row(name: str, item: Any) -> tuple[str, str, str, str]:
    if not isinstance(item, dict):
        return name, number(item), "", ""
    if item["value"] is None:
        return name, "not identifiable", "", item["reason"]
    interval = item.get("interval_95")
    note = item.get("note", "")
    between = f"{interval[0]:.5g} to {interval[1]:.5g}" if interval else ""
    return name, f"{item['value']:.5g}", between, " ".join(t for t in (item.get("unit", ""), note) if t)


def _evs(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    parts = [
        "<h2>Events (EVS)</h2>",
        _row(
            picture("Event probability per trial, mean of ON and OFF", maps["figure_probability"], "", 340),
            _rates(maps),
            _position_rates(maps),
        ),
        "<p>Arrows: no event was counted; they start at the 95 % limit.</p>",
        _row(*(_on_off(name, maps) for name in ("lit", "dark"))),
        _row(_steps(maps), _starts(section, maps)),
        "<h2>Parameters (EVS)</h2>",
        table(("parameter", "value", "95 % interval", "unit, or why not"), _evs_rows(section)),
        f"<p>{escape(section['model'])}. Gauge of β: {escape(section['gauge'])}.</p>",
        _position_table(section),
    ]
    return "\n".join(parts)


def _brightness_axis(signal: NDArray) -> tuple[str, tuple[float, float], bool]:
    """Label, range and whether it is logarithmic: where the brightness spans more than a factor of 100."""
    top, lowest = float(signal.max()), float(signal[signal > 0].min(initial=np.inf))
    if not top > 100 * lowest:
        return "light signal, DN", _span(signal), False
    dark = " (dark at the left edge)" if np.any(signal == 0) else ""
    return f"light signal, DN{dark}", (lowest / 1.5, 1.1 * top), True


def _rates(maps: dict[str, NDArray]) -> str:
    signal, on, off, trials = maps["figure_rates"].T
    line, fit_on, fit_off = maps["figure_rates_fit"].T
    lowest, highest = _probability_span(np.concatenate([on, off]), np.concatenate([trials, trials]))
    label, reach, log_x = _brightness_axis(signal)
    range_ = 0.8 * min(lowest, fit_on.min(), fit_off.min()), 1.2 * highest
    title = "Event probability against brightness"
    plot = Plot(title, label, "P per trial", reach, range_, log_y=True, log_x=log_x)
    _counted(plot, signal, on, trials, COLOURS[1], "ON")
    _counted(plot, signal, off, trials, COLOURS[0], "OFF")
    return plot.line(line, fit_on, COLOURS[1]).line(line, fit_off, COLOURS[0], dashed=True).svg()


def _position_rates(maps: dict[str, NDArray]) -> str:
    fits = maps["figure_position_fits"]
    position, signal, on, off, trials = maps["figure_position_rates"].T
    lowest, highest = _probability_span(on + off, 2 * trials)
    label, reach, log_x = _brightness_axis(signal)
    range_ = 0.8 * min(lowest, fits.min()), 1.2 * highest
    plot = Plot("By tile position", label, "P per trial", reach, range_, log_y=True, log_x=log_x)
    line = maps["figure_rates_fit"][:, 0]
    for k, fit in enumerate(fits):
        colour, some = COLOURS[k % len(COLOURS)], np.flatnonzero(position == k)[::3]
        _counted(plot, signal[some], (on + off)[some], 2 * trials[some], colour, radius=1.2)
        plot.line(line, fit, colour)
    return plot.svg()


def _counted(
    plot: Plot, x: NDArray, events: NDArray, trials: NDArray, colour: str, label: str = "", radius: float = 1.7
) -> None:
    """Rates as points; where nothing was counted, an arrow down from the 95 % limit, as 0 is on no logarithmic axis."""
    some = events > 0
    plot.points(x[some], events[some] / trials[some], colour, label, radius)
    plot.arrows_down(x[~some], _UPPER_OF_NONE / trials[~some], colour)


def _probability_span(events: NDArray, trials: NDArray) -> tuple[float, float]:
    """Lowest and highest of what `_counted` draws."""
    shown = np.where(events > 0, events, _UPPER_OF_NONE) / trials
    return float(shown.min()), float(shown.max())


def _on_off(name: str, maps: dict[str, NDArray]) -> str:
    if f"figure_on_off_{name}" not in maps:
        return ""
    top = float(maps[f"figure_on_off_{name}_top"])
    plot = Plot(f"Counts per pixel, {name}", "ON events", "OFF events", (-0.5, top), (-0.5, top), size=(360, 330))
    ends = np.array([0.0, top])
    return (
        plot.image(maps[f"figure_on_off_{name}"], (-0.5, top), (-0.5, top), log=True)
        .line(ends, ends, "#ffffff", dashed=True)
        .svg()
    )


def _steps(maps: dict[str, NDArray]) -> str:
    if "figure_steps" not in maps:
        return ""
    step, on, off = maps["figure_steps"].T
    line, fit_on, fit_off = maps["figure_steps_fit"].T
    plot = Plot("S-curve", "S = ln x₁/x₀", "P per trial", _span(step), (0, 1))
    n = float(maps["figure_steps_trials"])
    plot.points(step, on / n, COLOURS[1], "ON", 2.5).points(step, off / n, COLOURS[0], "OFF", 2.5)
    return plot.line(line, fit_on, COLOURS[1]).line(line, fit_off, COLOURS[0]).svg()


def _starts(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    starts, error = maps["figure_starts"], maps["figure_starts_error"]
    known = [k for k in range(4) if np.isfinite(error[k]) and error[k] > 0]
    if not known:
        return ""
    scaled = (starts - np.median(starts, axis=0)) / np.where(np.isfinite(error) & (error > 0), error, 1)
    reach = max(1e-4, 1.2 * float(np.abs(scaled[:, known]).max()))
    plot = Plot(
        f"{len(starts)} starts, spread by e² either way",
        "",
        "end − median, standard errors",
        (0.3, 4.7),
        (-reach, reach),
        ticks_x=False,
    )
    for k in known:
        plot.box(k + 1.0, scaled[:, k], COLOURS[k], "ABCD"[k])
    return plot.svg()


def _evs_rows(section: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    names = {
        "theta": "θ, mean of both", "theta_on": "θ₊", "theta_off": "θ₋", "threshold_mismatch": "threshold mismatch",
        "asymmetry": "asymmetry ρ = (θ₋ − θ₊)/(θ₋ + θ₊)", "leak_per_trial": "leak per trial",
    }  # fmt: skip
    rows = [_parameter_row(f"{n} (all positions)", section[n]) for n in "ABCD"]
    rows += [_parameter_row(text, section[key]) for key, text in names.items()]
    rows.append(_parameter_row("dispersion in time, ON + OFF", section["dispersion"]["temporal"]))
    rows.append(_parameter_row("dispersion in time, ON − OFF", section["dispersion"]["temporal_difference"]))
    logs = section["shot_law_log_likelihood"]
    other = next(k for k in logs if k not in ("decisive", section["shot_law"]))
    verdict = "" if logs["decisive"] else ", not decisive"
    rows.append(
        (
            "shot law",
            section["shot_law"],
            "",
            f"ln L above {other}: {logs[section['shot_law']] - logs[other]:.1f}{verdict}",
        )
    )
    rows.append(
        (
            "χ²/dof",
            f"{section['goodness']['chi2_per_dof']:.3f}",
            "",
            f"{section['goodness']['dof']} degrees of freedom, p = {section['goodness']['p_value']:.2g}",
        )
    )
    rows.append(("bad pixels", str(section["bad_pixels"]), "", ""))
    return rows


def _position_table(section: dict[str, Any]) -> str:
    def text(item: dict[str, Any]) -> str:
        return (
            "not identifiable"
            if item["value"] is None
            else f"{item['value']:.4g} ± {1.96 * item['standard_error']:.2g}"
        )

    rows = []
    for k, item in enumerate(section["positions"]):
        beta = ["–" if b is None else f"{b:.4g}" for b in section["beta"][k]]
        chi2 = section["goodness"]["positions_chi2_per_dof"][k]
        rows.append((str(tuple(item["tile_position"])), *(text(item[n]) for n in "ABCD"), *beta, f"{chi2:.3f}"))
    return table(("position", "A", "B", "C", "D", *(f"β{k}" for k in range(6)), "χ²/dof"), rows)


def _span(values: NDArray) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))

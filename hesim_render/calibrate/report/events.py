"""The report's section on events."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report.parts import findings, p_text, parameter_row, row_of, span_of
from hesim_render.calibrate.report.svg import COLOURS, Plot, picture, table

#: Mean number of events of which a chance of 5 % is left that none is counted: −ln 0.05.
_UPPER_OF_NONE = 3.0


def evs_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    parts = [
        "<h2>Events (EVS)</h2>",
        findings(section),
        row_of(
            picture("Event probability per trial, mean of ON and OFF", maps["figure_probability"], "", 340),
            _rates(maps),
            _position_rates(maps),
        ),
        "<p>Arrows: no event was counted; they start at the 95 % limit.</p>",
        row_of(*(_on_off(name, maps) for name in ("lit", "dark"))),
        row_of(_steps(maps), _starts(section, maps)),
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
        return "light signal, DN", span_of(signal), False
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
    plot = Plot("S-curve", "S = ln x₁/x₀", "P per trial", span_of(step), (0, 1))
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
    rows = [parameter_row(f"{n} (all positions)", section[n]) for n in "ABCD"]
    rows += [parameter_row(text, section[key]) for key, text in names.items()]
    rows.append(parameter_row("dispersion in time, ON + OFF", section["dispersion"]["temporal"]))
    rows.append(parameter_row("dispersion in time, ON − OFF", section["dispersion"]["temporal_difference"]))
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
        goodness = section["goodness"]
        fit = f"{goodness['positions_chi2_per_dof'][k]:.3f}", p_text(goodness["positions_p_value"][k])
        rows.append((str(tuple(item["tile_position"])), *(text(item[n]) for n in "ABCD"), *beta, *fit))
    return table(("position", "A", "B", "C", "D", *(f"β{k}" for k in range(6)), "χ²/dof", "p"), rows)

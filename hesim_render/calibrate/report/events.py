"""The report's section on events, of a sensor with fixed comparisons or of an asynchronous one."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report import parts
from hesim_render.calibrate.report.parts import (
    HEAD,
    findings,
    goodness_row,
    headline,
    law_row,
    p_text,
    parameter_row,
    with_interval,
)
from hesim_render.core.drawing import COLOURS, legend_below, panel, picture, points, svg
from hesim_render.core.html import filled, tick_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def evs_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    """HTML of the section.

    Parameters
    ----------
    section : ``evs`` of a ``calibration.yaml``.
    maps : its arrays, see `read_maps`; the arrays called ``figure_…`` are drawn.
    """
    return filled(
        "calibrate/report/events.html",
        headline=headline(section),
        findings=findings(section),
        rates=(
            picture("Event probability per trial, mean of ON and OFF", maps["figure_probability"], "", 340),
            _rates(maps),
            _position_rates(maps),
        ),
        counts=[_on_off(name, maps) for name in ("lit", "dark")],
        steps=(_steps(maps), _starts(section, maps)),
        head=HEAD,
        parameters=_evs_rows(section),
        model=section["model"],
        gauge=section["gauge"],
        position_head=("position", "A", "B", "C", "D", *(f"β{k}" for k in range(6)), "χ²/dof", "p"),
        positions=_position_rows(section),
    )


def _rate_panel(title: str, signal: NDArray) -> "tuple[Figure, Axes]":
    """Axes of event probabilities; the light is logarithmic, with 0 on it, where it spans more than a factor of 100."""
    figure, axes = panel(title, "light signal, DN", "P per trial")
    darkest_lit = float(signal[signal > 0].min(initial=np.inf))
    if float(signal.max()) > 100 * darkest_lit:
        parts.scale_from_dark(axes, darkest_lit)
        axes.xaxis.set_major_formatter(tick_text)
    axes.set_yscale("log", subs=range(2, 10))
    axes.yaxis.set_major_formatter(tick_text)
    axes.yaxis.set_minor_formatter("")
    return figure, axes


def _end_of_axis(axes: "Axes", counted: float, fitted: float) -> None:
    """End the axis so that all counts are visible, and the fit down to a hundredth of them. A short axis has more
    numbers.
    """
    from matplotlib.ticker import LogLocator

    axes.set_ylim(bottom=max(0.8 * min(counted, fitted), 0.01 * counted))
    low, high = axes.get_ylim()
    if high < 300 * low:
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))


def _rates(maps: dict[str, NDArray]) -> str:
    signal, on, off, trials = maps["figure_rates"].T
    line, fit_on, fit_off = maps["figure_rates_fit"].T
    figure, axes = _rate_panel("Event probability against brightness", signal)
    parts.counted(axes, signal, on, trials, COLOURS[1], "ON")
    parts.counted(axes, signal, off, trials, COLOURS[0], "OFF")
    axes.plot(line, fit_on, color=COLOURS[1])
    axes.plot(line, fit_off, color=COLOURS[0], linestyle="--")
    least = parts.lowest(np.concatenate([on, off]), np.concatenate([trials, trials]))
    _end_of_axis(axes, least, min(fit_on.min(), fit_off.min()))
    legend_below(figure, axes, 2)
    return svg(figure)


def _position_rates(maps: dict[str, NDArray]) -> str:
    fits = maps["figure_position_fits"]
    position, signal, on, off, trials = maps["figure_position_rates"].T
    figure, axes = _rate_panel("By tile position", signal)
    line = maps["figure_rates_fit"][:, 0]
    for k, fit in enumerate(fits):
        colour, some = COLOURS[k % len(COLOURS)], np.flatnonzero(position == k)[::3]
        parts.counted(axes, signal[some], (on + off)[some], 2 * trials[some], colour, size=2.4)
        axes.plot(line, fit, color=colour)
    _end_of_axis(axes, parts.lowest(on + off, 2 * trials), fits.min())
    return svg(figure)


def _on_off(name: str, maps: dict[str, NDArray]) -> str:
    if f"figure_on_off_{name}" not in maps:
        return ""
    from matplotlib.colors import FuncNorm

    counts, top = maps[f"figure_on_off_{name}"], float(maps[f"figure_on_off_{name}_top"])
    figure, axes = panel(f"Counts per pixel, {name}", "ON events", "OFF events", (360, 330))
    norm = FuncNorm((np.log1p, np.expm1), vmin=0, vmax=max(1.0, float(counts.max())))
    axes.imshow(counts, origin="lower", extent=(-0.5, top, -0.5, top), norm=norm)
    axes.plot([0.0, top], [0.0, top], color="#ffffff", linestyle="--")
    axes.grid(False)
    return svg(figure)


def _steps(maps: dict[str, NDArray]) -> str:
    if "figure_steps" not in maps:
        return ""
    step, on, off = maps["figure_steps"].T
    line, fit_on, fit_off = maps["figure_steps_fit"].T
    figure, axes = panel("S-curve", "S = ln x₁/x₀", "P per trial")
    n = float(maps["figure_steps_trials"])
    points(axes, step, on / n, COLOURS[1], "ON", 5.0)
    points(axes, step, off / n, COLOURS[0], "OFF", 5.0)
    axes.plot(line, fit_on, color=COLOURS[1])
    axes.plot(line, fit_off, color=COLOURS[0])
    axes.set_ylim(-0.03, 1.03)
    legend_below(figure, axes, 2)
    return svg(figure)


def _starts(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    starts, error = maps["figure_starts"], maps["figure_starts_error"]
    known = [k for k in range(4) if np.isfinite(error[k]) and error[k] > 0]
    if not known:
        return ""
    scaled = (starts[:, known] - np.median(starts[:, known], axis=0)) / error[known]
    reach = max(1e-4, 1.2 * float(np.abs(scaled).max()))
    lost = section["multi_start"].get("lost", 0)
    figure, axes = panel(
        f"{len(starts)} starts, spread by e² either way" + (f"; {lost} more were lost" if lost else ""),
        "",
        "end − median, standard errors",
    )
    axes.boxplot(scaled, whis=(0, 100), widths=0.3)
    axes.set_xticks(np.arange(1, len(known) + 1), ["ABCD"[k] for k in known])
    axes.set_ylim(-reach, reach)
    return svg(figure)


def _evs_rows(section: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    names = {
        "theta": "θ, mean of both", "theta_on": "θ₊", "theta_off": "θ₋", "threshold_mismatch_rel": "threshold mismatch",
        "asymmetry": "asymmetry ρ = (θ₋ − θ₊)/(θ₋ + θ₊)", "leak_per_trial": "leak per trial",
        "leak_rate_hz": "leak",
    }  # fmt: skip
    rows = [parameter_row(f"{n} (all positions)", section[n]) for n in "ABCD"]
    rows += [parameter_row(text, section[key]) for key, text in names.items() if key in section]
    rows.append(parameter_row("dispersion in time, ON + OFF", section["dispersion"]["temporal"]))
    rows.append(parameter_row("dispersion in time, ON − OFF", section["dispersion"]["temporal_difference"]))
    logs, law = section["shot_law_log_likelihood"], section["shot_law"]
    other = next(k for k in logs if k not in ("decisive", law))
    rows += [law_row(law, other, logs[law] - logs[other], logs["decisive"]), goodness_row(section["goodness"])]
    kinds = ", ".join(f"{count} {kind}" for kind, count in (section.get("defects") or {}).items())
    rows.append(("bad pixels", str(section["bad_pixels"]), "", kinds))
    return rows


def _position_rows(section: dict[str, Any]) -> list[tuple[str, ...]]:
    rows, goodness = [], section["goodness"]
    for k, item in enumerate(section["positions"]):
        beta = ["–" if b is None else f"{b:.4g}" for b in section["beta"][k]]
        fit = f"{goodness['positions_chi2_per_dof'][k]:.3f}", p_text(goodness["positions_p_value"][k])
        own = [with_interval(item[n]["value"], item[n].get("standard_error")) for n in "ABCD"]
        rows.append((str(tuple(item["tile_position"])), *own, *beta, *fit))
    return rows


def asynchronous_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    """HTML of the section: S-curves, noise rates, maps of thresholds, parameters."""
    return filled(
        "calibrate/report/asynchronous.html",
        headline=headline(section),
        findings=findings(section),
        curves=[*(_s_curves(maps, polarity) for polarity in (1, -1)), _noise_rate(maps)],
        maps=[_pixels(maps), *(_map(maps, name, sign) for name, sign in (("on", "θ₊"), ("off", "θ₋")))],
        head=HEAD,
        parameters=_rows(section),
        model=section["model"],
        gauge=section["gauge"],
    )


def _s_curves(maps: dict[str, NDArray], polarity: int) -> str:
    """Probability of an event against S, for every light."""
    rows = maps["figure_s_curves"]
    rows = rows[rows[:, 0] == polarity]
    title = "S-curves, ON" if polarity > 0 else "S-curves, OFF"
    figure, axes = panel(title, "|S| = |ln x₁/x₀|", "P of an event")
    last = rows[:, 3].max()
    for k, light in enumerate(np.unique(rows[:, 1])):
        colour = COLOURS[k % len(COLOURS)]
        for j in np.unique([0, last]):
            some = rows[(rows[:, 1] == light) & (rows[:, 3] == j)]
            some = some[np.argsort(np.abs(some[:, 2]))]
            step = np.abs(some[:, 2])
            points(axes, step, some[:, 4] / some[:, 5], colour, f"{light:.3g} DN" if j == 0 else "")
            axes.plot(step, some[:, 6], color=colour, linestyle="--" if j > 0 else "-")
    axes.set_ylim(-0.03, 1.03)
    legend_below(figure, axes, 3)
    return svg(figure)


def _noise_rate(maps: dict[str, NDArray]) -> str:
    """Events per second of calm time in steady light."""
    rows = maps["figure_noise_rate"]
    rows = rows[np.argsort(rows[:, 0])]
    signal, on, off, seconds, fit_on, fit_off = rows.T
    lit = signal > 0
    darkest = float(signal[lit].min()) if lit.any() else 0.1
    figure, axes = panel("Events in steady light", "light signal, DN", "events per s and pixel")
    parts.scale_from_dark(axes, darkest)
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(tick_text)
        axis.set_minor_formatter("")
    for events, fit, colour, label in ((on, fit_on, COLOURS[1], "ON"), (off, fit_off, COLOURS[0], "OFF")):
        parts.counted(axes, signal, events, seconds, colour, label)
        axes.plot(signal, fit, color=colour)
    axes.set_ylim(bottom=0.5 * min(parts.lowest(on, seconds), parts.lowest(off, seconds)))
    legend_below(figure, axes, 2)
    return svg(figure)


def _pixels(maps: dict[str, NDArray]) -> str:
    """Distribution of thresholds over the good pixels."""
    good = ~maps["bad_pixels"]
    values = [maps[f"threshold_{name}_rel"][good] for name in ("on", "off")]
    low, high = (float(v) for v in np.quantile(np.concatenate(values), [0.001, 0.999]))
    edges = np.linspace(low - 0.02, high + 0.02, 50).tolist()
    figure, axes = panel("Thresholds over their mean", "θ of a pixel / mean", "pixels")
    for each, colour, label in zip(values, (COLOURS[1], COLOURS[0]), ("θ₊", "θ₋"), strict=True):
        axes.hist(each, edges, color=colour, alpha=0.5, label=label)
    legend_below(figure, axes, 2)
    return svg(figure)


def _map(maps: dict[str, NDArray], name: str, sign: str) -> str:
    values = np.where(maps["bad_pixels"], np.nan, maps[f"threshold_{name}_rel"])
    return picture(f"{sign} over its mean", values, "", 320)


def _rows(section: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    names = {
        "theta": "θ, mean of both", "theta_on": "θ₊", "theta_off": "θ₋", "threshold_mismatch_rel": "threshold mismatch",
        "threshold_mismatch_on_rel": "mismatch of θ₊", "threshold_mismatch_off_rel": "mismatch of θ₋",
        "noise_cutoff_hz": "noise bandwidth f_c", "leak_rate_hz": "leak",
    }  # fmt: skip
    rows = [parameter_row(text, section[key]) for key, text in names.items()]
    rows += [parameter_row(f"noise σ at {item['signal_dn']:.4g} DN", item) for item in section["noise"]]
    for k, (value, error) in enumerate(zip(section["beta"][0], section["beta_standard_error"][0], strict=True)):
        rows.append((f"β{k}", f"{value:.5g}", "" if not error else f"± {1.96 * error:.2g}", ""))
    rows.append(law_row(section["shot_law"], "the other", section["shot_law_advantage"], section["shot_law_decisive"]))
    goodness = section["goodness"]
    rows.append(goodness_row(goodness))
    for name, text in (("steps", "right after steps"), ("times", "later after steps"), ("steady", "in steady light")):
        rows.append((f"p of events {text}", p_text(goodness[f"{name}_p_value"]), "", ""))
    kinds = ", ".join(f"{name} {count}" for name, count in section["defects"].items() if count)
    rows.append(("bad pixels", str(section["bad_pixels"]), "", kinds))
    return rows

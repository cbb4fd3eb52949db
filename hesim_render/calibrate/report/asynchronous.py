"""The report's section on the events of an asynchronous sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report import parts
from hesim_render.calibrate.report.parts import HEAD, findings, headline, p_text, parameter_row
from hesim_render.core.drawing import COLOURS, legend_below, panel, picture, points, svg
from hesim_render.core.html import filled, tick_text


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
        "photoreceptor_cutoff_hz": "noise bandwidth f_c", "leak_rate_hz": "leak",
    }  # fmt: skip
    rows = [parameter_row(text, section[key]) for key, text in names.items()]
    rows += [parameter_row(f"noise σ at {item['signal_dn']:.4g} DN", item) for item in section["noise"]]
    for k, (value, error) in enumerate(zip(section["beta"][0], section["beta_standard_error"][0], strict=True)):
        rows.append((f"β{k}", f"{value:.5g}", "" if not error else f"± {1.96 * error:.2g}", ""))
    decisive = "" if section["shot_law_decisive"] else ", not decisive"
    rows.append(
        ("shot law", section["shot_law"], "", f"ln L above the other: {section['shot_law_advantage']:.1f}{decisive}")
    )
    goodness = section["goodness"]
    rows.append(
        (
            "χ²/dof",
            f"{goodness['chi2_per_dof']:.3f}",
            "",
            f"{goodness['dof']} degrees of freedom, p = {p_text(goodness['p_value'])}",
        )
    )
    for name, text in (("steps", "right after steps"), ("times", "later after steps"), ("steady", "in steady light")):
        rows.append((f"p of events {text}", p_text(goodness[f"{name}_p_value"]), "", ""))
    kinds = ", ".join(f"{name} {count}" for name, count in section["defects"].items() if count)
    rows.append(("bad pixels", str(section["bad_pixels"]), "", kinds))
    return rows

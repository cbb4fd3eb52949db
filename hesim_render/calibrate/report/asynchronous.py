"""The report's section on the events of an asynchronous sensor."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.report.parts import findings, p_text, parameter_row, row_of, span_of
from hesim_render.calibrate.report.svg import COLOURS, Plot, picture, table

#: Mean number of events of which a chance of 5 % is left that none is counted: −ln 0.05.
_UPPER_OF_NONE = 3.0


def asynchronous_section(section: dict[str, Any], maps: dict[str, NDArray]) -> str:
    """HTML of the section: S-curves, noise rates, maps of thresholds, parameters."""
    parts = [
        "<h2>Events (EVS, asynchronous)</h2>",
        findings(section),
        row_of(*(_s_curves(maps, polarity) for polarity in (1, -1)), _noise_rate(maps)),
        "<p>Points: counted. Lines: the fit. In the S-curves the lower branch is of events right after the step (the "
        "first time bin), the upper one of all bins. Arrows: no event was counted; they start at the 95 % limit.</p>",
        row_of(_pixels(maps), *(_map(maps, name, sign) for name, sign in (("on", "θ₊"), ("off", "θ₋")))),
        "<h2>Parameters (EVS)</h2>",
        table(("parameter", "value", "95 % interval", "unit, or why not"), _rows(section)),
        f"<p>{escape(section['model'])}. Gauge of β: {escape(section['gauge'])}.</p>",
    ]
    return "\n".join(parts)


def _s_curves(maps: dict[str, NDArray], polarity: int) -> str:
    """Chance of an event against S of every light."""
    rows = maps["figure_s_curves"]
    rows = rows[rows[:, 0] == polarity]
    title = "S-curves, ON" if polarity > 0 else "S-curves, OFF"
    plot = Plot(title, "|S| = |ln x₁/x₀|", "P of an event", span_of(np.abs(rows[:, 2])), (0, 1))
    lights, last = np.unique(rows[:, 1]), rows[:, 3].max()
    for k, light in enumerate(lights):
        colour = COLOURS[k % len(COLOURS)]
        for j in np.unique([0, last]):
            some = rows[(rows[:, 1] == light) & (rows[:, 3] == j)]
            some = some[np.argsort(np.abs(some[:, 2]))]
            step = np.abs(some[:, 2])
            plot.points(step, some[:, 4] / some[:, 5], colour, f"{light:.3g} DN" if j == 0 else "", 2.0)
            plot.line(step, some[:, 6], colour, dashed=j > 0)
    return plot.svg()


def _noise_rate(maps: dict[str, NDArray]) -> str:
    """Events per second of calm time in steady light."""
    rows = maps["figure_noise_rate"]
    rows = rows[np.argsort(rows[:, 0])]
    signal, on, off, seconds, fit_on, fit_off = rows.T
    lit = signal > 0
    least = float(signal[lit].min()) / 3 if lit.any() else 0.1
    shown = np.concatenate([np.where(n > 0, n, _UPPER_OF_NONE) / seconds for n in (on, off)])
    plot = Plot(
        "Events in steady light", "light signal, DN" + (" (dark at the left edge)" if not lit.all() else ""),
        "events per s and pixel", (least, 1.3 * max(float(signal.max()), 2 * least)),
        (0.5 * float(shown.min()), 2 * float(shown.max())), log_y=True, log_x=True,
    )  # fmt: skip
    for events, fit, colour, label in ((on, fit_on, COLOURS[1], "ON"), (off, fit_off, COLOURS[0], "OFF")):
        some = events > 0
        plot.points(signal[some], events[some] / seconds[some], colour, label, 2.5)
        plot.arrows_down(signal[~some], _UPPER_OF_NONE / seconds[~some], colour)
        above = fit > 0.3 * float(shown.min())
        plot.line(np.maximum(signal[above], least), fit[above], colour)
    return plot.svg()


def _pixels(maps: dict[str, NDArray]) -> str:
    """How thresholds spread over the good pixels."""
    good = ~maps["bad_pixels"]
    values = [maps[f"threshold_{name}_relative"][good] for name in ("on", "off")]
    low, high = (float(v) for v in np.quantile(np.concatenate(values), [0.001, 0.999]))
    edges = np.linspace(low - 0.02, high + 0.02, 50)
    counts = [np.histogram(v, edges)[0] for v in values]
    middle = (edges[1:] + edges[:-1]) / 2
    plot = Plot(
        "Thresholds over their mean",
        "θ of a pixel / mean",
        "pixels",
        (edges[0], edges[-1]),
        (0, 1.1 * float(np.max(counts))),
    )
    return plot.bars(middle, counts[0], COLOURS[1], "θ₊").bars(middle, counts[1], COLOURS[0], "θ₋").svg()


def _map(maps: dict[str, NDArray], name: str, sign: str) -> str:
    values = np.where(maps["bad_pixels"], np.nan, maps[f"threshold_{name}_relative"])
    return picture(f"{sign} over its mean", values, "", 320)


def _rows(section: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    names = {
        "theta": "θ, mean of both", "theta_on": "θ₊", "theta_off": "θ₋", "threshold_mismatch": "threshold mismatch",
        "threshold_mismatch_on": "mismatch of θ₊", "threshold_mismatch_off": "mismatch of θ₋",
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

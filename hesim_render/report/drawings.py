"""Drawings of the report: each takes axes, so that the page and the PDF have the same."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.pairs import light_of
from hesim_render.core.drawing import COLOURS, logarithmic, points
from hesim_render.core.html import tick_text
from hesim_render.report.emva import FrameFigures
from hesim_render.report.figures import POLARITIES, EventFigures
from hesim_render.report.limits import DETECTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Draw = Callable[["Axes"], None]
#: Colours of ON and OFF.
_ON_OFF = (COLOURS[1], COLOURS[0])
#: Height of axes over that of their data, where a legend stands above these.
_LEGEND_ROOM = 1.35
#: Intervals are drawn up to here, µs.
_LONGEST_INTERVAL_US = 5000


def event_drawings(figures: EventFigures) -> list[Draw]:
    """Drawings of event pixels, those that there are data for."""
    draws: list[Draw] = []
    if figures.curves:
        draws.append(lambda axes: _s_curves(axes, figures))
    if figures.latencies[0]:
        draws += [lambda axes: _latency(axes, figures), lambda axes: _detected(axes, figures)]
    if figures.backgrounds:
        draws.append(lambda axes: _background(axes, figures))
    if figures.band is not None:
        draws.append(lambda axes: _band(axes, figures))
    if figures.intervals.sum() > 0:
        draws.append(lambda axes: _intervals(axes, figures))
    return draws


def frame_drawings(figures: FrameFigures) -> list[Draw]:
    """Drawings of frames: photon transfer, linearity, signal-to-noise ratio."""
    return [
        lambda axes: _transfer(axes, figures),
        lambda axes: _linearity(axes, figures),
        lambda axes: _snr(axes, figures),
    ]


def _s_curves(axes: "Axes", figures: EventFigures) -> None:
    pair = figures.curves[0]
    axes.set(title=f"S-curves at {pair[0].lux:g} lx", xlabel="step, ln L₁/L₀", ylabel="share of steps answered")
    for curve, name, colour in zip(pair, POLARITIES, _ON_OFF, strict=True):
        points(axes, curve.size, curve.share, colour, name, 4.2)
        if np.isfinite(curve.theta):
            line = np.linspace(curve.size.min(), curve.size.max(), 300)
            axes.plot(line, curve.at(line), color=colour)
            axes.axvline(curve.theta, color=colour, linewidth=0.7, linestyle=":")
    axes.legend(frameon=False)


def _bars(axes: "Axes", lux: list[float], values: list[dict], colour: str, label: str, line: str = "-") -> None:
    """Values with their intervals; those that are not known, or 0, are left out."""
    some = [(x, v) for x, v in zip(lux, values, strict=True) if v["value"] and "interval_95" in v]
    if some:
        x, y = [x for x, _ in some], np.array([v["value"] for _, v in some])
        low, high = (np.array([v["interval_95"][k] for _, v in some]) for k in (0, 1))
        floor = np.maximum(low, 0.3 * y)
        axes.errorbar(
            x,
            y,
            (y - floor, high - y),
            color=colour,
            marker="o",
            markersize=3.6,
            linestyle=line,
            linewidth=1,
            label=label,
        )


def _latency(axes: "Axes", figures: EventFigures) -> None:
    contrast = figures.latencies[0][0].contrast
    axes.set(title=f"Latency and jitter, contrast {100 * contrast:.3g} %", xlabel="illuminance, lx", ylabel="µs")
    for every, name, colour in zip(figures.latencies, POLARITIES, _ON_OFF, strict=True):
        lux = [one.lux for one in every]
        _bars(axes, lux, [one.latency for one in every], colour, f"latency {name}")
        _bars(axes, lux, [one.jitter for one in every], colour, f"jitter {name}", "--")
    logarithmic(axes, "x", "y")
    _legend(axes)


def _legend(axes: "Axes") -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False)


def _detected(axes: "Axes", figures: EventFigures) -> None:
    axes.set(
        title="Steps of 2θ that are found", xlabel="illuminance, lx", ylabel="share, less chance", ylim=(-0.05, 1.05)
    )
    for one, name, colour in zip(figures.ranges, POLARITIES, _ON_OFF, strict=True):
        if one is not None and one.lux.size:
            axes.errorbar(
                one.lux, one.share, 1.96 * one.error, color=colour, marker="o", markersize=3.6, linewidth=1, label=name
            )
    axes.axhline(DETECTED, color=COLOURS[6], linewidth=0.8, linestyle="--", label=f"{DETECTED:g}, of the range")
    logarithmic(axes, "x")
    _legend(axes)


def _background(axes: "Axes", figures: EventFigures) -> None:
    axes.set(title="Background", xlabel="illuminance, lx", ylabel="events per s and pixel")
    stated = sorted({one.temperature_c for one in figures.backgrounds if one.temperature_c is not None})
    each: list[float | None] = [*stated] or [None]
    for celsius in each:
        every = [one for one in figures.backgrounds if one.temperature_c == celsius]
        about = "" if celsius is None or len(stated) == 1 else f", {celsius:g} °C"
        for k, (name, colour) in enumerate(zip(POLARITIES, _ON_OFF, strict=True)):
            _bars(axes, [one.lux for one in every], [one.rates[k] for one in every], colour, name + about)
    logarithmic(axes, "x", "y")
    _legend(axes)


def _band(axes: "Axes", figures: EventFigures) -> None:
    band = figures.band
    assert band is not None
    name = "bursts" if band.in_bursts else "cycles"
    axes.set(
        title=f"Swing for half of the {name}",
        xlabel="frequency, Hz",
        ylabel="ln L_max/L_min",
    )
    there = np.isfinite(band.swing)
    if there.any():
        axes.plot(band.hz[there], band.swing[there], color=_ON_OFF[0], marker="o", markersize=3.6)
        limit = np.sqrt(2) * band.swing[there][0]
        axes.axhline(limit, color=COLOURS[6], linewidth=0.8, linestyle="--", label="√2 times the first")
        _legend(axes)
    if band.entry["value"] is not None:
        axes.axvline(band.entry["value"], color=COLOURS[6], linewidth=0.8, linestyle=":")
    logarithmic(axes, "x", "y")


def _intervals(axes: "Axes", figures: EventFigures) -> None:
    axes.set(title="Intervals of a pixel", xlabel="interval, µs", ylabel="number per µs")
    counts = figures.intervals[:-1]
    edges = np.unique(np.round(np.geomspace(1, _LONGEST_INTERVAL_US, 60)).astype(int))
    edges = edges[edges < counts.size]
    total = np.append(0, np.cumsum(counts))
    density = np.diff(total[edges]) / np.diff(edges)
    axes.stairs(np.where(density > 0, density, np.nan), edges, fill=True, color=COLOURS[5], alpha=0.6)
    dead = next(one.value for one in figures.entries if one.key == "dead_time")
    if dead["value"] is not None:
        axes.axvline(dead["value"], color=COLOURS[1], linewidth=1)
    logarithmic(axes, "x", "y")


def _levels(figures: FrameFigures) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], str]:
    """Light, signal and variance of the levels, and the name of the light."""
    result = figures.result
    unit = "photons per pixel" if result.pairs.has_photons else "exposure, s"
    return light_of(result.pairs, result.lit), result.signal, result.lit.variance - result.dark.variance, unit


def _transfer(axes: "Axes", figures: FrameFigures) -> None:
    _, signal, variance, _ = _levels(figures)
    axes.set(title="Photon transfer", xlabel="signal above the dark, DN", ylabel="variance above the dark, DN²")
    points(axes, signal, variance, COLOURS[0], "pairs", 4.2)
    top = 0.7 * figures.result.top_dn
    axes.plot([0, top], [0, figures.result.gain.slope * top], color=COLOURS[1], label="K, 0 to 70 % of saturation")
    axes.set_ylim(top=_LEGEND_ROOM * float(variance.max()))
    axes.legend(frameon=False, loc="upper left")


def _linearity(axes: "Axes", figures: FrameFigures) -> None:
    light, signal, _, unit = _levels(figures)
    axes.set(title="Signal", xlabel=unit, ylabel="signal above the dark, DN")
    points(axes, light, signal, COLOURS[0], "pairs", 4.2)
    slope = figures.result.responsivity.slope
    end = min(float(light.max()), float(signal.max()) / slope)
    axes.plot([0, end], [0, slope * end], color=COLOURS[1], label="responsivity")
    axes.set_ylim(top=_LEGEND_ROOM * float(signal.max()))
    axes.xaxis.set_major_formatter(tick_text)  # no power of ten apart from the numbers
    axes.legend(frameon=False, loc="upper left")


def _snr(axes: "Axes", figures: FrameFigures) -> None:
    light, signal, _, unit = _levels(figures)
    snr = signal / np.sqrt(np.maximum(figures.result.lit.variance, 1e-12))
    some = (signal > 0) & figures.result.clear
    axes.set(title="Signal-to-noise ratio", xlabel=unit, ylabel="signal over temporal noise")
    points(axes, light[some], snr[some], COLOURS[0], "pairs", 4.2)
    efficiency = figures.entries["quantum_efficiency"]["value"]
    if efficiency is not None:
        line = np.geomspace(light[some].min(), light[some].max(), 60)
        axes.plot(line, np.sqrt(efficiency * line), color=COLOURS[6], linestyle="--", label="shot noise alone")
    logarithmic(axes, "x", "y")
    axes.legend(frameon=False)

"""The page of a twin: what was found, pass or fail of each check, and both curves over each other."""

from collections.abc import Sequence

import numpy as np

from hesim_render.core.drawing import COLOURS, legend_below, logarithmic, new_figure, points, report_style, svg
from hesim_render.core.html import filled, number
from hesim_render.twin.comparison import Check

_SIZE_PX = (440, 340)
#: Range of values from which an axis is logarithmic.
_LOG_FROM = 10.0


def check_line(check: Check) -> str:
    """A check in one line."""
    verdict = f"{'pass' if check.passed else 'FAIL'}  {check.name:<34}"
    limit = f"(limit {check.limit:.1f})"
    if check.z.size == 1:
        values = f"{float(check.real[0]):.4g} and {float(check.twin[0]):.4g} {check.unit}"
        return f"{verdict} z {check.worst:+.1f} {limit}; {values}"
    name, _, unit = check.place.rpartition(", ")
    place = f"{name} {check.places[np.argmax(np.abs(check.z))]:.4g} {unit}".strip()
    rms = f"rms z {check.rms:.2f} (limit {check.most_rms:.2f})"
    return f"{verdict} worst z {check.worst:+.1f} {limit} of {check.z.size}, at {place}; {rms}"


def _row(check: Check) -> tuple[str, ...]:
    verdict = "pass" if check.passed else "FAIL"
    alone = check.z.size == 1
    values = (number(float(check.real[0])), number(float(check.twin[0]))) if alone else ("", "")
    scores = f"{check.worst:+.2f}", f"{check.limit:.2f}", f"{check.rms:.2f}", f"{check.most_rms:.2f}"
    return check.name, verdict, str(check.z.size), *scores, *values, check.unit


def page(checks: Sequence[Check], findings: Sequence[str]) -> str:
    """The HTML page; it needs no other file."""
    with report_style():
        drawings = [_overlay(check) for check in checks if check.z.size > 1]
    passed = sum(check.passed for check in checks)
    return filled("twin/page.html", title="Twin", rows=[*map(_row, checks)], passed=passed, findings=findings,
                  drawings=drawings)  # fmt: skip


def _overlay(check: Check) -> str:
    """Both over each other, and the z-scores below."""
    figure = new_figure(_SIZE_PX)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    upper.set(title=check.name, ylabel=check.unit)
    points(upper, check.places, check.real, COLOURS[0], "captures", 5.0)
    upper.plot(check.places, check.twin, color=COLOURS[1], label="twin")
    lower.set(xlabel=check.place, ylabel="z")
    points(lower, check.places, check.z, COLOURS[6], size=3.4)
    for side in (-1, 1):
        lower.axhline(side * check.limit, color=COLOURS[1], linewidth=0.8, linestyle="--")
    reach = max(check.limit, abs(check.worst)) * 1.15
    lower.set_ylim(-reach, reach)
    both = np.concatenate([check.real, check.twin])
    if both.min() > 0 and both.max() > _LOG_FROM * both.min() and not check.place.startswith(("photons", "exposure")):
        logarithmic(upper, "y")
    legend_below(figure, upper, 2)
    return svg(figure)

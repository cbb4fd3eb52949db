"""Floor and ceiling of the S-curves: spontaneous events and lost events.

    P₊(S) = f₊ + (c − f₊) Q((θ₊ − S)/s),   P₋(S) = f₋ + (c − f₋) Q((θ₋ + S)/s)

θ₊, θ₋, s and its slope are fitted again with the floors f₊, f₋ and the ceiling c. The errors are from a jackknife over
groups of pixels, as in `thresholds`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.evs.steps import GROUPS, Steps
from hesim_render.calibrate.evs.thresholds import Thresholds, curve, curve_slopes

#: Rounds, and the part of a parameter below which a change ends them.
_ROUNDS, _ENOUGH = 30, 1e-7
#: Least variance of a rate, also of steps without any event, so that no single event decides.
_LEAST_VARIANCE = 1e-5


@dataclass(frozen=True)
class CurveLevels:
    """Floors and ceiling with standard errors; probabilities per trial."""

    floor_on: tuple[float, float]
    floor_off: tuple[float, float]
    ceiling: tuple[float, float]


def curve_levels(steps: Steps, thresholds: Thresholds) -> CurveLevels:
    """Fit floors and ceiling to the pooled S-curves."""
    start = np.array([*thresholds.values, 0.0, 0.0, 1.0])
    result = _fit(steps, thresholds.step, np.ones(GROUPS, bool), start)
    groups = np.flatnonzero(steps.pixels)
    left_out = np.array([_fit(steps, thresholds.step, np.arange(GROUPS) != k, result) for k in groups])
    error = np.sqrt((groups.size - 1) * left_out.var(axis=0))
    return CurveLevels(*((float(result[k]), float(error[k])) for k in (4, 5, 6)))


def _fit(steps: Steps, step: NDArray, groups: NDArray[np.bool_], start: NDArray) -> NDArray[np.float64]:
    """(θ₊, θ₋, s, κ, f₊, f₋, c) of the groups taken."""
    n = float(steps.pixels[groups].sum()) * steps.trials
    rates = [counts[:, groups].sum(axis=1) / n for counts in (steps.on, steps.off)]
    values = start.copy()
    scale = np.array([values[0], values[1], values[2], 1.0, 1.0, 1.0, 1.0])
    for _ in range(_ROUNDS):
        score, fisher = np.zeros(7), np.zeros((7, 7))
        for rate, polarity, floor in zip(rates, (1.0, -1.0), (4, 5), strict=True):
            # rate = floor + (ceiling − floor) · S-curve, and its slopes by all seven parameters
            shape = curve(values[:4], polarity, step)
            p = values[floor] + (values[6] - values[floor]) * shape
            jacobian = np.zeros((step.size, 7))
            jacobian[:, :4] = (values[6] - values[floor]) * curve_slopes(values[:4], polarity, step)
            jacobian[:, floor], jacobian[:, 6] = 1 - shape, shape
            # a binomial weighs each rate by 1/(p (1 − p))
            weight = 1 / (np.clip(p * (1 - p), 0.0, None) + _LEAST_VARIANCE)
            score += (weight * (rate - p)) @ jacobian
            fisher += (jacobian * weight[:, None]).T @ jacobian
        # a step at most 0.3 of the scale, back into the range of a curve
        change = np.linalg.lstsq(fisher, score, rcond=None)[0]
        values = values + np.clip(change, -0.3 * scale, 0.3 * scale)
        values[:3] = np.maximum(values[:3], 1e-3 * scale[:3])
        values[3] = np.clip(values[3], -0.4, 0.4)
        if np.all(np.abs(change) < _ENOUGH * scale):
            break
    return values

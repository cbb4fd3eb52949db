"""Checks whether event counts follow their model: one noise law for static counts and for steps.

Each check gives a finding with the probability `estimate.ALARM` for counts that follow the model. A deviation that is
significant but too small to matter is not reported.

Floor and ceiling of the S-curves are spontaneous and lost events::

    P₊(S) = f₊ + (c − f₊) Q((θ₊ − S)/s),   P₋(S) = f₋ + (c − f₋) Q((θ₋ + S)/s)

θ₊, θ₋, s and its slope are fitted again with the floors f₊, f₋ and the ceiling c. The errors are from a jackknife over
groups of pixels, as in `thresholds`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from hesim_render.calibrate.estimate import ALARM, Finding
from hesim_render.calibrate.evs.analysis import EvsCalibration
from hesim_render.calibrate.evs.model import threshold_over_noise
from hesim_render.calibrate.evs.steps import GROUPS, Steps
from hesim_render.calibrate.evs.thresholds import Thresholds, curve, curve_slopes

#: Floor (probability per trial) and loss of events from which they are reported.
_LEAST_FLOOR, _LEAST_LOSS = 1e-5, 1e-3
#: Relative error of the width of the S-curve beside its own: the curve is taken as one normal law whose width changes
#: in proportion to the step, which is off by 1.5 % at θ = 0.2.
_MODEL_ERROR = 0.02
#: Distance in standard errors above which two searches end at different points.
_APART = 0.3
#: Rounds, and the part of a parameter below which a change ends them.
_ROUNDS, _ENOUGH = 30, 1e-7
#: Least variance of a rate, also of steps without any event, so that no single event decides.
_LEAST_VARIANCE = 1e-5


def check_events(result: EvsCalibration, contrast_of: str) -> "tuple[list[Finding], CurveLevels | None]":
    """Every check of the events, and the levels of the S-curves where they were captured."""
    outcome = [_counts(result), _starts(result)]
    levels = None
    if result.thresholds is not None and result.steps is not None:
        levels = curve_levels(result.steps, result.thresholds)
        outcome += [_ceiling(levels), _floor(result, levels), _width(result, contrast_of)]
    return [f for f in outcome if f is not None], levels


def _counts(result: EvsCalibration) -> Finding | None:
    """χ² of the static counts by brightness, of all positions together and of each."""
    of_each = [one.goodness.p_value for one in result.fits]
    p_value = min(1.0, 2 * min(result.together.goodness.p_value, len(of_each) * min(of_each)))
    if p_value > ALARM:
        return None
    return Finding(
        "event counts",
        f"the static counts are not the model's by brightness, χ²/dof {result.together.goodness.per_dof:.3g}. A … D "
        "are off. Look at the curves of P against brightness: events that come by themselves, noise with longer tails "
        "than a normal law, a scene that moves, or a signal_dn that is not that of the event pixels.",
        p_value,
    )


def _starts(result: EvsCalibration) -> Finding | None:
    """Finding of searches from other starts that end elsewhere: several fits describe the counts about equally well.

    A search that was lost on its way and ended where the counts are far less likely says nothing about the counts.
    """
    ends = result.ends
    free = np.array(result.together.free[:4]) & (ends.standard_error > 0)
    values = ends.values[ends.describe_counts(result.together.goodness.per_dof)]
    away = np.abs(values - np.median(values, axis=0))[:, free] / ends.standard_error[free]
    apart = np.any(away > _APART, axis=1)
    if not apart.any():
        return None
    return Finding(
        "starts",
        f"{int(apart.sum())} of {apart.size} searches from other starts end elsewhere, by up to {away.max():.2g} "
        "standard errors, and are about as likely: the counts do not tell A … D in one way only. Capture more trials, "
        "and brighter scenes.",
        None,
    )


def _ceiling(levels: "CurveLevels") -> Finding | None:
    value, error = levels.ceiling
    p_value = float(norm.sf((1 - value) / max(error, 1e-12)))
    if p_value > ALARM or 1 - value < _LEAST_LOSS:
        return None
    return Finding(
        "S-curve ceiling",
        f"steps far beyond the threshold give an event in {value:.4f} ± {error:.1g} of the trials, not in all. "
        "Thresholds and their mismatch are off. Events are lost (look at the read-out's bandwidth, and at arbitration "
        "when all pixels step at once: step fewer of them), or trials are counted that had no step.",
        p_value,
    )


def _floor(result: EvsCalibration, levels: "CurveLevels") -> Finding | None:
    """Finding of events of steps in the other direction, and of ON events beyond leak."""
    fit = result.together
    leak, leak_error = (fit.values[5], np.sqrt(max(fit.covariance[5, 5], 0.0))) if fit.free[5] else (0.0, 0.0)
    outcome = []
    for name, (value, error), own, own_error in (
        ("ON", levels.floor_on, leak, leak_error), ("OFF", levels.floor_off, 0.0, 0.0),
    ):  # fmt: skip
        p_value = 4 * float(norm.sf(abs(value - own) / max(float(np.hypot(error, own_error)), 1e-12)))
        if p_value < ALARM and abs(value - own) > _LEAST_FLOOR and value > 0:
            outcome.append((name, value, p_value))
    if not outcome:
        return None
    rates = " and ".join(f"{value:.2g} ({name})" for name, value, _ in outcome)
    return Finding(
        "S-curve floor",
        f"steps away from the threshold still give events, in {rates} of the trials, beyond leak. A … D, which take "
        "the rarest counts for noise, are off. Look for events that come by themselves (hot neighbours, crosstalk, "
        "read-out noise, moving objects) or noise with longer tails than a normal law.",
        min(p for _, _, p in outcome),
    )


def _width(result: EvsCalibration, contrast_of: str) -> Finding | None:
    """Compare the noise from the width of the S-curve with the noise from the static counts."""
    thresholds, steps, fit = result.thresholds, result.steps, result.together
    # without C the static counts do not give the noise in the light of the steps
    if thresholds is None or steps is None or not all(fit.identified(name) for name in "ABC"):
        return None
    theta = thresholds.theta
    measured, error = thresholds.noise
    signals = np.array([steps.signal_dn])
    if contrast_of == "signal":
        # σ_n² = s₀²/x₀² + s₁²/x₁² at the steps that reach θ₊ and −θ₋; static counts at I₀ and I₁ give 2 s²/x² there
        a, b = fit.values[:2]
        reach = np.exp([thresholds.theta_on, -thresholds.theta_off])
        after = np.maximum(((a * steps.signal_dn + b) * reach - b) / a, 0.0)
        signals = np.concatenate([signals, signals, after])
    elif thresholds.width**2 > (thresholds.spread.value * theta) ** 2:
        measured = float(np.sqrt(thresholds.width**2 - (thresholds.spread.value * theta) ** 2))
    u, _ = threshold_over_noise(fit.parameters, signals, result.theta_v, fit.law)
    expected = theta * float(np.sqrt(np.mean(1 / u**2)))
    if not 0 < 4 * error < measured:
        return None
    own = float(np.sqrt(fit.covariance[1, 1])) / fit.values[1]
    spread = float(np.hypot(np.hypot(error / measured, own), _MODEL_ERROR))
    z = float(np.log(measured / expected)) / spread
    p_value = 2 * float(norm.sf(abs(z)))
    if p_value > ALARM:
        return None
    return Finding(
        "S-curve width",
        f"the width of the S-curve belongs to a noise of {measured:.3g} (ln), the static counts for {expected:.3g}: "
        "they are not of one normal law. A … D hold for the static counts at best, and θ/σ does not. Look for noise "
        "with longer tails than a normal law, events without a change, or steps captured at another light or bias.",
        p_value,
    )


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

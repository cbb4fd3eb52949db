"""Maximum likelihood of thresholds, mismatch, noise, bandwidth and leak, and the covariance of the parameters.

Scoring with the outer product of the pixels' own scores [berndt1974], which is at the same
time the information: each pixel, with thresholds of its own, is one independent draw.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import logsumexp

from hesim_render.calibrate.asynchronous.likelihood import (
    CUTOFF,
    DARK,
    LEAK,
    MISMATCH,
    NAMES,
    RESPONSE,
    SHOT,
    THETA,
    Law,
    Likelihood,
    TrialCounts,
    log_prior,
    threshold_grid,
)  # fmt: skip
from hesim_render.calibrate.asynchronous.trials import Trials
from hesim_render.core.errors import SpecError

#: Largest number of pixels in the fit of the parameters, drawn at random. Maps contain all pixels.
MOST_PIXELS = 16384
_ROUNDS, _TRIES, _ENOUGH = 40, 8, 0.02
#: Number of pixels for the rough start.
_FEW = 300
#: Step of numerical derivatives and largest change in a round, of the ln of a parameter.
_H, _LARGEST = 1e-5, 0.7
#: Relative error of the law itself, in the order of `NAMES`: what sessions of davis346 with seeds 1 to 3 were off on
#: the average (r 0.3 %, β4² 1.5 %, f_c 1.5 %), with a margin. Judged on other seeds, and on trials written out in the
#: tests.
_LAW_ERROR = np.array([0.0, 0.0, 0.0, 0.0, 0.004, 0.01, 0.015, 0.02, 0.0])
#: Parameters that may be 0, and the fraction of the start value below which they are 0.
_MAY_VANISH = (SHOT, DARK, LEAK)
_FLOOR = 1e-6


@dataclass(frozen=True)
class Fit:
    """Parameters in the order of `likelihood.NAMES`.

    Attributes
    ----------
    values, covariance : values and covariance; rows of parameters at their bound of 0 are NaN.
    scores : [pixel, parameter], derivative of each pixel's ln L by the ln of each parameter.
    free : parameters that are not at their bound.
    likelihood : likelihood of the fitted pixels.
    log_likelihood : ln L of all fitted pixels.
    """

    law: Law
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    scores: NDArray[np.float64]
    free: NDArray[np.bool_]
    likelihood: Likelihood
    log_likelihood: float

    def law_of_thresholds(self, k: int) -> NDArray[np.float64]:
        """Chance of each threshold of the grid of polarity number `k`, over all pixels, [threshold]."""
        return np.exp(log_prior(self.values[THETA[k]], self.values[MISMATCH[k]], self.likelihood.grids[k]))

    def law_given(self, counts: TrialCounts) -> NDArray[np.float64]:
        """Chance of each threshold of the grid for each pixel, given its counts, [pixel, threshold]."""
        k = 0 if counts.polarity > 0 else 1
        grid = self.likelihood.grids[k]
        log = counts.log_likelihood(self.values, grid, self.law)
        log += log_prior(self.values[THETA[k]], self.values[MISMATCH[k]], grid)
        return np.exp(log - logsumexp(log, axis=1, keepdims=True))

    def value(self, name: str) -> float:
        return float(self.values[NAMES.index(name)])

    def error(self, name: str) -> float:
        k = NAMES.index(name)
        return float(np.sqrt(max(self.covariance[k, k], 0.0))) if self.free[k] else float("nan")


def fit_trials(sets: Sequence[Trials], law: Law, start: NDArray, rounds: int = _ROUNDS) -> Fit:
    """Fit from a start; the grids of thresholds follow the fit.

    Parameters
    ----------
    rounds : most that are made on either grid.
    """
    values = start.copy()
    for _ in range(2):
        # the grid is laid about the thresholds of the round before
        on, off = (threshold_grid(values[t], values[m]) for t, m in zip(THETA, MISMATCH, strict=True))
        likelihood = Likelihood.of(sets, law, (on, off))
        values, scores, free, best = _climb(likelihood, values, rounds)
    information = scores[:, free].T @ scores[:, free]
    covariance = np.full((len(NAMES), len(NAMES)), np.nan)
    # scores are by ln of the parameters: back to the parameters themselves
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    covariance[np.ix_(free, free)] = inverse * np.outer(values[free], values[free])
    # the law itself is approximate, which no number of trials changes
    covariance[np.diag_indices(len(NAMES))] += (_LAW_ERROR * values) ** 2
    return Fit(law, values, covariance, scores, free, likelihood, best)


def _scores(likelihood: Likelihood, values: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ln L [pixel] and its derivatives [pixel, parameter] by the ln of each."""
    given = likelihood.given_thresholds(values)
    each = likelihood.of_pixels(values, given)
    scores = np.empty((each.size, len(NAMES)))
    for k in range(len(NAMES)):
        there = values.copy()
        there[k] *= np.exp(_H)
        # the other polarity's mean threshold enters chances only by competition: left out of the derivative
        scores[:, k] = (likelihood.of_pixels(there, given if k < RESPONSE else None) - each) / _H
    return each, scores


def _climb(likelihood: Likelihood, start: NDArray, rounds: int) -> tuple[NDArray, NDArray, NDArray[np.bool_], float]:
    values, least = start.copy(), _FLOOR * start
    for _ in range(rounds):
        each, scores = _scores(likelihood, values)
        best, gradient = float(each.sum()), scores.sum(axis=0)
        free = np.ones(len(NAMES), bool)
        for k in _MAY_VANISH:
            # a term at its floor stays out unless the likelihood rises with it
            free[k] = values[k] > 2 * least[k] or gradient[k] > 0
        # far from the maximum scores are large because all point one way: the curvature follows from their scatter
        centred = scores[:, free] - scores[:, free].mean(axis=0)
        information = centred.T @ centred
        ridge = 1e-9 * np.trace(information) * np.eye(int(free.sum()))
        change = np.zeros(len(NAMES))
        change[free] = np.linalg.solve(information + ridge, gradient[free])
        # twice what the step should gain in ln L
        expected = float(gradient[free] @ change[free])
        if expected < _ENOUGH:
            break
        if (better := _along(likelihood, values, np.clip(change, -_LARGEST, _LARGEST), least, best)) is None:
            break
        values = better
    each, scores = _scores(likelihood, values)
    return values, scores, free, float(each.sum())


def _along(
    likelihood: Likelihood, values: NDArray, change: NDArray, least: NDArray, best: float
) -> NDArray[np.float64] | None:
    """The best point in the direction `change` of ln of the parameters; None where none is better."""
    result, scale = None, 1.0
    for _ in range(_TRIES):
        there = values * np.exp(scale * change)
        there[list(_MAY_VANISH)] = np.maximum(there, least)[list(_MAY_VANISH)]
        total = float(likelihood.of_pixels(there).sum())
        # double the step while it gains, shorten it while it does not
        if total > best:
            result, best = there, total
            if scale < 1:
                break
            scale *= 2.0
        elif result is not None:
            break
        else:
            scale *= 0.4
    return result


def rough_start(steady: Trials, steps: Trials, good: NDArray[np.bool_], law: Law) -> NDArray[np.float64]:
    """A start from closed forms: centres and widths of the pooled S-curves of each light, then the bandwidth by trial.

    Right after a step P = Q((θ − S)/w) over all pixels, w² = σ₀² + σ₁² + m² θ². r is the one with which θ is the same
    in all lights, and m, β3² and β4² are the least squares of w².
    """
    good_steps = steps.of(good)
    spread = [median_and_spread(pixel_thresholds(good_steps, p))[1] for p in (1, -1)]
    curves = [curve for p in (1, -1) for curve in _pooled_curves(good_steps, p)]
    light = np.array([c[1] for c in curves])
    if light.size == 0:
        raise SpecError("no S-curve rises from below ½ to above it; take steps of up to twice the threshold")
    # the response with which all lights agree on the threshold
    tried = np.geomspace(0.3, 3000.0, 200) / light.max()
    response = float(tried[np.argmin([_disagreement(curves, r) for r in tried])])
    polarity, _, centre, variance = np.array(curves).T
    # each curve's centre as a threshold; of all curves of a polarity, the median
    x0, x1 = 1 + response * light, 1 + response * light * np.exp(polarity * centre)
    theta_of = polarity * np.log(x1 / x0)
    theta = [float(np.median(theta_of[polarity == p])) if np.any(polarity == p) else 0.0 for p in (1, -1)]
    theta = [t or max(theta) for t in theta]
    # width² is linear in mismatch², shot noise and read noise: least squares with none below 0
    power, power_1 = ((v if law == "sqrt" else v * v) for v in (light, light * np.exp(polarity * centre)))
    width = variance * ((x1 - 1) / x1) ** 2
    columns = np.stack([theta_of**2, power / x0**2 + power_1 / x1**2, 1 / x0**2 + 1 / x1**2], axis=1)
    result, _ = nnls(columns / width[:, None], np.ones(width.size))
    # no noise term starts at 0, where its slope vanishes
    least = (0.02 * theta[0]) ** 2
    mismatch = [float(np.clip(np.sqrt(result[0]), 0.02, max(s, 0.02))) for s in spread]
    shot = max(result[1], 0.05 * least * (1 + response * light.max()) ** 2 / power.max())
    values = np.array([*theta, *mismatch, response, shot, max(result[2], least), 0.0, _leak_start(steady)])
    # the bandwidth has no closed form: the likeliest of sixteen, on some of the pixels
    few = np.random.default_rng(0).permutation(np.flatnonzero(good))[:_FEW]
    sets = steady.of(few), steps.of(few)
    grids = tuple(threshold_grid(t, m)[::4] for t, m in zip(theta, mismatch, strict=True))
    likelihood, ends = Likelihood.of(sets, law, (grids[0], grids[1])), []
    for cutoff in np.geomspace(0.1, 30.0, 16) / steps.edges_s[-1]:
        values[CUTOFF] = cutoff
        ends.append((float(likelihood.of_pixels(values).sum()), cutoff))
    values[CUTOFF] = max(ends)[1]
    return values


def _pooled_curves(steps: Trials, polarity: int) -> list[tuple[int, float, float, float]]:
    """Polarity, light, and mean and variance of |ln I₁/I₀| of the S-curve right after the step, of each light."""
    result = []
    for light in np.unique(steps.signal_dn):
        kinds = np.flatnonzero((np.sign(steps.contrast) == polarity) & (steps.signal_dn == light))
        kinds = kinds[np.argsort(np.abs(steps.contrast[kinds]))]
        # share of the calm trials of all pixels with an event in the first bin
        rate = steps.events(polarity)[kinds, 0].sum(axis=1) / np.maximum(steps.calm[kinds].sum(axis=1), 1)
        if kinds.size < 3 or rate[0] > 0.4 or rate[-1] < 0.6:
            continue
        # where even the last step lacks events, the start follows from the existing ones; the checks report it
        contrast, missing = np.abs(steps.contrast[kinds]), 1 - rate / rate[-1]
        # mean and variance of a law from its distribution function, by integrals
        first = np.trapezoid(missing, contrast)
        second = 2 * np.trapezoid(missing * (contrast - contrast[0]), contrast)
        result.append((polarity, float(light), float(contrast[0] + first), float(max(second - first**2, 1e-8))))
    return result


def _disagreement(curves: list[tuple[int, float, float, float]], response: float) -> float:
    """Relative variance of θ over lights, of both polarities."""
    total = 0.0
    for sign in (1, -1):
        some = [(light, sign * centre) for p, light, centre, _ in curves if p == sign]
        theta = [abs(np.log((1 + response * light * np.exp(c)) / (1 + response * light))) for light, c in some]
        total += float(np.var(theta) / np.mean(theta) ** 2) if len(theta) > 1 else 0.0
    return total


def _leak_start(steady: Trials) -> float:
    """ON events per second of calm time in the brightest steady light, half an event at least."""
    k = int(np.argmax(steady.signal_dn))
    return float((steady.on[k].sum() + 0.5) / max(steady.calm[k].sum() * steady.edges_s[-1], 1e-12))


def pixel_thresholds(steps: Trials, polarity: int) -> NDArray[np.float64]:
    """A rough threshold of each pixel, ln I₁/I₀: where half the trials from the brightest light have an event.

    It is the mean of the S-curve (Spearman and Kärber): the least contrast plus the integral of the probability of no
    event.
    """
    bright = steps.signal_dn[np.sign(steps.contrast) == polarity].max()
    kinds = np.flatnonzero((np.sign(steps.contrast) == polarity) & (steps.signal_dn >= 0.999 * bright))
    kinds = kinds[np.argsort(np.abs(steps.contrast[kinds]))]
    contrast = np.abs(steps.contrast[kinds])
    rate = steps.events(polarity)[kinds].sum(axis=1) / np.maximum(steps.calm[kinds], 1)
    missing = 1.0 - rate
    return contrast[0] + np.trapezoid(missing, contrast, axis=0)


def median_and_spread(values: NDArray) -> tuple[float, float]:
    """Median, and relative spread by quartiles, which a few bad pixels do not change."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return float(middle), float((high - low) / 1.349 / max(middle, 1e-12))

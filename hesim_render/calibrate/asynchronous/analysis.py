"""Analysis of trials after a reset of an asynchronous sensor, and maps of its pixels."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.asynchronous.checks import TrialGoodness, check_trials
from hesim_render.calibrate.asynchronous.defects import TrialDefects, classify, plainly_bad, unlike
from hesim_render.calibrate.asynchronous.fit import MOST_PIXELS, Fit, fit_trials, rough_start
from hesim_render.calibrate.asynchronous.likelihood import NAMES, THETA, Law, TrialCounts
from hesim_render.calibrate.asynchronous.trials import Trials, read_trials
from hesim_render.calibrate.estimate import Finding, Spread
from hesim_render.core.errors import SpecError
from hesim_render.recording.capture_set import CaptureSet

#: Difference of log-likelihood that decides between the shot laws; below it the law of the paper is used.
DECISIVE = 5.0
#: Difference of log-likelihood that decides after `_GLANCE` rounds of either fit.
_BEYOND_DOUBT, _GLANCE = 500.0, 4
#: Number of pixels for the choice of the shot law, and least number of good pixels.
_FEW, _FEWEST = 1024, 64
_CHUNK = 8192
#: Number of standard errors above which a mismatch is significant.
_SIGMAS = 4.0
_LAWS: tuple[Law, Law] = ("linear", "sqrt")


@dataclass(frozen=True)
class AsynchronousCalibration:
    """Results of the trials.

    Attributes
    ----------
    fit : parameters; its pixels are `fitted`.
    advantage : ln L of its shot law minus that of the other, on `_FEW` pixels.
    mismatch : mismatch of both polarities together.
    relative : [polarity (ON, OFF)][pixel], threshold of each pixel over the mean; 1 where not measured.
    noise : [polarity][pixel], standard error of each.
    """

    steady: Trials
    steps: Trials
    fit: Fit
    fitted: NDArray[np.intp]
    advantage: float
    mismatch: Spread
    defects: TrialDefects
    relative: tuple[NDArray[np.float32], NDArray[np.float32]]
    noise: tuple[NDArray[np.float32], NDArray[np.float32]]
    findings: list[Finding]
    goodness: dict[str, TrialGoodness]


def analyse_trials(
    captures: CaptureSet, seed: int = 0, progress: Callable[[str, float], None] | None = None
) -> AsynchronousCalibration:
    """Analyse the trials.

    Parameters
    ----------
    captures : capture set.
    seed : seed of the choice of fitted pixels, where there are more than `MOST_PIXELS`.
    progress : called with a text and the fraction done.

    Raises
    ------
    SpecError
        As `read_trials`, and where more than half of the pixels are bad or nothing can be fitted.
    """
    tell = progress or (lambda what, fraction: None)
    steady, steps = read_trials(captures)
    bad = plainly_bad(steady, steps)
    if bad.mean() > 0.5 or np.sum(~bad) < _FEWEST:
        raise SpecError(
            f"{int(bad.sum())} of {bad.size} event pixels lack events of a polarity, are not calm after a reset, or "
            "have events of their own; take steps of up to twice the threshold, and a longer reset",
            file=captures.folder,
        )
    order = np.random.default_rng(seed).permutation(bad.size)
    tell("shot law", 0.05)
    few = order[~bad[order]][:_FEW]
    sets = steady.of(few), steps.of(few)
    laws = {one: fit_trials(sets, one, rough_start(steady, steps, ~bad, one), _GLANCE) for one in _LAWS}
    advantage = laws["sqrt"].log_likelihood - laws["linear"].log_likelihood
    if abs(advantage) < _BEYOND_DOUBT:
        laws = {one: fit_trials(sets, one, result.values) for one, result in laws.items()}
        advantage = laws["sqrt"].log_likelihood - laws["linear"].log_likelihood
    law: Law = "sqrt" if advantage > DECISIVE else "linear"
    fit = laws[law]
    for turn in range(2):
        tell("fitting", 0.3 + 0.3 * turn)
        fitted = order[~bad[order]][:MOST_PIXELS]
        fit = fit_trials((steady.of(fitted), steps.of(fitted)), law, fit.values)
        more = unlike(fit, steady, steps, ~bad)
        if not more.any():
            break
        bad |= more
    if not np.all(np.isfinite(fit.values)) or not np.all(np.isfinite(fit.covariance[:2, :2])):
        raise SpecError("the trials do not tell thresholds and noise; take more, and more steps", file=captures.folder)
    tell("maps of pixels", 0.8)
    maps = [_pixel_thresholds(fit, steady, steps, p) for p in (1, -1)]
    tell("checks", 0.9)
    findings, goodness = check_trials(fit, (steady.of(fitted), steps.of(fitted)))
    return AsynchronousCalibration(
        steady=steady,
        steps=steps,
        fit=fit,
        fitted=fitted,
        advantage=advantage if law == "sqrt" else -advantage,
        mismatch=_mismatch(fit),
        defects=classify(steady, steps, bad),
        relative=(maps[0][0], maps[1][0]),
        noise=(maps[0][1], maps[1][1]),
        findings=findings,
        goodness=goodness,
    )


def _mismatch(fit: Fit) -> Spread:
    """Mismatch of both polarities, weighted by their inverse variances."""
    k = [NAMES.index(name) for name in ("mismatch_on", "mismatch_off")]
    values, covariance = fit.values[k], fit.covariance[np.ix_(k, k)]
    if not (np.all(np.isfinite(covariance)) and np.linalg.det(covariance) > 0):
        return Spread(0.0, float("nan"), float(values.max()))
    weight = np.linalg.solve(covariance, np.ones(2))
    weight /= weight.sum()
    value, error = float(weight @ values), float(np.sqrt(weight @ covariance @ weight))
    if value < _SIGMAS * error:
        return Spread(0.0, float("nan"), value + 2 * error)
    return Spread(value, error, value + 2 * error)


def _pixel_thresholds(
    fit: Fit, steady: Trials, steps: Trials, polarity: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Posterior mean and standard deviation of each pixel's threshold given its counts, over the mean threshold."""
    k = 0 if polarity > 0 else 1
    grid = fit.likelihood.grids[k]
    relative = grid / fit.values[THETA[k]]
    count = steps.calm.shape[1]
    mean, spread = np.ones((2, count), np.float32)
    for begin in range(0, count, _CHUNK):
        some = np.arange(begin, min(begin + _CHUNK, count))
        weight = fit.law_given(TrialCounts.of((steady.of(some), steps.of(some)), polarity))
        mean[some] = weight @ relative
        spread[some] = np.sqrt(np.maximum(weight @ relative**2 - mean[some].astype(np.float64) ** 2, 0.0))
    return mean, spread

"""Checks whether first events follow their law: their number per kind of trial, their times, and forbidden events.

A test of moments (Newey 1985; Tauchen 1985): the mean over pixels of what was counted less what the fit expects, with
its scatter over pixels, is normal. The part that the fit itself removed is taken into account by the pixels' scores.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_law
from scipy.stats import norm, poisson

from hesim_render.calibrate.asynchronous.fit import Fit, median_and_spread, pixel_thresholds
from hesim_render.calibrate.asynchronous.likelihood import LEAK, THETA, chances, step_of
from hesim_render.calibrate.asynchronous.trials import Trials
from hesim_render.calibrate.estimate import ALARM, Finding

#: Least number of events, and of trials without one, in a tested column; and number of pixels per column.
_FEWEST, _PIXELS_PER_COLUMN = 25.0, 10
#: Directions with less variance than this fraction of a column's are those that the fit removed.
_LEAST_VARIANCE = 1e-4
#: Allowed relative error of the law of times after a step and in steady light: its rates are approximations.
_LAW_ERROR = 0.03
#: Allowed relative error of the law right after a step.
_STEP_ERROR = 0.002
#: Loss of events, and events of the wrong polarity, per trial, above which they are reported.
_LEAST_LOSS, _LEAST_FLOOR = 1e-3, 1e-4
#: Number of spreads of the pixels' thresholds beyond which a step certainly gives an event.
_FAR = 4.0
#: Squared distance from the best fit, in standard errors, above which the search is reported as failed.
_UNDONE = 16.0
_FAMILIES = ("steps", "times", "steady")


@dataclass(frozen=True)
class TrialGoodness:
    """χ² of one family of columns, or of all, its degrees of freedom, and the probability of a larger one."""

    chi2: float
    dof: int
    p_value: float


@dataclass(frozen=True)
class Columns:
    """Compared numbers, [pixel, column]; `family` is an index into `_FAMILIES`."""

    residual: NDArray[np.float64]
    expected: NDArray[np.float64]  # [column], of all pixels
    silent: NDArray[np.float64]  # [column], trials of all pixels without it
    family: NDArray[np.intp]


def check_trials(fit: Fit, sets: tuple[Trials, Trials]) -> tuple[list[Finding], dict[str, TrialGoodness]]:
    """Every check, on the pixels of the fit: `sets` are their trials, steady and with steps."""
    columns = _columns(fit)
    goodness = {name: _judge(columns, np.flatnonzero(columns.family == k), fit) for k, name in enumerate(_FAMILIES)}
    goodness["all"] = _judge(columns, np.arange(columns.family.size), fit)
    result = [_family(name, goodness[name]) for name in _FAMILIES]
    result += [_ended(fit), _ceiling(sets[1]), _floor(fit, sets[1])]
    return [f for f in result if f is not None], goodness


def _columns(fit: Fit) -> Columns:
    parts: list[tuple[NDArray, NDArray, NDArray, NDArray]] = []
    for k, counts in enumerate(fit.likelihood.counts):
        grid = fit.likelihood.grids[k]
        # mean over each pixel's possible thresholds: pixels with low thresholds are calm less often, and count less
        weight = fit.law_given(counts)
        at = at_kind = 0
        for trials in counts.sets:
            chance = chances(fit.values, trials, counts.polarity, grid, fit.law)
            mean = np.tensordot(weight, chance, (1, 2))  # [pixel, kind, bin]
            kinds, bins = mean.shape[1:]
            events = counts.events[:, at : at + kinds * bins].reshape(-1, kinds, bins)
            total = events.sum(axis=2) + counts.silent[:, at_kind : at_kind + kinds]
            expected = total[:, :, None] * mean
            steady = not np.any(trials.contrast)
            family = np.full((kinds, bins), _FAMILIES.index("times"))
            family[:, 0] = _FAMILIES.index("steps")
            family[steady] = 0
            if steady:
                family[:] = _FAMILIES.index("steady")
            sums = expected.sum(axis=0)
            parts.append(
                (
                    (events - expected).reshape(len(events), -1), sums.ravel(),
                    (total.sum(axis=0)[:, None] - sums).ravel(), family.ravel(),
                )
            )  # fmt: skip
            at, at_kind = at + kinds * bins, at_kind + kinds
    residual, expected, silent, family = (np.concatenate(v, axis=-1) for v in zip(*parts, strict=True))
    # unexpected events count as well
    seen = residual.sum(axis=0)
    enough = (np.maximum(expected, expected + seen) >= _FEWEST) & (np.maximum(silent, silent - seen) >= _FEWEST)
    return Columns(residual[:, enough], expected[enough], silent[enough], family[enough])


def _judge(columns: Columns, some: NDArray[np.intp], fit: Fit) -> TrialGoodness:
    """Test of some columns. Neighbouring columns are added where there are many in relation to the pixels."""
    count = columns.residual.shape[0]
    group = np.arange(some.size) * min(1.0, count / _PIXELS_PER_COLUMN / max(some.size, 1))
    group = np.unique(np.floor(group).astype(int), return_inverse=True)[1]
    if some.size == 0 or group.max() + 1 > count / 4:
        return TrialGoodness(float("nan"), 0, 1.0)
    gather = np.zeros((some.size, group.max() + 1))
    gather[np.arange(some.size), group] = 1.0
    residual = columns.residual[:, some] @ gather
    error = np.where(columns.family[some] == 0, _STEP_ERROR, _LAW_ERROR) * columns.expected[some]
    error *= columns.silent[some] / (columns.expected[some] + columns.silent[some])
    scores = fit.scores[:, fit.free]
    # the pixels' scores remove what the fit fitted, and the remainder where it stopped before convergence
    left = residual - scores @ np.linalg.lstsq(scores, residual, rcond=None)[0]
    total = left.sum(axis=0)
    left = left - left.mean(axis=0)
    covariance = left.T @ left * (1 + 1 / count) + np.diag((error @ gather) ** 2)
    scale = np.sqrt(np.maximum(np.diag(residual.T @ residual), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > _LEAST_VARIANCE
    along = vectors[:, kept].T @ (total / scale)
    chi2, dof = float(np.sum(along**2 / values[kept])), int(kept.sum())
    ratio = chi2 * (count - dof) / (dof * (count - 1))
    return TrialGoodness(chi2, dof, float(f_law.sf(ratio, dof, count - dof)))


_LOOK_AT = {
    "steps": (
        "S-curve",
        "events right after a step are not those of one normal law of noise with normally spread thresholds: "
        "thresholds, mismatch and noise may be off. Look at the plot of the S-curves: contrasts not as stated, a "
        "step that takes longer than the first time bin, noise with long tails, events that are lost, or light that "
        "is not uniform.",
    ),
    "times": (
        "event times",
        "events in the later time bins after a step do not come as noise of one bandwidth brings them: "
        "noise_cutoff_hz is off. Look for steps that end late in the pixel (its signal bandwidth), latency of "
        "the read-out, or light that flickers.",
    ),
    "steady": (
        "noise rate",
        "events in steady light are not those of the noise that the S-curves have: noise_cutoff_hz, noise "
        "and leak may be off. Look for events that come by themselves (hot neighbours, flicker of the lamp, light that "
        "drifts), a dark level that is not dark, or another bias than that of the steps.",
    ),
}


def _family(name: str, goodness: TrialGoodness) -> Finding | None:
    if not goodness.p_value < ALARM:
        return None
    check, text = _LOOK_AT[name]
    return Finding(check, f"χ²/dof {goodness.chi2 / max(goodness.dof, 1):.3g}: {text}", goodness.p_value)


def _ended(fit: Fit) -> Finding | None:
    """Finding of a search that stopped far from its end. The other tests have removed the remaining deviation."""
    scores = fit.scores[:, fit.free]
    total = scores.sum(axis=0)
    left = float(total @ np.linalg.pinv(scores.T @ scores, hermitian=True) @ total)
    if left < _UNDONE:
        return None
    return Finding(
        "fit",
        f"the search for the parameters ended {np.sqrt(left):.2g} standard errors from the best: no parameters of "
        "this law describe the trials, and no figure below holds. Look at the S-curves of both time bins: events "
        "that come late (latency of the read-out, a step that is slower than the first time bin) or are lost, "
        "contrasts or lights that are not as stated.",
        None,
    )


def _ceiling(steps: Trials) -> Finding | None:
    """Finding of missing events at steps beyond four spreads of the pixels' own middle contrasts."""
    lost, total = np.zeros(steps.calm.shape[1]), 0.0
    for polarity in (1, -1):
        middle, spread = median_and_spread(pixel_thresholds(steps, polarity))
        there = steps.towards(polarity)
        sure = np.abs(there.contrast) > middle * (1 + _FAR * spread)
        sure &= there.signal_dn >= 0.999 * there.signal_dn.max()
        events = (there.on + there.off)[sure].sum(axis=(0, 1), dtype=np.float64)
        trials = there.calm[sure].sum(axis=0, dtype=np.float64)
        lost += trials - events
        total += float(trials.sum())
    if total == 0:
        return None
    loss, error = lost.sum() / total, np.sqrt(lost.size * lost.var() + 1.0) / total
    p_value = float(norm.sf((loss - _LEAST_LOSS / 2) / error))
    if p_value > ALARM or loss < _LEAST_LOSS:
        return None
    return Finding(
        "S-curve ceiling",
        f"steps far beyond the threshold give no event in {loss:.2g} of the trials: thresholds and noise are off. "
        "Events are lost (look at the read-out's bandwidth when all pixels step at once: step fewer of them), or "
        "trials are counted that had no step.",
        p_value,
    )


def _floor(fit: Fit, steps: Trials) -> Finding | None:
    """Finding of events with the polarity opposite to the step, beyond leak."""
    step = step_of(fit.values, steps)
    result = []
    for name, polarity, leak in (("ON", 1, fit.values[LEAK]), ("OFF", -1, 0.0)):
        theta = fit.values[THETA[0 if polarity > 0 else 1]]
        away = (np.sign(steps.contrast) == -polarity) & (np.abs(step) > 0.5 * theta)
        away &= steps.signal_dn == steps.signal_dn.max()
        trials = float(steps.calm[away].sum(dtype=np.float64))
        events = float(steps.events(polarity)[away].sum(dtype=np.float64))
        usual = trials * leak * steps.edges_s[-1]
        p_value = float(poisson.sf(events - 1, usual + 0.5))
        if trials and p_value < ALARM / 2 and (events - usual) / trials > _LEAST_FLOOR:
            result.append((name, events / trials, p_value))
    if not result:
        return None
    rates = " and ".join(f"{r:.2g} ({n})" for n, r, _ in result)
    return Finding(
        "S-curve floor",
        f"steps away from the threshold give events, in {rates} of the trials, beyond leak. Noise and leak are off. "
        "Look for events that come by themselves, or a reset that is not over when the trial begins.",
        min(2 * p for _, _, p in result),
    )

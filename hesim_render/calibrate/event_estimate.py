"""The event model fitted to pooled counts: what is identified, what is not, and with which error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.event_dispersion import Dispersion
from hesim_render.calibrate.event_fit import Scatter, maximise, quasi_sandwich, sandwich, search, start_values
from hesim_render.calibrate.event_model import (
    EventCounts,
    Law,
    log_likelihood,
    log_probabilities,
    natural,
    probabilities,
    probability_variance,
    threshold_over_noise,
)
from hesim_render.calibrate.event_pool import PooledEvents

#: Least eigenvalue of a scaled information matrix that tells all its parameters apart.
_SINGULAR = 1e-9
#: χ²/dof above which standard errors are widened by its root.
POOR_FIT = 2.0
#: χ²/dof above which the model does not describe the counts at all.
NO_FIT = 100.0
_CAPTURE = (
    "capture a wider range of brightness",
    "capture more trials, and the dark",
    "capture brighter scenes and more trials",
    "capture brighter scenes and more trials",
)


@dataclass(frozen=True)
class EventFit:
    """One fit of the event model.

    Attributes
    ----------
    parameters : [6] as `event_model.PARAMETERS`. free : [6], which were fitted.
    values : [6], A, B, C, D, ρ, λ. covariance : [6, 6] of them. fisher_covariance : as if counts were binomial.
    reasons : why A, B, C or D is not identifiable, by name.
    log_likelihood : trinomial, without the constant.
    pearson_chi2, dof : of the bins.
    """

    law: Law
    parameters: NDArray[np.float64]
    free: tuple[bool, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    fisher_covariance: NDArray[np.float64]
    reasons: dict[str, str]
    log_likelihood: float
    pearson_chi2: float
    dof: int

    def identified(self, name: str) -> bool:
        """Whether the data tell A, B, C or D."""
        return self.free["ABCD".index(name)] and name not in self.reasons


def fit_events(
    pooled: PooledEvents,
    theta_v: float,
    law: Law,
    mismatch: float,
    spread: Dispersion | None,
    start: NDArray | None = None,
    asymmetry: tuple[bool, ...] | None = None,
) -> EventFit:
    """Fit A, B, C, D (and ρ, λ where the counts call for them) to one set of bins [1, bin].

    Parameters that the data do not tell are dropped in the order D, C, A; the rest is fitted again.
    ρ and λ are kept where a likelihood-ratio test rejects their absence at 1e-3.

    Parameters
    ----------
    spread : measured over-dispersion; None takes the counts as binomial.
    start, asymmetry : from a fit of more data: its parameters, and its choice of free parameters.
    """
    bins = pooled.position(0)
    counts = EventCounts(*(v[0] for v in (bins.counts.signal_dn, bins.counts.trials, bins.counts.on, bins.counts.off)))
    theta = theta_v * bins.relative[0]
    begin = _best_start(counts, theta, theta_v, law, mismatch) if start is None else start.copy()
    inverse = None
    dispersed = spread is not None and (mismatch > 0 or spread.in_time != (1.0, 1.0))
    reasons: dict[str, str] = {}
    free = [True] * 4 + ([False, False] if asymmetry is None else list(asymmetry[4:]))
    while True:
        eta, fisher, _ = maximise(counts, begin[None], theta, law, mismatch, free)
        if asymmetry is None:
            eta, fisher, free = _test_asymmetry(
                counts,
                eta,
                fisher,
                theta,
                law,
                mismatch,
                free,
                _dispersion_factor(bins, eta[0], theta, law, mismatch),
            )
        likelihood = _likelihood(counts, eta[0], theta, law, mismatch)
        if dispersed and spread is not None:
            for _ in range(2):
                inverse = np.linalg.inv(_model_scatter(bins, eta[0], theta, law, mismatch, spread))[None]
                eta, fisher, _ = maximise(counts, eta, theta, law, mismatch, free, inverse)
        covariance, mixed = _covariance(fisher[0])
        # Where the data tell only a combination, none of its members is identified, though some stay in the fit.
        reasons |= {
            "ABCD"[k]: "the static capture tells only a combination of parameters; " + _CAPTURE[k] for k in mixed
        }
        weak = _weakest(eta[0], covariance, free, counts)
        if weak is None:
            break
        name, index, reason = weak
        if index == 2 and free[0] and 0 in mixed and _better_without(0, 2, counts, eta, theta, law, mismatch, free):
            name, index, reason = "A", 0, reasons["A"]
        reasons.setdefault(name, reason)
        free[index] = False
        begin = _without(eta[0], index)
        if index == 2 and free[3]:
            reasons["D"], free[3], begin[3] = "it has no effect without C", False, 0.0
    mask = np.array(free)
    fisher_covariance = covariance * mask[:, None] * mask
    used_covariance = fisher_covariance
    if dispersed:
        own, lit_dark = bins.scatter_about(
            *(bins.trials * p for p in probabilities(eta, bins.counts.signal_dn, theta, law, mismatch))
        )
        pixels = bins.pixels[0][:, None, None]
        scatter = Scatter(own[0] * pixels, lit_dark[0] * pixels, bins.dark_bin)
        if inverse is None:
            used_covariance = sandwich(eta[0], counts, theta, law, mismatch, free, scatter)
        else:
            used_covariance = (
                quasi_sandwich(eta[0], counts, theta, law, mismatch, inverse[0], scatter, covariance)
                * mask[:, None]
                * mask
            )
    values, natural_covariance = natural(eta[0], used_covariance)
    _, natural_fisher = natural(eta[0], fisher_covariance)
    chi2 = _pearson(bins, eta[0], theta, law, mismatch, spread if dispersed else None)
    dof = 2 * counts.signal_dn.size - int(mask.sum())
    if chi2 > POOR_FIT * dof:
        # The counts scatter about the model more than they should: no error may be smaller than that scatter.
        natural_covariance = natural_covariance * (chi2 / dof)
    return EventFit(
        law, eta[0], tuple(free), values, natural_covariance, natural_fisher, reasons, likelihood, chi2, dof
    )


def _best_start(
    counts: EventCounts, theta: float | NDArray, theta_v: float, law: Law, mismatch: float
) -> NDArray[np.float64]:
    """Where the likeliest of several searches for A, B, C and D ends: from one start alone it may be a side hill."""
    tried, _, _ = search(counts, start_values(counts, theta_v, law), theta, law, mismatch, [True] * 4 + [False] * 2)
    likelihood = [_likelihood(counts, eta, theta, law, mismatch) for eta in tried]
    return tried[int(np.nanargmax(likelihood))]


def _test_asymmetry(
    counts: EventCounts,
    eta: NDArray,
    fisher: NDArray,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    free: list[bool],
    factor: float,
) -> tuple[NDArray, NDArray, list[bool]]:
    """Add ρ, then λ, where the likelihood gains enough for the parameter added (1e-3, scaled by over-dispersion)."""

    enough = float(chi2_law.isf(1e-3, 1)) / 2 * factor
    for index in (4, 5):
        if free[index]:
            continue
        wider = list(free)
        wider[index] = True
        tried, information, _ = maximise(counts, eta, theta_v, law, mismatch, wider)
        gain = _likelihood(counts, tried[0], theta_v, law, mismatch) - _likelihood(
            counts, eta[0], theta_v, law, mismatch
        )
        if gain > enough:
            eta, fisher, free = tried, information, wider
    return eta, fisher, free


def _dispersion_factor(bins: PooledEvents, eta: NDArray, theta_v: float | NDArray, law: Law, mismatch: float) -> float:
    """Scatter of ON − OFF over the pixels beyond counting: what a test of their asymmetry must allow for."""
    scatter = bins.scatter()[0]
    on, off = probabilities(eta, bins.counts.signal_dn[0], theta_v, law, mismatch)
    use = bins.pixels[0] > 1
    measured = (scatter[:, 0, 0] + scatter[:, 1, 1] - 2 * scatter[:, 0, 1])[use]
    expected = (bins.trials * (on + off))[use]
    return max(1.0, float(np.sum(measured * bins.pixels[0][use]) / np.sum(expected * bins.pixels[0][use])))


def _weakest(eta: NDArray, covariance: NDArray, free: list[bool], counts: EventCounts) -> tuple[str, int, str] | None:
    """The next parameter to give up, or None where all that are left are identified."""
    values, natural_covariance = natural(eta, covariance * np.outer(free, free))
    error = np.sqrt(np.maximum(np.diag(natural_covariance), 0))
    narrow = np.ptp(counts.signal_dn) < 0.2 * counts.signal_dn.max()
    span = "the static capture holds too narrow a range of brightness" if narrow else "its error exceeds its value"
    if free[3] and abs(values[3]) > 0.99:
        return "D", 3, f"it ends at the edge of its range; {_CAPTURE[3]}"
    # D lies in [-1, 1]: an interval of 95 % that is as wide says nothing
    for name, index, largest in (("D", 3, 0.5), ("C", 2, values[2]), ("A", 0, values[0]), ("B", 1, values[1])):
        if free[index] and not error[index] < largest:
            return name, index, f"{span}; {_CAPTURE[index]}"
    return None


def _without(eta: NDArray, index: int) -> NDArray[np.float64]:
    """The parameters with one of them set to what leaves it out: A, C or D of 0."""
    changed = eta.copy()
    if index == 3:
        changed[2] += changed[3] ** 2
    changed[index] = 0.0
    return changed


def _better_without(
    one: int,
    other: int,
    counts: EventCounts,
    eta: NDArray,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    free: list[bool],
) -> bool:
    """Whether leaving out `one` parameter fits better than leaving out the `other`."""
    values = []
    for index in (one, other):
        kept = [ok and k != index for k, ok in enumerate(free)]
        fitted, _, _ = maximise(counts, _without(eta[0], index)[None], theta_v, law, mismatch, kept)
        values.append(_likelihood(counts, fitted[0], theta_v, law, mismatch))
    return values[0] > values[1]


def _likelihood(counts: EventCounts, eta: NDArray, theta_v: float | NDArray, law: Law, mismatch: float) -> float:
    return float(log_likelihood(counts, *log_probabilities(eta, counts.signal_dn, theta_v, law, mismatch)[:2]))


def _covariance(information: NDArray) -> tuple[NDArray[np.float64], list[int]]:
    """Inverse of the information, and the parameters (of A, B, C, D) that it tells only in combination."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-250))
    value, vector = np.linalg.eigh(information / np.outer(scale, scale))
    lost = value < _SINGULAR
    mixed = [k for k in range(4) if np.any(np.abs(vector[k, lost]) > 0.05)]
    inverse = (vector / np.maximum(value, _SINGULAR**2)) @ vector.T
    return inverse / np.outer(scale, scale), mixed


def _model_scatter(
    bins: PooledEvents, eta: NDArray, theta_v: float | NDArray, law: Law, mismatch: float, spread: Dispersion | None
) -> NDArray[np.float64]:
    """Covariance [bin, 2, 2] of a bin's total counts: trinomial in time, thresholds over pixels."""
    signal, n = bins.counts.signal_dn[0], bins.trials
    # Never below a thousandth of an event in a bin: a trial fit may make P vanish, and the matrix must have an inverse.
    least = 1e-3 / np.maximum(bins.counts.trials[0], 1)
    on, off = (np.maximum(p, least) for p in probabilities(eta, signal, theta_v, law, mismatch))
    total, difference = spread.in_time if spread is not None else (1.0, 1.0)
    # the trinomial covariance, scaled in its sum and difference, so that it stays one however large P is
    both, apart = total * (on + off) * (1 - on - off), difference * (on + off - (on - off) ** 2)
    skew = np.sqrt(total * difference) * (on * (1 - on) - off * (1 - off))
    one = np.empty((signal.size, 2, 2))
    one[:, 0, 0], one[:, 1, 1] = (both + apart) / 4 + skew / 2, (both + apart) / 4 - skew / 2
    one[:, 0, 1] = one[:, 1, 0] = (both - apart) / 4
    one *= n
    if spread is not None and mismatch > 0:
        u, _ = threshold_over_noise(eta, signal, theta_v, law)
        between = n * n * probability_variance(u, mismatch)
        shared = spread.common**2 - spread.difference**2
        total = spread.common**2 + spread.difference**2
        one[:, 0, 0] += between
        one[:, 1, 1] += between
        one[:, 0, 1] += between * (shared / total if total > 0 else 1.0)
        one[:, 1, 0] = one[:, 0, 1]
    return one * bins.pixels[0][:, None, None]


def _pearson(
    bins: PooledEvents, eta: NDArray, theta_v: float | NDArray, law: Law, mismatch: float, spread: Dispersion | None
) -> float:
    on, off = probabilities(eta, bins.counts.signal_dn[0], theta_v, law, mismatch)
    n = bins.counts.trials[0]
    residual = np.stack([bins.counts.on[0] - n * on, bins.counts.off[0] - n * off], axis=-1)
    scatter = _model_scatter(bins, eta, theta_v, law, mismatch, spread)
    return float(np.einsum("bi,bij,bj->", residual, np.linalg.inv(scatter), residual))


def with_mismatch_error(
    fit: EventFit, pooled: PooledEvents, theta_v: float, mismatch: float, error: float, spread: Dispersion
) -> EventFit:
    """Add what the mismatch's own error does to A … D (its effect on them by a finite difference)."""
    if mismatch <= 0 or error <= 0:
        return fit
    moved = fit_events(pooled, theta_v, fit.law, mismatch + error, spread, fit.parameters, fit.free)
    change = np.where(fit.free, moved.values - fit.values, 0.0)
    return replace(fit, covariance=fit.covariance + np.outer(change, change))

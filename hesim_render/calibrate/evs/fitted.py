"""The event model fitted to pooled counts: the identified parameters and their errors; searches from many starts."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.evs.cells import Cells, PixelCounts
from hesim_render.calibrate.evs.fit import maximise, sandwich, search, start_values
from hesim_render.calibrate.evs.model import (
    Goodness,
    Law,
    from_natural,
    goodness,
    log_likelihood,
    log_probability,
    natural,
    probability_variance,
    threshold_over_noise,
)

#: Least eigenvalue of a scaled information matrix at which all its parameters can be separated.
_SINGULAR = 1e-9
#: Number of iterations between the scatter and the fit.
_REWEIGHTED = 4
#: Cells of a polarity in which counts of widely spread thresholds are compared with a law.
_NORMAL = 24
#: χ²/dof above which standard errors are multiplied by its root.
POOR_FIT = 2.0
#: χ²/dof above which the model does not describe the counts at all.
NO_FIT = 100.0
_CAPTURE = (
    "capture a wider range of brightness",
    "capture more trials, and the dark",
    "capture brighter scenes and more trials",
    "capture brighter scenes and more trials",
)
#: Searches of the multi-start study, which must end at one point.
_STARTS = 200
#: ln L below the best end from which an end does not describe the counts: 4 standard errors of a likelihood ratio.
_TOO_UNLIKELY = 8.0


@dataclass(frozen=True)
class EventFit:
    """One fit of the event model.

    Attributes
    ----------
    parameters : [6] as `event_model.PARAMETERS`. free : [6], which were fitted.
    whole : [6], the parameters of the fit of A to D, before any was given up.
    values : [6], A, B, C, D, ρ, λ. covariance : [6, 6] of them, from how the pixels' scores scatter.
    design_effect : variance of A … D, on the average, over that of counts that scatter as the model says.
    reasons : why A, B, C or D is not identifiable, by name.
    log_likelihood : without constants.
    goodness : χ² of the counts by brightness.
    """

    law: Law
    parameters: NDArray[np.float64]
    whole: NDArray[np.float64]
    free: tuple[bool, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    design_effect: float
    reasons: dict[str, str]
    log_likelihood: float
    goodness: Goodness

    def identified(self, name: str) -> bool:
        """Whether the data determine A, B, C or D."""
        return self.free["ABCD".index(name)] and name not in self.reasons


def fit_events(
    pixels: PixelCounts,
    theta_v: float,
    law: Law,
    start: NDArray,
    asymmetry: tuple[bool, ...] | None = None,
) -> EventFit:
    """Fit A, B, C, D (and ρ, λ where the counts call for them).

    Parameters that the data do not determine are dropped in the order D, C, A, and the others are fitted again.
    ρ and λ are kept where a likelihood-ratio test rejects their absence at 1e-3. Where thresholds spread, the
    counts are weighted by the resulting scatter (quasi-likelihood), else the likelihood is binomial.

    Parameters
    ----------
    start : [6], as `event_model.PARAMETERS`.
    asymmetry : from a fit of more data, its choice of free parameters.
    """
    cells = pixels.cells
    begin = start.copy()
    reasons: dict[str, str] = {}
    free = [True] * 4 + ([False, False] if asymmetry is None else list(asymmetry[4:]))
    whole: NDArray | None = None
    while True:
        # fit what is still free; then look for the parameter that is determined least
        eta, fisher, variance = _fit(cells, begin, theta_v, law, free)
        whole = eta.copy() if whole is None else whole
        if asymmetry is None:
            eta, fisher, free = _test_asymmetry(pixels, eta, fisher, theta_v, law, free, variance)
        covariance, mixed = _covariance(fisher)
        # If the data determine only a combination, none of its members is identified, though some stay in the fit.
        reasons |= {
            "ABCD"[k]: "the static capture tells only a combination of parameters; " + _CAPTURE[k] for k in mixed
        }
        weak = _weakest(eta, covariance, free, cells)
        if weak is None:
            break
        name, index, reason = weak
        # A and C may be known in combination only: the one goes without which the fit is better
        if index == 2 and free[0] and 0 in mixed and _better_without(0, 2, cells, eta, theta_v, law, free):
            name, index, reason = "A", 0, reasons["A"]
        reasons.setdefault(name, reason)
        free[index] = False
        # the next fit begins where this one ended, without the parameter
        begin = _without(eta, index)
        if index == 2 and free[3]:
            reasons["D"], free[3], begin[3] = "it has no effect without C", False, 0.0
    mask = np.array(free)
    # errors are from the scatter of the pixels, not from what the model expects
    measured = sandwich(pixels, eta, theta_v, law, free, variance)
    values, natural_covariance = natural(eta, measured)
    # how much wider than by the model alone, mean over A to D
    used = np.flatnonzero(mask[:4])
    effect = float(np.mean(np.diag(measured)[used] / np.maximum(np.diag(covariance)[used], 1e-300))) if used.size else 1
    fit = goodness(pixels, eta, theta_v, law, int(mask.sum()))
    if fit.per_dof > POOR_FIT:
        # The counts scatter about the model more than expected: no error may be smaller than that scatter.
        natural_covariance = natural_covariance * fit.per_dof
    likelihood = _log_likelihood(cells, eta, theta_v, law, variance)
    return EventFit(
        law, eta, whole, tuple(free), values, natural_covariance, max(effect, 1.0), reasons, likelihood, fit
    )  # fmt: skip


def _fit(
    cells: Cells, begin: NDArray, theta_v: float, law: Law, free: list[bool]
) -> tuple[NDArray, NDArray, NDArray | None]:
    """Parameters [6], information [6, 6] and, where thresholds spread, the variance the cells were weighed with."""
    eta, variance = begin[None], None
    for _ in range(_REWEIGHTED if np.any(cells.spread > 0) else 1):
        # with a spread of thresholds, the weights depend on the fit, and are found with it
        if np.any(cells.spread > 0):
            variance = cell_variance(cells, eta[0], theta_v, law)
        eta, fisher, _ = maximise(cells, eta, theta_v, law, free, variance)
    return eta[0], fisher[0], variance


def _log_likelihood(cells: Cells, eta: NDArray, theta_v: float, law: Law, variance: NDArray | None) -> float:
    """Of the events: binomial, or where thresholds spread normal with the scatter that follows; without constants."""
    if variance is not None and np.ptp(cells.relative) == 0:
        cells = cells.coarser(_NORMAL)  # sums of many pixels, whose law is near a normal one
    log_p, _ = log_probability(eta, cells, theta_v, law)
    if variance is None:
        return float(log_likelihood(cells, log_p))
    own = cell_variance(cells, eta, theta_v, law)
    return -0.5 * float(np.sum((cells.events - cells.total * np.exp(log_p)) ** 2 / own + np.log(own)))


def best_start(typical: Cells, theta_v: float, law: Law) -> tuple[NDArray[np.float64], float, float]:
    """Likeliest end point of several searches for A, B, C and D. A search from one start alone may end at a local
    maximum.

    Returns
    -------
    Parameters [6], ln L, and the scatter about them over that of counting.
    """
    tried, _, _ = search(typical, start_values(typical, theta_v, law), theta_v, law, [True] * 4 + [False] * 2)
    log_p = log_probability(tried, typical, theta_v, law)[0]
    likelihood = log_likelihood(typical, log_p)
    best = int(np.nanargmax(likelihood))
    expected = typical.total * np.exp(log_p[best])
    scatter = float(np.mean((typical.events - expected) ** 2 / np.maximum(expected, 1e-9)))
    return tried[best], float(likelihood[best]), max(scatter, 1.0)


def _test_asymmetry(
    pixels: PixelCounts, eta: NDArray, fisher: NDArray, theta_v: float, law: Law, free: list[bool],
    variance: NDArray | None,
) -> tuple[NDArray, NDArray, list[bool]]:  # fmt: skip
    """Add ρ, then λ, where the fit gains enough for the parameter added (1e-3, scaled by over-dispersion)."""
    cells = pixels.cells
    enough = float(chi2_law.isf(1e-3, 1))

    def misfit(parameters: NDArray) -> float:
        log_p, _ = log_probability(parameters, cells, theta_v, law)
        if variance is None:
            return -2 * float(log_likelihood(cells, log_p))
        return float(np.sum((cells.events - cells.total * np.exp(log_p)) ** 2 / variance))

    for index in (4, 5):
        if free[index]:
            continue
        # one parameter more, from the fit without it
        wider = list(free)
        wider[index] = True
        tried, information, _ = maximise(cells, eta[None], theta_v, law, wider, variance)
        gain = misfit(eta) - misfit(tried[0])
        if gain <= enough:
            continue
        # counts of pixels that scatter more than the model says ask for a larger gain
        measured = sandwich(pixels, tried[0], theta_v, law, wider, variance)[index, index]
        dispersed = max(1.0, float(measured / np.maximum(_covariance(information[0])[0][index, index], 1e-300)))
        if gain > enough * dispersed:
            eta, fisher, free = tried[0], information[0], wider
    return eta, fisher, free


def _weakest(eta: NDArray, covariance: NDArray, free: list[bool], cells: Cells) -> tuple[str, int, str] | None:
    """The next parameter to drop, or None where all that are left are identified."""
    values, natural_covariance = natural(eta, covariance * np.outer(free, free))
    error = np.sqrt(np.maximum(np.diag(natural_covariance), 0))
    narrow = np.ptp(cells.signal_dn) < 0.2 * cells.signal_dn.max()
    span = "the static capture holds too narrow a range of brightness" if narrow else "its error exceeds its value"
    if free[3] and abs(values[3]) > 0.99:
        return "D", 3, f"it ends at the edge of its range; {_CAPTURE[3]}"
    # D lies in [-1, 1]: a 95 % interval of that width has no information
    for name, index, largest in (("D", 3, 0.5), ("C", 2, values[2]), ("A", 0, values[0]), ("B", 1, values[1])):
        if free[index] and not error[index] < largest:
            return name, index, f"{span}; {_CAPTURE[index]}"
    return None


def _without(eta: NDArray, index: int) -> NDArray[np.float64]:
    """The parameters with one of them set to the value that removes it: A, C or D to 0."""
    changed = eta.copy()
    if index == 3:
        changed[2] += changed[3] ** 2
    changed[index] = 0.0
    return changed


def _better_without(
    one: int, other: int, cells: Cells, eta: NDArray, theta_v: float, law: Law, free: list[bool]
) -> bool:
    """Whether leaving out `one` parameter fits better than leaving out the `other`."""
    values = []
    for index in (one, other):
        kept = [ok and k != index for k, ok in enumerate(free)]
        fitted, _, variance = _fit(cells, _without(eta, index), theta_v, law, kept)
        values.append(_log_likelihood(cells, fitted, theta_v, law, variance))
    return values[0] > values[1]


def _covariance(information: NDArray) -> tuple[NDArray[np.float64], list[int]]:
    """Inverse of the information, and the parameters (of A, B, C, D) that are determined only in combination."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-250))
    value, vector = np.linalg.eigh(information / np.outer(scale, scale))
    # combinations of parameters on which the counts do not depend
    lost = value < _SINGULAR
    mixed = [k for k in range(4) if np.any(np.abs(vector[k, lost]) > 0.05)]
    inverse = (vector / np.maximum(value, _SINGULAR**2)) @ vector.T
    return inverse / np.outer(scale, scale), mixed


def cell_variance(cells: Cells, eta: NDArray, theta_v: float, law: Law) -> NDArray[np.float64]:
    """Variance of each cell's events: binomial in time, thresholds over pixels. Above 0 whatever `eta` is."""
    log_p, _ = log_probability(eta, cells, theta_v, law)
    # never below a thousandth of an event in a cell: a trial fit may make P vanish
    p = np.maximum(np.exp(log_p), 1e-3 / np.maximum(cells.total, 1))
    u, _ = threshold_over_noise(eta, cells.signal_dn, theta_v, law)
    u = u * (1 - cells.polarity * eta[4])
    between = probability_variance(u, cells.spread, cells.relative)
    return np.maximum(cells.pixels, 1e-30) * cells.trials * (p * (1 - p) + cells.trials * between)


def with_mismatch_error(fit: EventFit, pixels: PixelCounts, theta_v: float, relative_error: float) -> EventFit:
    """Add the effect of the mismatch's error on A … D, by a finite difference.

    Parameters
    ----------
    fit : the fit.
    pixels : counts.
    theta_v : Θ, threshold in V.
    relative_error : relative error of the spread of thresholds in the cells.
    """
    if not relative_error > 0:
        return fit
    # the whole fit again with a spread larger by its error
    wider = replace(pixels, cells=pixels.cells.with_spread(1 + relative_error))
    moved = fit_events(wider, theta_v, fit.law, fit.parameters, fit.free)
    change = np.where(fit.free, moved.values - fit.values, 0.0)
    return replace(fit, covariance=fit.covariance + np.outer(change, change))


@dataclass(frozen=True)
class Ends:
    """Where the searches of the multi-start study ended.

    Parameters
    ----------
    values : (A, B, C, D) [start, 4].
    standard_error : [4], from the Fisher information; NaN for what is not free.
    log_likelihood_below : [start], ln L of the best end minus that of this one.
    """

    values: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    log_likelihood_below: NDArray[np.float64]

    def describe_counts(self, chi2_per_dof: float) -> NDArray[np.bool_]:
        """Whether each end is about as likely as the best, [start]. The others only say that a search was lost.

        Parameters
        ----------
        chi2_per_dof : of the fit. Counts that scatter more than the binomial law has it make ln L differ by more.
        """
        return self.log_likelihood_below < _TOO_UNLIKELY * max(1.0, chi2_per_dof)


def multi_start(pixels: PixelCounts, fit: EventFit, theta_v: float, seed: int) -> Ends:
    """Maximum likelihood from many starts: A, B, C vary by e² in either direction, D over (−0.9, 0.9).

    Parameters
    ----------
    pixels : counts. Of pixels with known thresholds those near the mean are used.
    fit : the fit whose parameters the starts surround.
    theta_v : Θ, threshold in V.
    seed : seed of the starts.
    """
    rng = np.random.default_rng(seed)
    begin = np.tile(fit.values, (_STARTS, 1))
    free = np.array(fit.free)
    spread = np.where(free[:3], rng.uniform(-2, 2, (_STARTS, 3)), 0)
    begin[:, :3] *= np.exp(spread)
    if free[3]:
        begin[:, 3] = rng.uniform(-0.9, 0.9, _STARTS)
    begin[:, 4:] = np.where(free[4:], 0.0, begin[:, 4:])
    cells = pixels.cells.typical().coarser()
    eta, fisher, _ = search(cells, from_natural(begin), theta_v, fit.law, fit.free)
    values, covariance = natural(eta, np.linalg.pinv(fisher))
    errors = np.sqrt(np.maximum(np.einsum("fii->fi", covariance)[:, :4], 0))
    level = log_likelihood(cells, log_probability(eta, cells, theta_v, fit.law)[0])
    return Ends(values[:, :4], np.where(free[:4], np.median(errors, axis=0), np.nan), level.max() - level)

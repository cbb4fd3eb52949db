"""S-curves: shares of jumps that pixels answer against their size, and the thresholds that they tell.

A pixel i answers a jump of s (ln units) with the chance q + (1 − q)·Φ((s − θᵢ)/σ): θᵢ is the size that it answers in
half of the cases, σ its own noise, q the share that chance answers. θᵢ scatters over pixels by a normal law about θ
with standard deviation τ. θ, σ, τ, q are those of the largest likelihood of the counts of each pixel; their errors
follow from the scatter of the pixels' scores, so that they hold where the law of the thresholds is another one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.report.bench import Responses
from hesim_render.report.estimates import log_estimated

#: Pixels that are fitted at most; of more, evenly chosen ones.
_MOST_PIXELS = 5_000
#: Grid of thresholds: in standard deviations over pixels about their mean, and in those of noise about each step.
_GRID, _SLOPE_GRID = np.linspace(-5.0, 5.0, 81), np.linspace(-3.6, 3.6, 13)
#: Shares between which a point lies on the slope of the curve.
_SLOPE = (0.03, 0.97)
_FEWEST_PIXELS = 20
#: A spread whose logarithm is less certain than this is not distinguished from none.
_UNSURE = 0.5
#: Range of ln σ/τ, starts of the fit, bound of the search for a limit.
_RATIO, _STARTS, _RATIO_MOST = (-6.0, 4.0), (-3.0, 0.0), 8.0
#: Fall of ln likelihood that chance exceeds in one of 20 cases, one-sided.
_LIKELY = 1.353
#: Logit of a share of chance that counts as none.
_NO_CHANCE = -9.0


@dataclass(frozen=True, eq=False)
class SCurve:
    """An S-curve.

    Parameters
    ----------
    lux : light before the steps, lx.
    size : [k], ln units.
    share, error : [k], answered jumps, mean over pixels, and its standard error.
    chance : share that chance answers, by the fit.
    entries : ``threshold``, ``threshold_spread_percent``, ``pixel_noise``, ``contrast_sensitivity`` as entries of the
        report.
    theta : θ, ln units, or NaN.
    width : standard deviation of the curve, ln units: noise and spread together.
    pixels : number of pixels.
    """

    lux: float
    size: NDArray[np.float64]
    share: NDArray[np.float64]
    error: NDArray[np.float64]
    chance: float
    entries: dict[str, dict[str, Any]]
    theta: float
    width: float
    pixels: int

    def at(self, size: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares by the fit."""
        return np.asarray(self.chance + (1 - self.chance) * special.ndtr((size - self.theta) / self.width))


def s_curve(responses: list[Responses], polarity: int, good: NDArray[np.bool_]) -> SCurve:
    """The S-curve of jumps at one light.

    Parameters
    ----------
    responses : recordings of steps from one light.
    polarity : 0 for rises and ON events, 1 for falls and OFF events.
    good : [pixel], pixels to be used.
    """
    chosen = np.flatnonzero(good)
    chosen = chosen[:: -(-chosen.size // _MOST_PIXELS)] if chosen.size else chosen
    sizes = np.array(sorted({one.size for one in responses}))
    hits, trials = np.zeros((sizes.size, chosen.size)), np.zeros(sizes.size)
    for one in responses:
        answers = one.of(polarity)[:, chosen] > 0
        k = int(np.searchsorted(sizes, one.size))
        hits[k] += answers.sum(axis=0)
        trials[k] += len(answers)
    share = hits.mean(axis=1) / trials if chosen.size else np.zeros(sizes.size)
    error_of_share = (
        hits.std(axis=1) / trials / np.sqrt(max(chosen.size - 1, 1)) if chosen.size else np.zeros(sizes.size)
    )
    lux = responses[0].steps.lux
    reason = _problem(sizes, share, chosen.size)
    if reason:
        names = ("threshold", "threshold_spread_percent", "pixel_noise", "contrast_sensitivity")
        entries = dict.fromkeys(names, not_identifiable(reason))
        return SCurve(lux, sizes, share, error_of_share, np.nan, entries, np.nan, np.nan, chosen.size)
    fit = _Fit(sizes, hits.T, trials)
    values, covariance = fit.values()
    theta, sigma, tau, chance = _natural(values)
    error = float(np.sqrt(covariance[0, 0]))
    sign = 1 if polarity == 0 else -1
    percent = 100 * sign * np.expm1(sign * theta)
    slope = 100 * np.exp(sign * theta)
    ratio = np.exp(2 * values[2])
    spread = np.array([0.0, 1.0, -ratio / (1 + ratio), 0.0])  # of ln τ over the values
    noise = spread + np.array([0.0, 0.0, 1.0, 0.0])
    entries = {
        "threshold": estimated(theta, error, "ln"),
        "threshold_spread_percent": _part(fit, values, covariance, spread, 100 * tau / theta, "%"),
        "pixel_noise": _part(fit, values, covariance, noise, sigma, "ln"),
        "contrast_sensitivity": estimated(float(percent), float(slope * error), "%"),
    }
    width = float(np.hypot(sigma, tau))
    return SCurve(lux, sizes, share, error_of_share, chance, entries, theta, width, chosen.size)


def _problem(sizes: NDArray[np.float64], share: NDArray[np.float64], pixels: int) -> str:
    """Why there is no threshold; empty if there is one."""
    if pixels < _FEWEST_PIXELS:
        return f"{pixels} pixels answer; {_FEWEST_PIXELS} are needed"
    if sizes.size < 4:
        return f"steps of {sizes.size} contrasts at this light; 4 are needed"
    if share.max() < 0.75:
        return f"the largest step is answered in {share.max():.2g} of the cases; take larger ones"
    if share.min() > 0.25:
        return f"the smallest step is answered in {share.min():.2g} of the cases; take smaller ones, or more light"
    inside = np.count_nonzero((share > _SLOPE[0]) & (share < _SLOPE[1]))
    if inside < 2:
        low, high = sizes[share < 0.5].max(), sizes[share >= 0.5].min()
        return (
            f"the contrasts are too coarse: between {low:.4g} and {high:.4g} (ln units) the share goes from "
            f"{share[sizes == low][0]:.2g} to {share[sizes == high][0]:.2g}; take some in between"
        )
    return ""


def _natural(values: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """θ, σ, τ and q of the values of a fit: θ, ln of the width √(σ² + τ²), ln σ/τ, logit q."""
    ratio = float(np.exp(values[2]))
    tau = float(np.exp(values[1])) / float(np.hypot(1.0, ratio))
    return float(values[0]), ratio * tau, tau, float(special.expit(values[3]))


def _part(
    fit: "_Fit",
    values: NDArray[np.float64],
    covariance: NDArray[np.float64],
    slope: NDArray[np.float64],
    value: float,
    unit: str,
) -> dict[str, Any]:
    """Spread or noise, or its limit where it does not show beside the other.

    Parameters
    ----------
    slope : of its logarithm over the values of the fit.
    value : in `unit`.
    """
    error = float(np.sqrt(slope @ covariance @ slope))
    at_end = (values[2] - _RATIO[0] < 0.01 and slope[2] > 0) or (_RATIO[1] - values[2] < 0.01 and slope[2] < 0)
    if not at_end and error < _UNSURE:
        return log_estimated(np.log(value), error, unit)
    away = values.copy()
    while -_RATIO_MOST < away[2] < _RATIO_MOST and fit.total(values) - fit.total(away) < _LIKELY:
        away[2] += 0.1 if slope[2] > 0 else -0.1
    most = value * float(np.exp(_log_part(away, slope[2]) - _log_part(values, slope[2])))
    return {"value": 0.0, "upper_limit": most, "unit": unit, "note": "too small to show beside the rest of the width"}


def _log_part(values: NDArray[np.float64], slope: float) -> float:
    """ln of σ where `slope` is above 0, else of τ."""
    _, sigma, tau, _ = _natural(values)
    return float(np.log(sigma if slope > 0 else tau))


class _Fit:
    """The likelihood of counts [pixel, size]; pixels with equal counts are taken together."""

    def __init__(self, sizes: NDArray[np.float64], hits: NDArray[np.float64], trials: NDArray[np.float64]) -> None:
        self._share = hits.mean(axis=0) / trials
        self._sizes = sizes
        self._hits, self._count = np.unique(hits, axis=0, return_counts=True)
        self._misses = trials - self._hits

    def _log(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """ln likelihood of each kind of counts, but for a constant."""
        theta, sigma, tau, chance = _natural(values)
        node = np.sort(np.concatenate([theta + tau * _GRID, (self._sizes[:, None] - sigma * _SLOPE_GRID).ravel()]))
        edge = np.concatenate([[-np.inf], (node[1:] + node[:-1]) / 2, [np.inf]])
        weight = np.diff(special.ndtr((edge - theta) / tau))
        kept = weight > 0
        answer = chance + (1 - chance) * special.ndtr((self._sizes[:, None] - node[kept]) / sigma)
        answer = np.clip(answer, 1e-12, 1 - 1e-12)
        # not a product of matrices: where other programs run, threads of a small one wait for each other
        log = np.einsum("ks,sn->kn", self._hits, np.log(answer)) + np.log(weight[kept])
        log += np.einsum("ks,sn->kn", self._misses, np.log1p(-answer))
        most = log.max(axis=1)
        return np.asarray(most + np.log(np.exp(log - most[:, None]).sum(axis=1)))

    def total(self, values: NDArray[np.float64]) -> float:
        """ln likelihood of all pixels."""
        return float(self._count @ self._log(values))

    def values(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values of the largest likelihood, and their covariance."""
        order = np.maximum.accumulate(self._share)
        theta, low, high = (float(np.interp(part, order, self._sizes)) for part in (0.5, 0.2, 0.8))
        width = max((high - low) / 1.7, 1e-3 * theta)
        chance = float(np.clip(self._share.min(), 1e-4, 0.2))
        scale = np.array([width, 0.3, 0.5, 0.5])
        pixels = self._count.sum()
        best, least = np.zeros(4), np.inf
        for ratio in _STARTS:
            start = np.array([theta, np.log(width), ratio, special.logit(chance)])
            bounds = [(0.2 * theta, 3 * theta), tuple(start[1] + np.array([-3.0, 2.0])), _RATIO, (-14.0, 0.0)]
            limits = [((a - s) / c, (b - s) / c) for (a, b), s, c in zip(bounds, start, scale, strict=True)]

            def cost(moved: NDArray[np.float64], start: NDArray[np.float64] = start) -> float:
                return -self.total(start + scale * moved) / float(pixels)

            outcome = optimize.minimize(cost, np.zeros(4), method="L-BFGS-B", bounds=limits, options={"ftol": 1e-11})
            if outcome.fun < least:
                best, least = start + scale * outcome.x, outcome.fun
        return best, self._covariance(best, np.array([0.05 * width, 0.05, 0.1, 0.1]))

    def _covariance(self, values: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """H⁻¹ S H⁻¹: H is the curvature, S the scatter of the pixels' scores. Values at an end count as known."""
        inside = _RATIO[0] + 0.06 < values[2] < _RATIO[1] - 0.06
        free = np.flatnonzero([True, True, inside, values[3] > _NO_CHANCE])
        away = np.diag(steps)
        score = np.stack(
            [(self._log(values + away[k]) - self._log(values - away[k])) / (2 * steps[k]) for k in free], axis=1
        )
        curve = np.empty((free.size, free.size))
        for a, i in enumerate(free):
            for b, j in enumerate(free):
                parts = [u * v * self.total(values + u * away[i] + v * away[j]) for u in (1, -1) for v in (1, -1)]
                curve[a, b] = sum(parts) / (4 * steps[i] * steps[j])
        mean = self._count @ score / self._count.sum()
        scatter = (self._count[:, None] * (score - mean)).T @ (score - mean)
        inverse = np.linalg.pinv(-curve, hermitian=True)
        whole = np.zeros((4, 4))
        whole[np.ix_(free, free)] = inverse @ scatter @ inverse
        return whole

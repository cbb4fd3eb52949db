"""Thresholds from the S-curve: event probability against contrast steps.

    P₊(S) = Q((θ₊ − S)/s),   P₋(S) = Q((θ₋ + S)/s),   s² = σ_n² + m² θ²

The curve is pooled over pixels whose thresholds spread by m θ. s may change linearly with S, as σ_n does through x₁.
The mismatch is the scatter of the pixels' summed counts over the steps beyond counting. The errors are from
a jackknife over groups of pixels: the counts of a pixel share its threshold, at all steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from hesim_render.calibrate.estimate import Spread
from hesim_render.calibrate.evs.cells import PixelThresholds
from hesim_render.calibrate.evs.steps import GROUPS, Steps
from hesim_render.pixels.evs.formulas import exceedance

_ROUNDS = 100
#: Thresholds of pixels for means over them, in standard deviations, and their weights.
_NODES = np.linspace(-5.0, 5.0, 101)
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()
#: Thresholds relative to the mean, for the look-up of a pixel's threshold from its counts.
_GRID = np.linspace(0.02, 3.0, 1491)
#: Number of standard errors above which a mismatch is significant.
_SIGMAS = 4.0


@dataclass(frozen=True)
class Thresholds:
    """θ in ln units.

    Attributes
    ----------
    theta_on, theta_off : mean thresholds. width : s at S = 0. slope : κ, relative change of s per θ of contrast.
    covariance : [4, 4] of (θ₊, θ₋, s, κ).
    spread : relative std over pixels of the threshold of one polarity.
    mismatch_on, mismatch_off : of either polarity.
    noise : σ_n at S = θ₊ and S = −θ₋, and its standard error.
    pixel_on, pixel_off : [row, col], threshold of each pixel relative to the mean (with its own noise).
    noise_on, noise_off : [row, col], standard error of these.
    step : [step], S of each step.
    """

    theta_on: float
    theta_off: float
    width: float
    slope: float
    covariance: NDArray[np.float64]
    spread: Spread
    mismatch_on: float
    mismatch_off: float
    noise: tuple[float, float]
    pixel_on: NDArray[np.float32]
    pixel_off: NDArray[np.float32]
    noise_on: NDArray[np.float32]
    noise_off: NDArray[np.float32]
    step: NDArray[np.float64]

    @property
    def theta(self) -> float:
        return (self.theta_on + self.theta_off) / 2

    @property
    def theta_error(self) -> float:
        return float(np.sqrt(self.covariance[:2, :2].sum())) / 2

    @property
    def values(self) -> NDArray[np.float64]:
        """(θ₊, θ₋, s, κ)."""
        return np.array([self.theta_on, self.theta_off, self.width, self.slope])

    def of_pixels(self) -> PixelThresholds:
        """Known thresholds of each pixel: its estimate, shrunk towards the mean by the noise of the estimate."""
        result = []
        for estimate, noise, mismatch in (
            (self.pixel_on, self.noise_on, self.mismatch_on), (self.pixel_off, self.noise_off, self.mismatch_off),
        ):  # fmt: skip
            variance, own = mismatch**2, noise.astype(np.float64) ** 2
            # the mean of the normal law of a threshold whose estimate has noise
            trust = variance / np.maximum(variance + own, 1e-30)
            result.append((1 + trust * (estimate.astype(np.float64) - 1), np.sqrt(trust * own)))
        (on, on_spread), (off, off_spread) = result
        return PixelThresholds(on, off, on_spread, off_spread)


def why_not(steps: Steps) -> str | None:
    """The reason why the steps cannot determine the thresholds, or None where they can."""
    n = steps.trials_of_all
    for name, events in (("ON", steps.on), ("OFF", steps.off)):
        rate = events.sum(axis=1) / n
        if rate.max() < 0.6 or rate.min() > 0.4:
            return (
                f"the {name} rate goes from {rate.min():.3g} to {rate.max():.3g} and does not pass ½; capture "
                "contrasts from −2 θ to 2 θ"
            )
    return None


def fit_thresholds(steps: Steps, step: NDArray[np.float64], good: NDArray[np.bool_]) -> Thresholds:
    """Binomial maximum likelihood of the pooled curves, then the mismatch from the pixels' totals.

    Parameters
    ----------
    step : [step], S = ln x₁/x₀ of each contrast.
    """
    sums = _Sums.of(steps, good)
    result = sums.fit(step, steps.trials)
    values, squares = result[:4], result[4:6]
    # jackknife: the fit without each group of pixels, [group, 7]
    left_out = np.array([sums.without(k).fit(step, steps.trials, values) for k in range(GROUPS) if sums.pixels[k]])
    covariance = (len(left_out) - 1) * np.cov(left_out.T, bias=True)
    error = np.sqrt(np.diag(covariance))
    # ON and OFF together decide whether there is a mismatch, then each for itself
    both, both_error = squares.mean(), float(np.sqrt(covariance[4:6, 4:6].sum())) / 2
    mismatch = float(np.sqrt(both)) if both > _SIGMAS * both_error else 0.0
    each = [
        float(np.sqrt(v)) if mismatch and v > _SIGMAS * e else 0.0 for v, e in zip(squares, error[4:6], strict=True)
    ]
    noise = result[6]
    pixel = [
        _of_pixel(values, sign, sign * step, total, steps.trials, m)
        for sign, total, m in ((1.0, steps.on_total, each[0]), (-1.0, steps.off_total, each[1]))
    ]
    return Thresholds(
        theta_on=float(values[0]),
        theta_off=float(values[1]),
        width=float(values[2]),
        slope=float(values[3]),
        covariance=covariance[:4, :4],
        spread=Spread(
            mismatch,
            both_error / (2 * mismatch) if mismatch else float("nan"),
            float(np.sqrt(max(both, 0.0) + 2 * both_error)),
            GROUPS,
        ),
        mismatch_on=each[0],
        mismatch_off=each[1],
        noise=(float(noise), float(error[6])),
        pixel_on=pixel[0][0],
        pixel_off=pixel[1][0],
        noise_on=pixel[0][1],
        noise_off=pixel[1][1],
        step=step,
    )


@dataclass(frozen=True)
class _Sums:
    """Sums of the counts for the fit, separate for each group of pixels: arrays [..., group]."""

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    pixels: NDArray[np.float64]
    totals: NDArray[np.float64]  # [polarity, group], Σ of a pixel's events over all steps
    squares: NDArray[np.float64]  # the same of their squares

    @classmethod
    def of(cls, steps: Steps, good: NDArray[np.bool_]) -> "_Sums":
        group = steps.group[good]
        totals = [total[good].astype(np.float64) for total in (steps.on_total, steps.off_total)]
        return cls(
            steps.on, steps.off, steps.pixels,
            np.array([np.bincount(group, t, GROUPS) for t in totals]),
            np.array([np.bincount(group, t * t, GROUPS) for t in totals]),
        )  # fmt: skip

    def without(self, k: int) -> "_Sums":
        keep = np.arange(self.pixels.size) != k
        return _Sums(*(values[..., keep] for values in vars(self).values()))

    def fit(self, step: NDArray, trials: int, start: NDArray | None = None) -> NDArray[np.float64]:
        """(θ₊, θ₋, s, κ, m₊², m₋², σ_n at the thresholds)."""
        pixels = float(self.pixels.sum())
        rates = [counts.sum(axis=1) / (pixels * trials) for counts in (self.on, self.off)]
        values = _fit_curves(rates, step, pixels * trials, start)
        squares = []
        for k, sign in enumerate((1.0, -1.0)):
            mean = self.totals[k].sum() / pixels
            # variance over pixels of the sum of a pixel's events over all steps
            variance = (self.squares[k].sum() / pixels - mean**2) * pixels / max(pixels - 1, 1)
            squares.append(_mismatch_square(values[k], values[2], values[3] * sign, sign * step, variance, trials))
        # what the width of the curve at either threshold has beyond the spread of thresholds is noise
        left = [
            (values[2] * max(1 + values[3], 0.2)) ** 2 - squares[0] * values[0] ** 2,
            (values[2] * max(1 - values[3], 0.2)) ** 2 - squares[1] * values[1] ** 2,
        ]
        return np.array([*values, *squares, np.sqrt(max(float(np.mean(left)), 0.0))])


def _fit_curves(rates: list[NDArray], step: NDArray, n: float, start: NDArray | None) -> NDArray[np.float64]:
    """(θ₊, θ₋, s, κ) of the pooled curves."""
    if start is None:
        # thresholds where the pooled rates pass ½
        half = [float(np.interp(0.5, *_increasing(r, s))) for r, s in zip(rates, (step, -step), strict=True)]
        half = [max(h, 1e-3 * float(np.abs(step).max())) for h in half]
        start = np.array([half[0], half[1], 0.4 * np.mean(half), 0.0])
    values = start.copy()
    for _ in range(_ROUNDS):
        score, fisher = _score(values, rates, step, n)
        change = np.linalg.lstsq(fisher, score, rcond=None)[0]
        # steps of 30 % at most, as the score is far from linear beyond
        limit = np.array([0.3, 0.3, 0.3, 0.3]) * np.abs([values[0], values[1], values[2], 1.0])
        change = np.clip(change, -limit, limit)
        values = values + change
        values[:3] = np.maximum(values[:3], 1e-9)
        values[3] = np.clip(values[3], -0.4, 0.4)
        if np.all(np.abs(change) < 1e-6 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))):
            break
    return values


def curve(values: NDArray, polarity: float, step: NDArray) -> NDArray[np.float64]:
    """P [step] of the pooled curve of one polarity (+1 ON, −1 OFF); `values` are (θ₊, θ₋, s, κ)."""
    theta = values[0] if polarity > 0 else values[1]
    return exceedance(theta - polarity * step, _widths(values, step))


def _widths(values: NDArray, step: NDArray) -> NDArray[np.float64]:
    return values[2] * np.maximum(1 + values[3] * step / ((values[0] + values[1]) / 2), 0.2)


def curve_slopes(values: NDArray, polarity: float, step: NDArray) -> NDArray[np.float64]:
    """Derivatives [step, 4] of `curve`."""
    k, s = (0 if polarity > 0 else 1), _widths(values, step)
    # P = Q(v): its slopes are minus the normal density times those of v
    v = (values[k] - polarity * step) / s
    density = np.exp(-0.5 * v * v) / np.sqrt(2 * np.pi)
    slopes = np.zeros((step.size, 4))
    slopes[:, k] = -density / s
    slopes[:, 2] = density * v / values[2]
    slopes[:, 3] = density * v * values[2] / s * step / ((values[0] + values[1]) / 2)
    return slopes


def _increasing(rate: NDArray, step: NDArray) -> tuple[NDArray, NDArray]:
    order = np.argsort(step)
    return np.maximum.accumulate(rate[order]) + 1e-12 * np.arange(step.size), step[order]


def _score(values: NDArray, rates: list[NDArray], step: NDArray, n: float) -> tuple[NDArray, NDArray]:
    """Gradient and Fisher information for (θ₊, θ₋, s, κ)."""
    score, fisher = np.zeros(4), np.zeros((4, 4))
    for rate, polarity in zip(rates, (1.0, -1.0), strict=True):
        p = np.clip(curve(values, polarity, step), 1e-12, 1 - 1e-12)
        jacobian = curve_slopes(values, polarity, step)
        weight = n / (p * (1 - p))
        score += (weight * (rate - p)) @ jacobian
        fisher += (jacobian * weight[:, None]).T @ jacobian
    return score, fisher


def _totals(
    thresholds: NDArray, theta: float, width: float, slope: float, signed: NDArray, trials: int, m2: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance in time of a pixel's events over all steps, for each of `thresholds`."""
    # the width of one pixel: that of the pooled curve without the spread of thresholds
    noise = np.sqrt(max(width**2 - max(m2, 0.0) * theta**2, 1e-4 * width**2))
    p = exceedance(thresholds[:, None] - signed, noise * np.maximum(1 + slope * signed / theta, 0.2))
    return trials * p.sum(axis=1), trials * (p * (1 - p)).sum(axis=1)


def totals_of(result: Thresholds, polarity: float, relative: NDArray, trials: int) -> NDArray[np.float64]:
    """Mean events over all steps of pixels whose threshold of one polarity is `relative` to the mean."""
    theta, m = (result.theta_on, result.mismatch_on) if polarity > 0 else (result.theta_off, result.mismatch_off)
    signed = polarity * result.step
    return _totals(theta * relative, theta, result.width, result.slope * polarity, signed, trials, m * m)[0]


def _mismatch_square(theta: float, width: float, slope: float, signed: NDArray, variance: float, trials: int) -> float:
    """m² that explains the scatter of the pixels' totals. It may be negative, so that its noise about 0 is even."""

    def expected(m2: float) -> float:
        mean, within = _totals(theta * (1 + np.sqrt(m2) * _NODES), theta, width, slope, signed, trials, m2)
        return float(_WEIGHTS @ within + _WEIGHTS @ mean**2 - (_WEIGHTS @ mean) ** 2)

    h = 1e-3
    # slope of the totals by ln θ, for the sign of an m² below 0
    ends, _ = _totals(theta * np.array([1 - h, 1 + h]), theta, width, slope, signed, trials, 0.0)
    slope_squared = max(float(((ends[1] - ends[0]) / (2 * h)) ** 2), 1e-300)
    low = (variance - expected(0.0)) / slope_squared
    if low <= 0:
        return low
    widest = min(0.999 * width / theta, 0.8) ** 2
    # the spread cannot be wider than the whole curve
    if expected(widest) < variance:
        return widest
    return float(brentq(lambda m2: expected(m2) - variance, 0.0, widest, xtol=1e-10))


def _of_pixel(
    values: NDArray, sign: float, signed: NDArray, total: NDArray, trials: int, mismatch: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Threshold of each pixel relative to the mean, and its standard error, from its total of events."""
    theta = values[0] if sign > 0 else values[1]
    mean, variance = _totals(theta * _GRID, theta, values[2], values[3] * sign, signed, trials, mismatch**2)
    # where no step separates thresholds the slope vanishes: the threshold is then known to within the mismatch only
    slope = np.maximum(-np.gradient(mean, _GRID), 1e-3 * trials)
    error = np.sqrt(variance + 0.25) / slope
    # totals fall with the threshold; made strictly monotonic for the look-up
    falling = -np.minimum.accumulate(mean) + 1e-9 * np.arange(_GRID.size)
    pixel = np.interp(-total, falling, _GRID)
    return pixel.astype(np.float32), np.interp(pixel, _GRID, error).astype(np.float32)

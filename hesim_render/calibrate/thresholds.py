"""Thresholds from the S-curve: event probability against contrast steps.

    P₊(S) = Q((θ₊ − S)/s),   P₋(S) = Q((θ₋ + S)/s),   s² = σ_n² + m² θ²

pooled over pixels whose thresholds spread by m θ. s may change linearly with S (σ_n does, as x₁ does).
The mismatch itself is what the sum of a pixel's counts over the steps scatters beyond counting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr

from hesim_render.calibrate.captures import CaptureSet, count_maps
from hesim_render.errors import SpecError

_ROUNDS = 100


@dataclass(frozen=True)
class Steps:
    """``evs_steps.npz`` summed up.

    Attributes
    ----------
    contrast : [step], as in the file. signal_dn : of I₀, one number.
    on, off : [step], events of all good pixels. pixels : how many they are. trials : of one pixel and step.
    on_total, off_total : [row, col], events of a pixel over all steps.
    """

    contrast: NDArray[np.float64]
    signal_dn: float
    on: NDArray[np.float64]
    off: NDArray[np.float64]
    pixels: int
    trials: int
    on_total: NDArray[np.int64]
    off_total: NDArray[np.int64]


@dataclass(frozen=True)
class Thresholds:
    """θ in ln units.

    Attributes
    ----------
    theta_on, theta_off : mean thresholds. covariance : [4, 4] of (θ₊, θ₋, s, κ).
    width : s at S = 0. slope : κ, relative change of s per θ of contrast.
    mismatch_on, mismatch_off : relative std over pixels, 0 where not significant; mismatch_error of either.
    pixel_on, pixel_off : [row, col], threshold of each pixel relative to the mean (with its own noise).
    step : [step], S of each step. chi2_per_dof : of the pooled curves.
    """

    theta_on: float
    theta_off: float
    covariance: NDArray[np.float64]
    width: float
    slope: float
    mismatch_on: float
    mismatch_off: float
    mismatch_error: float
    pixel_on: NDArray[np.float32]
    pixel_off: NDArray[np.float32]
    step: NDArray[np.float64]
    chi2_per_dof: float

    @property
    def theta(self) -> float:
        return (self.theta_on + self.theta_off) / 2

    @property
    def theta_error(self) -> float:
        return float(np.sqrt(self.covariance[:2, :2].sum())) / 2

    @property
    def mismatch(self) -> float:
        """Relative standard deviation over pixels of the threshold of one polarity."""
        return float(np.sqrt((self.mismatch_on**2 + self.mismatch_off**2) / 2))


def read_steps(captures: CaptureSet, good: NDArray[np.bool_]) -> Steps:
    """Read ``evs_steps.npz`` one step at a time.

    Raises
    ------
    SpecError
        If arrays are missing or do not fit each other or the static capture.
    """
    file = captures.folder / "evs_steps.npz"
    small = {}
    try:
        with np.load(file, allow_pickle=False) as data:
            missing = [n for n in ("contrast", "signal_dn", "n_on", "n_off", "n_trials") if n not in data.files]
            if not missing:
                small = {name: data[name] for name in ("contrast", "signal_dn", "n_trials")}
    except (OSError, ValueError, EOFError) as error:
        raise SpecError(f"cannot be read as an .npz file of plain arrays ({error})", file=file) from None
    if missing:
        raise SpecError(f"holds no array {missing[0]!r}", file=file)
    contrast = np.asarray(small["contrast"], np.float64)
    if contrast.ndim != 1 or contrast.size < 3:
        raise SpecError("contrast holds fewer than 3 steps; capture 10 or more, from −2 θ to 2 θ", file=file)
    signal = np.asarray(small["signal_dn"], np.float64)
    if signal.size > 1:
        signal = signal[good]
        if np.ptp(np.quantile(signal, [0.01, 0.99])) > 0.1 * np.median(signal):
            raise SpecError(
                "signal_dn of the steps varies by more than 10 %; capture them on a uniform light", file=file
            )
    trials = int(np.asarray(small["n_trials"]).item())
    sums, totals = {}, {}
    for name in ("n_on", "n_off"):
        rates = []
        total = np.zeros(good.shape, np.int64)
        for counts in count_maps(captures, "evs_steps", name):
            if counts.shape != good.shape or counts.dtype.kind not in "ui":
                raise SpecError(
                    f"{name} must be whole numbers [contrast, row, col] of the static capture's size", file=file
                )
            if counts.max() > trials:
                raise SpecError(f"{name} holds counts above n_trials = {trials}", file=file)
            rates.append(float(counts[good].sum(dtype=np.int64)))
            total += counts
        if len(rates) != contrast.size:
            raise SpecError(f"{name} holds {len(rates)} steps, contrast {contrast.size}", file=file)
        sums[name], totals[name] = np.array(rates), total
    return Steps(
        contrast=contrast,
        signal_dn=float(np.median(signal)),
        on=sums["n_on"],
        off=sums["n_off"],
        pixels=int(good.sum()),
        trials=trials,
        on_total=totals["n_on"],
        off_total=totals["n_off"],
    )


def why_not(steps: Steps) -> str | None:
    """Why the steps cannot tell the thresholds, or None where they can."""
    n = steps.pixels * steps.trials
    for name, events in (("ON", steps.on), ("OFF", steps.off)):
        rate = events / n
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
    n = float(steps.pixels * steps.trials)
    half = [float(np.interp(0.5, *_increasing(r / n, s))) for r, s in ((steps.on, step), (steps.off, -step))]
    values = np.array([half[0], half[1], 0.4 * np.mean(half), 0.0])
    for _ in range(_ROUNDS):
        score, fisher, _ = _score(values, steps, step, n)
        change = np.linalg.solve(fisher, score)
        limit = np.array([0.3, 0.3, 0.3, np.inf]) * np.abs([values[0], values[1], values[2], 1.0])
        change = np.clip(change, -limit, limit)
        values = values + change
        values[2], values[3] = max(values[2], 1e-9), np.clip(values[3], -0.4, 0.4)
        if np.all(np.abs(change) < 1e-6 / np.sqrt(np.diag(fisher))):
            break
    _, fisher, chi2 = _score(values, steps, step, n)
    covariance = np.linalg.inv(fisher) * max(1.0, chi2 / (2 * step.size - 4))
    theta_on, theta_off, width, slope = values
    results = []
    for theta, sign, total in ((theta_on, 1.0, steps.on_total), (theta_off, -1.0, steps.off_total)):
        results.append(_mismatch(theta, width, slope * sign, sign * step, total, steps.trials, good))
    for k, theta in enumerate((theta_on, theta_off)):
        covariance[k, k] += results[k][0] * theta**2 / steps.pixels
    (on2, on_error, pixel_on), (off2, off_error, pixel_off) = results
    error2 = max(on_error, off_error)
    on, off = (np.sqrt(v) if v > 4 * e else 0.0 for v, e in ((on2, on_error), (off2, off_error)))
    error = error2 / (2 * max(on, off)) if max(on, off) > 0 else np.sqrt(error2)
    # A pixel's two thresholds may shift together; the noise of their two estimates is independent.
    widest = np.sqrt(max(on2, 0) * max(off2, 0)) if on and off else 0.0
    shared = float(np.clip(np.cov(pixel_on[good], pixel_off[good])[0, 1], -widest, widest))
    covariance[0, 1] += shared * theta_on * theta_off / steps.pixels
    covariance[1, 0] = covariance[0, 1]
    return Thresholds(
        theta_on=float(theta_on),
        theta_off=float(theta_off),
        covariance=covariance,
        width=float(width),
        slope=float(slope),
        mismatch_on=float(on),
        mismatch_off=float(off),
        mismatch_error=float(error),
        pixel_on=pixel_on,
        pixel_off=pixel_off,
        step=step,
        chi2_per_dof=chi2 / (2 * step.size - 4),
    )


def groups_of_like_threshold(
    thresholds: Thresholds, good: NDArray[np.bool_], groups: int = 12
) -> tuple[NDArray[np.intp], NDArray[np.float64], float]:
    """Pixels sorted by their measured threshold, so that the static counts need not take it for noise.

    Returns
    -------
    group [row, col], the expected relative threshold of each group (shrunk towards 1 by the measurement's own
    noise), and the relative standard deviation that is left within the groups.
    """
    on, off = thresholds.pixel_on[good].astype(np.float64), thresholds.pixel_off[good].astype(np.float64)
    mean = (on + off) / 2
    variance = thresholds.mismatch**2
    shared = float(np.clip(np.cov(on, off)[0, 1], -variance, variance))
    shrink = (variance + shared) / 2 / max(float(mean.var()), 1e-30)
    edges = np.unique(np.quantile(mean, np.linspace(0, 1, groups + 1)[1:-1]))
    found = np.searchsorted(edges, mean, side="right")
    count = np.maximum(np.bincount(found, minlength=edges.size + 1), 1)
    relative = shrink * (np.bincount(found, mean, edges.size + 1) / count - mean.mean())
    left = max(variance - float(count @ relative**2) / mean.size, 0.0)
    group = np.zeros(good.shape, np.intp)
    group[good] = found
    return group, 1 + relative, float(np.sqrt(left))


def _increasing(rate: NDArray, step: NDArray) -> tuple[NDArray, NDArray]:
    order = np.argsort(step)
    return np.maximum.accumulate(rate[order]) + 1e-12 * np.arange(step.size), step[order]


def _score(values: NDArray, steps: Steps, step: NDArray, n: float) -> tuple[NDArray, NDArray, float]:
    """Gradient, Fisher information and Pearson χ² for (θ₊, θ₋, s, κ)."""
    theta_on, theta_off, width, slope = values
    middle = (theta_on + theta_off) / 2
    score, fisher, chi2 = np.zeros(4), np.zeros((4, 4)), 0.0
    s = width * np.maximum(1 + slope * step / middle, 0.2)
    for k, (theta, signed, counts) in enumerate(((theta_on, step, steps.on), (theta_off, -step, steps.off))):
        v = (theta - signed) / s
        p = np.clip(ndtr(-v), 1e-12, 1 - 1e-12)
        density = np.exp(-0.5 * v * v) / np.sqrt(2 * np.pi)
        jacobian = np.zeros((step.size, 4))
        jacobian[:, k] = -density / s
        jacobian[:, 2] = density * v / width
        jacobian[:, 3] = density * v * width / s * step / middle
        weight = n / (p * (1 - p))
        residual = counts / n - p
        score += (weight * residual) @ jacobian
        fisher += (jacobian * weight[:, None]).T @ jacobian
        chi2 += float(np.sum(weight * residual**2))
    return score, fisher, chi2


def _mismatch(
    theta: float, width: float, slope: float, signed: NDArray, total: NDArray, trials: int, good: NDArray[np.bool_]
) -> tuple[float, float, NDArray[np.float32]]:
    """m², its standard error, and each pixel's threshold relative to `theta`, from the pixels' total counts."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    weights = weights / weights.sum()
    relative = np.maximum(1 + slope * signed / theta, 0.2)

    def rates(thresholds: NDArray, m: float) -> NDArray:
        sigma = np.sqrt(max(width**2 - (m * theta) ** 2, 1e-4 * width**2)) * relative
        return ndtr(-(thresholds[:, None] - signed) / sigma)

    def expected(m2: float) -> float:
        m = np.sqrt(max(m2, 0.0))
        p = rates(theta * (1 + m * nodes), m)
        mean = trials * p.sum(axis=1)
        within = trials * (p * (1 - p)).sum(axis=1)
        between = float(weights @ mean**2 - (weights @ mean) ** 2)
        # A value below 0 keeps the noise of a null estimate symmetrical.
        return float(weights @ within) + (between if m2 >= 0 else m2 * slope_squared)

    h = 1e-3
    ends = trials * rates(theta * np.array([1 - h, 1 + h]), 0.0).sum(axis=1)
    slope_squared = float(((ends[1] - ends[0]) / (2 * h)) ** 2)
    values = total[good].astype(np.float64)
    centred = values - values.mean()
    variance = float(np.mean(centred**2)) * values.size / max(values.size - 1, 1)
    error = float(np.sqrt(max(np.mean(centred**4) - variance**2, 0) / values.size)) / slope_squared
    widest = min(0.98 * width / theta, 0.6) ** 2
    low = (variance - expected(0.0)) / slope_squared
    if low <= 0:
        m2 = low
    elif expected(widest) < variance:
        m2 = widest
    else:
        m2 = float(brentq(lambda m2: expected(m2) - variance, 0.0, widest))
    grid = theta * np.linspace(0.2, 1.8, 801)
    count = trials * rates(grid, np.sqrt(max(m2, 0.0))).sum(axis=1)
    pixel = np.interp(-total, -count, grid / theta).astype(np.float32)
    return m2, error, pixel

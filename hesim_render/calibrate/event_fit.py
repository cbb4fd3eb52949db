"""Maximum likelihood of the event model, many fits at once, and the covariance of what it gives.

Fisher scoring with Levenberg–Marquardt damping; every array carries a leading axis of fits (starts,
tile positions or bootstrap samples), so that 200 starts cost little more than one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.event_model import EventCounts, Law, log_likelihood, log_probabilities

_ROUNDS = 300
#: ln of the factors of C that a search tries first.
_REACH_OF_C = np.linspace(-3.0, 3.0, 25)
_LEAST = np.array([0.0, -30.0, 0.0, -np.inf, -0.95, 0.0])
_LARGEST = np.array([np.inf, 60.0, np.inf, np.inf, 0.95, 0.5])


def start_values(counts: EventCounts, theta_v: float, law: Law) -> NDArray[np.float64]:
    """Rough starts [start, 6] that agree with the dimmest and the brightest bins, for many strengths of C."""
    order = np.argsort(counts.signal_dn)
    few = max(1, len(order) // 10)
    bright = max(float(counts.signal_dn[order[-few:]].mean()), 1e-6)
    b = _threshold_over_noise(counts, order[:few]) * np.sqrt(2) / theta_v
    noise = np.array([0.1, 0.5, 2.0, 10.0, 50.0, 200.0, 1000.0])  # C y at the brightest
    x = _threshold_over_noise(counts, order[-few:]) * np.sqrt(2 * (1 + noise**2)) / theta_v
    starts = np.zeros((noise.size, 6))
    starts[:, 0] = np.maximum(x - b, 0.01 * b) / bright
    starts[:, 1] = np.log(b)
    starts[:, 2] = noise**2 / (bright**2 if law == "linear" else bright)
    return starts


def _threshold_over_noise(counts: EventCounts, bins: NDArray[np.intp]) -> float:
    """u of a few bins together, from their mean rate."""
    from scipy.special import ndtri

    rate = (counts.on[bins].sum() + counts.off[bins].sum() + 1) / (2 * counts.trials[bins].sum() + 2)
    return max(-float(ndtri(min(rate, 0.49))), 0.05)


def search(
    counts: EventCounts, start: NDArray, theta_v: float | NDArray, law: Law, mismatch: float, free: Sequence[bool]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """`maximise` from starts that may be far off.

    Far off, P is 0 or ½ in most bins, and the likelihood sends A and C, of which only the ratio then counts, away
    for good. So least squares of u, the Q⁻¹ of each bin's rate, comes first: it is linear in A and B, and C is the
    best of many about the start's; D stays.
    """
    return maximise(counts, _approach(counts, start, theta_v, law, mismatch, free), theta_v, law, mismatch, free)


def _approach(
    counts: EventCounts, start: NDArray, theta_v: float | NDArray, law: Law, mismatch: float, free: Sequence[bool]
) -> NDArray[np.float64]:
    """Least squares of u [fit, 6]; a start whose A, B or C is not free stays as it is."""
    if not all(free[:3]):
        return np.array(start)
    from scipy.special import ndtri

    p = np.minimum((counts.on + counts.off + 0.5) / (2 * counts.trials + 1), 0.49)
    v = -ndtri(p)
    u = v / np.sqrt(np.maximum(1 - (mismatch * v) ** 2, 0.1))
    weight = counts.trials * np.exp(-v * v) / p  # inverse variance of u, but for a factor
    shot = counts.signal_dn if law == "linear" else np.sqrt(counts.signal_dn)
    scale = np.exp(_REACH_OF_C)[:, None]  # [scale, 1], against [fit, scale, bin]
    w, e = start[:, 2, None, None] * scale**2, start[:, 3, None, None] * scale
    base = theta_v / np.sqrt(2 * np.maximum((1 + e * shot) ** 2 + w * shot**2, 1e-12))
    slope = base * counts.signal_dn
    aa, ab, bb = (np.sum(weight * x * y, axis=-1) for x, y in ((slope, slope), (slope, base), (base, base)))
    ay, by = np.sum(weight * slope * u, axis=-1), np.sum(weight * base * u, axis=-1)
    a = np.maximum((ay * bb - by * ab) / np.maximum(aa * bb - ab * ab, 1e-300), 0.0)
    b = (by - a * ab) / bb
    cost = np.where(b > 0, np.sum(weight * (u - a[..., None] * slope - b[..., None] * base) ** 2, axis=-1), np.inf)
    best = np.argmin(cost, axis=1)
    near, row = np.array(start), np.arange(len(start))
    near[:, 0], near[:, 1] = a[row, best], np.log(np.maximum(b[row, best], 1e-12))
    near[:, 2], near[:, 3] = w[row, best, 0], e[row, best, 0]
    return np.where(np.isfinite(cost[row, best])[:, None], near, start)


def maximise(
    counts: EventCounts,
    start: NDArray,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    free: Sequence[bool],
    inverse_covariance: NDArray | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Fit the event model.

    Parameters
    ----------
    theta_v : Θ, or Θ times the relative threshold of each bin's pixels [bin].
    start : [fit, 6] in the order of `event_model.PARAMETERS`; parameters that are not `free` stay there.
    inverse_covariance : [fit, bin, 2, 2] of the counts (ON, OFF); the estimating equation then weighs with it
        instead of the trinomial's own (quasi-likelihood of over-dispersed counts).

    Returns
    -------
    parameters [fit, 6], Fisher information [fit, 6, 6] (1 on the diagonal of parameters not free), and
    whether each fit converged: the next step would change nothing by more than 1e-4 standard errors.
    """
    eta = np.array(start, dtype=np.float64)
    mask = np.asarray(free, bool)
    bright = max(float(counts.signal_dn.max()), 1e-9)
    reach = bright if law == "linear" else np.sqrt(bright)
    converged = np.zeros(len(eta), bool)
    active = np.arange(len(eta))
    damping = np.full(len(eta), 1e-3)
    value, score, information = _evaluate(counts, eta, theta_v, law, mismatch, mask, inverse_covariance, True)
    for _ in range(_ROUNDS):
        now = eta[active]
        plain = _solve(now, score, information, 0.0)
        done = np.sum(plain * score, axis=1) < 1e-8
        if np.any(done):
            converged[active[done]] = True
            keep = ~done
            active, damping, value, score, information = (v[keep] for v in (active, damping, value, score, information))
            if active.size == 0:
                break
            now = eta[active]
        step = _solve(now, score, information, damping[:, None])
        limit = np.tile([0.0, 1.0, 0.0, 0.0, 0.3, 0.1], (len(now), 1))
        limit[:, 0] = np.maximum(np.exp(now[:, 1]) / bright, now[:, 0]) * 0.7
        strength = np.maximum(1 / reach, np.sqrt(now[:, 2] + now[:, 3] ** 2))
        limit[:, 2], limit[:, 3] = 0.7 * strength**2, 0.7 * strength
        step /= np.maximum(1, np.max(np.abs(step) / limit, axis=1))[:, None]
        trial = np.where(mask, np.clip(now + step, _LEAST, _LARGEST), now)
        new_value, new_score, new_information = _evaluate(
            counts, trial, theta_v, law, mismatch, mask, inverse_covariance, True
        )
        better = new_value >= value - 1e-12 * np.abs(value)
        eta[active[better]] = trial[better]
        value, score = np.where(better, new_value, value), np.where(better[:, None], new_score, score)
        information = np.where(better[:, None, None], new_information, information)
        damping = np.where(better, damping / 5, damping * 5).clip(1e-9, 1e9)
    _, _, fisher = _evaluate(counts, eta, theta_v, law, mismatch, mask, inverse_covariance)
    return eta, fisher, converged


def _solve(eta: NDArray, score: NDArray, information: NDArray, damping: NDArray | float) -> NDArray[np.float64]:
    """Steps [fit, 6]. Parameters at a bound that they would leave are held; scaled so that units do not matter."""
    held = ((eta <= _LEAST) & (score < 0)) | ((eta >= _LARGEST) & (score > 0))
    scale = np.sqrt(np.maximum(np.einsum("fii->fi", information), 1e-250))
    matrix = information / (scale[:, :, None] * scale[:, None, :])
    matrix = np.where(held[:, :, None] | held[:, None, :], 0.0, matrix)
    matrix[:, np.arange(6), np.arange(6)] = 1.0 + damping + 1e-12
    return np.linalg.solve(matrix, np.where(held, 0.0, score / scale)[..., None])[..., 0] / scale


def _evaluate(
    counts: EventCounts,
    eta: NDArray,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    mask: NDArray[np.bool_],
    inverse_covariance: NDArray | None,
    searching: bool = False,
) -> tuple[NDArray, NDArray, NDArray]:
    """Objective [fit], its gradient [fit, 6] and the information [fit, 6, 6]."""
    log_on, log_off, on_slope, off_slope = log_probabilities(eta, counts.signal_dn, theta_v, law, mismatch)
    on, off = np.exp(log_on), np.exp(log_off)
    on_slope, off_slope = on_slope * mask, off_slope * mask
    n = counts.trials
    if inverse_covariance is None:
        value = log_likelihood(counts, log_on, log_off)
        rest = n - counts.on - counts.off
        none = np.maximum(1 - on - off, 1e-12)
        both = on[..., None] * on_slope + off[..., None] * off_slope
        score = np.matmul((counts.on - rest * on / none)[..., None, :], on_slope)[..., 0, :]
        score += np.matmul((counts.off - rest * off / none)[..., None, :], off_slope)[..., 0, :]
        on_weight, off_weight = n * on, n * off
        if searching:
            # Far off, where P underflows, the expected information vanishes; the curvature of n ln Q does not.
            on_weight = np.maximum(on_weight, counts.on / (1 - 2 * log_on))
            off_weight = np.maximum(off_weight, counts.off / (1 - 2 * log_off))
        fisher = sum(
            np.matmul((s * w[..., None]).swapaxes(-1, -2), s)
            for s, w in ((on_slope, on_weight), (off_slope, off_weight), (both, n / none))
        )
    else:
        residual = np.stack([counts.on - n * on, counts.off - n * off], axis=-1)
        slope = _count_slopes(counts, on, off, on_slope, off_slope)
        weighted = np.matmul(inverse_covariance, residual[..., None])[..., 0]
        value = -0.5 * np.sum(residual * weighted, axis=(-1, -2))
        flat = slope.reshape(*slope.shape[:-3], -1, 6)
        turned = np.matmul(inverse_covariance, slope).reshape(flat.shape)
        score = np.matmul(weighted.reshape(*flat.shape[:-2], 1, -1), flat)[..., 0, :]
        fisher = np.matmul(flat.swapaxes(-1, -2), turned)
    fisher = fisher + np.diag(1.0 * ~mask)
    return value, score, fisher


@dataclass(frozen=True)
class Scatter:
    """How the bins' total counts (ON, OFF) scatter, measured over their pixels.

    Attributes
    ----------
    own : [bin, 2, 2], covariance of a bin's counts.
    lit_dark : [bin, 2, 2], of a lit bin's counts with those of the same pixels in the dark, which are a part of
        bin `dark_bin` [bin]: a pixel's threshold moves both. −1 where there is none.
    """

    own: NDArray[np.float64]
    lit_dark: NDArray[np.float64]
    dark_bin: NDArray[np.intp]

    def of_sum(self, influence: NDArray) -> NDArray[np.float64]:
        """Covariance [6, 6] of the sum over bins of counts times `influence` [bin, 2, 6]."""
        own = np.einsum("bip,bij,bjq->pq", influence, self.own, influence, optimize=True)
        lit = self.dark_bin >= 0
        dark = influence[self.dark_bin[lit]]
        both = np.einsum("bip,bij,bjq->pq", influence[lit], self.lit_dark[lit], dark, optimize=True)
        return own + both + both.T


def sandwich(
    parameters: NDArray,
    counts: EventCounts,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    free: Sequence[bool],
    scatter: Scatter,
) -> NDArray[np.float64]:
    """Covariance [6, 6] of one maximum-likelihood fit where counts scatter as `scatter`, not as a trinomial."""
    mask = np.asarray(free, bool)
    one = EventCounts(counts.signal_dn, counts.trials, counts.on, counts.off)
    _, _, fisher = _evaluate(one, parameters[None], theta_v, law, mismatch, mask, None)
    log_on, log_off, on_slope, off_slope = log_probabilities(parameters, counts.signal_dn, theta_v, law, mismatch)
    on, off = np.exp(log_on), np.exp(log_off)
    both = (on[:, None] * on_slope + off[:, None] * off_slope) / np.maximum(1 - on - off, 1e-12)[:, None]
    influence = np.stack([on_slope + both, off_slope + both], axis=1)
    meat = scatter.of_sum(influence) * mask[:, None] * mask
    bread = np.linalg.inv(fisher[0])
    return bread @ meat @ bread


def quasi_sandwich(
    parameters: NDArray,
    counts: EventCounts,
    theta_v: float | NDArray,
    law: Law,
    mismatch: float,
    inverse_covariance: NDArray,
    scatter: Scatter,
    bread: NDArray,
) -> NDArray[np.float64]:
    """The same for one quasi-likelihood fit with `inverse_covariance` [bin, 2, 2] and covariance `bread`."""
    log_on, log_off, on_slope, off_slope = log_probabilities(parameters, counts.signal_dn, theta_v, law, mismatch)
    slope = _count_slopes(counts, np.exp(log_on), np.exp(log_off), on_slope, off_slope)
    influence = np.einsum("bij,bjp->bip", inverse_covariance, slope)
    return bread @ scatter.of_sum(influence) @ bread


def _count_slopes(
    counts: EventCounts, on: NDArray, off: NDArray, on_slope: NDArray, off_slope: NDArray
) -> NDArray[np.float64]:
    """Derivatives [..., bin, 2, 6] of the expected counts (ON, OFF)."""
    n = counts.trials
    return np.stack([(n * on)[..., None] * on_slope, (n * off)[..., None] * off_slope], axis=-2)

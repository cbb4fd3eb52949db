"""Maximum likelihood of the event model, many fits at once, and the covariance of the parameters.

Fisher scoring with Levenberg–Marquardt damping. Parameters carry a leading axis of fits (starts), so that 200 starts
cost little more than one.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from hesim_render.calibrate.evs.cells import Cells, PixelCounts
from hesim_render.calibrate.evs.model import Law, coefficients, log_likelihood, log_probability, relative_variance

_ROUNDS = 300
#: A search ends when ln L rises by less than `_PROGRESS` in `_PATIENCE` rounds.
_PATIENCE, _PROGRESS = 25, 1e-4
#: ln of the factors of C that a search tries first.
_REACH_OF_C = np.linspace(-3.0, 3.0, 25)
_LEAST = np.array([0.0, -30.0, 0.0, -np.inf, -0.95, 0.0])
_LARGEST = np.array([np.inf, 60.0, np.inf, np.inf, 0.95, 0.5])
#: Number of pixels whose scores are summed at once.
_CHUNK = 1 << 16


def start_values(cells: Cells, theta_v: float, law: Law) -> NDArray[np.float64]:
    """Rough starts [start, 6] that agree with the dimmest and the brightest cells, for many values of C."""
    order = np.argsort(cells.signal_dn)
    few = max(2, len(order) // 10)
    bright = max(float(cells.signal_dn[order[-few:]].mean()), 1e-6)
    # in the dimmest cells u is B Θ/√2, in the brightest that of A I + B with the shot noise tried
    b = _threshold_over_noise(cells, order[:few]) * np.sqrt(2) / theta_v
    noise = np.array([0.1, 0.5, 2.0, 10.0, 50.0, 200.0, 1000.0])  # C y at the brightest
    x = _threshold_over_noise(cells, order[-few:]) * np.sqrt(2 * (1 + noise**2)) / theta_v
    starts = np.zeros((noise.size, 6))
    starts[:, 0] = np.maximum(x - b, 0.01 * b) / bright
    starts[:, 1] = np.log(b)
    starts[:, 2] = noise**2 / (bright**2 if law == "linear" else bright)
    return starts


def _threshold_over_noise(cells: Cells, some: NDArray[np.intp]) -> float:
    """u of a few cells together, from their mean rate."""
    rate = (cells.events[some].sum() + 1) / (cells.total[some].sum() + 2)
    return max(-float(ndtri(min(rate, 0.49))), 0.05)


def search(
    cells: Cells, start: NDArray, theta_v: float, law: Law, free: Sequence[bool], variance: NDArray | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """`maximise` from starts that may be far off.

    Far from the maximum, P is 0 or ½ in most cells. Then only the ratio of A and C counts, and the search makes both
    grow without limit. So least squares of u, Q⁻¹ of each cell's rate, comes first: it is linear in A and B, C is the
    best of many values around that of the start, and D stays.
    """
    return maximise(cells, _approach(cells, start, theta_v, law, free), theta_v, law, free, variance)


def _approach(cells: Cells, start: NDArray, theta_v: float, law: Law, free: Sequence[bool]) -> NDArray[np.float64]:
    """Least squares of u [fit, 6]; a start whose A, B or C is not free stays as it is."""
    if not all(free[:3]):
        return np.array(start)
    # rates away from 0 and ½, where u would be infinite or its slope vanish
    p = np.minimum((cells.events + 0.5) / (cells.total + 1), 0.49)
    v = -ndtri(p)
    # u of a pixel of typical threshold: the spread of thresholds flattens the mean rate of a cell
    u = v / np.sqrt(np.maximum(cells.relative**2 - (cells.spread * v) ** 2, 0.1))
    weight = cells.total * np.exp(-v * v) / p  # inverse variance of u, but for a factor
    many = np.repeat(start[:, None], _REACH_OF_C.size, axis=1)  # [fit, scale, 6], against cells
    many[..., 2] *= np.exp(2 * _REACH_OF_C)
    many[..., 3] *= np.exp(_REACH_OF_C)
    # u = A · slope + B · base for each C that is tried, [fit, scale, cell]
    base = theta_v / np.sqrt(2 * relative_variance(coefficients(many), cells.signal_dn, law))
    slope = base * cells.signal_dn
    # normal equations of the two terms, solved in closed form; A is not below 0
    aa, ab, bb = (np.sum(weight * x * y, axis=-1) for x, y in ((slope, slope), (slope, base), (base, base)))
    ay, by = np.sum(weight * slope * u, axis=-1), np.sum(weight * base * u, axis=-1)
    a = np.maximum((ay * bb - by * ab) / np.maximum(aa * bb - ab * ab, 1e-300), 0.0)
    b = (by - a * ab) / bb
    # a fit with B below 0 has no meaning: C is chosen among the others
    cost = np.where(b > 0, np.sum(weight * (u - a[..., None] * slope - b[..., None] * base) ** 2, axis=-1), np.inf)
    best = np.argmin(cost, axis=1)
    near, row = np.array(start), np.arange(len(start))
    near[:, 0], near[:, 1] = a[row, best], np.log(np.maximum(b[row, best], 1e-12))
    near[:, 2:4] = many[row, best, 2:4]
    # where no C works the start stays as it is
    return np.where(np.isfinite(cost[row, best])[:, None], near, start)


def maximise(
    cells: Cells,
    start: NDArray,
    theta_v: float,
    law: Law,
    free: Sequence[bool],
    variance: NDArray | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Fit the event model.

    Parameters
    ----------
    start : [fit, 6] in the order of `event_model.PARAMETERS`; parameters that are not `free` stay there.
    variance : [cell], of a cell's number of events; the estimating equation then uses it as weight instead of the
        binomial's own (quasi-likelihood of over-dispersed counts).

    Returns
    -------
    parameters [fit, 6], Fisher information [fit, 6, 6] (1 on the diagonal of parameters not free), and
    whether each fit converged: the next step would change nothing by more than 1e-4 standard errors.
    """
    eta = np.array(start, dtype=np.float64)
    mask = np.asarray(free, bool)
    # how far the brightest light reaches, which scales the steps of the shot noise
    bright = max(float(cells.signal_dn.max()), 1e-9)
    reach = bright if law == "linear" else np.sqrt(bright)
    converged = np.zeros(len(eta), bool)
    active = np.arange(len(eta))
    damping = np.full(len(eta), 1e-3)
    # scoring with a damping of its own for each fit; fits that have converged leave `active`
    value, score, information = _evaluate(cells, eta, theta_v, law, mask, variance, True)
    before = value
    for round_ in range(_ROUNDS):
        if round_ % _PATIENCE == _PATIENCE - 1:
            if np.all(value - before < _PROGRESS):
                break  # far out in a valley without end, where only a combination of parameters is identifiable
            before = value
        now = eta[active]
        # converged: the undamped step would gain next to nothing of the likelihood
        plain = _solve(now, score, information, 0.0)
        done = np.sum(plain * score, axis=1) < 1e-8
        if np.any(done):
            converged[active[done]] = True
            keep = ~done
            active, damping, value, before, score, information = (
                v[keep] for v in (active, damping, value, before, score, information)
            )
            if active.size == 0:
                break
            now = eta[active]
        # the damped step, at most as long as each parameter may change in one round
        step = _solve(now, score, information, damping[:, None])
        limit = np.tile([0.0, 1.0, 0.0, 0.0, 0.3, 0.1], (len(now), 1))
        limit[:, 0] = np.maximum(np.exp(now[:, 1]) / bright, now[:, 0]) * 0.7
        strength = np.maximum(1 / reach, np.sqrt(now[:, 2] + now[:, 3] ** 2))
        limit[:, 2], limit[:, 3] = 0.7 * strength**2, 0.7 * strength
        step /= np.maximum(1, np.max(np.abs(step) / limit, axis=1))[:, None]
        # take it where the likelihood rises and trust the model more; elsewhere stay and trust it less
        trial = np.where(mask, np.clip(now + step, _LEAST, _LARGEST), now)
        new_value, new_score, new_information = _evaluate(cells, trial, theta_v, law, mask, variance, True)
        better = new_value >= value - 1e-12 * np.abs(value)
        eta[active[better]] = trial[better]
        value, score = np.where(better, new_value, value), np.where(better[:, None], new_score, score)
        information = np.where(better[:, None, None], new_information, information)
        damping = np.where(better, damping / 5, damping * 5).clip(1e-9, 1e9)
    # the information at the end, with the weights of the end
    _, _, fisher = _evaluate(cells, eta, theta_v, law, mask, variance)
    return eta, fisher, converged


def _solve(eta: NDArray, score: NDArray, information: NDArray, damping: NDArray | float) -> NDArray[np.float64]:
    """Steps [fit, 6], scaled so that units do not matter. Parameters that would leave a bound are held at it."""
    # at a bound and pushed outwards: such a parameter has a step of 0
    held = ((eta <= _LEAST) & (score < 0)) | ((eta >= _LARGEST) & (score > 0))
    # a diagonal of ones, so that one damping serves parameters of any unit
    scale = np.sqrt(np.maximum(np.einsum("fii->fi", information), 1e-250))
    matrix = information / (scale[:, :, None] * scale[:, None, :])
    matrix = np.where(held[:, :, None] | held[:, None, :], 0.0, matrix)
    matrix[:, np.arange(6), np.arange(6)] = 1.0 + damping + 1e-12
    return np.linalg.solve(matrix, np.where(held, 0.0, score / scale)[..., None])[..., 0] / scale


def _evaluate(
    cells: Cells,
    eta: NDArray,
    theta_v: float,
    law: Law,
    mask: NDArray[np.bool_],
    variance: NDArray | None,
    searching: bool = False,
) -> tuple[NDArray, NDArray, NDArray]:
    """Objective [fit], its gradient [fit, 6] and the information [fit, 6, 6]."""
    log_p, slope = log_probability(eta, cells, theta_v, law)
    p, slope, n = np.exp(log_p), slope * mask, cells.total
    residual = cells.events - n * p
    if variance is None:
        value = log_likelihood(cells, log_p)
        # derivatives by ln P: the score of a binomial is (k − n p)/(1 − p), its information n p/(1 − p)
        rest = np.maximum(1 - p, 1e-12)
        influence, weight = residual / rest, n * p / rest
        if searching:
            # Where P underflows, the expected information vanishes; the curvature of n ln Q does not.
            weight = np.maximum(weight, cells.events / (1 - 2 * log_p))
    else:
        value = -0.5 * np.sum(residual**2 / variance, axis=-1)
        influence, weight = residual * n * p / variance, (n * p) ** 2 / variance
    # sums over cells: gradient, and information of the free parameters; 1 on the diagonal of the others
    score = np.matmul(influence[..., None, :], slope)[..., 0, :]
    information = np.matmul((slope * weight[..., None]).swapaxes(-1, -2), slope)
    return value, score, information + np.diag(1.0 * ~mask)


def pixel_scores(
    pixels: PixelCounts, eta: NDArray, theta_v: float, law: Law, free: Sequence[bool], variance: NDArray | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Covariance [6, 6] of the score of one fit `eta` [6], from how the pixels' own scatter, and the information.

    All counts of a pixel, ON and OFF, lit and dark, are taken together. This includes every cause of common scatter:
    thresholds, noise correlated from tick to tick, changes in time.
    """
    cells = pixels.cells
    log_p, slope = log_probability(eta, cells, theta_v, law)
    slope = slope * np.asarray(free, bool)
    p = np.exp(log_p)
    # what one event more of a cell adds to the score, [cell, 6]
    influence = (slope / np.maximum(1 - p, 1e-12)[:, None]) if variance is None else slope * (
        cells.total * p / variance
    )[:, None]  # fmt: skip
    meat = np.zeros((6, 6))
    for begin in range(0, pixels.signal_dn.size, _CHUNK):
        part = np.s_[begin : begin + _CHUNK]
        # one row a pixel: all its counts together
        score = sum(
            (k[part] - cells.trials * p[cell[part]])[:, None] * influence[cell[part]]
            for k, cell in zip(pixels.counts, pixels.cell, strict=True)
        )
        meat += score.T @ score
    return meat, (slope * (cells.total * p)[:, None]).T @ influence


def sandwich(
    pixels: PixelCounts, eta: NDArray, theta_v: float, law: Law, free: Sequence[bool], variance: NDArray | None
) -> NDArray[np.float64]:
    """Covariance [6, 6] of one fit, from the scatter of the pixels' scores; 0 for parameters that are not free."""
    mask = np.asarray(free, bool)
    meat, information = pixel_scores(pixels, eta, theta_v, law, free, variance)
    # parameters that are not free have neither rows nor columns
    bread = np.linalg.pinv(information, hermitian=True) * mask[:, None] * mask
    return bread @ meat @ bread

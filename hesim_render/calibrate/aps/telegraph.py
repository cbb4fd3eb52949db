"""Frame pixels with random telegraph noise: found in dark frames by their variance, then by the two levels themselves.

A pixel is examined if its dark variance has a probability of 1e-6 for a good pixel. Its values are read once
more, and two models are fitted to them: one level, and two with a Markov chain between them (a hidden Markov model,
by expectation maximisation [baum1970]), each with a Gaussian of its own width and dark current. Two levels are accepted
if their likelihood is larger than noise of one level, of any width, can reach.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from hesim_render.calibrate.moments import FrameMoments
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.aps.formulas import ADC_VARIANCE_DN2
from hesim_render.recording.capture_set import FrameStack

#: Probability that a good pixel is examined, and least gain of log-likelihood of two levels.
_CHANCE, _LEAST_GAIN = 1e-6, 20.0
#: Least number of frames at each level, and least distance of the levels in widths.
_LEAST_VISITS, _LEAST_DISTANCE = 5.0, 1.0
#: Most pixels that are examined, largest variance first: their values stay in memory.
_MOST = 100_000
#: Pixels fitted together, most rounds, and the change of log-likelihood below which the rounds end.
_TOGETHER, _ROUNDS, _SETTLED = 2000, 60, 1e-3


@dataclass(frozen=True)
class TelegraphMaps:
    """Two levels of pixels [row, col]; 0 where a pixel has one level.

    Attributes
    ----------
    amplitude_dn : high level minus low level, DN.
    high_share : fraction of the frames at the high level.
    correlation : correlation of the state from one frame to the next.
    """

    amplitude_dn: NDArray[np.float32]
    high_share: NDArray[np.float32]
    correlation: NDArray[np.float32]

    @property
    def is_telegraph(self) -> NDArray[np.bool_]:
        return self.amplitude_dn > 0


def find_telegraph(
    stack: FrameStack, moments: FrameMoments, used: NDArray[np.bool_], tile: tuple[int, int], full_scale_dn: int
) -> TelegraphMaps:
    """Pixels with two levels in dark frames.

    Parameters
    ----------
    stack : the dark frames.
    moments : their moments.
    used : [row, col], pixels that have a frame value.
    tile : (rows, cols) of a tile.
    full_scale_dn : largest value of the ADC, DN.
    """
    maps = TelegraphMaps(*np.zeros((3, *used.shape), np.float32))
    place = np.flatnonzero(_suspects(moments, used, tile, full_scale_dn))
    if place.size == 0:
        return maps
    # [exposure, frame, pixel]: the suspects alone are held in memory
    values = np.empty((*stack.shape[:2], place.size), np.uint16)
    for number, frame in enumerate(stack):
        values[divmod(number, stack.shape[1])] = frame.ravel()[place]
    for first in range(0, place.size, _TOGETHER):
        part = slice(first, first + _TOGETHER)
        result = fit_two_levels(values[..., part], stack.exposures_us.astype(np.float64) * S_PER_US)
        good = result.is_telegraph
        for name in ("amplitude_dn", "high_share", "correlation"):
            getattr(maps, name).ravel()[place[part][good]] = getattr(result, name)[good]
    return maps


def _suspects(
    moments: FrameMoments, used: NDArray[np.bool_], tile: tuple[int, int], full_scale_dn: int
) -> NDArray[np.bool_]:
    """Pixels [row, col] whose variance over all exposures is above that of good pixels with the same dark current."""
    excess, freedom = np.zeros(used.shape), np.zeros(used.shape)
    clear = (moments.lowest > 0) & (moments.highest < full_scale_dn)
    t = moments.exposures_s
    # dark current of each pixel, from the shortest and the longest exposure
    dark_dn_per_s = (moments.mean[-1] - moments.mean[0]) / (t[-1] - t[0])
    for k in range(t.size):
        for i, j in np.ndindex(tile):
            cut = np.s_[i :: tile[0], j :: tile[1]]
            here = used[cut] & clear[k][cut]
            if here.any():
                variance = moments.variance[k][cut]
                # χ² of the pixel's sample variances, added up over exposures
                expected = _usual_variance(variance, t[k] * dark_dn_per_s[cut], here)
                excess[cut] += np.where(here, (moments.frames - 1) * variance / expected, 0.0)
                freedom[cut] += np.where(here, moments.frames - 1, 0)
    limit = chi2.isf(_CHANCE, np.maximum(freedom, 1))
    beyond = np.where(freedom > 0, excess / limit, 0.0)
    suspects = beyond > 1
    if suspects.sum() > _MOST:
        # the most suspicious ones
        suspects &= beyond >= np.partition(beyond.ravel(), -_MOST)[-_MOST]
    return suspects


def _usual_variance(variance: NDArray, dark_dn: NDArray, here: NDArray[np.bool_]) -> NDArray:
    """Variance of a good pixel as a function of its dark current, including the shot noise of the dark current.

    It is a straight line through the medians of the pixels with the least and with the most dark current.

    Parameters
    ----------
    variance : [row, col], DN².
    dark_dn : [row, col], signal of the dark current, DN.
    here : [row, col], pixels of the position.
    """
    low, high = np.quantile(dark_dn[here], (0.5, 0.95))
    least, most = here & (dark_dn <= low), here & (dark_dn >= high)
    x, y = ([float(np.median(values[part])) for part in (least, most)] for values in (dark_dn, variance))
    # shot noise of the dark current; medians of both ends are hardly changed by bad pixels
    slope = max((y[1] - y[0]) / (x[1] - x[0]), 0.0) if x[1] > x[0] else 0.0
    return np.maximum(y[0] + slope * (dark_dn - x[0]), max(0.5 * y[0], ADC_VARIANCE_DN2))


@dataclass(frozen=True)
class TwoLevels:
    """What was fitted to the values of pixels [pixel].

    Attributes
    ----------
    amplitude_dn, high_share, correlation : as of `TelegraphMaps`.
    width_dn : standard deviation about either level.
    gain : log-likelihood above that of one level.
    visits : frames at the level that is visited less.
    """

    amplitude_dn: NDArray[np.float64]
    high_share: NDArray[np.float64]
    correlation: NDArray[np.float64]
    width_dn: NDArray[np.float64]
    gain: NDArray[np.float64]
    visits: NDArray[np.float64]

    @property
    def is_telegraph(self) -> NDArray[np.bool_]:
        return (
            (self.gain > _LEAST_GAIN)
            & (self.visits >= _LEAST_VISITS)
            & (self.amplitude_dn > _LEAST_DISTANCE * self.width_dn)
        )


def fit_two_levels(values: NDArray, exposures_s: NDArray[np.float64]) -> TwoLevels:
    """Maximum likelihood of two levels about a straight line of exposure, with a Markov chain between them.

    Parameters
    ----------
    values : [exposure, frame, pixel], DN; frames of one exposure follow each other, exposures do not.
    exposures_s : [exposure].
    """
    y = np.asarray(values, np.float64)
    t = np.asarray(exposures_s, np.float64)[:, None, None] / np.max(exposures_s)
    # one level: a straight line, and its width
    line, one_width = _line(y, np.broadcast_to(t, y.shape), None)
    rest = y - line[0] - line[1] * t
    count = y.shape[0] * y.shape[1]
    # ln L of a normal law at its own variance
    one = -0.5 * count * (np.log(2 * np.pi * one_width**2) + 1)
    # The fit begins twice, and the likelier result is kept. States above and below the median of each exposure suit
    # many changes of level within an exposure, states above and below the straight line suit few changes.
    ends = [_climb(y, t, rest > 0), _climb(y, t, y > np.median(y, axis=1, keepdims=True))]
    better = ends[1][-1] > ends[0][-1]
    level, width, share, correlation, log_likelihood = (np.where(better, b, a) for a, b in zip(*ends, strict=True))
    # the higher level is the one whose share is stated
    share = np.where(level[2] < 0, 1 - share, share)
    visits = count * np.minimum(share, 1 - share)
    return TwoLevels(np.abs(level[2]), share, correlation, width, log_likelihood - one, visits)


def _climb(y: NDArray, t: NDArray, begin: NDArray[np.bool_]) -> tuple[NDArray[np.float64], ...]:
    """Expectation maximisation from the states `begin`.

    Parameters
    ----------
    y : [exposure, frame, pixel], DN.
    t : exposure, s, that broadcasts against `y`.
    begin : [exposure, frame, pixel], True for the high state.

    Returns
    -------
    Levels [3, pixel], and [pixel] width, share of the high state, correlation and log-likelihood.
    """
    share, correlation = np.full(y.shape[2], 0.5), np.full(y.shape[2], 0.5)
    high = begin.astype(np.float64)
    level, width = _line(y, np.broadcast_to(t, y.shape), high)
    log_likelihood: NDArray = np.full(y.shape[2], -np.inf)
    for _ in range(_ROUNDS):
        before = log_likelihood
        log_likelihood, high, both = _chain(y, t, level, width, share, correlation)
        if np.all(log_likelihood - before < _SETTLED):
            break
        level, width = _line(y, np.broadcast_to(t, y.shape), high)
        share = np.clip(high.mean(axis=(0, 1)), 1e-4, 1 - 1e-4)
        # of a chain with correlation c: P(high, high) = p² + p (1 − p) c
        correlation = np.clip((both - share**2) / (share * (1 - share)), 1e-4, 1 - 1e-4)
    return level, width, share, correlation, log_likelihood


def _line(y: NDArray, t: NDArray, high: NDArray | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least squares of y on 1, t and the state.

    `high` is the probability of the high state: y belongs to either level with its probability.

    Returns
    -------
    Coefficients [2 or 3, pixel], and standard deviation of the residual [pixel].
    """
    axes = (0, 1)
    terms = [np.ones_like(y), t] if high is None else [np.ones_like(y), t, high]
    size = len(terms)
    normal, right = np.empty((y.shape[2], size, size)), np.empty((y.shape[2], size))
    for i in range(size):
        right[:, i] = np.sum(terms[i] * y, axis=axes)
        for j in range(size):
            # the state squared is the state
            product = terms[i] if high is not None and i == j == 2 else terms[i] * terms[j]
            normal[:, i, j] = np.sum(product, axis=axes)
    normal += 1e-9 * np.eye(size) * y.shape[0] * y.shape[1]
    result: NDArray = np.linalg.solve(normal, right[..., None])[..., 0].T
    squares = np.sum(y * y, axis=axes) - np.sum(result * right.T, axis=0)
    return result, np.sqrt(np.maximum(squares / (y.shape[0] * y.shape[1]), ADC_VARIANCE_DN2)).astype(np.float64)


def _chain(
    y: NDArray, t: NDArray, level: NDArray, width: NDArray, share: NDArray, correlation: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Forward and backward passes of the Markov chain, over the frames of all exposures at once.

    Returns
    -------
    Log-likelihood [pixel], probability of the high state [exposure, frame, pixel], and the mean probability that it
    occurs in two successive frames [pixel].
    """
    exposures, frames, pixels = y.shape
    # how likely each value is in either state, over the larger of the two
    rest = (y - level[0] - level[1] * t) / width
    emission = np.stack([-0.5 * rest**2, -0.5 * (rest - level[2] / width) ** 2])
    top = emission.max(axis=0)
    emission = np.exp(emission - top)
    # forward: probability of the state from all frames up to this one
    stationary = np.stack([1 - share, share])[:, None]  # [state, 1, pixel]
    forward = np.empty((2, exposures, frames, pixels))
    scale = np.empty((exposures, frames, pixels))
    before = np.broadcast_to(stationary, (2, exposures, pixels))
    for k in range(frames):
        now = before * emission[:, :, k]
        scale[:, k] = now.sum(axis=0)
        now = now / scale[:, k]
        forward[:, :, k] = now
        before = correlation * now + (1 - correlation) * stationary
    # backward: the same from all later frames; together they are the probability from all frames
    high = np.empty_like(y)
    both = np.zeros(pixels)
    backward = np.ones((2, exposures, pixels))
    for k in range(frames - 1, -1, -1):
        high[:, k] = forward[1, :, k] * backward[1]
        if k == 0:
            break
        seen = emission[:, :, k] * backward / scale[:, k]
        stay = share + (1 - share) * correlation
        both += np.sum(forward[1, :, k - 1] * stay * seen[1], axis=0)
        backward = correlation * seen + (1 - correlation) * np.sum(stationary * seen, axis=0)
    log_likelihood = np.sum(np.log(scale) + top - np.log(width) - 0.5 * np.log(2 * np.pi), axis=(0, 1))
    return log_likelihood, high, both / (exposures * (frames - 1))

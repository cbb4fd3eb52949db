"""Spread of the noise's bandwidth over event pixels, from a recording of a still scene in dim light.

A pixel of bandwidth f has events of both polarities at rates that are proportional to f. They depend on its thresholds
as well. With δ₊, δ₋ the relative deviations of θ₊, θ₋, of variance m², s² the variance of ln f, and the balance
n₊ θ₊ = n₋ θ₋ of still light::

    ln n₊ = ln f − (k + 1)/2 · δ₊ − (k − 1)/2 · δ₋        cov(ln n₊, ln n₋) = s² + m² (k² − 1)/2
    ln n₋ = ln f − (k − 1)/2 · δ₊ − (k + 1)/2 · δ₋        var(ln n₊) = var(ln n₋) = cov(ln n₊, ln n₋) + m²

k, by how many per cent the rate falls with a threshold 1 % larger, follows from the time that a pixel takes from an
event to one of the other polarity, times its rate: both have f in them, and their product has noise over threshold
alone. Covariances are those of counts in both halves of the time, which counting has no part in.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.rests import quantile_us
from hesim_render.calibrate.recordings.still import jackknife
from hesim_render.calibrate.recordings.tally import GROUPS, EventTally
from hesim_render.core.units import S_PER_US

#: Lower quartile of the times between events of different polarity, times the events a second, and k. Counted on
#: simulated noise through two equal poles, with θ₋/θ₊ from 0.75 to 1.35, of 1.0 to 3.2 σ.
_TURN = np.array([0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6])
_FALL = np.array([5.7, 4.8, 4.2, 3.57, 2.98, 2.6, 2.37, 2.22, 2.08, 1.91, 1.78, 1.66])
#: Relative error of that law.
_LAW_ERROR = 0.08
#: Logarithm by which the product falls, in variances of ln f: fast pixels have more of the times, and shorter ones.
_FAST = 0.9
#: Events of a polarity that a pixel needs in half of the time, and most ON events for an OFF event, or the other way.
_EVENTS_OF_HALF, _MOST_RATIO = 5.0, 2.0
#: Keys of a sensor file (``evs.noise_spread``).
KEYS = ("bandwidth_rel", "odd_rows_rel", "odd_cols_rel")


def noise_spread(tally: EventTally, first: tuple[int, int] = (0, 0)) -> dict[str, dict[str, Any]]:
    """Keys of ``evs.noise_spread``, each with its interval, a jackknife over groups of pixels.

    ``bandwidth_rel`` is s, apart from the pattern; odd rows have ``1 + odd_rows_rel`` times the bandwidth, even ones
    ``1 − odd_rows_rel``, columns likewise. Light must be even: what differs in it makes rates differ.

    Parameters
    ----------
    tally : of the recording.
    first : row and column of its first pixel on the sensor; of a crop, whose odd rows may be even ones there.
    """
    counts = tally.counts.reshape(4, -1).astype(np.float64)
    means = counts[:, tally.used].mean(axis=1)
    on, off = means[:2].sum(), means[2:].sum()
    if means.min() < _EVENTS_OF_HALF:
        return _none(f"a pixel has {means.min():.2g} events of a polarity in half of the time; {_EVENTS_OF_HALF:g} are "
                     "needed: record longer, in dimmer light")  # fmt: skip
    if not 1 / _MOST_RATIO < on / off < _MOST_RATIO:
        return _none(f"there are {on / off:.2g} ON events for an OFF event, so that not noise alone makes them: record "
                     "in dimmer light")  # fmt: skip
    sums = _sums(tally, counts, first)
    every = np.concatenate([sums.sum(axis=2, keepdims=True), sums.sum(axis=2, keepdims=True) - sums], axis=2)
    if every[0].min() < 2:
        return _none("even or odd rows or columns have too few pixels")
    gaps = tally.gaps.sum(axis=0)
    gaps = np.concatenate([gaps.sum(axis=0, keepdims=True), gaps.sum(axis=0) - gaps])
    turn_s = np.array([quantile_us(one, 0.25) for one in gaps]) * S_PER_US
    rows, cols = _pattern(every, 2), _pattern(every, 1)
    own, both = _covariances(every)
    mismatch2, rate_hz = own - both, (every[1:5].sum(axis=(0, 1)) / every[0].sum(axis=0)) / tally.seconds
    spread2 = np.zeros(GROUPS + 1)
    for _ in range(4):
        turn = turn_s * rate_hz * np.exp(_FAST * (np.maximum(spread2, 0.0) + rows**2 + cols**2))
        fall = np.exp(np.interp(np.log(np.maximum(turn, 1e-300)), np.log(_TURN), np.log(_FALL)))
        spread2 = both - mismatch2 * (fall**2 - 1) / 2
    result = {
        key: estimated(values[0], float(jackknife(values)), "", GROUPS)
        for key, values in zip(KEYS[1:], (rows, cols), strict=True)
    }
    if turn[0] < _TURN[0]:
        reason = "the noise is too weak beside the thresholds: record in dimmer light"
        return {KEYS[0]: not_identifiable(reason), **result}
    of_law = _LAW_ERROR * fall[0] ** 2 * max(mismatch2[0], float(jackknife(mismatch2)))
    error = float(np.hypot(jackknife(spread2), of_law))
    if spread2[0] <= 2 * error:
        limit = float(np.sqrt(max(spread2[0], 0.0) + 2 * error))
        alike = {"value": 0.0, "upper_limit": limit, "note": "the pixels scatter no more than their thresholds do"}
        return {KEYS[0]: alike, **result}
    spread = float(np.sqrt(spread2[0]))
    return {KEYS[0]: estimated(spread, error / (2 * spread), "std of ln", GROUPS), **result}


def surest(spreads: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Of several recordings, each key where its interval is narrowest; where none knows it, the reason of the first."""
    if not spreads:
        return _none("the rate of every recording changes (findings)")

    def width(entry: dict[str, Any]) -> float:
        low, high = entry.get("interval_95", (0.0, entry.get("upper_limit", np.inf)))
        return float(high - low)

    return {key: min((one[key] for one in spreads), key=width) for key in KEYS}


def _none(reason: str) -> dict[str, dict[str, Any]]:
    return dict.fromkeys(KEYS, not_identifiable(reason))


def _sums(tally: EventTally, counts: NDArray[np.float64], first: tuple[int, int]) -> NDArray[np.float64]:
    """Sums over pixels of even or odd rows and columns, [sum, class, group of pixels].

    They are the pixels, the counts [polarity, half] and the products of counts of different halves: of ON, of OFF, and
    of both ways of ON and OFF.
    """
    row, col = np.divmod(np.arange(tally.pixels), tally.shape[1])
    place = (((row + first[0]) % 2 * 2 + (col + first[1]) % 2) * GROUPS + tally.group.astype(np.int64))[tally.used]
    on_on, off_off = counts[0] * counts[1], counts[2] * counts[3]
    values = [np.ones(tally.pixels), *counts, on_on, off_off, counts[0] * counts[3], counts[1] * counts[2]]
    sums = [np.bincount(place, one[tally.used], 4 * GROUPS).reshape(4, GROUPS) for one in values]
    return np.asarray(sums, np.float64)


def _pattern(sums: NDArray[np.float64], bit: int) -> NDArray[np.float64]:
    """Events of the odd rows (bit 2) or columns (bit 1) less those of the even ones, over their sum, [k]."""
    mean = sums[1:5].sum(axis=0) / sums[0]
    is_odd = np.arange(4) & bit > 0
    odd, even = mean[is_odd].mean(axis=0), mean[~is_odd].mean(axis=0)
    return np.asarray((odd - even) / (odd + even))


def _covariances(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Variance of the logarithm of a polarity's rate, mean of both, and covariance of both polarities, [k].

    Of lognormal laws: the logarithm of the mean of the products over the product of the means, mean over classes.
    """
    mean = sums[1:] / sums[0]
    pairs = ((0, 1), (2, 3), (0, 3), (1, 2))
    logs = [np.log(mean[4 + k] / (mean[a] * mean[b])) for k, (a, b) in enumerate(pairs)]
    # mean over the four classes, by their pixels
    weight = sums[0] / sums[0].sum(axis=0)
    own_on, own_off, first, second = (np.sum(weight * one, axis=0) for one in logs)
    return 0.5 * (own_on + own_off), 0.5 * (first + second)

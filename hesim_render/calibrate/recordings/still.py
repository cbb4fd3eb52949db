"""Rates, leak, spread and defects of event pixels from recordings of still scenes.

In still light the level of a pixel does not go anywhere: what its ON events add to the reference, its OFF events and
the leak take away. Over all pixels, with n₊ and n₋ the rates and ρ = θ₋/θ₊, the leak in thresholds a second is
therefore n₊ − ρ n₋, however the noise may be. With three lights, ρ, the leak in the dark and its growth follow from a
straight line.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import maximum_filter

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.tally import GROUPS, EventTally

#: Events of a pixel, as the median, with which a silent pixel is not silent by chance.
_EVENTS_TO_BE_SILENT = 30
#: A hot pixel has more ON events than a pixel of so many times the rate of the others, but with this chance, in each
#: recording.
_HOT, _HOT_CHANCE = 10.0, 1e-3
#: Fewest ON events of a pixel that is alone in having them.
_LONELY = 10
#: Relative standard deviation of thresholds over pixels, where none was measured.
USUAL_MISMATCH = 0.1
#: Shift of ρ, and of a leak over ρ n₋, in squares of the mismatch.
_RATIO_SHIFT, _LEAK_SHIFT = 1.0, 3.0
#: Relative error of the leak in the light of a moving target.
UNSURE_LEAK = 0.1
#: Standard errors below 0 from which a leak is none.
_BELOW_0 = 3.0
#: Range in which the ratio of the thresholds is taken to be where nothing tells it.
_RATIO = (0.5, 2.0)


def group_rates(tally: EventTally) -> NDArray[np.float64]:
    """Events per pixel and second [polarity, k]: of all pixels, and without each group of pixels."""
    events = np.array([tally.by_group(count) for count in tally.per_pixel()])
    pixels = tally.by_group(np.ones(tally.pixels))
    every = np.concatenate([events.sum(axis=1, keepdims=True), events.sum(axis=1, keepdims=True) - events], axis=1)
    return every / (np.append(pixels.sum(), pixels.sum() - pixels) * tally.seconds)


def jackknife(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard errors of values [..., k]: the whole, and without each group."""
    parts = values[..., 1:]
    return np.sqrt((GROUPS - 1) / GROUPS * np.sum((parts - parts.mean(axis=-1, keepdims=True)) ** 2, axis=-1))


def rate(rates: NDArray[np.float64], polarity: int) -> dict[str, Any]:
    """Events of one polarity per pixel and second, mean over pixels; 0 with its limit where there are none."""
    if rates[polarity, 0] == 0:
        return {"value": 0.0, "unit": "Hz", "note": "no event"}
    return estimated(rates[polarity, 0], float(jackknife(rates[polarity])), "Hz", GROUPS)


class LeakBalance(NamedTuple):
    """Figures of the balance of levels, as entries of the result.

    Parameters
    ----------
    ratio : ρ = θ₋/θ₊.
    leaks : of each recording, Hz.
    dark, growth : leak in the dark, Hz, and its growth with the light, Hz/lx.
    """

    ratio: dict[str, Any]
    leaks: list[dict[str, Any]]
    dark: dict[str, Any]
    growth: dict[str, Any]


def balance(tallies: Sequence[EventTally], lux: Sequence[float] | None) -> LeakBalance:
    """Ratio of the thresholds and leak from the balance of the levels, without a moving target.

    All errors are those of a jackknife over groups of pixels, through all steps: pixels differ, and the same pixels are
    in all recordings. Pixels of low θ₋ have more of the OFF events than others, so that ρ is not exactly the ratio that
    counts. In simulations that shifts ρ by up to once, and a leak by up to 3 times mismatch² · ρ n₋, which count as
    errors of their own.

    Parameters
    ----------
    tallies : recordings of still scenes.
    lux : illuminance of each, or None.
    """
    if not tallies:
        reason = not_identifiable("the rate of every recording changes (findings)")
        return LeakBalance(reason, [], reason, reason)
    rates = np.array([group_rates(one) for one in tallies])  # [recording, polarity, k]
    if lux is None:
        reason = not_identifiable("it takes the illuminances (--lux), or a moving target (--target)")
    elif len(set(lux)) < 3:
        reason = not_identifiable("it takes still scenes at three different lights, or a moving target (--target)")
    else:
        ratio = _three_lights(rates, np.asarray(lux, np.float64))
        error = float(np.hypot(jackknife(ratio), _RATIO_SHIFT * USUAL_MISMATCH**2 * ratio[0]))
        if np.isfinite(ratio).all() and 0 < 2 * error < ratio[0]:
            leak = rates[:, 0] - ratio * rates[:, 1]
            unknown = _LEAK_SHIFT * USUAL_MISMATCH**2 * ratio[0] * rates[:, 1, 0]
            return _with_ratio(leak, unknown, lux, estimated(ratio[0], error, "", GROUPS))
        reason = not_identifiable(
            "OFF events are too few, or follow the light as ON events do: noise and leak do not come apart"
        )
    leaks = [_leak_alone(one, reason["reason"]) for one in rates]
    few = np.array([leak["value"] is not None for leak in leaks])
    return LeakBalance(reason, leaks, *_line(rates[:, 0] - rates[:, 1], (_RATIO[1] - 1) * rates[:, 1, 0], few, lux))


def balance_with_target(
    tallies: Sequence[EventTally],
    lux: Sequence[float] | None,
    moving: EventTally,
    ratio: dict[str, Any],
    leak_hz: float,
) -> LeakBalance:
    """The same with a moving target, which tells each pixel's own ratio of the thresholds.

    There the levels are balanced as well: a pixel's ON events, less its leak, over its OFF events are its θ₋/θ₊. The
    leak of the target's light is not known. It is taken as `leak_hz`, and a tenth of its effect is an error of its own.

    Parameters
    ----------
    tallies, lux : as for `balance`.
    moving : recording of the target.
    ratio : θ₋/θ₊, mean over pixels, as an entry of the result.
    leak_hz : leak of a pixel while the target moved, Hz.
    """
    if not tallies:
        return balance(tallies, lux)._replace(ratio=ratio)
    on, off = moving.per_pixel().astype(np.float64)
    # pixels that the target passed over
    seen = (off > 0.25 * np.median(off[off > 0])) & moving.used
    # each pixel's ratio θ₋/θ₊: its levels are balanced over the recording
    own = np.where(seen, (on - leak_hz * moving.seconds) / np.maximum(off, 1.0), 0.0)
    group = moving.group.astype(np.int64)
    each = np.array([
        np.bincount(group, np.where(seen, (count[0] - own * count[1]) / one.seconds, 0.0), GROUPS)
        for one in tallies
        for count in (one.per_pixel().astype(np.float64),)
    ])  # fmt: skip
    pixels = np.bincount(group[seen], minlength=GROUPS)
    sums = np.concatenate([each.sum(axis=1, keepdims=True), each.sum(axis=1, keepdims=True) - each], axis=1)
    leak = sums / np.append(pixels.sum(), pixels.sum() - pixels)
    # the leak's part of that ratio, of which a tenth is not known
    share = abs(leak_hz) * moving.seconds * float(np.mean(1 / off[seen]))
    unknown = UNSURE_LEAK * share * np.array([group_rates(one)[1, 0] for one in tallies])
    return _with_ratio(leak, unknown, lux, ratio)


def _with_ratio(
    leak: NDArray[np.float64], unknown: NDArray[np.float64], lux: Sequence[float] | None, ratio: dict[str, Any]
) -> LeakBalance:
    errors = np.hypot(jackknife(leak), unknown)
    leaks = [estimated(one[0], float(error), "Hz", GROUPS) for one, error in zip(leak, errors, strict=True)]
    known = leak[:, 0] > -_BELOW_0 * errors
    for k in np.flatnonzero(~known):
        leaks[k] = not_identifiable(
            f"the levels do not balance: it would be {leak[k, 0]:.3g} Hz, and a leak makes ON events. The "
            "reference does not follow its events by whole thresholds, as where noise is fast beside the dead time"
        )
    return LeakBalance(ratio, leaks, *_line(leak, unknown, known, lux))


def _leak_alone(rates: NDArray[np.float64], why: str) -> dict[str, Any]:
    """Leak of a recording where the ratio of the thresholds is not known: where OFF events hardly matter."""
    on, off = rates[:, 0]
    error = float(jackknife(rates[0] - rates[1]))
    unknown = (_RATIO[1] - _RATIO[0]) / 2 * off
    if unknown > max(error, 0.01 * on):
        return not_identifiable(f"OFF events come at {off:.3g} Hz, and the ratio of the thresholds is not known: {why}")
    return estimated(on - off, float(np.hypot(error, unknown)), "Hz", GROUPS)


def _three_lights(rates: NDArray[np.float64], lux: NDArray[np.float64]) -> NDArray[np.float64]:
    """ρ [k] of n₊ = ρ n₋ + a + b L, by weighted least squares; errors are those of n₊ − ρ n₋ with the ρ before."""
    ratio = np.ones(GROUPS + 1)
    for _ in range(10):
        weight = 1 / np.maximum(jackknife(rates[:, 0] - np.clip(ratio[0], 0.05, 20.0) * rates[:, 1]), 1e-12)
        for k in range(GROUPS + 1):
            # columns n₋, 1 and L, each of length 1 for the test of the condition
            design = np.stack([rates[:, 1, k], np.ones(lux.size), lux], axis=1) * weight[:, None]
            size = np.linalg.norm(design, axis=0)
            if np.any(size == 0) or np.linalg.cond(design / size) > 1e6:
                return np.full(GROUPS + 1, np.nan)
            ratio[k] = np.linalg.lstsq(design / size, rates[:, 0, k] * weight, rcond=None)[0][0] / size[0]
    return ratio


def _line(
    leak: NDArray[np.float64], unknown: NDArray[np.float64], known: NDArray[np.bool_], lux: Sequence[float] | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Leak in the dark and its growth: a weighted line through the leaks [recording, k] that are known, each with an
    error [recording] that has nothing to do with the scatter of its pixels.
    """
    if lux is None:
        reason = not_identifiable("it takes the illuminances of the recordings (--lux)")
        return reason, reason
    level = np.asarray(lux, np.float64)[known]
    if np.unique(level).size < 2:
        at = "one light" if known.any() else "no light"
        reason = not_identifiable(f"the leak is known at {at}; two are needed")
        return reason, reason
    weight = 1 / np.maximum(np.hypot(jackknife(leak[known]), unknown[known]), 1e-12)
    # the line as a matrix on the leaks, so that errors go through it
    design = np.stack([np.ones(level.size), level], axis=1) * weight[:, None]
    size = np.linalg.norm(design, axis=0)
    line = np.linalg.pinv(design / size) / size[:, None] * weight
    coefficients = line @ leak[known]
    errors = np.hypot(jackknife(coefficients), np.sqrt(line**2 @ unknown[known] ** 2))
    dark, growth = (
        estimated(v[0], float(error), unit, GROUPS)
        for v, error, unit in zip(coefficients, errors, ("Hz", "Hz/lx"), strict=True)
    )
    return dark, growth


def share(count: int, of: int) -> dict[str, Any]:
    """Part of the pixels, with the interval of Clopper and Pearson."""
    low = stats.beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    part = count / of
    return {
        "value": part, "standard_error": float(np.sqrt(part * (1 - part) / of)),
        "interval_95": [float(low), float(high)], "unit": "", "note": f"{count} of {of} pixels",
    }  # fmt: skip


def hot_pixels(tallies: Sequence[EventTally]) -> NDArray[np.bool_]:
    """Pixels [pixel] with many more ON events than the others, in each recording that can show it.

    Where the others are so busy that a pixel of that rate would not stand out, it has half of that rate at least.
    """
    counts = np.array([one.per_pixel()[0] for one in tallies])
    seconds = np.array([one.seconds for one in tallies])[:, None]
    # mean of the lower nine tenths, which hot pixels do not change
    lower = np.sort(counts, axis=1)[:, : max(1, round(0.9 * counts.shape[1]))]
    usual = lower.mean(axis=1, keepdims=True) + 1 / counts.shape[1]
    limit = stats.poisson.isf(_HOT_CHANCE / counts.shape[1], _HOT * usual)
    stands_out = counts > limit
    rate_hz = counts / seconds
    least_hz = np.where(stands_out, rate_hz, np.inf).min(axis=0)
    masked = (least_hz * seconds <= limit) & (rate_hz >= 0.5 * least_hz)
    return np.asarray(stands_out.any(axis=0) & np.all(stands_out | masked, axis=0))


def hot_share(tallies: Sequence[EventTally]) -> dict[str, Any]:
    """Part of the pixels with many more ON events than the others, in each recording."""
    if len(tallies) < 2:
        return not_identifiable(
            "it takes two recordings: in one, a pixel that sees a change looks like a hot one; "
            f"{_lonely(tallies[0])} pixels have more than ten times the ON events of each pixel beside them"
        )
    hot = hot_pixels(tallies)
    return share(int(np.count_nonzero(hot)), hot.size)


def _lonely(tally: EventTally) -> int:
    """Pixels of ten ON events or more that have more than `_HOT` times those of each of their neighbours."""
    on = tally.per_pixel()[0].reshape(tally.shape)
    beside = np.ones((3, 3), np.bool_)
    beside[1, 1] = False
    return int(np.count_nonzero((on >= _LONELY) & (on > _HOT * maximum_filter(on, footprint=beside, mode="constant"))))


def silent_share(tallies: Sequence[EventTally]) -> dict[str, Any]:
    """Part of the pixels without an event in any recording."""
    total = np.sum([one.per_pixel().sum(axis=0) for one in tallies], axis=0)
    median = float(np.median(total))
    if median < _EVENTS_TO_BE_SILENT:
        return not_identifiable(
            f"half of the pixels have {median:g} events at most, so that one may have none by chance; "
            f"{_EVENTS_TO_BE_SILENT} are needed: record longer"
        )
    return share(int(np.count_nonzero(total == 0)), total.size)

"""Thresholds and their spread from a recording of a target of known contrast that moves through the picture.

Each pixel sees its light rise and fall by Δ = ln(bright/dark) again and again. Its reference follows in steps of its
own thresholds. It turns back up to a threshold before the light does, so that its ON events in a cycle are fewer than
Δ/θ₊ by a number that depends on where it turns. The counts of pixels with given thresholds are therefore simulated, and
θ₊, θ₋ and their spread are those whose mean counts and scatter over pixels are the measured ones. The light must change
slowly enough for the pixels, and noise must be small against the thresholds. Where the light rests at its top and its
bottom, noise carries the level further than the light; by how much is read from late events (`rests`).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.ndimage import uniform_filter

from hesim_render.calibrate.estimate import Z_95, estimated, not_identifiable
from hesim_render.calibrate.recordings.ramps import jitter
from hesim_render.calibrate.recordings.rests import overshoots, quantile_us, rests
from hesim_render.calibrate.recordings.still import UNSURE_LEAK, jackknife
from hesim_render.calibrate.recordings.tally import GROUPS, EventTally
from hesim_render.calibrate.recordings.tally import tally as tally_of
from hesim_render.core.units import US_PER_S
from hesim_render.exchange.stream import EventStream

#: Simulated pixels, cycles before their counts begin, and most cycles that are simulated.
_PIXELS, _WARM, _MOST_CYCLES = 8192, 4, 60
#: Cycles, and ON and OFF events a cycle, that are needed.
_LEAST_CYCLES, _LEAST_EVENTS = 3, 1.5
#: Relative error of the variance of the thresholds, by noise at the rests, or by pixels that see nearly the whole
#: contrast. They lie beside those that see less: without rests it is as large where so many of the pixels are left out,
#: smaller in proportion below. Of stars and checkerboards written in NumPy 16 to 40 of 100 are, where all pixels see
#: the same 0 to 3. In noise the variance scatters by 1.5 times as much as its other errors say.
_PARTIAL, _LEFT_OUT = 0.06, 0.03
#: Relative difference of the rests of pixels that are taken together; most deviations of a pixel's counts, of those
#: above the median, and the times that pixels beyond are taken out. Chosen on stars and checkerboards written in NumPy,
#: judged on those of the tests, on their six sensors and on a hundred more, which have seeds of their own.
_SAME_REST, _FAR, _CUTS = 0.15, 3.0, 6


class TargetThresholds(NamedTuple):
    """Figures of a moving target.

    Parameters
    ----------
    entries : ``theta_on``, ``theta_off`` (ln units) and ``threshold_mismatch_rel``, as entries of the result.
    ratio : ρ = θ₋/θ₊, as an entry of the result.
    """

    entries: dict[str, dict[str, Any]]
    ratio: dict[str, Any]


def thresholds(tally: EventTally, contrast: float, cycles_hz: float | None, leak_hz: float) -> TargetThresholds:
    """θ₊, θ₋ and their relative mismatch over pixels, each with its interval, a jackknife over groups of pixels.

    Parameters
    ----------
    tally : of the recording.
    contrast : bright over dark light of the target.
    cycles_hz : bright–dark cycles of a pixel per second; None: read from the times between its turns to ON events.
    leak_hz : leak while the target moved, Hz: half of it is in the ON events of the rise, half missing in the fall.
    """
    count = tally.per_pixel().astype(np.float64)
    seen = seen_alike(tally)
    if np.count_nonzero(seen) < 2 * GROUPS:
        return unknown(f"{np.count_nonzero(seen)} pixels have events of both polarities; {2 * GROUPS} are needed")
    period_s = 1 / cycles_hz if cycles_hz is not None else tally.period_s()
    if period_s is None:
        return unknown(
            "no steady period is seen in the times between a pixel's turns from OFF to ON events: no target passes, "
            "its speed changes, or noise is too strong"
        )
    cycles = tally.seconds / period_s
    count = count[:, seen]
    means = count.mean(axis=1)
    count = count / cycles
    if cycles < _LEAST_CYCLES or count.mean(axis=1).min() < _LEAST_EVENTS:
        return unknown(
            f"a pixel sees {cycles:.3g} cycles of the target, with {count.mean(axis=1).min():.3g} "
            f"events of a polarity in each; {_LEAST_CYCLES} cycles of {_LEAST_EVENTS} events are needed"
        )
    ratio = max(means[0] - leak_hz * tally.seconds, 1.0) / means[1]
    course = _course(tally, leak_hz, period_s, ratio)
    unsure = course.unsure * np.array([1.0, 1 / ratio]) / count.mean(axis=1)
    rise = float(np.log(contrast))
    simulated = _Simulated(rise, round(min(cycles, _MOST_CYCLES)), course)
    group = tally.group.astype(np.int64)[seen]
    whole = _moments(count)
    parts = np.array([_moments(count[:, group != k]) for k in range(GROUPS)])
    fitted, slope = simulated.fit(whole)
    every = np.concatenate([fitted[:, None], fitted[:, None] + np.linalg.solve(slope, (parts - whole).T)], axis=1)
    # the simulated pixels scatter as the real ones do
    of_simulated = simulated.moment_covariance(fitted)
    inverse = np.linalg.inv(slope)
    of_simulated = inverse @ of_simulated @ inverse.T
    # the swing of the level is that of the light and both overshoots, of which one bandwidth is not known
    swing = rise + course.top.mean() * fitted[0] + course.bottom.mean() * fitted[1]
    one, other = (course.ends * fitted[:2]).T
    over = np.sqrt(one**2 + other**2 + 2 * course.alike * one * other) / swing
    left_out = 1 - np.count_nonzero(seen) / np.count_nonzero(tally.used & (tally.per_pixel().min(axis=0) > 0))
    partial = _PARTIAL if course.ends.any() else _PARTIAL * min(left_out / _LEFT_OUT, 1.0)
    beside = fitted * np.append(unsure, partial)
    errors = np.sqrt(jackknife(every) ** 2 + np.diag(of_simulated) + beside**2)
    if not np.all(np.isfinite([fitted, errors])):
        return unknown("no thresholds give the counts of this target: its contrast is another, or noise is too strong")
    entries = {
        name: _widened(estimated(value, error, "ln", GROUPS), over)
        for name, value, error in zip(("theta_on", "theta_off"), fitted[:2], errors[:2], strict=True)
    }
    if fitted[2] > 2 * errors[2]:
        spread = float(np.sqrt(fitted[2]))
        entries["threshold_mismatch_rel"] = estimated(spread, errors[2] / (2 * spread), "relative std", GROUPS)
    else:
        entries["threshold_mismatch_rel"] = {
            "value": 0.0, "upper_limit": float(np.sqrt(max(fitted[2], 0.0) + 2 * errors[2])),
            "note": "the pixels scatter no more than the place of their turns makes them",
        }  # fmt: skip
    ratios = every[1] / every[0]
    away = np.array([-1 / fitted[0], 1 / fitted[1], 0.0])  # slope of ln ρ
    error = float(np.sqrt(jackknife(ratios) ** 2 + ratios[0] ** 2 * (unsure.sum() ** 2 + away @ of_simulated @ away)))
    return TargetThresholds(entries, estimated(ratios[0], error, "", GROUPS))


def _widened(entry: dict[str, Any], over: NDArray[np.float64]) -> dict[str, Any]:
    """An estimate with an interval that also holds what is not known of the overshoots, relative, down and up."""
    if entry["value"] is None:
        return entry
    value, own = entry["value"], entry["standard_error"]
    half = entry["interval_95"][1] - value
    below, above = (float(end) for end in np.hypot(half, over * value))
    # as many standard errors in half of the interval as without the overshoots
    error = 0.5 * (below + above) / (half / own if own > 0 else Z_95)
    return {**entry, "standard_error": error, "interval_95": [value - below, value + above]}


class _Course(NamedTuple):
    """What the level of a pixel does beside the light, in thresholds: θ₊ at the top, θ₋ at the bottom.

    Parameters
    ----------
    top, bottom : overshoot of the level at each rest, [pixel].
    drifts : of the reference from the begin of the top to that of the bottom, and on to the next top, in θ₊.
    unsure : what is not known of the drift, in θ₊ a cycle.
    ends : how far the interval of the mean of each overshoot goes down and up from it, [2, top and bottom].
    alike : correlation of what is not known of both overshoots.
    """

    top: NDArray[np.float64]
    bottom: NDArray[np.float64]
    drifts: tuple[float, float]
    unsure: float
    ends: NDArray[np.float64]
    alike: float


def _course(tally: EventTally, leak_hz: float, period_s: float, ratio: float) -> _Course:
    """Overshoots by what comes late at the rests of the light; light without rests turns without any."""
    both = rests(tally, leak_hz, ratio)
    of_ramps = None if both is None else jitter(tally)
    if both is None or (of_ramps is None and not all(rest.late.size for rest in both)):
        none, half = np.zeros(_PIXELS), 0.5 * leak_hz * period_s
        return _Course(none, none, (half, half), UNSURE_LEAK * half, np.zeros((2, 2)), 0.0)
    top, bottom, alike = overshoots(*both, _PIXELS, of_ramps, ratio)
    ramp_s = 0.5 * max(period_s - both[0].ramps.rest_s - both[1].ramps.rest_s, 0.0)
    leaks = top.drift, -bottom.drift * ratio
    ramp_leak_hz = 0.5 * (leaks[0] + leaks[1])
    drifts = [own * rest.ramps.rest_s + ramp_leak_hz * ramp_s for own, rest in zip(leaks, both, strict=True)]
    lasting = [rest.ramps.rest_s + ramp_s for rest in both]  # of each leak: half of either ramp has it
    unsure = 0.5 * (top.drift_error * lasting[0] + bottom.drift_error * ratio * lasting[1])
    ends = np.array([[one.mean - one.low, one.high - one.mean] for one in (top, bottom)]).T
    return _Course(top.quantiles, bottom.quantiles, (drifts[0], drifts[1]), unsure, ends, alike)


def of_whole_cycles(stream: EventStream, first: EventTally, cycles_hz: float | None) -> EventTally:
    """The tally of a target's whole cycles, in which every pixel sees as many rises as falls, wherever it begins; with
    the times of those pixels alone that see the same light.

    Parameters
    ----------
    stream, first : recording of the target, and its tally.
    cycles_hz : see `thresholds`.
    """
    period_s = 1 / cycles_hz if cycles_hz is not None else first.period_s()
    if period_s is None or first.seconds < period_s:
        return first
    end_us = first.begin_us + round(np.floor(first.seconds / period_s) * period_s * US_PER_S)
    return tally_of(replace(stream, interval_us=(first.begin_us, end_us)), seen_alike(first))


def seen_alike(tally: EventTally) -> NDArray[np.bool_]:
    """Pixels [pixel] that see the whole contrast of the target, and rests as long as others do.

    At the corners of a checkerboard and in the middle of a star the lens mixes bright and dark parts.
    """
    count = tally.per_pixel().astype(np.float64)
    both = np.where(tally.used, count.min(axis=0), 0.0)
    seen = both > 0.25 * np.median(both[both > 0]) if both.any() else np.zeros(both.size, np.bool_)
    interval_us = max(quantile_us(same.sum(axis=0)) for same in tally.same)
    for own in tally.gap_us if seen.any() else ():
        middle = np.median(own[seen])
        seen = seen & (np.abs(own - middle) <= max(_SAME_REST * middle, 2 * interval_us))
    return _regular(count, _regular(count, seen), tally.shape)


def _regular(
    count: NDArray[np.float64], seen: NDArray[np.bool_], shape: tuple[int, int] | None = None
) -> NDArray[np.bool_]:
    """Pixels of `seen` whose counts [polarity, pixel] are no farther from their median than those above it allow.

    With the shape of the sensor, means of 3×3 pixels are compared in place of single ones: thresholds differ from pixel
    to pixel, while those that see less of the target lie together.
    """
    for _ in range(_CUTS if np.count_nonzero(seen) > 2 * GROUPS else 0):
        middle = np.median(count[:, seen], axis=1, keepdims=True)
        share = (count / np.maximum(middle, 1e-300)).mean(axis=0)
        least = 1 / max(float(middle.min()), 1e-300)
        if shape is not None:
            share, least = uniform_filter(share.reshape(shape), 3, mode="nearest").ravel(), least / 9
        half, upper = np.quantile(share[seen], (0.5, 0.84))
        seen = seen & (np.abs(share - half) <= _FAR * max(upper - half, least))
    return seen


def unknown(reason: str) -> TargetThresholds:
    """Figures of a target that tells none, with the reason."""
    entry = not_identifiable(reason)
    return TargetThresholds(dict.fromkeys(("theta_on", "theta_off", "threshold_mismatch_rel"), entry), entry)


def _moments(count: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean ON and OFF events a cycle, and the relative variance over pixels, mean of both polarities."""
    mean = count.mean(axis=1)
    return np.array([*mean, np.mean(count.var(axis=1, ddof=1) / mean**2)])


class _Simulated:
    """Counts of pixels whose light rises and falls by `rise`, ln units, and rests in between.

    Parameters
    ----------
    rise : logarithm of the contrast.
    cycles : that are counted.
    course : rests, overshoots and drift.
    """

    def __init__(self, rise: float, cycles: int, course: _Course) -> None:
        self._rise, self._cycles, self._course = rise, cycles, course
        rng = np.random.default_rng(1)
        # even steps of each law in random order: a sample would have a mean of its own
        place = (np.arange(_PIXELS) + 0.5) / _PIXELS
        self._z = np.array([special.ndtri(rng.permutation(place)) for _ in range(2)])
        self._start = rng.permutation(place)
        self._over = [[rng.permutation(one) for _ in range(_WARM + cycles)] for one in (course.top, course.bottom)]

    def moments(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """`_moments` of θ₊, θ₋ and the variance of the relative mismatch."""
        return _moments(self._counts(values))

    def moment_covariance(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of `moments` from sample to sample of the simulated pixels."""
        count = self._counts(values)
        group = np.arange(count.shape[1]) % GROUPS
        parts = np.array([_moments(count[:, group == k]) for k in range(GROUPS)])
        return np.asarray(np.cov(parts.T)) / GROUPS

    def _counts(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """ON and OFF events a cycle of simulated pixels, but for those that would be left out of a recording."""
        spread = np.sqrt(max(values[2], 0.0))
        theta = np.maximum(values[:2, None] * (1 + spread * self._z), 0.05 * values[:2, None])
        reference, count = self._start * self._rise, np.zeros((2, _PIXELS))
        to_bottom, to_top = (values[0] * part for part in self._course.drifts)
        for cycle in range(_WARM + self._cycles):
            top, bottom = (self._over[k][cycle] * values[k] for k in range(2))
            up = np.maximum(np.floor((self._rise + top - reference) / theta[0] + 1e-9), 0.0)
            reference = reference + up * theta[0] - to_bottom
            down = np.maximum(np.floor((reference + bottom) / theta[1] + 1e-9), 0.0)
            reference = reference - down * theta[1] - to_top
            if cycle >= _WARM:
                count += np.stack([up, down])
        return count[:, _regular(count, np.ones(_PIXELS, np.bool_))] / self._cycles

    def fit(self, wanted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values of the given moments, and the slope of the moments there, over 5 %: counts are whole."""
        swing = self._rise / (1 + 0.5 * np.sum(1 / wanted[:2]))
        values = np.array([swing / wanted[0], swing / wanted[1], max(wanted[2], 1e-4)])
        slope = np.eye(3)
        for _ in range(8):
            slope = self._slope(values)
            step = np.linalg.solve(slope, wanted - self.moments(values))
            bound = np.array([0.3 * values[0], 0.3 * values[1], max(0.5 * values[2], 2e-3)])
            values = values + np.clip(step, -bound, bound)
            values[2] = max(values[2], -1e-2)
        return values, slope

    def _slope(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = []
        for k, wide in enumerate((0.05 * values[0], 0.05 * values[1], max(0.3 * values[2], 1e-3))):
            away = np.zeros(3)
            away[k] = wide
            low = values - away if k < 2 or values[2] > wide else values
            columns.append((self.moments(values + away) - self.moments(low)) / ((values + away)[k] - low[k]))
        return np.stack(columns, axis=1)

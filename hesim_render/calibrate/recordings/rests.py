"""Noise at the rests of a moving target's light: by how much it lets the level of a pixel swing further than the light.

While the light rests at its top, the noise goes on, and the reference follows its highest level: now and then an ON
event comes late, long after the light has come to its top. From top to bottom the level swings by the light's contrast
and by both overshoots. The light is taken to rise, rest, fall and rest in straight lines; with σ the noise, the level
n + δ t, δ its drift by the leak, is at most u until the time t with the chance::

    F(u, t) = Φ(u/σ) · exp(−crossings of u until t)

The expected crossings are those of Gaussian noise through two equal poles [rice1945], which has been below before.
With θ the threshold, late events come at the rate d/dt (mean highest level)/θ. How many come how late tells σ/θ, and
the bandwidth in part.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.calibrate.recordings.ramps import Jitter, likelihoods
from hesim_render.calibrate.recordings.tally import STEPS_PER_OCTAVE, EventTally
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.evs.formulas import POLE

#: Levels over σ at which the law of the highest level is known.
_LEVELS = np.linspace(-5.0, 8.0, 131)
#: Noise over the threshold, and corners of the noise in Hz, among which the likelihood decides.
_NOISE, _CUTOFF_HZ = np.geomspace(2e-3, 0.7, 60), np.geomspace(20.0, 2000.0, 33)
#: Leak at a rest over that of the still scenes, whose light may be another, and the deviation of its logarithm: 0.5 to
#: 0.6 where any part of it grows with the light, and the still scenes have any light of the target.
_LEAK, _LEAK_DEVIATION = np.array([0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0, 5.5]), 0.6
#: Relative error of the law of late events, given the bandwidth: measured on 17 rests of nine sensors written in NumPy,
#: without a leak and with poles of the noise 1 to 7 apart (6 % rms with equal ones, 2 % with others, 5 % together,
#: errors of counting taken off); judged on the hundred of the tests, which have seeds of their own.
_LAW_ERROR = 0.05
#: Late events in the last half of a rest over those of the quarter before, above which events back are among them.
#: Chosen on sensors like the six of the tests, judged there on seeds of their own.
_STRONG = 1.4
#: First late events that count: at this part of the rest, and after so many intervals of the ramp.
_EARLY, _INTERVALS = 1 / 64, 4.0
#: Part of the pixels whose rest may begin later than late events count.
_LATEST = 0.05
#: Late events in the first factor of two over those of the second, above which those of ramps are among them. Chosen on
#: stars and checkerboards written in NumPy, judged on those of the tests, which have seeds of their own.
_OF_RAMPS = 2.0
#: Late events of light that comes to its rest slowly, as behind a lens: parts of the first count that may be of it, by
#: what they fall from one factor of two of the time to the next. That there are none is taken to be as likely as all of
#: these together. Chosen on targets with a blur that is a Gaussian, judged on others.
_OF_TAIL, _TAIL_FALLS = np.arange(0.1, 0.95, 0.1), (2.0, 4.0)
#: A rest shorter than this part of the period is none.
_LEAST_REST = 0.1
#: Gaps above the median differ by this much at most, where all pixels see the same rests.
_SAME_RESTS = 0.2
#: Crossings of a level by noise that has stayed below it, over a mean velocity of 1: the density of the noise over its
#: chance to be below, times the share of them that come alone. That share was counted on simulated noise.
_GRID = np.linspace(-40.0, 10.0, 2001)
_RATE = np.exp(-0.5 * _GRID**2 - special.log_ndtr(_GRID)) / np.sqrt(2 * np.pi) * np.interp(
    _GRID, [-1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 5.0], [1.12, 1.035, 0.98, 0.92, 0.88, 0.87, 0.9, 1.0]
)  # fmt: skip
#: Their integral from the lowest level of `_GRID`.
_CROSSED = np.append(0.0, np.cumsum(0.5 * (_RATE[1:] + _RATE[:-1]) * np.diff(_GRID)))


class Ramps(NamedTuple):
    """How the level leaves and reaches a rest: its slopes, its drift and the length of the rest, in thresholds and s.

    Parameters
    ----------
    slopes : before and after the rest, thresholds/s, both positive.
    drift : away from the middle of the swing, thresholds/s.
    rest_s : length of the rest.
    """

    slopes: tuple[float, float]
    drift: float
    rest_s: float

    def leaking(self, part: float) -> "Ramps":
        """The same with a drift so many times as large."""
        return self._replace(drift=part * self.drift)


class Rest(NamedTuple):
    """One rest of the light, top or bottom.

    Parameters
    ----------
    ramps : of it.
    edges_s : times since its begin between which late events are counted; its end alone where none can be.
    late, of : late events between these times, and all visits of pixels.
    scatter : variance of late events over groups of pixels, over their mean; 1 at least.
    is_noisy : noise brings events back at this rest.
    """

    ramps: Ramps
    edges_s: NDArray[np.float64]
    late: NDArray[np.float64]
    of: float
    scatter: float
    is_noisy: bool


class Overshoot(NamedTuple):
    """Law of the highest level over the light's, in thresholds.

    Parameters
    ----------
    mean : median over what is not known.
    low, high : interval of 95 % of the mean, by what is not known.
    drift, drift_error : by the leak, mean and deviation over what is not known, thresholds/s.
    quantiles : of the highest level of a visit, at even places of its chance.
    """

    mean: float
    low: float
    high: float
    drift: float
    drift_error: float
    quantiles: NDArray[np.float64]


def _faster(x: NDArray) -> NDArray[np.float64]:
    """Mean of the positive part of a normal deviate plus x."""
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi) + x * special.ndtr(x))


def _crossed(level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral of the crossings (`_RATE`) up to a level, in units of the noise."""
    return np.asarray(np.interp(level, _GRID, _CROSSED))


def highest(noise: NDArray, cutoff_hz: NDArray, ramps: Ramps, times_s: NDArray, is_over: bool) -> NDArray[np.float64]:
    """Chance that the level has stayed below each of `_LEVELS`, in units of the noise: [..., time, level].

    Parameters
    ----------
    noise : σ in thresholds, [...].
    cutoff_hz : corner of the noise, [...].
    ramps : of the rest.
    times_s : since the begin of the rest, [time].
    is_over : the level has left the rest as well.
    """
    sigma, pole = (np.asarray(v, np.float64)[..., None, None] for v in (noise, cutoff_hz * POLE))
    t, u = np.asarray(times_s, np.float64)[:, None], _LEVELS
    drift = ramps.drift / sigma
    small = np.abs(drift * t) < 1e-3
    far = np.where(small, 1e-3, drift * t)
    along = np.where(small, np.interp(u, _GRID, _RATE), _crossed(u) - _crossed(u - far)) / np.where(small, 1.0, far)
    crossings = pole * _faster(drift / pole) * t * along
    before, after = (slope / sigma for slope in ramps.slopes)
    beyond = _CROSSED[-1]
    crossings = crossings + pole / before * _faster(-before / pole) * (beyond - _crossed(u))
    if is_over:
        end = np.where(small, 0.0, far)
        crossings = crossings + pole / after * _faster(-after / pole) * (beyond - _crossed(u - end))
    return np.asarray(special.ndtr(u) * np.exp(-crossings))


def _mean(chance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of a law [..., level] in units of the noise."""
    return np.asarray(_LEVELS[-1] - np.trapezoid(chance, _LEVELS, axis=-1))


def quantile_us(counts: NDArray, part: float = 0.5) -> float:
    """Place of a quantile in a histogram of times with even logarithmic steps, µs; 0 without any."""
    if counts.sum() == 0:
        return 0.0
    below = np.append(0.0, np.cumsum(counts))
    return float(2.0 ** (np.interp(part * below[-1], below, np.arange(below.size)) / STEPS_PER_OCTAVE))


def rests(tally: EventTally, leak_hz: float, ratio: float) -> tuple[Rest, Rest] | None:
    """The rests at the top and at the bottom of the light; None where it has none, or not the same for all pixels.

    A rest that is too short for late events has none of them, in no time.

    Parameters
    ----------
    tally : of the target.
    leak_hz : leak while it moved, thresholds of ON events per second.
    ratio : θ₋/θ₊.
    """
    interval_s = [quantile_us(tally.same.sum(axis=1)[k]) * S_PER_US for k in range(2)]
    period_s = tally.period_s()
    result, is_noisy = [], False
    for k, own in enumerate((ratio, 1 / ratio)):
        gaps = tally.gaps[k]
        whole = gaps.sum(axis=0)
        if whole.sum() < 1000 or period_s is None or not all(interval_s):
            return None
        middle_s, upper_s = (quantile_us(whole, part) * S_PER_US for part in (0.5, 0.85))
        up_s, down_s = interval_s[k], interval_s[1 - k]
        # the last event comes half an interval before the top; half a threshold of its own and one of the other
        # polarity lie between it and the first event of the fall
        rest_s = middle_s - 0.5 * up_s - (0.5 / own + 1) * down_s
        spread_s = up_s + down_s / own
        if rest_s < _LEAST_REST * period_s or upper_s - middle_s > _SAME_RESTS * middle_s + spread_s:
            return None
        first_s = max(_EARLY * rest_s, _INTERVALS * max(up_s, down_s), _later_s(tally, k))
        octaves = np.arange(np.floor(np.log2(rest_s / first_s)), -1, -1)
        edges_s = np.asarray(rest_s / 2.0**octaves, np.float64)
        drift = leak_hz if k == 0 else -leak_hz / ratio
        ramps = Ramps((1 / up_s, own / down_s), drift, rest_s)
        if edges_s.size < 2:  # too short beside the intervals of the ramp
            result.append(Rest(ramps, np.array([rest_s]), np.empty(0), float(whole.sum()), 1.0, False))
            continue
        # times before the fall, as edges of the histogram; a late event is at its level, so that a threshold of the
        # other polarity lies between it and the first event of the fall
        end_s = rest_s + down_s
        cuts = np.round(np.log2(np.maximum(end_s - edges_s, S_PER_US) / S_PER_US) * STEPS_PER_OCTAVE).astype(np.int64)
        cuts[-1] = 0
        edges_s[:-1] = end_s - 2.0 ** (cuts[:-1] / STEPS_PER_OCTAVE) * S_PER_US
        below = np.concatenate([np.zeros((gaps.shape[0], 1)), np.cumsum(gaps, axis=1)], axis=1)[:, cuts]
        late: NDArray[np.float64] = -np.diff(below, axis=1)
        # noise makes about as many in each factor of two: many more in the first one are of pixels that rest later
        first, second = late.sum(axis=0)[:2] if edges_s.size > 2 else (0.0, 0.0)
        if first > _OF_RAMPS * second + 3 * np.sqrt(first):
            edges_s, late = edges_s[1:], late[:, 1:]
        each = late.sum(axis=1)
        scatter = each.var(ddof=1) / each.mean() if each.mean() > 1 else 1.0
        # noise makes as many late events in each factor of two of the time, the leak as many in each second
        by_leak = _LEAK[-1] * max(drift, 0.0) * np.diff(edges_s) * whole.sum()
        before, last = (late.sum(axis=0) - by_leak)[-2:] if edges_s.size > 2 else (np.inf, 0.0)
        is_noisy = is_noisy or bool(last > _STRONG * before + 3 * np.sqrt(late[:, -2:].sum()))
        of_groups = max(float(scatter), 1.0)
        result.append(Rest(ramps, edges_s, late.sum(axis=0, dtype=np.float64), float(whole.sum()), of_groups, False))
    return result[0]._replace(is_noisy=is_noisy), result[1]._replace(is_noisy=is_noisy)


def _later_s(tally: EventTally, polarity: int) -> float:
    """By how much the rest of pixels begins later than that of most: what comes until then may be of the ramp, s."""
    if tally.only is None:
        return 0.0
    own_us = tally.gap_us[polarity][tally.only]
    return float(np.median(own_us) - np.quantile(own_us, _LATEST)) * S_PER_US


def _leaks(rest: Rest) -> NDArray[np.float64]:
    """Leaks among which the likelihood decides, over that of the still scenes."""
    return np.ones(1) if rest.ramps.drift == 0 else _LEAK


def overshoots(
    top: Rest, bottom: Rest, places: int, of_ramps: Jitter | None = None, ratio: float = 1.0
) -> tuple[Overshoot, Overshoot, float]:
    """Highest levels at both rests, by the posterior of their noise and of their common bandwidth, and the correlation
    of what is not known of them.

    The priors of the logarithms are flat, but for the leak. Late events scatter more than at random, as the same pixels
    have them again.

    Parameters
    ----------
    top, bottom : rests.
    places : of the quantiles of the law.
    of_ramps : scatter of the events in the ramps, which has the bandwidth in it; None: late events alone.
    ratio : θ₋/θ₊.
    """
    parts = [_posterior(rest) for rest in (top, bottom)]
    late = [special.logsumexp(log, axis=0) for log, _ in parts]
    *others, own = likelihoods(late[0], late[1], _NOISE, _CUTOFF_HZ, of_ramps, ratio)
    both = own + late[0][:, :, None] + late[1][:, None, :]
    both = np.exp(both - special.logsumexp(both))  # [cut-off, noise at the top, at the bottom]
    result, middles, variances, parted = [], [], [], []
    for k, (rest, (log, mean), other) in enumerate(zip((top, bottom), parts, others, strict=True)):
        weight = log + other  # [leak, cut-off, noise]
        weight = np.exp(weight - special.logsumexp(weight))
        middle = float(np.sum(weight * mean))
        middles.append(middle)
        # with the error of the law, which both have
        variances.append(float(np.sum(weight * (mean - middle) ** 2)) + (_LAW_ERROR * middle) ** 2)
        parted.append(np.sum(np.exp(log - late[k]) * mean, axis=0) - middle)
        order = np.argsort(mean, axis=None)
        below = np.cumsum(weight.ravel()[order])
        low, value, high = (float(v) for v in np.interp([0.025, 0.5, 0.975], below, mean.ravel()[order]))
        low, high = (value + sign * float(np.hypot(end - value, 2 * _LAW_ERROR * value))
                     for sign, end in ((-1, low), (1, high)))  # fmt: skip
        # the law of likely values whose mean is nearest
        likely = weight > 1e-3 * weight.max()
        near = np.unravel_index(np.argmin(np.where(likely, np.abs(mean - value), np.inf)), mean.shape)
        noise, ramps = _NOISE[near[2]], rest.ramps.leaking(float(_leaks(rest)[near[0]]))
        law = highest(noise, _CUTOFF_HZ[near[1]], ramps, np.array([ramps.rest_s]), True)[0]
        law = np.maximum.accumulate(law)
        quantiles = noise * np.interp((np.arange(places) + 0.5) / places, law / law[-1], _LEVELS)
        if rest.is_noisy:
            low, high = 0.0, max(high, 2 * value)
        of_leak, leaks = weight.sum(axis=(1, 2)), _leaks(rest) * rest.ramps.drift
        drift = float(of_leak @ leaks)
        spread = float(np.sqrt(of_leak @ (leaks - drift) ** 2))
        result.append(Overshoot(value, low, high, drift, spread, quantiles + value - quantiles.mean()))
    common = float(np.einsum("cij,ci,cj", both, *parted)) + _LAW_ERROR**2 * middles[0] * middles[1]
    alike = 1.0 if top.is_noisy else common / np.sqrt(variances[0] * variances[1])
    return result[0], result[1], float(alike)


def _posterior(rest: Rest) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Logarithm of the likelihood, and mean overshoot in thresholds, over leaks, cut-offs and noise.

    Where the noise is strong, an event back may come before the fall, which moves late events to later times. There
    their number alone is taken.
    """
    noise, corner = np.meshgrid(_NOISE, _CUTOFF_HZ)
    of_leak = []
    for leak in _leaks(rest):
        ramps = rest.ramps.leaking(leak)
        begins = _mean(highest(noise, corner, ramps, rest.edges_s[:-1], False))
        end = _mean(highest(noise, corner, ramps, rest.edges_s[-1:], True))
        of_leak.append(np.concatenate([begins, end], axis=-1))
    levels = noise[..., None] * np.array(of_leak)
    expected = np.maximum(np.diff(levels, axis=-1) * rest.of, 1e-9)
    mean = levels[..., -1]

    def log_chance(late: NDArray, expected: NDArray) -> NDArray[np.float64]:
        return np.asarray(np.sum(special.xlogy(late, expected) - expected, axis=-1) / rest.scatter)

    own = -0.5 * (np.log(_leaks(rest)) / _LEAK_DEVIATION)[:, None, None] ** 2
    if rest.is_noisy:
        return own + log_chance(rest.late.sum(keepdims=True), expected.sum(axis=-1, keepdims=True)), mean
    tails = _tails(rest.late) if rest.late.size else []
    chances = [log_chance(rest.late, expected)]
    chances += [log_chance(rest.late, expected + tail) - np.log(len(tails)) for tail in tails]
    return own + special.logsumexp(chances, axis=0), mean


def _tails(late: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Late events of light that comes to its rest slowly, as they may be among these, each [time]."""
    steps = np.arange(late.size)
    return [part * late[0] * falls**-steps for falls in _TAIL_FALLS for part in _OF_TAIL]

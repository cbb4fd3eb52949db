"""Bandwidth of event pixels, and thresholds from counts of events, both in modulated light."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.still import jackknife
from hesim_render.calibrate.recordings.tally import GROUPS
from hesim_render.core.guard import require_memory
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.report.bench import EventBench
from hesim_render.report.estimates import crossing, log_estimated
from hesim_render.specs.event_bench import Modulation

#: Cycles of a modulation before those that are counted.
_WARM_CYCLES = 2
#: Events in a cycle from which they are counted: with fewer, equal thresholds round the counts of all pixels alike.
#: Largest ratio of the smaller to the larger of two swings.
_LEAST_EVENTS, _SWINGS_APART = 6.0, 0.8
#: Largest part of the events that a dead time may swallow.
_MOST_SWALLOWED = 0.1
_SWALLOWED = "the dead time swallows more than a tenth of the events: take a lower frequency"


@dataclass(frozen=True, eq=False)
class Bandwidth:
    """Swing of the light that a pixel answers in half of the cycles or bursts, against frequency.

    Parameters
    ----------
    lux : mean light.
    in_bursts : the light was modulated in bursts, and an event of either polarity is an answer; otherwise an ON event.
    hz, swing : [frequency], swing ln(L_max/L_min); NaN where no swing of the captures does.
    entry : bandwidth, as an entry of the report.
    pixels : number of pixels.
    """

    lux: float
    in_bursts: bool
    hz: NDArray[np.float64]
    swing: NDArray[np.float64]
    entry: dict[str, Any]
    pixels: int


def bandwidth(bench: EventBench, good: NDArray[np.bool_]) -> Bandwidth | None:
    """Bandwidth from modulated light; None without such recordings.

    The errors are those of a jackknife over groups of pixels, through all steps.
    """
    every = bench.spec.modulation
    if not every:
        return None
    kinds = [(one.lux, one.bursts is not None) for one in every]
    lux, in_bursts = max(sorted(set(kinds)), key=kinds.count)
    used = [one for one, kind in zip(every, kinds, strict=True) if kind == (lux, in_bursts)]
    hz = np.array(sorted({one.hz for one in used}))
    shares = [[(_swing(one), _answered(bench, one, good)) for one in used if one.hz == f] for f in hz]
    swings = np.array([[_half(part, k) for k in range(GROUPS + 1)] for part in shares])  # [frequency, k]
    log_hz = np.array([_corner(np.log(hz), np.log(swings[:, k])) for k in range(GROUPS + 1)])
    pixels = int(np.count_nonzero(good))
    if np.isfinite(swings[:, 0]).sum() < 2:
        entry = not_identifiable("half of them are answered at fewer than two frequencies; take other swings")
    elif np.isnan(log_hz[0]):
        top = hz[np.isfinite(swings[:, 0])].max()
        entry = not_identifiable(f"above {top:.4g} Hz: up to there the swing grows by less than √2")
    elif not np.isfinite(log_hz).all():
        entry = not_identifiable("too few answers for an interval; take more cycles, or more swings")
    else:
        entry = log_estimated(float(log_hz[0]), float(jackknife(log_hz)), "Hz")
    return Bandwidth(lux, in_bursts, hz, swings[:, 0], entry, pixels)


def _swing(one: Modulation) -> float:
    return float(np.log1p(one.depth) - np.log1p(-one.depth))


def _cycles(bench: EventBench, one: Modulation) -> tuple[float, float, int]:
    """Begin of the first cycle or burst that counts, µs; time from one to the next, µs; and their number."""
    begin_us, end_us = bench.stream(one.file).span_us()
    if one.bursts is None:
        period_us = US_PER_S / one.hz
        first_us = begin_us + _WARM_CYCLES * period_us
    else:
        period_us, first_us = float(one.bursts.period_us), float(one.bursts.begin_us)
    return first_us, period_us, max(int((end_us - first_us) / period_us + 1e-9), 0)


def _answered(bench: EventBench, one: Modulation, good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Share of cycles with an ON event, or of bursts with any, [k]: of all pixels, and without each group."""
    first_us, period_us, count = _cycles(bench, one)
    if count < 1:
        return np.full(GROUPS + 1, np.nan)
    require_memory(count * bench.pixels, f"{count} cycles", bench.path(one.file))
    seen = np.zeros((count, bench.pixels), np.bool_)
    for events in bench.stream(one.file):
        cycle = np.floor((events["t_us"] - first_us) / period_us).astype(np.int64)
        kept = (cycle >= 0) & (cycle < count)
        if one.bursts is None:
            kept &= events["polarity"] > 0
        else:
            kept &= events["t_us"] - first_us - cycle * period_us <= one.bursts.length_us
        seen[cycle[kept], events["y"][kept].astype(np.int64) * bench.shape[1] + events["x"][kept]] = True
    return _means(bench, one, seen.mean(axis=0), good)


def _means(
    bench: EventBench, one: Modulation, values: NDArray[np.float64], good: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Mean over the good pixels [k]: over all of them, and without each group."""
    group = bench.tally(one.file).group.astype(np.int64)[good]
    sums, pixels = np.bincount(group, values[good], GROUPS), np.bincount(group, minlength=GROUPS)
    return np.append(sums.sum(), sums.sum() - sums) / np.maximum(np.append(pixels.sum(), pixels.sum() - pixels), 1)


def _half(part: list[tuple[float, NDArray[np.float64]]], k: int) -> float:
    """Swing at which half of the cycles or bursts are answered; NaN where none is."""
    part = sorted(part, key=lambda one: one[0])
    x, share = np.log([swing for swing, _ in part]), np.array([values[k] for _, values in part])
    if not np.isfinite(share).all():
        return float("nan")
    at = crossing(x, share, np.zeros(x.size), 0.5, 1e4)
    return float("nan") if at is None else float(np.exp(at[0]))


def _corner(log_hz: NDArray[np.float64], log_swing: NDArray[np.float64]) -> float:
    """ln of the frequency above which the swing exceeds √2 times that at the lowest, linear in between."""
    there = np.isfinite(log_swing)
    log_hz, log_swing = log_hz[there], log_swing[there]
    if log_hz.size < 2:
        return float("nan")
    level = log_swing[0] + 0.5 * np.log(2)
    inside = np.flatnonzero(log_swing <= level)
    k = int(inside[-1])
    if k == log_hz.size - 1:
        return float("nan")
    part = (level - log_swing[k]) / (log_swing[k + 1] - log_swing[k])
    return float(log_hz[k] + part * (log_hz[k + 1] - log_hz[k]))


def count_thresholds(
    bench: EventBench, good: NDArray[np.bool_], dead_us: float
) -> tuple[dict[str, Any], dict[str, Any], float | None]:
    """Thresholds from the events of slow, large swings, which no reset of the pixels precedes; ON, OFF, and the light.

    A pixel with the threshold θ that remembers the level of its last event has A/θ − c events of a polarity in a cycle.
    The slope of their mean over A is 1/θ, whatever the constant c and the background are. A dead time T after each
    event swallows 2π²·f·T·(1/√(1 − d²) − 1)/θ² of them at a depth d, which are added again.

    Parameters
    ----------
    bench : the recordings.
    good : [pixel], pixels to be used.
    dead_us : dead time, µs; 0 where it is not known.
    """
    every = [one for one in bench.spec.modulation if one.bursts is None]
    for lux, hz in sorted({(one.lux, one.hz) for one in every}, key=lambda place: place[1]):
        used = sorted((one for one in every if (one.lux, one.hz) == (lux, hz)), key=_swing)
        counts = [_counts(bench, one, good) for one in used]  # of each swing: [polarity, k]
        some = [k for k, count in enumerate(counts) if count[:, 0].min() >= _LEAST_EVENTS]
        if len(some) < 2 or _swing(used[some[0]]) > _SWINGS_APART * _swing(used[some[-1]]):
            continue
        pair = [used[some[0]], used[some[-1]]]
        both = np.array([counts[some[0]], counts[some[-1]]])
        on, off = (_slope(pair, both[:, polarity], dead_us) for polarity in (0, 1))
        return on, off, lux
    nothing = not_identifiable(
        f"it takes continuous modulation of one frequency with two swings that give {_LEAST_EVENTS:g} events a cycle"
    )
    return nothing, nothing, None


def _counts(bench: EventBench, one: Modulation, good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Events of a pixel in a cycle [polarity, k]."""
    first_us, period_us, count = _cycles(bench, one)
    if count < 1:
        return np.zeros((2, GROUPS + 1))
    total = np.zeros((2, bench.pixels))
    for events in bench.stream(one.file):
        kept = events[(events["t_us"] >= first_us) & (events["t_us"] < first_us + count * period_us)]
        pixel = kept["y"].astype(np.int64) * bench.shape[1] + kept["x"]
        for k, chosen in enumerate((kept["polarity"] > 0, kept["polarity"] < 0)):
            total[k] += np.bincount(pixel[chosen], minlength=bench.pixels)
    return np.stack([_means(bench, one, each / count, good) for each in total])


def _slope(pair: list[Modulation], counts: NDArray[np.float64], dead_us: float) -> dict[str, Any]:
    """θ from counts [swing, k] of one polarity at two swings."""
    rise = _swing(pair[1]) - _swing(pair[0])
    lost = [2 * np.pi**2 * one.hz * dead_us * S_PER_US * (1 / np.sqrt(1 - one.depth**2) - 1) for one in pair]
    more, more_lost = counts[1] - counts[0], lost[1] - lost[0]
    if more[0] <= 0:
        return not_identifiable("the larger swing gives no more events than the smaller one")
    # rise/θ = more + more_lost/θ²
    root = rise**2 - 4 * more_lost * more
    if np.any(root <= 0):
        return not_identifiable(_SWALLOWED)
    theta = (rise + np.sqrt(root)) / (2 * more)
    if lost[1] / theta[0] ** 2 > _MOST_SWALLOWED * counts[1, 0]:
        return not_identifiable(_SWALLOWED)
    return estimated(float(theta[0]), float(jackknife(theta)), "ln", GROUPS)

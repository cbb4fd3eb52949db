"""Ends of what event pixels see: the dynamic range in light, and the bandwidth in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.still import jackknife
from hesim_render.calibrate.recordings.tally import GROUPS
from hesim_render.report.bench import EventBench
from hesim_render.report.estimates import corrected, crossing, log_estimated
from hesim_render.report.latency import Answers
from hesim_render.specs.event_bench import Modulation, Steady

#: Share of steps of 2θ that must be found.
DETECTED = 0.9
#: Decibels of a factor e of light, 20·log₁₀.
_DB = 20 / np.log(10)
#: Windows of steady light that are looked at.
_MOST_WINDOWS = 200
#: Cycles of a modulation before those that are counted.
_WARM_CYCLES = 2


@dataclass(frozen=True, eq=False)
class DynamicRange:
    """Share of steps of two thresholds that are found, against light.

    Parameters
    ----------
    lux, share, error : [light], found steps less those that chance finds.
    least_lux, most_lux, range_db : entries of the report.
    """

    lux: NDArray[np.float64]
    share: NDArray[np.float64]
    error: NDArray[np.float64]
    least_lux: dict[str, Any]
    most_lux: dict[str, Any]
    range_db: dict[str, Any]


def false_share(bench: EventBench, steady: Steady, window_us: int, polarity: int, good: NDArray[np.bool_]) -> float:
    """Part of windows of steady light in which a pixel has an event of a polarity."""
    stream = bench.stream(steady.file)
    begin_us, end_us = stream.span_us()
    windows = min((end_us - begin_us) // window_us, _MOST_WINDOWS)
    if windows < 1:
        return float("nan")
    seen = np.zeros(windows * bench.pixels, np.bool_)
    for events in stream:
        number = (events["t_us"] - begin_us) // window_us
        kept = (number < windows) & ((events["polarity"] > 0) == (polarity == 0))
        seen[number[kept] * bench.pixels + events["y"][kept].astype(np.int64) * bench.shape[1] + events["x"][kept]] = 1
    return float(seen.reshape(windows, -1)[:, good].mean())


def dynamic_range(answers: list[Answers], false: list[float]) -> DynamicRange:
    """Lowest and highest light at which steps of two thresholds are found 90 of 100 times.

    Parameters
    ----------
    answers : answers to steps of two thresholds, in order of light.
    false : of each, the share that chance finds in the same time.
    """
    lux = np.array([one.lux for one in answers])
    share = np.array([corrected(one.share, chance) for one, chance in zip(answers, false, strict=True)])
    error = np.array([one.error / max(1 - chance, 1e-9) for one, chance in zip(answers, false, strict=True)])
    nothing = not_identifiable("no steps of two thresholds at two lights or more")
    if lux.size < 2:
        return DynamicRange(lux, share, error, nothing, nothing, nothing)
    good = share >= DETECTED
    if not good.any():
        nothing = not_identifiable(f"at no light are {100 * DETECTED:g} % found; at most {100 * share.max():.3g} %")
        return DynamicRange(lux, share, error, nothing, nothing, nothing)
    first, last = int(np.argmax(good)), int(lux.size - 1 - np.argmax(good[::-1]))
    count = min(one.count * one.pixels for one in answers)
    log = np.log(lux)
    low = crossing(log[: first + 1], share[: first + 1], error[: first + 1], DETECTED, count)
    back = slice(last, None)
    high = crossing(-log[back][::-1], share[back][::-1], error[back][::-1], DETECTED, count)
    least = _end(low, lux[first], 1, "at most")
    most = _end(high, lux[last], -1, "at least")
    if low is not None and high is not None:
        range_db = estimated(-(high[0] + low[0]) * _DB, float(np.hypot(high[1], low[1])) * _DB, "dB")
    else:
        top = -high[0] if high is not None else log[last]
        bottom = low[0] if low is not None else log[first]
        range_db = not_identifiable(f"at least {(top - bottom) * _DB:.4g} dB, from {np.exp(bottom):.3g} to "
                                    f"{np.exp(top):.3g} lx: the captures end there")  # fmt: skip
    return DynamicRange(lux, share, error, least, most, range_db)


def _end(place: tuple[float, float] | None, lux: float, sign: int, word: str) -> dict[str, Any]:
    if place is None:
        return not_identifiable(f"{word} {lux:.4g} lx, the last light of the captures")
    return log_estimated(sign * place[0], place[1], "lx")


@dataclass(frozen=True, eq=False)
class Bandwidth:
    """Swing of the light that a pixel answers in half of the cycles, against frequency.

    Parameters
    ----------
    lux : mean light.
    hz, swing : [frequency], swing ln(L_max/L_min); NaN where no swing of the captures does.
    entry : bandwidth, as an entry of the report.
    pixels : number of pixels.
    """

    lux: float
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
    lights, number = np.unique([one.lux for one in every], return_counts=True)
    lux = float(lights[np.argmax(number)])
    used = [one for one in every if one.lux == lux]
    hz = np.array(sorted({one.hz for one in used}))
    shares = [[(_swing(one), _cycle_share(bench, one, good)) for one in used if one.hz == f] for f in hz]
    swings = np.array([[_half(part, k) for k in range(GROUPS + 1)] for part in shares])  # [frequency, k]
    log_hz = np.array([_corner(np.log(hz), np.log(swings[:, k])) for k in range(GROUPS + 1)])
    pixels = int(np.count_nonzero(good))
    if np.isfinite(swings[:, 0]).sum() < 2:
        entry = not_identifiable("at fewer than two frequencies is half of the cycles answered; take other swings")
    elif np.isnan(log_hz[0]):
        top = hz[np.isfinite(swings[:, 0])].max()
        entry = not_identifiable(f"above {top:.4g} Hz: up to there the swing grows by less than √2")
    elif not np.isfinite(log_hz).all():
        entry = not_identifiable("too few answers for an interval; take more cycles, or more swings")
    else:
        entry = log_estimated(float(log_hz[0]), float(jackknife(log_hz)), "Hz")
    return Bandwidth(lux, hz, swings[:, 0], entry, pixels)


def _swing(one: Modulation) -> float:
    return float(np.log1p(one.depth) - np.log1p(-one.depth))


def _cycle_share(bench: EventBench, one: Modulation, good: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Share of cycles with an ON event [k]: of all pixels, and without each group."""
    stream = bench.stream(one.file)
    begin_us, end_us = stream.span_us()
    begin_us += round(_WARM_CYCLES * 1e6 / one.hz)
    cycles = int((end_us - begin_us) * one.hz / 1e6)
    group = bench.tally(one.file).group.astype(np.int64)[good]
    if cycles < 1:
        return np.full(GROUPS + 1, np.nan)
    seen = np.zeros((cycles, bench.pixels), np.bool_)
    for events in stream:
        cycle = np.floor((events["t_us"] - begin_us) * one.hz / 1e6).astype(np.int64)
        kept = (cycle >= 0) & (cycle < cycles) & (events["polarity"] > 0)
        seen[cycle[kept], events["y"][kept].astype(np.int64) * bench.shape[1] + events["x"][kept]] = True
    hits = np.bincount(group, seen[:, good].mean(axis=0), GROUPS)
    pixels = np.bincount(group, minlength=GROUPS)
    return np.append(hits.sum(), hits.sum() - hits) / np.maximum(np.append(pixels.sum(), pixels.sum() - pixels), 1)


def _half(part: list[tuple[float, NDArray[np.float64]]], k: int) -> float:
    """Swing at which half of the cycles are answered; NaN where none is."""
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

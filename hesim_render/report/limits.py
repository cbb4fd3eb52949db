"""The dynamic range of event pixels: the lowest and the highest light at which steps of two thresholds are found."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.report.bench import EventBench
from hesim_render.report.estimates import corrected, crossing, figure, log_estimated
from hesim_render.report.latency import Answers
from hesim_render.specs.event_bench import Steady

#: Share of steps of 2θ that must be found.
DETECTED = 0.9
#: Decibels of a factor e of light, 20·log₁₀.
_DB = 20 / np.log(10)
#: Windows of steady light that are looked at.
_MOST_WINDOWS = 200


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
        range_db = not_identifiable(f"at least {(top - bottom) * _DB:.4g} dB, from {figure(np.exp(bottom), 3)} to "
                                    f"{figure(np.exp(top), 3)} lx: the captures end there")  # fmt: skip
    return DynamicRange(lux, share, error, least, most, range_db)


def _end(place: tuple[float, float] | None, lux: float, sign: int, word: str) -> dict[str, Any]:
    if place is None:
        return not_identifiable(f"{word} {figure(lux)} lx, the last light of the captures")
    return log_estimated(sign * place[0], place[1], "lx")

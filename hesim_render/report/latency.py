"""Latency and jitter of event pixels, and the share of steps that they find, against light."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import not_identifiable
from hesim_render.report.bench import Responses
from hesim_render.report.estimates import mean_error, quantile, whole_us_quantile

#: Part of a normal law within one standard deviation.
_ONE_SIGMA = 0.6826894921370859
#: Answers that a latency needs.
_LEAST = 100


@dataclass(frozen=True)
class Answers:
    """What steps of one light tell of one polarity.

    Parameters
    ----------
    lux, contrast : light before the step, lx, and (L₁ − L₀)/L₀.
    temperature_c : of the sensor, if stated.
    window_us : time in which an answer counts, µs.
    share, error : answered steps, and standard error; of `count` steps of a pixel.
    latency, jitter : entries of the report.
    pixels : number of pixels.
    """

    lux: float
    contrast: float
    temperature_c: float | None
    window_us: int
    share: float
    error: float
    count: int
    latency: dict[str, Any]
    jitter: dict[str, Any]
    pixels: int


def answers(one: Responses, polarity: int, good: NDArray[np.bool_], temperature_c: float | None) -> Answers:
    """Latency, jitter and answered share of the rises (0) or falls (1) of a recording.

    Parameters
    ----------
    one : the recording.
    polarity : 0 for ON, 1 for OFF.
    good : [pixel], pixels to be used.
    temperature_c : of the sensor, if stated.
    """
    latency = one.of(polarity)[:, good].astype(np.float64)
    has_answer = latency > 0
    everything = np.ones_like(has_answer)
    pixels = int(np.count_nonzero(good))
    share = float(has_answer.mean()) if has_answer.size else 0.0
    about = one.steps.lux, one.steps.contrast, temperature_c, one.window_us
    error = max(mean_error(has_answer.astype(np.float64), everything), 1 / max(has_answer.size, 1))
    if np.count_nonzero(has_answer) < _LEAST:
        reason = not_identifiable(f"{np.count_nonzero(has_answer)} answers; {_LEAST} are needed")
        return Answers(*about, share, error, len(has_answer), reason, reason, pixels)
    median = whole_us_quantile(quantile(latency, has_answer, 0.5))
    return Answers(*about, share, error, len(has_answer), median, _jitter(latency, has_answer), pixels)


def _jitter(latency: NDArray[np.float64], has_answer: NDArray[np.bool_]) -> dict[str, Any]:
    """Standard deviation of a normal law from the differences of successive latencies of a pixel."""
    pairs = len(latency) // 2
    if pairs == 0:
        return not_identifiable("one step; two are needed")
    first, second = latency[: 2 * pairs : 2], latency[1 : 2 * pairs : 2]
    both = has_answer[: 2 * pairs : 2] & has_answer[1 : 2 * pairs : 2]
    if np.count_nonzero(both) < _LEAST:
        return not_identifiable(f"{np.count_nonzero(both)} pairs of answers; {_LEAST} are needed")
    return whole_us_quantile(quantile(np.abs(second - first), both, _ONE_SIGMA), np.sqrt(0.5))

"""Intensity from events alone: the leaky sum of their steps, and how a picture of unknown scale is measured.

Event double integral: sharp images from a blurred one and the events of its exposure [pan2019].

The log intensity at a time t differs from that at a reference time f by the signed number of events between, times the
threshold: L(t) = L(f) · exp(c · E(f, t)). The blurred image is the mean of L over the exposure, so

    L(f) = B / mean over t of exp(c · E(f, t))

for every pixel. E is a step function of time: its mean is a sum over the events, without a loop over pixels.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.measure.pictures import ssim

#: Largest factor between the blurred and a sharp value; noise may give pixels hundreds of events.
_MOST = 100.0


def log_steps(events: NDArray, threshold_on: float, threshold_off: float) -> NDArray[np.float64]:
    """Change of log intensity that each event stands for, [event]."""
    return np.where(events["polarity"] > 0, threshold_on, -threshold_off)


def sharp_over_blurred(
    events: NDArray,
    shape: tuple[int, int],
    begin_us: ArrayLike,
    exposure_us: float,
    times_us: Sequence[float],
    thresholds: tuple[float, float],
) -> NDArray[np.float64]:
    """Ratio of the sharp image at each time to the blurred one.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`, any time, in order of time.
    shape : rows and columns of the event grid.
    begin_us : begin of the exposure, a scalar or [row] of the event grid, µs.
    exposure_us : length of the exposure, µs.
    times_us : times of the sharp images, before, within or after the exposure. With a begin for each row, times are
        those of row 0, and a later row is taken so much later.
    thresholds : contrast thresholds ON and OFF, in ln units.

    Returns
    -------
    [time, y, x]; between 0.01 and 100.
    """
    rows, cols = shape
    row_begin = np.broadcast_to(np.asarray(begin_us, dtype=np.float64), rows)
    delay = row_begin - row_begin[0]
    place = events["y"].astype(np.int64) * cols + events["x"]
    time = events["t_us"] - delay[events["y"]]  # as if all rows were those of row 0
    begin, end = row_begin[0], row_begin[0] + exposure_us
    step = log_steps(events, *thresholds)
    size = rows * cols

    # log intensity relative to that at the begin of the exposure: a step function between the events within
    within = (time > begin) & (time < end)
    order = np.lexsort((time[within], place[within]))
    where, when, jump = place[within][order], time[within][order], step[within][order]
    level = np.cumsum(jump)
    first = np.searchsorted(where, where)  # index of the pixel's first event
    before = np.where(first > 0, level[first - 1], 0.0) if len(where) else level
    level = level - before
    last_of_pixel = np.append(where[1:] != where[:-1], True) if len(where) else np.zeros(0, bool)
    until = np.where(last_of_pixel, end, np.append(when[1:], end))[: len(when)]
    most = np.log(_MOST)
    held = np.exp(np.clip(level, -most, most)) * (until - when)
    lead = np.full(size, exposure_us, dtype=np.float64)
    firsts = np.flatnonzero(first == np.arange(len(where)))
    lead[where[firsts]] = when[firsts] - begin
    mean = (lead + np.bincount(where, held, size)) / exposure_us

    result = []
    for t in times_us:
        if t >= begin:
            part = (time > begin) & (time <= t)
            change = np.bincount(place[part], step[part], size)
        else:
            part = (time > t) & (time <= begin)
            change = -np.bincount(place[part], step[part], size)
        result.append(np.clip(np.exp(np.clip(change, -most, most)) / mean, 1 / _MOST, _MOST))
    return np.array(result).reshape(len(result), rows, cols)


#: Time in which the sum falls to 1/e, µs; a choice of ours, not fitted to any data.
LEAK_US = 200_000.0


def leaky_sum(
    events: NDArray, shape: tuple[int, int], t_us: float, thresholds: tuple[float, float], leak_us: float = LEAK_US
) -> NDArray[np.float64]:
    """Log intensity of each pixel relative to its own past: steps that fade with time [scheerlinck2018], [y, x].

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`; those after `t_us` do not count.
    shape : rows and columns of the event grid.
    t_us : time of the picture, µs.
    thresholds : contrast thresholds ON and OFF, ln units.
    leak_us : time in which a step falls to 1/e, µs.
    """
    part = events[events["t_us"] <= t_us]
    steps = log_steps(part, *thresholds) * np.exp((part["t_us"] - t_us) / leak_us)
    place = part["y"].astype(np.int64) * shape[1] + part["x"]
    total: NDArray[np.float64] = np.bincount(place, steps, shape[0] * shape[1]).astype(np.float64)
    return total.reshape(shape)


def intensity_scores(log_picture: NDArray, log_truth: NDArray) -> dict[str, float]:
    """Measures of a log intensity whose scale and offset are not known.

    Both are fitted to the truth by least squares first. SSIM is of the fitted picture and the truth, with the range of
    the truth (its quantiles 0.5 % and 99.5 %) as [0, 1].

    Parameters
    ----------
    log_picture, log_truth : [row, col], ln units; pixels where one is not finite do not count in the fit, and are equal
        in SSIM.

    Returns
    -------
    ``log_rmse``: in ln units after the fit; ``correlation``; ``ssim`` where the picture is large enough.
    """
    valid = np.isfinite(log_picture) & np.isfinite(log_truth)
    a, b = log_picture[valid].astype(np.float64), log_truth[valid].astype(np.float64)
    if a.size < 2:
        return {"log_rmse": float("nan"), "correlation": float("nan")}
    spread = a.std()
    slope = float(np.mean((a - a.mean()) * (b - b.mean())) / spread**2) if spread > 0 else 0.0
    fitted = slope * (a - a.mean()) + b.mean()
    correlated = spread > 0 and b.std() > 0
    result: dict[str, float] = {
        "log_rmse": float(np.sqrt(np.mean((fitted - b) ** 2))),
        "correlation": float(np.corrcoef(a, b)[0, 1]) if correlated else float("nan"),
    }
    low, high = np.quantile(b, [0.005, 0.995])
    if min(log_truth.shape) >= 11 and high > low:
        pictures = np.zeros((2, *log_truth.shape))
        pictures[:, valid] = (np.stack([fitted, b]) - low) / (high - low)
        result["ssim"] = ssim(pictures[0], pictures[1])
    return result

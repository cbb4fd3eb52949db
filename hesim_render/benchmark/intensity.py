"""Intensity from events alone: the leaky sum of their steps, and how a picture of unknown scale is measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.benchmark.double_integral import log_steps
from hesim_render.measure.pictures import ssim

#: Time in which the sum falls to 1/e, µs; a choice of ours, not fitted to any data.
LEAK_US = 200_000.0


def leaky_sum(
    events: NDArray, shape: tuple[int, int], t_us: float, thresholds: tuple[float, float], leak_us: float = LEAK_US
) -> NDArray[np.float64]:
    """Log intensity of each pixel relative to its own past: steps that fade with time [scheerlinck2018].

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`; those after `t_us` do not count.
    shape : rows and columns of the event grid.
    t_us : time of the picture, µs.
    thresholds : contrast thresholds ON and OFF, ln units.
    leak_us : time in which a step falls to 1/e, µs.

    Returns
    -------
    [y, x], ln units.
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
    found: dict[str, float] = {
        "log_rmse": float(np.sqrt(np.mean((fitted - b) ** 2))),
        "correlation": float(np.corrcoef(a, b)[0, 1]) if correlated else float("nan"),
    }
    low, high = np.quantile(b, [0.005, 0.995])
    if min(log_truth.shape) >= 11 and high > low:
        pictures = np.zeros((2, *log_truth.shape))
        pictures[:, valid] = (np.stack([fitted, b]) - low) / (high - low)
        found["ssim"] = ssim(pictures[0], pictures[1])
    return found

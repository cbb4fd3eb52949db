"""Intervals of quantiles and shares over pixels and jumps, and places where a share is crossed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.calibrate.estimate import Z_95, estimated


def mean_error(values: NDArray[np.float64], valid: NDArray[np.bool_]) -> float:
    """Standard error of a mean over jumps and pixels, both of which may have a part that is their own.

    With sums over the values of a pixel, and over those of a jump, V = V_pixel + max(V_jump − V_each, 0)
    [cameron2011].

    Parameters
    ----------
    values : [jump, pixel].
    valid : [jump, pixel], which of them there are.
    """
    count = int(np.count_nonzero(valid))
    if count < 2:
        return float("nan")
    rest = np.where(valid, values - values[valid].mean(), 0.0)
    each = float(np.sum(rest**2))
    pixel, jump = float(np.sum(rest.sum(axis=0) ** 2)), float(np.sum(rest.sum(axis=1) ** 2))
    return float(np.sqrt(max(pixel, each) + max(jump - each, 0.0))) / count


def quantile(values: NDArray[np.float64], valid: NDArray[np.bool_], part: float) -> tuple[float, float, float, float]:
    """A quantile, its standard error, and its 95 % interval: the quantiles at the ends of the interval of the share of
    values below it [woodruff1952].

    Parameters
    ----------
    values, valid : as for `mean_error`.
    part : 0 to 1.
    """
    some = values[valid]
    value = float(np.quantile(some, part))
    error = max(mean_error((values <= value).astype(np.float64), valid), 0.5 / some.size)
    low, high = (float(np.quantile(some, min(max(part + z * error, 0.0), 1.0))) for z in (-Z_95, Z_95))
    return value, (high - low) / (2 * Z_95), low, high


def whole_us_quantile(estimate: tuple[float, float, float, float], scale: float = 1.0) -> dict[str, Any]:
    """A quantile of times that are whole µs as an entry of the report: half a µs is added to either side."""
    value, error, low, high = (scale * number for number in estimate)
    half = 0.5 * scale
    return {
        "value": value, "standard_error": float(np.hypot(error, half / np.sqrt(3))),
        "interval_95": [max(low - half, 0.0), high + half], "unit": "µs",
    }  # fmt: skip


def corrected(share: float, false: float) -> float:
    """Share of steps that were found, without those that chance finds: (p − q)/(1 − q) [abbott1925]."""
    return (share - false) / max(1 - false, 1e-9)


def probit(share: NDArray[np.float64], count: float) -> NDArray[np.float64]:
    """z of a share; shares of 0 and 1 of `count` count as half of one."""
    return np.asarray(special.ndtri(np.clip(share, 0.5 / count, 1 - 0.5 / count)))


def crossing(
    x: NDArray[np.float64], share: NDArray[np.float64], error: NDArray[np.float64], level: float, count: float
) -> tuple[float, float] | None:
    """Smallest x from which on the shares reach a level, and its standard error; None where they never do, or always.

    Between the two points beside it, the probit of the share is a straight line in x.

    Parameters
    ----------
    x : [k], rising.
    share, error : [k], shares and their standard errors.
    level : wanted share.
    count : answers behind a share.
    """
    below = np.flatnonzero(share < level)
    if below.size == 0 or below[-1] == x.size - 1:
        return None
    k = int(below[-1])
    z = probit(share[k : k + 2], count)
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    slope = (x[k + 1] - x[k]) / (z[1] - z[0])
    part = (float(special.ndtri(level)) - z[0]) / (z[1] - z[0])
    errors = error[k : k + 2] / np.maximum(density, 1e-6) * np.array([1 - part, part])
    return float(x[k] + part * (x[k + 1] - x[k])), float(slope * np.hypot(*errors))


def log_estimated(log: float, error: float, unit: str) -> dict[str, Any]:
    """An entry from the logarithm of a value and its standard error; the interval is symmetrical in the logarithm."""
    value = float(np.exp(log))
    low, high = float(np.exp(log - Z_95 * error)), float(np.exp(log + Z_95 * error))
    return estimated(value, value * error, unit) | {"interval_95": [low, high]}


def figure(value: float, digits: int = 4) -> str:
    """A number with few digits, without an exponent up to 10 million."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e7 else text

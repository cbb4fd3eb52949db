"""Rate of noise events of an asynchronous pixel in steady light, from its thresholds and its noise, and the inverse.

The noise of ln x is Gaussian, white noise through two equal poles that are −3 dB at f together
(`hesim_render.pixels.evs.processes.BandNoise`). After an event and its dead time the pixel compares with the level of
that instant. How often the noise then crosses a threshold has no closed form. Level crossings [rice1945] are the rate
of a pixel that always compares with the mean; it is ten to fifty times lower at thresholds of four σ, because the level
of comparison itself wanders with the noise. The table has the rates of pixels in their stationary state
(``noise_rates.npz``, made by ``benchmarks/event_noise.py``), as events per period 1/f, of the lower threshold and the
difference of both over σ, of the dead time and of the rate of leak events. Between entries log(rate) is a cubic spline
of the square of the lower threshold, of the root of the difference, and of the logs of dead time and leak.

An event of the leak resets a pixel with a dead time to the level of that instant, which is random. For a while after it
noise events are more frequent. A pixel without a dead time moves its level of comparison by exactly a threshold with
each event, and leak events do not move it.
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize
from scipy.interpolate import RegularGridInterpolator, make_interp_spline

from hesim_render.core.errors import RangeError

#: The file of `RateTable`.
TABLE = Path(__file__).with_name("noise_rates.npz")
#: A pixel's threshold never falls below this part of the nominal one, as in v2e (0.01 of 0.2 ln units).
LEAST_THRESHOLD_REL = 0.05

#: Largest mean threshold over σ; there, and long before, noise events are too rare for any pixel to have one.
_LARGEST_MEAN = 400.0
#: Points of the normal distribution of each threshold over pixels, and their weights: the trapezoid rule, which for a
#: smooth integrand is exact to the tails that it leaves out. Rare pixels of low threshold have much of the noise.
_DEVIATES = np.linspace(-4.0, 4.0, 33)
_WEIGHTS = np.exp(-0.5 * _DEVIATES**2) / np.sum(np.exp(-0.5 * _DEVIATES**2))


class RateTable(NamedTuple):
    """Simulated rates of noise events.

    Parameters
    ----------
    lower, difference : lower threshold, and difference of both, over σ.
    dead_periods, leak_periods : dead time, in periods, and leak events of a period.
    log_events_no_dead_time : [lower, difference], 1000 ln of the ON and OFF events of a period without a dead time.
    log_events : the same with one, [lower, difference, dead time, leak].
    """

    lower: NDArray[np.float64]
    difference: NDArray[np.float64]
    dead_periods: NDArray[np.float64]
    leak_periods: NDArray[np.float64]
    log_events_no_dead_time: NDArray[np.int16]
    log_events: NDArray[np.int16]


@lru_cache(maxsize=1)
def rate_table() -> RateTable:
    """The table of this package."""
    with np.load(TABLE) as arrays:
        return RateTable(*(arrays[name] for name in RateTable._fields))


@lru_cache(maxsize=64)
def _interpolator(dead_periods: float, leak_periods: float) -> RegularGridInterpolator:
    """log(rate) of the square of the lower threshold and of the root of the difference."""
    table = rate_table()
    values = table.log_events_no_dead_time / 1000
    if dead_periods > 0:
        values = table.log_events / 1000
        for nodes, value in ((table.dead_periods, dead_periods), (table.leak_periods, leak_periods)):
            at = math.log(min(max(value, nodes[0]), nodes[-1]))
            values = make_interp_spline(np.log(nodes), values, axis=2)(at)
    return RegularGridInterpolator((np.square(table.lower), np.sqrt(table.difference)), values, "cubic")


def events_per_period(
    on_sigma: ArrayLike, off_sigma: ArrayLike, dead_periods: float, leak_periods: float = 0.0
) -> NDArray[np.float64]:
    """ON and OFF noise events together of a pixel, per period 1/f of the noise bandwidth.

    Parameters
    ----------
    on_sigma, off_sigma : θ₊/σ and θ₋/σ, any shapes that go together.
    dead_periods : dead time times f; 0 for none.
    leak_periods : rate of leak events over f. It matters to pixels with a dead time only.

    Returns
    -------
    Events per period, without those of the leak. Lower thresholds above 7 σ are extrapolated as crossings of a level.
    """
    on, off = np.broadcast_arrays(np.asarray(on_sigma, np.float64), np.asarray(off_sigma, np.float64))
    lower, difference = np.minimum(on, off), np.abs(on - off)
    table = rate_table()
    least, most = table.lower[[0, -1]]
    where = np.clip(lower, least, most) ** 2, np.sqrt(np.minimum(difference, table.difference[-1]))
    log = _interpolator(float(dead_periods), float(leak_periods))(np.stack(where, axis=-1)).reshape(on.shape)
    return np.exp(log - 0.5 * np.maximum(lower**2 - most**2, 0.0))


def noise_rates_hz(
    thresholds: tuple[float, float],
    mismatch: float,
    sigma: float,
    bandwidth_hz: float,
    dead_s: float,
    leak_hz: float = 0.0,
) -> tuple[float, float]:
    """Rates of ON and of OFF noise events of a pixel, mean over pixels, in steady light, Hz.

    In the long run both directions travel equally far: the rates are inverse to the thresholds, each with the distance
    that the level goes beyond it during the dead time.

    Parameters
    ----------
    thresholds : θ₊, θ₋, ln units.
    mismatch : relative standard deviation of each over pixels.
    sigma : standard deviation of ln x, time average.
    bandwidth_hz : −3 dB frequency of the noise, Hz.
    dead_s : dead time after an event, s; 0 for none.
    leak_hz : rate of leak events, Hz, which are no part of the result.
    """
    if sigma <= 0:
        return 0.0, 0.0
    # each pixel has its own pair of thresholds: the mean over both normal laws, by the trapezoid rule
    deviates, weights = (_DEVIATES, _WEIGHTS) if mismatch > 0 else (np.zeros(1), np.ones(1))
    spread = np.maximum(1 + mismatch * deviates, LEAST_THRESHOLD_REL)
    on, off = np.meshgrid(thresholds[0] * spread / sigma, thresholds[1] * spread / sigma)
    dead_periods = dead_s * bandwidth_hz
    rates = bandwidth_hz * events_per_period(on, off, dead_periods, leak_hz / bandwidth_hz) * np.outer(weights, weights)
    # both directions travel equally far in the long run: the lower threshold, with what lies beyond it, has more events
    beyond = _beyond((on + off) / 2, dead_periods)
    share = np.clip((off + beyond) / (on + off + 2 * beyond), 0.0, 1.0)
    return float(np.sum(rates * share)), float(np.sum(rates * (1 - share)))


def _beyond(mean: NDArray[np.float64], dead_periods: float) -> NDArray[np.float64]:
    """Mean travel of the level beyond a threshold at the end of the dead time, in σ; negative where it is on its way
    back. Of the same simulations: within 0.3 of them for means of 2.5 to 4.5.
    """
    if dead_periods <= 0:
        return np.zeros_like(mean)
    first, *_, last = rate_table().dead_periods
    at = np.log(np.clip(dead_periods, first, last))
    fixed, growing = (np.interp(at, np.log(_BEYOND[0]), values) for values in _BEYOND[1:])
    return fixed + growing * mean


#: Dead time in periods; travel with it: a constant, and a part proportional to the mean threshold.
_BEYOND = ((0.01, 0.03, 0.1, 0.3, 1.0), (0.12, 0.33, 0.7, 1.17, 1.52), (0.0, 0.0, 0.0, -0.65, -1.05))


def noise_sigma(
    rate_hz: float,
    thresholds: tuple[float, float],
    mismatch: float,
    bandwidth_hz: float,
    dead_s: float,
    leak_hz: float = 0.0,
) -> float:
    """Standard deviation of ln x that gives a rate of noise events, ON and OFF together; inverse of `noise_rates_hz`.

    Parameters
    ----------
    rate_hz : noise events of a pixel, mean over pixels, Hz.
    thresholds, mismatch, bandwidth_hz, dead_s, leak_hz : as for `noise_rates_hz`.

    Raises
    ------
    RangeError
        If no noise of this bandwidth gives the rate.
    """
    mean = sum(thresholds) / 2

    def excess(log_sigma: float) -> float:
        sigma = math.exp(log_sigma)
        result = sum(noise_rates_hz(thresholds, mismatch, sigma, bandwidth_hz, dead_s, leak_hz))
        return math.log(max(result, 1e-300) / rate_hz)

    lowest, highest = math.log(mean / _LARGEST_MEAN), math.log(mean / rate_table().lower[0])
    if excess(highest) < 0:
        most = sum(noise_rates_hz(thresholds, mismatch, math.exp(highest), bandwidth_hz, dead_s, leak_hz))
        raise RangeError(
            "rate of noise events", f"{rate_hz:g} Hz", f"at most {most:.3g} Hz with a noise bandwidth of "
            f"{bandwidth_hz:g} Hz; a larger bandwidth gives more"
        )  # fmt: skip
    return math.exp(float(optimize.brentq(excess, lowest, highest, xtol=1e-6)))

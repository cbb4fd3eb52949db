"""Level with which asynchronous pixels compare after a long time in steady light: the law over pixels.

In units of the noise's standard deviation, a pixel with thresholds a and b compares with a level r. Its noise goes up
through r + a at the rate ν(a + r), down through r − b at the rate ν(b − r), each after a wait of its own. Then the
level of comparison becomes that of the crossing or, with a dead time, the level at its end; a leak event of a pixel
with a dead time does the same at any level. So r is a semi-Markov process: the share of the time at r is the share of
the visits to r times the mean wait there. Pixels wait longest where both thresholds are far, and there they are found.

- ν is the rate at which the simulated noise, which is linear between its nodes, crosses a level. For two nodes of the
  standard deviation A and the correlation ρ it is 2 T(L/A, √((1 − ρ)/(1 + ρ))) with Owen's function T [owen1956]; with
  ever more nodes it is that of a Gaussian process [rice1945].
- At a crossing the noise is at the threshold, with a speed of Rayleigh's law. A dead time later it is at
  e^−h ((1 + h) L + h v), with the variance 1 − e^−2h (1 + 2h + 2h²) of what came since.
- The visits are the stationary law of a Markov chain on a grid, by elimination without differences [grassmann1985]:
  its chances differ by many powers of ten.

The law holds for rare crossings; where they are frequent, a few periods of the noise bring any law to the true one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.pixels.evs.formulas import POLE

#: Grid of levels, in standard deviations.
_STEP = 0.1
_GRID = _STEP * np.arange(-56, 57)
#: Mean and variance of Rayleigh's law.
_SPEED, _SPEED_VARIANCE = math.sqrt(math.pi / 2), 2 - math.pi / 2


class Pixels(NamedTuple):
    """Asynchronous pixels in units of their noise.

    Parameters
    ----------
    on, off : [n], θ₊/σ and θ₋/σ.
    dead : dead time, in periods 1/f of the noise; 0 for none.
    leak : events that reset a pixel, per period.
    angle : rate of the noise's poles times the time between its nodes.
    """

    on: NDArray[np.float64]
    off: NDArray[np.float64]
    dead: float
    leak: float
    angle: float


class Law(NamedTuple):
    """Law of pixels in steady light.

    Parameters
    ----------
    edges : [k + 1], bounds of cells of levels, in standard deviations from the mean level.
    share : [n, k], part of the time, outside of dead times, at which each pixel compares with a level in a cell.
    dead_share : [n], part of the time that is dead.
    events : [n], noise events per period.
    """

    edges: NDArray[np.float64]
    share: NDArray[np.float64]
    dead_share: NDArray[np.float64]
    events: NDArray[np.float64]


def law(pixels: Pixels) -> Law:
    """The law of each pixel."""
    up = _crossings(pixels.on[:, None] + _GRID, pixels.angle)
    down = _crossings(pixels.off[:, None] - _GRID, pixels.angle)
    out = up + down + pixels.leak
    to = up[..., None] * _landing(pixels.on[:, None] + _GRID, 1.0, pixels.dead)
    to += down[..., None] * _landing(_GRID - pixels.off[:, None], -1.0, pixels.dead)
    to += pixels.leak * _weights(np.zeros(1), 1.0)
    visits = _stationary(to / out[..., None])
    waits = visits / out
    cycle = waits.sum(axis=1) + pixels.dead
    return Law(
        np.append(_GRID - _STEP / 2, _GRID[-1] + _STEP / 2),
        waits / waits.sum(axis=1, keepdims=True),
        pixels.dead / cycle,
        np.sum(visits * (up + down) / out, axis=1) / cycle,
    )


def _crossings(level: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """How often the noise crosses a level upwards, per period; a level below the mean counts as the mean."""
    correlation = (1 + angle) * math.exp(-angle)
    amplitude = math.sqrt(3 / (2 + correlation))
    slope = math.sqrt((1 - correlation) / (1 + correlation))
    return POLE / angle * 2 * special.owens_t(np.maximum(level, 0.0) / amplitude, slope)


def _landing(level: NDArray[np.float64], sign: float, dead: float) -> NDArray[np.float64]:
    """Chances [..., k] of the next level of comparison after a crossing of `level`, upwards for `sign` 1.

    They are spread by a step of the grid at least: thresholds that are multiples of it would visit some levels only.
    """
    h = POLE * dead
    decay = math.exp(-h)
    variance = 1 - decay**2 * (1 + 2 * h + 2 * h * h) + (h * decay) ** 2 * _SPEED_VARIANCE
    return _weights(decay * ((1 + h) * level + sign * h * _SPEED), math.sqrt(max(variance, _STEP**2)))


def _weights(mean: NDArray[np.float64], deviation: float) -> NDArray[np.float64]:
    """A normal law on the grid, [..., k]: each value is shared by its two neighbours so that the mean is kept."""
    away = mean[..., None] - _GRID
    t = away / deviation
    above = deviation * np.exp(-0.5 * t * t) / math.sqrt(math.tau) + away * special.ndtr(t)  # E max(X − g, 0)
    slope = np.diff(above, axis=-1) / _STEP  # minus the chance to be beyond
    return np.maximum(np.diff(slope, axis=-1, prepend=-1.0, append=0.0), 0.0)


def _stationary(chances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stationary laws [n, k] of Markov chains [n, k, k]. No sum depends on the number of threads."""
    rest, count = chances.copy(), chances.shape[-1]
    for k in range(count - 1, 0, -1):
        rest[:, :k, k] /= rest[:, k, :k].sum(axis=1, keepdims=True)
        rest[:, :k, :k] += rest[:, :k, k, None] * rest[:, None, k, :k]
    found = np.zeros(chances.shape[:2])
    found[:, 0] = 1.0
    for k in range(1, count):
        found[:, k] = (found[:, :k] * rest[:, :k, k]).sum(axis=1)
    return found / found.sum(axis=1, keepdims=True)

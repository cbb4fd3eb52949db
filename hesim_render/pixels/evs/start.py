"""State in which asynchronous pixels begin: that of a camera which has looked at the first light for a long time.

The level of comparison of each pixel is drawn from its law (`hesim_render.pixels.evs.start`), with the
thresholds, the noise and the bandwidth that the pixel has in the light of the first sample. Then the pixels run for a
few periods of their noise, whose events nobody sees (`hesim_render.pixels.evs.last_event.LastEvent`).

The laws are known at nodes of thresholds over noise and of the bandwidth. Between nodes, quantiles are interpolated.

Level with which asynchronous pixels compare after a long time in steady light: the law over pixels.

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

import math
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.core.rng import Stream, random_words, uniform
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.evs.formulas import POLE
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.processes import most_bandwidth

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
    # a Markov chain over levels of comparison, [pixel, level]: rates at which noise or a reset ends a stay there
    up = _crossings(pixels.on[:, None] + _GRID, pixels.angle)
    down = _crossings(pixels.off[:, None] - _GRID, pixels.angle)
    out = up + down + pixels.leak
    # and where each leads, [pixel, level, next level]
    to = up[..., None] * _landing(pixels.on[:, None] + _GRID, 1.0, pixels.dead)
    to += down[..., None] * _landing(_GRID - pixels.off[:, None], -1.0, pixels.dead)
    to += pixels.leak * _weights(np.zeros(1), 1.0)
    # share of visits of each level, and of time: a level that is left late counts more
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
    # elimination of one level after the other (Grassmann, Taksar and Heyman): no differences, so no cancellation
    rest, count = chances.copy(), chances.shape[-1]
    for k in range(count - 1, 0, -1):
        rest[:, :k, k] /= rest[:, k, :k].sum(axis=1, keepdims=True)
        rest[:, :k, :k] += rest[:, :k, k, None] * rest[:, None, k, :k]
    result = np.zeros(chances.shape[:2])
    result[:, 0] = 1.0
    for k in range(1, count):
        result[:, k] = (result[:, :k] * rest[:, :k, k]).sum(axis=1)
    return result / result.sum(axis=1, keepdims=True)


#: Thresholds over noise at which laws are known. Beyond, noise events are too rare, or so frequent that any law is left
#: at once.
_NODES = np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 9.0])
#: Quantiles of a law that are kept, as normal deviates.
_QUANTILES = np.linspace(-4.0, 4.0, 161)
#: How long ago all pixels were reset, s, on average: only pixels with fewer noise events than that notice.
_LONG_S = 1000.0


class Start(NamedTuple):
    """State of the pixels at the begin.

    Parameters
    ----------
    reference : [pixel], level of comparison less ln x, in standard deviations of the noise.
    dead_us : [pixel], time until each is ready, µs; 0 for most.
    events_hz : [pixel], noise events, Hz.
    chance : [pixel], a uniform random number that neither of both depends on.
    """

    reference: NDArray[np.float32]
    dead_us: NDArray[np.float64]
    events_hz: NDArray[np.float64]
    chance: NDArray[np.float64]


class _Laws:
    """Laws at the nodes of both thresholds, for one bandwidth; each is worked out when it is first needed."""

    def __init__(self, dead: float, leak: float, angle: float) -> None:
        self._dead, self._leak, self._angle = dead, leak, angle
        size = _NODES.size
        self.quantiles = np.full((size * size, _QUANTILES.size), np.nan, np.float32)
        self.dead_share, self.events = np.zeros(size * size), np.zeros(size * size)

    def know(self, nodes: NDArray[np.intp]) -> None:
        """Work out the laws of nodes, numbered ON first."""
        new = nodes[np.isnan(self.quantiles[nodes, 0])]
        if new.size == 0:
            return
        on, off = (_NODES[place] for place in np.divmod(new, _NODES.size))
        result = law(Pixels(on, off, self._dead, self._leak, self._angle))
        below = np.concatenate([np.zeros((new.size, 1)), np.cumsum(result.share, axis=1)], axis=1)
        wanted = special.ndtr(_QUANTILES)
        for node, one in zip(new, below, strict=True):
            self.quantiles[node] = np.interp(wanted, one, result.edges)
        self.dead_share[new], self.events[new] = result.dead_share, result.events


_laws = lru_cache(maxsize=64)(_Laws)


def start_of(
    noise: EvsNoise, seed: int, spread: NDArray[np.float32], share: NDArray[np.float64], angle: float
) -> Start:
    """State of the pixels in the light of the first sample: a pure function of the seed, the pixel and this light.

    Parameters
    ----------
    noise : noise model of the pixels.
    seed : seed of the noise.
    spread : [pixel], standard deviation of ln x.
    share : [pixel], bandwidth of each pixel's noise over the largest.
    angle : rate of the poles at the largest bandwidth times the time between nodes of the noise.
    """
    chance, of_dead, free = start_chances(noise, seed)
    # where each pixel lies between the nodes of the table: thresholds in noise units, octave of its bandwidth, quantile
    sigma = np.maximum(spread.astype(np.float64), 1e-12)
    thresholds = noise.threshold_on_map, noise.threshold_off_map
    where = [_place(np.ravel(theta) / sigma, _NODES) for theta in thresholds]
    octave = -np.log2(np.clip(share, 1e-6, 1.0))
    whole = np.floor(octave).astype(np.intp)
    z = (np.clip(special.ndtri(chance), _QUANTILES[0], _QUANTILES[-1]) - _QUANTILES[0]) / (
        _QUANTILES[1] - _QUANTILES[0]
    )
    low = np.minimum(z.astype(np.intp), _QUANTILES.size - 2)
    part = (z - low).astype(np.float32)
    reference, dead_share, events_hz = np.zeros(chance.size, np.float32), np.zeros(chance.size), np.zeros(chance.size)
    # what resets a pixel besides its events, and for how long it is dead after one
    bandwidth_hz, period_us = noise.spec.noise_cutoff_hz, noise.refractory_period_us
    assert bandwidth_hz is not None
    bandwidth_hz *= most_bandwidth(noise)
    dead_s = (period_us or 0) / US_PER_S
    resets_hz = 1 / _LONG_S + (noise.resets_hz if period_us else 0.0)
    octaves = np.unique(np.concatenate([whole, whole[octave > whole] + 1]))
    for step in octaves:
        here = np.flatnonzero(np.abs(octave - step) < 1)
        own_hz = bandwidth_hz / 2.0**step
        laws = _laws(dead_s * own_hz, resets_hz / own_hz, angle / 2.0**step)
        # linear between octaves, thresholds and quantiles: each corner of the cell adds its share
        weight = (1 - np.abs(octave[here] - step)).astype(np.float32)
        for (on, on_weight), (off, off_weight) in product(*(((n, 1 - p), (n + 1, p)) for n, p in where)):
            node = on[here] * _NODES.size + off[here]
            laws.know(np.flatnonzero(np.bincount(node, minlength=_NODES.size**2)))
            all_weight = weight * on_weight[here] * off_weight[here]
            value, following = (laws.quantiles[node, low[here] + k] for k in (0, 1))
            reference[here] += all_weight * (value + part[here] * (following - value))
            dead_share[here] += all_weight * laws.dead_share[node]
            events_hz[here] += all_weight * laws.events[node] * own_hz
    # a pixel is in its dead time with that time's share, at an even place within it
    asleep = of_dead < dead_share
    dead_us = np.where(asleep, (period_us or 0) * of_dead / np.where(asleep, dead_share, 1.0), 0.0)
    return Start(reference, dead_us, events_hz, free)


def start_chances(noise: EvsNoise, seed: int) -> NDArray[np.float64]:
    """Three uniform random numbers of each pixel, [3, pixel]."""
    key = noise.layout.full_index.ravel()[noise.layout.evs_pixel.ravel()]
    none = np.zeros(key.size, np.uint32)
    return uniform(random_words(seed, Stream.EVENT_START, key, none, none)[:3])


def _place(value: NDArray[np.float64], nodes: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Node below each value, and how far the value is to the next one, 0 to 1."""
    number = np.interp(value, nodes, np.arange(nodes.size))
    below = np.minimum(number.astype(np.intp), nodes.size - 2)
    return below, (number - below).astype(np.float32)

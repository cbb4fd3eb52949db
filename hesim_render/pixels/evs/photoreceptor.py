"""The photoreceptor's bandwidth: ln x through two equal poles, stepped exactly.

With u = ln x of the light and a the rate of both poles, z' = a(u − z) and y' = a(z − y); y is the input of the
comparator. For u on a straight line from u₀ to u₁, with x the integral of a from a point of the line to its end,
H that over the whole line, E = exp(−H), and means over the time of the line::

    z₁ = u₁ + E (z₀ − u₀) − mean(exp(−x)) (u₁ − u₀)
    y₁ = u₁ + E (y₀ − u₀ + H (z₀ − u₀)) − mean((1 + x) exp(−x)) (u₁ − u₀)

Where a is constant over a time h, H = ah, and with p = (1 − E)/H the means are p and 2p − E. The step is exact for
every h. Both poles together are −3 dB at f_c, so that a = 2π f_c/√(√2 − 1). A photoreceptor is a second-order system
whose corner rises with the photocurrent [graca2021] until its bias current limits it.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.arrays import take
from hesim_render.pixels.evs.formulas import POLE
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.on_device import EventPixels

#: Nodes per period of the highest corner frequency. Where y comes near a threshold, it is a straight line between them.
NODES_PER_CORNER_PERIOD = 32
#: Where the corner follows the light, most of H and of the change of ln x in one step of the quadrature: y is then good
#: to 1e-5. Fitted at corners up to 300 Hz, abrupt; judged at gradual ones, at 2000 Hz and by the differential
#: equation.
_MOST_H, _MOST_CHANGE = 1.2, 0.5
#: H up to which 1 − exp(−H) is taken from a series.
_SHORT_H = 0.3

#: ln x so near to the light is the light itself, in single precision.
_SETTLED = 1e-7

#: z − u and y − u of each pixel.
_State = tuple[Float, Float]


def _rate(corner_hz: Float) -> Float:
    """a in 1/µs of both poles of a corner frequency."""
    return corner_hz * (POLE / US_PER_S)


class Instant(NamedTuple):
    """A photoreceptor at one time: ln x of the light, and z and y as differences from it; one value per pixel each."""

    t_us: float
    log: Float
    z: Float
    y: Float


class Photoreceptor:
    """State of each pixel's low-pass, with its own time grid.

    A corner frequency that follows the light does so at every instant: a jump of the light changes it at once. Steps
    add up exactly, so the result does not depend on how often the filter is asked.

    Parameters
    ----------
    noise : with `photoreceptor` given.
    """

    STATE = ("_t_us", "_node", "_input", "_state")

    def __init__(self, noise: EvsNoise) -> None:
        spec = noise.photoreceptor
        assert spec is not None
        self._noise, self._spec = noise, spec
        self._period_us = US_PER_S / (NODES_PER_CORNER_PERIOD * spec.cutoff_hz)
        self._t_us = 0.0
        self._node = 0  # the last node at or before the present
        self._input: Float = None  # u
        #: Not z and y: in slow pixels single precision would swallow the last 1e-4 of their way to u.
        self._state: _State = (None, None)

    def _rate_at(self, log: Float, pixels: EventPixels) -> Float:
        return _rate(pixels.corner_hz(log, self._spec))

    @property
    def noise_rate_per_us(self) -> Float:
        """a of the noise in the present light, 1/µs: a number, or one per pixel. Where the corner comes to its limit
        gradually, that of the noise is noise_cutoff_hz.
        """
        bandwidth_hz = self._noise.spec.noise_cutoff_hz or 0.0
        return _rate(self._noise.on_device.corner_hz(self._input, self._spec, bandwidth_hz))

    def _node_at(self, t_us: float) -> int:
        return math.floor(t_us / self._period_us + 1e-6)  # reached, but for rounding

    def start(self, log: Float, t_us: int) -> Float:
        """Begin in the settled state at the light of the first sample. Returns y.

        Parameters
        ----------
        log : ln x of each pixel.
        t_us : time of the sample, µs.
        """
        self._t_us, self._node = float(t_us), self._node_at(t_us)
        settled = dr.zeros(jit().Float, dr.width(log))
        self._input, self._state = log, (settled, settled)
        return log

    def nodes_us(self, end_us: float) -> list[float]:
        """Times of the nodes after the present and before `end_us`, µs."""
        last = math.ceil(end_us / self._period_us - 1e-6) - 1
        return [node * self._period_us for node in range(self._node + 1, last + 1)]

    def rests(self, log: Float, t_us: int) -> bool:
        """Go to `t_us`, µs, at once if y stays as it is: the light is that of before, and all pixels have settled.

        Parameters
        ----------
        log : ln x of each pixel at `t_us`.
        t_us : time of the sample, µs.

        Returns
        -------
        True if the filter is at `t_us` now, where y is `log`; False if it is where it was.
        """
        z, y = self._state
        # the light is that of before, and z and y are too small to matter
        still = (log == self._input) & (z * z + y * y < _SETTLED**2)
        if not dr.all(still)[0]:
            return False
        self.start(log, t_us)
        return True

    def to(self, log: Float, t_us: float) -> Float:
        """y at `t_us`, µs, if ln x goes on a straight line to `log`."""
        elapsed = dr.opaque(jit().Float, t_us - self._t_us)
        self._state = self._stepped(self._state, self._input, log - self._input, elapsed, self._noise.on_device)
        self._input, self._t_us, self._node = log, t_us, self._node_at(t_us)
        dr.schedule(self._input, self._state)
        return log + self._state[1]

    @property
    def now(self) -> Instant:
        """The filter at the present, from which `to` goes on."""
        return Instant(self._t_us, self._input, *self._state)

    def along(
        self, begin: Instant, log: Float, pixel: UInt32, times_us: NDArray[np.float64], line: tuple[Float, Float]
    ) -> tuple[Float, Float, Float]:
        """y of some pixels at some times, if ln x goes on a straight line from `begin` to `log`, plus another line.

        Parameters
        ----------
        begin : the filter before the line.
        log : ln x of each pixel at the end of the line, the last of the times.
        pixel : [n], numbers of the pixels.
        times_us : [nodes], µs, rising, all after `begin`.
        line : what is added at the begin and at the last of the times, [n] each.

        Returns
        -------
        levels : [nodes · n], the pixels of a node side by side.
        least, most : of the levels of each pixel, [n].
        """
        types, pixels, count = jit(), self._noise.on_device.at(pixel), len(times_us)
        before, after, z, y = (take(values, pixel) for values in (begin.log, log, begin.z, begin.y))
        since_us = times_us - begin.t_us
        elapsed_us, parts = (
            from_host(types.Float, values) for values in (np.diff(since_us, prepend=0.0), since_us / since_us[-1])
        )
        lane, lanes = dr.arange(types.UInt32, dr.width(pixel)), dr.opaque(types.UInt32, dr.width(pixel))
        nodes, result = dr.opaque(types.UInt32, count), dr.empty(types.Float, count * dr.width(pixel))

        first_added, last_added = line

        def step(
            node: UInt32, log: Float, z: Float, y: Float, least: Float, most: Float
        ) -> tuple[UInt32, Float, Float, Float, Float, Float]:
            part = dr.gather(types.Float, parts, node)
            following = dr.fma(after - before, part, before)
            z, y = self._stepped((z, y), log, following - log, dr.gather(types.Float, elapsed_us, node), pixels)
            level = following + y + first_added + part * (last_added - first_added)
            dr.scatter(result, level, node * lanes + lane)
            return node + 1, following, z, y, dr.minimum(least, level), dr.maximum(most, level)

        n = dr.width(pixel)
        start = (
            dr.zeros(types.UInt32, n),
            before,
            z,
            y,
            dr.full(types.Float, np.inf, n),
            dr.full(types.Float, -np.inf, n),
        )
        *_, least, most = dr.while_loop(start, lambda node, *_: node < nodes, step, label="photoreceptor nodes")
        return result, least, most

    def _stepped(self, state: _State, begin: Float, change: Float, elapsed_us: Float, pixels: EventPixels) -> _State:
        """State at the end of a line, with the corner of the light at each instant of it.

        Where the corner follows the light, the line has up to two parts: one in which it does, and before or after it
        one in which the corner is the largest. Where the corner comes to its limit gradually, it follows everywhere.

        Parameters
        ----------
        state : at the begin.
        begin, change : of ln x.
        elapsed_us : time of the line, µs.
        pixels : parameters of the pixels.
        """
        types = jit()
        # opaque, so that no corner is written into the kernel
        largest = dr.opaque(types.Float, _rate(self._spec.cutoff_hz))
        if not self._spec.follows_light:
            return _advance(state, change, largest * elapsed_us)
        if self._spec.approach == "gradual":
            return self._follow(state, begin, change, elapsed_us, pixels)
        # the part of the line, 0 to 1, after which the light reaches that of the largest corner
        line = dr.select(change == 0, types.Float(1e-30), change)
        reached = dr.clip((pixels.log_of_largest_corner - begin) / line, 0.0, 1.0)
        # falling light begins at the limit, rising light ends there
        first, last = dr.select(change < 0, reached, 0.0), dr.select(change < 0, 1.0, reached)
        part = last - first
        state = _advance(state, first * change, largest * (first * elapsed_us))
        state = self._follow(state, dr.fma(first, change, begin), part * change, part * elapsed_us, pixels)
        rest = 1.0 - last
        return _advance(state, rest * change, largest * (rest * elapsed_us))

    def _follow(self, state: _State, begin: Float, change: Float, elapsed_us: Float, pixels: EventPixels) -> _State:
        """State at the end of a line on which the corner is below its largest value, in as many steps as the
        quadrature needs.
        """
        types = jit()
        # in still light the corner is constant, and one step is exact whatever its length
        brightest: Float = dr.maximum(begin, begin + change)
        by_light: Float = self._rate_at(brightest, pixels) * (elapsed_us * (1 / _MOST_H))
        by_change: Float = dr.abs(change) * (1 / _MOST_CHANGE)
        steps: Float = dr.maximum(dr.ceil(dr.maximum(by_light, by_change)), 1.0)
        steps = dr.select(change == 0, 1.0, steps)
        part_change, part_us = change / steps, elapsed_us / steps

        def step(number: Float, z: Float, y: Float) -> tuple[Float, Float, Float]:
            here = dr.fma(number, part_change, begin)
            return number + 1.0, *self._quadrature((z, y), here, part_change, part_us, pixels)

        start = dr.zeros(types.Float, dr.width(steps)), *state
        return dr.while_loop(start, lambda number, *_: number < steps, step, label="photoreceptor")[1:]

    def _quadrature(self, state: _State, begin: Float, change: Float, elapsed_us: Float, pixels: EventPixels) -> _State:
        """State at the end of a short line on which the corner follows the light, by Gauss and Legendre."""
        # corner times elapsed time at the three points of the quadrature
        rates = [self._rate_at(dr.fma(change, place, begin), pixels) * elapsed_us for place in _PLACES]
        total = sum(weight * rate for weight, rate in zip(_WEIGHTS, rates, strict=True))
        rests = [sum(weight * rate for weight, rate in zip(row, rates, strict=True)) for row in _REST]
        # what is left at the end of what came in at each point
        decays = [weight * dr.exp(-rest) for weight, rest in zip(_WEIGHTS, rests, strict=True)]
        lag = sum(decays)
        later = sum(decay * rest for decay, rest in zip(decays, rests, strict=True))
        return _decayed(state, total, (lag * change, (lag + later) * change))

    def follow(self, log: Float, t_us: int) -> Float:
        """y at the next sample. The first call begins in the settled state.

        Parameters
        ----------
        log : ln x of each pixel at the sample.
        t_us : time of the sample, µs.
        """
        if self._input is None:
            return self.start(log, t_us)
        return log if self.rests(log, t_us) else self.to(log, float(t_us))


def _advance(state: _State, change: Float, h: Float) -> _State:
    """State at the end of a line of constant corner; `h` is H."""
    lag = dr.select(h < _SHORT_H, _short_lag(h), (1.0 - dr.exp(-h)) / h)  # p
    return _decayed(state, h, (lag * change, (2.0 * lag - dr.exp(-h)) * change))


def _decayed(state: _State, h: Float, shift: _State) -> _State:
    """State after its decay over H and a shift down."""
    z, y = state[0], dr.fma(h, *state)
    # next to 1, E would lose the digits of 1 − E
    left, loss, is_short = dr.exp(-h), h * _short_lag(h), h < _SHORT_H
    z, y = (dr.select(is_short, dr.fma(-loss, value, value), left * value) for value in (z, y))
    return z - shift[0], y - shift[1]


def _short_lag(h: Float) -> Float:
    """p = (1 − exp(−h))/h by its series, good to 1e-8 up to `_SHORT_H`."""
    series = dr.fma(h, 1 / 5040, -1 / 720)
    for term in (1 / 120, -1 / 24, 1 / 6, -1 / 2, 1.0):
        series = dr.fma(h, series, term)
    return series


# A quadrature of three points on [0, 1], exact for polynomials of degree 5: its points and weights, and the weights
# of the same points for the integral from each of them to 1, exact for polynomials of degree 2.
_points, _weights = np.polynomial.legendre.leggauss(3)
_PLACES: list[float] = (0.5 * (1 + _points)).tolist()
_WEIGHTS: list[float] = (0.5 * _weights).tolist()
_powers = np.power.outer(_PLACES, np.arange(3))
_REST: list[list[float]] = (
    (1 - np.power.outer(_PLACES, np.arange(1, 4))) / np.arange(1, 4) @ np.linalg.inv(_powers)
).tolist()

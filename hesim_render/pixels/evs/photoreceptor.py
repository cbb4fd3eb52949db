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

from __future__ import annotations

import math

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.evs.formulas import POLE
from hesim_render.pixels.evs.model import EvsNoise

#: Nodes per period of the highest corner frequency. Between nodes, y is taken as a straight line.
NODES_PER_CORNER_PERIOD = 32

#: ln x so near to the light is the light itself, in single precision.
_SETTLED = 1e-7

#: z − u and y − u of each pixel.
_State = tuple[Float, Float]


def _rate(corner_hz: Float) -> Float:
    """a in 1/µs of both poles of a corner frequency."""
    return corner_hz * (POLE / US_PER_S)


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

    def _rate_at(self, log: Float) -> Float:
        return _rate(self._noise.on_device.corner_hz(log, self._spec))

    @property
    def rate_per_us(self) -> Float:
        """a of both poles in the present light, 1/µs: a number, or one per pixel."""
        return self._rate_at(self._input) if self._spec.follows_light else _rate(self._spec.cutoff_hz)

    @property
    def noise_rate_per_us(self) -> Float:
        """The same for the noise, of which photoreceptor_cutoff_hz is the limit, where the corner comes to it
        gradually.
        """
        bandwidth_hz = self._noise.spec.photoreceptor_cutoff_hz or 0.0
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
        import drjit as dr

        self._t_us, self._node = float(t_us), self._node_at(t_us)
        settled = dr.zeros(jit().Float, dr.width(log))
        self._input, self._state = log, (settled, settled)
        return log

    def nodes_us(self, end_us: float) -> list[float]:
        """Times of the nodes after the present and before `end_us`."""
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
        import drjit as dr

        z, y = self._state
        # the light is that of before, and z and y are too small to matter
        still = (log == self._input) & (z * z + y * y < _SETTLED**2)
        if not dr.all(still)[0]:
            return False
        self.start(log, t_us)
        return True

    def to(self, log: Float, t_us: float) -> Float:
        """y at `t_us`, µs, if ln x goes on a straight line to `log`. No node lies in between."""
        import drjit as dr

        line = self._followed if self._spec.follows_light else self._held
        self._state = line(log - self._input, t_us - self._t_us)
        self._input, self._t_us, self._node = log, t_us, self._node_at(t_us)
        dr.eval(self._input, self._state)
        return log + self._state[1]

    def _held(self, change: Float, elapsed_us: float) -> _State:
        """State at the end of a line, with the same corner in any light."""
        import drjit as dr

        h = self.rate_per_us * elapsed_us
        loss = -math.expm1(-h)
        return _advance(self._state, change, *(dr.opaque(jit().Float, number) for number in (h, loss / h, loss)))

    def _followed(self, change: Float, elapsed_us: float) -> _State:
        """State at the end of a line, with the corner of the light at each instant of it.

        The line has up to two parts: one in which the corner follows the light, and before or after it one in which
        the corner is the largest. Where the corner comes to its limit gradually, it follows the light everywhere.
        """
        import drjit as dr

        types = jit()
        begin, elapsed = self._input, dr.opaque(types.Float, elapsed_us)
        if self._spec.approach == "gradual":
            return self._follow_inside(self._state, begin, change, elapsed)
        # the largest corner, and the part of the line, 0 to 1, after which the light reaches it
        largest = dr.opaque(types.Float, _rate(self._spec.cutoff_hz))
        line = dr.select(change == 0, types.Float(1e-30), change)
        reached = dr.clip((self._noise.on_device.log_of_largest_corner - begin) / line, 0.0, 1.0)
        # falling light begins at the limit, rising light ends there
        first, last = dr.select(change < 0, reached, 0.0), dr.select(change < 0, 1.0, reached)

        def at_limit(state: _State, part: Float) -> _State:
            h = largest * (part * elapsed)
            return _advance(state, part * change, h, lag := _lag(h), h * lag)

        part = last - first
        state = at_limit(self._state, first)
        state = self._follow_inside(state, dr.fma(first, change, begin), part * change, part * elapsed)
        return at_limit(state, 1.0 - last)

    def _follow_inside(self, state: _State, begin: Float, change: Float, elapsed_us: Float) -> _State:
        """State at the end of a line on which the corner is below its largest value.

        The integrals are quadratures of Gauss and Legendre. In y they are good to 1e-6 for changes of ln x up to 1
        between two nodes, and to 1e-4 for changes of 4.
        """
        import drjit as dr

        # corner times elapsed time at the three points of the quadrature
        rates = [self._rate_at(dr.fma(change, place, begin)) * elapsed_us for place in _PLACES]
        total = sum(weight * rate for weight, rate in zip(_WEIGHTS, rates, strict=True))
        rests = [sum(weight * rate for weight, rate in zip(row, rates, strict=True)) for row in _REST]
        # what is left at the end of what came in at each point
        decays = [weight * dr.exp(-rest) for weight, rest in zip(_WEIGHTS, rests, strict=True)]
        lag = sum(decays)
        later = sum(decay * rest for decay, rest in zip(decays, rests, strict=True))
        return _decayed(state, total, total * _lag(total), (lag * change, (lag + later) * change))

    def follow(self, log: Float, t_us: int) -> Float:
        """y at the next sample, over all nodes in between. The first call begins in the settled state.

        Parameters
        ----------
        log : ln x of each pixel at the sample.
        t_us : time of the sample, µs.
        """
        import drjit as dr

        if self._input is None:
            return self.start(log, t_us)
        if self.rests(log, t_us):
            return log
        if self._spec.follows_light:
            # corners that follow the light need nodes, between which ln x is a line
            before, begin_us = self._input, self._t_us
            for node_us in self.nodes_us(t_us):
                part = dr.opaque(jit().Float, (node_us - begin_us) / (t_us - begin_us))
                self.to(dr.fma(log - before, part, before), node_us)
        return self.to(log, float(t_us))


def _advance(state: _State, change: Float, h: Float, lag: Float, loss: Float) -> _State:
    """State at the end of a line of constant corner: `h` is H, `lag` is p, `loss` is 1 − E."""
    return _decayed(state, h, loss, (lag * change, (2.0 * lag - (1.0 - loss)) * change))


def _decayed(state: _State, h: Float, loss: Float, shift: _State) -> _State:
    """State after its decay and a shift down. Next to 1, E would lose the digits of `loss`, which is 1 − E."""
    import drjit as dr

    z, y = state[0], dr.fma(h, *state)
    return dr.fma(-loss, z, z) - shift[0], dr.fma(-loss, y, y) - shift[1]


def _lag(h: Float) -> Float:
    """p = (1 − exp(−h))/h by its series, good to 1e-8 up to the 0.305 that two nodes have between them at most."""
    import drjit as dr

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

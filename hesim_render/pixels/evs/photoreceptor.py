"""The photoreceptor's bandwidth: ln x through two equal poles, stepped exactly.

With u = ln x of the light and a the rate of both poles, z' = a(u − z) and y' = a(z − y); y is the input of the
comparator. For u on a straight line from u₀ to u₁ in a time h, with E = exp(−ah) and p = (1 − E)/(ah)::

    z₁ = u₁ + E (z₀ − u₀) − p (u₁ − u₀)
    y₁ = u₁ + E (y₀ − u₀ + ah (z₀ − u₀)) − (2p − E)(u₁ − u₀)

The step is exact for every h. Both poles together are −3 dB at f_c, so that a = 2π f_c/√(√2 − 1). A photoreceptor is a
second-order system whose corner rises with the photocurrent [graca2021] until its bias current limits it.
"""

from __future__ import annotations

import math

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.evs.model import EvsNoise

#: Nodes per period of the highest corner frequency. Between nodes, y is taken as a straight line.
NODES_PER_CORNER_PERIOD = 32

#: Below this a·h, 1 − E is a difference of nearly equal numbers. A series of five terms is accurate to 2e-8 there.
_SERIES_BELOW = 0.1


def _rate(corner_hz: Float) -> Float:
    """a in 1/µs of both poles of a corner frequency."""
    return corner_hz * (math.tau / math.sqrt(math.sqrt(2.0) - 1.0) / US_PER_S)


class Photoreceptor:
    """State of each pixel's low-pass, with its own time grid.

    A corner frequency that follows the light is constant from one node of the grid to the next. Its value is that
    at the middle of the stretch, on the straight line through the previous node and this one. Steps within a stretch
    add up exactly, so the result does not depend on how often the filter is asked.

    Parameters
    ----------
    noise : with `photoreceptor` given.
    """

    STATE = ("_t_us", "_node", "_input", "_state", "_rate", "_node_rate")

    def __init__(self, noise: EvsNoise) -> None:
        spec = noise.photoreceptor
        assert spec is not None
        self._noise, self._spec = noise, spec
        self._period_us = US_PER_S / (NODES_PER_CORNER_PERIOD * spec.cutoff_hz)
        self._t_us = 0.0
        self._node = 0  # the last node at or before the present
        self._input: Float = None  # u
        self._state: tuple[Float, Float] = (None, None)  # z, y
        self._rate: Float = None  # a in 1/µs up to the next node: a number, or one per pixel
        self._node_rate: Float = None  # a at the last node

    def _rate_at(self, log: Float) -> Float:
        spec = self._spec
        return _rate(self._noise.on_device.corner_hz(log, spec) if spec.follows_light else spec.cutoff_hz)

    @property
    def rate_per_us(self) -> Float:
        """a of both poles up to the next node, 1/µs: a number, or one per pixel."""
        return self._rate

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
        self._input, self._state = log, (log, log)
        self._rate = self._node_rate = self._rate_at(log)
        return log

    def nodes_us(self, end_us: float) -> list[float]:
        """Times of the nodes after the present and before `end_us`."""
        last = math.ceil(end_us / self._period_us - 1e-6) - 1
        return [node * self._period_us for node in range(self._node + 1, last + 1)]

    def to(self, log: Float, t_us: float) -> Float:
        """y at `t_us`, µs, if ln x goes on a straight line to `log`. No node lies in between."""
        import drjit as dr

        types = jit()
        elapsed_us = t_us - self._t_us
        if self._spec.follows_light:
            h = self._rate * dr.opaque(types.Float, elapsed_us)
            decay = dr.exp(-h)
            series = dr.fma(h, dr.fma(h, dr.fma(h, dr.fma(h, 1 / 120, -1 / 24), 1 / 6), -0.5), 1.0)
            lag = dr.select(h < _SERIES_BELOW, series, (1.0 - decay) / h)
        else:
            exact = self._rate * elapsed_us
            h, decay, lag = (
                dr.opaque(types.Float, value) for value in (exact, math.exp(-exact), -math.expm1(-exact) / exact)
            )
        z, y = self._state
        change, z_off = log - self._input, z - self._input
        self._state = (
            log + (decay * z_off - lag * change),
            log + (decay * dr.fma(h, z_off, y - self._input) - (2.0 * lag - decay) * change),
        )
        self._input, self._t_us = log, t_us
        dr.eval(self._input, self._state)
        node = self._node_at(t_us)
        if self._spec.min_cutoff_hz is not None and node > self._node:
            before, now = self._node_rate, self._rate_at(log)
            lowest = dr.maximum(0.5 * now, _rate(self._spec.min_cutoff_hz))
            highest = dr.minimum(2.0 * now, _rate(self._spec.cutoff_hz))
            self._node_rate, self._rate = now, dr.clip(dr.fma(0.5, now - before, now), lowest, highest)
            dr.eval(self._rate, self._node_rate)
        self._node = node
        return self._state[1]

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
        if self._spec.follows_light:
            before, begin_us = self._input, self._t_us
            for node_us in self.nodes_us(t_us):
                part = dr.opaque(jit().Float, (node_us - begin_us) / (t_us - begin_us))
                self.to(dr.fma(log - before, part, before), node_us)
        return self.to(log, float(t_us))

"""Processes in time of asynchronous event pixels: band-limited noise and leak events.

Both are functions of the seed, the pixel and the time of the first sample. They do not depend on how often they are
asked.

Where the bandwidth of the noise differs from pixel to pixel, with f_c the ``noise_cutoff_hz``, z a normal
deviate of the pixel, r and c of `NoiseSpreadSpec`::

    f = f_c · exp(bandwidth_rel · z) · (1 ± r)(1 ± c)

with plus in odd rows and columns of the event grid of the full sensor. The noise keeps its variance.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Float64, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal, normal_pair, philox, stream_key
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.evs.formulas import POLE
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.photoreceptor import Photoreceptor

#: Nodes of the noise per period of the photoreceptor's cut-off frequency.
NODES_PER_CUTOFF_PERIOD = 16


class BandNoise:
    """Unit noise of each pixel, band-limited at the cut-off: exact at nodes, linear in between.

    It is white noise through two equal poles that are −3 dB at the cut-off together. With a = 2π f_c/√(√2 − 1) its
    correlation is (1 + a|τ|)·exp(−a|τ|). Its slope is finite, so it crosses a level at a finite rate [rice1945]: it
    crosses zero upwards a/2π times a second. Behind a single pole that rate would have no limit, and event rates would
    depend on the spacing of the nodes.

    The state (u, u'/a) steps from node to node with its exact transition matrix. Between nodes the interpolated
    variance averages (2 + ρ)/3, with ρ the correlation of neighbouring nodes. The amplitude is scaled to compensate.

    Pixels of unlike bandwidths have nodes at the same times, those of the largest one. Where the photoreceptor filters
    the noise, a is at most its rate at each node, one per pixel. In the units of the state the
    stationary law is the same for every a, so that the variance stays 1 while a changes.

    Parameters
    ----------
    noise : noise model of the pixels.
    seed : seed of the noise.
    photoreceptor : gives the rate a of each pixel; None where the noise has the same bandwidth in all.
    """

    STATE = ("_node", "_value", "_state")

    def __init__(self, noise: EvsNoise, seed: int, photoreceptor: Photoreceptor | None = None) -> None:
        cutoff_hz = noise.spec.noise_cutoff_hz
        assert cutoff_hz is not None
        self._key, self._seed = noise.on_device.key, seed
        self._period_us = US_PER_S / (NODES_PER_CUTOFF_PERIOD * cutoff_hz * most_bandwidth(noise))
        h = POLE / NODES_PER_CUTOFF_PERIOD  # a·period
        self._transition = math.exp(-h) * np.array([[1.0 + h, h], [-h, 1.0 - h]])
        self._amplitude = math.sqrt(3.0 / (2.0 + (1.0 + h) * math.exp(-h)))
        # in the stationary state u and u'/a are independent, each of variance 1
        fresh = np.eye(2) - self._transition @ self._transition.T
        self._fresh = self._amplitude * np.linalg.cholesky(fresh)
        self._photoreceptor, self._largest = photoreceptor, h
        own = bandwidth_map(noise)
        self._own: Float = None if own is None else from_host(jit().Float, h * own / np.float32(most_bandwidth(noise)))
        self._is_alike = photoreceptor is None and own is None
        if not self._is_alike:
            self._amplitude = 1.0  # each pixel has its own, see `_scale`
        self._node = 0  # the last node at or before the present
        self._value: Float = None  # u at that node
        self._state: tuple[Float, Float] = (None, None)  # u and u'/a at the next one

    def _deviates(self, node: int) -> tuple[Float, Float]:
        # deviates belong to a node, whatever was asked for before
        word = philox(self._seed, Stream.EVS, self._key, node & ((1 << 48) - 1)).next_uint32x4()
        return normal_pair(word[0], word[1])

    def _advance(self) -> None:
        """Step the state by one node."""
        self._value, speed = self._state
        z = self._deviates(self._node + 1)
        if not self._is_alike:
            self._state = _step(self._value, speed, self._angle(), z)
            dr.schedule(self._state)
            return
        self._state = tuple(
            float(f[0]) * self._value + float(f[1]) * speed + float(g[0]) * z[0] + float(g[1]) * z[1]
            for f, g in zip(self._transition, self._fresh, strict=True)
        )
        dr.schedule(self._state)

    def start(self, t_us: int) -> Float:
        """Begin in the stationary state. Returns the noise at `t_us`, µs."""
        self._node = math.floor(t_us / self._period_us)
        self._state = tuple(self._amplitude * z for z in self._deviates(self._node))
        self._advance()
        dr.eval(self._value)
        return self.at(t_us)

    @property
    def angle(self) -> float:
        """a times the time between nodes, of pixels with the largest bandwidth."""
        return self._largest

    def share(self, pixels: int) -> NDArray[np.float64]:
        """Bandwidth of each pixel's noise over the largest, [pixels]."""
        if self._is_alike:
            return np.ones(pixels)
        return np.broadcast_to(np.asarray(self._angle(), np.float64) / self._largest, pixels)

    def periods_us(self, count: float) -> int:
        """Time of `count` periods of the largest bandwidth, whole µs."""
        return math.ceil(count * NODES_PER_CUTOFF_PERIOD * self._period_us)

    def nodes_us(self, end_us: float) -> list[float]:
        """Times of the nodes after the present and before `end_us`."""
        last = math.ceil(end_us / self._period_us) - 1
        return [node * self._period_us for node in range(self._node + 1, last + 1)]

    def at(self, t_us: float) -> Float:
        """The noise at `t_us`, which lies at most one node ahead of the present."""
        # how far the time is on the way to the next node
        part = t_us / self._period_us - self._node
        if part > 1.0 - 1e-9:  # the next node is reached, but for rounding
            self._node += 1
            self._advance()
            part = max(t_us / self._period_us - self._node, 0.0)
        # a line between nodes
        value = dr.fma(self._state[0] - self._value, dr.opaque(jit().Float, part), self._value)
        return value if self._is_alike else value * self._scale()

    def _angle(self) -> Float:
        """h = a·period of each pixel."""
        if self._own is not None:
            return self._own
        assert self._photoreceptor is not None
        return dr.minimum(self._photoreceptor.noise_rate_per_us * self._period_us, self._largest)

    def _scale(self) -> Float:
        """Amplitude that compensates the interpolation, for each pixel's own rate."""
        h = self._angle()
        return dr.sqrt(3.0 / dr.fma(1.0 + h, dr.exp(-h), 2.0))


#: Below this 2h, the variance that a step adds to u is a difference of nearly equal numbers; the series of six terms
#: is accurate to 1e-6 there.
_SERIES_BELOW = 0.3


def _step(value: Float, speed: Float, h: Float, z: tuple[Float, Float]) -> tuple[Float, Float]:
    """One step of the state (u, u'/a) with h = a·Δt of each pixel, and two normal deviates.

    With E = exp(−h) and x = 2h, what the step adds has Var u = 1 − E²(1 + x + x²/2) = ½ x³ Σ (−x)^k / (k! (k + 3)),
    covariance E² x²/2, and Var u'/a = 1 − E²(1 − x + x²/2).
    """
    decay = dr.exp(-h)
    # Horner's scheme of the series of Var u, from its last term
    x, squared = 2.0 * h, decay * decay
    series = dr.fma(x, -1 / 960, 1 / 168)
    for term in (-1 / 36, 1 / 10, -1 / 4, 1 / 3):
        series = dr.fma(x, series, term)
    exact = 1.0 - squared * dr.fma(x, dr.fma(x, 0.5, 1.0), 1.0)
    own = dr.select(x < _SERIES_BELOW, 0.5 * x * x * x * series, exact)
    both = 0.5 * squared * x * x
    # variance of u'/a that is left when its part common with u is taken off (Cholesky)
    rest = 1.0 - squared * dr.fma(x, dr.fma(x, 0.5, -1.0), 1.0) - both * both / own
    root = dr.sqrt(own)
    return (
        decay * dr.fma(h, value + speed, value) + root * z[0],
        decay * (speed - h * (value + speed)) + both / root * z[0] + dr.sqrt(dr.maximum(rest, 0.0)) * z[1],
    )


class RandomEvents:
    """Events at random times: of the leak, or of the comparators' noise. The waiting times of each pixel are
    exponentially distributed.

    Parameters
    ----------
    key : full-sensor index of each pixel.
    seed : seed of the events.
    stream : purpose of the random numbers.
    rate_hz : events of a pixel.
    """

    STATE = ("_due_us", "_count")

    def __init__(self, key: UInt32, seed: int, stream: Stream, rate_hz: float) -> None:
        self._key, self._stream_key = key, stream_key(seed, stream)
        self._mean_us = US_PER_S / rate_hz
        self._due_us: Float64 = None
        self._count: UInt32 = None  # events so far

    def _wait_us(self, key: UInt32, count: UInt32) -> Float64:
        types = jit()
        word = types.Philox4x32(dr.opaque(types.UInt64, self._stream_key), key, count).next_uint32x4()[0]
        return types.Float64(-dr.log(dr.fma(types.Float(word), 2.0**-32, 2.0**-33))) * self._mean_us

    def start(self, t_us: int) -> None:
        self._count = dr.zeros(jit().UInt32, dr.width(self._key))
        # opaque: a time written into the kernel would have the kernel compiled again for every time
        self._due_us = self._wait_us(self._key, self._count) + dr.opaque(jit().Float64, float(t_us))
        dr.eval(self._due_us)

    def until(self, t_us: float) -> Iterator[tuple[NDArray[np.float64], NDArray[np.uint32]]]:
        """Times (µs) and pixels of the events up to `t_us`, µs. Each round has the next event of each pixel that has
        one.
        """
        types = jit()
        end_us = dr.opaque(types.Float64, float(t_us))
        # pixels with an event before the end; after each round those that have another one
        pixel: UInt32 = dr.compress(self._due_us <= end_us)
        while dr.width(pixel):
            due_us = dr.gather(types.Float64, self._due_us, pixel)
            count = dr.gather(types.UInt32, self._count, pixel) + 1
            # the next waiting time has the number of the event as its counter
            following = due_us + self._wait_us(dr.gather(types.UInt32, self._key, pixel), count)
            dr.eval(due_us, count, following)
            dr.scatter(self._due_us, following, pixel)
            dr.scatter(self._count, count, pixel)
            yield np.array(due_us), np.array(pixel)
            again: UInt32 = dr.compress(following <= end_us)
            pixel = dr.gather(types.UInt32, pixel, again)


def most_bandwidth(noise: EvsNoise) -> float:
    """Largest bandwidth of a pixel's noise over noise_cutoff_hz."""
    spread = noise.spec.noise_spread
    return 1.0 if spread is None or "mismatch" in noise.off else spread.most


def bandwidth_map(noise: EvsNoise) -> NDArray[np.float32] | None:
    """Bandwidth of each event pixel's noise over noise_cutoff_hz, row-major; None where all are alike."""
    spread, layout = noise.spec.noise_spread, noise.layout
    if spread is None or "mismatch" in noise.off:
        return None
    index = layout.full_index.ravel()[layout.evs_pixel.ravel()]
    places = np.divmod(index.astype(np.int64), layout.spec.geometry.cols)
    factor = np.exp(spread.bandwidth_rel * device_normal(noise.device_seed, Stream.NOISE_SPREAD, index))
    for axis, part in enumerate((spread.odd_rows_rel, spread.odd_cols_rel)):
        # row, or column, of the event grid of the full sensor
        size = layout.tile_shape[axis]
        inside = np.unique([position[axis] for position in layout.spec.positions("evs")])
        line = places[axis] // size * inside.size + np.searchsorted(inside, places[axis] % size)
        factor = factor * (1 + part * (2 * (line % 2) - 1))
    return np.minimum(factor, spread.most).astype(np.float32)

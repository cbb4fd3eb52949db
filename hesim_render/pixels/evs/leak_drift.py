"""Leak of asynchronous event pixels as a drift of the reference level towards ON events.

The current of a junction in the change amplifier, and a photocurrent of its own that grows with the light, move the
reference [nozaki2017]. Without noise a pixel gives ON events in equal intervals θ₊/current; its noise moves them. The
current of a pixel, in thresholds of the nominal pixel per second, is::

    (rate_hz + rate_hz_per_dn · I)(1 + spread_rel · z) + tail,   P(tail > r) = tail_hz/(tail_hz + r)

with z a normal deviate of the pixel, the factor not below 0.05, and no tail above 1000 Hz.

The reference stays where it is, and all levels are taken as higher by the way of the drift since the start: that sum
is kept in double precision, so that small steps of it are not lost.
"""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Float64
from hesim_render.core.host_arrays import from_host
from hesim_render.core.rng import Stream, device_normal, device_uniform
from hesim_render.core.units import US_PER_S
from hesim_render.pixels.evs.events import Origin
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.noise_rates import LEAST_THRESHOLD_REL
from hesim_render.specs.event_pixels import MOST_TAIL_HZ

#: Way of the drift, ln units, after which levels and reference are moved back together.
_FAR = 4.0


class LeakDrift:
    """Way of each pixel's drift (a leak of the process 'drift'), and what it says about the origin of events."""

    STATE = ("_way", "_per_us", "_at_event")

    def __init__(self, noise: EvsNoise) -> None:
        spec, layout = noise.leak_drift, noise.layout
        assert spec is not None
        index = layout.full_index.ravel()[layout.evs_pixel.ravel()]
        size = index.size
        relative = np.ones(size)
        if spec.spread_rel > 0:
            relative += spec.spread_rel * device_normal(noise.device_seed, Stream.LEAK_SPREAD, index)
            relative = np.maximum(relative, LEAST_THRESHOLD_REL)
        tail_hz = np.zeros(size)
        if spec.tail_hz > 0:
            most = MOST_TAIL_HZ / (spec.tail_hz + MOST_TAIL_HZ)
            place = most * device_uniform(noise.device_seed, Stream.LEAK_TAIL, index)
            tail_hz = spec.tail_hz * place / (1 - place)
        unit = noise.spec.contrast_threshold_on / US_PER_S
        per_electron = noise.dn_per_electron[layout.evs_position.ravel()]
        types = jit()
        self._dark: Float64 = from_host(types.Float64, unit * (relative * spec.rate_hz + tail_hz))
        self._light: Float64 = from_host(types.Float64, unit * relative * spec.rate_hz_per_dn * per_electron)
        self._theta_on = np.broadcast_to(np.ravel(noise.threshold_on_map), size).astype(np.float64)
        self._way: Float64 = None  # since the start, at the last sample
        self._per_us: Float64 = None  # speed at the last sample
        self._at_event: NDArray[np.float64] = np.zeros(size)  # way at the last event of each pixel

    def _speed(self, electrons: Float) -> Float64:
        return dr.fma(self._light, dr.maximum(jit().Float64(electrons), 0.0), self._dark)

    def start(self, electrons: Float, is_reset: bool, events_hz: NDArray[np.float64], chance: NDArray) -> None:
        """Begin at the first sample.

        Parameters
        ----------
        electrons : of the window, Float [pixel].
        is_reset : all pixels begin with an event; otherwise their last one lies as far back as after a long time.
        events_hz : noise events of each pixel, Hz, which end a drift before its own event.
        chance : [pixel], a uniform random number of each pixel.
        """
        self._per_us = self._speed(electrons) + dr.zeros(jit().Float64, self._theta_on.size)
        way = np.zeros(self._theta_on.size)
        if not is_reset:
            # the time since the last event, between 0 and a whole drift: uniform where noise gives no events, else
            # exponential
            per_us = np.maximum(np.array(self._per_us), 1e-30)
            whole_us, per_event = self._theta_on / per_us, events_hz / US_PER_S
            ends = per_event * whole_us  # noise events that a whole drift would have
            few = ends < 1e-6
            late_us = -np.log1p(chance * np.expm1(-ends)) / np.where(few, 1.0, per_event)
            way = np.minimum(np.where(few, chance * whole_us, late_us), whole_us) * per_us
        self._way = from_host(jit().Float64, way)
        self._at_event = np.zeros(self._theta_on.size)
        dr.eval(self._way, self._per_us)

    @property
    def way(self) -> Float:
        """Way at the last sample, ln x [pixel]."""
        return jit().Float(self._way)

    def at(self, electrons: Float, part: float, elapsed_us: float) -> Float:
        """Way at a time after the last sample, ln x [pixel]; the current is the mean of those of both samples.

        Parameters
        ----------
        electrons : of the window of the next sample.
        part, elapsed_us : time after the last sample, over that of the next one, and in µs.
        """
        types = jit()
        mean = dr.fma(self._speed(electrons) - self._per_us, dr.opaque(types.Float64, 0.5 * part), self._per_us)
        return types.Float(dr.fma(mean, dr.opaque(types.Float64, elapsed_us), self._way))

    def pass_by(self, events: NDArray[np.void], cols: int, electrons: Float, begin_us: int, end_us: int) -> NDArray:
        """Go to the next sample. ON events that are half the drift's at least get its origin.

        Parameters
        ----------
        events : all events between both samples that set the reference, sorted by time; changed in place.
        cols : columns of the event grid.
        electrons : of the window of the next sample.
        begin_us, end_us : times of both samples, µs.

        Returns
        -------
        [pixel], by how much levels and references are to be lowered: 0 but for pixels that have drifted far.
        """
        types = jit()
        length_us = float(end_us - begin_us)
        later = self._speed(electrons) + dr.zeros(types.Float64, self._theta_on.size)
        if events.size:
            pixel = events["y"].astype(np.uint32) * np.uint32(cols) + events["x"]
            order = np.argsort(pixel, kind="stable")
            place = from_host(types.UInt32, pixel[order])
            # way of each event's pixel at the time of the event: the speed goes on a line between both samples
            way, before, after = (
                np.array(dr.gather(types.Float64, values, place)) for values in (self._way, self._per_us, later)
            )
            own = pixel[order]
            elapsed = np.minimum(events["t_us"][order] - float(begin_us), length_us)
            at = way + (before + (after - before) * (0.5 / length_us) * elapsed) * elapsed
            # what has drifted since the event before, which is of this call or an earlier one
            first = np.diff(own.astype(np.int64), prepend=-1) != 0
            since = at - np.where(first, self._at_event[own], np.append(0.0, at[:-1]))
            drifted = (events["polarity"][order] == 1) & (since > 0.5 * self._theta_on[own])
            events["polarity"][order[drifted]] = Origin.DRIFT
            self._at_event = self._at_event.copy()  # a saved state keeps its own
            self._at_event[own] = at  # the last one of a pixel is written last
        # whole steps of a long way are taken off, so that float32 levels keep their small ones
        way = self._way + (self._per_us + later) * dr.opaque(types.Float64, 0.5 * length_us)
        down = dr.floor(way / _FAR) * _FAR
        self._way, self._per_us = way - down, later
        dr.eval(self._way, self._per_us, down)
        lower = np.array(down)
        self._at_event = self._at_event - lower
        return lower

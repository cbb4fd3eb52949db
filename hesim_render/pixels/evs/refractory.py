"""Dead time of asynchronous event pixels: for a while after an event the pixel is held in reset.

No event of a pixel comes within the period after its last one, leak events included. At the end of the
period the change amplifier is released, and the reference is the level of that instant, as in a DVS pixel
[lichtsteiner2008]. On a steady slope a pixel therefore fires every period + θ/slope.
"""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.arrays import take
from hesim_render.pixels.evs.crossings import DueEvents, events_on_paths, level_at, listed

#: Before any time, µs.
LONG_AGO_US = -1e18


class Refractory:
    """Time at which each pixel will be ready again.

    Parameters
    ----------
    period_us : dead time, µs.
    pixels : number of pixels.
    """

    STATE = ("_ready_us",)

    def __init__(self, period_us: float, pixels: int) -> None:
        self._period_us = float(period_us)
        self._ready_us = dr.full(jit().Float64, LONG_AGO_US, pixels)

    def begin(self, ready_us: NDArray[np.float64]) -> None:
        """Let each pixel be ready at a time [pixel], µs."""
        self._ready_us = from_host(jit().Float64, ready_us)

    def crossings(
        self,
        reference: Float,
        levels: tuple[Float, Float],
        thresholds: tuple[Float, Float],
        begin_us: float,
        end_us: float,
        due: DueEvents,
    ) -> tuple[Float, NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]]:
        """Events of one segment in which the level goes on a straight line from `levels[0]` to `levels[1]`.

        Parameters
        ----------
        reference : level with which each pixel compares, Float.
        levels : levels at the begin and the end of the segment, one value per pixel.
        thresholds : θ₊, θ₋; numbers or one per pixel.
        begin_us, end_us : bounds of the segment, µs.
        due : leak events in the segment, and those of defects.

        Returns
        -------
        reference : the new one.
        t_us, pixel, polarity : the events, unsorted; the polarity times their `Origin`.
        """
        types = jit()
        theta_on, theta_off = thresholds
        level_0, level_1 = levels
        rest = types.Float(self._ready_us - dr.opaque(types.Float64, begin_us))
        # pixels whose dead time ends within the segment take the level of that moment as their reference
        rest /= dr.opaque(types.Float, end_us - begin_us)  # part of the segment that is dead
        awake = rest <= 1.0
        released = awake & (rest > 0.0)
        reference = dr.select(released, dr.fma(level_1 - level_0, rest, level_0), reference)
        distance = level_1 - reference
        hit = awake & ((distance >= theta_on) | (distance <= -theta_off))
        dr.eval(reference, hit)
        # only pixels that cross, or leak, go to the host, where each may have several events
        result = listed(np.array(hit), due)
        if result.size == 0:
            return reference, *(np.empty(0, kind) for kind in (np.float64, np.uint32, np.float64))
        pixel = from_host(types.UInt32, result)
        gathered = [dr.gather(types.Float, value, pixel) for value in (reference, level_0, level_1)]
        gathered += [take(theta_on, pixel) + dr.zeros(types.Float, result.size), take(theta_off, pixel)]
        ready = np.array(dr.gather(types.Float64, self._ready_us, pixel))
        own, low, high, on, off = (np.array(value).astype(np.float64) for value in gathered)
        theta = on, np.broadcast_to(off, result.shape)
        path = np.stack([low, high]), np.array([begin_us, end_us])
        own, ready, *events = events_on_paths(result, *path, own, theta, due, ready, self._period_us)
        dr.scatter(reference, from_host(types.Float, own), pixel)
        dr.scatter(self._ready_us, from_host(types.Float64, ready), pixel)
        dr.eval(reference, self._ready_us)
        return reference, *events

    def crossings_on_curves(
        self,
        pixel: NDArray[np.uint32],
        levels: NDArray[np.float32],
        times_us: NDArray[np.float64],
        reference: NDArray[np.float64],
        thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
        due: DueEvents,
    ) -> tuple[NDArray[np.float64], NDArray, NDArray, NDArray]:
        """Events of some pixels whose levels go on paths of straight lines; see `events_on_paths`."""
        types = jit()
        index = from_host(types.UInt32, pixel)
        ready = np.array(dr.gather(types.Float64, self._ready_us, index))
        released = np.flatnonzero((ready > times_us[0]) & (ready <= times_us[-1]))
        reference[released] = level_at(released, ready[released], levels, times_us)
        given = pixel, levels, times_us, reference, thresholds, due, ready, self._period_us
        own, ready, t_us, fired, polarity = events_on_paths(*given)
        dr.scatter(self._ready_us, from_host(types.Float64, ready), index)
        dr.eval(self._ready_us)
        return own, t_us, fired, polarity

    def may_fire(self, crosses: Mask, begin_us: float, end_us: float, pixel: UInt32 | None = None) -> Mask:
        """True where a pixel may have an event or a new reference up to `end_us`, of those whose level may cross.

        Pixels that are dead all the time have neither. Those that are released on the way get a new reference.

        Parameters
        ----------
        crosses : of all pixels, or of those listed.
        begin_us, end_us : µs.
        pixel : their numbers; None for all.
        """
        types = jit()
        ready = self._ready_us if pixel is None else take(self._ready_us, pixel)
        awake = ready <= dr.opaque(types.Float64, end_us)
        return awake & (crosses | (ready > dr.opaque(types.Float64, begin_us)))

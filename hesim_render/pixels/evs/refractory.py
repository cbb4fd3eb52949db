"""Dead time of asynchronous event pixels: for a while after an event the pixel is held in reset.

No event of a pixel comes within the period after its last one, leak events included. At the end of the
period the change amplifier is released, and the reference is the level of that instant, as in a DVS pixel
[lichtsteiner2008]. On a steady slope a pixel therefore fires every period + θ/slope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.pixels.arrays import take

#: Least time of an event after the begin of its segment, µs: rounding may have moved it out of the previous segment.
_SOON_US = 1e-3
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
        import drjit as dr

        self._period_us = float(period_us)
        self._ready_us = dr.full(jit().Float64, LONG_AGO_US, pixels)

    def begin(self, ready_us: NDArray[np.float64]) -> None:
        """Let each pixel be ready at a time [pixel], µs."""
        self._ready_us = jit().Float64(ready_us)

    def crossings(
        self,
        reference: Float,
        levels: tuple[Float, Float],
        thresholds: tuple[Float, Float],
        begin_us: float,
        end_us: float,
        leak: tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]],
    ) -> tuple[Float, NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]]:
        """Events of one segment in which the level goes on a straight line from `levels[0]` to `levels[1]`.

        Parameters
        ----------
        reference : level with which each pixel compares, Float.
        levels : levels at the begin and the end of the segment, one value per pixel.
        thresholds : θ₊, θ₋; numbers or one per pixel.
        begin_us, end_us : bounds of the segment, µs.
        leak : times in µs, pixels and origins of the leak events in the segment, and of those of defects.

        Returns
        -------
        reference : the new one.
        t_us, pixel, polarity : the events, unsorted; the polarity times their `Origin`.
        """
        import drjit as dr

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
        result = np.union1d(np.flatnonzero(hit.numpy()), leak[1]).astype(np.uint32)
        if result.size == 0:
            return reference, *(np.empty(0, kind) for kind in (np.float64, np.uint32, np.float64))
        pixel = types.UInt32(result)
        gathered = [dr.gather(types.Float, value, pixel) for value in (reference, level_0, level_1)]
        gathered += [take(theta_on, pixel) + dr.zeros(types.Float, result.size), take(theta_off, pixel)]
        ready = np.array(dr.gather(types.Float64, self._ready_us, pixel))
        own, low, high, on, off = (np.array(value).astype(np.float64) for value in gathered)
        off = np.broadcast_to(off, result.shape)
        own, ready, *events = self._rounds(result, own, ready, low, high, (on, off), begin_us, end_us, leak)
        dr.scatter(reference, types.Float(own.astype(np.float32)), pixel)
        dr.scatter(self._ready_us, types.Float64(ready), pixel)
        dr.eval(reference, self._ready_us)
        return reference, *events

    def _rounds(
        self,
        pixel: NDArray[np.uint32],
        own: NDArray[np.float64],
        ready: NDArray[np.float64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
        begin_us: float,
        end_us: float,
        leak: tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]],
    ) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
        """Reference and end of the dead time after the segment, and its events. Each round has the next event of every
        pixel.
        """
        # leaks by pixel, then by time; a sentinel that is never due at the end
        order = np.lexsort(leak[:2])
        leak_us, leak_origin = np.append(leak[0][order], np.inf), np.append(leak[2][order], 0.0)
        # range of each pixel's leaks in that list
        turn, last = (np.searchsorted(leak[1][order], pixel, side=side) for side in ("left", "right"))
        travel, length = high - low, end_us - begin_us
        result: list[tuple[NDArray, NDArray, NDArray]] = []
        here = np.arange(pixel.size)
        while here.size:
            # the next crossing of each pixel, not before its dead time ends
            distance = high[here] - own[here]
            sign = np.where(distance > 0, 1.0, -1.0)
            theta = np.where(distance > 0, thresholds[0][here], thresholds[1][here])
            part = (own[here] + sign * theta - low[here]) / np.where(travel[here] == 0, np.inf, travel[here])
            crossing_us = np.maximum(begin_us + np.maximum(np.clip(part, 0.0, 1.0) * length, _SOON_US), ready[here])
            # no crossing: the line ends before the threshold, or the pixel sleeps to the end of the segment
            crossing_us[(np.abs(distance) < theta) | (ready[here] > end_us)] = np.inf
            # what comes first, a leak or a crossing
            due = np.where(turn[here] < last[here], turn[here], -1)
            due_us = leak_us[due]
            leaks = due_us < crossing_us
            t_us = np.where(leaks, due_us, crossing_us)
            # a leak in the dead time is lost
            fires = np.isfinite(t_us) & ~(leaks & (due_us < ready[here]))
            turn[here[leaks]] += 1
            firing = here[fires]
            result.append((t_us[fires], pixel[firing], np.where(leaks, leak_origin[due], sign)[fires]))
            ready[firing] = t_us[fires] + self._period_us
            # a pixel that is released within the segment compares with the level of that moment
            released = firing[ready[firing] <= end_us]
            own[released] = low[released] + (ready[released] - begin_us) / length * travel[released]
            # pixels with neither leak nor crossing left are done
            here = here[np.isfinite(t_us)]
        t_us, fired, polarity = (np.concatenate(values) for values in zip(*result, strict=True))
        return own, ready, t_us, fired, polarity

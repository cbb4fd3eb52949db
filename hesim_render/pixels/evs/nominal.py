"""Steps of a pixel with thresholds of its own that the nominal thresholds give as well.

A step in one direction leads from a reference level to the pixel's own threshold. The nominal threshold gives it as
well if the level goes on from the same reference to that one before the pixel steps back. Each step is decided by
itself, so that the two thresholds cannot drift apart however long the pixel runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.pixels.evs.balance import PixelSteps
from hesim_render.pixels.evs.on_device import Map

#: Levels are float32: thresholds that differ by less are the same, ln units.
_ROUNDING = 1e-5


class _Waiting(NamedTuple):
    """Steps that are not decided yet, [n] each: pixel, direction, number, and the level that decides, ln x."""

    pixel: NDArray[np.int64]
    sign: NDArray[np.int64]
    number: NDArray[np.int64]
    goal: NDArray[np.float64]

    def at(self, which: NDArray) -> _Waiting:
        return _Waiting(*(values[which] for values in self))


class NominalSteps:
    """Steps whose level has not reached the nominal threshold yet; at most a few for each pixel.

    Parameters
    ----------
    own, nominal : θ₊ and θ₋, numbers or one for each pixel, ln units.
    pixels : number of pixels.
    """

    def __init__(self, own: tuple[Map, Map], nominal: tuple[Map, Map], pixels: int) -> None:
        self._own, self._nominal = (
            np.stack([np.broadcast_to(np.asarray(theta, np.float64).ravel(), pixels) for theta in thetas])
            for thetas in (own, nominal)
        )
        none = np.empty(0, np.int64)
        self._waiting = _Waiting(none, none, none, np.empty(0))

    @property
    def undecided(self) -> NDArray[np.int64]:
        """Numbers of the steps that are not decided yet."""
        return self._waiting.number

    def take(self, steps: PixelSteps, reference: NDArray[np.float32], level: NDArray[np.float32]) -> NDArray[np.int64]:
        """Take all steps between two samples.

        Parameters
        ----------
        steps : of the pixels with their own thresholds, in order of time.
        reference, level : of all pixels at the second sample, ln x.

        Returns
        -------
        Numbers of the steps, these and earlier ones, that the nominal thresholds have given now.
        """
        order = np.argsort(steps.pixel, kind="stable")
        pixel, sign, number = (values[order] for values in (steps.pixel, steps.sign, steps.number))
        own, nominal = (theta[(sign < 0).astype(np.intp), pixel] for theta in (self._own, self._nominal))
        # from the reference at the end back to those after each step
        new_pixel = np.diff(pixel, prepend=-1) != 0
        moved = np.cumsum(sign * own)
        last = np.append(np.flatnonzero(new_pixel), pixel.size)[1:] - 1
        of_pixel = np.cumsum(new_pixel) - 1
        after = reference[pixel].astype(np.float64) - (moved[last[of_pixel]] - moved)
        # runs of steps in one direction; the last of a pixel goes on to the level at the end
        starts = np.flatnonzero(new_pixel | (np.diff(sign, prepend=0) != 0))
        ends = np.append(starts, pixel.size)[1:] - 1
        run = np.repeat(np.arange(starts.size), ends - starts + 1)
        goes_on = np.isin(ends, last)
        farthest = sign[ends] * after[ends]
        farthest[goes_on] = np.maximum(farthest[goes_on], (sign[ends] * level[pixel[ends]])[goes_on])

        before = self._waiting
        first_run = np.full(self._own.shape[1], -1)
        first_run[pixel[new_pixel]] = run[new_pixel]
        run_before = first_run[before.pixel]
        none = run_before < 0
        ends_before = before.sign * level[before.pixel].astype(np.float64)
        if starts.size:
            of_run = pixel[starts[run_before]], sign[starts[run_before]]
            turned = ~none & (of_run[1] != before.sign)
            ends_before[~none] = np.where(turned, -np.inf, farthest[run_before])[~none]
        else:
            turned = np.zeros(none.size, np.bool_)

        every = _Waiting(*(np.concatenate(both) for both in zip(
            before, (pixel, sign, number, after + sign * (nominal - own)), strict=True
        )))  # fmt: skip
        reached = every.sign * every.goal <= np.concatenate([ends_before, farthest[run]]) + _ROUNDING
        final = np.concatenate([turned, ~goes_on[run]])
        self._waiting = every.at(~reached & ~final)
        return every.number[reached]

    def shift(self, pixel: NDArray[np.int64], by: NDArray[np.float32]) -> None:
        """Move the references of some pixels, in rising order, by differences of ln x."""
        if pixel.size == 0:
            return
        place = np.minimum(np.searchsorted(pixel, self._waiting.pixel), pixel.size - 1)
        found = pixel[place] == self._waiting.pixel
        self._waiting.goal[found] += by[place[found]]

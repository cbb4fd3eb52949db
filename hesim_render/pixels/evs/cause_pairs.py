"""Pairs of causes and effects of pixels that step up and down: which step of one follows from which of another.

Two sequences of signed steps of the same pixel, such as the events with and without noise, follow the same signal. A
step of the one is paired with a step of the other in the same direction, whichever comes first. A step and its opposite
in the same sequence cancel if neither has a partner by then: the pixel went back. What is left has no partner.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Steps of a pixel that can wait for partners at first; the room doubles when it is needed.
_ROOM = 2
CAUSE, EFFECT = 0, 1


class PixelSteps(NamedTuple):
    """Steps of pixels, [n] each, in order of time.

    Parameters
    ----------
    t_us : times, µs.
    pixel : numbers of the pixels.
    sign : +1 or −1.
    number : what names the step in the pairs.
    """

    t_us: NDArray[np.int64]
    pixel: NDArray[np.int64]
    sign: NDArray[np.int64]
    number: NDArray[np.int64]


class Balance:
    """Steps of both sequences that wait for their partners.

    Parameters
    ----------
    pixels : number of pixels.
    dead_us : time after each effect in which the pixel has none, µs: causes within are lost, and waiting effects end;
        None if there is no such time.
    """

    def __init__(self, pixels: int, dead_us: float | None = None) -> None:
        self._dead_us = dead_us
        #: Signed number of waiting steps, [sequence, pixel], and their numbers, [sequence, pixel, place].
        self._count = np.zeros((2, pixels), np.int32)
        self._waiting = np.zeros((2, pixels, _ROOM), np.int64)
        self._ready_us = np.full(pixels, -np.inf)

    def is_idle(self, pixel: NDArray[np.int64], t_us: int) -> NDArray[np.bool_]:
        """True for pixels of which no step waits, and that are not in their dead time."""
        return ~self._count[:, pixel].any(axis=0) & (self._ready_us[pixel] <= t_us)

    def waiting(self, side: int) -> NDArray[np.int64]:
        """Numbers of the steps of one sequence, CAUSE or EFFECT, that wait for their partners, in no order."""
        pixel = np.flatnonzero(self._count[side])
        held = np.arange(self._waiting.shape[2]) < np.abs(self._count[side, pixel])[:, None]
        return self._waiting[side, pixel][held]

    def take(
        self, causes: PixelSteps, effects: PixelSteps
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Take the next steps of both sequences.

        Parameters
        ----------
        causes, effects : none before those of earlier calls. At the same time, a cause comes first.

        Returns
        -------
        cause, effect : [k], numbers of the steps of each new pair.
        lost : numbers of causes within the dead time of a pixel.
        """
        pairs: list[tuple[NDArray, NDArray]] = [(np.empty(0, np.int64), np.empty(0, np.int64))]
        lost: list[NDArray[np.int64]] = [np.empty(0, np.int64)]
        for own, steps in _rounds(causes, effects):
            self._step(own, *steps, pairs, lost)
        cause, effect = (np.concatenate(values) for values in zip(*pairs, strict=True))
        return cause, effect, np.concatenate(lost)

    def _step(
        self,
        own: int,
        t_us: NDArray[np.int64],
        pixel: NDArray[np.int64],
        sign: NDArray[np.int64],
        number: NDArray[np.int64],
        pairs: list[tuple[NDArray, NDArray]],
        lost: list[NDArray[np.int64]],
    ) -> None:
        """One step of each of different pixels in one sequence."""
        other = 1 - own
        if self._dead_us is not None:
            # a pixel that was released compares with a new level: what waited has no partner any more
            released = self._ready_us[pixel] < t_us
            self._count[EFFECT, pixel[released & (self._count[EFFECT, pixel] != 0)]] = 0
        # a step of the other sequence in the same direction waits: the two are a pair
        match = self._count[other, pixel] * sign > 0
        result = self._pop(other, pixel[match])
        pairs.append((result, number[match]) if own == EFFECT else (number[match], result))
        rest = ~match
        if self._dead_us is not None and own == CAUSE:
            # a cause in the dead time has no effect
            asleep = rest & (t_us <= self._ready_us[pixel])
            lost.append(number[asleep])
            rest &= ~asleep
        # a step back of the same sequence undoes the one before
        back = rest & (self._count[own, pixel] * sign < 0)
        self._pop(own, pixel[back])
        wait = rest & ~back
        self._push(own, pixel[wait], sign[wait], number[wait])
        if self._dead_us is not None and own == EFFECT:
            self._ready_us[pixel] = t_us + self._dead_us

    def _pop(self, side: int, pixel: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of the latest waiting steps, which wait no longer."""
        # the last one in is the first one out
        count = self._count[side, pixel]
        result = self._waiting[side, pixel, np.abs(count) - 1]
        self._count[side, pixel] = count - np.sign(count)
        return result

    def _push(self, side: int, pixel: NDArray[np.int64], sign: NDArray[np.int64], number: NDArray[np.int64]) -> None:
        place = np.abs(self._count[side, pixel])
        room = self._waiting.shape[2]
        # room for twice as many
        if place.size and place.max() >= room:
            self._waiting = np.concatenate([self._waiting, np.zeros_like(self._waiting)], axis=2)
        self._waiting[side, pixel, place] = number
        self._count[side, pixel] += sign.astype(np.int32)


class LastSteps:
    """Steps of both sequences of pixels with a dead time. Each waits until the next step of its own sequence.

    A pixel that was released compares with the level of that moment. So there is no step back that undoes another one,
    and of two steps in one direction, with none of the other sequence between them, only the second can find a partner.

    Parameters
    ----------
    pixels : number of pixels.
    dead_us : dead time after each step, µs.
    """

    def __init__(self, pixels: int, dead_us: float) -> None:
        self._dead_us = dead_us
        self._ready_us = np.full(pixels, -np.inf)
        #: Direction of the waiting step, 0 for none, and its number, [sequence, pixel].
        self._sign = np.zeros((2, pixels), np.int8)
        self._number = np.zeros((2, pixels), np.int64)

    def waiting(self, side: int) -> NDArray[np.int64]:
        """Numbers of the steps of one sequence, CAUSE or EFFECT, that wait for their partners."""
        return self._number[side, self._sign[side] != 0]

    def is_idle(self, pixel: NDArray[np.int64], t_us: int) -> NDArray[np.bool_]:
        """True for pixels of which no step waits, and that are in the dead time of neither sequence."""
        return ~self._sign[:, pixel].any(axis=0) & (self._ready_us[pixel] <= t_us)

    def take(self, causes: PixelSteps, effects: PixelSteps) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Take the next steps of both sequences, as `Balance.take`. Returns numbers of the steps of each new pair."""
        pairs: list[tuple[NDArray, NDArray]] = [(np.empty(0, np.int64), np.empty(0, np.int64))]
        for own, (t_us, pixel, sign, number) in _rounds(causes, effects):
            match = self._sign[1 - own, pixel] == sign
            # the step of the other sequence that waits in the same direction
            result = self._number[1 - own, pixel[match]]
            pairs.append((result, number[match]) if own == EFFECT else (number[match], result))
            self._sign[1 - own, pixel[match]] = 0
            self._sign[own, pixel] = np.where(match, 0, sign)
            self._number[own, pixel] = number
            self._ready_us[pixel] = t_us + self._dead_us
        cause, effect = (np.concatenate(values) for values in zip(*pairs, strict=True))
        return cause, effect


def _rounds(causes: PixelSteps, effects: PixelSteps) -> Iterator[tuple[int, PixelSteps]]:
    """The steps of both in rounds, in order of time; each has at most one step of a pixel, all of one sequence."""
    every = PixelSteps(*(np.concatenate(values) for values in zip(causes, effects, strict=True)))
    if every.pixel.size == 0:
        return
    side = np.repeat([CAUSE, EFFECT], [causes.pixel.size, effects.pixel.size])
    # by pixel, then time, then causes before effects
    order = np.lexsort((side, every.t_us, every.pixel))
    pixel = every.pixel[order]
    first = np.flatnonzero(np.diff(pixel, prepend=pixel[0] - 1))
    # number of each step among those of its pixel: steps of one rank are of different pixels
    rank = np.arange(order.size) - np.repeat(first, np.diff(np.append(first, order.size)))
    by_rank = np.argsort(rank, kind="stable")
    for here in np.split(order[by_rank], np.cumsum(np.bincount(rank))[:-1]):
        for own in (CAUSE, EFFECT):
            which = here[side[here] == own]
            if which.size:
                yield own, PixelSteps(*(values[which] for values in every))

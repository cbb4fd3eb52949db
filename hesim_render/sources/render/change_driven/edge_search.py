"""Searches for the line between two sides of rays that has the widest gap, at rest or moving."""

import math
from collections.abc import Sequence

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host

#: Directions of a line that are tried in a round, about the best one so far; the angle that they span in the first
#: round, how many times less in each further one, and rounds.
_FINE, _SPAN_DEG, _NARROWER, _ROUNDS = 8, 100.0, 4.5, 4
#: Directions of a plane that are tried in a round, around the best one so far, and angles to these, in degrees.
_AROUND, _STEPS_DEG = 8, (16, 16, 8, 8, 4, 2, 1, 0.5)
#: Fastest line, px per window: of a faster one, only few rays meet the window while it crosses the pixel.
_FASTEST_PX = 8.0


def widest_gap(x: Float, y: Float, side: Float, rays: int) -> tuple[Float, Float, Float]:
    """Direction in which the two sides of each pair are farthest apart, the gap, and the place of its middle.

    A search over directions in steps that become finer, from that of the mean of a side on; in each
    direction, all rays of the pair are projected.
    """
    types = jit()
    projected = _Projected(x, y, dr.zeros(types.Float, len(side)), side, rays)
    between_x, between_y, _ = projected.between_means()

    def attempt(number: UInt32, best: Float, gap: Float, at: Float) -> tuple[UInt32, Float, Float, Float]:
        span = math.radians(_SPAN_DEG) * dr.power(types.Float(1 / _NARROWER), types.Float(number))
        angles = [best + ((turn + 0.5) / _FINE - 0.5) * span for turn in range(_FINE)]
        turned = [dr.sincos(angle) for angle in angles]
        ends = projected.ends([(cosine, sine, types.Float(0)) for sine, cosine in turned])
        for angle, (lower, higher) in zip(angles, ends, strict=True):
            wider = higher - lower > gap
            best, gap = dr.select(wider, angle, best), dr.select(wider, higher - lower, gap)
            at = dr.select(wider, 0.5 * (lower + higher), at)
        return number + 1, best, gap, at

    start = dr.atan2(between_y, between_x), dr.full(types.Float, -100, projected.pairs)
    state = dr.zeros(types.UInt32, projected.pairs), *start, dr.zeros(types.Float, projected.pairs)
    best_fit = dr.while_loop(state, lambda number, *_: number < _ROUNDS, attempt, label="directions of edges")
    return best_fit[1], best_fit[2], best_fit[3]


class _Projected:
    """Rays of pairs, which are projected onto several directions at a time: fetching them takes most of the time.

    Parameters
    ----------
    x, y, time, side : see `widest_moving_gap`.
    rays : rays of each pair.
    """

    def __init__(self, x: Float, y: Float, time: Float, side: Float, rays: int) -> None:
        types = jit()
        # the four numbers of a ray side by side, so that one fetch brings them
        self._rays: Float = dr.ravel(types.Array4f(x, y, time, side))
        dr.eval(self._rays)
        self.pairs = len(side) // rays
        pair = dr.arange(types.UInt32, self.pairs)
        self._first = pair * dr.opaque(types.UInt32, rays)
        self._last = (pair + 1) * dr.opaque(types.UInt32, rays)

    def ends(self, directions: Sequence[tuple[Float, Float, Float]]) -> list[tuple[Float, Float]]:
        """Largest projection of the lower side and smallest of the higher one, in each direction."""
        types = jit()

        def step(k: UInt32, *ends: Float) -> tuple[UInt32, *tuple[Float, ...]]:
            x, y, time, side = dr.gather(types.Array4f, self._rays, k)
            is_high, result = side > 0, list[Float]()
            for (a, b, c), lower, higher in zip(directions, ends[::2], ends[1::2], strict=True):
                at = a * x + b * y + c * time
                result.append(dr.maximum(lower, dr.select(is_high, -10.0, at)))
                result.append(dr.minimum(higher, dr.select(is_high, at, 10.0)))
            return k + 1, *result

        start = [dr.full(types.Float, 10 * sign, self.pairs) for _ in directions for sign in (-1, 1)]
        _, *reached = dr.while_loop(
            (types.UInt32(self._first), *start), lambda k, *_: k < self._last, step, label="projected rays"
        )
        return list(zip(reached[::2], reached[1::2], strict=True))

    def between_means(self) -> tuple[Float, Float, Float]:
        """Direction from the mean of all rays to that of the higher side, in x, y and time.

        A line across it nearly parts the sides, as rays scatter about as much in all of them.
        """
        types = jit()

        def step(k: UInt32, high: Float, *sums: Float) -> tuple[UInt32, *tuple[Float, ...]]:
            *places, side = dr.gather(types.Array4f, self._rays, k)
            is_high, result = dr.select(side > 0, types.Float(1), 0), list[Float]()
            for place, total, on_high in zip(places, sums[::2], sums[1::2], strict=True):
                result += [total + place, dr.fma(is_high, place, on_high)]
            return k + 1, high + is_high, *result

        start = [dr.zeros(types.Float, self.pairs) for _ in range(7)]
        _, high, *sums = dr.while_loop(
            (types.UInt32(self._first), *start), lambda k, *_: k < self._last, step, label="means of both sides"
        )
        part = high / types.Float(self._last - self._first)
        x, y, time = (on_high - part * total for total, on_high in zip(sums[::2], sums[1::2], strict=True))
        return x, y, time


def widest_moving_gap(
    x: Float, y: Float, time: Float, side: Float, rays: int
) -> tuple[Float, Float, Float, Float, Float]:
    """Line that moves within the window and has the widest gap between the sides of each pair.

    A line that moves at a constant speed is a plane in (x, y, time). The gap of planes is searched for over directions
    on the sphere, from that of the mean of a side on, around the best one so far, each time closer.

    Parameters
    ----------
    x, y, time : of each ray, px and windows from the middle.
    side : 1 for rays of the higher flux, -1 for the others.
    rays : rays of each pair.

    Returns
    -------
    normal_x, normal_y, offset, speed : the line, see `PairEdges`.
    gap : at one time, px; negative where no such line separates the sides.
    """
    types = jit()
    projected = _Projected(x, y, time, side, rays)
    steps = from_host(types.Float, np.tan(np.deg2rad(np.array(_STEPS_DEG, np.float32))))
    dr.make_opaque(steps)
    turns = 2 * math.pi / _AROUND

    def attempt(
        number: UInt32, a: Float, b: Float, c: Float, gap: Float, at: Float
    ) -> tuple[UInt32, Float, Float, Float, Float, Float]:
        # each round is about the best direction of the rounds before it: two directions across that one [duff2017]
        sign = dr.select(c >= 0, types.Float(1), -1)
        p = -1 / (sign + c)
        q = a * b * p
        tilt = dr.gather(types.Float, steps, number)
        directions = []
        for turn in range(_AROUND):
            s, r = math.sin(turn * turns) * tilt, math.cos(turn * turns) * tilt
            na = a + r * (1 + sign * a * a * p) + s * q
            nb = b + r * sign * q + s * (sign + b * b * p)
            nc = c - r * sign * a - s * b
            scale = dr.rsqrt(na * na + nb * nb + nc * nc)
            directions.append((na * scale, nb * scale, nc * scale))
        for (da, db, dc), (lower, higher) in zip(directions, projected.ends(directions), strict=True):
            wider = higher - lower > gap
            a, b, c = dr.select(wider, da, a), dr.select(wider, db, b), dr.select(wider, dc, c)
            gap = dr.select(wider, higher - lower, gap)
            at = dr.select(wider, 0.5 * (lower + higher), at)
        return number + 1, a, b, c, gap, at

    between = projected.between_means()
    square = dr.squared_norm(types.Array3f(*between))
    # of rays that are all on one side, any direction
    a, b, c = (
        dr.select(square > 0, each * dr.rsqrt(square), first) for each, first in zip(between, (1, 0, 0), strict=True)
    )
    zero = dr.zeros(types.Float, projected.pairs)
    state = dr.zeros(types.UInt32, projected.pairs), a, b, c, dr.full(types.Float, -100, projected.pairs), zero
    end = len(_STEPS_DEG)
    _, a, b, c, gap, at = dr.while_loop(state, lambda number, *_: number < end, attempt, label="directions of planes")
    # from the plane to a line in the image and its speed; a plane across the axis of time is no line
    length = dr.sqrt(a * a + b * b)
    is_line = abs(c) <= _FASTEST_PX * length
    per_length = dr.rcp(dr.maximum(length, 1e-3))
    gap = dr.select(is_line, gap * per_length, -1)
    return (
        dr.select(is_line, a * per_length, 1), dr.select(is_line, b * per_length, 0),
        -at * per_length, c * per_length, gap,
    )  # fmt: skip

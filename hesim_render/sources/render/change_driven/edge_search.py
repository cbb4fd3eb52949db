"""Searches for the line between two sides of rays that has the widest gap, at rest or moving."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.tables import table

#: Directions of a line that are tried first, and then around the best one so far, each time closer.
_COARSE, _FINE, _ROUNDS = 48, 8, 3
#: Directions of a plane that are tried first, all over the sphere; directions around the best one so far, and angles to
#: these, in degrees, round by round.
_SPHERE, _AROUND, _STEPS_DEG = 64, 8, (16, 16, 8, 8, 4, 2, 1, 0.5)
#: Fastest line, px per window: of a faster one, only few rays meet the window while it crosses the pixel.
_FASTEST_PX = 8.0


def widest_gap(x: Float, y: Float, side: Float, rays: int) -> tuple[Float, Float, Float]:
    """Direction in which the two sides of each pair are farthest apart, the gap, and the place of its middle.

    A search over directions in steps that become finer; in each direction, all rays of the pair are projected.
    """
    types = jit()
    projected = _Projected(x, y, dr.zeros(types.Float, len(side)), side, rays)

    def attempt(number: UInt32, best: Float, gap: Float, at: Float) -> tuple[UInt32, Float, Float, Float]:
        is_coarse = number < _COARSE
        fine = number - _COARSE
        # each round spans one step of the round before it, about the best direction so far
        span = (2 * np.pi / _COARSE) * dr.power(types.Float(1 / _FINE), types.Float(fine // _FINE))
        angles = []
        for turn in range(_FINE):
            place = (types.Float(turn) + 0.5) / _FINE - 0.5
            coarse = types.Float(number + turn) * (2 * np.pi / _COARSE)
            angles.append(dr.select(is_coarse, coarse, best + place * span))
        turned = [dr.sincos(angle) for angle in angles]
        ends = projected.ends([(cosine, sine, types.Float(0)) for sine, cosine in turned])
        for angle, (lower, higher) in zip(angles, ends, strict=True):
            wider = higher - lower > gap
            best, gap = dr.select(wider, angle, best), dr.select(wider, higher - lower, gap)
            at = dr.select(wider, 0.5 * (lower + higher), at)
        return number + _FINE, best, gap, at

    zero = dr.zeros(types.Float, projected.pairs)
    state = dr.zeros(types.UInt32, projected.pairs), zero, dr.full(types.Float, -100, projected.pairs), zero
    best_fit = dr.while_loop(
        state, lambda number, *_: number < _COARSE + _ROUNDS * _FINE, attempt, label="directions of edges"
    )
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


def widest_moving_gap(
    x: Float, y: Float, time: Float, side: Float, rays: int
) -> tuple[Float, Float, Float, Float, Float]:
    """Line that moves within the window and has the widest gap between the sides of each pair.

    A line that moves at a constant speed is a plane in (x, y, time). The gap of planes is searched for over directions
    on the sphere, first all over it, then around the best one so far, each time closer.

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
    steps = table(types.Float, np.tan(np.deg2rad(np.array(_STEPS_DEG, np.float32))))
    dr.make_opaque(steps)
    turns = 2 * np.pi / _AROUND

    def attempt(
        number: UInt32, a: Float, b: Float, c: Float, gap: Float, at: Float
    ) -> tuple[UInt32, Float, Float, Float, Float, Float]:
        is_coarse = number < _SPHERE
        # each round is about the best direction of the rounds before it: two directions across that one [duff2017]
        fine = number - _SPHERE
        sign = dr.select(c >= 0, types.Float(1), -1)
        p = -1 / (sign + c)
        q = a * b * p
        tilt = dr.gather(types.Float, steps, dr.minimum(fine // _AROUND, len(_STEPS_DEG) - 1))
        directions = []
        for turn in range(_AROUND):
            # even over the sphere: a spiral by the golden angle
            place = number + turn
            height = 1 - (2 * types.Float(place) + 1) / _SPHERE
            sine, cosine = dr.sincos(types.Float(place) * (np.pi * (3 - 5**0.5)))
            radius = dr.sqrt(dr.maximum(1 - height * height, 0))
            s, r = dr.sincos(types.Float(turn) * turns)
            r, s = r * tilt, s * tilt
            na = a + r * (1 + sign * a * a * p) + s * q
            nb = b + r * sign * q + s * (sign + b * b * p)
            nc = c - r * sign * a - s * b
            scale = dr.rsqrt(na * na + nb * nb + nc * nc)
            directions.append((
                dr.select(is_coarse, radius * cosine, na * scale), dr.select(is_coarse, radius * sine, nb * scale),
                dr.select(is_coarse, height, nc * scale),
            ))  # fmt: skip
        for (da, db, dc), (lower, higher) in zip(directions, projected.ends(directions), strict=True):
            wider = higher - lower > gap
            a, b, c = dr.select(wider, da, a), dr.select(wider, db, b), dr.select(wider, dc, c)
            gap = dr.select(wider, higher - lower, gap)
            at = dr.select(wider, 0.5 * (lower + higher), at)
        return number + _AROUND, a, b, c, gap, at

    count = projected.pairs
    zero, one = dr.zeros(types.Float, count), dr.full(types.Float, 1, count)
    state = dr.zeros(types.UInt32, count), one, zero, zero, dr.full(types.Float, -100, count), zero
    most = _SPHERE + _AROUND * len(_STEPS_DEG)
    _, a, b, c, gap, at = dr.while_loop(state, lambda number, *_: number < most, attempt, label="directions of planes")
    # from the plane to a line in the image and its speed; a plane across the axis of time is no line
    length = dr.sqrt(a * a + b * b)
    is_line = abs(c) <= _FASTEST_PX * length
    per_length = dr.rcp(dr.maximum(length, 1e-3))
    gap = dr.select(is_line, gap * per_length, -1)
    return (
        dr.select(is_line, a * per_length, 1), dr.select(is_line, b * per_length, 0),
        -at * per_length, c * per_length, gap,
    )  # fmt: skip

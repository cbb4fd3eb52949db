"""Searches for the line between two sides of rays that has the widest gap, at rest or moving."""

from __future__ import annotations

import numpy as np

from hesim_render.core.backend import jit
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
    import drjit as dr

    types = jit()
    pair = dr.arange(types.UInt32, len(side) // rays)
    first, last = pair * dr.opaque(types.UInt32, rays), (pair + 1) * dr.opaque(types.UInt32, rays)

    def ends(angle: Float) -> tuple[Float, Float]:
        """Largest projection of the lower side, smallest of the higher one."""
        sine, cosine = dr.sincos(angle)

        def step(k: UInt32, lower: Float, higher: Float) -> tuple[UInt32, Float, Float]:
            at = cosine * dr.gather(types.Float, x, k) + sine * dr.gather(types.Float, y, k)
            is_high = dr.gather(types.Float, side, k) > 0
            lower = dr.maximum(lower, dr.select(is_high, -10.0, at))
            return k + 1, lower, dr.minimum(higher, dr.select(is_high, at, 10.0))

        state = types.UInt32(first), dr.full(types.Float, -10, len(pair)), dr.full(types.Float, 10, len(pair))
        _, lower, higher = dr.while_loop(state, lambda k, *_: k < last, step, label="projected rays")
        return lower, higher

    def attempt(
        number: UInt32, centre: Float, best: Float, gap: Float, at: Float
    ) -> tuple[UInt32, Float, Float, Float, Float]:
        is_coarse = number < _COARSE
        fine = number - _COARSE
        # each round spans one step of the round before it
        centre = dr.select(~is_coarse & (fine % _FINE == 0), best, centre)
        span = (2 * np.pi / _COARSE) * dr.power(types.Float(1 / _FINE), types.Float(fine // _FINE))
        place = (types.Float(fine % _FINE) + 0.5) / _FINE - 0.5
        angle = dr.select(is_coarse, types.Float(number) * (2 * np.pi / _COARSE), centre + place * span)
        lower, higher = ends(angle)
        wider = higher - lower > gap
        return (
            number + 1, centre, dr.select(wider, angle, best), dr.select(wider, higher - lower, gap),
            dr.select(wider, 0.5 * (lower + higher), at),
        )  # fmt: skip

    zero = dr.zeros(types.Float, len(pair))
    state = dr.zeros(types.UInt32, len(pair)), zero, zero, dr.full(types.Float, -100, len(pair)), zero
    best_fit = dr.while_loop(
        state, lambda number, *_: number < _COARSE + _ROUNDS * _FINE, attempt, label="directions of edges"
    )
    return best_fit[2], best_fit[3], best_fit[4]


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
    import drjit as dr

    types = jit()
    pair = dr.arange(types.UInt32, len(side) // rays)
    first, last = pair * dr.opaque(types.UInt32, rays), (pair + 1) * dr.opaque(types.UInt32, rays)
    steps = table(types.Float, np.tan(np.deg2rad(np.array(_STEPS_DEG, np.float32))))
    dr.make_opaque(steps)
    turns = 2 * np.pi / _AROUND

    def ends(a: Float, b: Float, c: Float) -> tuple[Float, Float]:
        """Largest projection of the lower side, smallest of the higher one."""

        def step(k: UInt32, lower: Float, higher: Float) -> tuple[UInt32, Float, Float]:
            at = (
                a * dr.gather(types.Float, x, k)
                + b * dr.gather(types.Float, y, k)
                + c * dr.gather(types.Float, time, k)
            )
            is_high = dr.gather(types.Float, side, k) > 0
            lower = dr.maximum(lower, dr.select(is_high, -10.0, at))
            return k + 1, lower, dr.minimum(higher, dr.select(is_high, at, 10.0))

        state = types.UInt32(first), dr.full(types.Float, -10, len(pair)), dr.full(types.Float, 10, len(pair))
        _, lower, higher = dr.while_loop(state, lambda k, *_: k < last, step, label="projected rays")
        return lower, higher

    def attempt(
        number: UInt32, ca: Float, cb: Float, cc: Float, a: Float, b: Float, c: Float, gap: Float, at: Float
    ) -> tuple[UInt32, Float, Float, Float, Float, Float, Float, Float, Float]:
        is_coarse = number < _SPHERE
        # even over the sphere: a spiral by the golden angle
        height = 1 - (2 * types.Float(number) + 1) / _SPHERE
        sine, cosine = dr.sincos(types.Float(number) * (np.pi * (3 - 5**0.5)))
        radius = dr.sqrt(dr.maximum(1 - height * height, 0))
        # each round is about the best direction of the rounds before it
        fine = number - _SPHERE
        is_new = ~is_coarse & (fine % _AROUND == 0)
        ca, cb, cc = dr.select(is_new, a, ca), dr.select(is_new, b, cb), dr.select(is_new, c, cc)
        # two directions across it [duff2017]
        sign = dr.select(cc >= 0, types.Float(1), -1)
        p = -1 / (sign + cc)
        q = ca * cb * p
        tilt = dr.gather(types.Float, steps, dr.minimum(fine // _AROUND, len(_STEPS_DEG) - 1))
        s, r = dr.sincos(types.Float(fine % _AROUND) * turns)
        r, s = r * tilt, s * tilt
        na = ca + r * (1 + sign * ca * ca * p) + s * q
        nb = cb + r * sign * q + s * (sign + cb * cb * p)
        nc = cc - r * sign * ca - s * cb
        scale = dr.rsqrt(na * na + nb * nb + nc * nc)
        da = dr.select(is_coarse, radius * cosine, na * scale)
        db = dr.select(is_coarse, radius * sine, nb * scale)
        dc = dr.select(is_coarse, height, nc * scale)
        lower, higher = ends(da, db, dc)
        wider = higher - lower > gap
        return (
            number + 1, ca, cb, cc, dr.select(wider, da, a), dr.select(wider, db, b), dr.select(wider, dc, c),
            dr.select(wider, higher - lower, gap), dr.select(wider, 0.5 * (lower + higher), at),
        )  # fmt: skip

    zero, one = dr.zeros(types.Float, len(pair)), dr.full(types.Float, 1, len(pair))
    state = (
        dr.zeros(types.UInt32, len(pair)),
        one,
        zero,
        zero,
        one,
        zero,
        zero,
        dr.full(types.Float, -100, len(pair)),
        zero,
    )
    most = _SPHERE + _AROUND * len(_STEPS_DEG)
    *_, a, b, c, gap, at = dr.while_loop(state, lambda number, *_: number < most, attempt, label="directions of planes")
    # from the plane to a line in the image and its speed; a plane across the axis of time is no line
    length = dr.sqrt(a * a + b * b)
    is_line = abs(c) <= _FASTEST_PX * length
    per_length = dr.rcp(dr.maximum(length, 1e-3))
    gap = dr.select(is_line, gap * per_length, -1)
    return (
        dr.select(is_line, a * per_length, 1), dr.select(is_line, b * per_length, 0),
        -at * per_length, c * per_length, gap,
    )  # fmt: skip

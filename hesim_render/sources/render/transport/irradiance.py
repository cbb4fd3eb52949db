"""Irradiance by a Lambertian rectangle in closed form, on the device."""

from collections.abc import Sequence
from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaModule, Point2, Point3, Vector3

#: Area over squared distance below which a rectangle counts as a point at its centre: the sum over edges loses its
#: digits in float32 there, and the relative error of the point is about as large as this number.
_SMALL_SR = 1e-4
#: Squared distance from the middle of a ball, over its squared radius, up to which a point is one of its surface.
BESIDE_BALL = 1.0001


class RectangleLight:
    """A rectangle that emits from its front, with radiance 1.

    Parameters
    ----------
    mi : the mitsuba module.
    frame : [4, 4]; columns are half the width, half the height, the unit normal and the centre, m.
    """

    def __init__(self, mi: MitsubaModule, frame: NDArray[np.float64]) -> None:
        self._mi = mi
        vectors = [mi.Vector3f(frame[:3, k]) for k in range(4)]
        corners = [frame[:3, 3] + a * frame[:3, 0] + b * frame[:3, 1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        self._half_width, self._half_height, self.normal, middle = vectors
        self.middle = mi.Point3f(middle)
        self._corners = [mi.Point3f(corner) for corner in corners]
        area = 4 * float((frame[:3, 0] ** 2).sum() ** 0.5 * (frame[:3, 1] ** 2).sum() ** 0.5)
        self._area_m2 = mi.Float(area)
        dr.make_opaque(self._half_width, self._half_height, self.normal, self.middle, self._corners, self._area_m2)

    def irradiance(self, point: Point3, normal: Vector3) -> Float:
        """∫ cos θ dω over the part of the rectangle above the horizon, sr.

        See `outline_above_horizon`.

        Parameters
        ----------
        point : Point3f per lane.
        normal : unit Vector3f per lane.
        """
        mi = self._mi
        rays = [corner - point for corner in self._corners]
        total = outline_above_horizon(mi, rays, normal)
        to = self.middle - point
        square = dr.squared_norm(to)
        before = -dr.dot(to, self.normal)
        # a lamp of a small solid angle: Lambert's formula would cancel in float32
        as_point = self._area_m2 * before * dr.dot(to, normal) / (square * square)
        exact = dr.select(self._area_m2 < _SMALL_SR * square, dr.maximum(as_point, 0.0), 0.5 * abs(total))
        return dr.select(before > 0, exact, 0.0)

    def outline(self, point: Point3, normal: Vector3) -> tuple[list[Vector3], list[Vector3], list[Float], Mask]:
        """The rectangle as points see it from its front.

        Parameters
        ----------
        point, normal : see `irradiance`.

        Returns
        -------
        rays : from the point to each corner, in order.
        planes : through the point and each edge, as normals that point inwards, as long as the cross product of their
            ends.
        weights : cosine of each of these normals to that of the surface.
        is_clear : True where `irradiance` is that of all of the rectangle and not of a point in its centre.
        """
        rays = [corner - point for corner in self._corners]
        planes = [dr.cross(other, one) for one, other in zip(rays, [*rays[1:], rays[0]], strict=True)]
        weights = [dr.dot(plane, normal) * dr.rsqrt(dr.squared_norm(plane)) for plane in planes]
        to = self.middle - point
        is_clear = (dr.dot(to, self.normal) < 0) & (self._area_m2 >= _SMALL_SR * dr.squared_norm(to))
        for ray in rays:
            is_clear &= dr.dot(ray, normal) > 0
        return rays, planes, weights, is_clear

    def sample(self, point: Point3, normal: Vector3, place: Point2) -> tuple[Point3, Float]:
        """A point drawn uniformly on the rectangle, and its contribution to the irradiance, whose mean is `irradiance`.

        Parameters
        ----------
        point, normal : see `irradiance`.
        place : Point2f in [0, 1)², random numbers.
        """
        drawn = dr.fma(self._half_width, 2 * place.x - 1, dr.fma(self._half_height, 2 * place.y - 1, self.middle))
        to = drawn - point
        square = dr.squared_norm(to)
        cosines = dr.maximum(dr.dot(to, normal), 0.0) * dr.maximum(-dr.dot(to, self.normal), 0.0)
        return drawn, dr.select(square > 0, self._area_m2 * cosines / (square * square), 0.0)


def ball_above_horizon(towards: Vector3, square: Float, normal: Vector3) -> Float:
    """∫ cos θ dω over the part above the horizon of a ball, sr.

    Half the integral of r × dr along the rim of what is seen of it, times the normal: an arc of the circle, and, where
    the ball reaches below, of the horizon.

    Parameters
    ----------
    towards : unit vector to the middle of the ball.
    square : squared sine of its angular radius, below 1.
    normal : unit normal.
    """
    sine, cosine = dr.sqrt(square), dr.sqrt(1 - square)
    height = dr.clip(dr.dot(towards, normal), -1, 1)
    across = dr.sqrt(dr.maximum(1 - height * height, 0))
    # half the arc above the horizon
    half = dr.acos(dr.clip(-cosine * height / dr.maximum(sine * across, 1e-20), -1, 1))
    arc = half * square * height - cosine * sine * across * dr.sin(half)
    level = dr.atan2(sine * dr.sin(half), cosine * across - sine * height * dr.cos(half))
    # without rounding where all of it is above
    return dr.select(height >= sine, pi * square * height, dr.maximum(arc + level, 0))


def outline_above_horizon(mi: MitsubaModule, rays: Sequence[Vector3], normal: Vector3) -> Float:
    """Twice ∫ cos θ dω over the part above the horizon of a convex polygon, sr; its sign is that of the order of the
    corners.

    Lambert's formula, Σ γ_i (Γ_i · n), with γ_i the angle that edge i subtends and Γ_i the unit normal of the plane
    through the point and that edge ([lambert1760]; for polygons [baum1989]). Clipping a convex polygon at a plane
    shortens its edges and adds one edge along the horizon.

    Parameters
    ----------
    rays : from the point to each corner, in order.
    normal : unit Vector3f per lane.
    """
    heights = [dr.dot(ray, normal) for ray in rays]
    total = mi.Float(0.0)
    leaving, entering = dr.zeros(mi.Vector3f), dr.zeros(mi.Vector3f)
    crosses = mi.Bool(False)
    for k, (a, height_a) in enumerate(zip(rays, heights, strict=True)):
        following = (k + 1) % len(rays)
        b, height_b = rays[following], heights[following]
        above_a, above_b = height_a >= 0, height_b >= 0
        # an edge that crosses the horizon is cut there
        on_horizon = dr.fma(b - a, height_a / (height_a - height_b), a)
        first, second = dr.select(above_a, a, on_horizon), dr.select(above_b, b, on_horizon)
        total += dr.select(above_a | above_b, _edge(first, second, normal), 0.0)
        # a convex polygon leaves and enters once; the edge between both places closes it
        leaving = dr.select(above_a & ~above_b, on_horizon, leaving)
        entering = dr.select(~above_a & above_b, on_horizon, entering)
        crosses |= above_a != above_b
    return total + dr.select(crosses, _edge(leaving, entering, normal), 0.0)


def _edge(first: Vector3, second: Vector3, normal: Vector3) -> Float:
    """γ (Γ · n) of one edge."""
    across = dr.cross(first, second)
    length = dr.norm(across)
    angle = dr.atan2(length, dr.dot(first, second))
    return dr.select(length > 0, angle * dr.dot(across, normal) / length, 0.0)

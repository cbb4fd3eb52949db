"""Intersections of rays with balls and faces, in closed form."""

from collections.abc import Sequence

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, Point2, Point3, Ray, Vector3


def to_ball(ray: Ray, middle: Point3, square: Float) -> Float:
    """Distance along a ray to a ball, m; negative or NaN where the ball lies behind the ray or is missed."""
    to = middle - ray.o
    along = dr.dot(to, ray.d)
    # compute the root without cancellation, and the other one from the product of both roots
    root = dr.sqrt(square - dr.squared_norm(dr.fma(-along, ray.d, to)))
    far = along + dr.mulsign(root, along)
    other = (dr.squared_norm(to) - square) * dr.rcp(far)
    first, second = dr.select(far < other, far, other), dr.select(far < other, other, far)
    return dr.select(first >= 0, first, second)


def to_face(ray: Ray, rows: Sequence[tuple[Vector3, Float]]) -> tuple[Float, Point2, Mask]:
    """Distance along a ray to the plane of a face, position on the face, and whether it lies on the face.

    Distance and position are NaN, and the mask is False, where the ray is parallel to the plane.

    Parameters
    ----------
    ray : Ray3f.
    rows : rows of the map to u, v and height: three pairs of a vector and a number.
    """
    import mitsuba as mi

    (u_row, u_0), (v_row, v_0), (normal, height) = rows
    t = -(dr.dot(normal, ray.o) + height) * dr.rcp(dr.dot(normal, ray.d))
    point = dr.fma(ray.d, t, ray.o)
    u, v = dr.dot(u_row, point) + u_0, dr.dot(v_row, point) + v_0
    # not dr.minimum and dr.maximum: their handling of NaN takes time
    return t, mi.Point2f(u, v), (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)


def meets_ball(ray: Ray, length: Float, ball: tuple[Point3, Float]) -> Mask:
    """True where the first `length` metres of a ray meet a ball, given by its centre and squared radius."""
    middle, square = ball
    to = middle - ray.o
    along, far = dr.dot(to, ray.d), dr.squared_norm(to)
    # seen from outside, the ball must lie ahead, and its near side must be within the length of the ray
    ahead = (far <= square) | ((along > 0) & ((along <= length) | (dr.square(along - length) <= square)))
    return ahead & (dr.fma(-along, along, far) <= square)

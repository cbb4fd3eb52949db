"""Flat convex outlines and balls that may hide a uniform sky, and the share of the sky that they hide, in closed form.

A flat target hides from a point of a wall a part of the sky that Lambert's formula gives, and so does a closed convex
body, face by face; the share of a ball has a formula of its own. Direct light takes these shares as a control variate
(`transport.diffuse`): shadow rays then only correct what the outlines do not describe, such as holes, other forms, and
two outlines behind each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, MitsubaModule, MitsubaObject, Point3, Vector3
from hesim_render.sources.render.scene.mitsuba_version import ball_of, mesh_faces, mesh_vertices
from hesim_render.sources.render.transport.irradiance import BESIDE_BALL, ball_above_horizon, outline_above_horizon
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.swept_boxes import Moment

#: Largest number of outlines of a scene, the largest ones; each takes the time of a few dozen operations a ray.
_MOST = 8
#: Largest number of corners of an outline, of shapes of a part that are searched for outlines, and of their triangles:
#: a mesh of millions takes seconds, and is hardly ever flat.
_MOST_CORNERS, _MOST_SHAPES, _MOST_TRIANGLES = 8, 64, 100_000
#: Distance from a plane, over the size of what lies in it, up to which a point lies in the plane.
_IN_PLANE = 1e-5
#: Least part of an outline that the surface must fill.
_FILLED = 0.98


@dataclass(frozen=True)
class Outline:
    """A flat convex polygon.

    Parameters
    ----------
    corners : in order, [n, 3], m.
    one_sided : True if only the side towards which the corners run anticlockwise hides anything: a face of a closed
        body, whose other faces hide what lies behind.
    """

    corners: NDArray[np.float64]
    one_sided: bool

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit normal of the side towards which the corners run anticlockwise."""
        vector_area = _twice_area(self.corners)
        return vector_area / np.linalg.norm(vector_area)

    @property
    def area_m2(self) -> float:
        return 0.5 * float(np.linalg.norm(_twice_area(self.corners)))


@dataclass(frozen=True)
class BallOutline:
    """A ball, which hides a circle of directions.

    Parameters
    ----------
    middle : [3], m.
    radius_m : its radius.
    """

    middle: NDArray[np.float64]
    radius_m: float

    @property
    def area_m2(self) -> float:
        return pi * self.radius_m**2


def outlines_of(scene: MitsubaObject) -> list[Outline | BallOutline]:
    """Outlines of the shapes of a part: of all of them together, if they lie in one plane and fill their hull; else of
    each one that is flat, a ball, or closed and convex with few faces.
    """
    shapes = scene.shapes()
    if len(shapes) > _MOST_SHAPES:
        return []
    if not all(shape.is_mesh() for shape in shapes):
        balls = [ball_of(shape) for shape in shapes if shape.class_name() == "Sphere"]
        return [BallOutline(place[:3], float(place[3])) for place in balls]
    if not shapes or sum(shape.face_count() for shape in shapes) > _MOST_TRIANGLES:
        return []
    triangles = [mesh_vertices(shape)[mesh_faces(shape)] for shape in shapes]
    together = _flat(np.concatenate(triangles))
    if together is not None:
        return [together]
    return [outline for each in triangles for outline in _of_mesh(each)]


def _of_mesh(triangles: NDArray[np.float64]) -> list[Outline]:
    flat = _flat(triangles)
    if flat is not None:
        return [flat]
    return _faces_of_body(triangles)


def _flat(triangles: NDArray[np.float64]) -> Outline | None:
    """Outline of triangles [n, 3, 3] that lie in one plane and fill their convex hull; None of others."""
    points = np.unique(triangles.reshape(-1, 3), axis=0)
    middle = points.mean(axis=0)
    # axes of the points, the one along which they extend least last
    _, sizes, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(points) < 3 or sizes[1] <= _IN_PLANE * sizes[0] or sizes[2] > _IN_PLANE * sizes[0]:
        return None
    try:
        hull = ConvexHull((points - middle) @ axes[:2].T)
    except QhullError:
        return None
    corners = _without_straight(points[hull.vertices])
    outline = Outline(corners, one_sided=False)
    filled = (
        0.5
        * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum()
    )
    return outline if len(corners) <= _MOST_CORNERS and filled >= _FILLED * outline.area_m2 else None


def _faces_of_body(triangles: NDArray[np.float64]) -> list[Outline]:
    """Faces of a closed convex body with few faces; empty for other triangles [n, 3, 3]."""
    if len(triangles) > 2 * _MOST:
        return []
    points = np.unique(triangles.reshape(-1, 3), axis=0)
    size = float(np.ptp(points, axis=0).max())
    faces: list[Outline] = []
    done = np.zeros(len(triangles), np.bool_)
    for number, triangle in enumerate(triangles):
        if done[number]:
            continue
        normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
        length = np.linalg.norm(normal)
        if length <= _IN_PLANE * size**2:
            return []
        heights = (triangles - triangle[0]) @ (normal / length)
        # outside of every face lies nothing
        if heights.max() > _IN_PLANE * size:
            return []
        own = np.abs(heights).max(axis=1) <= _IN_PLANE * size
        done |= own
        face = _flat(triangles[own])
        if face is None:
            return []
        forward = _twice_area(face.corners) @ normal > 0
        faces.append(Outline(face.corners if forward else face.corners[::-1], one_sided=True))
    # the vector areas of a closed body add up to nothing
    total = np.sum([_twice_area(face.corners) for face in faces], axis=0)
    return faces if np.linalg.norm(total) <= _IN_PLANE * size**2 else []


def _twice_area(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the vector area of a polygon; about its first corner, so that places far away keep their digits."""
    sides = corners[1:] - corners[0]
    return np.cross(sides[:-1], sides[1:]).sum(axis=0)


def _without_straight(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of a polygon, without those on a straight line between their neighbours."""
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turn = np.linalg.norm(np.cross(before, after), axis=1)
    return corners[turn > _IN_PLANE * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)]


class Screen:
    """Outlines of one part, on the device, in the frame in which the part rests.

    Parameters
    ----------
    mi : the mitsuba module.
    outlines : one or more.
    """

    def __init__(self, mi: MitsubaModule, outlines: Sequence[Outline | BallOutline]) -> None:
        self._mi = mi
        flat = [each for each in outlines if isinstance(each, Outline)]
        self._sides = [each.one_sided for each in flat]
        self._corners = [[mi.Point3f(corner) for corner in each.corners] for each in flat]
        self._planes = [
            (mi.Vector3f(each.normal), mi.Float(float(each.normal @ each.corners[0])), mi.Float(_margin(each)))
            for each in flat
        ]
        #: Centre and squared radius of each ball.
        self._balls = [
            (mi.Point3f(each.middle), mi.Float(each.radius_m**2)) for each in outlines if isinstance(each, BallOutline)
        ]
        dr.make_opaque(self._corners, self._planes, self._balls)

    def hides(self, point: Point3, normal: Vector3, direction: Vector3) -> tuple[Float, Float]:
        """Share of a uniform sky that the outlines hide from surface points, and how many outlines hide a direction.

        The mean of the second over directions with a cosine distribution about the normal is the first, to rounding.

        Parameters
        ----------
        point, normal : of each lane, at rest with the part; unit normals.
        direction : unit Vector3f above the horizon of each lane.
        """
        mi = self._mi
        share, count = mi.Float(0.0), mi.Float(0.0)
        for corners, (plane, offset, margin), one_sided in zip(self._corners, self._planes, self._sides, strict=True):
            height = dr.dot(plane, point) - offset
            # from within its plane, an outline is a line and hides nothing
            counts = height > margin if one_sided else abs(height) > margin
            # what lies below the horizon as a whole hides nothing
            rises = mi.Bool(False)
            for corner in corners:
                rises |= dr.dot(corner - point, normal) > 0

            def occluded(
                point: Point3, normal: Vector3, direction: Vector3, height: Float, corners: list[Point3] = corners
            ) -> tuple[Float, Float]:
                rays = [corner - point for corner in corners]
                total = outline_above_horizon(mi, rays, normal)
                # seen from above, corners run anticlockwise, so that a direction inside is on the right of all edges
                above, inside = height > 0, mi.Bool(True)
                for ray, following in zip(rays, [*rays[1:], rays[0]], strict=True):
                    side = dr.dot(direction, dr.cross(ray, following))
                    inside &= dr.select(above, side < 0, side > 0)
                return abs(total) * (0.5 / pi), dr.select(inside, mi.Float(1.0), 0.0)

            part, hides = dr.if_stmt(
                (point, normal, direction, height),
                counts & rises,
                occluded,
                lambda *_: (mi.Float(0.0), mi.Float(0.0)),
                label="outline",
            )
            share, count = share + part, count + hides
        for middle, square in self._balls:
            to = middle - point
            distance = dr.squared_norm(to)
            # a point on or in the ball is one of its own surface
            counts = distance > square * BESIDE_BALL

            def behind(to: Vector3, normal: Vector3, direction: Vector3, part: Float) -> tuple[Float, Float]:
                towards = dr.normalize(to)
                hides = dr.dot(direction, towards) > dr.sqrt(1 - part)
                return ball_above_horizon(towards, part, normal) / pi, dr.select(hides, mi.Float(1.0), 0.0)

            part, hides = dr.if_stmt(
                (to, normal, direction, square / distance),
                counts & (dr.dot(to, normal) > -dr.sqrt(square)),
                behind,
                lambda *_: (mi.Float(0.0), mi.Float(0.0)),
                label="ball",
            )
            share, count = share + part, count + hides
        return share, count


def _margin(outline: Outline) -> float:
    return _IN_PLANE * float(np.linalg.norm(np.ptp(outline.corners, axis=0)))


def largest(parts: Sequence[Sequence[Outline | BallOutline]]) -> list[list[Outline | BallOutline]]:
    """The largest outlines of several parts, at most `_MOST` in all; of equal ones the first."""
    every = [(number, outline) for number, part in enumerate(parts) for outline in part]
    kept = sorted(every, key=lambda one: -one[1].area_m2)[:_MOST]
    return [[outline for number, outline in kept if number == own] for own in range(len(parts))]


class OccludedSky:
    """What the outlines of a moving scene hide of a uniform sky.

    Attributes
    ----------
    is_known : True if there are any outlines.
    groups : numbers of the moving groups that have some.
    """

    def __init__(self, scene: MovingScene) -> None:
        self._scene = scene
        parts = largest([outlines_of(part) for part in (scene.static, *(group.scene for group in scene.groups))])
        #: Number of the group in whose frame a screen rests, None for the resting part.
        self._screens = [
            (None if number == 0 else number - 1, Screen(scene.mi, part)) for number, part in enumerate(parts) if part
        ]
        self.is_known = bool(self._screens)
        self.groups = [number for number, _ in self._screens if number is not None]

    def hides(self, point: Point3, normal: Vector3, direction: Vector3, moment: Moment) -> tuple[Float, Float]:
        """As `Screen.hides`, of all outlines; in world space, at the time of each ray."""
        mi = self._scene.mi
        share, count = mi.Float(0.0), mi.Float(0.0)
        for number, screen in self._screens:
            own = point, normal, direction
            if number is not None:
                pose = self._scene.pose(number, moment)
                own = pose.to_rest(point), pose.turn_to_rest(normal), pose.turn_to_rest(direction)
            part, hides = screen.hides(*own)
            share, count = share + part, count + hides
        return share, count

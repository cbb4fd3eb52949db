"""Shapes that keep their places among themselves, and where rays meet them.

Targets are flat, and so is most of what stands around them. A few faces and balls are tried one after the other within
the kernel; a search through a tree of boxes, for which rays leave the kernel, takes longer. Where there are many, or
anything else, rays are met by Mitsuba (Embree on a CPU, OptiX on a GPU). What a surface does with a ray is Mitsuba's in
any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Faces and balls of a part that are tried one by one, at most. Paths of four segments among 3, 6, 12, 24 and 48 faces
#: took 0.93, 0.83, 1.06, 1.08 and 1.7 times as long as with Embree (AVX-512).
_MOST = 8
#: How far the corners of two triangles may be off those of a parallelogram, over its size.
_FLAT = 1e-5


@dataclass(frozen=True)
class Face:
    """A parallelogram of two successive triangles of a mesh, spanned from a corner that only the first one has.

    Parameters
    ----------
    first : number of the first triangle.
    own, opposite : which of its three corners each triangle shares not with the other.
    along_u, along_v : where the two shared ones are in the first and in the second triangle.
    to_uvh : [3, 4], metres to u and v, 0 to 1 on the face, and to the height over it in metres.
    """

    first: int
    own: int
    opposite: int
    along_u: tuple[int, int]
    along_v: tuple[int, int]
    to_uvh: NDArray[np.float64]

    def triangle(self, mi: Any, u: Any, v: Any) -> tuple[Any, Any]:
        """Number of the triangle at a place on the face, and Mitsuba's coordinates in it."""
        import drjit as dr

        there = u + v <= 1
        one = {self.own: 1 - u - v, self.along_u[0]: u, self.along_v[0]: v}
        other = {self.opposite: u + v - 1, self.along_u[1]: 1 - v, self.along_v[1]: 1 - u}
        place = mi.Point2f(*(dr.select(there, one[corner], other[corner]) for corner in (1, 2)))
        return dr.select(there, mi.UInt32(self.first), mi.UInt32(self.first + 1)), place


def faces_of(vertices: NDArray[np.float64], triangles: NDArray[np.int64]) -> list[Face]:
    """The parallelograms that a mesh consists of, two successive triangles each; none if there is anything else.

    Parameters
    ----------
    vertices : [n, 3], m.
    triangles : [k, 3], numbers of vertices.
    """
    found: list[Face] = []
    if len(triangles) % 2:
        return []
    for first in range(0, len(triangles), 2):
        one, other = vertices[triangles[first]], vertices[triangles[first + 1]]
        size = float(np.ptp(one, axis=0).max())
        same = np.linalg.norm(one[:, None] - other, axis=2) <= _FLAT * size
        if not np.array_equal(np.sort(same.sum(axis=0)), [0, 1, 1]) or same.sum(axis=1).max() > 1:
            return []
        own, opposite = int(np.argmin(same.sum(axis=1))), int(np.argmin(same.sum(axis=0)))
        next_u, next_v = (own + 1) % 3, (own + 2) % 3
        u, v = one[next_u] - one[own], one[next_v] - one[own]
        normal = np.cross(u, v)
        area = float(np.linalg.norm(normal))
        if area <= _FLAT * size**2 or np.linalg.norm(one[own] + u + v - other[opposite]) > _FLAT * size:
            return []
        inverse = np.linalg.inv(np.stack([u, v, normal / area], axis=1))
        to_uvh = np.concatenate([inverse, -inverse @ one[own][:, None]], axis=1)
        along_u, along_v = (next_u, int(np.argmax(same[next_u]))), (next_v, int(np.argmax(same[next_v])))
        found.append(Face(first, own, opposite, along_u, along_v, to_uvh))
    return found


class Part:
    """Some shapes in the frame in which they rest.

    Parameters
    ----------
    mi : the mitsuba module.
    scene : of Mitsuba, with these shapes.
    apart : whether most rays pass far from them: Mitsuba is then asked only about rays that meet a ball around them.
    """

    def __init__(self, mi: Any, scene: Any, apart: bool) -> None:
        import drjit as dr

        self._mi = mi
        #: Middle and square of the radius of each ball, and its shape.
        self._balls: list[tuple[Any, Any, Any]] = []
        #: Rows of the map to u, v and height of each face, the face, and its shape.
        self._faces: list[tuple[list[tuple[Any, Any]], Face, Any]] = []
        #: What Mitsuba searches, and the ball around it.
        self._scene = self._around = None
        shapes = scene.shapes()
        faces = [_faces(shape) for shape in shapes]
        is_ball = [shape.class_name() == "Sphere" for shape in shapes]
        simple = all(ball or found for ball, found in zip(is_ball, faces, strict=True))
        if simple and sum(is_ball) + sum(map(len, faces)) <= _MOST:
            for shape, found in zip(shapes, faces, strict=True):
                rows = [[(mi.Vector3f(row[:3]), mi.Float(float(row[3]))) for row in face.to_uvh] for face in found]
                self._faces += zip(rows, found, [mi.ShapePtr(shape)] * len(found), strict=True)
                if not found:
                    self._balls.append((*_ball_around(mi, shape.bbox(), 3**-0.5), mi.ShapePtr(shape)))
        else:
            self._scene = scene
            # somewhat widened: rounding must not take a rim
            self._around = _ball_around(mi, scene.bbox(), 1.0001) if apart else None
        dr.make_opaque([ball[:2] for ball in self._balls], [rows for rows, _, _ in self._faces], self._around)

    def nearest(self, ray: Any, coherent: Any, active: Any) -> Any:
        """The first surface before a ray's `maxt`, `PreliminaryIntersection3f`; its t is infinite where there is none.

        Parameters
        ----------
        ray : Ray3f in the part's own frame.
        coherent : whether neighbouring lanes' rays are alike.
        """
        import drjit as dr

        mi = self._mi
        if self._scene is not None:
            return self._scene.ray_intersect_preliminary(ray, coherent, active & self._near(ray))
        found = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
        found.t, end = mi.Float(dr.inf), ray.maxt

        def take(closer: Any, t: Any, shape: Any) -> Any:
            found.valid |= closer
            found.t, found.shape = dr.select(closer, t, found.t), dr.select(closer, shape, found.shape)
            return dr.select(closer, t, end)

        for middle, square, shape in self._balls:
            t = _to_ball(ray, middle, square)
            end = take(active & (t >= 0) & (t < end), t, shape)
        for rows, face, shape in self._faces:
            t, u, v, inside = _to_face(ray, rows)
            closer = active & inside & (t >= 0) & (t < end)
            end = take(closer, t, shape)
            index, place = face.triangle(mi, u, v)
            found.prim_index = dr.select(closer, index, found.prim_index)
            found.prim_uv = dr.select(closer, place, found.prim_uv)
        return found

    def blocks(self, ray: Any, active: Any) -> Any:
        """Whether anything lies on a ray before its `maxt`."""
        if self._scene is not None:
            return self._scene.ray_test(ray, active & self._near(ray))
        blocked = self._mi.Bool(False)
        for middle, square, _ in self._balls:
            t = _to_ball(ray, middle, square)
            blocked |= (t >= 0) & (t < ray.maxt)
        for rows, _, _ in self._faces:
            t, _, _, inside = _to_face(ray, rows)
            blocked |= inside & (t >= 0) & (t < ray.maxt)
        return blocked & active

    def _near(self, ray: Any) -> Any:
        """Whether a ray meets the ball around all, where there is one."""
        return self._mi.Bool(True) if self._around is None else meets_ball(ray, ray.maxt, self._around)


def _faces(shape: Any) -> list[Face]:
    """The faces of a mesh if they are all it is and not too many; else none."""
    if not shape.is_mesh() or shape.face_count() > 2 * _MOST:
        return []
    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    return faces_of(vertices, np.array(shape.faces_buffer(), np.int64).reshape(-1, 3))


def _ball_around(mi: Any, box: Any, factor: float) -> tuple[Any, Any]:
    """Middle of a box, and the square of `factor` times half its diagonal."""
    low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
    return mi.Point3f((low + high) / 2), mi.Float(float((factor * np.linalg.norm(high - low) / 2) ** 2))


def _to_ball(ray: Any, middle: Any, square: Any) -> Any:
    """Distance along a ray to a ball; negative or not a number where it lies behind or is missed."""
    import drjit as dr

    to = middle - ray.o
    along = dr.dot(to, ray.d)
    # of the two roots the one without cancellation, and the other by their product
    root = dr.sqrt(square - dr.squared_norm(dr.fma(-along, ray.d, to)))
    far = along + dr.mulsign(root, along)
    other = (dr.squared_norm(to) - square) * dr.rcp(far)
    first, second = dr.select(far < other, far, other), dr.select(far < other, other, far)
    return dr.select(first >= 0, first, second)


def _to_face(ray: Any, rows: Sequence[tuple[Any, Any]]) -> tuple[Any, Any, Any, Any]:
    """Distance along a ray to a face's plane, the place there, and whether it lies on the face.

    Where the ray runs along the plane they are not numbers, and it does not.
    """
    import drjit as dr

    (u_row, u_0), (v_row, v_0), (normal, height) = rows
    t = -(dr.dot(normal, ray.o) + height) * dr.rcp(dr.dot(normal, ray.d))
    point = dr.fma(ray.d, t, ray.o)
    u, v = dr.dot(u_row, point) + u_0, dr.dot(v_row, point) + v_0
    # not dr.minimum and dr.maximum: what those do about NaN takes time
    return t, u, v, (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)


def meets_ball(ray: Any, length: Any, ball: tuple[Any, Any]) -> Any:
    """Whether the first `length` metres of a ray meet a ball, given by its middle and the square of its radius."""
    import drjit as dr

    middle, square = ball
    to = middle - ray.o
    along, far = dr.dot(to, ray.d), dr.squared_norm(to)
    # from outside it has to lie ahead, and its near side, whatever the radius, no farther than the ray goes
    ahead = (far <= square) | ((along > 0) & ((along <= length) | (dr.square(along - length) <= square)))
    return ahead & (dr.fma(-along, along, far) <= square)

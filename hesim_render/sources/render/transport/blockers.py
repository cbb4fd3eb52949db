"""What shadow rays meet in closed form: balls, boxes and parallelograms.

Shadow rays go everywhere, so a search through a tree of triangles takes them longer than a few tests within the kernel,
and they need no more than whether anything is in the way. What a ray from the camera hits is another matter: see
`closed_form`.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import select
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaModule, MitsubaObject, Point3, Ray
from hesim_render.sources.render.scene.mitsuba_version import mesh_faces, mesh_vertices
from hesim_render.sources.render.transport.faces import map_of
from hesim_render.sources.render.transport.intersections import to_ball, to_face
from hesim_render.sources.render.transport.sheets import DeviceSheet

#: Largest number of boxes and parallelograms, and of boxes beside other shapes, which Embree then searches for less: a
#: box takes a shadow ray 0.4 ns, Embree takes 8 to 20 ns.
_MOST, _MOST_BESIDE = 16, 8
#: Triangles of a box, and of a parallelogram.
_OF_BOX, _OF_FACE = 12, 2
#: Largest distance of a corner of a box from its place, over the sides of the box.
_EXACT = 1e-5


class Blockers:
    """What shadow rays may meet in a part.

    Parameters
    ----------
    mi : the mitsuba module.
    balls : centre, m, and squared radius, m², of each, on the device.
    boxes : maps [3, 4] as from `box_of`.
    faces : maps [3, 4] of parallelograms, as `Face.to_uvh`.
    sheets : planes of triangles.
    rest : Mitsuba scene of all else; None if there is nothing else.
    """

    def __init__(
        self,
        mi: MitsubaModule,
        balls: Sequence[tuple[Point3, Float]],
        boxes: Sequence[NDArray[np.float64]] = (),
        faces: Sequence[NDArray[np.float64]] = (),
        sheets: Sequence[DeviceSheet] = (),
        rest: MitsubaObject | None = None,
    ) -> None:
        self._mi, self._balls, self._sheets, self._rest = mi, balls, sheets, rest
        self._boxes, self._faces = (
            [[(mi.Vector3f(row[:3]), mi.Float(float(row[3]))) for row in each] for each in maps]
            for maps in (boxes, faces)
        )
        dr.make_opaque(self._boxes, self._faces)

    @classmethod
    def of(cls, mi: MitsubaModule, scene: MitsubaObject, balls: Sequence[tuple[Point3, Float]]) -> "Blockers":
        """The shapes of a scene, with some balls that it does not hold."""
        shapes = scene.shapes()
        # a GPU has units of its own for triangles, and times were not compared
        if select().backend == "cuda":
            return cls(mi, balls, rest=scene)
        boxes = {k: box for k, shape in enumerate(shapes) if (box := box_of(shape)) is not None}
        faces = {k: face for k, shape in enumerate(shapes) if (face := face_of(shape)) is not None}
        if len(boxes) + len(faces) == len(shapes) <= _MOST:
            return cls(mi, balls, list(boxes.values()), list(faces.values()))
        # Mitsuba cannot put an instance into a second scene
        if not boxes or len(boxes) > _MOST_BESIDE or any(shape.class_name() == "Instance" for shape in shapes):
            return cls(mi, balls, rest=scene)
        others = {f"shape_{k}": shape for k, shape in enumerate(shapes) if k not in boxes}
        return cls(mi, balls, list(boxes.values()), rest=mi.load_dict({"type": "scene", **others}, optimize=False))

    def block(self, ray: Ray, active: Mask, near: Mask) -> Mask:
        """True where anything is met before `maxt`.

        Parameters
        ----------
        ray : Ray3f.
        active : lanes in which a result is needed.
        near : lanes in which a ray may meet anything of the rest.
        """
        blocked = self._mi.Bool(False)
        for middle, square in self._balls:
            t = to_ball(ray, middle, square)
            blocked |= (t >= 0) & (t < ray.maxt)
        for rows in self._boxes:
            # a box is met where the ray is between all three pairs of its faces at once
            enter, leave = self._mi.Float(-dr.inf), self._mi.Float(dr.inf)
            for row, offset in rows:
                speed = dr.dot(row, ray.d)
                # kept finite, because 0 · ∞ is undefined
                per_speed = dr.rcp(dr.select(abs(speed) < 1e-30, 1e-30, speed))
                one = -(dr.dot(row, ray.o) + offset) * per_speed
                other = one + per_speed
                rises = per_speed > 0
                first, last = dr.select(rises, one, other), dr.select(rises, other, one)
                enter, leave = dr.select(first > enter, first, enter), dr.select(last < leave, last, leave)
            t = dr.select(enter >= 0, enter, leave)
            blocked |= (enter <= leave) & (t >= 0) & (t < ray.maxt)
        for rows in self._faces:
            t, _, inside = to_face(ray, rows)
            blocked |= inside & (t >= 0) & (t < ray.maxt)
        for sheet in self._sheets:
            blocked |= sheet.blocks(ray, active & ~blocked)
        blocked &= active
        return blocked if self._rest is None else blocked | self._rest.ray_test(ray, active & ~blocked & near)


def _triangles(shape: MitsubaObject) -> NDArray[np.float64]:
    """Corners of a mesh [n, 3, 3], m; empty if it has too many for a box, or is no mesh."""
    if not shape.is_mesh() or shape.face_count() > _OF_BOX:
        return np.empty((0, 3, 3))
    return mesh_vertices(shape).astype(np.float64)[mesh_faces(shape)]


def face_of(shape: MitsubaObject) -> NDArray[np.float64] | None:
    triangles = _triangles(shape)
    return map_of(*triangles) if len(triangles) == _OF_FACE else None


def box_of(shape: MitsubaObject) -> NDArray[np.float64] | None:
    """Map [3, 4] of a point, m, to its place between the pairs of faces of a box, 0 to 1 within; None of other shapes.

    A box is a mesh of a parallelepiped, with two triangles on each of its six faces.
    """
    triangles = _triangles(shape)
    if len(triangles) != _OF_BOX:
        return None
    corner = triangles[0, 0]
    points = np.unique(triangles.reshape(-1, 3), axis=0) - corner
    # three corners next to one, by which all others are given; of corners that rounding has parted, each may be tried
    others = points[np.linalg.norm(points, axis=1) > 0]
    for first in range(len(others)):
        for second in range(first):
            for third in range(second):
                sides = others[[first, second, third]].T
                if np.linalg.det(sides) != 0:
                    inverse = np.linalg.inv(sides)
                    if _is_cube((triangles - corner) @ inverse.T):
                        return np.concatenate([inverse, -(inverse @ corner)[:, None]], axis=1)
    return None


def _is_cube(triangles: NDArray[np.float64]) -> bool:
    """True if triangles [12, 3 corners, 3] are the six faces of the cube from 0 to 1."""
    exact = np.rint(triangles)
    if np.abs(triangles - exact).max() > _EXACT:
        return False
    for axis in range(3):
        for side in range(2):
            on_face = np.delete(exact[(exact[:, :, axis] == side).all(axis=1)], axis, axis=2)
            places, counts = np.unique(on_face.reshape(-1, 2), axis=0, return_counts=True)
            # two triangles that share a diagonal, and nothing else
            if sorted(counts) != [1, 1, 2, 2] or (places[counts == 2].sum(axis=0) != 1).any():
                return False
    return True

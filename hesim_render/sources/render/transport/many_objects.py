"""Many moving objects of simple form, tested one after another in a loop over tables.

The kernel does not depend on the number of objects. Objects consist of the forms of `closed_form`: balls, boxes,
rectangles. Each is tested in its own frame at the ray's own time, if the ray meets the box that contains the object
during the window.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hesim_render.core.device_types import (
    Float,
    Interaction,
    LoopState,
    Mask,
    MitsubaModule,
    MitsubaObject,
    Point2,
    Ray,
    UInt32,
    Vector3,
)
from hesim_render.core.tables import table
from hesim_render.sources.render.scene.tracks import DevicePose, Tracks
from hesim_render.sources.render.transport.closed_form import SimpleForm
from hesim_render.sources.render.transport.intersections import to_ball, to_face
from hesim_render.sources.render.transport.swept_boxes import Moment, inverse_of, meets_box

#: Number of entries in a row of the table of balls and of the table of faces.
_BALL, _FACE = 8, 16


class Fleet:
    """Moving groups in closed form.

    Parameters
    ----------
    mi : the mitsuba module.
    forms : faces and balls of each group.
    numbers : number of each group among all groups of the scene.
    tracks : tracks of all groups of the scene.
    """

    def __init__(self, mi: MitsubaModule, forms: Sequence[SimpleForm], numbers: Sequence[int], tracks: Tracks) -> None:
        import drjit as dr

        self._mi, self._tracks = mi, tracks
        heads: list[list[float]] = []
        balls: list[Sequence[float]] = []
        faces: list[Sequence[float]] = []
        for form, number in zip(forms, numbers, strict=True):
            heads.append([number, len(balls), len(balls) + len(form.balls), 0])
            heads.append([len(faces), len(faces) + len(form.faces), 0, 0])
            for ball, shape in form.balls:
                balls.append([*ball.middle, ball.square, _number(mi, shape), 0, 0, 0])
            for face, shape in form.faces:
                codes = [3 * first + second for first, second, _ in face.order]
                faces.append([*face.to_uvh.ravel(), _number(mi, shape), face.triangle, *codes])
        self._heads = mi.UInt32(np.array(heads, np.uint32).ravel())
        self._balls = table(mi.Float, np.array([*balls, [0.0] * _BALL], np.float32))
        self._faces = table(mi.Float, np.array([*faces, [0.0] * _FACE], np.float32))
        self._count = mi.UInt32(len(forms))
        dr.make_opaque(self._heads, self._balls, self._faces, self._count)

    def nearest(self, ray: Ray, moment: Moment, length: Float, active: Mask) -> tuple[Interaction, UInt32, Mask]:
        """Intersect rays with all groups: the nearest surface within a distance.

        Parameters
        ----------
        ray : Ray3f, world space.
        moment : time of each ray.
        length : largest distance along the ray, m.
        active : lanes to trace.

        Returns
        -------
        hit : `PreliminaryIntersection3f` in the frame of the group that was hit; t is infinite where nothing was hit.
        group : UInt32, number of that group among all groups of the scene.
        met : Bool, True where the ray came through the box of any group.
        """
        import drjit as dr

        mi = self._mi
        inverse = inverse_of(ray.d)

        def visit(k: UInt32, t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32, met: Mask) -> LoopState:
            number, first_ball, last_ball, _ = dr.gather(mi.Array4u, self._heads, 2 * k)
            near = active & meets_box(ray, inverse, length, moment.box(number))
            met |= near

            def look(t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32) -> LoopState:
                local = self._at_rest(ray, number, moment)
                first_face, last_face, _, _ = dr.gather(mi.Array4u, self._heads, 2 * k + 1)

                def try_ball(j: UInt32, t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32) -> LoopState:
                    x, y, z, square = dr.gather(mi.Vector4f, self._balls, 2 * j)
                    own = to_ball(local, mi.Point3f(x, y, z), square)
                    closer = near & (own >= 0) & (own < t)
                    t, which, ball = dr.select(closer, own, t), dr.select(closer, j, which), ball | closer
                    return j + 1, t, place, which, ball, dr.select(closer, number, group)

                def try_face(j: UInt32, t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32) -> LoopState:
                    own, spot, inside = to_face(local, self._rows(j))
                    closer = near & inside & (own >= 0) & (own < t)
                    t, which, place = (
                        dr.select(closer, own, t),
                        dr.select(closer, j, which),
                        dr.select(closer, spot, place),
                    )
                    return j + 1, t, place, which, ball & ~closer, dr.select(closer, number, group)

                state = first_ball, t, place, which, ball, group
                _, *found = dr.while_loop(state, lambda j, *_: j < last_ball, try_ball, label="balls")
                state = first_face, *found
                return tuple(dr.while_loop(state, lambda j, *_: j < last_face, try_face, label="faces")[1:])

            found = dr.if_stmt((t, place, which, ball, group), near, look, lambda *state: state, label="moving group")
            return k + 1, *found, met

        nothing = mi.UInt32(0), mi.Float(length), mi.Point2f(0.0), mi.UInt32(0), mi.Bool(False), mi.UInt32(0)
        state = (*nothing, mi.Bool(False))
        _, t, place, which, ball, group, met = dr.while_loop(
            state, lambda k, *_: k < self._count, visit, label="moving groups"
        )
        return self._hit(t, t < length, place, which, ball), group, met

    def blocks(self, ray: Ray, moment: Moment, active: Mask) -> tuple[Mask, Mask]:
        """True where a ray hits anything before its `maxt`; and True where it came through the box of any group."""
        import drjit as dr

        mi = self._mi
        inverse = inverse_of(ray.d)

        def visit(k: UInt32, blocked: Mask, met: Mask) -> LoopState:
            number, first_ball, last_ball, _ = dr.gather(mi.Array4u, self._heads, 2 * k)
            near = active & meets_box(ray, inverse, ray.maxt, moment.box(number))
            met |= near

            def look(blocked: Mask) -> tuple[Mask]:
                local = self._at_rest(ray, number, moment)
                first_face, last_face, _, _ = dr.gather(mi.Array4u, self._heads, 2 * k + 1)

                def try_ball(j: UInt32, blocked: Mask) -> tuple[UInt32, Mask]:
                    x, y, z, square = dr.gather(mi.Vector4f, self._balls, 2 * j)
                    t = to_ball(local, mi.Point3f(x, y, z), square)
                    return j + 1, blocked | (near & (t >= 0) & (t < ray.maxt))

                def try_face(j: UInt32, blocked: Mask) -> tuple[UInt32, Mask]:
                    t, _, inside = to_face(local, self._rows(j))
                    return j + 1, blocked | (near & inside & (t >= 0) & (t < ray.maxt))

                state = first_ball, blocked
                _, blocked = dr.while_loop(state, lambda j, _: j < last_ball, try_ball, label="balls")
                state = first_face, blocked
                return (dr.while_loop(state, lambda j, _: j < last_face, try_face, label="faces")[1],)

            (blocked,) = dr.if_stmt((blocked,), near & ~blocked, look, lambda blocked: (blocked,), label="moving group")
            return k + 1, blocked, met

        state = mi.UInt32(0), mi.Bool(False), mi.Bool(False)
        _, blocked, met = dr.while_loop(state, lambda k, *_: k < self._count, visit, label="moving groups")
        return blocked, met

    def pose(self, group: UInt32, moment: Moment) -> DevicePose:
        """Pose of the group whose number each lane holds."""
        return self._tracks.pose(group, moment.local_us(group))

    def _at_rest(self, ray: Ray, group: UInt32, moment: Moment) -> Ray:
        pose = self.pose(group, moment)
        local = type(ray)(ray)
        local.o, local.d = pose.to_rest(ray.o), pose.turn_to_rest(ray.d)
        return local

    def _rows(self, face: UInt32) -> list[tuple[Vector3, Float]]:
        import drjit as dr

        mi = self._mi
        found = [dr.gather(mi.Vector4f, self._faces, 4 * face + k) for k in range(3)]
        return [(mi.Vector3f(row.x, row.y, row.z), row.w) for row in found]

    def _hit(self, t: Float, found: Mask, place: Point2, which: UInt32, ball: Mask) -> Interaction:
        """The hit record from which Mitsuba computes a surface interaction."""
        import drjit as dr

        mi = self._mi
        hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(t))
        hit.valid, hit.t = found, dr.select(found, t, dr.inf)
        face = found & ~ball
        number, triangle, one, other = dr.gather(mi.Vector4f, self._faces, 4 * which + 3, face)
        own = dr.gather(mi.Float, self._balls, _BALL * which + 4, found & ball)
        shape = mi.UInt32(dr.select(ball, own, number))
        hit.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(found, shape, 0))
        # the corner at (0, 0) or (1, 1) of the triangle that was hit, and its neighbours along u and v
        u, v = place
        second = u + v > 1
        code = mi.UInt32(dr.select(second, other, one))
        first = code // 3
        along = code - 3 * first
        weights = dr.select(second, u + v - 1, 1 - u - v), dr.select(second, 1 - v, u), dr.select(second, 1 - u, v)
        barycentric = [dr.select(first == k, weights[0], dr.select(along == k, weights[1], weights[2])) for k in (1, 2)]
        hit.prim_uv = mi.Point2f(*barycentric)
        hit.prim_index = mi.UInt32(triangle) + dr.select(second, mi.UInt32(1), mi.UInt32(0))
        return hit


def _number(mi: MitsubaModule, shape: MitsubaObject) -> int:
    """The number by which Dr.Jit identifies a shape."""
    import drjit as dr

    number: UInt32 = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
    return int(number[0])

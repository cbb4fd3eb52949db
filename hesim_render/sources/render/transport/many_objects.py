"""Many moving objects of simple form, tested in loops over tables.

The kernel does not depend on the number of objects. Objects consist of the forms of `closed_form`: balls, boxes,
rectangles. Each is tested in its own frame at the ray's own time, if the ray meets the box that contains the object
during the window. Objects that are near each other in a window form a bunch, and a ray that misses the box of a bunch
asks for none of its members. Bunches save time only: where two surfaces are equally far, the object of the lower
number counts, so that the order of the tests does not matter.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
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
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.tracks import DevicePose, Tracks
from hesim_render.sources.render.transport.closed_form import SimpleForm
from hesim_render.sources.render.transport.intersections import to_ball, to_face
from hesim_render.sources.render.transport.swept_boxes import Moment, inverse_of, meets_box

#: Number of entries in a row of the table of balls and of the table of faces.
_BALL, _FACE = 8, 16
#: Number of objects in a bunch. Of 80 to 400 objects in one picture, 4 to 12 are within a tenth of the fastest.
_BUNCH = 8
#: Bits of a place along each axis, by which objects are sorted.
_PLACE_BITS = 10


class Fleet:
    """Moving groups in closed form.

    Parameters
    ----------
    mi : the mitsuba module.
    forms : faces and balls of each group.
    numbers : number of each group among all groups of the scene.
    tracks : tracks of all groups of the scene.
    groups : number of all groups, which have rows of boxes before those of the fleet.
    """

    def __init__(
        self, mi: MitsubaModule, forms: Sequence[SimpleForm], numbers: Sequence[int], tracks: Tracks, groups: int
    ) -> None:
        self._mi, self._tracks, self._numbers = mi, tracks, np.array(numbers, np.int64)
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
        self._heads = from_host(mi.UInt32, heads)
        self._balls = from_host(mi.Float, np.array([*balls, [0.0] * _BALL], np.float32))
        self._faces = from_host(mi.Float, np.array([*faces, [0.0] * _FACE], np.float32))
        self._bunch, count = _BUNCH, len(forms)
        bunches = -(-count // self._bunch)
        self._first, self._end, self._bunches = (mi.UInt32(n) for n in (groups, groups + count, bunches))
        dr.make_opaque(self._heads, self._balls, self._faces, self._first, self._end, self._bunches)

    def rows(self, boxes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Rows of `Moment.boxes` of the fleet.

        Parameters
        ----------
        boxes : [interval, group, 8], the rows of all groups of the scene.

        Returns
        -------
        [interval, object + bunch, 8]. In each interval, objects are sorted by their place; the number beside the low
        corner is that of the object in the fleet. Then the boxes around each bunch.
        """
        # objects that lie near one another come into one bunch, so that few rays meet many bunches
        own = boxes[:, self._numbers]
        order = np.argsort(_along_a_curve(own[..., :3] + own[..., 4:7]), axis=1, kind="stable")
        own = np.take_along_axis(own, order[..., None], axis=1)
        own[..., 3] = order
        starts = np.arange(0, own.shape[1], self._bunch)
        low, high = np.minimum.reduceat(own, starts, axis=1), np.maximum.reduceat(own, starts, axis=1)
        return np.concatenate([own, np.concatenate([low[..., :4], high[..., 4:]], axis=-1)], axis=1)

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
        mi = self._mi
        inverse = inverse_of(ray.d)

        def visit(near: Mask, number: UInt32, k: UInt32, state: LoopState) -> LoopState:
            local, (balls, faces) = self._at_rest(ray, number, moment), self._parts(k)

            def try_ball(j: UInt32, t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32) -> LoopState:
                x, y, z, square = dr.gather(mi.Vector4f, self._balls, 2 * j)
                own = to_ball(local, mi.Point3f(x, y, z), square)
                is_nearer = near & (own >= 0) & _before(own, number, t, group)
                t, which, ball = dr.select(is_nearer, own, t), dr.select(is_nearer, j, which), ball | is_nearer
                return j + 1, t, place, which, ball, dr.select(is_nearer, number, group)

            def try_face(j: UInt32, t: Float, place: Point2, which: UInt32, ball: Mask, group: UInt32) -> LoopState:
                own, spot, inside = to_face(local, self._rows(j))
                is_nearer = near & inside & (own >= 0) & _before(own, number, t, group)
                t, which, place = (
                    dr.select(is_nearer, own, t),
                    dr.select(is_nearer, j, which),
                    dr.select(is_nearer, spot, place),
                )
                return j + 1, t, place, which, ball & ~is_nearer, dr.select(is_nearer, number, group)

            _, *nearest = dr.while_loop((balls[0], *state), lambda j, *_: j < balls[1], try_ball, label="balls")
            return tuple(dr.while_loop((faces[0], *nearest), lambda j, *_: j < faces[1], try_face, label="faces")[1:])

        nothing = mi.Float(length), mi.Point2f(0.0), mi.UInt32(0), mi.Bool(False), mi.UInt32(0)
        (t, place, which, ball, group), met = self._visit(ray, inverse, length, moment, active, nothing, visit)
        return self._hit(t, t < length, place, which, ball), group, met

    def blocks(self, ray: Ray, moment: Moment, active: Mask) -> tuple[Mask, Mask]:
        """True where a ray hits anything before its `maxt`; and True where it came through the box of any group."""
        mi = self._mi
        inverse = inverse_of(ray.d)

        def visit(near: Mask, number: UInt32, k: UInt32, state: LoopState) -> LoopState:
            local, (balls, faces) = self._at_rest(ray, number, moment), self._parts(k)
            near = near & ~state[0]

            def try_ball(j: UInt32, blocked: Mask) -> LoopState:
                x, y, z, square = dr.gather(mi.Vector4f, self._balls, 2 * j)
                t = to_ball(local, mi.Point3f(x, y, z), square)
                return j + 1, blocked | (near & (t >= 0) & (t < ray.maxt))

            def try_face(j: UInt32, blocked: Mask) -> LoopState:
                t, _, inside = to_face(local, self._rows(j))
                return j + 1, blocked | (near & inside & (t >= 0) & (t < ray.maxt))

            _, *nearest = dr.while_loop((balls[0], *state), lambda j, *_: j < balls[1], try_ball, label="balls")
            return tuple(dr.while_loop((faces[0], *nearest), lambda j, *_: j < faces[1], try_face, label="faces")[1:])

        (blocked,), met = self._visit(ray, inverse, ray.maxt, moment, active, (mi.Bool(False),), visit)
        return blocked, met

    def _visit(
        self,
        ray: Ray,
        inverse: Vector3,
        length: Float,
        moment: Moment,
        active: Mask,
        state: LoopState,
        visit: Callable[[Mask, UInt32, UInt32, LoopState], LoopState],
    ) -> tuple[LoopState, Mask]:
        """Call `visit` to update a state for each object whose box a ray meets.

        Parameters
        ----------
        inverse, length : see `meets_box`.
        state : initial values.
        visit : takes the lanes that met the box, the number of the group in the scene and in the fleet, and the state;
            returns the new state.

        Returns
        -------
        state, met : the final state; and Bool, True where any box was met.
        """
        mi = self._mi

        def bunch(number: UInt32, *state: Any) -> LoopState:
            # members of a bunch are looked at only by lanes that met its box
            inside = active & meets_box(ray, inverse, length, moment.box(self._end + number))
            first = self._first + number * self._bunch
            end = dr.minimum(first + self._bunch, self._end)

            def members(*state: Any) -> LoopState:
                return tuple(dr.while_loop((first, *state), lambda row, *_: row < end, member, label="members")[1:])

            def member(row: UInt32, *state: Any) -> LoopState:
                *before, met = state
                box, mark = moment.box_and_mark(row)
                near = inside & meets_box(ray, inverse, length, box)

                def look(*state: Any) -> LoopState:
                    k = mi.UInt32(mark)
                    return visit(near, dr.gather(mi.UInt32, self._heads, 8 * k), k, state)

                updated = dr.if_stmt(tuple(before), near, look, lambda *state: state, label="moving group")
                return row + 1, *updated, met | near

            return number + 1, *dr.if_stmt(tuple(state), inside, members, lambda *state: state, label="bunch")

        begin = mi.UInt32(0), *state, mi.Bool(False)
        _, *end, met = dr.while_loop(begin, lambda number, *_: number < self._bunches, bunch, label="moving groups")
        return tuple(end), met

    def _parts(self, k: UInt32) -> tuple[tuple[UInt32, UInt32], tuple[UInt32, UInt32]]:
        """First and last, exclusive, of the balls and of the faces of a group of the fleet."""
        _, first_ball, last_ball, _ = dr.gather(self._mi.Array4u, self._heads, 2 * k)
        first_face, last_face, _, _ = dr.gather(self._mi.Array4u, self._heads, 2 * k + 1)
        return (first_ball, last_ball), (first_face, last_face)

    def pose(self, group: UInt32, moment: Moment) -> DevicePose:
        """Pose of the group whose number each lane holds."""
        return self._tracks.pose(group, moment.local_us(group))

    def _at_rest(self, ray: Ray, group: UInt32, moment: Moment) -> Ray:
        pose = self.pose(group, moment)
        local = type(ray)(ray)
        local.o, local.d = pose.to_rest(ray.o), pose.turn_to_rest(ray.d)
        return local

    def _rows(self, face: UInt32) -> list[tuple[Vector3, Float]]:
        mi = self._mi
        rows = [dr.gather(mi.Vector4f, self._faces, 4 * face + k) for k in range(3)]
        return [(mi.Vector3f(row.x, row.y, row.z), row.w) for row in rows]

    def _hit(self, t: Float, is_hit: Mask, place: Point2, which: UInt32, ball: Mask) -> Interaction:
        """The hit record from which Mitsuba computes a surface interaction."""
        mi = self._mi
        hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(t))
        hit.valid, hit.t = is_hit, dr.select(is_hit, t, dr.inf)
        face = is_hit & ~ball
        number, triangle, one, other = dr.gather(mi.Vector4f, self._faces, 4 * which + 3, face)
        own = dr.gather(mi.Float, self._balls, _BALL * which + 4, is_hit & ball)
        shape = mi.UInt32(dr.select(ball, own, number))
        hit.shape = dr.reinterpret_array(mi.ShapePtr, dr.select(is_hit, shape, 0))
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
    number: UInt32 = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
    return int(number[0])


def _before(t: Float, group: UInt32, other_t: Float, other_group: UInt32) -> Mask:
    """Whether a hit counts before another one: it is nearer, or equally far and of a group with a lower number."""
    return (t < other_t) | ((t == other_t) & (group < other_group))


def _along_a_curve(places: NDArray[np.float32]) -> NDArray[np.int64]:
    """Position of places [..., n, 3] along a Z-order curve through their bounding box, [..., n]."""
    # cell of each place on a cubic grid, whose bits of three axes are interleaved
    low, high = places.min(axis=-2, keepdims=True), places.max(axis=-2, keepdims=True)
    share = (places - low) / np.maximum((high - low).max(axis=-1, keepdims=True), 1e-30)
    cell = (share * ((1 << _PLACE_BITS) - 1)).astype(np.int64)
    bits = (cell[..., None] >> np.arange(_PLACE_BITS)) & 1
    return np.sum(bits << (3 * np.arange(_PLACE_BITS) + np.arange(3)[:, None]), axis=(-1, -2))

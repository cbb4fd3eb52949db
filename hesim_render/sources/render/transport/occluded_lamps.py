"""Shadows of rectangle lamps in closed form: the part of a lamp that one convex shape hides from a point.

What a parallelogram hides of a lamp is where two convex cones meet, and Lambert's formula holds for that polygon as for
the lamp: its edges are those of either outline, each cut to the part inside of the other. A box hides what its faces
towards the point hide, which do not overlap. A ball hides a circle, whose arcs have a closed form as well. Direct light
takes these parts as a control variate (`transport.diffuse`), so shadow rays only correct what they do not describe:
other shapes, and shapes behind each other.

A face or a ball takes hundreds of operations a ray. Pairs of a pixel and a window therefore name the few shapes that
cast a shadow on them (`LampShadows.first_met`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, LoopState, Mask, MitsubaObject, Point3, Ray, UInt32, Vector3
from hesim_render.core.tables import table
from hesim_render.sources.render.scene.tracks import DevicePose
from hesim_render.sources.render.transport.blockers import box_of, face_of
from hesim_render.sources.render.transport.intersections import to_ball
from hesim_render.sources.render.transport.irradiance import RectangleLight
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.swept_boxes import Moment

#: Largest number of shapes that are known, the largest ones; a code has eight bits for each, and 0 for none.
_MOST = 64
#: Shapes that a code holds.
SLOTS = 4
#: Distance of a point from the plane of a face, over the size of the box, below which the face hides nothing.
_IN_PLANE = 1e-4
_ROW = 16


class LampShadows:
    """Boxes, parallelograms and balls of a scene that may hide a lamp.

    Parameters
    ----------
    scene : the scene.

    Attributes
    ----------
    is_known : True if there are any.
    """

    def __init__(self, scene: MovingScene) -> None:
        self._scene, mi = scene, scene.mi
        rows: list[list[float]] = []
        for number, part in enumerate((scene.static, *(group.scene for group in scene.groups))):
            rows += [row for shape in part.shapes() if (row := _row_of(shape, number)) is not None]
        # the largest ones, by the area of their largest face
        rows = sorted(sorted(rows, key=lambda row: -_size(row))[:_MOST], key=lambda row: row[3])
        self.is_known = bool(rows)
        self._moves = any(row[3] > 0 for row in rows)
        self._rows = table(mi.Float, np.array(rows or [[0.0] * _ROW], np.float32))
        self._count = dr.opaque(mi.UInt32, len(rows))

    def before(
        self, lamp: RectangleLight, normal: Vector3, shadow: Ray, moment: Moment, code: UInt32
    ) -> tuple[Float, Float]:
        """Irradiance by the hidden part of a lamp of radiance 1, sr, and how many shapes a shadow ray meets.

        The mean of the share of the ray times the second over points on the lamp is the first, to rounding.

        Parameters
        ----------
        lamp : the lamp.
        normal : unit normal of each surface, world space.
        shadow : ray from the surface to a point on the lamp. Its origin stands a little off the surface, as for all
            shadow rays, and so does the point from which the lamp is seen here: a shape may be as close.
        moment : time of each ray.
        code : shapes of each lane, eight bits for each: its number from 1, or 0.
        """
        mi = self._scene.mi
        point = shadow.o
        corners, planes, weights, is_clear = lamp.outline(point, normal)

        def add(code: UInt32, hidden: Float, count: Float) -> tuple[UInt32, Float, Float]:
            shape = self._shape((code & 255) - 1, moment)
            # parts of a shape behind the lamp hide nothing
            counts = is_clear & (shape.over(lamp.middle, lamp.normal) > 0)
            given = point, normal, shape, corners, planes, weights
            part, is_outside = dr.if_stmt(given, shape.square > 0, _hidden_by_ball, _hidden_by_box, label="shadow")
            counts &= is_outside
            hits = counts & shape.meets(shadow)
            return code >> 8, hidden + dr.select(counts, part, 0), count + dr.select(hits, mi.Float(1.0), 0)

        state = code, mi.Float(0.0), mi.Float(0.0)
        _, hidden, count = dr.while_loop(state, lambda code, *_: code != 0, add, label="shadows")
        return hidden, count

    def first_met(self, shadow: Ray, moment: Moment, active: Mask) -> UInt32:
        """Number, from 1, of the first shape in the list that a ray meets before its `maxt`; 0 if it meets none."""
        mi = self._scene.mi
        none = DevicePose.none(jit().Array3f)

        def look(number: UInt32, met: UInt32, part: UInt32, *columns: Vector3) -> LoopState:
            shape, own = self._at_rest(number)
            # shapes are in order of their part, whose pose is computed once
            if self._moves:
                columns = dr.if_stmt(
                    (own, *columns),
                    own != part,
                    lambda own, *_: _columns(self._scene.pose(own - 1, moment)),
                    lambda own, *columns: columns,
                    label="pose",
                )
                shape = shape.posed(DevicePose(tuple(columns[:3]), columns[3]))
            hits = active & (met == 0) & shape.meets(shadow)
            return number + 1, dr.select(hits, number + 1, met), own, *columns

        state = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0), *_columns(none)
        return dr.while_loop(state, lambda number, *_: number < self._count, look, label="shapes")[1]

    def _shape(self, number: UInt32, moment: Moment) -> _Shape:
        """The shape whose number each lane holds, in world space."""
        shape, part = self._at_rest(number)
        if self._moves:
            moves = part > 0
            pose = self._scene.pose(dr.select(moves, part - 1, 0), moment)
            shape = shape.posed(DevicePose.none(self._scene.mi.Vector3f).where(~moves, pose))
        return shape

    def _at_rest(self, number: UInt32) -> tuple[_Shape, UInt32]:
        """The shape whose number each lane holds, in the frame of its part; and its part, 0 for what rests."""
        mi = self._scene.mi
        rows = [dr.gather(mi.Vector4f, self._rows, 4 * number + k) for k in range(4)]
        corner, a, b, c = (mi.Vector3f(row.x, row.y, row.z) for row in rows)
        return _Shape(mi.Point3f(corner), (a, b, c), rows[1].w, rows[2].w), mi.UInt32(rows[0].w)


def _columns(pose: DevicePose) -> tuple[Vector3, ...]:
    return *pose.columns, pose.shift


@dataclass
class _Shape:
    """A shape of each lane.

    Parameters
    ----------
    corner : of a box or parallelogram, or centre of a ball, world space.
    sides : of a box; of a parallelogram, the third one is its normal.
    height : over the third side: 1 of a box, 0 of a parallelogram.
    square : squared radius of a ball, m²; 0 of other shapes.
    """

    corner: Point3
    sides: tuple[Vector3, Vector3, Vector3]
    height: Float
    square: Float

    def posed(self, pose: DevicePose) -> _Shape:
        """The same shape in world space."""
        a, b, c = (pose.turn_to_world(side) for side in self.sides)
        return _Shape(pose.to_world(self.corner), (a, b, c), self.height, self.square)

    def over(self, place: Point3, along: Vector3) -> Float:
        """Least height of the shape over a plane through a place, along its unit normal, m."""
        below = type(self.height)(0.0)
        for side, part in zip(self.sides, (1, 1, self.height), strict=True):
            below += dr.minimum(dr.dot(side, along) * part, 0)
        below = dr.select(self.square > 0, -dr.sqrt(self.square), below)
        return dr.dot(self.corner - place, along) + below

    def meets(self, ray: Ray) -> Mask:
        """True where a ray meets the shape before its `maxt`."""
        a, b, c = self.sides
        across = dr.cross(b, c), dr.cross(c, a), dr.cross(a, b)
        per_volume = dr.rcp(dr.dot(a, across[0]))
        kind = type(self.height)
        enter, leave = kind(-dr.inf), kind(dr.inf)
        for each, far in zip(across, (1, 1, self.height), strict=True):
            row = each * per_volume
            speed, place = dr.dot(row, ray.d), dr.dot(row, ray.o - self.corner)
            per_speed = dr.rcp(dr.select(abs(speed) < 1e-30, 1e-30, speed))
            one = -place * per_speed
            other = dr.fma(per_speed, far, one)
            rises = per_speed > 0
            first, last = dr.select(rises, one, other), dr.select(rises, other, one)
            enter, leave = dr.select(first > enter, first, enter), dr.select(last < leave, last, leave)
        t = dr.select(enter >= 0, enter, leave)
        box = (enter <= leave) & (t >= 0) & (t < ray.maxt)
        t = to_ball(ray, self.corner, self.square)
        return dr.select(self.square > 0, (t >= 0) & (t < ray.maxt), box)


def _row_of(shape: MitsubaObject, part: int) -> list[float] | None:
    """A row of the table, four times four numbers: corner and part; sides, the first two with height and square."""
    if shape.class_name() == "Sphere":
        box = shape.bbox()
        middle, radius = 0.5 * (np.array(box.min) + np.array(box.max)), 0.5 * float(box.max[0] - box.min[0])
        return [*middle, float(part), radius, 0, 0, 1, 0, radius, 0, radius**2, 0, 0, radius, 0]
    box = box_of(shape)
    to_places = face_of(shape) if box is None else box
    if to_places is None:
        return None
    sides = np.linalg.inv(to_places[:, :3])
    corner = -sides @ to_places[:, 3]
    return [*corner, float(part), *sides[:, 0], float(box is not None), *sides[:, 1], 0.0, *sides[:, 2], 0.0]


def _size(row: Sequence[float]) -> float:
    """Area of the largest face of a row of the table, m²."""
    a, b, c = (np.array(row[4 * k : 4 * k + 3]) for k in (1, 2, 3))
    c = c * row[7]
    return max(float(np.linalg.norm(np.cross(*two))) for two in ((a, b), (b, c), (c, a)))


def _hidden_by_box(
    point: Point3,
    normal: Vector3,
    shape: _Shape,
    lamp: Sequence[Vector3],
    planes: Sequence[Vector3],
    weights: Sequence[Float],
) -> tuple[Float, Mask]:
    """Irradiance by the part of a lamp that a box or a parallelogram hides; and True where the point lies outside of
    it, and not only in the plane of a face.

    Parameters
    ----------
    lamp, planes, weights : as `RectangleLight.outline` gives them.
    """
    kind, sides, top = type(shape.height), shape.sides, shape.height
    relative = shape.corner - point
    a, b, c = sides
    across = dr.cross(b, c), dr.cross(c, a), dr.cross(a, b)
    volume = dr.dot(a, across[0])
    per_volume = dr.rcp(volume)
    # place of the point between the faces of each pair
    places = [-dr.dot(each, relative) * per_volume for each in across]
    hidden, is_outside = kind(0.0), type(volume > 0)(False)
    has_all = top > 0
    for axis in range(3):
        far = top if axis == 2 else kind(1.0)
        below, above = places[axis] < -_IN_PLANE, places[axis] > far + _IN_PLANE
        faces = below | above
        if axis < 2:
            faces &= has_all
        is_outside |= faces
        first, second = sides[(axis + 1) % 3], sides[(axis + 2) % 3]
        base = relative + dr.select(above, sides[axis] * far, 0)
        sign = dr.select(below == (volume > 0), kind(1.0), -1)

        def face(base: Vector3, first: Vector3, second: Vector3, sign: Float) -> Float:
            own = [base, base + first, base + first + second, base + second]
            inward = [sign * dr.cross(one, other) for one, other in zip(own, [*own[1:], own[0]], strict=True)]
            own_weights = [dr.dot(plane, normal) * dr.rsqrt(dr.squared_norm(plane)) for plane in inward]
            return _edges_within(own, inward, own_weights, planes) + _edges_within(lamp, planes, weights, inward)

        part = dr.if_stmt((base, first, second, sign), faces, face, lambda *_: kind(0.0), label="face")
        hidden += part
    return 0.5 * hidden, is_outside


def _edges_within(
    corners: Sequence[Vector3], own: Sequence[Vector3], weights: Sequence[Float], planes: Sequence[Vector3]
) -> Float:
    """Σ γ (Γ · n) over the edges of a polygon, each cut to the part inside of some planes through the point.

    Parameters
    ----------
    corners : from the point to each corner, in order.
    own : normals of the planes of the edges, as long as the cross product of their ends.
    weights : cosine of each of these normals to that of the surface.
    planes : normals that point inwards.
    """
    total = type(weights[0])(0.0)
    heights = [[dr.dot(plane, corner) for plane in planes] for corner in corners]
    for k, corner in enumerate(corners):
        following = (k + 1) % len(corners)
        begin, end = type(total)(0.0), type(total)(1.0)
        for here, there in zip(heights[k], heights[following], strict=True):
            cut = here * dr.rcp(here - there)
            begin = dr.select((here < 0) & (cut > begin), cut, begin)
            end = dr.select((there < 0) & (cut < end), cut, end)
            end = dr.select((here < 0) & (there < 0), -1, end)
        side = corners[following] - corner
        near = dr.fma(dr.dot(corner, side), begin + end, dr.dot(corner, corner))
        along = dr.fma(dr.dot(side, side), begin * end, near)
        angle = dr.atan2((end - begin) * dr.norm(own[k]), along)
        total += dr.select(end > begin, angle * weights[k], 0)
    return total


def _hidden_by_ball(
    point: Point3,
    normal: Vector3,
    shape: _Shape,
    lamp: Sequence[Vector3],
    planes: Sequence[Vector3],
    weights: Sequence[Float],
) -> tuple[Float, Mask]:
    """As `_hidden_by_box`, of a ball, which hides a circle of directions.

    The circle is cut into sectors, one for each edge of the lamp: the part of an edge inside of the circle counts as it
    is, and the arc of the circle counts beside the parts outside of it. With the axis a, the angle α from it, and
    azimuths e that are unit vectors across it, ∫ d × dd over an arc is sin²α Δφ a + cos α sin α (a × e_1 − a × e_0).
    """
    kind = type(shape.square)
    to = shape.corner - point
    square = dr.squared_norm(to)
    axis = to * dr.rsqrt(square)
    sine2 = shape.square / square
    is_outside = sine2 < 1 - _IN_PLANE
    sine, cosine = dr.sqrt(sine2), dr.safe_sqrt(1 - sine2)
    lateral = dr.dot(axis, normal)
    total = kind(0.0)
    for k, plane in enumerate(planes):
        # planes run from the later corner to the earlier one, see `RectangleLight.outline`
        first, last = lamp[(k + 1) % len(lamp)], lamp[k]
        length = dr.norm(plane)
        across = plane / length
        # the point of the edge's great circle next to the axis, the direction of the edge there, and the third axis
        height = dr.dot(axis, across)
        low = dr.sqrt(dr.maximum(1 - height * height, 1e-12))
        foot = (axis - across * height) / low
        ahead = dr.cross(across, foot)
        beside = dr.cross(axis, ahead)
        # angles of the ends and of the part within the circle, from that point
        half = 0.5 * dr.atan2(length, dr.dot(first, last))
        middle = first * dr.rsqrt(dr.squared_norm(first)) + last * dr.rsqrt(dr.squared_norm(last))
        at = dr.atan2(dr.dot(middle, ahead), dr.dot(middle, foot))
        reach = dr.acos(dr.minimum(cosine / low, 1))
        begin, end = at - half, at + half
        enter, leave = dr.clip(-reach, begin, end), dr.clip(reach, begin, end)
        total += (leave - enter) * weights[k]
        ahead_n, beside_n = dr.dot(ahead, normal), dr.dot(beside, normal)
        for one, other in ((begin, enter), (leave, end)):
            (s_1, c_1), (s_2, c_2) = dr.sincos(one), dr.sincos(other)
            turn = dr.atan2(height * dr.sin(other - one), s_1 * s_2 + height * height * c_1 * c_2)
            total += sine2 * turn * lateral
            for s, c, sign in ((s_2, c_2, 1), (s_1, c_1, -1)):
                per_radius = dr.rsqrt(dr.maximum(s * s + height * height * c * c, 1e-20))
                total += sign * sine * cosine * per_radius * (s * beside_n + height * c * ahead_n)
    return 0.5 * total, is_outside


def most_frequent(met: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Codes of the shapes that several rays met most often, [n].

    Parameters
    ----------
    met : [n, rays], what each ray met before each lamp, as codes.
    """
    count = len(met)
    # how often each pair met each shape, [n, shape]; the number 0 is none
    shapes = met[..., None] >> np.arange(0, 8 * SLOTS, 8, dtype=np.uint32) & np.uint32(255)
    of = np.arange(count)[:, None] * (_MOST + 1) + shapes.reshape(count, -1)
    often = np.bincount(of.ravel(), minlength=count * (_MOST + 1)).reshape(count, -1)
    often[:, 0] = 0
    # of equal counts the larger shape
    best = np.argsort(-often, axis=1, kind="stable")[:, :SLOTS]
    numbers = np.where(np.take_along_axis(often, best, axis=1) > 0, best, 0).astype(np.uint32)
    return np.bitwise_or.reduce(numbers << np.arange(0, 8 * SLOTS, 8, dtype=np.uint32), axis=1)

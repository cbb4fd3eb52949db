"""What a box, a parallelogram or a ball occludes of a rectangle lamp, in closed form.

What a parallelogram occludes is where two convex cones meet, and Lambert's formula holds for that polygon as for the
lamp: its edges are those of either outline, each cut to the part inside of the other. A box occludes what its faces
towards the point do, which do not overlap. A ball occludes a circle, whose arcs have a closed form as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, Point3, Ray, Vector3
from hesim_render.sources.render.scene.tracks import DevicePose
from hesim_render.sources.render.transport.intersections import to_ball

#: Distance of a point from the plane of a face, over the size of the box, below which the face hides nothing.
_IN_PLANE = 1e-4


@dataclass
class Occluder:
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

    def posed(self, pose: DevicePose) -> "Occluder":
        """The same shape in world space."""
        a, b, c = (pose.turn_to_world(side) for side in self.sides)
        return Occluder(pose.to_world(self.corner), (a, b, c), self.height, self.square)

    def over(self, place: Point3, along: Vector3) -> Float:
        """Least height of the shape over a plane through a place, along its unit normal, m."""
        # the corner that lies lowest along the normal: each side counts where it goes down
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
        # slabs: the ray is inside from the latest entry to the earliest exit
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
        # a ray that starts inside meets the shape where it leaves
        t = dr.select(enter >= 0, enter, leave)
        box = (enter <= leave) & (t >= 0) & (t < ray.maxt)
        t = to_ball(ray, self.corner, self.square)
        return dr.select(self.square > 0, (t >= 0) & (t < ray.maxt), box)


def by_box(
    point: Point3,
    normal: Vector3,
    shape: Occluder,
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
    occluded, is_outside = kind(0.0), type(volume > 0)(False)
    has_all = top > 0
    for axis in range(3):
        # a face is seen from its outer side only, so at most one of each pair
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
        occluded += part
    return 0.5 * occluded, is_outside


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
            # where the edge crosses a plane, as a share of its length
            cut = here * dr.rcp(here - there)
            begin = dr.select((here < 0) & (cut > begin), cut, begin)
            end = dr.select((there < 0) & (cut < end), cut, end)
        # the angle between the ends of the rest, from the products of corner and side alone
        side = corners[following] - corner
        near = dr.fma(dr.dot(corner, side), begin + end, dr.dot(corner, corner))
        along = dr.fma(dr.dot(side, side), begin * end, near)
        angle = dr.atan2((end - begin) * dr.norm(own[k]), along)
        total += dr.select(end > begin, angle * weights[k], 0)
    return total


def by_ball(
    point: Point3,
    normal: Vector3,
    shape: Occluder,
    lamp: Sequence[Vector3],
    planes: Sequence[Vector3],
    weights: Sequence[Float],
) -> tuple[Float, Mask]:
    """As `by_box`, of a ball, which hides a circle of directions.

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
        # the part of the edge within the circle, which the ball hides
        enter, leave = dr.clip(-reach, begin, end), dr.clip(reach, begin, end)
        total += (leave - enter) * weights[k]
        ahead_n, beside_n = dr.dot(ahead, normal), dr.dot(beside, normal)
        # in place of its two parts outside, the arcs of the circle in their sectors
        for one, other in ((begin, enter), (leave, end)):
            (s_1, c_1), (s_2, c_2) = dr.sincos(one), dr.sincos(other)
            turn = dr.atan2(height * dr.sin(other - one), s_1 * s_2 + height * height * c_1 * c_2)
            total += sine2 * turn * lateral
            for s, c, sign in ((s_2, c_2, 1), (s_1, c_1, -1)):
                per_radius = dr.rsqrt(dr.maximum(s * s + height * height * c * c, 1e-20))
                total += sign * sine * cosine * per_radius * (s * beside_n + height * c * ahead_n)
    return 0.5 * total, is_outside

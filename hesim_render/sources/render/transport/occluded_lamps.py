"""Shadows of rectangle lamps in closed form: the part of a lamp that one convex shape hides from a point.

Direct light takes these parts as a control variate (`transport.diffuse`), so shadow rays only correct what they do not
describe: other shapes, and shapes behind each other.

A face or a ball takes hundreds of operations a ray. Pairs of a pixel and a window therefore name the few shapes that
cast a shadow on them (`LampShadows.first_met`).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, LoopState, Mask, MitsubaObject, Ray, UInt32, Vector3
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.scene.tracks import DevicePose
from hesim_render.sources.render.transport.blockers import box_of, face_of
from hesim_render.sources.render.transport.irradiance import RectangleLight
from hesim_render.sources.render.transport.moving_scene import MovingScene
from hesim_render.sources.render.transport.occluders import Occluder, by_ball, by_box
from hesim_render.sources.render.transport.swept_boxes import Moment

#: Largest number of shapes that are known, the largest ones; a code has eight bits for each, and 0 for none.
_MOST = 64
#: Shapes that a code holds.
SLOTS = 4
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
        # the largest ones, by the area of their largest face; in order of their part, of each the largest first
        rows = sorted(sorted(rows, key=lambda row: -_size(row))[:_MOST], key=lambda row: row[3])
        self.is_known = bool(rows)
        self._moves = any(row[3] > 0 for row in rows)
        self._rows = from_host(mi.Float, np.array(rows or [[0.0] * _ROW], np.float32))
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

        def add(code: UInt32, occluded: Float, count: Float) -> tuple[UInt32, Float, Float]:
            shape = self._shape((code & 255) - 1, moment)
            # parts of a shape behind the lamp hide nothing
            counts = is_clear & (shape.over(lamp.middle, lamp.normal) > 0)
            given = point, normal, shape, corners, planes, weights
            part, is_outside = dr.if_stmt(given, shape.square > 0, by_ball, by_box, label="shadow")
            counts &= is_outside
            hits = counts & shape.meets(shadow)
            return code >> 8, occluded + dr.select(counts, part, 0), count + dr.select(hits, mi.Float(1.0), 0)

        state = code, mi.Float(0.0), mi.Float(0.0)
        _, occluded, count = dr.while_loop(state, lambda code, *_: code != 0, add, label="shadows")
        return occluded, count

    def first_met(self, shadow: Ray, moment: Moment, active: Mask) -> UInt32:
        """Number, from 1, of the first shape in the list that a ray meets before its `maxt`; 0 if it meets none."""
        mi = self._scene.mi
        none = DevicePose.none(jit().Array3f)

        def look(number: UInt32, met: UInt32, part: UInt32, *columns: Vector3) -> LoopState:
            shape, own = self._at_rest(number)
            # shapes are in order of their part, whose pose is computed once: 0.27 in place of 0.48 µs a ray (60 shapes)
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

    def _shape(self, number: UInt32, moment: Moment) -> Occluder:
        """The shape whose number each lane holds, in world space."""
        shape, part = self._at_rest(number)
        if self._moves:
            moves = part > 0
            pose = self._scene.pose(dr.select(moves, part - 1, 0), moment)
            shape = shape.posed(DevicePose.none(self._scene.mi.Vector3f).where(~moves, pose))
        return shape

    def _at_rest(self, number: UInt32) -> tuple[Occluder, UInt32]:
        """The shape whose number each lane holds, in the frame of its part; and its part, 0 for what rests."""
        mi = self._scene.mi
        rows = [dr.gather(mi.Vector4f, self._rows, 4 * number + k) for k in range(4)]
        corner, a, b, c = (mi.Vector3f(row.x, row.y, row.z) for row in rows)
        return Occluder(mi.Point3f(corner), (a, b, c), rows[1].w, rows[2].w), mi.UInt32(rows[0].w)


def _columns(pose: DevicePose) -> tuple[Vector3, ...]:
    return *pose.columns, pose.shift


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
    # of equal counts the lower number
    best = np.argsort(-often, axis=1, kind="stable")[:, :SLOTS]
    numbers = np.where(np.take_along_axis(often, best, axis=1) > 0, best, 0).astype(np.uint32)
    return np.bitwise_or.reduce(numbers << np.arange(0, 8 * SLOTS, 8, dtype=np.uint32), axis=1)

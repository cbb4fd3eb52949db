"""Ray intersection in closed form for rigid groups of flat faces, balls or sheets.

Targets are flat, and so are most of the surfaces around them. A few faces and balls are tested one after the other
within the kernel, and Mitsuba's description of each face is fetched once in advance. This is faster than a search
through a tree of boxes, for which rays leave the kernel, and than fetching corners for each hit. Groups with many
shapes, or with shapes of another form, are intersected by Mitsuba (Embree on a CPU, OptiX on a GPU), but for their
balls if these are few. Mitsuba evaluates the reflection of all surfaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import select
from hesim_render.core.device import dr
from hesim_render.core.device_types import (
    DeviceArray,
    Float,
    Interaction,
    Mask,
    MitsubaModule,
    MitsubaObject,
    Point3,
    Ray,
    UInt32,
    Vector3,
)
from hesim_render.sources.render.transport.blockers import Blockers, box_of
from hesim_render.sources.render.transport.faces import SAME, Face, faces_of
from hesim_render.sources.render.transport.intersections import meets_ball, to_ball, to_face
from hesim_render.sources.render.transport.sheets import DeviceSheet, Sheet, sheets_of

#: Largest number of faces and balls that are tested one by one: paths of four segments among 3, 6, 12, 24, 48 faces
#: took 0.93, 0.83, 1.06, 1.08 and 1.7 times as long as with Embree (AVX-512).
_MOST = 8
#: The same of balls beside shapes that Mitsuba intersects: with 1, 4, 16, 32 balls among ten boxes, a ray took 3.2,
#: 4.0, 7.2, 12 ns in place of 14 to 16, because a single ball makes Embree take another search for all shapes.
_MOST_BALLS = 16


@dataclass(frozen=True)
class Ball:
    """Centre, m, and squared radius, m², of a ball."""

    middle: NDArray[np.float64]
    square: float


@dataclass(frozen=True)
class SimpleForm:
    """Faces and balls, each with its Mitsuba shape; or sheets, and the meshes that they are of."""

    faces: list[tuple[Face, MitsubaObject]]
    balls: list[tuple[Ball, MitsubaObject]]
    sheets: list[Sheet]
    meshes: list[MitsubaObject]

    @classmethod
    def of(cls, mi: MitsubaModule, scene: MitsubaObject) -> "SimpleForm | None":
        """The faces and balls of a scene, or its sheets; None if it has other shapes, or too many."""
        shapes = scene.shapes()
        balls = [shape for shape in shapes if shape.class_name() == "Sphere"]
        meshes = [shape for shape in shapes if shape.is_mesh()]
        form = cls([], [], [], meshes)
        # known before any shape is looked at, which takes a kernel
        if len(balls) + sum(mesh.face_count() for mesh in meshes) / 2 > _MOST:
            # on a GPU, which has units of its own for triangles, times were not compared
            if len(meshes) < len(shapes) or select().backend == "cuda":
                return None
            form.sheets.extend(sheets_of(meshes))
            return form if form.sheets else None
        for shape in shapes:
            if shape.class_name() == "Sphere":
                form.balls.append((_ball_around(shape.bbox(), 3**-0.5), shape))
                continue
            faces = faces_of(mi, shape)
            if not faces:
                return None
            form.faces.extend((face, shape) for face in faces)
        return form


class Part:
    """Shapes in the frame in which they are at rest.

    Parameters
    ----------
    mi : the mitsuba module.
    scene : Mitsuba scene with these shapes.
    apart : True if most rays pass far from the shapes. Mitsuba is then asked only about rays that meet a ball around
        them.
    faces_before : number of faces of the parts before it, if faces of several parts are told apart.
    """

    def __init__(self, mi: MitsubaModule, scene: MitsubaObject, apart: bool, faces_before: int = 0) -> None:
        self._mi, self._faces_before = mi, faces_before
        #: Centre and squared radius of each ball, and its shape.
        self._balls: list[tuple[Point3, Float, MitsubaObject]] = []
        #: For each face: rows of the map to u, v and height; number of its first triangle; its shape.
        self._faces: list[tuple[list[tuple[Vector3, Float]], int, MitsubaObject]] = []
        self._sheets: list[DeviceSheet] = []
        #: Mitsuba's surface data of the faces: one value for both triangles, or one for each.
        self._surfaces: list[dict[str, list[Any]]] = []
        #: The scene that Mitsuba intersects, and the ball around it.
        self._scene = self._around = None
        #: The shapes, if they are intersected in closed form.
        self.form = SimpleForm.of(mi, scene)
        if self.form is not None:
            for face, shape in self.form.faces:
                rows = [(mi.Vector3f(row[:3]), mi.Float(float(row[3]))) for row in face.to_uvh]
                self._faces.append((rows, face.triangle, mi.ShapePtr(shape)))
                self._surfaces.append({name: _on_device(mi, value) for name, value in face.surface.items()})
            for ball, shape in self.form.balls:
                self._balls.append((mi.Point3f(ball.middle), mi.Float(ball.square), mi.ShapePtr(shape)))
            self._sheets = [DeviceSheet(mi, sheet, self.form.meshes) for sheet in self.form.sheets]
            boxes = {mesh.id(): box for mesh in self.form.meshes if (box := box_of(mesh)) is not None}
            faces = [face.to_uvh for face, shape in self.form.faces if shape.id() not in boxes]
            self._blockers = Blockers(mi, self._middles, list(boxes.values()), faces, self._sheets)
        else:
            self._scene, balls = _without_balls(mi, scene)
            self._balls = [(mi.Point3f(b.middle), mi.Float(b.square), mi.ShapePtr(shape)) for b, shape in balls]
            # somewhat widened: rounding must not take a rim
            ball = _ball_around(scene.bbox(), 1.0001)
            self._around = (mi.Point3f(ball.middle), mi.Float(ball.square)) if apart else None
            self._blockers = Blockers.of(mi, self._scene, self._middles)
        # shapes as well: their numbers within the kernel would make it another one for every scene
        dr.make_opaque(self._balls, [(rows, shape) for rows, _, shape in self._faces], self._surfaces, self._around)

    @property
    def _middles(self) -> list[tuple[Point3, Float]]:
        return [(middle, square) for middle, square, _ in self._balls]

    @property
    def face_count(self) -> int:
        """Number of faces that are tested one by one."""
        return len(self._faces)

    def nearest(self, ray: Ray, coherent: Mask, active: Mask) -> tuple[Interaction, UInt32]:
        """Intersect rays with the part: the nearest surface before `maxt`.

        Parameters
        ----------
        ray : Ray3f in the part's own frame.
        coherent : True if rays of neighbouring lanes are similar.
        active : lanes to trace.

        Returns
        -------
        hit : `PreliminaryIntersection3f`, its t infinite where nothing is hit; on a face, with the position on the
            face.
        face : UInt32, `faces_before` + 1 to + `face_count` for a face, and 0 for anything else.
        """
        mi = self._mi
        face = mi.UInt32(0)
        if self._scene is not None:
            hit = self._scene.ray_intersect_preliminary(ray, coherent, active & self._near(ray))
            end = dr.minimum(hit.t, ray.maxt)
        else:
            hit = dr.zeros(mi.PreliminaryIntersection3f, dr.width(ray))
            hit.t, end = mi.Float(dr.inf), ray.maxt

        def take(is_nearer: Mask, t: Float, shape: MitsubaObject) -> Float:
            hit.valid |= is_nearer
            hit.t, hit.shape = dr.select(is_nearer, t, hit.t), dr.select(is_nearer, shape, hit.shape)
            return dr.select(is_nearer, t, end)

        for middle, square, shape in self._balls:
            t = to_ball(ray, middle, square)
            end = take(active & (t >= 0) & (t < end), t, shape)
        for number, (rows, _, shape) in enumerate(self._faces, start=self._faces_before + 1):
            t, place, inside = to_face(ray, rows)
            is_nearer = active & inside & (t >= 0) & (t < end)
            end, face = take(is_nearer, t, shape), dr.select(is_nearer, number, face)
            hit.prim_uv = dr.select(is_nearer, place, hit.prim_uv)
        for sheet in self._sheets:
            t, is_met, place, triangle = sheet.meet(ray, active)
            is_nearer = is_met & (t < end)
            own_shape, own_number = sheet.owner(triangle, is_nearer)
            end = take(is_nearer, t, own_shape)
            hit.prim_uv = dr.select(is_nearer, place, hit.prim_uv)
            hit.prim_index = dr.select(is_nearer, own_number, hit.prim_index)
        return hit, face

    def blocks(self, ray: Ray, active: Mask) -> Mask:
        """True where a ray hits anything before its `maxt`."""
        return self._blockers.block(ray, active, self._near(ray))

    def describe_faces(self, si: Interaction, hit: Interaction, face: UInt32) -> None:
        """Fill in normals, axes, texture coordinates and triangles of lanes that hit a face of this part."""
        u, v = hit.prim_uv
        second = u + v > 1
        n, shading, s, dp_du, dp_dv = si.n, si.sh_frame.n, si.sh_frame.s, si.dp_du, si.dp_dv
        for number, ((_, triangle, _), surface) in enumerate(
            zip(self._faces, self._surfaces, strict=True), start=self._faces_before + 1
        ):
            here = face == number

            def chosen(name: str, surface: dict[str, list[Any]] = surface) -> DeviceArray:
                return (
                    dr.select(second, surface[name][1], surface[name][0])
                    if len(surface[name]) == 2
                    else surface[name][0]
                )

            n, shading = dr.select(here, chosen("n"), n), dr.select(here, chosen("shading"), shading)
            s = dr.select(here, chosen("s"), s)
            dp_du, dp_dv = dr.select(here, chosen("dp_du"), dp_du), dr.select(here, chosen("dp_dv"), dp_dv)
            origin, along_u, along_v = chosen("uv")
            si.uv = dr.select(here, dr.fma(along_u, u, dr.fma(along_v, v, origin)), si.uv)
            si.prim_index = dr.select(here, dr.select(second, triangle + 1, triangle), si.prim_index)
        si.n, si.sh_frame.n, si.sh_frame.s, si.dp_du, si.dp_dv = n, shading, s, dp_du, dp_dv

    def _near(self, ray: Ray) -> Mask:
        """True where a ray meets the ball around all shapes, if there is one."""
        return self._mi.Bool(True) if self._around is None else meets_ball(ray, ray.maxt, self._around)


def surface_of(
    parts: Sequence[Part], hit: Interaction, face: UInt32, ray: Ray, flags: MitsubaObject, active: Mask
) -> Interaction:
    """Surface at the hit points, `SurfaceInteraction3f` in the frame of the part that was hit; t is infinite where
    nothing was hit.

    Parameters
    ----------
    parts : all that may have been hit.
    hit, face : results of `Part.nearest` of that part.
    ray : the rays in its frame.
    flags : `RayFlags`, fields to compute. Faces always have all fields.
    active : lanes in which a result is needed.
    """
    si = hit.compute_surface_interaction(ray, flags, active & (face == 0))
    if not any(part.face_count for part in parts):
        return si
    for part in parts:
        part.describe_faces(si, hit, face)
    here = face != 0
    si.sh_frame.t = dr.select(here, dr.cross(si.sh_frame.n, si.sh_frame.s), si.sh_frame.t)
    si.t, si.p = dr.select(here, hit.t, si.t), dr.select(here, ray(hit.t), si.p)
    si.shape = dr.select(here, hit.shape, si.shape)
    si.wi = dr.select(here, si.sh_frame.to_local(-ray.d), si.wi)
    return si


def _on_device(mi: MitsubaModule, values: NDArray[np.float64]) -> list[Any]:
    """Values of both triangles, [2, ...]; one value where they are equal."""
    alike = np.allclose(values[0], values[1], rtol=0, atol=SAME * np.abs(values).max())
    kept = values[:1] if alike else values
    if values.ndim == 2:
        return [mi.Vector3f(value) for value in kept]
    return [tuple(mi.Point2f(row) for row in value) for value in kept]


def _without_balls(mi: MitsubaModule, scene: MitsubaObject) -> tuple[MitsubaObject, list[tuple[Ball, MitsubaObject]]]:
    """A scene without its balls, if these are few beside other shapes, and the balls."""
    shapes = scene.shapes()
    balls = [shape for shape in shapes if shape.class_name() == "Sphere"]
    others = {f"shape_{k}": shape for k, shape in enumerate(shapes) if shape.class_name() != "Sphere"}
    # Mitsuba cannot put an instance into a second scene
    has_instance = any(shape.class_name() == "Instance" for shape in shapes)
    if not balls or len(balls) > _MOST_BALLS or not others or has_instance:
        return scene, []
    return mi.load_dict({"type": "scene", **others}, optimize=False), [
        (_ball_around(shape.bbox(), 3**-0.5), shape) for shape in balls
    ]


def _ball_around(box: MitsubaObject, factor: float) -> Ball:
    """Ball about the centre of a box; its radius is `factor` times half the diagonal."""
    low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
    return Ball((low + high) / 2, float((factor * np.linalg.norm(high - low) / 2) ** 2))

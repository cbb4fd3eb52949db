"""Directions to the images of lamps in flat mirrors, which sampling of lamps and of diffuse surfaces both miss.

A diffuse surface that sees a lamp in a mirror is lit by the image of the lamp. A shadow ray to the lamp ends at the
mirror, and few directions of the surface's own sampling hit the image. Some directions are therefore drawn from cones
around the images instead. The density of all directions is that of the mixture: one-sample multiple importance sampling
with the balance heuristic ([veach1997], section 9.2.4). The estimate is unbiased whatever such a ray hits.
"""

from math import pi

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Bands, Float, Mask, MitsubaModule, MitsubaObject, Point2, Point3, Vector3
from hesim_render.sources.render.scene.mitsuba_version import mesh_faces, mesh_vertices
from hesim_render.sources.render.transport.moving_scene import Surface

#: Part of the directions that is drawn from all images together. In a scene with floor, mirror and three other objects
#: 0.03 to 0.1 had the same noise within a tenth, 0.3 had more.
_SHARE = 0.08
#: Radius of a ball over half the diagonal of a lamp's box: a square then has as much area as the ball's disc. What lies
#: beyond, the corners, is left to the surface's own directions; with all of it in the cones the noise was 4 % larger.
_WITHIN = 0.8
#: Largest number of images; those of the largest lamps are kept.
_MOST = 4
#: Narrowest cone, as 1 - cos of its half angle: below it, float32 cannot tell whether a direction lies within.
_NARROWEST = 1e-5
#: Largest distance of the corners of a flat shape from its plane, over its size.
_FLAT = 1e-5

#: Centre and radius, m; unit normal and offset of the mirror.
Image = tuple[NDArray[np.float64], float, NDArray[np.float64], float]


class LampImages:
    """Balls around the images of lamps, each behind its mirror.

    Parameters
    ----------
    mi : the mitsuba module.
    images : for each: centre [3] and radius, m, and the unit normal [3] and offset of its mirror. A point x is in front
        of the mirror if x · normal > offset.
    """

    def __init__(self, mi: MitsubaModule, images: list[Image]) -> None:
        self._mi = mi
        largest = sorted(images, key=lambda image: -image[1])[:_MOST]
        self._images = [
            (mi.Point3f(centre), mi.Float(radius**2), mi.Vector3f(normal), mi.Float(offset))
            for centre, radius, normal, offset in largest
        ]
        dr.make_opaque(self._images)

    @classmethod
    def of(cls, mi: MitsubaModule, scene: MitsubaObject) -> "LampImages":
        """Images of the area lights of a Mitsuba scene in its flat, perfectly reflecting shapes."""
        lamps = [shape.bbox() for shape in scene.shapes() if shape.is_emitter()]
        images: list[Image] = []
        for shape in scene.shapes():
            plane = _mirror(mi, shape)
            if plane is None:
                continue
            normal, offset = plane
            for box in lamps:
                low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
                centre, radius = (low + high) / 2, _WITHIN * float(np.linalg.norm(high - low)) / 2
                height = float(centre @ normal) - offset
                both = mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.BackSide)
                for side in (1.0, -1.0) if both else (1.0,):
                    if side * height > -radius:
                        images.append((centre - 2 * height * normal, radius, side * normal, side * offset))
        return cls(mi, images)

    def __len__(self) -> int:
        return len(self._images)

    def seen_from(self, point: Point3, upwards: Vector3, active: Mask) -> "Cones":
        """Cones of directions from surface points to the images that can light them.

        Parameters
        ----------
        point : Point3f, world space.
        upwards : unit Vector3f, on the visible side of the surface.
        active : lanes in use.
        """
        mi = self._mi
        cones = []
        for centre, square, normal, offset in self._images:
            to = centre - point
            far = dr.squared_norm(to)
            axis = to * dr.rsqrt(far)
            square_sine = dr.minimum(square / far, 1.0)
            width = square_sine / (1 + dr.sqrt(1 - square_sine))
            there = active & (far > 1.02 * square) & (width > _NARROWEST)
            there &= (dr.dot(mi.Vector3f(point), normal) > offset) & (dr.dot(upwards, axis) > 0)
            chance = dr.select(there, mi.Float(_SHARE / len(self._images)), 0.0)
            cones.append((axis, width, chance))
        return Cones(mi, cones)


class Cones:
    """Directions per lane that are drawn from images instead of from a surface.

    Parameters
    ----------
    mi : the mitsuba module.
    cones : for each: axis, 1 - cos of the half angle, and probability of being drawn.
    """

    def __init__(self, mi: MitsubaModule, cones: list[tuple[Vector3, Float, Float]]) -> None:
        self._mi, self._cones = mi, cones
        self.chance = sum((chance for _, _, chance in cones), mi.Float(0.0))

    def sample(self, choice: Float, place: Point2) -> tuple[Vector3, Mask]:
        """Draw a direction, and tell where one was drawn at all.

        Parameters
        ----------
        choice, place : random numbers in [0, 1) and [0, 1)².
        """
        mi = self._mi
        axis, width, before, drawn = mi.Vector3f(0, 0, 1), mi.Float(0.0), mi.Float(0.0), mi.Bool(False)
        for one, wide, chance in self._cones:
            this = (choice >= before) & (choice < before + chance)
            before += chance
            drawn |= this
            axis, width = dr.select(this, one, axis), dr.select(this, wide, width)
        below = width * place.x  # 1 - cos
        sine = dr.sqrt(below * (2 - below))
        y, x = dr.sincos(2 * pi * place.y)
        return mi.Frame3f(axis).to_world(mi.Vector3f(sine * x, sine * y, 1 - below)), drawn

    def density(self, direction: Vector3) -> Float:
        """Density of the directions drawn from images, per steradian; its integral is `chance`."""
        total = self._mi.Float(0.0)
        for axis, width, chance in self._cones:
            inside = (chance > 0) & (1 - dr.dot(direction, axis) <= width)
            total += dr.select(inside, chance / (2 * pi * width), 0.0)
        return total


def _mirror(mi: MitsubaModule, shape: MitsubaObject) -> tuple[NDArray[np.float64], float] | None:
    """Unit normal and offset of the plane of a flat shape that is a perfect mirror; None for any other shape."""
    bsdf = shape.bsdf()
    if bsdf is None or not mi.has_flag(bsdf.flags(), mi.BSDFFlags.DeltaReflection):
        return None
    # not glass or a rough mirror: most of the light passes through glass, and a rough mirror scatters it
    others = (mi.BSDFFlags.Smooth, mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.Null)
    if any(mi.has_flag(bsdf.flags(), flag) for flag in others):
        return None
    if shape.is_mesh():
        points, faces = mesh_vertices(shape), mesh_faces(shape)
        normal = np.cross(points[faces[0, 1]] - points[faces[0, 0]], points[faces[0, 2]] - points[faces[0, 0]])
    elif shape.class_name() in ("Rectangle", "Disk"):
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
        points, normal = matrix[None, :3, 3], np.cross(matrix[:3, 0], matrix[:3, 1])
    else:
        return None
    length = float(np.linalg.norm(normal))
    if length == 0:
        return None
    normal, size = normal / length, float(np.ptp(points, axis=0).max())
    heights = points @ normal
    if np.ptp(heights) > _FLAT * size:
        return None
    return normal, float(heights.mean())


def redirected(
    bsdf: MitsubaObject,
    context: MitsubaObject,
    surface: Surface,
    cones: Cones,
    choice: Float,
    place: Point2,
    chosen: Mask,
    weight: Bands,
) -> Bands:
    """Weight of a surface sample if some samples are drawn from cones; writes the sampled direction into `chosen`
    lanes.
    """
    import mitsuba as mi

    direction, drawn = cones.sample(choice, place)
    towards = surface.to_local(direction)
    value, pdf = bsdf.eval_pdf(context, surface.rest, towards, drawn)
    delta = ~drawn & mi.has_flag(chosen.sampled_type, mi.BSDFFlags.Delta)
    own, pdf = 1 - cones.chance, dr.select(drawn, pdf, chosen.pdf)
    mixed = dr.fma(own, pdf, cones.density(dr.select(drawn, direction, surface.to_world(chosen.wo))))
    weight = dr.select(drawn, value / mixed, weight * dr.select(delta, dr.rcp(own), pdf / mixed))
    chosen.wo = dr.select(drawn, towards, chosen.wo)
    chosen.pdf = dr.select(delta, chosen.pdf, mixed)
    chosen.eta = dr.select(drawn, 1.0, chosen.eta)
    chosen.sampled_type = dr.select(drawn, +mi.BSDFFlags.DiffuseReflection, chosen.sampled_type)
    return dr.select(mixed > 0, weight, 0.0)

"""Rays that leave surfaces: they begin a little off, so that rounding does not let them meet the surface again.

Mitsuba takes 9e-5 of 1 m and of the largest coordinate together, as for scenes of about 1 m. In a scene of 1 mm that is
a tenth of it: shadows would begin beside the objects that cast them. Smaller scenes have a gap of their own size here.
"""

import warnings

import numpy as np

from hesim_render.core.device import dr
from hesim_render.core.device_types import Interaction, MitsubaModule, MitsubaObject, Point3, Ray, Vector3
from hesim_render.core.errors import HesimWarning

#: Scenes of this size or more have Mitsuba's own gap, m.
_LARGE_M = 1.0
#: Distance from the origin over the size of a scene beyond which the gap is no longer small, a tenth of the size.
_FAR = 1000


class Leaving:
    """Begins of rays on the surfaces of a scene.

    Parameters
    ----------
    mi : the mitsuba module.
    scene : Mitsuba scene of all shapes at rest; lamps do not count for its size.
    """

    def __init__(self, mi: MitsubaModule, scene: MitsubaObject) -> None:
        # lamps may be far away from what they light
        boxes = [shape.bbox() for shape in scene.shapes() if not shape.is_emitter()]
        ends = np.array([[box.min, box.max] for box in boxes], np.float64).reshape(-1, 2, 3)
        size_m = float(np.linalg.norm(ends[:, 1].max(axis=0) - ends[:, 0].min(axis=0))) if boxes else _LARGE_M
        far_m = float(np.abs(ends).max(initial=0.0))
        if far_m > _FAR * size_m:
            warnings.warn(
                f"the scene, {size_m:.3g} m large, lies {far_m:.3g} m from the origin, too far for single precision: "
                f"its shadows begin {far_m * mi.math.RayEpsilon:.2g} m off; move it and its camera to the origin",
                HesimWarning,
                stacklevel=2,
            )
        self.mi, self._is_own = mi, size_m < _LARGE_M
        self._size = dr.opaque(mi.Float, min(size_m, _LARGE_M))

    def along(self, point: Interaction, direction: Vector3) -> Ray:
        """A ray from a point of a surface in a direction."""
        ray = point.spawn_ray(direction)
        if self._is_own:
            ray.o = self._beside(point, direction)
        return ray

    def to(self, point: Interaction, place: Point3) -> Ray:
        """A ray from a point of a surface that ends just before a place."""
        ray = point.spawn_ray_to(place)
        if self._is_own:
            ray.o = self._beside(point, place - point.p)
            way = place - ray.o
            length = dr.norm(way)
            ray.d, ray.maxt = way / length, length * (1 - self.mi.math.ShadowEpsilon)
        return ray

    def _beside(self, point: Interaction, direction: Vector3) -> Point3:
        gap = (self._size + dr.max(abs(point.p))) * self.mi.math.RayEpsilon
        return dr.fma(dr.mulsign(gap, dr.dot(point.n, direction)), point.n, point.p)

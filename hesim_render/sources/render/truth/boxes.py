"""Boxes around objects, in the picture and in space."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from hesim_render.core.device_types import MitsubaObject
from hesim_render.sources.render.scene.mitsuba_version import box_corners, mesh_vertices
from hesim_render.sources.render.truth.chief_rays import ChiefRays
from hesim_render.sources.render.truth.poses import PoseTable, inverse
from hesim_render.sources.render.truth.raster import Raster

#: Points on the outline of a sphere: its box is short by at most 1e-4 of its size.
_OUTLINE = 256


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of all objects at one time, in the order of `names`.

    Parameters
    ----------
    names : names of the objects, without the background.
    visible_px : [object, 4], left, top, right, bottom of the pixels that show the object, in px of the grid: borders of
        pixels, so that one pixel at (0, 0) has −0.5, −0.5, 0.5, 0.5. NaN where none shows it.
    whole_px : [object, 4], the same of the whole object, occluded parts and parts beside the picture included, exact
        for meshes and spheres and of the box in space for other shapes; NaN if a part of it is not in front of the
        camera.
        With a rolling shutter, at the time of the middle row.
    corners_m : [object, 8, 3], corners of the box in space, world, m. It is parallel to the world's axes while the
        object is at its place in the scene file, and moves with it.
    """

    names: tuple[str, ...]
    visible_px: NDArray[np.float64]
    whole_px: NDArray[np.float64]
    corners_m: NDArray[np.float64]


class ObjectShapes:
    """Points of each object at rest, from which its boxes follow.

    Parameters
    ----------
    rays : the scene; its shapes are at rest.
    """

    def __init__(self, rays: ChiefRays) -> None:
        self._rays = rays
        names = rays.names
        self._points: list[list[NDArray[np.float64]]] = [[] for _ in names.objects]
        #: Centre and radius of spheres.
        self._balls: list[list[tuple[NDArray[np.float64], float]]] = [[] for _ in names.objects]
        corners: list[list[NDArray[np.float64]]] = [[] for _ in names.objects]
        for number, shape in enumerate(rays.parts.shapes.values(), start=1):
            owner = int(names.object_of[number])
            box = shape.bbox()
            low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
            corners[owner].append(np.stack([low, high]))
            if shape.class_name() == "Sphere":
                self._balls[owner].append(((low + high) / 2, float(np.linalg.norm(high - low) / 2 / 3**0.5)))
            else:
                self._points[owner].append(_points_of(shape, low, high))
        self._corners = np.zeros((len(names.objects), 8, 3))
        for number, own_corners in enumerate(corners):
            if own_corners:
                every = np.concatenate(own_corners)
                self._corners[number] = box_corners(every.min(axis=0), every.max(axis=0))

    def boxes(self, raster: Raster, objects: NDArray[np.integer], times_us: NDArray[np.float64]) -> Boxes:
        """Boxes at the times of rows.

        Parameters
        ----------
        raster : the grid.
        objects : [row, col], number of the object that each pixel shows.
        times_us : time of each mosaic row, µs.
        """
        rays = self._rays
        count = len(rays.names.objects)
        visible, whole = np.full((count, 4), np.nan), np.full((count, 4), np.nan)
        for number, part in enumerate(ndimage.find_objects(objects.astype(np.int32), count - 1), start=1):
            if part is not None:
                rows, cols = part
                visible[number] = cols.start - 0.5, rows.start - 0.5, cols.stop - 0.5, rows.stop - 0.5
        # the whole object is at one time, that of the middle row
        middle = PoseTable(rays, np.array([times_us[(times_us.size - 1) // 2]]))
        pose = middle.groups[rays.names.group_of, 0]
        to_camera = inverse(middle.camera[0]) @ pose
        for number in range(1, count):
            whole[number] = self._whole(number, to_camera[number], raster)
        corners = np.einsum("nij,nkj->nki", pose[:, :3, :3], self._corners) + pose[:, None, :3, 3]
        return Boxes(rays.names.objects[1:], visible[1:], whole[1:], corners[1:])

    def _whole(self, number: int, to_camera: NDArray[np.float64], raster: Raster) -> NDArray[np.float64]:
        points = [part @ to_camera[:3, :3].T + to_camera[:3, 3] for part in self._points[number]]
        for middle, radius in self._balls[number]:
            points.append(_outline(to_camera[:3, :3] @ middle + to_camera[:3, 3], radius))
        places = raster.to_grid(self._rays.view.projection.project(np.concatenate(points)))
        if not np.all(np.isfinite(places)):
            return np.full(4, np.nan)
        return np.concatenate([places.min(axis=0), places.max(axis=0)])


def _points_of(shape: MitsubaObject, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points whose hull is that of a shape, [n, 3]: vertices of a mesh, else corners of its box."""
    if not shape.is_mesh():
        return box_corners(low, high)
    return mesh_vertices(shape)


def _outline(middle: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Points of a sphere where rays from the origin touch it, [n, 3]; NaN if the origin lies inside.

    They lie on a circle in the plane at r²/d in front of the centre, of radius r·√(1 − r²/d²).
    """
    distance = float(np.linalg.norm(middle))
    if distance <= radius:
        return np.full((1, 3), np.nan)
    axis = middle / distance
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    angle = np.arange(_OUTLINE) * (2 * np.pi / _OUTLINE)
    circle = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
    share = radius / distance
    return middle - axis * radius * share + radius * (1 - share**2) ** 0.5 * circle

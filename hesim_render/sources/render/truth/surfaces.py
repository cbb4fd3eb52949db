"""What each pixel's chief ray meets: distance, normal, shape and material, and whether the pixel is mixed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.bands import in_bands
from hesim_render.sources.render.projection import Projection
from hesim_render.sources.render.tracer import BLOCK_RAYS
from hesim_render.sources.render.truth.chief_rays import ChiefRays, Hits, Placed
from hesim_render.sources.render.truth.poses import PoseTable
from hesim_render.sources.render.truth.raster import Raster

#: A pixel is mixed if a ray through its border or a corner meets another shape, or the same shape at a normal that
#: differs by more than this angle, or farther from the plane of its surface than this part of the distance.
MIXED_DEG, MIXED_DEPTH = 15.0, 0.01
#: Distance of those rays from the centre, px: just inside, so that rounding takes none into the next pixel.
_BORDER_PX = 0.5 - 1 / 64
_AROUND = [(x, y) for x in (-_BORDER_PX, 0.0, _BORDER_PX) for y in (-_BORDER_PX, 0.0, _BORDER_PX) if x or y]
#: Points that one thread works on at a time.
BAND = 1 << 15


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces that the pixels of a grid show, [row, col] each.

    Parameters
    ----------
    distance_m : float32, from the entrance pupil; infinite where there is no surface.
    normal : [row, col, 3], float32.
    shape, material : Dr.Jit's numbers, see `Names`.
    times_us : time of each mosaic row of the region, µs.
    projection : geometry of the lens.
    """

    distance_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    shape: NDArray[np.uint32]
    material: NDArray[np.uint32]
    times_us: NDArray[np.float64]
    projection: Projection

    def points(
        self,
        col: NDArray[np.integer],
        row: NDArray[np.integer],
        distance_m: NDArray[np.floating],
        camera_to_world: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """World points [n, 4] of pixels of the full sensor, homogeneous: where there is no surface, a direction whose
        last coordinate is 0.
        """
        local = self.projection.unproject(np.stack([col, row], axis=-1))
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        far = np.isinf(distance_m)
        local *= np.where(far, 1.0, distance_m)[:, None]
        homogeneous = np.concatenate([local, np.where(far, 0.0, 1.0)[:, None]], axis=1)
        return np.einsum("nij,nj->ni", camera_to_world, homogeneous)

    def depth_m(self, raster: Raster) -> NDArray[np.float32]:
        """Depth along the optical axis, [row, col], m; infinite where there is no surface."""
        local = self.projection.unproject(np.stack([raster.col, raster.row], axis=-1))
        return (self.distance_m / np.linalg.norm(local, axis=-1)).astype(np.float32)

    def position(self, rays: ChiefRays, raster: Raster) -> NDArray[np.float32]:
        """World position of the surface, [row, col, 3], m; NaN where there is none."""
        table, row, col = PoseTable(rays, self.times_us), raster.row.ravel(), raster.col.ravel()
        distance, position = self.distance_m.ravel(), np.empty((row.size, 3), np.float32)

        def place(part: slice) -> None:
            camera = table.camera[table.index(row[part] - raster.first[1])]
            points = self.points(col[part], row[part], distance[part], camera)
            points[points[:, 3] == 0] = np.nan
            position[part] = points[:, :3]

        in_bands(row.size, place, BAND)
        return position.reshape(*raster.shape, 3)


def _placed(raster: Raster, times_us: NDArray[np.float64]) -> Placed:
    row = raster.row.ravel()
    return Placed(raster.col.ravel().astype(np.float64), row.astype(np.float64), times_us[row - raster.first[1]])


def surfaces_at(rays: ChiefRays, raster: Raster, times_us: NDArray[np.float64]) -> Surfaces:
    """Surfaces that the pixels of a grid show, each at the time of its row."""
    hits = rays.trace(_placed(raster, times_us))
    return Surfaces(
        hits.distance_m.reshape(raster.shape),
        hits.normal.reshape(*raster.shape, 3),
        hits.shape.reshape(raster.shape),
        hits.material.reshape(raster.shape),
        times_us,
        rays.view.projection,
    )


def mixed_pixels(rays: ChiefRays, raster: Raster, surfaces: Surfaces) -> NDArray[np.bool_]:
    """True where a pixel's footprint (one pitch square) shows more than one surface or an edge, [row, col].

    Rays through the four corners and the middles of the four sides are compared with the chief ray. Things smaller than
    half a pixel may pass between them.
    """
    placed, table = _placed(raster, surfaces.times_us), PoseTable(rays, surfaces.times_us)
    shape, normal = surfaces.shape.ravel(), surfaces.normal.reshape(-1, 3)
    distance, row = surfaces.distance_m.ravel(), raster.row.ravel() - raster.first[1]
    mixed = np.zeros(shape.size, np.bool_)
    for first in range(0, shape.size, BLOCK_RAYS):
        part = slice(first, first + BLOCK_RAYS)
        here = Placed(placed.col[part], placed.row[part], placed.t_us[part])
        centre = np.stack([here.col, here.row], axis=-1)
        # normals in camera space, so that both rays begin at the origin
        own = np.einsum("nji,nj->ni", table.camera[table.index(row[part]), :3, :3], normal[part])
        far = np.where(np.isinf(distance[part]), 0, distance[part])
        height = np.einsum("ni,ni->n", own, _unit(rays, centre)) * far
        for offset in _AROUND:
            beside = _unit(rays, centre + np.array(offset))
            mixed[part] |= _differs(rays.trace(here, offset), shape[part], normal[part], height, own, beside)
    return mixed.reshape(raster.shape)


def _unit(rays: ChiefRays, place_px: NDArray[np.float64]) -> NDArray[np.float64]:
    local = rays.view.projection.unproject(place_px)
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def _differs(
    hits: Hits,
    shape: NDArray[np.uint32],
    normal: NDArray[np.float32],
    height: NDArray[np.float64],
    own: NDArray[np.float64],
    direction: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Whether rays meet another surface than the chief rays of their pixels; see `MIXED_DEG`.

    Parameters
    ----------
    shape, normal : of the chief rays.
    height : distance of the plane of their surface from the camera, negative, m.
    own, direction : that normal and the rays, in camera space.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        turned = np.einsum("ni,ni->n", hits.normal, normal) < np.cos(np.radians(MIXED_DEG))
        flat = height / np.einsum("ni,ni->n", own, direction)
        stepped = np.abs(hits.distance_m - flat) > MIXED_DEPTH * flat
    return (hits.shape != shape) | ((shape != 0) & (turned | stepped))

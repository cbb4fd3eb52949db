"""Where each point of a picture lies in the picture of another time, and whether it is visible there.

A pixel's point is the one that its chief ray meets at the time of its row. It moves with its object, and so does the
camera. With a rolling shutter, the time at which the point is seen again depends on the row in which it is seen:
row = y(t(row)), which is solved by fixed-point iteration. It contracts as long as the image of the point moves more
slowly than the shutter.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.bands import in_bands
from hesim_render.sources.render.tracer import BLOCK_RAYS
from hesim_render.sources.render.truth.chief_rays import ChiefRays
from hesim_render.sources.render.truth.poses import PoseTable, inverse
from hesim_render.sources.render.truth.raster import Raster
from hesim_render.sources.render.truth.surfaces import BAND, Surfaces

#: Largest error of the row at which the iteration ends, px, and most steps.
_SETTLED_PX, _MOST_STEPS = 1e-5, 60


@dataclass(frozen=True, eq=False)
class Flow:
    """Optical flow of a grid.

    Parameters
    ----------
    flow_px : [row, col, 2], displacement to the right and downwards, px of the grid, float32; NaN where the point is
        not in front of the camera at the second time.
    visible : [row, col], True where the point is seen again: inside the picture, its face towards the camera, and
        nothing in front of it.
    """

    flow_px: NDArray[np.float32]
    visible: NDArray[np.bool_]


def flow_between(rays: ChiefRays, raster: Raster, surfaces: Surfaces, to_us: NDArray[np.float64]) -> Flow:
    """Flow from the time of `surfaces` to the times of rows `to_us`.

    Parameters
    ----------
    rays, raster : scene and grid.
    surfaces : what the pixels of the grid show at the first time.
    to_us : second time of each mosaic row, [rows], µs.
    """
    before, after = PoseTable(rays, surfaces.times_us), PoseTable(rays, to_us)
    # from the rest pose of each group to the camera at the second time, [group, row, 4, 4]
    relative = inverse(after.camera) @ after.groups
    count = raster.col.size
    place = np.empty((count, 2))
    facing = np.empty(count, np.bool_)
    shape = surfaces.shape.ravel()
    group = rays.names.group_of[rays.names.object_of[rays.names.instance(shape)]]
    distance, normal = surfaces.distance_m.ravel(), surfaces.normal.reshape(-1, 3)
    col, row = raster.col.ravel(), raster.row.ravel() - raster.first[1]
    project = rays.view.projection.project
    first_row = raster.first[1]

    def follow(part: slice) -> None:
        own, which = before.index(row[part]), group[part]
        # the point and its normal, taken back from the first time to where their object rests
        point = surfaces.points(col[part], row[part] + first_row, distance[part], before.camera[own])
        rest = np.einsum("nij,nj->ni", inverse(before.groups[which, own]), point)
        turned = np.swapaxes(before.groups[which, own][:, :3, :3], 1, 2)
        rest_normal = np.einsum("nij,nj->ni", turned, normal[part].astype(np.float64))
        # the row that sees the point sets its time, and the time sets the row: from the own row, until both agree
        seen = row[part].astype(np.float64)
        for _ in range(_MOST_STEPS):
            low, high, share = after.between(seen)
            matrix = relative[which, low]
            if not after.is_global:
                matrix = matrix + share[:, None, None] * (relative[which, high] - matrix)
            local = np.einsum("nij,nj->ni", matrix[:, :3], rest)
            there = project(local)
            moved = np.abs(there[:, 1] - first_row - seen)
            seen = there[:, 1] - first_row
            if after.is_global or not np.any(moved > _SETTLED_PX):
                break
        place[part] = there
        # a surface that has turned away cannot be seen; the sky has no side
        towards = -np.einsum("nij,nj,ni->n", matrix[:, :3, :3], rest_normal, local)
        settled = np.isfinite(moved) & (after.is_global | ~(moved > _SETTLED_PX))
        facing[part] = settled & ((towards > 0) | ~np.isfinite(distance[part]))

    in_bands(count, follow, BAND)
    start = np.stack([col, raster.row.ravel()], axis=-1)
    flow = ((place - start) / np.array(raster.step)).astype(np.float32)
    corner = place - np.array(raster.first)
    size = np.array([rays.sensor.cols, rays.sensor.rows])
    # only points that face the camera within the picture are worth a ray
    candidate = np.flatnonzero(facing & np.all((corner >= -0.5) & (corner <= size - 0.5), axis=1))
    visible = np.zeros(count, np.bool_)
    for first in range(0, candidate.size, BLOCK_RAYS):
        which = candidate[first : first + BLOCK_RAYS]
        visible[which] = _unoccluded(rays, after, before, surfaces, group, col, row, which, corner, distance)
    return Flow(flow.reshape(*raster.shape, 2), visible.reshape(raster.shape))


def _unoccluded(
    rays: ChiefRays,
    after: PoseTable,
    before: PoseTable,
    surfaces: Surfaces,
    group: NDArray[np.int64],
    col: NDArray[np.int64],
    row: NDArray[np.int64],
    which: NDArray[np.intp],
    corner: NDArray[np.float64],
    distance: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Whether nothing lies in front of points at the second time, for the listed pixels."""
    own, low_high = before.index(row[which]), after.between(corner[which, 1])
    low, high, share = low_high
    point = surfaces.points(col[which], row[which] + rays.sensor.layout.row0, distance[which], before.camera[own])
    rest = np.einsum("nij,nj->ni", inverse(before.groups[group[which], own]), point)
    pose = after.groups[group[which], low]
    camera = after.camera[low]
    if not after.is_global:
        pose = pose + share[:, None, None] * (after.groups[group[which], high] - pose)
        camera = camera + share[:, None, None] * (after.camera[high] - camera)
    there = np.einsum("nij,nj->ni", pose[:, :3], rest)
    t_us, origin = after.times_at(corner[which, 1]), camera[:, :3, 3]
    clear = np.zeros(which.size, np.bool_)
    sky = np.isinf(distance[which])
    # a point of a surface is at a distance, a direction of the sky is not
    clear[~sky] = rays.sees(there[~sky], t_us[~sky], origin[~sky])
    if sky.any():
        clear[sky] = rays.sees_sky(there[sky], t_us[sky], origin[sky])
    return clear

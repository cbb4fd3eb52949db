"""Poses of the camera and of all moving things at any time, as tables of matrices.

Public poses have the axes that computer vision uses: x to the right of the image, y downwards, z along the view.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.sources.render.truth.chief_rays import ChiefRays
from hesim_render.sources.render.truth.raster import Raster

#: From the axes of computer vision (y down, z forward) to camera space (y up, −z forward).
VISION_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of a grid; column and row (x, y) of a point [X, Y, Z] in front of the camera are
    (fx·x' + cx, fy·y' + cy), with (x', y') = (X/Z, Y/Z) after distortion. Whole numbers are centres of pixels, as in
    OpenCV. Where a lens has lateral chromatic aberration, this is at wavelengths at which it is 0.

    Parameters
    ----------
    k : [3, 3], [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px of the grid.
    width, height : size of the grid.
    distortion_model : ``none``, ``opencv`` (`cv2.projectPoints`) or ``fisheye`` (`cv2.fisheye.projectPoints`).
    distortion : coefficients of that model, in OpenCV's order: k1, k2, p1, p2, k3 and, for the rational model, k4, k5,
        k6; or k1 to k4 of the fisheye.
    is_even : False if some pixels lie beside the grid's own places (event pixels at uneven places of the tile).
    """

    k: NDArray[np.float64]
    width: int
    height: int
    distortion_model: str
    distortion: tuple[float, ...]
    is_even: bool

    def as_dict(self) -> dict[str, Any]:
        """The fields as plain values."""
        return {
            "k": self.k.tolist(),
            "width": self.width,
            "height": self.height,
            "distortion_model": self.distortion_model,
            "distortion": list(self.distortion),
            "is_even": self.is_even,
        }


def camera_model(rays: ChiefRays, raster: Raster) -> CameraModel:
    """Intrinsics of the camera in use for a grid."""
    projection = rays.view.projection
    height, width = raster.shape
    centre = raster.to_grid(np.array(projection.centre_px))
    k = np.array(
        [
            [projection.focal_px / raster.step[0], 0.0, centre[0]],
            [0.0, projection.focal_px / raster.step[1], centre[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    distortion = rays.sensor.optics.distortion
    model, coefficients = ("none", ()) if distortion is None else (distortion.model, distortion.coefficients)
    return CameraModel(k, width, height, model, coefficients, raster.is_even)


def inverse(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of rigid poses [..., 4, 4]."""
    back = np.zeros_like(pose)
    back[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, 3] = -np.einsum("...ij,...j->...i", back[..., :3, :3], pose[..., :3, 3])
    back[..., 3, 3] = 1.0
    return back


class PoseTable:
    """Poses of camera and groups at the times of all rows, or at one time for all.

    Parameters
    ----------
    rays : the scene.
    times_us : time of each row, [rows], µs.

    Attributes
    ----------
    camera : [k, 4, 4], camera to world, k = 1 for one time.
    groups : [groups + 1, k, 4, 4], rest to world; the last is the identity of what rests.
    """

    def __init__(self, rays: ChiefRays, times_us: NDArray[np.float64]) -> None:
        self.is_global = bool(np.all(times_us == times_us[0]))
        self.times_us = times_us[:1] if self.is_global else times_us
        self.camera = np.ascontiguousarray(rays.camera_to_world(self.times_us))
        still = np.broadcast_to(np.eye(4), self.camera.shape)
        self.groups = np.stack([*(track.matrix(self.times_us) for track in rays.tracks), still])

    def index(self, row: NDArray[np.integer]) -> NDArray[np.intp]:
        """Entry of the tables for each row."""
        return np.zeros(row.shape, np.intp) if self.is_global else row.astype(np.intp)

    def between(self, row: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Two entries and the share of the second, for fractional rows; beyond the picture, the time of its border."""
        if self.is_global:
            zero = np.zeros(row.shape, np.intp)
            return zero, zero, np.zeros(row.shape)
        last = self.times_us.size - 1
        inside = np.clip(np.nan_to_num(row), 0, last)
        low = np.minimum(inside.astype(np.intp), last - 1)
        return low, low + 1, inside - low

    def times_at(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        """Time of fractional rows, µs."""
        low, high, share = self.between(row)
        return self.times_us[low] * (1 - share) + self.times_us[high] * share


def camera_pose(rays: ChiefRays, t_us: ArrayLike) -> NDArray[np.float64]:
    """Pose of the camera in world, [..., 4, 4], axes of computer vision."""
    return rays.camera_to_world(np.asarray(t_us, dtype=np.float64)) @ VISION_AXES


def object_poses(rays: ChiefRays, t_us: ArrayLike) -> dict[str, NDArray[np.float64]]:
    """Pose of each object, [..., 4, 4]: from its place in the scene file to its place at that time."""
    times = np.asarray(t_us, dtype=np.float64)
    tracks, groups = rays.tracks, rays.names.group_of
    still = np.broadcast_to(np.eye(4), (*times.shape, 4, 4))
    return {
        name: tracks[groups[number]].matrix(times) if groups[number] >= 0 else still
        for number, name in enumerate(rays.names.objects)
        if number
    }

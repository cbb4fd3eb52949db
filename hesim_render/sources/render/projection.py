"""Where the picture of a direction lies, and which direction a place in the picture shows: the geometry of the lens.

Camera space: x to the right of the image, y up, view direction −z. Places are pixels of the *full* sensor, column
first; the centre of the pixel in column 0 and row 0 is (0, 0), so that it covers −0.5 to 0.5, as in OpenCV.

`Projection` is the only place that knows the law of the lens. A pinhole images the tangent of an angle; a lens with
distortion changes `distorted` and `undistorted` here, and `tangents` on the device.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.sensor.sensor import Sensor


@dataclass(frozen=True)
class Projection:
    """Geometry of a lens and its sensor.

    Parameters
    ----------
    focal_px : image distance over the pixel pitch, px.
    centre_px : column and row of the optical axis on the full sensor (the principal point), px.
    """

    focal_px: float
    centre_px: tuple[float, float]

    @classmethod
    def of(cls, sensor: Sensor) -> Projection:
        """The projection of a sensor with the lens in use."""
        geometry, lens = sensor.spec.geometry, sensor.lens
        pitch_mm = geometry.pitch_um * 1e-3
        x, y = (
            (count - 1) / 2 + axis / pitch_mm
            for count, axis in zip((geometry.cols, geometry.rows), lens.axis_mm, strict=True)
        )
        return cls(lens.image_distance_mm / pitch_mm, (x, y))

    def distorted(self, tangent: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image places [..., 2] in units of the image distance, from tangents of the angles to the axis [..., 2]; both
        to the right and downwards.
        """
        return tangent

    def undistorted(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tangents [..., 2] of image places [..., 2]: the inverse of `distorted`."""
        return place

    def project(self, local: ArrayLike) -> NDArray[np.float64]:
        """Column and row of points or directions in camera space.

        Parameters
        ----------
        local : [..., 3], any length. Those that are not in front of the camera have no picture.

        Returns
        -------
        [..., 2], px of the full sensor; NaN where there is no picture.
        """
        x, y, z = np.moveaxis(np.asarray(local, dtype=np.float64), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            tangent = np.stack([x, -y], axis=-1) / np.where(z < 0, -z, np.nan)[..., None]
        return self.distorted(tangent) * self.focal_px + np.array(self.centre_px)

    def unproject(self, place_px: ArrayLike) -> NDArray[np.float64]:
        """Direction of chief rays in camera space, at depth 1: [..., 3] with z = −1.

        Parameters
        ----------
        place_px : column and row, [..., 2], px of the full sensor.
        """
        tangent = self.undistorted((np.asarray(place_px, dtype=np.float64) - np.array(self.centre_px)) / self.focal_px)
        return np.stack([tangent[..., 0], -tangent[..., 1], np.full(tangent.shape[:-1], -1.0)], axis=-1)


class DeviceProjection:
    """`Projection.unproject` on the device, in float32.

    Parameters
    ----------
    projection : the projection.
    """

    def __init__(self, projection: Projection) -> None:
        import drjit as dr

        types = jit()
        # opaque, so that another lens or sensor needs no new kernel
        self._middle = [dr.opaque(types.Float, centre) for centre in projection.centre_px]
        #: Tangent of the chief ray's angle from one pixel to the next.
        self._step = dr.opaque(types.Float, 1 / projection.focal_px)

    def tangents(self, row: Float, col: Float, offset_x: Float, offset_y: Float) -> tuple[Float, Float]:
        """Tangents of the chief ray's angles, to the right and downwards.

        Parameters
        ----------
        row, col : Dr.Jit Float, whole pixels of the full sensor.
        offset_x, offset_y : place beside the pixel's centre, px.
        """
        # half-integers relative to the centre of the chip are exact in float32
        return (col - self._middle[0] + offset_x) * self._step, (row - self._middle[1] + offset_y) * self._step

    def places(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Column and row of tangents, the inverse of `tangents`; and pixels per unit of tangent there."""
        import drjit as dr

        scale = dr.rcp(self._step)
        return x * scale + self._middle[0], y * scale + self._middle[1], scale

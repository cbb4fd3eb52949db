"""Where the picture of a direction lies, and which direction a place in the picture shows: the geometry of the lens.

Camera space: x to the right of the image, y up, view direction −z. Places are pixels of the *full* sensor, column
first; the centre of the pixel in column 0 and row 0 is (0, 0), so that it covers −0.5 to 0.5, as in OpenCV.

`Projection` is the only place that knows the law of the lens. A pinhole images the tangent of an angle; the models of
distortion are in `hesim_render.sensor.distortion`.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Float64
from hesim_render.core.errors import SpecError
from hesim_render.core.host_arrays import from_host
from hesim_render.sensor.distortion import Distortion, fisheye, opencv
from hesim_render.sensor.sensor import Sensor

#: Entries of the table from which the inverse starts on the device, and its steps.
_STARTS, _STEPS = 1024, 2
_distortion = lru_cache(maxsize=32)(Distortion.of)


@dataclass(frozen=True)
class Projection:
    """Geometry of a lens and its sensor.

    Parameters
    ----------
    focal_px : image distance over the pixel pitch, px.
    centre_px : column and row of the optical axis on the full sensor (the principal point), px.
    distortion : None for a pinhole.
    """

    focal_px: float
    centre_px: tuple[float, float]
    distortion: Distortion | None = None

    @classmethod
    def of(cls, sensor: Sensor, region_mm: tuple[float, float, float, float] | None = None) -> "Projection":
        """The projection of a sensor with the lens in use.

        Parameters
        ----------
        sensor : with the lens in use.
        region_mm : part of the chip that has a picture, as `View.region_mm`; default all of it.

        Raises
        ------
        SpecError
            If the distortion of the sensor file folds inside that part; with file and line.
        """
        geometry, lens = sensor.spec.geometry, sensor.lens
        pitch_mm = geometry.pitch_um * 1e-3
        x, y = (
            (count - 1) / 2 + axis / pitch_mm
            for count, axis in zip((geometry.cols, geometry.rows), lens.axis_mm, strict=True)
        )
        focal_px, model = lens.image_distance_mm / pitch_mm, sensor.optics.distortion
        if model is None:
            return cls(focal_px, (x, y))
        half_x, half_y = geometry.cols * pitch_mm / 2, geometry.rows * pitch_mm / 2
        left, right, top, bottom = region_mm or (-half_x, half_x, -half_y, half_y)
        axis_x, axis_y = lens.axis_mm
        far = np.hypot(max(axis_x - left, right - axis_x), max(axis_y - top, bottom - axis_y))
        try:
            return cls(focal_px, (x, y), _distortion(model, float(far) / lens.image_distance_mm))
        except SpecError as error:
            raise sensor.lens_error(str(error).removeprefix(f"{error.key}: "), "lens.distortion") from None

    def distorted(self, tangent: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image places [..., 2] in units of the image distance, from tangents of the angles to the axis [..., 2]; both
        to the right and downwards.
        """
        return tangent if self.distortion is None else self.distortion.distorted(tangent)

    def undistorted(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tangents [..., 2] of image places [..., 2]: the inverse of `distorted`."""
        return place if self.distortion is None else self.distortion.undistorted(place)

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
    """`Projection.unproject` on the device, in float32."""

    def __init__(self, projection: Projection) -> None:
        types = jit()
        # opaque, so that another lens or sensor needs no new kernel
        self._middle = [dr.opaque(types.Float, centre) for centre in projection.centre_px]
        #: Image place, in units of the image distance, from one pixel to the next.
        self._step = dr.opaque(types.Float, 1 / projection.focal_px)
        self._exact_step = dr.opaque(types.Float64, 1 / projection.focal_px)
        self._distortion = None if projection.distortion is None else _DeviceDistortion(projection.distortion)

    def tangents(
        self, row: Float, col: Float, offset_x: Float, offset_y: Float, shrink: Float | None = None
    ) -> tuple[Float, Float]:
        """Tangents of the chief ray's angles, to the right and downwards.

        Parameters
        ----------
        row, col : Dr.Jit Float, whole pixels of the full sensor.
        offset_x, offset_y : place beside the pixel's centre, px.
        shrink : factor on the place's distance from the axis; None for 1.
        """
        if self._distortion is None:
            x, y = self.image_place(row, col, offset_x, offset_y)
            return (x, y) if shrink is None else (x * shrink, y * shrink)
        types = jit()
        step = self._exact_step if shrink is None else self._exact_step * types.Float64(shrink)
        return self._distortion.undistorted(
            (types.Float64(col - self._middle[0]) + types.Float64(offset_x)) * step,
            (types.Float64(row - self._middle[1]) + types.Float64(offset_y)) * step,
        )

    def image_place(self, row: Float, col: Float, offset_x: Float, offset_y: Float) -> tuple[Float, Float]:
        """The same place relative to the axis, in units of the image distance."""
        # half-integers relative to the centre of the chip are exact in float32
        return (col - self._middle[0] + offset_x) * self._step, (row - self._middle[1] + offset_y) * self._step

    def places(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Column and row of tangents, the inverse of `tangents`; and at most so many pixels per unit of tangent
        there.
        """
        scale = dr.rcp(self._step)
        if self._distortion is None:
            return x * scale + self._middle[0], y * scale + self._middle[1], scale
        u, v, gain = self._distortion.distorted(x, y)
        return u * scale + self._middle[0], v * scale + self._middle[1], scale * gain


class _DeviceDistortion:
    """`Distortion` on the device, in float32; beyond its limit, directions are those at the limit."""

    def __init__(self, distortion: Distortion) -> None:
        types = jit()
        self._is_fisheye = distortion.model == "fisheye"
        self._k = [dr.opaque(types.Float, value) for value in distortion.coefficients]
        self._exact = [dr.opaque(types.Float64, value) for value in distortion.coefficients]
        self._limit = dr.opaque(types.Float, distortion.limit)
        place, tangent = distortion.starts
        even = np.linspace(0, place[-1], _STARTS)
        ratio = np.interp(even, place, tangent) / np.maximum(even, 1e-300)
        ratio[0] = ratio[1]
        self._ratio = from_host(types.Float, ratio)
        self._most = dr.opaque(types.Float, float(place[-1]))
        dr.make_opaque(self._ratio)

    def _formula(self, x: Float, y: Float, exact: bool = False) -> tuple[Any, ...]:
        k = self._exact if exact else self._k
        if self._is_fisheye:
            return fisheye(k, x, y, dr.atan2, dr.sqrt, dr.maximum)
        return opencv(k, x, y)

    def distorted(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Image place, and the largest factor by which it moves for a tangent."""
        inside = dr.minimum(self._limit * dr.rsqrt(dr.maximum(x * x + y * y, 1e-30)), 1)
        u, v, xx, xy, yy = self._formula(x * inside, y * inside)
        return u, v, dr.sqrt(xx * xx + 2 * xy * xy + yy * yy)

    def undistorted(self, u: Float64, v: Float64) -> tuple[Float, Float]:
        """Tangents of an image place: Newton's method from a table of the mean over directions.

        The last residual is computed in float64: rounding of the model would be 0.001 px at the border of a fisheye.
        """
        types = jit()
        # beyond the limit of the model: the place at the limit in the same direction
        distance = dr.sqrt(u * u + v * v)
        inside = dr.minimum(types.Float64(self._most) / dr.maximum(distance, 1e-30), 1)
        u, v, distance = u * inside, v * inside, types.Float(distance * inside)
        # start: the tangent over the place, by the table, between two of its entries
        at = dr.minimum(distance / self._most * (_STARTS - 1), _STARTS - 1)
        cell = dr.minimum(types.UInt32(at), _STARTS - 2)
        low, high = (dr.gather(types.Float, self._ratio, cell + k) for k in (0, 1))
        start = dr.fma(at - types.Float(cell), high - low, low)
        x, y = types.Float(u) * start, types.Float(v) * start
        # the Jacobian is symmetric, so three numbers invert it
        for last in [False] * _STEPS + [True]:
            kind = types.Float64 if last else types.Float
            projected_u, projected_v, xx, xy, yy = self._formula(kind(x), kind(y), exact=last)
            du, dv, per_det = u - types.Float64(projected_u), v - types.Float64(projected_v), dr.rcp(xx * yy - xy * xy)
            du, dv, per_det = (types.Float(values) for values in (du, dv, per_det))
            xx, xy, yy = (types.Float(values) for values in (xx, xy, yy))
            x, y = x + (yy * du - xy * dv) * per_det, y + (xx * dv - xy * du) * per_det
        return x, y

"""Distortion of a lens in OpenCV's models: image places of directions, and the inverse.

A direction is the pair of tangents (x, y) of its angles to the axis; an image place is in units of the image distance.
Both point to the right and downwards, as in OpenCV.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import Values
from hesim_render.core.errors import SpecError
from hesim_render.specs.lens import FisheyeDistortion, OpenCvDistortion

#: Largest angle to the axis: OpenCV's models divide by the depth, which is 0 at 90°.
MOST_DEG = 89.0
#: Angles to the axis, and directions around it, at which a model is examined.
_ANGLES, _AROUND = 4001, 72
#: The model is used up to this many times the farthest direction in the image, but only to this part of the way to
#: where it folds. Farther out, image places go on evenly.
_BEYOND, _TO_FOLD = 1.3, 0.98
#: Newton's method ends at this residual, in units of the image distance, or after so many steps.
_SETTLED, _MOST_STEPS = 1e-14, 30


def opencv(k: Sequence[Values], x: Values, y: Values) -> tuple[Values, ...]:
    """Place and its derivatives by `OpenCvDistortion`.

    Parameters
    ----------
    k : k1, k2, p1, p2, k3, k4, k5, k6; numbers, or values on the device.
    x, y : tangents, NumPy or Dr.Jit.

    Returns
    -------
    Place u, v; ∂u/∂x, ∂u/∂y (which is ∂v/∂x), ∂v/∂y.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = x * x + y * y
    over, under = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = over / under
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - gain * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / under
    xy = x * y
    return (
        x * gain + 2 * p1 * xy + p2 * (r2 + 2 * x * x),
        y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * xy,
        gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * xy * slope + 2 * p1 * x + 2 * p2 * y,
        gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


def fisheye(
    k: Sequence[Values],
    x: Values,
    y: Values,
    atan2: Callable[[Values, Values], Values],
    sqrt: Callable[[Values], Values],
    maximum: Callable[[Values, Values], Values],
) -> tuple[Values, ...]:
    """Place and its derivatives by `FisheyeDistortion`; see `opencv`. `k` is k1 to k4; the functions are those of the
    arrays' library.
    """
    k1, k2, k3, k4 = k
    r2 = maximum(x * x + y * y, 1e-12)
    r = sqrt(r2)
    angle = atan2(r, 1 + 0 * r)
    a2 = angle * angle
    gain = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
    by_angle = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    slope = (by_angle / (1 + r2) - gain) / (2 * r2)
    cross = 2 * x * y * slope
    return x * gain, y * gain, gain + 2 * x * x * slope, cross, gain + 2 * y * y * slope


@dataclass(frozen=True)
class Distortion:
    """A model of distortion, and the directions for which it is used.

    Parameters
    ----------
    model : ``opencv`` or ``fisheye``.
    coefficients : all of the model, in OpenCV's order.
    farthest : largest distance of a place in the image from the axis, in units of the image distance.

    Raises
    ------
    SpecError
        If the model folds in the circle around the axis through the farthest place of the image, or that shows a
        direction of more than `MOST_DEG` to the axis.
    """

    model: str
    coefficients: tuple[float, ...]
    farthest: float

    @classmethod
    def of(cls, spec: OpenCvDistortion | FisheyeDistortion, farthest: float) -> "Distortion":
        """The distortion that a sensor file states; `farthest` as in `Distortion`."""
        if isinstance(spec, FisheyeDistortion):
            return cls("fisheye", spec.coefficients, farthest)
        return cls("opencv", (*spec.coefficients, 0.0, 0.0, 0.0)[:8], farthest)

    def __post_init__(self) -> None:
        radius, _ = self._radii
        seen = self._at_radius(self._fold)
        if seen <= self.farthest:
            manner = (
                f"folds at {np.degrees(np.arctan(self._fold)):.3g}° off the axis, where"
                if self._fold < radius[-1]
                else f"would show directions of more than {MOST_DEG:g}° to the axis:"
            )
            raise SpecError(
                f"the model {manner} the image is {seen:.4g} image distances off the axis, and the picture's farthest "
                f"corner lies at {self.farthest:.4g}: use weaker coefficients, a longer focal length or a smaller "
                "picture",
                key="lens.distortion",
            )

    @cached_property
    def _radii(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Tangents [n] of angles to the axis up to `MOST_DEG`, and the image places [n, around, 5] with derivatives."""
        radius = np.tan(np.radians(np.linspace(0, MOST_DEG, _ANGLES)))
        around = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
        x, y = radius[:, None] * np.cos(around), radius[:, None] * np.sin(around)
        with np.errstate(all="ignore"):
            return radius, np.stack(self._formula(x, y), axis=-1)

    @cached_property
    def _fold(self) -> float:
        """Tangent at which the model folds first, in any direction around the axis; the largest one if it does not."""
        radius, result = self._radii
        _, _, xx, xy, yy = np.moveaxis(result, -1, 0)
        with np.errstate(all="ignore"):
            # beyond a pole of the rational model, the first is below 0 as well
            fair = (xx * yy - xy * xy > 0) & (xx + yy > 0)
        wrong = np.flatnonzero(~fair.all(axis=1))
        return float(radius[-1] if wrong.size == 0 else radius[max(wrong[0] - 1, 0)])

    def _at_radius(self, tangent: float) -> float:
        """Least distance from the axis, over all directions around it, of the places at a tangent."""
        radius, result = self._radii
        around = np.hypot(result[..., 0], result[..., 1]).min(axis=1)
        return float(np.interp(tangent, radius, around))

    @cached_property
    def limit(self) -> float:
        """Tangent up to which the model is used: beyond the image, but before it folds."""
        radius, result = self._radii
        least = np.hypot(result[..., 0], result[..., 1]).min(axis=1)
        good = radius <= self._fold
        seen = float(np.interp(self.farthest, least[good], radius[good]))
        return float(min(_BEYOND * seen, seen + _TO_FOLD * (self._fold - seen)))

    @cached_property
    def starts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean distance from the axis of places, increasing, and the tangents there: where the inverse starts."""
        radius, result = self._radii
        inside = radius < self.limit
        tangent = np.append(radius[inside], self.limit)
        mean = np.hypot(result[..., 0], result[..., 1]).mean(axis=1)
        return np.maximum.accumulate(np.interp(tangent, radius, mean)), tangent

    @cached_property
    def steepest(self) -> tuple[float, float, float]:
        """Largest factors, over all directions that are used, by which an image place moves: for a change of the
        tangent, for a shift of the camera over the depth of what it sees, and for a turn of the camera, rad.
        """
        radius, result = self._radii
        inside = radius <= self.limit
        _, _, xx, xy, yy = np.moveaxis(result[inside], -1, 0)
        norm = (np.abs(xx + yy) + np.sqrt((xx - yy) ** 2 + 4 * xy**2)).max(axis=1) / 2
        stretch = np.sqrt(1 + radius[inside] ** 2)
        return float(norm.max()), float((norm * stretch).max()), float((norm * stretch**2).max())

    @classmethod
    def height_at(cls, spec: OpenCvDistortion | FisheyeDistortion, tangent: float) -> float:
        """Image height of a direction to the right of the axis, in units of the image distance.

        Raises
        ------
        SpecError
            If the model folds before that direction.
        """
        model = cls.of(spec, 0.0)
        if tangent > model._fold:
            asked, fold = np.degrees(np.arctan([tangent, model._fold]))
            problem = f"horizontal_fov_deg asks for {asked:.3g}° off the axis, and the model folds at {fold:.3g}°"
            raise SpecError(problem, key="lens.distortion")
        return float(model._formula(np.array(tangent), np.zeros(()))[0])

    def _formula(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        if self.model == "fisheye":
            return fisheye(self.coefficients, x, y, np.arctan2, np.sqrt, np.maximum)
        return opencv(self.coefficients, x, y)

    def distorted(self, tangent: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image places [..., 2] of tangents [..., 2]. Beyond `limit`, places go on outwards as evenly as tangents do,
        so that no direction outside the image is imaged into it.
        """
        radius = np.hypot(tangent[..., 0], tangent[..., 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(radius > self.limit, self.limit / radius, 1.0)
        u, v, *_ = self._formula(tangent[..., 0] * scale, tangent[..., 1] * scale)
        return np.stack([u, v], axis=-1) / scale[..., None]

    def undistorted(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tangents [..., 2] of image places [..., 2]: the inverse of `distorted`, by Newton's method."""
        wanted = np.asarray(place, dtype=np.float64)
        distance = np.hypot(wanted[..., 0], wanted[..., 1])
        edge, tangent = self.starts
        outside = distance > edge[-1]
        with np.errstate(invalid="ignore", divide="ignore"):
            start = np.where(distance > 0, np.interp(distance, edge, tangent) / distance, 1.0)
            start = np.where(outside, tangent[-1] / edge[-1], start)
        x, y = wanted[..., 0] * start, wanted[..., 1] * start
        for _ in range(_MOST_STEPS):
            radius = np.hypot(x, y)
            over = np.maximum(radius / self.limit, 1.0)
            u, v, xx, xy, yy = self._formula(x / over, y / over)
            du, dv = wanted[..., 0] - u * over, wanted[..., 1] - v * over
            if not np.nanmax(np.hypot(du, dv) / np.maximum(distance, 1.0), initial=0.0) > _SETTLED:
                break
            # beyond the limit, where places are in proportion to tangents: turn and stretch
            turn = (wanted[..., 0] + 1j * wanted[..., 1]) / np.where(over > 1, (u + 1j * v) * over, 1.0)
            turned, det = (x + 1j * y) * turn, xx * yy - xy * xy
            x = np.where(over > 1, turned.real, x + (yy * du - xy * dv) / det)
            y = np.where(over > 1, turned.imag, y + (xx * dv - xy * du) / det)
        return np.stack([x, y], axis=-1)

"""Vectors, rigid poses and regions in files."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, NonNegativeInt, PositiveInt, model_validator

from hesim_render.core.guard import MOST_PIXELS
from hesim_render.specs.files import Strict

#: Largest coordinate, m, and largest and smallest size; squares of larger values exceed the range of float32.
LARGEST_M, SMALLEST_M = 1e9, 1e-9
Coordinate = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]
Size = Annotated[float, Field(ge=SMALLEST_M, le=LARGEST_M)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Row = tuple[Coordinate, Coordinate, Coordinate, Coordinate]


def below(least: str, most: str) -> Any:
    """A check of a model: the value of one key is below that of another."""

    def check(model: Strict) -> Strict:
        if getattr(model, least) >= getattr(model, most):
            raise ValueError(f"{least} must be below {most}")
        return model

    return model_validator(mode="after")(check)


class Region(Strict):
    """The part of a sensor that was read out, in frame pixels."""

    x: NonNegativeInt
    y: NonNegativeInt
    width_px: PositiveInt
    height_px: PositiveInt

    @model_validator(mode="after")
    def _check(self) -> "Region":
        if self.width_px * self.height_px > MOST_PIXELS:
            raise ValueError(f"width_px and height_px: more than {MOST_PIXELS} pixels, as no sensor has")
        return self


#: Largest deviation of RᵀR from 1 that counts as rounding of the file's numbers.
_RIGID_TOLERANCE = 1e-4


def _not_zero(vector: Vector) -> Vector:
    if sum(c * c for c in vector) < 1e-18:
        raise ValueError("a direction must not be the zero vector")
    return vector


Direction = Annotated[Vector, AfterValidator(_not_zero)]


def _rigid(matrix: tuple[Row, Row, Row, Row]) -> tuple[Row, Row, Row, Row]:
    """Refuse a matrix that is not a rotation and a translation, with the reason."""
    values = np.array(matrix, dtype=np.float64)
    if np.abs(values[3] - [0, 0, 0, 1]).max() > _RIGID_TOLERANCE:
        raise ValueError("the last row of a pose must be 0, 0, 0, 1")
    linear = values[:3, :3]
    products = linear.T @ linear
    sizes = np.sqrt(np.diag(products))
    if np.abs(products - np.eye(3)).max() > _RIGID_TOLERANCE:
        if np.abs(sizes - 1).max() > _RIGID_TOLERANCE / 2:
            raise ValueError(f"not rigid: it scales by {sizes[0]:.4g}, {sizes[1]:.4g}, {sizes[2]:.4g} along x, y, z")
        raise ValueError("not rigid: it shears; the columns must be perpendicular")
    if np.linalg.det(linear) < 0:
        raise ValueError("not rigid: it mirrors; the determinant must be +1")
    return matrix


#: A 4×4 pose by rows: rotation and translation only.
RigidMatrix = Annotated[tuple[Row, Row, Row, Row], AfterValidator(_rigid)]


def rotation_vectors(matrices: Sequence[tuple[Row, Row, Row, Row]]) -> NDArray[np.float64]:
    """Axis times angle (0 to π) of the rotations of rigid matrices, those nearest to their rounded numbers; [n, 3]."""
    from scipy.spatial.transform import Rotation

    if not matrices:
        return np.empty((0, 3))
    return Rotation.from_matrix(np.array(matrices)[:, :3, :3]).as_rotvec()


def rotation_about(axis: ArrayLike, angle_deg: float) -> NDArray[np.float64]:
    """Matrix [3, 3] of a right-handed rotation by `angle_deg` about `axis` (any length but zero)."""
    from scipy.spatial.transform import Rotation

    direction = np.asarray(axis, dtype=np.float64)
    return Rotation.from_rotvec(np.radians(angle_deg) * direction / np.linalg.norm(direction)).as_matrix()

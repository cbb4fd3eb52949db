"""Meshes of rectangles and boxes whose sides run from -1 to 1."""

import numpy as np
from numpy.typing import NDArray


def rectangle_mesh() -> tuple[NDArray, NDArray, NDArray]:
    """Corners [4, 3], faces [2, 3] and u, v [4, 2] of a rectangle that faces +z."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), (corners[:, :2] + 1) / 2


def box_mesh() -> tuple[NDArray, NDArray, NDArray]:
    """Six faces with outward normals, each with its own u, v from 0 to 1."""
    vertices: list[NDArray] = []
    faces: list[NDArray] = []
    uv: list[NDArray] = []
    flat, triangles, flat_uv = rectangle_mesh()
    for axis in range(3):
        for sign in (1.0, -1.0):
            # cyclic axes keep the face right-handed; mirroring u on the far side flips its normal
            face = np.empty((4, 3))
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3], face[:, axis] = flat[:, 0] * sign, flat[:, 1], sign
            faces.append(triangles + 4 * len(vertices))
            vertices.append(face)
            uv.append(flat_uv)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv)

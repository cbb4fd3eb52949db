"""Flat faces of meshes: parallelograms of two triangles each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.sources.render.scene.mitsuba_version import mesh_faces, mesh_vertices

#: Largest distance of the corners of two triangles from those of a parallelogram, over its size.
_FLAT = 1e-5
#: Largest difference of normals between the corners of a face, and of its other surface data, over its size.
SAME = 1e-5


@dataclass(frozen=True)
class Face:
    """A parallelogram made of two successive triangles of a mesh.

    Parameters
    ----------
    triangle : number of the first triangle, the half with u + v <= 1.
    order : numbers of the corners of both triangles at (0, 0), (1, 0), (0, 1), and at (1, 1), (1, 0), (0, 1).
    to_uvh : [3, 4], maps a point in metres to u and v (0 to 1 on the face) and to its height above the face, m.
    surface : Mitsuba's data of both triangles, [2, ...] each: `n` and `shading`, normals; `s`, first axis of the
        shading frame; `dp_du`, `dp_dv`; and `uv` [2, 3, 2], texture coordinates at (0, 0) and their change along u, v.
    """

    triangle: int
    order: tuple[tuple[int, int, int], tuple[int, int, int]]
    to_uvh: NDArray[np.float64]
    surface: dict[str, NDArray[np.float64]]


def faces_of(mi: MitsubaModule, shape: MitsubaObject) -> list[Face]:
    """The faces of a mesh, if it consists of flat faces only; otherwise an empty list.

    Faces must be flat for shading as well.
    """
    if not shape.is_mesh() or shape.face_count() % 2:
        return []
    vertices = mesh_vertices(shape)
    triangles = mesh_faces(shape).reshape(-1, 2, 3)
    known = _at_corners(mi, shape)
    faces = []
    for number, (first, second) in enumerate(triangles):
        order = _parallelogram(vertices[first], vertices[second])
        corners = {name: values[number] for name, values in known.items()}
        flat = all(np.allclose(corners[name], corners[name][0, 0], rtol=0, atol=SAME) for name in ("n", "shading"))
        if order is None or not flat:
            return []
        (own, on_u, on_v), (opposite, at_u, at_v) = order
        to_uvh = _map(vertices[first[list(order[0])]])
        one, other = corners.pop("uv")
        uv = [
            [one[own], one[on_u] - one[own], one[on_v] - one[own]],
            [other[at_u] + other[at_v] - other[opposite], other[opposite] - other[at_v], other[opposite] - other[at_u]],
        ]
        surface = {name: values[:, 0] for name, values in corners.items()}
        faces.append(Face(2 * number, order, to_uvh, {**surface, "uv": np.array(uv)}))
    return faces


def map_of(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """`Face.to_uvh` of two triangles, [3, 3] each, m; None if they do not form a parallelogram."""
    order = _parallelogram(one, other)
    return None if order is None else _map(one[list(order[0])])


def _map(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """`Face.to_uvh` from the corners at (0, 0), (1, 0) and (0, 1), [3, 3], m."""
    sides = corners[1:] - corners[0]
    normal = np.cross(*sides)
    inverse = np.linalg.inv(np.stack([*sides, normal / np.linalg.norm(normal)], axis=1))
    return np.concatenate([inverse, -(inverse @ corners[0])[:, None]], axis=1)


def _parallelogram(
    one: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[tuple[int, int, int], tuple[int, int, int]] | None:
    """Corner order of two triangles that form a parallelogram, as in `Face.order`; None if they do not.

    Parameters
    ----------
    one, other : corners, [3, 3], m.
    """
    size = float(np.ptp(one, axis=0).max())
    same = np.linalg.norm(one[:, None] - other, axis=2) <= _FLAT * size
    if sorted(same.sum(axis=0)) != [0, 1, 1] or sorted(same.sum(axis=1)) != [0, 1, 1]:
        return None
    own, opposite = int(np.argmin(same.sum(axis=1))), int(np.argmin(same.sum(axis=0)))
    on_u, on_v = (own + 1) % 3, (own + 2) % 3
    u, v = one[on_u] - one[own], one[on_v] - one[own]
    thin = np.linalg.norm(np.cross(u, v)) <= _FLAT * size**2
    if thin or np.linalg.norm(one[own] + u + v - other[opposite]) > _FLAT * size:
        return None
    return (own, on_u, on_v), (opposite, int(np.argmax(same[on_u])), int(np.argmax(same[on_v])))


def _at_corners(mi: MitsubaModule, shape: MitsubaObject) -> dict[str, NDArray[np.float64]]:
    """Mitsuba's surface data at the corners of a mesh's triangles, [faces, 2, 3 corners, ...] each."""
    count = shape.face_count()
    hit, number = dr.zeros(mi.PreliminaryIntersection3f, 3 * count), dr.arange(mi.UInt32, 3 * count)
    # a shape that is a constant of the kernel would need a kernel of its own
    hit.valid, hit.t, hit.shape = mi.Bool(True), mi.Float(1.0), dr.opaque(mi.ShapePtr, shape)
    hit.prim_index, corner = number // 3, number % 3
    hit.prim_uv = mi.Point2f(dr.select(corner == 1, 1.0, 0.0), dr.select(corner == 2, 1.0, 0.0))
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0, 1))
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, mi.Bool(True))
    data = {"n": si.n, "shading": si.sh_frame.n, "s": si.sh_frame.s, "dp_du": si.dp_du, "dp_dv": si.dp_dv, "uv": si.uv}
    dr.eval(data)  # all by one kernel
    return {
        name: np.stack([axis.numpy() for axis in value], axis=-1).astype(np.float64).reshape(count // 2, 2, 3, -1)
        for name, value in data.items()
    }

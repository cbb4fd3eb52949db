"""Frames of the rectangles that shine in a loaded scene of Mitsuba."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import MitsubaModule, MitsubaObject
from hesim_render.sources.render.scene.mitsuba_version import matrix_of, mesh_faces, mesh_vertices

#: Largest cosine between the sides of a rectangle, and difference of other directions and places, over their size.
_RIGHT_ANGLED = 1e-5
#: Places of a lamp whose normals are compared: two in each half of the unit square.
_PLACES = ((0.2, 0.1), (0.7, 0.3), (0.3, 0.8), (0.9, 0.6))


def lamp_frame(mi: MitsubaModule, shape: MitsubaObject) -> NDArray[np.float64] | None:
    """The frame [4, 4] of a rectangle, or of a mesh that is one, see `area_light_frame`; None of others.

    Parameters
    ----------
    mi : the mitsuba module.
    shape : of the loaded scene.
    """
    parameters = mi.traverse(shape)
    frame = matrix_of(parameters["to_world"]) if "to_world" in parameters else _frame_of_mesh(shape)
    if frame is None:
        return None
    width, height = frame[:3, 0].copy(), frame[:3, 1]
    area = np.linalg.norm(width) * np.linalg.norm(height)
    if area == 0 or abs(width @ height) > _RIGHT_ANGLED * area:
        return None
    normals = np.array([np.array(shape.sample_position(0.0, mi.Point2f(*at)).n).ravel() for at in _PLACES], np.float64)
    across = np.cross(width, height) / area
    # a mesh may have normals of its vertices, by which it would shine
    if np.abs(normals @ across).min() < 1 - _RIGHT_ANGLED:
        return None
    # corners run anticlockwise for who sees it shine
    frame[:3, 0] = width if across @ normals[0] > 0 else -width
    frame[:3, 2] = normals[0]
    return frame


def _frame_of_mesh(mesh: MitsubaObject) -> NDArray[np.float64] | None:
    """Half the sides and the middle of two triangles that make a parallelogram; None of others."""
    corners, number = np.unique(mesh_vertices(mesh), axis=0, return_inverse=True)
    faces = number.ravel()[mesh_faces(mesh)]
    if len(faces) != 2:
        return None
    # the side that both share is a diagonal; the other corners lie across it
    shared = np.intersect1d(*faces)
    across = [np.setdiff1d(face, shared) for face in faces]
    if shared.size != 2 or any(each.size != 1 for each in across):
        return None
    (first, last), ends = corners[np.concatenate(across)], corners[shared]
    if np.linalg.norm(first + last - ends.sum(axis=0)) > _RIGHT_ANGLED * np.linalg.norm(last - first):
        return None
    frame = np.eye(4)
    frame[:3, :2], frame[:3, 3] = (ends - first).T / 2, (first + last) / 2
    return frame

"""Normals of the vertices of meshes whose files have none.

Mitsuba sums them on all threads, in an order that differs from build to build, and so do their last bits. They are
computed here in a fixed order instead, by the same weights.
"""

import mmap
import re
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: Plugins of meshes that Mitsuba reads from files.
MESH_FILES = ("obj", "ply", "serialized")
_OBJ_NORMAL = re.compile(rb"(?m)^[ \t]*vn[ \t]")
_PLY_NORMAL = re.compile(rb"(?m)^property\s+\w+\s+nx\s*$")
#: Of a header of a PLY file, at most; bytes.
_PLY_HEADER = 1 << 16
#: Flag of a mesh with normals in Mitsuba's serialized format, and compressed bytes that contain the flags, at most.
_SERIALIZED_NORMALS, _SERIALIZED_HEAD = 0x0001, 1 << 12


def ordered_normals(vertices_m: NDArray[np.floating], faces: NDArray[np.integer]) -> NDArray[np.float32]:
    """Unit normals of vertices: normals of their faces, weighted with the angles of the faces at them, [vertex, 3].

    A pure function of the mesh: terms are added in the order of the faces, in float64. The weights are those of
    [thurmer1998], as in Mitsuba. A vertex whose normals cancel has the normal of its last face, and one without a face
    of any area has (1, 0, 0), as in Mitsuba's scalar variants.

    Parameters
    ----------
    vertices_m : [vertex, 3], m.
    faces : [face, 3], numbers of vertices.
    """
    corners = np.asarray(vertices_m, dtype=np.float64)[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(across, axis=1)
    # faces without area have no normal, and count for nothing
    has_area = twice_area > 0
    corners, faces, normal = corners[has_area], faces[has_area], across[has_area] / twice_area[has_area, None]
    normals = np.tile(np.array([1.0, 0.0, 0.0]), (len(vertices_m), 1))
    normals[faces.ravel()] = np.repeat(normal, 3, axis=0)
    total = np.zeros_like(normals)
    for k in range(3):
        one, other = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        # the angle from sine and cosine: an arc cosine alone loses digits in thin triangles
        angle = np.arctan2(twice_area[has_area], np.einsum("fi,fi->f", one, other))
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, k], normal[:, axis] * angle, minlength=len(total))
    length = np.linalg.norm(total, axis=1)
    # less is rounding of terms that cancel
    sums = length > 1e-9
    normals[sums] = total[sums] / length[sums, None]
    return normals.astype(np.float32)


def brings_normals(path: Path, shape_index: int = 0) -> bool:
    """True if a mesh file has normals of its own; it must be one that Mitsuba has read.

    Parameters
    ----------
    path : an OBJ, PLY or serialized file.
    shape_index : number of the mesh in a serialized file.
    """
    kind = path.suffix.lower()
    with path.open("rb") as stream:
        if kind == ".ply":
            return _PLY_NORMAL.search(stream.read(_PLY_HEADER).split(b"end_header")[0]) is not None
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if kind == ".obj":
                return _OBJ_NORMAL.search(content) is not None
            return bool(_serialized_flags(content, shape_index) & _SERIALIZED_NORMALS)


def _serialized_flags(content: mmap.mmap, shape_index: int) -> int:
    """Flags of a mesh in Mitsuba's serialized format, which ends in a table of places and the number of meshes."""
    version = struct.unpack_from("<H", content, 2)[0]
    (count,) = struct.unpack_from("<I", content, len(content) - 4)
    # places have 8 bytes since version 4
    form, size = ("<Q", 8) if version >= 4 else ("<I", 4)
    (place,) = struct.unpack_from(form, content, len(content) - 4 - size * (count - shape_index))
    head = content[place + 4 : place + 4 + _SERIALIZED_HEAD]
    return int(struct.unpack("<I", zlib.decompressobj().decompress(head, 4))[0])

"""What Mitsuba 3.10 renames, by its release notes: these tests fail with 3.10 installed, and say what takes the places.

Besides new names: data of meshes become tensors of (vertices, 3) and (faces, 3), so that `len` counts rows, faces of
flipped meshes change their winding, and ``mi.Mesh`` takes arrays in place of counts.
"""

import re
from pathlib import Path

import numpy as np
import pytest

from hesim_render.sources.render.scene import mitsuba_version

PACKAGE = Path(__file__).parents[3] / "hesim_render"
HERE = "sources/render/scene/mitsuba_version.py"
#: Parameters of `mi.traverse`, and methods of meshes.
PARAMETERS = {"vertex_positions": "positions", "vertex_normals": "normals", "vertex_texcoords": "texcoords"}
METHODS = {
    "vertex_positions_buffer": "positions", "faces_buffer": "faces", "vertex_normals_buffer": "normals",
    "vertex_texcoords_buffer": "texcoords", "has_vertex_normals": "has_normals",
    "has_vertex_texcoords": "has_texcoords",
    "attribute_buffer": "attribute", "recompute_vertex_normals": "recompute_normals", "build_directed_edges": "dedge",
    "opposite_dedge": "dedge_opposite", "edge_indices": "dedge_indices", "has_flipped_normals": "(removed)",
}  # fmt: skip


@pytest.fixture(scope="module")
def mesh():
    module = mitsuba_version.mitsuba()
    corners = np.array([[0.5, 0.25, 2.0], [3.0, 0.125, 2.5], [0.75, 4.0, 3.5], [3.25, 5.0, 1.5]])
    faces = np.array([[0, 1, 2], [1, 3, 2]], dtype=np.uint32)
    surface = {"type": "diffuse"}
    uv = np.array([[0.1, 0.2], [0.9, 0.3], [0.2, 0.8], [0.7, 0.6]])
    return module, mitsuba_version.make_mesh(module, "sheet", corners, faces, surface, uv), corners, faces


def test_only_the_module_of_the_version_has_names_that_change():
    names = re.compile(r"\b(?:%s)\b(?! import)" % "|".join({*PARAMETERS, *METHODS}))
    found = {
        path.relative_to(PACKAGE).as_posix(): used
        for path in PACKAGE.rglob("*.py")
        if (used := set(names.findall(path.read_text(encoding="utf-8"))))
    }
    assert found == {HERE: {"vertex_positions", "vertex_normals", "vertex_texcoords", "vertex_positions_buffer",
                            "faces_buffer", "has_vertex_texcoords"}}  # fmt: skip


def test_mitsuba_has_the_names_of_before(mesh):
    module, sheet, _, _ = mesh
    keys = set(module.traverse(sheet).keys())
    both = module.traverse(module.Mesh("sheet", 3, 1, has_vertex_normals=True))
    gone = {old: new for old, new in PARAMETERS.items() if old not in keys | set(both.keys())}
    gone |= {f"{old}()": f"{new}()" for old, new in METHODS.items() if not hasattr(sheet, old)}
    assert not gone, f"this Mitsuba has other names, to be taken in {HERE}: {gone}"
    assert module.traverse(sheet)["faces"].shape == (6,), f"faces are rows now; see {HERE}"
    animated = [name for name in dir(module) if "Animated" in name]
    assert not animated, (
        f"Mitsuba has {animated}: objects that move can use it in place of a pose for each time ({HERE})"
    )


def test_vertices_and_faces_are_rows(mesh):
    _, sheet, corners, faces = mesh
    np.testing.assert_array_equal(mitsuba_version.mesh_vertices(sheet), corners)
    np.testing.assert_array_equal(mitsuba_version.mesh_faces(sheet), faces)
    assert mitsuba_version.mesh_vertices(sheet).dtype == np.float64
    assert mitsuba_version.can_move({"a.vertex_positions": 0, "b.to_world": 0}, "a")
    assert mitsuba_version.can_move({"a.vertex_positions": 0, "b.to_world": 0}, "b")
    assert not mitsuba_version.can_move({"a.vertex_positions": 0, "b.to_world": 0}, "c")

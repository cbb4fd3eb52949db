"""Counts in headers against what a file of a size can hold: the last count that passes, and the first that does not."""

import math
import struct
import zlib

import pytest

from hesim_render.core.errors import SpecError
from hesim_render.sources.render.scene import sizes


def passes(folder, data):
    (folder / "x").write_bytes(data)
    try:
        sizes.require_fits(folder / "x")
    except SpecError as error:
        assert "cannot hold" in str(error)
        return False
    return True


@pytest.mark.parametrize("shape", [(3, 4, 5, 2), (7, 1, 9, 3), (2, 11, 2, 5)])
def test_a_volume_has_a_byte_or_more_for_a_value(tmp_path, shape):
    head, count = b"VOL\x03" + struct.pack("<5i", 1, *shape), math.prod(shape)
    data = head + bytes(count - len(head))
    assert passes(tmp_path, data) and not passes(tmp_path, data[:-1])


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("vertices", [0, 700, 2500])
def test_a_packed_mesh_has_a_thousandth_of_its_bytes_at_least(tmp_path, monkeypatch, version, vertices):
    """Twelve bytes for the place of a vertex, and as many for a triangle; memory is asked for with normals."""
    asked = []
    monkeypatch.setattr(sizes, "require_memory", lambda count, what, file: asked.append(count))

    def mesh(triangles):
        name = b"a mesh\0" if version == 4 else b""
        packed = zlib.compress(struct.pack("<I", 0x1000) + name + struct.pack("<QQ", vertices, triangles))
        return (struct.pack("<HH", 0x041C, version) + packed).ljust(60, b"\0")

    most = 1032 * 60 // 12 - vertices
    assert passes(tmp_path, mesh(most)) and not passes(tmp_path, mesh(most + 1))
    assert asked == [32 * vertices + 12 * most, 32 * vertices + 12 * (most + 1)]


@pytest.mark.parametrize(("form", "properties", "least"), [
    ("binary_little_endian", "float x;double y;uchar red;short n", 4 + 8 + 1 + 2),
    ("binary_big_endian", "list uchar int vertex_indices;int kind", 1 + 4),
    ("ascii", "float x;double y;uchar red", 2 * 3),
])  # fmt: skip
def test_an_element_has_the_bytes_of_its_properties(tmp_path, form, properties, least):
    """Or a digit and a blank for each, where they are text; a comment in between is none."""
    lines = "".join(f"property {each}\n" for each in properties.split(";")).replace("\n", "\ncomment c\n", 1)

    def file(count, size):
        head = f"ply\nformat {form} 1.0\nelement vertex 1\nproperty uchar a\nelement other {count}\n{lines}end_header\n"
        return head.encode().ljust(size, b"1")

    for count in (61, 94):
        assert passes(tmp_path, file(count, count * least)) and not passes(tmp_path, file(count, count * least - 1))

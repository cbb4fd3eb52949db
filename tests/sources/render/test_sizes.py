"""Files that state more than memory, or than they hold, are refused by their headers, before Mitsuba reads them."""

import struct
import zlib

import numpy as np
import pytest
from damage import LIT, refused, scene_file
from PIL import Image

import hesim_render as hr
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.mitsuba_version import files_readable, mitsuba
from hesim_render.sources.render.scene.sizes import require_fits


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height):
    """A PNG with all its rows, packed: a thousandth of the picture."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + 3 * width)) for _ in range(min(height, 4))) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def exr(folder, width, height):
    mi = mitsuba()
    with files_readable():
        mi.Bitmap(np.ones((2, 2, 3), np.float32)).write(str(folder / "small.exr"))
    data = (folder / "small.exr").read_bytes()
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        place = data.index(name) + len(name) + 4
        data = data[:place] + struct.pack("<4i", 0, 0, width - 1, height - 1) + data[place + 16 :]
    return data


PLY = b"ply\nformat %s 1.0\ncomment x\nelement vertex %d\nproperty float x\nproperty float y\nproperty double z\n"
FACES = b"element face %d\nproperty list uchar int vertex_indices\nend_header\n"
SERIALIZED = struct.pack("<HH", 0x041C, 4) + zlib.compress(
    struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", 2**33, 5)
)


def large(kind, folder):
    return {
        "png": lambda: png(40_000, 30_000),
        "exr": lambda: exr(folder, 40_000, 30_000),
        "hdr": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 40000\n",
        "hdr by columns": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n+X 40000 -Y 30000\n",
        "pfm": lambda: b"PF\n40000 30000\n-1.0\n",
        "ppm": lambda: b"P6\n40000 30000\n255\n",
        "bmp": lambda: b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 40_000, 30_000, 1, 24, *[0] * 6),
        "ply": lambda: PLY % (b"binary_little_endian", 2**31) + FACES % 1 + bytes(64),
        "ply of text": lambda: PLY % (b"ascii", 100) + FACES % 1 + b"0 0 0\n" * 20,
        "faces": lambda: PLY % (b"binary_big_endian", 2) + FACES % 2**31 + bytes(64),
        "vol": lambda: b"VOL\x03" + struct.pack("<5i", 1, 4000, 4000, 4000, 3) + bytes(64),
        "serialized": lambda: SERIALIZED,
    }[kind]()  # fmt: skip


KINDS = ["png", "exr", "hdr", "hdr by columns", "pfm", "ppm", "bmp", "ply", "ply of text", "faces", "vol", "serialized"]


@pytest.mark.parametrize("kind", KINDS)
def test_headers_that_promise_too_much_are_refused(tmp_path, kind):
    (tmp_path / "x").write_bytes(large(kind, tmp_path))
    is_told = kind in ("exr", "hdr", "hdr by columns", "pfm")
    words = "has 40000x30000 px; a picture has at most" if is_told else "exceeds limit of|cannot hold|of memory, more"
    refused(lambda: require_fits(tmp_path / "x"), words)


@pytest.mark.parametrize("kind", ["png", "jpg", "bmp", "ppm", "exr", "ply", "text"])
def test_files_of_usual_sizes_pass(tmp_path, kind):
    file = tmp_path / f"x.{kind}"
    if kind == "exr":
        file.write_bytes(exr(tmp_path, 2, 2))
    elif kind == "ply":
        file.write_bytes(PLY % (b"binary_little_endian", 3) + FACES % 1 + bytes(3 * 16 + 13))
    elif kind == "text":
        file.write_text("v 0 0 0\n")
    else:
        Image.fromarray(np.zeros((30, 20, 3), np.uint8)).save(file)
    require_fits(file)


@pytest.mark.parametrize("body", [
    "mitsuba: {inline: {a: {type: constant}, b: {type: sphere, c: {type: diffuse, reflectance: "
    "{type: bitmap, filename: x.png}}}}}",
    "mitsuba: {inline: {a: {type: envmap, filename: x.png}, b: {type: sphere}}}",
    "mitsuba: {file: main.xml}",
    "objects: [{name: a, shape: sphere, material: {type: diffuse, reflectance: {type: bitmap, filename: x.png}}}]\n"
    f"{LIT}",
    f"objects: [{{name: a, shape: sphere, texture: {{file: x.png}}}}]\n{LIT}",
    f"target: {{type: image, file: x.png, width_m: 1, height_m: 1}}\n{LIT}",
    "objects: [{name: a, shape: sphere}]\nlight: {type: environment, file: x.png, illuminance_lux: 9}",
    f"objects: [{{name: a, shape: mesh, mesh: x.ply}}]\n{LIT}",
    "mitsuba: {inline: {a: {type: constant}, b: {type: ply, filename: x.ply}}}",
])  # fmt: skip
def test_scenes_ask_before_they_read(tmp_path, body):
    """A PNG of 40,000 x 40,000 px took 7.7 GB and ended the process."""
    (tmp_path / "x.png").write_bytes(png(40_000, 40_000))
    (tmp_path / "x.ply").write_bytes(large("ply", tmp_path))
    (tmp_path / "main.xml").write_text(
        '<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"><bsdf type="diffuse">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="x.png"/></texture></bsdf></shape>'
        "</scene>"
    )
    file = scene_file(tmp_path, body)
    refused(lambda: build(mitsuba(), hr.load_scene(file).spec), "exceeds limit of|cannot hold|of memory")

"""Memory that readers ask for before they read: what the values take, from sides that are not equal."""

import zlib
from types import SimpleNamespace

import h5py
import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image

from hesim_render.core import exr, guard, hdf5, npz
from hesim_render.core.errors import HesimError, RangeError, SpecError
from hesim_render.recording import grey_picture, label_file
from hesim_render.report import bench, modulated
from hesim_render.sources.render.scene import deformation, mesh_file, sizes
from hesim_render.sources.video import folder
from hesim_render.targets import cube_file, opened_cube
from hesim_render.targets.cube_file import open_cube


class Asked(HesimError):
    """Raised in place of a reader that goes on."""


@pytest.fixture
def asks(monkeypatch):
    """A function that calls something of a module, and gives the bytes that it asks for."""

    def run(module, call):
        def require(size, *words):
            raise Asked(str(size))

        monkeypatch.setattr(module, "require_memory", require)
        with pytest.raises(Asked) as caught:
            call()
        return int(str(caught.value))

    return run


def test_cubes_are_of_4_bytes_a_value(asks, tmp_path):
    (tmp_path / "cave").mkdir()
    for number in (1, 2, 3):
        Image.fromarray(np.zeros((7, 5), np.uint16)).save(tmp_path / "cave" / f"a_ms_{number:02}.png")
    assert asks(cube_file, lambda: open_cube(tmp_path / "cave")) == 4 * 7 * 5 * 3
    np.save(tmp_path / "a.npy", np.full((7, 5, 31), 0.5, np.float32))
    cube = open_cube(tmp_path / "a.npy", wavelength_nm=np.arange(400.0, 701.0, 10.0).tolist())
    assert asks(opened_cube, cube.whole) == 4 * 7 * 5 * 31


def test_pictures_and_textures(asks, tmp_path):
    assert asks(grey_picture, lambda: grey_picture._require("a.png", "L", (7, 5), (7, 5), True)) == 8 * 35
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((7, 5, 3), np.uint16))
    assert asks(folder, lambda: folder._read_tiff(tmp_path / "a.tif")) == 3 * 7 * 5 * 3 * 2
    part = SimpleNamespace(baseColorTexture=SimpleNamespace(width=7, height=5))
    material = SimpleNamespace(has_texture=True, base_color=(1.0, 0.5, 0.2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mesh_file, "_material_of", lambda part: material)
        patch.setattr(mesh_file, "_pbr", lambda part: part)
        assert asks(mesh_file, lambda: mesh_file._principled(None, part, tmp_path / "a.glb")) == 48 * 35


def test_exr_files_are_of_8_bytes_a_value_of_each_channel(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(exr, "require_picture", lambda *sizes: asked.append(sizes))
    planes = {name: np.zeros((7, 5), np.float32) for name in "RGBAZ"}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    exr.require_exr_fits(tmp_path / "a.exr")
    assert asked == [(5, 7, 8 * 5, tmp_path / "a.exr")]


def test_meshes_and_their_shapes(asks, tmp_path):
    """Three numbers of 4 bytes a vertex of each shape; normals and texture coordinates as well in a file of Mitsuba."""
    spec = SimpleNamespace(files=["a", "b", "c"], path=tmp_path)
    assert asks(deformation, lambda: deformation._from_folder(None, spec, 11, np.empty((0, 3)), "k")) == 3 * 11 * 12
    packed = np.array([7, 5], "<u8").tobytes()
    head = b"\x1c\x04\x03\x00" + zlib.compress(b"\0\0\0\0" + packed)
    assert asks(sizes, lambda: sizes._serialized(tmp_path / "a", head)) == 7 * 32 + 5 * 12


def test_columns_and_responses(asks, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["label"] = np.zeros(90, np.uint16)
        ask = asks(label_file, lambda: label_file._column(file, "label", tmp_path, "u2", slice(20, 53)))
    assert ask == 33 * 2
    reader = SimpleNamespace(
        stream=lambda file: None, pixels=35, path=lambda name: name,
        _jumps=lambda *given: (np.array([0, 900, 2000]), np.array([True, False])),
    )  # fmt: skip
    steps = SimpleNamespace(file="a.raw", window_us=None)
    assert asks(bench, lambda: bench.EventBench.answers_to(reader, steps)) == 12 * 2 * 35
    own = SimpleNamespace(stream=lambda file: None, pixels=35, path=lambda name: name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modulated, "_cycles", lambda *given: (0.0, 10.0, 13))
        assert asks(modulated, lambda: modulated._answered(own, SimpleNamespace(file="a.raw"), None)) == 13 * 35


def test_archives_and_data_sets(monkeypatch, tmp_path):
    """All arrays of an archive together; a whole data set or one entry of it, and a chunk of it."""
    asked = []
    for module in (npz, hdf5):
        monkeypatch.setattr(module, "require_memory", lambda size, what, file, *most: asked.append((size, *most)))
    np.savez(tmp_path / "a.npz", one=np.zeros((7, 5), np.uint16), two=np.zeros((3, 11), np.float64))
    npz.read_arrays(tmp_path / "a.npz", ("one", "two"))
    assert asked == [(70,), (70, guard.MOST_BYTES), (70 + 264,), (264, guard.MOST_BYTES)]
    asked.clear()
    assert len(list(npz.stream_member(tmp_path / "a.npz", "two", 3, (11,)))) == 3
    assert asked == [(88, guard.MOST_BYTES)]
    asked.clear()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", data=np.zeros((7, 5, 3), np.uint16), chunks=(2, 5, 3))
    hdf5.read_dataset(tmp_path / "a.h5", "as x", "x")
    hdf5.read_dataset(tmp_path / "a.h5", "as x", "x", 6)
    assert [size for size, *_ in asked] == [2 * 15 * 2, 7 * 15 * 2, 2 * 15 * 2, 15 * 2]
    with pytest.raises(RangeError, match="0 to 6"):
        hdf5.read_dataset(tmp_path / "a.h5", "as x", "x", 7)


def test_the_limit_is_half_of_the_machine_or_the_one_given(monkeypatch):
    monkeypatch.setattr(guard, "_machine_bytes", lambda: 2000)
    guard.require_memory(1000, "a", "b")
    guard.require_memory(70, "a", "b", 70)
    for size, most in ((1001, None), (71, 70)):
        with pytest.raises(SpecError, match="of memory, more than"):
            guard.require_memory(size, "a", "b", most)
    guard.require_picture(5, 20, 10, "b")
    with pytest.raises(SpecError, match="of memory, more than"):
        guard.require_picture(5, 20, 11, "b")
    monkeypatch.setattr(guard, "MOST_PIXELS", 100)
    guard.require_picture(5, 20, 1, "b")
    with pytest.raises(SpecError, match="has 5x21 px; a picture has at most 100 px"):
        guard.require_picture(5, 21, 1, "b")

"""Meshes of GLB, glTF and STL files: size, place and materials, and one line for what cannot be seen."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from rendering import FURNACE, make_scene
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.cube import render_cube
from hesim_render.sources.render.look import look
from hesim_render.sources.render.scene.mesh_file import file_materials

CAMERA = {"origin_m": [0, 0, 5], "horizontal_fov_deg": 30}


def two_parts():
    """A diffuse box of linear red 0.5 on the left, a textured plate on the right, upper half light."""
    red = PBRMaterial(baseColorFactor=[128, 0, 0, 255], metallicFactor=0.0, roughnessFactor=1.0)
    box = trimesh.creation.box((1, 1, 0.2))
    box.visual = TextureVisuals(material=red)
    codes = np.zeros((8, 8, 3), np.uint8)
    codes[:4] = 188  # sRGB of linear 0.5; row 0 is the top
    plain = PBRMaterial(baseColorTexture=Image.fromarray(codes), metallicFactor=0.0, roughnessFactor=1.0)
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    plate = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    plate.visual = TextureVisuals(uv=corners[:, :2] + 0.5, material=plain)
    scene = trimesh.Scene()
    scene.add_geometry(box, geom_name="box", transform=trimesh.transformations.translation_matrix([-1, 0, 0]))
    scene.add_geometry(plate, geom_name="plate", transform=trimesh.transformations.translation_matrix([1, 0, 0]))
    return scene


def seen(mesh, **keys):
    item = {"name": "thing", "shape": "mesh", "mesh": str(mesh), "size_m": [2.0, 1.0, 0.1], **keys}
    scene = make_scene(objects=[item], light=FURNACE, camera=CAMERA)
    return render_cube(scene, (40, 60), [450.0, 630.0], 64)[1]


def test_parts_lie_in_the_box_of_the_object_with_its_own_reflectance(tmp_path):
    (tmp_path / "two.glb").write_bytes(two_parts().export(file_type="glb"))
    radiance = seen(tmp_path / "two.glb", reflectance=0.3)[..., 0]
    # 2 m at 5 m: 30° across is 2.679 m, so 0.0447 m a pixel; box and plate are a third of the 3 units each
    cols = (np.arange(60) - 29.5) * 0.04465
    diffuse = np.isclose(radiance[20], 0.3, rtol=1e-3)
    on = (np.abs(cols) < 0.97) & (np.abs(cols) > 0.37)
    off = (np.abs(cols) > 1.05) | (np.abs(cols) < 0.3)
    assert diffuse[on].all() and not diffuse[off].any()
    np.testing.assert_allclose(radiance[20][off], 1.0, rtol=1e-5)  # the sky


@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_materials_of_the_file_are_mapped(kind, tmp_path):
    exported = two_parts().export(file_type=kind)
    if kind == "glb":
        (tmp_path / "two.glb").write_bytes(exported)
    else:
        for name, data in exported.items():
            (tmp_path / ("two.gltf" if name.endswith(".gltf") else name)).write_bytes(data)
    radiance = seen(tmp_path / f"two.{kind}", materials="file")
    red = radiance[20, 14]
    assert 0.5 < red[1] < 0.9 and red[0] < 0.12  # saturated red: the smooth spectrum rises beyond 0.5 at 630 nm
    light, dark = radiance[14, 45], radiance[26, 45]
    # grey of 0.5, with some sheen of the rough surface beside it
    assert 0.35 < light[0] < 0.6 and dark[0] < 0.12 and abs(light[0] / light[1] - 1) < 0.05


def test_materials_are_listed_as_they_are_rendered(tmp_path, capsys):
    """Three parts of three materials; factors come back in steps of 1/255, as trimesh has them."""
    scene = two_parts()
    normals = Image.fromarray(np.full((4, 4, 3), 128, np.uint8))
    steel = PBRMaterial(name="steel", baseColorFactor=[51, 102, 153, 255], metallicFactor=1.0, roughnessFactor=0.25,
                        normalTexture=normals, emissiveFactor=[0.5, 0.0, 0.0], alphaMode="BLEND")  # fmt: skip
    ball = trimesh.creation.box((0.2, 0.2, 0.2))
    ball.visual = TextureVisuals(uv=np.zeros((len(ball.vertices), 2)), material=steel)
    scene.add_geometry(ball, geom_name="ball")
    (tmp_path / "three.glb").write_bytes(scene.export(file_type="glb"))
    spec = hr.load_scene(scene_file(tmp_path, "three.glb", ", materials: file")).spec
    own = {material.part: material for material in file_materials(spec)["thing"]}
    box, plate, metal = (own[name] for name in ("box", "plate", "ball"))
    np.testing.assert_allclose(box.base_color, [128 / 255, 0, 0], atol=0.5 / 255)
    assert (box.metallic, box.roughness, box.has_texture, box.unused) == (0.0, 1.0, False, ())
    assert plate.has_texture and plate.base_color == (1.0, 1.0, 1.0)
    np.testing.assert_allclose(metal.base_color, [0.2, 0.4, 0.6], atol=0.5 / 255)
    assert (metal.metallic, metal.roughness) == (1.0, 0.25)
    assert set(metal.unused) == {"normal texture", "emission", "transparency"}
    found = look(hr.load_scene(tmp_path / "scene.yaml"), hr.load_sensor("reference-mono").crop(64, 48))
    listed = "\n".join(map(str, found.materials["thing"]))
    assert "ball: steel, base colour (0.2, 0.4, 0.6), metallic 1, roughness 0.25; not used: normal texture, " in listed


def test_an_stl_file_is_a_mesh_with_one_reflectance(tmp_path):
    trimesh.creation.box((3, 2, 1)).export(tmp_path / "box.stl")
    radiance = seen(tmp_path / "box.stl", reflectance=0.4)[..., 0]
    np.testing.assert_allclose(radiance[20, 30], 0.4, rtol=1e-3)


def scene_file(tmp_path, mesh, keys=""):
    (tmp_path / "scene.yaml").write_text(
        "schema_version: 1\nname: mesh\ndescription: one mesh\nobjects:\n"
        f"  - {{name: thing, shape: mesh, mesh: {mesh}{keys}}}\n"
        "light: {type: uniform, illuminance_lux: 100}\ncamera: {origin_m: [0, 0, 1]}\n"
    )
    return tmp_path / "scene.yaml"


def test_meshes_without_a_surface_are_one_line(tmp_path):
    (tmp_path / "damaged.glb").write_bytes(b"glTF damaged")
    trimesh.Trimesh([[0, 0, 0], [0, 0, 1], [0, 0, 2]], [[0, 1, 2]], process=False).export(tmp_path / "line.stl")
    (tmp_path / "point.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n"
    )
    (tmp_path / "quad.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"
    )
    (tmp_path / "far.gltf").write_text(
        json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "../far.bin", "byteLength": 4}]})
    )
    wrong = {
        "none.glb": "no such mesh file: ",
        "damaged.glb": "damaged.glb: cannot be read as a mesh",
        "line.stl": "line.stl: objects.thing.mesh: the mesh has no extent, so there is nothing to see",
        "point.ply": "point.ply: objects.thing.mesh: the mesh has no extent, so there is nothing to see",
        "quad.ply": "quad.ply: objects.thing.mesh: has no triangles alone: export triangles (Triangulated Mesh in",
        "far.gltf": "'../far.bin' lies outside of the scene's folder",
        "scene.yaml": "a mesh must be one of OBJ, PLY, STL, GLB, GLTF, not scene.yaml",
    }
    sensor = hr.load_sensor("reference-mono").crop(8, 8)
    for mesh, told in wrong.items():
        with pytest.raises(SpecError) as caught:
            hr.simulate(hr.load_scene(scene_file(tmp_path, mesh)), sensor, duration_s=0.002)
        assert told in str(caught.value) and len(str(caught.value).splitlines()) == 1, str(caught.value)
    with pytest.raises(SpecError, match="only GLB and glTF files have materials that are read"):
        hr.load_scene(scene_file(tmp_path, "line.stl", ", materials: file"))


@pytest.mark.slow
def test_a_moving_mesh_of_several_parts_is_rendered_in_the_default_mode(tmp_path):
    (tmp_path / "two.glb").write_bytes(two_parts().export(file_type="glb"))
    text = scene_file(tmp_path, "two.glb", ", materials: file, size_m: [0.2, 0.1, 0.01]").read_text()
    track = "motion:\n  - {object: thing, keyframes: [{t_us: 0}, {t_us: 10000, translation_m: [0.05, 0, 0]}]}\n"
    (tmp_path / "scene.yaml").write_text(text + track)
    recording = hr.simulate(
        hr.load_scene(tmp_path / "scene.yaml"),
        hr.load_sensor("reference-mono").crop(32, 24),
        duration_s=0.005,
        quality=3,
    )
    assert recording.manifest["settings"]["mode"] == "change-driven" and len(recording.events) > 0

"""Shipped scenes, scenes of Mitsuba's own, objects and their errors."""

import json

import numpy as np
import pytest
from rendering import FURNACE, flux_image, make_scene, mono

import hesim_render as hr
from hesim_render.core.errors import SpecError
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.scene import Scene
from hesim_render.specs.files import content_hash, list_names

XML = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="48"/></film>
  </sensor>
  <emitter type="constant">
    <spectrum name="radiance" type="regular">
      <float name="wavelength_min" value="300"/><float name="wavelength_max" value="900"/>
      <string name="values" value="2, 2"/>
    </spectrum>
  </emitter>
  <shape type="sphere" id="ball">
    <bsdf type="diffuse"><spectrum name="reflectance" type="uniform"><float name="value" value="0.5"/></spectrum></bsdf>
  </shape>
</scene>
"""
RISE = [{"t_us": 0}, {"t_us": 1000, "translation_m": (0, 1.0, 0)}]


def bayer(cols=32, rows=24):
    return hr.load_sensor("reference-bayer").crop(cols, rows)


#: Targets that are built as others are: polygons of a few reflectances.
ALIKE = (
    "checkerboard",
    "circle-grid",
    "dot-grid",
    "edge-field",
    "grey-ramp",
    "resolution-wedges",
    "siemens-star",
    "step-wedge",
)
#: Motions of textured solids, as in `glass-and-metal` and `traffic-light`.
MOVING_ALIKE = ("facade-drive", "falling-objects", "fan", "hand-held", "pendulum", "robot-arm")
#: Kernels of their own, which take long to compile.
DEAR = ("dead-leaves", "glass-and-metal", "traffic-light")
#: Darkness, and streets at night and by day.
OTHER_LIGHT = ("dark", "traffic-light", "facade-drive")


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in ALIKE + MOVING_ALIKE + DEAR else n for n in list_names("scenes")],
)
def test_every_shipped_scene_renders(name):
    scene = hr.load_scene(name)
    assert len(scene.spec.description) > 40
    a, b, source = flux_image(scene, bayer(), 8)
    assert np.all(np.isfinite(a)) and np.all(a >= 0) and np.all(np.isfinite(b))
    assert source.is_static == (not scene.spec.motion)
    if name not in OTHER_LIGHT:
        # exposed for 10 ms, the brightest tenth holds a few hundred to some ten thousand electrons
        assert 300 < np.quantile(a, 0.9) * 0.01 < 20_000


@pytest.mark.parametrize("name", [pytest.param("camera-sweep", marks=pytest.mark.slow), "rotating-star"])
def test_moving_scenes_move_within_a_tenth_of_a_second(name):
    scene, sensor = hr.load_scene(name), bayer(64, 48)
    source = RenderedFlux(scene, sensor, 16)
    pixels = np.arange(64 * 48)
    frames = [np.mean([np.array(half) for half in source.mean_flux(pixels, t, t + 10)], axis=0) for t in (0, 50_000)]
    contrast = np.abs(np.log((frames[1] + 100) / (frames[0] + 100)))
    assert np.mean(contrast > 0.2) > 0.1


def test_a_mitsuba_xml_file_renders(tmp_path):
    (tmp_path / "scene.xml").write_text(XML)
    (tmp_path / "x.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: an XML file\nmitsuba: {file: scene.xml, radiance_scale: 0.5}\n"
    )
    a, b, source = flux_image(hr.load_scene(tmp_path / "x.yaml"), mono(), 64)
    total = source.sensor.responses["clear"].integral()
    image = (a + b) / 2 / total
    np.testing.assert_allclose(image[:3, :3], 1.0, rtol=1e-5)  # background: 2 × 0.5
    np.testing.assert_allclose(image[20:28, 28:36].mean(), 0.5, rtol=0.02)  # ball: ρ = 0.5, emitter-sampled
    # its silhouette: asin(1/4) of half angle where 20° fill half the width
    radius_px = 32 * np.tan(np.arcsin(1 / 4)) / np.tan(np.radians(20))
    np.testing.assert_allclose((image < 0.75).sum(), np.pi * radius_px**2, rtol=0.02)
    direct = Scene.from_mitsuba(tmp_path / "scene.xml", radiance_scale=0.5)
    np.testing.assert_array_equal(flux_image(direct, mono(), 64)[0], a)


def test_unreadable_xml_is_one_clear_error(tmp_path):
    for name, content in (
        ("broken.xml", "<scene version='3.0.0'><shape"),
        ("plugin.xml", "<scene version='3.0.0'><shape type='nonsense'/></scene>"),
        ("noscene.xml", "<bsdf version='3.0.0' type='diffuse'/>"),
    ):
        (tmp_path / name).write_text(content)
        with pytest.raises(SpecError) as caught:
            RenderedFlux(Scene.from_mitsuba(tmp_path / name), bayer(), 2)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(SpecError, match="no such file"):
        Scene.from_mitsuba(tmp_path / "none.xml")
    (tmp_path / "x.yaml").write_text(
        "schema_version: 1\nname: x\ndescription: missing file\nmitsuba: {file: none.xml}\n"
    )
    with pytest.raises(SpecError, match=r"x.yaml: mitsuba.file: no such Mitsuba scene file"):
        RenderedFlux(hr.load_scene(tmp_path / "x.yaml"), bayer(), 2)


def test_shapes_of_a_mitsuba_scene_move_by_their_id(tmp_path):
    (tmp_path / "scene.xml").write_text(XML)
    # the analytic ball rises by one metre in 1 ms: a radius; frozen per slice at the slice's middle
    scene = Scene.from_mitsuba(tmp_path / "scene.xml", motion=[{"object": "ball", "keyframes": RISE}])
    source = RenderedFlux(scene, mono(), 32)
    pixels, rows = np.arange(64 * 48), np.indices((48, 64))[0]
    heights = []
    for begin, end in ((0, 1), (998, 999), (5000, 6000)):
        image = np.array(source.mean_flux(pixels, begin, end)[0]).reshape(48, 64)
        lit = image < 0.75 * image.max()
        heights.append(24 - (rows[lit].mean() + 0.5))
    assert abs(heights[0]) < 0.5
    # seen from 4 m: 32 px / tan 20° per unit of angle's tangent; the ball reaches past the upper border of 24 px
    assert heights[1] > 8
    assert abs(heights[2] - heights[1]) < 0.5  # held after the last keyframe
    mi = mitsuba()
    box = Scene.from_mitsuba(mi.cornell_box(), motion=[{"object": "small-box", "keyframes": RISE}])
    a, _, source = flux_image(box, bayer(), 4)
    later = np.array(source.mean_flux(np.arange(a.size), 900, 901)[0]).reshape(a.shape)
    assert not source.is_static and np.abs(later - a).max() > 0.2 * np.median(a)
    with pytest.raises(SpecError, match=r"no shape 'lamp'.*small-box"):
        RenderedFlux(Scene.from_mitsuba(mi.cornell_box(), motion=[{"object": "lamp", "keyframes": RISE}]), bayer(), 2)


def test_inline_dictionary_in_yaml_and_its_hash(tmp_path):
    (tmp_path / "x.yaml").write_text(
        """
schema_version: 1
name: x
description: an inline dictionary with a matrix and a spectrum as lists
mitsuba:
  inline:
    sky: {type: constant, radiance: {type: irregular, wavelengths: [300, 900], values: [1, 1]}}
    card:
      type: rectangle
      to_world: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1]]
      bsdf: {type: diffuse, reflectance: {type: uniform, value: 0.25}}
camera: {origin_m: [0, 0, 0], target_m: [0, 0, -2], horizontal_fov_deg: 20}
"""
    )
    scene = hr.load_scene(tmp_path / "x.yaml")
    a, _, source = flux_image(scene, mono(16, 16), 64)
    np.testing.assert_allclose(a.mean() / source.sensor.responses["clear"].integral(), 0.25, rtol=0.01)
    assert len(content_hash(scene.spec)) == 64
    mi = mitsuba()
    text = json.dumps(Scene.from_mitsuba(mi.cornell_box()).spec.model_dump(mode="json"))
    assert "small-box" in text and "object at 0x" not in text
    assert content_hash(Scene.from_mitsuba(mi.cornell_box()).spec) == content_hash(
        Scene.from_mitsuba(mi.cornell_box()).spec
    )


def test_a_mitsuba_scene_without_emitter_or_sensor_is_an_error_unless_darkness_is_meant():
    sphere, camera = {"type": "scene", "ball": {"type": "sphere"}}, {"origin_m": (0, 0, 4)}
    with pytest.raises(SpecError, match=r"no emitter.*light: \{type: none\}"):
        RenderedFlux(Scene.from_mitsuba(sphere, camera=camera), bayer(), 2)
    dark = {"light": {"type": "none"}, "camera": camera}
    a, b, _ = flux_image(make_scene(mitsuba={"inline": sphere}, **dark), bayer(), 2)
    assert np.all(a == 0) and np.all(b == 0)
    sky = {"sky": {"type": "constant"}}
    with pytest.raises(SpecError, match="has emitters"):
        RenderedFlux(make_scene(mitsuba={"inline": sphere | sky}, **dark), bayer(), 2)
    with pytest.raises(SpecError, match="has no sensor"):
        RenderedFlux(Scene.from_mitsuba(sphere | sky), bayer(), 2)


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_mesh_files_fill_their_size_and_are_named_in_errors(tmp_path, kind):
    corners, faces = [(0, 0, 0), (3, 0, 0), (3, 7, 0), (0, 7, 0)], [(0, 1, 2), (0, 2, 3)]
    if kind == "obj":
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
        text += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)
    else:
        text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        text += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        text += "".join(f"{x} {y} {z}\n" for x, y, z in corners) + "".join(f"3 {a} {b} {c}\n" for a, b, c in faces)
    (tmp_path / f"m.{kind}").write_text(text)
    yaml = """
schema_version: 1
name: x
description: a mesh file
objects:
  - {name: m, shape: mesh, mesh: %s, size_m: [0.2, 0.1, 0], position_m: [0.05, 0, 0], reflectance: 0.5}
light: {type: uniform, illuminant: {flat: 1}, irradiance_w_m2: 1}
camera: {origin_m: [0, 0, 1], horizontal_fov_deg: 30}
"""
    (tmp_path / "x.yaml").write_text(yaml % f"m.{kind}")
    a, b, _ = flux_image(hr.load_scene(tmp_path / "x.yaml"), mono(), 256)
    covered = 2 * (1 - (a + b) / (a + b).max())  # 1 on the mesh, 0 beside it
    area, scale = covered.sum(), 32 / np.tan(np.radians(15))
    np.testing.assert_allclose(area, 0.2 * 0.1 * scale**2, rtol=0.01)
    np.testing.assert_allclose((covered * (np.arange(64) + 0.5)).sum() / area, 32 + 0.05 * scale, atol=0.1)
    (tmp_path / "x.yaml").write_text(yaml % "other.ply")
    with pytest.raises(SpecError, match="no such mesh file"):
        RenderedFlux(hr.load_scene(tmp_path / "x.yaml"), mono(), 2)
    (tmp_path / f"m.{kind}").write_text("nonsense")
    (tmp_path / "x.yaml").write_text(yaml % f"m.{kind}")
    with pytest.raises(SpecError, match=rf"m\.{kind}"):
        RenderedFlux(hr.load_scene(tmp_path / "x.yaml"), mono(), 2)


def test_boxes_face_outwards_and_patterns_alternate():
    # a box of ρ = 0.6 and 0.2 in a furnace: its face is 4 × 2 checks; a face turned inwards would be black
    box = {"name": "b", "shape": "box", "size_m": (0.2, 0.2, 0.2), "pattern": {"flat": 0.2}, "pattern_count": (4, 2)}
    for axis, angle in (((0, 1, 0), 0), ((0, 1, 0), 90), ((0, 1, 0), 180), ((0, 1, 0), 270), ((1, 0, 0), 90)):
        item = {**box, "reflectance": {"flat": 0.6}, "rotation_axis": axis, "rotation_deg": angle}
        scene = make_scene(objects=[item], light=FURNACE, camera={"origin_m": (0, 0, 1.1), "horizontal_fov_deg": 11.42})
        a, _, source = flux_image(scene, mono(64, 64), 16)
        image = a / source.sensor.responses["clear"].integral()
        checks = image.reshape(8, 8, 8, 8)[:, 2:6, :, 2:6].mean(axis=(1, 3))  # middles of an 8 × 8 grid
        assert np.all((np.abs(checks - 0.6) < 0.01) | (np.abs(checks - 0.2) < 0.01))
        assert abs(np.mean(checks > 0.4) - 0.5) < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_deph": 3}, "max_deph: unknown key"),
        ({"folder": "/x"}, "unknown key 'folder'"),
        ({"target.surround": 2}, r"target.*\[0, 1\]"),
        ({"target.type": "mona-lisa"}, "target"),
        ({"light.illuminant": "D66"}, "D66"),
        ({"camera.fit_margin": -1}, "camera.fit_margin"),
        ({"camera.horizontal_fov_deg": 30, "camera.focal_length_mm": 5}, "not both"),
        ({"objects.0.name": "target"}, "unique"),
        ({"objects.0.shape": "sphere", "objects.0.size_m": [1, 1, 2]}, "diameter"),
        ({"objects.0.rotation_axis": [0, 0, 0]}, "zero vector"),
        ({"objects.0.mesh": "x.ply"}, "go together"),
        ({"motion": [{"object": "wal", "keyframes": RISE}]}, "no object 'wal'.*wall"),
        ({"motion": [{"object": "wall", "keyframes": RISE}] * 2}, "one track"),
        ({"motion": [{"object": "wall", "keyframes": RISE[::-1]}]}, "order of time"),
        ({"motion": [{"object": "wall", "keyframes": RISE[:1]}]}, "at least 2"),
        ({"mitsuba": {"builtin": "cornell_box"}}, "drop target"),
    ],
)
def test_bad_scene_files_are_one_clear_error(changes, message):
    with pytest.raises(SpecError, match=message) as caught:
        hr.load_scene("colorchecker", changes)
    assert "\n" not in str(caught.value)

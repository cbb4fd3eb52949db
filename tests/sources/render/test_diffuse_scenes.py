"""Scenes of Mitsuba whose light is seen in closed form, against Mitsuba's path tracer, and those that are not."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rendering import flux_image, make_scene, mitsuba_scene, mono, pair_tracer, traced

import hesim_render as hr
from hesim_render.core.device import dr
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene import diffuse_scene, surfaces
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.render.scene.direct_lights import DirectLight
from hesim_render.sources.render.scene.mitsuba_version import mitsuba, names_of
from hesim_render.sources.render.transport import known_lights
from hesim_render.sources.render.transport.leaving import Leaving
from hesim_render.sources.render.transport.light_sources import light_source
from hesim_render.spectral.spectrum import constant

#: Every kind of surface and light that has a closed form: a lamp that is mirrored and painted on both sides, spectra in
#: tables of their own, a beam, a point, a sky, pictures in colour and grey, shapes without id or BSDF.
SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="2"/></integrator>
  <bsdf type="plastic" id="spare"/>
  <bsdf type="diffuse" id="clay"><rgb name="reflectance" value="0.61, 0.33, 0.2"/></bsdf>
  <shape type="rectangle">
    <transform name="to_world"><scale x="0.6" y="0.5"/><translate x="0.02" y="-0.03" z="-0.1"/></transform>
    <bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
      <rgb name="color0" value="0.7, 0.65, 0.5"/>
      <spectrum name="color1" value="420:0.05, 611:0.1, 612:0.95, 613:0.1, 690:0.4"/>
      <transform name="to_uv"><scale x="7" y="-3"/></transform>
    </texture></bsdf>
  </shape>
  <shape type="rectangle" id="board">
    <transform name="to_world">
      <scale x="0.17" y="0.12"/><rotate y="1" angle="25"/><translate x="-0.18" y="0.1" z="0.05"/>
    </transform>
    <bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="colour.png"/><transform name="to_uv"><scale x="1.5" y="2"/></transform>
    </texture></bsdf></bsdf>
  </shape>
  <shape type="rectangle" id="back-to-front">
    <transform name="to_world"><scale x="0.1" y="0.12"/><rotate y="1" angle="200"/><translate x="0.22" y="0.15"/>
    </transform>
    <bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
      <string name="filename" value="grey.png"/><string name="filter_type" value="nearest"/>
      <string name="wrap_mode" value="clamp"/><transform name="to_uv"><scale x="1.3"/></transform>
    </texture></bsdf></bsdf>
  </shape>
  <shape type="sphere"><point name="center" x="0.13" y="-0.12" z="0.05"/><float name="radius" value="0.09"/>
    <ref id="clay"/></shape>
  <shape type="cube" id="block">
    <transform name="to_world">
      <scale x="0.05" y="0.07" z="0.06"/><rotate z="1" angle="30"/><translate x="-0.15" y="-0.16" z="0.02"/>
    </transform>
  </shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world">
      <scale x="-0.06" y="0.11"/><rotate x="1" angle="160"/><translate x="0.05" y="0.05" z="0.35"/>
    </transform>
    <bsdf type="twosided"><ref id="clay"/></bsdf>
    <emitter type="area"><spectrum name="radiance" value="380:0.4, 500:2.1, 501:9, 502:2, 720:1.2"/></emitter>
  </shape>
  <shape type="rectangle" id="panel">
    <transform name="to_world"><scale x="0.05" y="0.03"/><translate x="0.1" y="0.22" z="0.12"/></transform>
    <emitter type="area"><rgb name="radiance" value="0.6, 0.9, 0.7"/></emitter>
  </shape>
  <shape type="sphere" id="bulb"><point name="center" x="-0.02" y="-0.2" z="-0.06"/><float name="radius" value="0.055"/>
    <emitter type="area"><spectrum name="radiance" value="0.35"/></emitter></shape>
  <emitter type="point"><point name="position" x="-0.4" y="0.3" z="0.7"/><rgb name="intensity" value="0.4, 0.5, 0.3"/>
  </emitter>
  <emitter type="constant"><spectrum name="radiance" value="0.13"/></emitter>
  <emitter type="directional"><vector name="direction" x="0.3" y="0.2" z="-1"/>
    <spectrum name="irradiance" value="0.35"/></emitter>
</scene>"""


def loaded(folder, text=SCENE, motion="[]", **extra):
    """The scene, with a camera that looks at it from above."""
    rng = np.random.default_rng(11)
    for name, shape in (("colour.png", (6, 9, 3)), ("grey.png", (5, 4))):
        Image.fromarray(rng.integers(20, 250, shape, dtype=np.uint8)).save(folder / name)
    (folder / "scene.xml").write_text(text)
    given = {"file": "scene.xml", "radiance_scale": 0.37, **extra}
    (folder / "scene.yaml").write_text(
        "schema_version: 1\nname: diffuse\ndescription: ''\n"
        "camera: {origin_m: [0.03, 0.02, 2], target_m: [0.01, 0, 0], horizontal_fov_deg: 22.62}\n"
        f"mitsuba: {given}\nmotion: {motion}\n"
    )
    return hr.load_scene(folder / "scene.yaml")


def assert_same(tracer, scene, sensor, most=12, rays=4096):
    """Means of 2×2 tiles by both estimates and Mitsuba's paths; differences over standard errors from halves: their
    mean, and the largest one, which is that of a lamp's rim.
    """

    def groups(half_a, half_b):
        shape = sensor.rows // 4, 2, 2, sensor.cols // 4, 2, 2
        a, b = (np.array(half, np.float64).reshape(shape).mean(axis=(1, 4)) for half in (half_a, half_b))
        return (a + b) / 2, (a - b) ** 2 / 4

    a, b, _ = flux_image(scene, sensor, rays, begin_us=0.0, end_us=0.0)
    wanted, their_square = groups(a, b)
    assert wanted.std() > 0.2 * wanted.mean()
    for controlled in (True, False):
        seen = traced(tracer, rays, 0.0, 0.0, controlled)
        got, square = groups(seen.half_a, seen.half_b)
        spread = np.sqrt(np.mean(square + their_square))
        assert spread < 0.01 * wanted.mean()
        assert abs(np.mean(got - wanted)) < 5 * spread / got.size**0.5
        assert np.abs(got - wanted).max() < most * spread


def test_closed_form_sees_what_mitsubas_paths_see(tmp_path):
    scene, sensor = loaded(tmp_path), hr.load_sensor("gen2").crop(60, 44, 1400, 1000)
    tracer = pair_tracer(scene, sensor)
    assert tracer.is_diffuse
    assert_same(tracer, scene, sensor)


@pytest.mark.slow
def test_a_lamp_that_is_off_stays_as_a_painted_surface(tmp_path):
    sensor, scene = hr.load_sensor("gen2").crop(60, 44, 1400, 1000), loaded(tmp_path, unlit=["lamp"])
    tracer = pair_tracer(scene, sensor)
    kinds = [light.kind for light in build(mitsuba(), scene.spec).diffuse.lights]
    assert kinds == ["rectangle", "ball", "point", "beam", "sky"]
    assert tracer.is_diffuse
    assert_same(tracer, scene, sensor, rays=1024)


def test_spectra_and_places_of_surfaces_and_lights_are_those_of_the_file(tmp_path):
    mi = mitsuba()
    built = build(mi, loaded(tmp_path).spec)
    paints = {paint.shape: paint for paint in built.diffuse.paints}
    assert names_of(built.scene.shapes()) == list(paints)
    assert list(paints) == ["shape_0", "board", "back-to-front", "shape_3", "block", "lamp", "panel", "bulb"]
    floor = paints["shape_0"]
    assert floor.scale == (7, -3) and not floor.two_sided and paints["board"].two_sided
    nm = [400, 419.99, 420, 515.5, 611, 611.4, 612, 650, 690, 690.1]
    assert floor.colours[1].at(nm) == pytest.approx(
        [0, 0, 0.05, 0.075, 0.1, 0.44, 0.95, 0.1 + 0.3 * 37 / 77, 0.4, 0], abs=1e-5
    )
    assert paints["block"].colours[0].at([400, 700]) == pytest.approx(0.5)
    lamp, panel, bulb, point, beam, sky = built.diffuse.lights
    assert bulb.shape == "bulb" and bulb.place == pytest.approx([-0.02, -0.2, -0.06, 0.055], abs=1e-6)
    assert bulb.strength.at(500) == pytest.approx(0.35)
    assert lamp.shape == "lamp" and panel.shape == "panel" and point.shape is None
    assert lamp.strength.at([380, 500.5, 501, 501.5]) == pytest.approx([0.4, 5.55, 9, 5.5], rel=1e-5)
    turned = np.radians(160)
    assert lamp.place[:3, 2] == pytest.approx([0, -np.sin(turned), np.cos(turned)], abs=1e-6)
    assert np.abs(lamp.place[:3, 0]) == pytest.approx([0.06, 0, 0], abs=1e-7)
    assert np.linalg.norm(lamp.place[:3, 1]) == pytest.approx(0.11)
    assert lamp.place[:3, 3] == pytest.approx([0.05, 0.05, 0.35])
    for each in (lamp, panel):  # corners run anticlockwise for who sees it shine
        assert np.cross(each.place[:3, 0], each.place[:3, 1]) @ each.place[:3, 2] > 0
    assert point.place == pytest.approx([-0.4, 0.3, 0.7])
    assert beam.place == pytest.approx(np.array([0.3, 0.2, -1]) / np.linalg.norm([0.3, 0.2, -1]))
    assert beam.strength.at([400, 700]) == pytest.approx(0.35) and sky.strength.at([420, 550]) == pytest.approx(0.13)
    assert sky.level.at(550) == pytest.approx(0.13 * np.pi)  # of a plane


def test_objects_that_shine_are_seen_in_closed_form():
    """A ball that is half sunk in the floor, a small one, and a panel that shines to one side; and what is not."""
    objects = [
        {"name": "floor", "shape": "rectangle", "size_m": [1.2, 1.1, 0], "reflectance": 0.7, "pattern": 0.3},
        {"name": "wall", "shape": "box", "size_m": [0.1, 0.3, 0.2], "position_m": [0.2, 0.05, 0.1], "reflectance": 0.5},
        {"name": "ball", "shape": "sphere", "size_m": [0.14] * 3, "position_m": [-0.1, 0.02, 0.03], "reflectance": 0.3,
         "emission": {"luminance_cd_m2": 900}},
        {"name": "spark", "shape": "sphere", "size_m": [0.03] * 3, "position_m": [0.1, -0.2, 0.1], "reflectance": 0.3,
         "emission": {"luminance_cd_m2": 3000, "illuminant": "A"}},
        {"name": "panel", "shape": "rectangle", "size_m": [0.1, 0.2, 0], "position_m": [-0.3, -0.1, 0.12],
         "rotation_axis": [0, 1, 0], "rotation_deg": 70, "reflectance": 0.4,
         "emission": {"luminance_cd_m2": 700, "illuminant": "FL11"}},
    ]  # fmt: skip
    camera = {"origin_m": [0.0, 0.05, 2], "target_m": [0.0, 0, 0], "horizontal_fov_deg": 22.62}
    light = {"type": "uniform", "illuminant": "D65", "illuminance_lux": 100}
    scene, sensor = make_scene(objects=objects, camera=camera, light=light), mono(60, 44)
    tracer = pair_tracer(scene, sensor)
    assert tracer.is_diffuse
    assert_same(tracer, scene, sensor, most=20)
    assert tracer._integrator.knows_shadows
    panel = objects.pop()
    scene = make_scene(objects=objects, camera=camera, light=light)
    # the shadows of balls have no closed form, and the default mode must not ask for them
    assert not pair_tracer(scene, sensor)._integrator.knows_shadows
    flux = ChangeDrivenFlux(scene, hr.load_sensor("davis346").crop(16, 12, 166, 124), 0.5, seed=2)
    (first, *_) = flux.flux_of_blocks(np.arange(16 * 12, dtype=np.uint32), flux.sample_blocks(1, 0, 1000))
    assert np.all(np.isfinite(np.array(first.half_a)))
    block = panel | {"shape": "box", "size_m": [0.1, 0.2, 0.02]}
    dark = [*objects, block | {"emission": {"luminance_cd_m2": 0}}]
    diffuse = build(mitsuba(), make_scene(objects=dark, camera=camera, light=light).spec).diffuse
    assert [each.kind for each in diffuse.lights] == ["ball", "ball", "sky"]


@pytest.mark.parametrize("depth", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_boxes_that_shine_and_maps_of_scene_files_are_seen_by_paths_beside_lamps(tmp_path, depth):
    """A box and a ball of plastic that shine, under a lamp and a map of the sky."""
    Image.fromarray(np.random.default_rng(5).integers(20, 250, (5, 8, 3), dtype=np.uint8)).save(tmp_path / "sky.png")
    floor = {"name": "floor", "shape": "rectangle", "size_m": [1.2, 1.1, 0], "reflectance": 0.7}
    block = {"name": "block", "shape": "box", "size_m": [0.1, 0.2, 0.02], "position_m": [-0.3, -0.1, 0.12]}
    bead = {"name": "bead", "shape": "sphere", "size_m": [0.12] * 3, "position_m": [0.25, 0.1, 0.1]}
    scene = make_scene(
        objects=[floor, {**block, "reflectance": 0.4, "emission": {"luminance_cd_m2": 300, "illuminant": "A"}},
                 {**bead, "material": {"type": "plastic"}, "emission": {"luminance_cd_m2": 150, "illuminant": "FL11"}}],
        camera={"origin_m": [0.0, 0.05, 2], "target_m": [0.0, 0, 0], "horizontal_fov_deg": 22.62}, max_depth=depth,
        light=[{"type": "area", "illuminant": "D50", "illuminance_lux": 400, "position_m": [0.5, 0.4, 1.3],
                "size_m": [0.5, 0.3]},
               {"type": "environment", "file": str(tmp_path / "sky.png"), "illuminance_lux": 250}],
    )  # fmt: skip
    diffuse, sensor = build(mitsuba(), scene.spec).diffuse, mono(60, 44)
    assert list(diffuse.glows) == ["object_1", "object_2"] and diffuse.others == ["object_2"]
    assert [light.kind for light in diffuse.lights] == ["rectangle"] and diffuse.more_lights == [0]
    tracer = pair_tracer(scene, sensor)
    assert tracer.has_bounced
    assert_same(tracer, scene, sensor, rays=1024, most=20)


def test_maps_are_known_by_their_place_among_the_lights_of_a_scene_file(tmp_path):
    Image.fromarray(np.full((4, 6, 3), 90, dtype=np.uint8)).save(tmp_path / "sky.png")
    given = [
        {"type": "environment", "file": str(tmp_path / "sky.png"), "illuminance_lux": 20},
        {"type": "area", "illuminance_lux": 30, "position_m": [0.5, 0.4, 1.3], "size_m": [0.5, 0.3]},
        {"type": "point", "illuminance_lux": 50, "position_m": [0.3, 0.1, 1.2]},
        {"type": "directional", "illuminance_lux": 40, "direction": [0.1, 0.2, -1]},
    ]
    floor = [{"name": "floor", "shape": "rectangle", "size_m": [1.2, 1.1, 0], "reflectance": 0.4}]
    camera = {"origin_m": [0.0, 0.05, 2], "target_m": [0.0, 0, 0], "horizontal_fov_deg": 22.62}
    for place in range(4):
        lights = [*given[1 : place + 1], given[0], *given[place + 1 :]]
        built = build(mitsuba(), make_scene(objects=floor, light=lights, camera=camera, max_depth=2).spec)
        apart = [light.is_environment() for light in built.scene.emitters() if light.get_shape() is None]
        assert len(apart) == 3 and built.diffuse.more_lights == np.flatnonzero(apart).tolist()


def test_lamps_of_a_grid_are_seen_in_the_light_of_another(tmp_path):
    """Lamps of 5 % that shine, and a board."""
    grid = {"type": "led-grid", "rows": 2, "cols": 3, "pitch_m": 0.2, "diameter_m": 0.09, "luminance_cd_m2": 60}
    lamp = {
        "type": "area",
        "illuminant": "A",
        "illuminance_lux": 3000,
        "position_m": [0.5, 0.4, 1.3],
        "size_m": [0.5, 0.3],
    }
    camera = {"origin_m": [0.0, 0.05, 2], "target_m": [0.0, 0, 0], "horizontal_fov_deg": 22.62}
    scene, sensor = make_scene(target=grid, light=lamp, camera=camera, max_depth=2), mono(60, 44)
    diffuse, tracer = build(mitsuba(), scene.spec).diffuse, pair_tracer(scene, sensor)
    assert diffuse.glows and set(diffuse.glows) < {paint.shape for paint in diffuse.paints}
    assert tracer.has_bounced
    assert_same(tracer, scene, sensor, rays=256)


def test_what_balls_give_is_what_rays_bring():
    """Irradiance, and its mean over drawn points, of balls of 30 and of 0.3 degrees at several heights."""
    mi, rng = mitsuba(), np.random.default_rng(4)
    built = build(mi, mitsuba_scene({"wall": {"type": "rectangle"}, "light": {"type": "constant"}}).spec)
    for radius_m in (0.5, 0.005):
        ball = DirectLight("ball", constant(1.0), 1.0, np.array([0.3, -0.2, 0.9, radius_m]))
        source = light_source(Leaving(mi, built.scene), ball)
        for towards in ([0.1, 0.2, 1.0], [1.0, 0.3, -0.28], [0.9, -0.2, -0.42], [-0.2, 0.1, -0.9]):
            normal = np.array(towards) / np.linalg.norm(towards)
            at = dr.zeros(mi.SurfaceInteraction3f, 200_000)
            at.p, at.n = mi.Point3f(0.1, 0.1, 0.05), mi.Normal3f(normal)
            place = SimpleNamespace(surface_2d=lambda: mi.Point2f(rng.random((2, 200_000)).astype(np.float32)))
            level, share, shadow = source.seen_from(at, mi.Vector3f(normal), place)
            to = np.array([0.2, -0.3, 0.85])
            along = np.array(shadow.d, np.float64).T
            # the rays end where they enter the ball, and those that do bring what E = ∫ cos θ dω says
            end = np.array(shadow.o, np.float64).T + np.array(shadow.maxt, np.float64)[:, None] * along
            off = np.linalg.norm(end - [0.3, -0.2, 0.9], axis=1) - radius_m
            assert np.abs(off).max() < 2e-3 and np.all((end - [0.3, -0.2, 0.9]) @ to < 0)
            drawn, expected = np.array(share, np.float64), float(np.array(level).max())
            assert drawn.mean() == pytest.approx(expected, abs=4.5 * drawn.std() / 200_000**0.5 + 1e-7)
            height, square = normal @ to / np.linalg.norm(to), radius_m**2 / (to @ to)
            if height > square**0.5:
                assert expected == pytest.approx(np.pi * square * height, rel=1e-4)
            assert (expected > 0) == (height > -(square**0.5))
    at.p = mi.Point3f(0.3, -0.2, 0.9 - 0.005)  # its own surface
    level, share, _ = source.seen_from(at, mi.Vector3f(0, 0, 1), place)
    assert not np.any(level) and not np.any(share)


def test_light_of_a_ball_that_its_housing_hides_does_not_count():
    """Half of the ball is sunk in a box. Of all its light, as of other lamps, a run took three times as many rays."""
    objects = [
        {"name": "floor", "shape": "rectangle", "size_m": [1.2, 1.1, 0], "reflectance": 0.7},
        {"name": "housing", "shape": "box", "size_m": [0.2, 0.2, 0.12], "position_m": [0.1, 0.05, 0.21]},
        {"name": "ball", "shape": "sphere", "size_m": [0.11] * 3, "position_m": [0.1, 0.05, 0.15], "reflectance": 0.3,
         "emission": {"luminance_cd_m2": 800}},
    ]  # fmt: skip
    camera = {"origin_m": [0.0, 0.05, 2], "target_m": [0.0, 0, 0], "horizontal_fov_deg": 22.62}
    flux = ChangeDrivenFlux(make_scene(objects=objects, camera=camera, light={"type": "none"}), mono(24, 18), 0.5)
    index, first = flux._index, Windows(np.array([0.0]), np.array([1.0]))
    pilot = flux._tracer.pilot(index, np.zeros(index.size, np.int64), first, 64, 1.25)
    on_floor = np.flatnonzero(pilot.plain > 0.02 * np.median(pilot.plain))
    assert on_floor.size > 200
    excess = pilot.unshadowed[on_floor].sum() / pilot.plain[on_floor].sum() - 1
    assert abs(excess) < 0.05


RED = '<rgb name="reflectance" value="0.61, 0.33, 0.2"/>'
BITMAP = '<texture type="bitmap" name="{}"><string name="filename" value="colour.png"/>{}</texture>'
RAW = BITMAP.format("reflectance", '<boolean name="raw" value="true"/>')


def changed(text, old, new):
    """A text with one thing changed. (|old|new is a second one.)"""
    new, *second = new.split("|")
    text, before = text.replace(old, new), text
    assert text != before
    return text.replace(*second) if second else text


def test_what_is_seen_of_lamps_alone_is_seen_by_paths(tmp_path):
    """No light goes from its source to a surface."""
    scene = loaded(tmp_path, changed(SCENE, 'name="max_depth" value="2"', 'name="max_depth" value="1"'))
    assert build(mitsuba(), scene.spec).diffuse is None
    tracer = pair_tracer(scene, mono(8, 6))
    assert not (tracer.is_diffuse or tracer.has_bounced)


@pytest.mark.parametrize(
    "old, new, glows, others, more",
    [
        ('<shape type="cube" id="block">', '<shape type="cube" id="block"><emitter type="area"/>', {"block": 1}, 0, 0),
        ('<shape type="sphere" id="bulb">',
         '<shape type="sphere" id="bulb"><boolean name="flip_normals" value="true"/>', {"bulb": 1}, 0, 0),
        ('<scale x="-0.06" y="0.11"/>', '<scale x="-0.06" y="0.11"/><rotate z="1" angle="20"/><scale x="2"/>',
         {"lamp": 1}, 0, 0),
        ('<rgb name="radiance" value="0.6, 0.9, 0.7"/>', BITMAP.format("radiance", ""), {"panel": 0}, 0, 0),
        ('<emitter type="area"><rgb', '<emitter type="area"><float name="sampling_weight" value="0.3"/><rgb',
         {"panel": 1}, 0, 0),
        ('<emitter type="point">', '<emitter type="point"><float name="sampling_weight" value="0"/>', {}, 0, [0]),
        ('<emitter type="point"><point name="position" x="-0.4" y="0.3" z="0.7"/>', '<emitter type="spot">',
         {}, 0, [0]),
        ('<emitter type="constant"><spectrum name="radiance" value="0.13"/></emitter>',
         '<emitter type="envmap"><string name="filename" value="colour.png"/></emitter>', {}, 0, [1]),
        # surfaces of lamps
        ('<ref id="clay"/></bsdf>', f'<bsdf type="diffuse">{RAW}</bsdf></bsdf>', {"lamp": 1}, 1, 0),
        ('<ref id="clay"/></bsdf>', '<ref id="clay"/><ref id="spare"/></bsdf>', {"lamp": 1}, 1, 0),
        (f'<bsdf type="diffuse" id="clay">{RED}</bsdf>', '<bsdf type="plastic" id="clay"/>', {"lamp": 1}, 2, 0),
        (RED, BITMAP.format("reflectance", '<transform name="to_uv"><scale x="0"/></transform>'), {"lamp": 1}, 2, 0),
        (RED, '<texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_a"/></texture>',
         {"lamp": 1}, 2, 0),
    ],
)  # fmt: skip
def test_light_that_has_no_closed_form_is_seen_by_paths(tmp_path, old, new, glows, others, more):
    """One thing is changed in each case."""
    scene = loaded(tmp_path, changed(SCENE, old, new))
    diffuse = build(mitsuba(), scene.spec).diffuse
    assert {name: radiance is not None for name, radiance in diffuse.glows.items()} == glows
    assert diffuse.more_lights == (more or []) and len(diffuse.others) == others
    lamps = {"lamp", "panel", "bulb"} - glows.keys()
    assert {light.shape for light in diffuse.lights if light.shape is not None} == lamps
    assert len(diffuse.lights) == len(lamps) + 3 - len(diffuse.more_lights)
    tracer = pair_tracer(scene, mono(8, 6))
    assert tracer.has_bounced and not tracer.is_diffuse


QUAD = "v -0.1 0.04 0.2\nv -0.06 0.01 0.26\nv 0.02 0.07 0.2366667\nv -0.02 0.1 0.1766667\n"


@pytest.mark.parametrize(
    "mesh, is_lamp",
    [
        (QUAD + "f 1 2 3 4\n", True),
        # corners twice, and the same sides with the other diagonal
        (QUAD + QUAD + "f 6 3 8\nf 6 4 1\n", True),
        (QUAD + "f 1 4 3 2\n", True),
        (QUAD + "f 1 2 3\n", False),
        (QUAD + "v 0 0.1 0.2\nf 1 2 3\nf 1 3 5\n", False),
        # a parallelogram
        (QUAD.replace("0.2366667", "0.25").replace("0.1766667", "0.19") + "f 1 2 3 4\n", False),
        (QUAD.replace("0.1766667", "0.18") + "f 1 2 3 4\n", False),
        # two triangles apart, one without an area, a bent normal at one corner, and at all
        (QUAD + "v 0 0.1 0.2\nv 0.1 0.1 0.2\nv 0.1 0 0.2\nf 1 2 3\nf 5 6 7\n", False),
        (QUAD + "f 1 2 3\nf 1 3 1\n", False),
        (QUAD + "vn -0.0029 0.0057333 0.0048\nvn 0 0 1\nf 1//1 2//1 3//1\nf 1//1 3//1 4//2\n", False),
        (QUAD + "vn 0.1 0 1\nvn 0 0.1 1\nvn 0 0 1\nf 1//1 2//2 3//3 4//3\n", False),
    ],
)  # fmt: skip
def test_meshes_that_are_rectangles_shine_in_closed_form(tmp_path, mesh, is_lamp):
    """By hand: sides of 0.04, -0.03, 0.06 and 0.08, 0.06, -0.0233, which are at right angles."""
    (tmp_path / "quad.obj").write_text(mesh)
    shape = '<shape type="obj" id="quad"><string name="filename" value="quad.obj"/>'
    emitter = '<emitter type="area"><rgb name="radiance" value="2, 1, 0.5"/></emitter></shape></scene>'
    diffuse = build(mitsuba(), loaded(tmp_path, SCENE.replace("</scene>", shape + emitter)).spec).diffuse
    lamps = [light for light in diffuse.lights if light.shape == "quad"]
    assert len(lamps) == is_lamp and list(diffuse.glows) == ([] if is_lamp else ["quad"])
    if is_lamp:
        (frame,) = (lamp.place for lamp in lamps)
        np.testing.assert_allclose(frame[:3, 3], [-0.04, 0.055, 0.2183333], atol=1e-6)
        sides = {tuple(np.round(sign * side, 6)) for side in frame[:3, :2].T for sign in (1, -1)}
        assert {(0.02, -0.015, 0.03), (0.04, 0.03, -0.011667)} <= sides
        np.testing.assert_allclose(
            np.linalg.det(frame[:3, :3]), np.prod(np.linalg.norm(frame[:3, :2], axis=0)), rtol=1e-5
        )
        upwards = "f 1 4" not in mesh
        assert (frame[2, 2] > 0) == upwards


def test_a_mesh_that_is_a_rectangle_gives_the_light_that_mitsuba_gives(tmp_path):
    (tmp_path / "quad.obj").write_text(QUAD + "f 1 4 3 2\n")
    shape = '<shape type="obj" id="quad"><string name="filename" value="quad.obj"/><ref id="clay"/>'
    emitter = '<emitter type="area"><rgb name="radiance" value="12, 9, 5"/></emitter></shape></scene>'
    scene, sensor = loaded(tmp_path, SCENE.replace("</scene>", shape + emitter)), mono(60, 44)
    tracer = pair_tracer(scene, sensor)
    assert tracer.is_diffuse
    assert_same(tracer, scene, sensor, rays=1024)


@pytest.mark.slow
def test_more_lights_than_a_kernel_holds_are_seen_by_paths(tmp_path, monkeypatch):
    monkeypatch.setattr(diffuse_scene, "_MOST_LIGHTS", 4)
    diffuse = build(mitsuba(), loaded(tmp_path).spec).diffuse
    assert [light.kind for light in diffuse.lights] == ["rectangle", "rectangle", "ball", "point"]
    assert diffuse.more_lights == [2, 1] and not diffuse.glows
    monkeypatch.setattr(diffuse_scene, "_MOST_LIGHTS", 1)
    scene, sensor = loaded(tmp_path), mono(60, 44)
    diffuse, tracer = build(mitsuba(), scene.spec).diffuse, pair_tracer(scene, sensor)
    assert list(diffuse.glows) == ["panel", "bulb"] and diffuse.more_lights == [0, 2, 1]
    assert tracer.has_bounced
    assert_same(tracer, scene, sensor, rays=1024, most=20)
    # where the others cannot be drawn alone, samples of known lights count for nothing
    monkeypatch.setattr(known_lights, "_MOST_RUNS", 0)
    assert_same(pair_tracer(scene, sensor), scene, sensor, rays=1024, most=20)


def test_a_scene_whose_lights_all_lack_a_closed_form_is_seen_by_paths(tmp_path):
    text = (
        '<scene version="3.0.0"><shape type="sphere"/><emitter type="envmap">'
        '<string name="filename" value="colour.png"/></emitter></scene>'
    )
    scene = loaded(tmp_path, text)
    assert build(mitsuba(), scene.spec).diffuse is None


@pytest.mark.parametrize(
    "old, new, others",
    [
        ('name="max_depth" value="2"', 'name="max_depth" value="3"', 0),
        ('<ref id="clay"/></shape>', '<ref id="spare"/></shape>', 1),
        ('<shape type="cube" id="block">', '<shape type="merge"><shape type="cube"/></shape><shape type="cube">', 1),
        ('<scale x="1.5" y="2"/>', '<scale x="1.5" y="2"/><rotate z="1" angle="10"/>', 1),
        ('<scale x="1.3"/>', '<scale x="1.3"/><translate x="0.2"/>', 1),
        ('value="clamp"', 'value="mirror"', 1),
        ('value="clamp"/>', 'value="clamp"/><boolean name="raw" value="true"/>|grey.png|colour.png', 1),
        ('<rgb name="color0" value="0.7, 0.65, 0.5"/>', BITMAP.format("color0", ""), 1),
    ],
)  # fmt: skip
def test_what_else_has_no_closed_form_is_seen_by_paths_beside_it(tmp_path, old, new, others):
    """One thing is changed in each case."""
    scene = loaded(tmp_path, changed(SCENE, old, new))
    built = build(mitsuba(), scene.spec)
    assert len(built.diffuse.others) == others and len(built.diffuse.paints) + others == len(built.scene.shapes())
    tracer = pair_tracer(scene, mono(8, 6))
    assert tracer.has_bounced and not tracer.is_diffuse


#: Things that are not diffuse: glossy with bumps, a mirror that shows the lamp, and with holes.
OTHERS = """
  <shape type="sphere" id="gloss"><point name="center" x="0.12" y="-0.12" z="0.1"/><float name="radius" value="0.07"/>
    <bsdf type="bumpmap"><texture type="bitmap" name="bumps"><string name="filename" value="grey.png"/></texture>
    <float name="scale" value="0.3"/><bsdf type="roughplastic"><float name="alpha" value="0.3"/></bsdf></bsdf></shape>
  <shape type="rectangle" id="mirror"><transform name="to_world">
    <scale x="0.09" y="0.11"/><rotate y="1" angle="25.1"/><rotate x="1" angle="-17.1"/>
    <translate x="-0.28" y="-0.16" z="0.02"/></transform>
    <bsdf type="twosided"><bsdf type="conductor"/></bsdf></shape>
  <shape type="rectangle" id="veil"><transform name="to_world">
    <scale x="0.12" y="0.06"/><translate x="0.1" y="0.28" z="0.09"/></transform>
    <bsdf type="mask"><float name="opacity" value="0.6"/><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf>
  </shape>
</scene>"""


@pytest.mark.parametrize("depth", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_gloss_and_what_bounces_are_seen_by_paths_beside_closed_forms(tmp_path, depth):
    """Against Mitsuba's own path tracer. Light is sampled at what is glossy, and known at what is not."""
    text = SCENE.replace("</scene>", OTHERS).replace('"max_depth" value="2"', f'"max_depth" value="{depth}"')
    scene, sensor = loaded(tmp_path, text), hr.load_sensor("gen2").crop(60, 44, 1400, 1000)
    tracer = pair_tracer(scene, sensor)
    assert build(mitsuba(), scene.spec).diffuse.others == ["gloss", "mirror", "veil"]
    assert tracer.has_bounced and not tracer.is_diffuse
    assert_same(tracer, scene, sensor, rays=1024, most=20)


#: Lights without a closed form: a map of the sky, a spot, a block, a disk with a picture, and a ball of plastic that
#: shine; and a hair.
MORE = """
  <emitter type="envmap"><string name="filename" value="colour.png"/><float name="scale" value="0.25"/>
    <transform name="to_world"><rotate x="1" angle="70"/></transform></emitter>
  <emitter type="spot"><transform name="to_world"><lookat origin="0.3, -0.4, 0.5" target="0.1, 0, 0" up="0, 1, 0"/>
    </transform><rgb name="intensity" value="0.3, 0.25, 0.2"/><float name="cutoff_angle" value="14"/></emitter>
  <shape type="cube" id="glow"><transform name="to_world">
      <scale x="0.03" y="0.02" z="0.02"/><rotate z="1" angle="50"/><translate x="0.05" y="0.12" z="0"/></transform>
    <emitter type="area"><rgb name="radiance" value="0.9, 0.7, 0.3"/></emitter></shape>
  <shape type="disk" id="screen"><transform name="to_world">
      <scale x="0.06" y="0.05"/><rotate y="1" angle="40"/><translate x="-0.25" y="-0.02" z="0.08"/></transform>
    <emitter type="area"><texture type="bitmap" name="radiance"><string name="filename" value="colour.png"/></texture>
    </emitter></shape>
  <shape type="sphere" id="bead"><point name="center" x="0.17" y="0.03" z="0.02"/><float name="radius" value="0.03"/>
    <bsdf type="plastic"/><emitter type="area"><rgb name="radiance" value="0.2, 0.3, 0.4"/></emitter></shape>
  <shape type="linearcurve" id="hair"><string name="filename" value="hair.txt"/><ref id="clay"/></shape>
</scene>"""


SKY = '<emitter type="constant"><spectrum name="radiance" value="0.13"/></emitter>'
HAIR = "-0.2 0.2 0.02 0.008\n0.0 0.23 0.06 0.008\n0.2 0.2 0.03 0.008\n"


SLOW_LIGHTS = [(5, False, False), (2, True, False), (5, True, False), (5, False, True)]


@pytest.mark.parametrize(
    "depth, lamps, even_sky",
    [(2, False, False), (2, False, True), *(pytest.param(*each, marks=pytest.mark.slow) for each in SLOW_LIGHTS)],
)
def test_lights_without_a_closed_form_are_seen_by_paths_beside_others(tmp_path, depth, lamps, even_sky):
    """Against Mitsuba's own path tracer, with many lights of closed form and with the point light alone, and with a
    uniform sky in place of the map, where paths go on in the direction of its shadow rays.
    """
    (tmp_path / "hair.txt").write_text(HAIR)
    text, more = SCENE.replace('"max_depth" value="2"', f'"max_depth" value="{depth}"'), MORE
    if even_sky:
        more = MORE[: MORE.index('  <emitter type="envmap"')] + MORE[MORE.index('  <emitter type="spot"') :]
    else:
        text = text.replace(SKY, "")
    off = [] if lamps else ["lamp", "panel", "bulb"]
    scene = loaded(tmp_path, text.replace("</scene>", more), unlit=off)
    diffuse, sensor = build(mitsuba(), scene.spec).diffuse, hr.load_sensor("gen2").crop(60, 44, 1400, 1000)
    assert list(diffuse.glows) == ["glow", "screen", "bead"] and diffuse.others == ["bead"]
    assert diffuse.more_lights == ([3] if even_sky else [2, 3]) and "hair" in {paint.shape for paint in diffuse.paints}
    tracer = pair_tracer(scene, sensor)
    assert tracer.has_bounced
    assert_same(tracer, scene, sensor, rays=1024, most=20)


def test_surfaces_that_were_made_before_are_seen_by_paths():
    """The parser says nothing of them."""
    mi, shapes = mitsuba(), {"wall": {"type": "rectangle"}, "light": {"type": "constant"}}
    assert build(mi, mitsuba_scene(shapes, depth=2).spec).diffuse is not None
    shapes["wall"]["bsdf"] = mi.load_dict({"type": "plastic"})
    assert build(mi, mitsuba_scene(shapes, depth=2).spec).diffuse is None


def test_a_direct_integrator_has_depth_2(tmp_path):
    own = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'
    for text in (
        SCENE.replace(own, '<integrator type="direct"/>'),
        SCENE.replace('value="2"/></int', 'value="8"/></int'),
    ):
        scene = loaded(tmp_path, text)
        assert pair_tracer(scene, mono(8, 6)).is_diffuse == ('"8"' not in text)
    assert pair_tracer(hr.load_scene(tmp_path / "scene.yaml", {"max_depth": 2}), mono(8, 6)).is_diffuse


@pytest.mark.slow
@pytest.mark.parametrize("more", [False, True])
def test_moving_shapes_have_the_wanted_error_in_the_default_mode(tmp_path, monkeypatch, more):
    """A board with a picture slides and turns, and its shadows with it; errors in noise units against paths."""
    turn = "{t_us: 100000, translation_m: [0.2, 0.05, 0], rotation_axis: [0, 0, 1], rotation_deg: 40}"
    motion = f"[{{object: board, keyframes: [{{t_us: 0}}, {turn}]}}]"
    (tmp_path / "hair.txt").write_text(HAIR)
    text = SCENE.replace(SKY, "").replace("</scene>", MORE) if more else SCENE
    scene, sensor = loaded(tmp_path, text, motion), hr.load_sensor("davis346").crop(48, 36, 150, 110)
    flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=6)
    blocks = list(flux.sample_blocks(1, 0, 5_000))
    pixels = np.arange(48 * 36, dtype=np.uint32)
    seen = np.array([(np.array(s.half_a) + np.array(s.half_b)) / 2 for s in flux.flux_of_blocks(pixels, blocks)])
    begin, end = (np.concatenate([getattr(b, name)[b.wanted] for b in blocks]) for name in ("begin_us", "end_us"))
    unit = flux.noise_unit(pixels, seen, True)
    changes = np.abs(seen - seen[0]) > 3 * unit
    window, pixel = (index[np.random.default_rng(2).permutation(changes.sum())[:500]] for index in np.nonzero(changes))
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", 0)
    paths = pair_tracer(scene, sensor)
    own = flux._renderer.tracer
    assert (own.is_diffuse, own.has_bounced) == (not more, more) and not (paths.is_diffuse or paths.has_bounced)
    places, windows = sensor.layout.full_index.ravel()[pixel], Windows(begin, end)
    given = places, window, windows, np.full(pixel.size, 4096), np.zeros(pixel.size, np.bool_)
    several = np.array([paths.trace(*given, repeat=k).mean for k in range(4)], np.float64)
    off = (seen[window, pixel] - several.mean(axis=0)) / unit[window, pixel]
    assert pixel.size == 500
    assert np.sqrt(np.mean(several.var(axis=0, ddof=1) / 4 / unit[window, pixel] ** 2)) < 0.2
    assert np.sqrt(np.mean(off**2)) < 0.55
    assert abs(off.mean()) < 4.4 * off.std() / off.size**0.5

"""Scenes of Mitsuba's own: what is honoured, what needs the exact mode, and what is refused."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mitsuba_specfilm import reference_flux
from rendering import make_scene, mitsuba_scene, mono

import hesim_render as hr
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import HesimError, SpecError
from hesim_render.isp.develop import _illumination
from hesim_render.mosaic.schedule import BLOCK_INTERVALS, CELL_US
from hesim_render.sources.render.camera import place_camera
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.one_window import render_one_window
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer, Windows
from hesim_render.sources.render.change_driven.sample_instants import STEP_PX, MotionClock
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.exact import RenderedFlux, used_responses
from hesim_render.sources.render.scene import plugin_tables
from hesim_render.sources.render.scene.builder import NeedsExactMode, build
from hesim_render.sources.render.scene.mitsuba_scene import _plugin_dict
from hesim_render.sources.render.scene.mitsuba_version import files_readable, mitsuba
from hesim_render.sources.render.scene.trajectory import Trajectory
from hesim_render.sources.scene import Scene
from hesim_render.specs.geometry import rotation_about
from hesim_render.specs.motion import TrackSpec

COLS, ROWS = 16, 12
DOCS = Path(__file__).parents[3] / "docs" / "scenes.md"
BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "scenes"


def even(value):
    return {"type": "uniform", "value": value}


REGULAR = {"type": "regular", "wavelength_min": 400, "wavelength_max": 700, "values": "1, 1"}
GREY = {"type": "diffuse", "reflectance": even(0.5)}
SKY = {"type": "constant", "radiance": even(1.0)}
FLOOR = {"type": "rectangle", "bsdf": GREY}
BALL = {"type": "sphere", "center": [0, 0, 0.15], "radius": 0.15}
LAMP = {
    "type": "rectangle",
    "to_world": [[0.3, 0, 0, 0.3], [0, -0.3, 0, 0.2], [0, 0, -0.3, 1.5], [0, 0, 0, 1]],
    "emitter": {"type": "area", "radiance": even(3.0)},
}
ROOM = {"floor": FLOOR, "lamp": LAMP, "ball": {**BALL, "bsdf": GREY}}
STEP = [{"t_us": 0, "translation_m": (0.05, 0, 0)}, {"t_us": 1000, "translation_m": (0.0500001, 0, 0)}]


def default_flux(scene, sensor, rays=512, seed=3):
    """Both halves of the flux that the default mode's tracer finds in [0 µs, 1 µs), [2, row, col]."""
    tracer = PairTracer(scene, sensor, seed, used_responses(sensor))
    pixel = sensor.layout.full_index.ravel().astype(np.uint32)
    window = Windows(np.array([0.0]), np.array([1.0]))
    found = tracer.trace(pixel, 0 * pixel, window, np.full(pixel.size, rays), np.ones(pixel.size, bool))
    return np.stack([found.half_a, found.half_b]).astype(np.float64).reshape(2, *sensor.layout.shape)


def exact_flux(scene, sensor, rays=512, seed=3):
    source = RenderedFlux(scene, sensor, rays, seed)
    halves = source.mean_flux(np.arange(sensor.rows * sensor.cols, dtype=np.uint32), 0.0, 1.0)
    return np.stack([np.array(half, dtype=np.float64) for half in halves]).reshape(2, *sensor.layout.shape)


def agrees(halves, reference, sigmas=4.5):
    """Whether an image agrees with a reference flux in its mean, in its halves and quarters."""
    mean, own = halves.mean(axis=0), np.diff(halves, axis=0)[0] / 2
    other, stderr = reference.mosaic()
    rows, cols = mean.shape
    for block in ((1, 1), (1, 2), (2, 1), (2, 2)):
        shape = (block[0], rows // block[0], block[1], cols // block[1])
        difference = (mean - other).reshape(shape).mean(axis=(1, 3))
        variance = (own**2 + stderr**2).reshape(shape).sum(axis=(1, 3)) / (rows * cols / np.prod(block)) ** 2
        if np.any(np.abs(difference) > sigmas * np.sqrt(variance)):
            return False
    return True


def refusal(shapes, camera=True, **changes):
    """The one line with which a scene is refused."""
    scene = mitsuba_scene(shapes, depth=None) if camera else make_scene(mitsuba={"inline": shapes})
    with pytest.raises(SpecError) as caught:
        RenderedFlux(Scene(scene.spec.model_copy(update=changes)), mono(COLS, ROWS), 2)
    assert "\n" not in str(caught.value) and isinstance(caught.value, HesimError)
    return str(caught.value)


# ---- every plugin has its place ----------------------------------------------------------------


def own_plugins():
    """Kind and name of everything that this Mitsuba brings: its libraries, and what its Python part registers."""
    mi = mitsuba()
    folder = Path(mi.__file__).parent
    found = {}
    for library in (folder / "plugins").glob("*.so"):
        found[library.stem] = mi.PluginManager.instance().plugin_type(library.stem).name
    for source in (folder / "python").rglob("*.py"):
        for kind, name in re.findall(r'mi\.register_(\w+)\(\s*"(\w+)"', source.read_text()):
            found[name] = kind.capitalize()
    return found


def tables():
    """Kind of each plugin that the tables name, and how it is taken."""
    found = {}
    for how, table in (
        ("default", plugin_tables.HONOURED),
        ("exact", plugin_tables.EXACT),
        ("sensor file", plugin_tables.OF_THE_SENSOR_FILE),
        ("refused", plugin_tables.REFUSED),
    ):
        for kind, names in table.items():
            for name in names:
                assert name not in found, f"{name} is in two tables"
                found[name] = kind, how
    return found


def test_each_plugin_that_mitsuba_brings_is_decided_about():
    own = own_plugins()
    assert len(own) > 100
    decided = {name: kind for name, (kind, _) in tables().items()}
    assert decided == own


def test_the_page_says_of_each_plugin_what_the_tables_say():
    text = DOCS.read_text(encoding="utf-8")
    table = text.split("### Plugins")[1]
    rows = re.findall(r"^\| ([^|]+) \| ([^|]*) \| ([^|]*) \| ([^|]*) \|$", table, re.MULTILINE)[1:]
    told = {}
    for _, *cells in rows:
        for how, cell in zip(("default", "exact", "refused"), cells, strict=True):
            told |= dict.fromkeys(re.findall(r"`(\w+)`", cell), how)
    assert told == {name: how for name, (kind, how) in tables().items() if how != "sensor file"}


# ---- integrators -------------------------------------------------------------------------------

#: Light in this room bounces often: ρ = 0.8 all around, so that what the path length is matters.
WHITE = {"type": "diffuse", "reflectance": even(0.8)}
CLOSED = {
    "walls": {"type": "sphere", "radius": 4.0, "flip_normals": True, "bsdf": WHITE},
    "lamp": {**LAMP, "bsdf": WHITE},
}


@pytest.mark.slow
def test_a_pixel_in_which_no_ray_saw_light_states_the_error_that_is_wanted():
    """A floor that reflects nothing shows nothing, yet its rays do not prove that no light comes from there."""
    black = {"type": "diffuse", "reflectance": even(0.0)}
    shapes = {"floor": {**FLOOR, "bsdf": black}, "lamp": LAMP, "ball": {**BALL, "bsdf": {"type": "plastic"}}}
    sensor, quality = hr.load_sensor("davis346").crop(COLS, ROWS), 0.7
    pixel = sensor.layout.evs_pixel.ravel()
    begin, rays = np.full(pixel.size, 100.0), []
    for least in (8, 64):
        source = ChangeDrivenFlux(mitsuba_scene(shapes), sensor, quality, 3, tuning=replace(TUNING, dark_rays=least))
        out = Flux.zeros(1, pixel.size)
        render_one_window(source._renderer, pixel, begin, begin + 1, "events", out)
        rays.append(source.counts.rays)
    half, dark = 0.5 * np.abs(out.half_a - out.half_b)[0], (out.half_a + out.half_b)[0] == 0
    assert 120 < dark.sum() < 180
    wanted = quality * source.noise_unit(pixel, np.zeros((1, pixel.size)), True)[0]
    # beside the ball the pilot, which starts rays a little further out, saw light, and more is wanted there
    assert np.all(half[dark] > 0.999 * wanted[dark]) and np.mean(half[dark] < 1.001 * wanted[dark]) > 0.9
    # black pixels with nothing bright beside them take 8 rays otherwise
    assert rays[1] - rays[0] > 56 * 0.5 * dark.sum() and TUNING.dark_rays == 64


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["room", "floor-ball", *(pytest.param(name, marks=pytest.mark.slow) for name in ("copper", "glass-ball"))]
)
def test_the_scenes_of_the_benchmark_take_the_default_mode_and_move(name):
    sensor = hr.load_sensor("davis346").crop(24, 18, 140, 100)
    source = ChangeDrivenFlux(hr.load_scene(BENCHMARK / f"{name}.yaml"), sensor, seed=3)
    assert not source.is_static and source.settings["mode"] == "change-driven"


@pytest.mark.slow
def test_a_run_of_polished_copper_says_that_no_quality_would_do(monkeypatch):
    monkeypatch.setattr("hesim_render.sources.render.audit.audit._RAYS", 3_000_000)
    scene, sensor = hr.load_scene(BENCHMARK / "copper.yaml"), hr.load_sensor("davis346").crop(32, 24, 148, 106)
    audit = hr.simulate(scene, sensor, duration_s=0.003, seed=5).manifest["settings"]["render"]["audit"]
    assert audit["verdict"] == "not met" and audit["quality_needed"] is None
    parts = [audit[name]["off_by_stated_error_alone"] for name in ("events", "frames") if name in audit]
    assert audit["short_of_rays"] == max(parts) > 0.02


def furnace(integrator, depth=None):
    return mitsuba_scene({**CLOSED, **({"integrator": integrator} if integrator else {})}, depth=depth)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", ["path", "volpath", pytest.param("volpathmis", marks=pytest.mark.slow)])
def test_max_depth_of_the_scene_file_changes_the_scenes_own_integrator(plugin):
    # at rr_depth 1 with all walls at 0.8 roulette ends a fifth of all paths: they are noisier, none is lost
    sensor, own = mono(COLS, ROWS), {"type": plugin, "max_depth": 2, "rr_depth": 9}
    first = exact_flux(furnace(own), sensor, 64)
    np.testing.assert_array_equal(exact_flux(furnace({**own, "max_depth": 7}, depth=2), sensor, 64), first)
    fourth = exact_flux(furnace({**own, "max_depth": 4}), sensor, 64)
    np.testing.assert_array_equal(exact_flux(furnace(own, depth=4), sensor, 64), fourth)
    assert fourth.mean() > 1.5 * first.mean()
    mi = mitsuba()
    for depth, expected in ((None, 2), (4, 4)):
        built = build(mi, furnace({**own, "hide_emitters": True}, depth).spec)
        text = str(built.integrator)
        assert f"max_depth = {expected}" in text and "rr_depth = 9" in text
        assert built.integrator.hide_emitters
        assert type(built.integrator) is type(mi.load_dict({"type": plugin}))


@pytest.mark.parametrize("plugin", ["volpath", "volpathmis"])
def test_other_integrators_take_the_exact_mode_and_the_manifest_says_why(plugin):
    scene = mitsuba_scene({**ROOM, "integrator": {"type": plugin}}, depth=None)
    with pytest.raises(NeedsExactMode, match=f"integrator '{plugin}'"):
        PairTracer(scene, mono(COLS, ROWS), 1, used_responses(mono(COLS, ROWS)))
    render = hr.simulate(scene, mono(COLS, ROWS), duration_s=0.002, samples=None).manifest["settings"]
    assert render["mode"] == "exact" and f"integrator '{plugin}'" in render["exact_because"]


def test_direct_light_alone_is_not_made_longer():
    assert "max_depth 5; use 'path'" in refusal({**ROOM, "integrator": {"type": "direct"}}, max_depth=5)
    sensor = mono(COLS, ROWS)
    asked = exact_flux(furnace({"type": "direct"}, depth=2), sensor, 256)
    path = exact_flux(furnace({"type": "path", "max_depth": 2}), sensor, 256)
    np.testing.assert_allclose(asked.mean(), path.mean(), rtol=0.02)  # 192 pixels, 4 % each: 7 σ


@pytest.mark.slow
def test_direct_light_alone_is_a_path_of_two_segments_in_the_default_mode():
    """Against Mitsuba's own picture by its own `direct` with 3 and 2 samples, light that comes back left out."""
    sensor, own = mono(COLS, ROWS), {"type": "direct", "emitter_samples": 3, "bsdf_samples": 2}
    shapes = {**ROOM, "ball": {**BALL, "bsdf": {"type": "plastic"}}, "wall": {**CLOSED["walls"], "radius": 5.0}}
    scene = mitsuba_scene({**shapes, "integrator": own}, depth=None)
    reference = reference_flux(scene, sensor, 256, repeats=4, seed=8)
    # 9 means at 4.5 σ: false alarm 6e-5
    assert agrees(default_flux(scene, sensor), reference)
    assert not agrees(default_flux(mitsuba_scene(shapes, depth=3), sensor, 2048), reference)
    manifest = hr.simulate(scene, sensor, duration_s=0.002).manifest["settings"]
    assert manifest["mode"] != "exact" and "exact_because" not in manifest


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hide_emitters": True}, "hides lights"),
        ({"emitter_samples": 0, "bsdf_samples": 2}, "'direct': with emitter_samples 0 it leaves light out"),
        ({"emitter_samples": 2, "bsdf_samples": 0}, "'direct': with bsdf_samples 0 it leaves light out"),
    ],
)
def test_settings_of_direct_light_that_change_the_picture_take_the_exact_mode(settings, message):
    scene = mitsuba_scene({**ROOM, "integrator": {"type": "direct", **settings}}, depth=None)
    with pytest.raises(NeedsExactMode, match=message):
        PairTracer(scene, mono(COLS, ROWS), 1, used_responses(mono(COLS, ROWS)))


def unused(folder):
    """What would need the exact mode, be refused, or not be read, if a shape used it."""
    for name in ("no.pbsdf", "no.png"):
        (folder / name).write_text("nothing that Mitsuba reads")
    volume = {"type": "constvolume", "value": even(0.3)}
    return {
        "polar": {"type": "polarizer"},
        "lost": {"type": "twosided", "inside": {"type": "measured_polarized", "filename": str(folder / "no.pbsdf")}},
        "cloud": {"type": "heterogeneous", "albedo": even(0.5), "sigma_t": volume},
        "haze": {"type": "homogeneous"},
        "stripes": {"type": "volume", "volume": volume},
        "picture": {"type": "bitmap", "filename": str(folder / "no.png")},
        "group": {"type": "shapegroup", "cube": {"type": "cube", "bsdf": {"type": "retarder"}}},
        "made": mitsuba().load_dict({"type": "circular"}),
    }


def test_what_no_shape_uses_decides_nothing(tmp_path):
    """Bits and mode are those without it; but its type must be known and its files be there, used or not."""
    sensor, motion = mono(COLS, ROWS), [{"object": "ball", "keyframes": STEP}]
    used = {**ROOM, "skin": {"type": "twosided", "id": "skin", "inside": GREY}}
    used["floor"] = {"type": "rectangle", "bsdf": {"type": "ref", "id": "skin"}}
    plain, full = (mitsuba_scene(shapes, motion) for shapes in (used, {**unused(tmp_path), **used}))
    np.testing.assert_array_equal(default_flux(full, sensor, 16), default_flux(plain, sensor, 16))
    text = "".join(f'<bsdf type="{name}" id="{name}"/>' for name in ("retarder", "circular"))
    (tmp_path / "s.xml").write_text(
        f'<scene version="3.0.0">{text}<texture type="bitmap" id="t"><string name="filename" value="no.png"/></texture>'
        '<bsdf type="diffuse" id="d"/><bsdf type="twosided" id="e"><ref id="d"/></bsdf>'
        '<shape type="sphere"><ref id="e"/></shape><emitter type="constant"/></scene>'
    )
    built = build(mitsuba(), Scene.from_mitsuba(tmp_path / "s.xml").spec)
    assert built.exact_because is None
    assert [shape.bsdf().class_name() for shape in built.scene.shapes()] == ["TwoSidedBRDF"]
    for name in ("mine", "../evil"):
        (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">\n<bsdf type="{name}" id="no"/></scene>')
        with pytest.raises(SpecError, match=rf"s\.xml:2: no: BSDF '{name}': it is not known here; use one of"):
            build(mitsuba(), Scene.from_mitsuba(tmp_path / "s.xml").spec)


@pytest.mark.parametrize("name", sorted(plugin_tables.REFUSED["Integrator"]))
def test_integrators_that_are_not_rendered_are_refused_by_name(name, tmp_path):
    text = refusal({**ROOM, "light": {"type": name}})
    assert text.startswith(f"mitsuba.inline.light: integrator '{name}': ") and ("use '" in text or "put the" in text)
    (tmp_path / "s.xml").write_text(f'<scene version="3.0.0">\n\n  <integrator type="{name}" id="me"/>\n</scene>')
    with pytest.raises(SpecError, match=rf"s\.xml:3: me: integrator '{name}': "):
        RenderedFlux(Scene.from_mitsuba(tmp_path / "s.xml"), mono(COLS, ROWS), 2)


def test_a_plugin_that_is_not_mitsubas_is_not_loaded(tmp_path):
    # a type is a file name to Mitsuba: it would load, and so run, a library beside its own
    text = refusal({**ROOM, "ball": {**BALL, "skin": {"type": "../evil"}}})
    assert text == "mitsuba.inline.ball.skin: type '../evil' is no plugin of Mitsuba's that is known here"
    (tmp_path / "s.xml").write_text('<scene version="3.0.0">\n<shape type="../evil"/></scene>')
    with pytest.raises(SpecError, match=r"s\.xml:2: shape '../evil': it is not known here; use one of bsplinecurve, "):
        RenderedFlux(Scene.from_mitsuba(tmp_path / "s.xml"), mono(COLS, ROWS), 2)


# ---- media -------------------------------------------------------------------------------------


def slab(integrator, sigma=0.7, **medium):
    """A layer 0.5 m thick that only absorbs, before a sky of radiance 1."""
    absorber = {"type": "homogeneous", "albedo": even(0.0), "sigma_t": even(sigma), **medium}
    layer = {
        "type": "cube",
        "to_world": [[9, 0, 0, 0], [0, 9, 0, 0], [0, 0, 0.25, 0], [0, 0, 0, 1]],
        "bsdf": {"type": "null"},
        "interior": absorber,
    }
    return {"sky": SKY, "slab": layer, **({"integrator": {"type": integrator}} if integrator else {})}


@pytest.mark.parametrize("integrator", [pytest.param("volpath", marks=pytest.mark.slow), "volpathmis"])
def test_light_through_a_medium_follows_beers_law(integrator):
    sensor = mono(COLS, ROWS)
    flux = exact_flux(mitsuba_scene(slab(integrator), depth=None), sensor, 4096).mean()
    x, y = ((np.arange(count) + 0.5) / count * 2 - 1 for count in (COLS, ROWS))
    squared = x**2 + (y[:, None] * ROWS / COLS) ** 2
    length = 0.5 * np.sqrt(1 + squared * np.tan(np.radians(11.31)) ** 2)
    expected = np.exp(-0.7 * length).mean() * sensor.responses["clear"].integral()
    # Mitsuba's transmittance of such a layer is in closed form: no path is lost by chance
    np.testing.assert_allclose(flux, expected, rtol=3e-4)


@pytest.mark.parametrize("integrator", [None, "path", "direct"])
def test_media_are_never_ignored(integrator):
    text = refusal(slab(integrator))
    assert text.startswith("mitsuba.inline.slab.interior: medium 'homogeneous': ") and "use 'volpath'" in text
    assert integrator is None or f"'{integrator}' does not see media" in text


def test_a_volume_does_not_stay_behind_when_its_shape_moves():
    cloud = {"type": "heterogeneous", "albedo": even(0.5), "sigma_t": {"type": "constvolume", "value": even(1.0)}}
    cloud = slab("volpath") | {"slab": slab("volpath")["slab"] | {"interior": cloud}}
    scene = mitsuba_scene(cloud, [{"object": "slab", "keyframes": STEP}], depth=None)
    with pytest.raises(
        SpecError, match=r"mitsuba\.inline\.slab\.interior: medium 'heterogeneous': the shape around it moves"
    ):
        RenderedFlux(scene, mono(COLS, ROWS), 2)


# ---- BSDFs, emitters, shapes --------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(plugin_tables.REFUSED["BSDF"]))
def test_what_needs_polarised_light_is_refused(name, tmp_path):
    text = refusal(
        {**ROOM, "ball": {**BALL, "skin": {"type": "blendbsdf", "weight": 0.5, "a": {"type": name}, "b": GREY}}}
    )
    assert text.startswith(f"mitsuba.inline.ball.skin.a: BSDF '{name}': light is rendered without its polarisation")
    (tmp_path / "s.xml").write_text(
        f'<scene version="3.0.0">\n  <shape type="sphere">\n    <bsdf type="{name}" id="me"/>\n  </shape>\n</scene>'
    )
    with pytest.raises(SpecError, match=rf"s\.xml:3: me: BSDF '{name}': "):
        RenderedFlux(Scene.from_mitsuba(tmp_path / "s.xml"), mono(COLS, ROWS), 2)


def test_objects_that_were_made_before_are_looked_into():
    mi = mitsuba()
    made = mi.load_dict({**BALL, "bsdf": {"type": "polarizer"}})
    assert refusal({**ROOM, "ball": made}).startswith("mitsuba.inline.ball: BSDF 'polarizer': ")
    made = mi.load_dict({**BALL, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}})
    assert refusal({**ROOM, "ball": made}).startswith("mitsuba.inline.ball: medium 'homogeneous': ")
    eye = {"type": "perspective", "film": {"type": "hdrfilm"}}
    for changes, message in (
        ({"medium": {"type": "homogeneous"}}, "medium 'homogeneous': the camera stands in it"),
        ({"type": "thinlens", "aperture_radius": 0.1}, "sensor 'thinlens': its depth of field"),
        ({"film": {"type": "specfilm", "c": REGULAR}}, "film 'specfilm': its channels"),
        ({"shutter_open": 0.0, "shutter_close": 1.0}, "its shutter_open"),
    ):
        text = refusal({**ROOM, "eye": mi.load_dict(eye | changes), "i": {"type": "volpath"}}, camera=False)
        assert text.startswith("mitsuba.inline.eye: ") and message in text
    text = refusal({**ROOM, "i": mi.load_dict({"type": "prbvolpath"})})
    assert text == "mitsuba.inline.i: integrator 'SamplingIntegrator': it is not known here; use one of direct, path"
    made = mi.load_dict({"type": "volpath", "max_depth": 3})
    assert "max_depth cannot be set" in refusal({**ROOM, "i": made}, max_depth=5)
    with pytest.raises(NeedsExactMode, match="'volpath'"):
        default_flux(mitsuba_scene({**ROOM, "i": made}, depth=None), mono(COLS, ROWS))
    still = mi.load_dict({**BALL, "id": "ball", "bsdf": GREY})
    scene = mitsuba_scene({**ROOM, "ball": still}, [{"object": still.id(), "keyframes": STEP}])
    with pytest.raises(SpecError, match="made before, so that it would keep its pose"):
        RenderedFlux(scene, mono(COLS, ROWS), 2)


def turned(matrix):
    """A transform [4, 4] by a matrix [3, 3], moved and turned about an axis without symmetry."""
    whole = np.eye(4)
    whole[:3, :3] = rotation_about((0.3, -0.8, 0.5), 37.0) @ matrix
    whole[:3, 3] = 0.4, 0.2, 0.6
    return whole.tolist()


def test_spheres_and_cylinders_that_would_stay_round_are_refused():
    """Mitsuba makes a ball of any sphere, whatever its transform, and says so in its log alone."""
    along_x = {"p0": [-0.2, 0, 0], "p1": [0.7, 0, 0]}
    egg, tilted = np.diag([0.3, 0.45, 0.3]), np.array([[0.3, 0.1, 0], [0, 0.3, 0], [0, 0, 0.3]])
    for shape, matrix in (
        ({"type": "sphere"}, egg), ({"type": "sphere"}, tilted), ({"type": "cylinder"}, egg),
        ({"type": "cylinder"}, tilted), ({"type": "cylinder", **along_x}, np.diag([0.3, 0.3, 0.45])),
    ):  # fmt: skip
        text = refusal({**ROOM, "ball": {**shape, "to_world": turned(matrix), "bsdf": GREY}})
        assert text.startswith(f"mitsuba.inline.ball: shape '{shape['type']}': its to_world scales it unevenly")
    even = {
        "mirrored": ({"type": "sphere"}, np.diag([-0.3, 0.3, 0.3])),
        "long": ({"type": "cylinder", "radius": 0.7}, np.diag([0.3, 0.3, 0.45])),
        "long_x": ({"type": "cylinder", **along_x}, egg @ np.diag([1.4, 1, 1.5])),
        "rounded": ({"type": "sphere"}, np.diag([0.3, 0.30001, 0.3])),
    }
    shapes = {name: {**shape, "to_world": turned(matrix), "bsdf": GREY} for name, (shape, matrix) in even.items()}
    build(mitsuba(), mitsuba_scene({**ROOM, **shapes}).spec)


@pytest.mark.parametrize(("largest", "is_refused"), [(0.93, False), (1.4, True)])
def test_a_picture_of_a_lamp_that_mitsuba_would_cut_is_refused(largest, is_refused, tmp_path):
    """In spectral scenes a picture is at most 1. The picture is in the dictionary, or in a file."""
    mi = mitsuba()
    values = np.full((3, 4, 3), 0.2, np.float32)
    values[2, 1, 1] = largest
    with files_readable():
        mi.Bitmap(values).write(str(tmp_path / "lamp.exr"))
    for picture in ({"bitmap": mi.Bitmap(values)}, {"filename": str(tmp_path / "lamp.exr")}):
        shine = {**LAMP, "emitter": {"type": "area", "radiance": {"type": "bitmap", **picture}}}
        scene = mitsuba_scene({**ROOM, "lamp": shine, "ball": {**BALL, "bsdf": {
            "type": "diffuse", "reflectance": {"type": "bitmap", **picture}}}})  # fmt: skip
        if is_refused:
            with pytest.raises(
                SpecError, match=r"lamp.*texture 'bitmap': the picture of a lamp has values up to 1\.4,"
            ):
                build(mi, scene.spec)
        else:
            build(mi, scene.spec)


def test_emitters_and_shapes_that_are_not_rendered_are_refused_by_name():
    glow = {"type": "directionalarea", "radiance": even(1.0)}
    text = refusal({**ROOM, "lamp": {**LAMP, "emitter": glow}})
    assert text.startswith("mitsuba.inline.lamp.emitter: emitter 'directionalarea': ") and "use 'directional'" in text
    assert refusal({**ROOM, "sky": {"type": "timed_sunsky"}}).startswith("mitsuba.inline.sky: emitter 'timed_sunsky': ")
    assert refusal({**ROOM, "mesh": {"type": "blender"}}).startswith("mitsuba.inline.mesh: shape 'blender': ")


def instances(bsdf=GREY):
    """Two small towers, as copies of one, and written out."""
    places = [np.diag([0.1, 0.1, 0.1, 1.0]), np.diag([0.05, 0.05, 0.05, 1.0])]
    places[0][:3, 3], places[1][:3, 3] = (-0.1, 0, 0.1), (0.15, 0.1, 0.05)
    tall = np.diag([1.0, 1.0, 3.0, 1.0])
    tall[2, 3] = 2.0
    copies = {"group": {"type": "shapegroup", "cube": {"type": "cube", "to_world": tall.tolist(), "bsdf": bsdf}}}
    plain = {}
    for number, place in enumerate(places):
        matrix = place.tolist()
        copies[f"copy_{number}"] = {"type": "instance", "to_world": matrix, "of": {"type": "ref", "id": "group"}}
        plain[f"copy_{number}"] = {"type": "cube", "to_world": (place @ tall).tolist(), "bsdf": bsdf}
    return {**ROOM, **copies}, {**ROOM, **plain}


@pytest.mark.parametrize("moving", [False, True])
def test_instances_take_the_exact_mode_and_look_like_what_they_copy(moving):
    sensor = mono(COLS, ROWS)
    motion = [{"object": "copy_0", "keyframes": STEP}] if moving else []
    copied, plain = (mitsuba_scene(shapes, motion) for shapes in instances())
    with pytest.raises(NeedsExactMode, match="shape 'shapegroup': its copies have no surface of their own"):
        default_flux(copied, sensor)
    with pytest.raises(NeedsExactMode, match=r"needs the exact mode: give a number of rays \(--samples\) in place of"):
        scene_renderer(copied, sensor, 3, quality=0.4)
    found, expected = exact_flux(copied, sensor, 64), exact_flux(plain, sensor, 64)
    if moving:  # the box in which its motion is followed is that of the copy, not of a unit cube
        corners = build(mitsuba(), copied.spec).groups["copy_0"][0].corners
        np.testing.assert_allclose(
            [corners.min(axis=0), corners.max(axis=0)], [(-0.2, -0.1, 0), (0, 0.1, 0.6)], atol=1e-6
        )
    # the same random numbers meet the same surfaces, but for rounding at their edges
    off = np.abs(found - expected) > 1e-3 * expected
    assert off.mean() < 0.02
    if not moving:
        settings = hr.simulate(copied, sensor, duration_s=0.002).manifest["settings"]
        assert settings["mode"] == "exact" and "'shapegroup'" in settings["exact_because"]


def test_a_texture_that_stays_in_space_needs_the_exact_mode_only_where_shapes_move():
    stripes = {"type": "volume", "volume": {"type": "constvolume", "value": even(0.3)}}
    shapes = {**ROOM, "ball": {**BALL, "bsdf": {"type": "diffuse", "reflectance": stripes}}}
    assert default_flux(mitsuba_scene(shapes), mono(COLS, ROWS), 8).max() > 0
    with pytest.raises(NeedsExactMode, match="texture 'volume': it stays where it is"):
        default_flux(mitsuba_scene(shapes, [{"object": "ball", "keyframes": STEP}]), mono(COLS, ROWS))


def test_shapes_that_cannot_move_say_so(tmp_path):
    (tmp_path / "c.txt").write_text("-0.2 0 0.1 0.03\n-0.1 0.1 0.2 0.03\n0 0 0.1 0.03\n0.1 -0.1 0.1 0.03\n")
    curve = {"type": "bsplinecurve", "filename": str(tmp_path / "c.txt"), "bsdf": GREY}
    scene = mitsuba_scene({**ROOM, "hair": curve}, [{"object": "hair", "keyframes": STEP}])
    with pytest.raises(SpecError, match="shape 'hair' is a BSplineCurve, which cannot move; use a mesh"):
        RenderedFlux(scene, mono(COLS, ROWS), 2)
    grid = mitsuba().TensorXf(np.linspace(-1, 1, 8, dtype=np.float32).reshape(2, 2, 2, 1))
    scene = mitsuba_scene({**ROOM, "form": {"type": "sdfgrid", "grid": grid}}, [{"object": "form", "keyframes": STEP}])
    with pytest.raises(NeedsExactMode, match="shape 'sdfgrid': it moves"):
        default_flux(scene, mono(COLS, ROWS))


def test_a_bitmap_that_was_handed_over_is_still_there_the_second_time():
    # Mitsuba moves the content of a bitmap into the first texture that is made of it
    mi = mitsuba()
    bitmap = mi.Bitmap(np.full((4, 4, 3), 0.5, np.float32))
    card = {**FLOOR, "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": False}}}
    scene = mitsuba_scene({"floor": card, "sky": SKY})
    first = exact_flux(scene, mono(COLS, ROWS), 16)
    assert first.min() > 0
    np.testing.assert_array_equal(exact_flux(scene, mono(COLS, ROWS), 16), first)


@pytest.mark.slow
@pytest.mark.parametrize(
    "many", [pytest.param(False, marks=pytest.mark.slow), True], ids=["faces in closed form", "searched by Mitsuba"]
)
def test_vertex_colours_move_with_their_mesh(many, tmp_path):
    """A sheet whose colour runs from 0.05 to 0.95 along it, turned by 90° and shifted."""
    steps = 9 if many else 2
    u, v = np.meshgrid(np.linspace(0, 1, steps), np.linspace(0, 1, steps))
    x, y, colour = 0.5 * u.ravel() - 0.25, 0.3 * v.ravel() - 0.15, 0.05 + 0.9 * u.ravel()
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", "r", "g", "b"))
    corner = (np.arange(steps - 1)[:, None] * steps + np.arange(steps - 1)).ravel()
    faces = [f"3 {i} {i + 1} {i + steps + 1}\n3 {i} {i + steps + 1} {i + steps}\n" for i in corner]
    text = f"ply\nformat ascii 1.0\nelement vertex {steps**2}\n{header}element face {2 * corner.size}\n"
    text += "property list uchar int vertex_indices\nend_header\n"
    text += "".join(f"{a} {b} 0.1 {c} {c / 2} {c / 4}\n" for a, b, c in zip(x, y, colour, strict=True)) + "".join(faces)
    (tmp_path / "sheet.ply").write_text(text)
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    sheet = {"type": "ply", "filename": str(tmp_path / "sheet.ply"), "bsdf": {"type": "twosided", "paint": paint}}
    turned = [{**key, "rotation_axis": (0, 0, 1), "rotation_deg": 90} for key in STEP]
    scene = mitsuba_scene({"floor": FLOOR, "lamp": LAMP, "sheet": sheet}, [{"object": "sheet", "keyframes": turned}])
    sensor = mono(COLS, ROWS)
    reference = reference_flux(scene, sensor, 256, repeats=4, seed=8)
    found = default_flux(scene, sensor, 512)
    # means of the picture, its halves and quarters, 9 in all at 4.5 σ: false alarm 6e-5
    assert agrees(found, reference)
    plain = default_flux(mitsuba_scene({"floor": FLOOR, "lamp": LAMP}), sensor, 64)
    assert not agrees(plain, reference)  # the sheet is seen
    assert not agrees(found[:, ::-1], reference)  # and where its colours are


# ---- cameras -----------------------------------------------------------------------------------


def camera(film=(64, 48), **more):
    size = {"type": "hdrfilm", "width": film[0], "height": film[1]}
    look = [[-1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]]
    return {"type": "perspective", "fov": 30, "to_world": look, "film": size, **more}


SPOTS = {
    f"spot_{number}": {
        "type": "rectangle",
        "to_world": np.array([[0.05, 0, 0, x], [0, 0.05, 0, y], [0, 0, 1, 0.001], [0, 0, 0, 1]]).tolist(),
        "bsdf": {"type": "diffuse", "reflectance": even(0.9)},
    }
    for number, (x, y) in enumerate(((0.1, 0.1), (-0.2, 0.1), (0.3, -0.2)))
}
FIELD = {"sky": SKY, "floor": {**FLOOR, "bsdf": {"type": "diffuse", "reflectance": even(0.1)}}, **SPOTS}


def mitsubas_own(shapes, spp=64):
    """Mitsuba's picture with its own camera and film, box-filtered to [row, col], mean over wavelengths: L = ρ here."""
    mi = mitsuba()
    scene = mi.load_dict({"type": "scene", **_plugin_dict(mi, shapes)}, optimize=False)
    return np.array(mi.render(scene, spp=spp, integrator=mi.load_dict({"type": "path", "max_depth": 2}))).mean(axis=2)


@pytest.mark.parametrize(
    ("settings", "film", "more"),
    [
        pytest.param(
            {"principal_point_offset_x": 0.3, "principal_point_offset_y": -0.2}, {}, {}, marks=pytest.mark.slow
        ),
        pytest.param(
            {},
            {"crop_offset_x": 32, "crop_offset_y": 4, "crop_width": 32, "crop_height": 24},
            {},
            marks=pytest.mark.slow,
        ),
        (
            {"principal_point_offset_x": -0.1},
            {"crop_offset_x": 8, "crop_offset_y": 20, "crop_width": 32, "crop_height": 24},
            {},
        ),
        ({"fov_axis": "y"}, {}, {}),
        ({"near_clip": 1.0}, {}, {"hidden": {**BALL, "center": [0, 0, 1.4], "radius": 0.2, "bsdf": GREY}}),
    ],
    ids=["principal point", "crop window", "both", "vertical field of view", "near clip"],
)
def test_settings_of_a_mitsuba_camera_are_seen_in_every_mode(settings, film, more):
    own = camera(fov=60, **settings)
    own["film"] = {**own["film"], **film, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    rows, cols = film.get("crop_height", 48), film.get("crop_width", 64)
    shapes = {**FIELD, **more, "camera": own, "integrator": {"type": "path", "max_depth": 2}}
    expected = mitsubas_own(shapes) / np.mean(mitsubas_own({"sky": SKY, "camera": own}, 1))
    assert np.ptp(expected) > 0.5
    scene = make_scene(mitsuba={"inline": shapes})
    sensor = mono(cols, rows, **{"lens__relative_illumination": "none"})
    images = {
        "default": default_flux(scene, sensor, 64).mean(axis=0),
        "exact": exact_flux(scene, sensor, 64).mean(axis=0),
        "reference": reference_flux(scene, sensor, 64, repeats=2).mosaic()[0],
    }
    for mode, image in images.items():
        # the least contrast is 0.1 to 0.9: only what is noisy there, a rim or a corner, may be off
        off = np.abs(image / sensor.responses["clear"].integral() - expected)
        assert (off > 0.1).mean() < 0.003, mode
        assert off.mean() < 0.01, mode


def test_the_fall_off_of_light_lies_about_the_principal_point():
    shapes = {"sky": SKY, "camera": camera(fov=60, principal_point_offset_x=0.5)}
    scene = make_scene(mitsuba={"inline": shapes})
    sensor = mono(64, 48, **{"lens__relative_illumination": "cos4"})
    image = default_flux(scene, sensor, 16).mean(axis=0) / sensor.responses["clear"].integral()
    x = (np.arange(64) + 0.5) / 32 - 1 + 1  # tangents over that of 30°
    y = ((np.arange(48) + 0.5) / 24 - 1) * 48 / 64
    tangent = np.tan(np.radians(30)) * np.hypot(x[None], y[:, None])
    np.testing.assert_allclose(image, (1 + tangent**2) ** -2, rtol=1e-4)
    recording = hr.simulate(scene, sensor, duration_s=0.002)
    np.testing.assert_allclose(recording.manifest["lens"]["axis_mm"], [-32 * 0.005, 0], atol=1e-7)
    # and developing takes it out again
    np.testing.assert_allclose(_illumination(recording), (1 + tangent**2) ** -2, rtol=1e-4)


def test_a_region_beside_the_chips_middle_shows_the_same_picture_about_its_middle():
    shapes = {**FIELD, "camera": camera(principal_point_offset_x=0.2, principal_point_offset_y=0.1)}
    scene = make_scene(mitsuba={"inline": shapes})
    seen = build(mitsuba(), scene.spec).mitsuba_sensor()
    for x, y in ((None, None), (400, 500), (0, 0)):
        view = place_camera(scene.spec, hr.load_sensor("reference-mono").crop(64, 48, x, y), seen)
        # what is in the middle of Mitsuba's picture: 0.2 and 0.1 of its width and height beside the axis
        tangent = np.tan(np.radians(15)) * np.array([0.4, 0.2 * 48 / 64])
        middle = np.array([[0.1 + 2 * tangent[0], -2 * tangent[1], 0.0]])
        np.testing.assert_allclose(view.project(middle), [[32, 24]], atol=1e-4)
        # and the way back, which the clock of a moving camera takes
        spread = view.project(view.unproject(np.array([1.0, 3.0]), view.camera_to_world)).reshape(2, 5, 5, 2)
        np.testing.assert_allclose(spread[..., 0], np.broadcast_to(np.linspace(0, 64, 5), (2, 5, 5)), atol=1e-6)
        np.testing.assert_allclose(
            spread[..., 1], np.broadcast_to(np.linspace(0, 48, 5)[:, None], (2, 5, 5)), atol=1e-6
        )


def test_a_turning_camera_is_followed_at_the_corner_that_is_farthest_from_its_axis():
    shapes = {**FIELD, "camera": camera(fov=60, principal_point_offset_x=0.4)}
    scene = make_scene(mitsuba={"inline": shapes})
    built = build(mitsuba(), scene.spec)
    view = place_camera(scene.spec, mono(64, 48), built.mitsuba_sensor())
    place = view.camera_to_world[:3, 3].tolist()
    # it turns about itself by 80° in 0.2 s
    keys = [{"t_us": 0}, {"t_us": 200_000, "rotation_axis": (0, 1, 0), "rotation_deg": 80}]
    turn = Trajectory(TrackSpec.model_validate({"object": "camera", "pivot_m": place, "keyframes": keys}))
    instants = MotionClock(view, turn, [], lambda t: 1.0).instants_us(0, CELL_US)
    # the picture reaches from 0.2 to 1.8 times its half width: x = tan α moves by 1 + x² + y² for a turn at most
    half = np.tan(np.radians(30))
    per_rad = 32 / half * (1 + (1.8 * half) ** 2 + (half * 48 / 64) ** 2)
    moved_px = np.radians(80) / 0.2 * CELL_US * 1e-6 * per_rad
    assert moved_px > 4 * STEP_PX
    assert instants.size == 1 + np.ceil(moved_px / STEP_PX) + 1  # and the instant after the first keyframe


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"type": "thinlens", "aperture_radius": 0.05}, "sensor 'thinlens': its depth of field is not rendered"),
        ({"type": "orthographic"}, "sensor 'orthographic': a lens sees in perspective"),
        ({"type": "irradiancemeter"}, "sensor 'irradiancemeter': it has no picture"),
        ({"type": "radiancemeter"}, "sensor 'radiancemeter': it has no picture"),
        ({"type": "distant"}, "sensor 'distant': it has no picture"),
        ({"type": "batch"}, "sensor 'batch': it is several cameras"),
        ({"shutter_open": 0.0, "shutter_close": 0.01}, "sensor 'perspective': its shutter_open and shutter_close"),
        ({"srf": even(1.0)}, "srf: texture 'uniform': it is the camera's 'srf'"),
        ({"medium": {"type": "homogeneous"}}, "medium: medium 'homogeneous': the camera stands in it"),
        ({"far_clip": 1.5}, "far_clip is 1.5, and there are shapes up to 2 away"),
        (
            {"film": {"type": "specfilm", "width": 64, "height": 48, "c": REGULAR}},
            "film: film 'specfilm': its channels",
        ),
    ],
)
def test_cameras_that_are_not_rendered_are_refused_unless_the_scene_file_has_its_own(changes, message):
    shapes = {**FIELD, "eye": camera() | changes, "integrator": {"type": "volpath"}}
    for key in () if changes.get("type") is None else ("fov",):
        shapes["eye"].pop(key)
    text = refusal(shapes, camera=False)
    assert message in text and text.startswith("mitsuba.inline.eye")
    assert re.search("use |add |remove|give |put ", text)
    if changes.get("type") in (None, "orthographic", "thinlens"):
        if changes.get("type") == "thinlens":
            shapes["eye"]["fov"] = 30
        assert exact_flux(mitsuba_scene(shapes, depth=2), mono(COLS, ROWS), 2).min() > 0


# ---- one CPU -----------------------------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs CPU affinity")
def test_an_environment_map_is_read_on_one_cpu(tmp_path):
    """In a process of one CPU Mitsuba's pool has one thread, in which reading an EXR file waits for itself."""
    import OpenEXR

    pixels = {"RGB": np.full((8, 16, 3), 0.5, np.float32)}
    with OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, pixels) as file:
        file.write(str(tmp_path / "sky.exr"))
    code = f"""
import json
import os
os.sched_setaffinity(0, {{min(os.sched_getaffinity(0))}})
from hesim_render.sources.render.scene.mitsuba_version import mitsuba
from hesim_render.sources.render.scene.builder import build
from hesim_render.sources.scene import Scene
shapes = {{"sky": {{"type": "envmap", "filename": r"{tmp_path / "sky.exr"}"}}}}
print(len(build(mitsuba(), Scene.from_mitsuba(shapes).spec).scene.emitters()))
import drjit
print(drjit.thread_count())
"""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=180)
    # afterwards it renders in as many threads as it was given
    assert child.stdout.split() == ["1", "1"], child.stderr


def test_files_of_an_inline_scene_lie_beside_the_scene_file(tmp_path, monkeypatch):
    """Wherever the program was started; and no file outside is found by its name."""
    from PIL import Image

    folder, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(folder / "mine.png")
    Image.fromarray(np.full((4, 4, 3), 128, np.uint8)).save(elsewhere / "theirs.png")
    monkeypatch.chdir(elsewhere)

    def scene(name):
        wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": name}}}
        content = {
            "schema_version": 1, "name": "inline", "description": "",
            "mitsuba": {"inline": {"wall": wall, "sky": {"type": "constant"}}},
            "camera": {"origin_m": [0, 0, 3]},
        }  # fmt: skip
        (folder / "scene.yaml").write_text(json.dumps(content))
        return hr.load_scene(folder / "scene.yaml")

    sensor = hr.load_sensor("reference-mono").crop(16, 12)
    assert np.allclose(hr.SceneTruth(scene("mine.png"), sensor).depth(0), 3)
    for name in ("theirs.png", "../elsewhere/theirs.png"):
        with pytest.raises(SpecError):
            hr.SceneTruth(scene(name), sensor).depth(0)


def test_a_sliding_camera_is_followed_by_half_of_the_least_distance_at_three_times():
    """m/s of the camera and of an object, over half the least depth and over that of the object's nearest corner."""
    shapes = {**FIELD, "camera": camera(fov=60)}
    scene = make_scene(mitsuba={"inline": shapes})
    view = place_camera(scene.spec, mono(64, 48), build(mitsuba(), scene.spec).mitsuba_sensor())
    keys = [{"t_us": 0}, {"t_us": 500_000, "translation_m": [0.3, 0.4, 0]}]
    slide = Trajectory(TrackSpec.model_validate({"object": "camera", "keyframes": keys}))
    rest = Trajectory(TrackSpec.model_validate({"object": "card", "keyframes": [{"t_us": 0}, {"t_us": 1}]}))
    pose = view.camera_to_world
    # corners 3 and 3.5 m in front of the camera, where it stands at rest
    corners = pose[:3, 3] - 3.0 * pose[:3, 2] + np.array([[0.1, 0.2, 0.0], [-0.3, 0.1, 0.0]]) @ pose[:3, :3].T
    corners = np.concatenate([corners, corners - 0.5 * pose[:3, 2]])
    clock = MotionClock(view, slide, [SimpleNamespace(corners=corners, trajectory=rest)], lambda t: 4.0 - 1e-6 * t)
    half = np.tan(np.radians(30))
    stretch = np.sqrt(1 + half**2 + (half * 48 / 64) ** 2)
    span_us = BLOCK_INTERVALS * CELL_US
    resting, (own,) = clock._per_metre(2)
    assert resting == pytest.approx(stretch / (0.5 * (4.0 - 1e-6 * 3 * span_us)), rel=1e-6)
    # between the three times the camera may come nearer by what it moves in a quarter of the interval, at 1 m/s
    depth = 3.0 - 0.25e-6 * span_us
    assert own == pytest.approx(stretch / depth, rel=1e-6)
    # an interval over two sixteens of cells has the larger bound of both, which is that of the later one
    fastest = max(resting, own)
    px_per_m = clock._px_per_rad
    assert clock.motion_px(2.5 * span_us, 2.75 * span_us) == pytest.approx(0.25e-6 * span_us * fastest * px_per_m)
    assert clock.motion_px(1.75 * span_us, 2.25 * span_us) == pytest.approx(0.5e-6 * span_us * fastest * px_per_m)
    # where the camera comes nearer to an object, the later bound is the larger one as well
    ahead = [{"t_us": 0}, {"t_us": 500_000, "translation_m": (-0.5 * pose[:3, 2]).tolist()}]
    nearer = Trajectory(TrackSpec.model_validate({"object": "camera", "keyframes": ahead}))
    closer = MotionClock(view, nearer, clock._groups, lambda t: 40.0)
    (early,), (late,) = closer._per_metre(1)[1], closer._per_metre(2)[1]
    assert late > 1.003 * early
    assert closer.motion_px(1.75 * span_us, 2.25 * span_us) == pytest.approx(0.5e-6 * span_us * late * px_per_m)
    # windows within which nothing moves by more than a pixel: of 0.12 to 0.51 pixels each
    for each_px, windows in ((0.12, 4), (0.24, 4), (0.26, 2), (0.49, 2), (0.51, 1)):
        long_us = 0.25 * span_us, 9.5 * span_us
        assert clock.windows_of_a_pixel(*long_us, clock.motion_px(*long_us) / each_px) == windows

"""Pixels that share the second vertices of their paths: no bias, the same bits for any list of pixels, fewer rays."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy import stats

import hesim_render as hr
from hesim_render.core.journal import Journal
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.anchor import Anchor
from hesim_render.sources.render.change_driven.differences import Differences, differences
from hesim_render.sources.render.change_driven.estimates import Band, Counts
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PairFlux
from hesim_render.sources.render.change_driven.pilot import Change, Pilot, Refinement
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.shared_tracer import SIDE, SharedTracer, Tiles
from hesim_render.sources.render.change_driven.sharing import Sharing
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import RenderedFlux

CAMERA = """<sensor type="perspective"><float name="fov" value="61"/>
    <transform name="to_world"><lookat origin="0.1, 0.55, 1.85" target="-0.05, 0.3, 0" up="0, 1, 0"/></transform>
    </sensor>"""
WALLS = """<shape type="rectangle" id="floor">
      <transform name="to_world"><rotate x="1" angle="-90"/><scale x="1.4" z="1.4"/></transform>
      <bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
      <rgb name="color0" value="0.71, 0.55, 0.4"/><rgb name="color1" value="0.21, 0.3, 0.45"/>
      <transform name="to_uv"><scale x="9" y="9"/></transform></texture></bsdf></shape>
    <shape type="rectangle" id="back"><transform name="to_world"><scale value="1.4"/><translate z="-0.7"/></transform>
      <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.63, 0.31"/></bsdf></bsdf></shape>
    <shape type="rectangle" id="left"><transform name="to_world"><rotate y="1" angle="90"/><scale value="1.4"/>
      <translate x="-0.8"/></transform>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.62, 0.2, 0.17"/></bsdf></shape>
    <shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><scale x="0.3" y="0.2"/>
      <translate x="0.35" y="1.3" z="0.2"/></transform>
      <emitter type="area"><rgb name="radiance" value="9, 7.5, 5"/></emitter></shape>
    <emitter type="constant"><rgb name="radiance" value="0.11, 0.14, 0.2"/></emitter>"""
#: A box that moves, and balls that reflect, refract and shine; the last one has bumps.
THINGS = """<shape type="cube" id="box"><transform name="to_world"><scale value="0.16"/><rotate y="1" angle="23"/>
      <translate x="-0.35" y="0.17" z="0.1"/></transform>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.58, 0.66"/></bsdf></shape>
    <shape type="sphere" id="shiny"><point name="center" x="0.1" y="0.2" z="0.35"/><float name="radius" value="0.2"/>
      <bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.5, 0.4, 0.2"/>
      <float name="alpha" value="0.2"/></bsdf></shape>
    <shape type="sphere" id="glass"><point name="center" x="0.5" y="0.22" z="0.1"/><float name="radius" value="0.22"/>
      <bsdf type="dielectric"/></shape>
    <shape type="sphere" id="bumpy"><point name="center" x="0.3" y="0.75" z="-0.3"/><float name="radius" value="0.25"/>
      <bsdf type="bumpmap"><texture name="arbitrary" type="bitmap"><string name="filename" value="bumps.png"/>
      <boolean name="raw" value="true"/></texture><float name="scale" value="0.2"/>
      <bsdf type="diffuse"><rgb name="reflectance" value="0.55, 0.6, 0.65"/></bsdf></bsdf></shape>"""
MOTION = """motion:
- object: box
  keyframes: [{t_us: 0, translation_m: [0, 0, 0]}, {t_us: 100000, translation_m: [0.4, 0.1, 0.07]}]
"""


@pytest.fixture
def scene_of(tmp_path):
    """Makes a scene of Mitsuba XML."""

    def make(shapes, depth=6, motion="", camera=CAMERA):
        integrator = f'<integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>'
        (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{integrator}{camera}{shapes}</scene>')
        head = (
            "schema_version: 1\nname: of-xml\ndescription: A test.\nmitsuba: {file: scene.xml, radiance_scale: 0.7}\n"
        )
        (tmp_path / "scene.yaml").write_text(head + motion)
        bumps = np.random.default_rng(1).integers(0, 256, (16, 16), np.uint8)
        Image.fromarray(bumps).save(tmp_path / "bumps.png")
        return hr.load_scene(str(tmp_path / "scene.yaml"))

    return make


def source_of(scene, sensor="davis346", crop=(13, 9, 166, 121), **given):
    return ChangeDrivenFlux(scene, hr.load_sensor(sensor).crop(*crop), seed=given.pop("seed", 11), **given)


def parts_of(source):
    """Tracer, pixels on the full sensor and lattice of the event pixels."""
    return source._tracer, source._index[source.sensor.layout.evs_pixel.ravel()], source._renderer.sharing.lattice


def both_of(source, rays, repeats, window_us=(31_000.0, 31_900.0)):
    """Means of pixels that share, and of the same paths alone, [repeat, pixel]."""
    tracer, pixel, lattice = parts_of(source)
    windows = Windows(*(np.array([time]) for time in window_us))
    given = (
        pixel,
        np.zeros(pixel.size, np.int64),
        windows,
        np.full(pixel.size, rays),
        Tiles(lattice),
        Stream.RENDER,
        None,
    )
    values = [[flux.mean for flux in tracer._of_tiles(*given, repeat)] for repeat in range(repeats)]
    return np.array(values, np.float64).transpose(1, 0, 2)


# ---- tiles -----------------------------------------------------------------------------------------


def test_tiles_cover_a_lattice():
    """A lattice of 11×18 pixels at every third row and second column: each tile has 16 different pixels of it."""
    lattice = Lattice(11, 18, (2, 1), (3, 2), 40)
    tiles, (row, col) = Tiles(lattice), np.indices((11, 18)).reshape(2, -1)
    pixel = lattice.index(row, col)
    tile, member = tiles.of(pixel)
    members = tiles.pixels(tile)
    np.testing.assert_array_equal(members[np.arange(pixel.size), member], pixel)
    assert np.isin(members, pixel).all() and all(np.unique(one).size == SIDE**2 for one in members)
    # of a whole tile all pixels are its own; those at the far edges begin earlier
    assert np.unique(tile).size == 15 and np.count_nonzero(tile == 6) == 16
    row, col = np.indices((4, 4)).reshape(2, -1)
    np.testing.assert_array_equal(tiles.pixels(np.array([14]))[0], lattice.index(row + 7, col + 14))


# ---- no bias ---------------------------------------------------------------------------------------


def test_in_a_furnace_all_light_is_there(scene_of):
    """A closed box whose walls shine and reflect 0.55 of all light: L·(1 + 0.55 + … + 0.55⁴), whatever a pixel sees."""
    camera = CAMERA.replace("0.1, 0.55, 1.85", "0.1, 0.55, 0.6")

    def box(reflectance):
        return f"""<shape type="cube"><transform name="to_world"><scale x="0.9" y="1.2" z="0.8"/></transform>
            <boolean name="flip_normals" value="true"/>
            <bsdf type="diffuse"><spectrum name="reflectance" value="{reflectance}"/></bsdf>
            <emitter type="area"><spectrum name="radiance" value="0.3"/></emitter></shape>"""

    black, grey = (source_of(scene_of(box(value), 5, camera=camera)) for value in (0.0, 0.55))
    (_, own), (shared, alone) = both_of(black, 64, 1), both_of(grey, 64, 24)
    expected = own[0] * (1 + 0.55 + 0.55**2 + 0.55**3 + 0.55**4)
    # the mean over tiles, which are independent
    tile = np.unique(Tiles(parts_of(grey)[2]).of(parts_of(grey)[1])[0], return_inverse=True)[1]
    for values in (shared, alone):
        ratio = np.array([np.bincount(tile, one / expected) / np.bincount(tile) for one in values])
        error = ratio.mean() - 1
        assert abs(error) < 4 * ratio.std(ddof=1) / ratio.size**0.5 and ratio.std() / ratio.size**0.5 < 2e-3
    assert shared.std(axis=0).mean() < 0.8 * alone.std(axis=0).mean()


@pytest.mark.parametrize("with_things", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_shared_light_has_no_bias(scene_of, with_things):
    """Against the same number of paths that share nothing, while a box moves by two pixels within the window."""
    source = source_of(scene_of(WALLS + (THINGS if with_things else ""), motion=MOTION if with_things else ""))
    shared, _ = both_of(source, 64, 24)
    tracer, pixel, _ = parts_of(source)
    windows = Windows(np.array([31_000.0]), np.array([31_900.0]))
    given = pixel, np.zeros(pixel.size, np.int64), windows, np.full(pixel.size, 1024), np.zeros(pixel.size, np.bool_)
    alone = np.array([tracer.trace(*given, stream=Stream.AUDIT, repeat=k).mean for k in range(8)], np.float64)
    error = shared.mean(axis=0) - alone.mean(axis=0)
    spread = np.sqrt(shared.var(axis=0, ddof=1) / 24 + alone.var(axis=0, ddof=1) / 8)
    z = error / spread
    # pixels of a tile are off together; a z of 8 degrees of freedom has more than one sixth above 1
    assert np.sqrt(np.mean(z**2)) < 1.5 and np.abs(z).max() < 6
    total = np.array([one.sum() for one in shared]), np.array([one.sum() for one in alone])
    assert abs(total[0].mean() - total[1].mean()) < 4 * np.hypot(total[0].std() / 24**0.5, total[1].std() / 8**0.5)
    assert total[0].std() / 24**0.5 < 2e-3 * total[0].mean()


@pytest.mark.slow
@pytest.mark.parametrize(("turn_deg", "x", "lies"), [(-90, -0.05, False), (90, -0.5, False), (-90, -0.05, True)])
def test_no_light_is_shared_through_a_wall(scene_of, turn_deg, x, lies):
    """A floor from above, and a sheet that stands on it, edge-on, in the middle of a tile. A lamp on one side shines at
    a board there, or at the sheet, from which light comes to the floor on that side, and little to the other. Or the
    sheet lies above the floor, and gets no light from what is below it.
    """
    camera = CAMERA.replace("0.1, 0.55, 1.85", "0, 0.6, 0").replace("-0.05, 0.3, 0", "0, 0, 0")
    camera = camera.replace("0, 1, 0", "0, 0, -1")

    def upright(x, height, width):
        grey = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.55, 0.5"/></bsdf>'
        place = f'<scale y="{height / 2}" z="{width / 2}"/><translate x="{x}" y="{height / 2}"/>'
        place = f'<transform name="to_world"><rotate y="1" angle="90"/>{place}</transform>'
        return f'<shape type="rectangle">{place}<bsdf type="twosided">{grey}</bsdf></shape>'

    turned = f'<transform name="to_world"><rotate y="1" angle="{turn_deg}"/><scale y="0.05" z="0.1"/>'
    shines = '<emitter type="area"><rgb name="radiance" value="7, 6, 5"/></emitter></shape>'
    height = 0.08 if lies else 0.35
    lamp = f'<shape type="rectangle">{turned}<translate x="{x}" y="{height}"/></transform>{shines}'
    sheet = upright(0.011, 0.45, 1.1)
    if lies:
        sheet = sheet.replace(
            '<translate x="0.011" y="0.225"/>', '<rotate z="1" angle="-90"/><translate x="0.236" y="0.2"/>'
        )
        assert "rotate z" in sheet
    things = sheet + upright(-0.6, 0.7, 0.9) + lamp
    floor = WALLS[: WALLS.index('<shape type="rectangle" id="back">')]
    source = source_of(scene_of(floor + things, camera=camera), crop=(13, 9, 164, 121))
    shared, alone = (each.reshape(40, 9, 13) for each in both_of(source, 128, 40))
    dark, light = ([each[:, :, part].mean(axis=(1, 2)) for each in (shared, alone)] for part in (np.s_[7:], np.s_[4:6]))
    assert lies or dark[1].mean() < 0.5 * light[1].mean()
    for one, other in (dark, light):
        spread = np.hypot(one.std(ddof=1), other.std(ddof=1)) / 40**0.5
        assert abs(one.mean() - other.mean()) < 4 * spread and spread < 0.03 * other.mean()


def test_paths_of_a_group_have_the_same_wavelengths(scene_of):
    """Floor and wall reflect every other stretch of 12 nm: what both reflect is not the product of their means."""
    comb = ", ".join(f"{nm}:{0.9 * (k // 2 % 2)}" for k, nm in enumerate(np.arange(360, 830, 6)))
    grey = f'<bsdf type="diffuse"><spectrum name="reflectance" value="{comb}"/></bsdf>'
    shapes = [part.split("<bsdf")[0] + grey for part in WALLS.split("</shape>")[:2]]
    lamp = '<shape type="rectangle"><transform name="to_world"><scale x="0.3" y="0.2"/><translate y="0.6" z="0.1"/>'
    lamp += (
        '<rotate y="1" angle="180"/></transform><emitter type="area"><rgb name="radiance" value="9, 9, 9"/></emitter>'
    )
    camera = CAMERA.replace("-0.05, 0.3, 0", "-0.05, -0.4, 0.2")
    source = source_of(scene_of("</shape>".join([*shapes, lamp, ""]), camera=camera))
    shared, alone = (each.mean(axis=1) for each in both_of(source, 64, 40))
    spread = np.hypot(shared.std(ddof=1), alone.std(ddof=1)) / 40**0.5
    assert abs(shared.mean() - alone.mean()) < 4 * spread and spread < 0.01 * alone.mean()


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["roughplastic", "bumpmap"])
def test_what_is_not_diffuse_keeps_its_own_light(scene_of, surface):
    """A wall before all others, and a floor that bounces light back to it."""
    bumpy = THINGS[THINGS.index('<bsdf type="bumpmap">') : THINGS.rindex("</shape>")]
    bsdf = bumpy if surface == "bumpmap" else '<bsdf type="roughplastic"><float name="alpha" value="0.3"/></bsdf>'
    place = '<transform name="to_world"><scale value="5"/><translate z="0.9"/></transform>'
    source = source_of(scene_of(f'{WALLS}<shape type="rectangle">{place}{bsdf}</shape>'))
    shared, alone = both_of(source, 32, 1)
    # pixels at the rim see others
    shared, alone = (values.reshape(9, 13)[1:6, 3:10] for values in (shared, alone))
    assert np.all(alone > 0)
    np.testing.assert_allclose(shared, alone, rtol=1e-6)


def test_light_from_metal_is_not_shared(scene_of):
    """A floor whose paths meet rough metal or nothing."""
    floor, sky = (
        WALLS[: WALLS.index('<shape type="rectangle" id="back">')],
        WALLS[WALLS.index('<emitter type="constant">') :],
    )
    place = '<transform name="to_world"><scale value="3"/><translate z="-0.7"/></transform>'
    metal = (
        f'<shape type="rectangle">{place}<bsdf type="roughconductor"><float name="alpha" value="0.3"/></bsdf></shape>'
    )
    camera = (
        CAMERA.replace("0.1, 0.55, 1.85", "0, 0.8, 0")
        .replace("-0.05, 0.3, 0", "0, 0, 0")
        .replace("0, 1, 0", "0, 0, -1")
    )
    shared, alone = both_of(source_of(scene_of(floor + metal + sky, camera=camera)), 32, 1)
    assert np.all(alone > 0)
    np.testing.assert_allclose(shared, alone, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["room", "cornell-box"])
def test_a_closed_room_has_the_flux_of_mitsubas_integrators(name):
    """Welch's test of 24 parts of 4×4 pixels, each of which cuts tiles, and their sum; eight seeds of either mode."""
    file = str(Path(__file__).parents[3] / "benchmarks" / "scenes" / "room.yaml")
    scene, sensor = hr.load_scene(file if name == "room" else name), hr.load_sensor("davis346").crop(24, 16, 150, 118)
    own, other = [], []
    for seed in range(8):
        source = ChangeDrivenFlux(scene, sensor, seed=500 + seed)
        blocks = list(source.sample_blocks(1, 0, 5000))
        samples = list(source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks))
        own.append(0.5 * (np.array(samples[-1].half_a, np.float64) + np.array(samples[-1].half_b)))
        begin_us, end_us = (times[blocks[-1].wanted][-1] for times in (blocks[-1].begin_us, blocks[-1].end_us))
        exact = RenderedFlux(scene, sensor, 512, 900 + seed, max_motion_px=0.02)
        halves = exact.mean_flux(source.sensor.layout.evs_pixel.ravel(), begin_us, end_us)
        other.append(0.5 * (np.array(halves[0], np.float64) + np.array(halves[1])))
    assert sum(rays > 0 for rays, _ in source._renderer.sharing._known.values()) >= 10
    parts = [np.array(each).reshape(8, 4, 4, 6, 4).sum(axis=(2, 4)).reshape(8, 24) for each in (own, other)]
    p = stats.ttest_ind(*parts, equal_var=False).pvalue
    assert p.min() > 1e-3 / 24 and stats.kstest(p, "uniform").pvalue > 1e-3
    sums = [each.sum(axis=1) for each in parts]
    assert stats.ttest_ind(*sums, equal_var=False).pvalue > 1e-3
    assert max(each.std(ddof=1) / each.mean() for each in sums) / 8**0.5 < 1e-3


# ---- purity ----------------------------------------------------------------------------------------


def test_a_pixel_has_the_same_bits_whichever_others_are_asked_for(scene_of):
    source = source_of(scene_of(WALLS + THINGS, motion=MOTION))
    tracer, pixel, lattice = parts_of(source)
    windows = Windows(np.array([31_000.0, 56_000]), np.array([31_900.0, 57_100]))
    window, rays = np.arange(pixel.size) % 2, np.where(np.arange(pixel.size) % 3 > 0, 64, 16)
    whole = tracer.shared(pixel, window, windows, rays, lattice)
    some = np.random.default_rng(2).permutation(pixel.size)[:31]
    tracer._block_rays = 700
    part = tracer.shared(pixel[some], window[some], windows, rays[some], lattice)
    for name in ("half_a", "half_b", "met"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[some])
    assert np.all(whole.half_a != whole.half_b)


def test_an_interrupted_run_takes_its_tiles_from_the_journal(scene_of, tmp_path):
    """Two windows and numbers of rays; the second time nothing is traced."""
    scene = scene_of(WALLS + THINGS.split('<shape type="sphere" id="shiny">')[0], motion=MOTION)
    windows, values = Windows(np.array([31_000.0, 56_000]), np.array([31_900.0, 57_100])), []
    for again in (False, True):
        with pytest.raises(KeyboardInterrupt), Journal(tmp_path / "out", {}, after_s=0.0) as journal:
            source = source_of(scene)
            source.go_on(journal, 3)
            tracer, pixel, lattice = parts_of(source)
            tracer._block_rays = 9000
            for window, rays in ((0, 16), (1, 16), (1, 64)):
                of = pixel, np.full(pixel.size, window), windows, np.full(pixel.size, rays), lattice
                values.append(tracer.shared(*of))
            assert (tracer.traces == 0) == again
            raise KeyboardInterrupt
    for one, other in zip(values[:3], values[3:], strict=True):
        for name in ("half_a", "half_b", "met"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert len({one.half_a.tobytes() for one in values}) == 3


def test_a_tile_meets_what_any_of_its_paths_meets(scene_of):
    source = source_of(scene_of(WALLS + THINGS.split('<shape type="sphere" id="shiny">')[0], motion=MOTION))
    tracer, pixel, lattice = parts_of(source)
    windows = Windows(np.array([31_000.0]), np.array([31_900.0]))
    met = tracer.shared(pixel, 0 * pixel.astype(np.int64), windows, np.full(pixel.size, 8), lattice).met
    for tile in np.unique(Tiles(lattice).of(pixel)[0]):
        assert np.unique(met[Tiles(lattice).of(pixel)[0] == tile]).size == 1
    assert met.any()
    still = source_of(scene_of(WALLS))
    tracer, pixel, lattice = parts_of(still)
    assert not tracer.shared(pixel, 0 * pixel.astype(np.int64), windows, np.full(pixel.size, 8), lattice).met.any()


def test_shadow_rays_of_lamps_and_paths_that_end_count_for_a_tile(scene_of):
    """A floor below the sky, and a small lamp before which a small box moves: few other rays come near it."""
    camera = CAMERA.replace("0.1, 0.55, 1.85", "0, 0.6, 0").replace("-0.05, 0.3, 0", "0, 0, 0")
    camera = camera.replace("0, 1, 0", "0, 0, -1")
    floor = WALLS[: WALLS.index('<shape type="rectangle" id="back">')]
    lamp = WALLS[WALLS.index('<shape type="rectangle" id="lamp">') :].replace('x="0.3" y="0.2"', 'x="0.004" y="0.003"')
    box = THINGS.split('<shape type="sphere" id="shiny">')[0].replace('scale value="0.16"', 'scale value="0.02"')
    box = box.replace('x="-0.35" y="0.17" z="0.1"', 'x="0.35" y="1.26" z="0.2"')
    motion = MOTION.replace("[0.4, 0.1, 0.07]", "[0.004, 0, 0.002]")
    tracer, pixel, lattice = parts_of(source_of(scene_of(floor + box + lamp, motion=motion, camera=camera)))
    windows = Windows(np.array([31_000.0]), np.array([31_900.0]))
    assert tracer.shared(pixel, 0 * pixel.astype(np.int64), windows, np.full(pixel.size, 8), lattice).met.all()


@pytest.mark.slow
def test_runs_have_the_same_values_for_crops_and_splits(scene_of):
    """Over an anchor at 64 ms, of the whole region and of a part of it that cuts tiles."""
    camera = "camera: {focal_length_mm: 6.1}\n"
    scene = scene_of(WALLS + THINGS.split('<shape type="sphere" id="shiny">')[0], motion=MOTION + camera)

    def run(begin_us, end_us, crop):
        source = source_of(scene, crop=crop, quality=0.3)
        blocks = list(source.sample_blocks(1, begin_us, end_us))
        ends_us = np.concatenate([block.end_us[block.wanted] for block in blocks])
        flux = source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks)
        values = np.array([(np.array(one.half_a), np.array(one.half_b)) for one in flux])
        return source, ends_us[1:], values[1:].reshape(-1, 2, crop[1], crop[0])

    source, ends_us, whole = run(62_500, 65_200, (13, 9, 166, 121))
    assert sum(rays > 0 for rays, _ in source._renderer.sharing._known.values()) >= 6
    _, later_us, later = run(64_000, 65_200, (13, 9, 166, 121))
    np.testing.assert_array_equal(later, whole[np.isin(ends_us, later_us)])
    _, _, part = run(62_500, 65_200, (6, 5, 169, 123))
    np.testing.assert_array_equal(part, whole[:, :, 2:7, 3:9])


# ---- where it pays ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sensor", "depth", "more", "may"),
    [
        ("davis346", 6, "", True),
        ("davis346", 3, "", True),
        ("davis346", 2, "", False),
        # event pixels of four filters
        ("reference-bayer", 6, "", False),
        # a mirror, to the image of whose lamp some paths are sent
        (
            "davis346", 6,
            '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="-90"/><translate x="1.3"/>'
            '</transform><bsdf type="conductor"/></shape>', False,
        ),
    ],
)  # fmt: skip
def test_which_sensors_and_scenes_may_share(scene_of, sensor, depth, more, may):
    source = source_of(scene_of(WALLS + more, depth), sensor, (14, 10, 166, 122))
    assert (source._renderer.sharing.lattice is not None) == may


def test_pixels_of_several_filters_do_not_share():
    """A tile of four by six filters, of which every second row and third column is the lattice."""
    filters = np.arange(24, dtype=np.uint8).reshape(4, 6)
    filters[1::2, 2::3] = 7
    tracer = SimpleNamespace(sensor=SimpleNamespace(layout=SimpleNamespace(tile_shape=(4, 6), filter_index=filters)))
    lattice = Lattice(20, 30, (1, 2), (2, 3), 90)
    assert SharedTracer._has_one_filter(tracer, lattice)
    filters[3, 5] = 9
    assert not SharedTracer._has_one_filter(tracer, lattice)


def plan_of(rays):
    """The plan of an anchor of 40 pixels in a row."""
    shape = 1, rays.size
    zero, none = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
    return Plan(
        *(~none, rays[None].astype(np.int16), none, zero + 7, zero + 3, zero.astype(np.int16)),
        *(Differences.none(*shape), none, none, none, zero),
    )


def test_pixels_share_where_a_trial_says_so():
    """Tiles of a lattice of 5×40 pixels, of which the last row asks; in noise units of 4, and wanted errors of 1.2."""
    lattice, tried = Lattice(5, 40, (0, 0), (1, 1), 40), []
    # variance alone over that of shared paths, and the latter, of each of the ten tiles
    gain = np.array([1.0, 2.4, 2.6, 9.0, 9.0, 9.0, 9.0, 2.6, 9.0, 9.0])
    square = np.array([90.0, 90, 90, 90, 360, 1e6, 0.1, 90, 90, 0])  # the last one is dark

    class Tracer:
        sensor = SimpleNamespace(spec=SimpleNamespace(evs=True))
        rays_done = 0

        def may_share(self, given):
            return given is lattice

        def trial(self, tile, given):
            assert given is lattice and np.all(tile >= 10)
            tried.extend(tile.tolist())
            self.rays_done += 1000 * tile.size
            spread = np.linspace(0.5, 1.5, 16)  # over the pixels of a tile
            both = np.stack([square, square * gain])[:, tile - 10, None] * spread
            return np.full((tile.size, 16), 250.0), both

    noise = SimpleNamespace(
        lattice=lambda role: lattice, of=lambda role, index: lambda flux: 0 * flux + np.float32(4.0)
    )
    sharing, counts = Sharing(Tracer(), noise, 0.3, TUNING), Counts()
    rays = np.full(40, 2048)
    # pixels of two tiles ask for too little
    rays[:4], rays[33:36] = 256, 64
    sites = Sites.alone(np.arange(160, 200, dtype=np.uint32))
    band = Band(np.arange(40), sites, None, False, 16, 0.3, False)
    what = sharing.planned(plan_of(rays), band, counts)
    assert tried == list(range(11, 20)) and counts.pilot_rays == 9000
    own = np.repeat(np.arange(10), 4)
    pays = (gain[own] >= TUNING.least_sharing_gain) & (rays >= TUNING.least_shared_rays) & (square[own] > 0)
    np.testing.assert_array_equal(what.shared[0], pays)
    # the law of errors from 16 rays on, twice the rays for a knot
    needed = 2 * 16 * (np.sqrt(square[own]) / 1.2) ** (1 / 0.56)
    expected = 2 ** np.rint(np.log2(np.clip(needed, 64, 4096)))
    np.testing.assert_array_equal(what.rays[0], np.where(pays, expected, rays))
    left = np.sqrt(square[own]) * (expected / 16) ** -0.56
    np.testing.assert_allclose(what.error[0], np.where(pays, left, 7), rtol=1e-5)
    # what is known is not tried again
    again = sharing.planned(plan_of(rays), band, counts)
    np.testing.assert_array_equal(again.rays, what.rays)
    assert len(tried) == 9


def test_aimed_pairs_do_not_share():
    lattice = Lattice(8, 8, (0, 0), (1, 1), 8)
    tracer = SimpleNamespace(
        sensor=SimpleNamespace(spec=SimpleNamespace(evs=True)), rays_done=0, may_share=lambda given: True,
        trial=lambda tile, given: (np.full((tile.size, 16), 250.0), np.full((2, tile.size, 16), [[[40.0]], [[400.0]]])),
    )  # fmt: skip
    noise = SimpleNamespace(
        lattice=lambda role: lattice, of=lambda role, index: lambda flux: 0 * flux + np.float32(4.0)
    )
    sites = Sites.alone(np.arange(8, dtype=np.uint32))
    aimed = np.array([2, 5])
    what = plan_of(np.full(8, 1024))
    what = replace(what, aims=SimpleNamespace(at=lambda window, site: SimpleNamespace(count=np.isin(site, aimed) * 3)))
    band = Band(np.arange(8), sites, None, False, 16, 0.3, False)
    shared = Sharing(tracer, noise, 0.3, TUNING).planned(what, band, Counts()).shared[0]
    np.testing.assert_array_equal(shared, ~np.isin(np.arange(8), aimed))


def test_pairs_with_known_lines_have_rays_of_their_own():
    """Of seven pairs, four are to share, one of them holds a line; each result is put where it belongs."""
    asked = {}

    def shared(pixel, window, windows, rays, lattice, *, span_us):
        asked["shared"] = pixel.tolist(), window.tolist(), rays.tolist(), span_us
        return PairFlux(100.0 + pixel, 200.0 + pixel, pixel > 40)

    def trace(pixel, window, windows, rays, controlled, **more):
        asked["alone"] = pixel.tolist(), window.tolist(), rays.tolist(), controlled.tolist(), more
        return PairFlux(300.0 + pixel, 400.0 + pixel, pixel > 40)

    sharing = Sharing.__new__(Sharing)
    sharing.lattice, sharing._tracer = object(), SimpleNamespace(shared=shared, trace=trace)
    pixel, rays = np.arange(38, 45, dtype=np.uint32), 8 * np.arange(2, 9)
    lines = np.array([0, 0, 0, 1, 0, 1, 0], np.bool_)

    class Part:
        def __init__(self, of):
            self.of, self.is_there = of, lines[of]

        def part(self, place):
            return Part(self.of[place])

    pairs = pixel, np.arange(7) % 2, "windows", rays, np.arange(7) > 3
    to_share, shadows = np.array([1, 0, 0, 1, 1, 0, 1], np.bool_), np.arange(7, dtype=np.uint32)
    every = np.arange(7)
    flux = sharing.trace(pairs, to_share, (3.0, 5.0), Part(every), Part(every), shadows)
    alone = [1, 2, 3, 5]
    assert asked["shared"] == ([38, 42, 44], [0, 0, 0], [16, 48, 64], (3.0, 5.0))
    assert asked["alone"][:4] == (
        pixel[alone].tolist(),
        [1, 0, 1, 1],
        rays[alone].tolist(),
        [False, False, False, True],
    )
    more = asked["alone"][4]
    assert more["aims"].of.tolist() == more["edges"].of.tolist() == more["shadows"].tolist() == alone
    assert more["span_us"] == (3.0, 5.0)
    is_alone = np.isin(every, alone)
    np.testing.assert_array_equal(flux.half_a, pixel + np.where(is_alone, 300, 100))
    np.testing.assert_array_equal(flux.half_b, pixel + np.where(is_alone, 400, 200))
    np.testing.assert_array_equal(flux.met, pixel > 40)


# ---- differences to what has little noise ------------------------------------------------------------


def test_pairs_are_linked_where_their_differences_have_less_noise():
    """Six windows of 20 pixels that lie apart: pairs of 256 rays by themselves, or of 64 as differences."""
    sites, shape = Sites.alone(np.arange(20, dtype=np.uint32)), (6, 20)
    zero = np.zeros(shape, np.float32)
    scatter = zero + np.linspace(30, 600, 20, dtype=np.float32)
    change = Change(zero, zero, scatter, scatter)
    pilot = Pilot(zero, zero, zero, zero, zero, change=change)
    units, rendered = np.full(shape, 11.0, np.float32), np.ones(shape, np.bool_)
    rendered[3, 4:] = False
    alone, error = np.full(shape, 256, np.int16), np.full(shape, 25.0, np.float32)
    first, last = np.arange(20) % 5 > 0, np.arange(20) % 3 > 0
    refined = [Refinement(*(np.empty(0, kind) for kind in (int, int, np.float32, np.float32))) for _ in range(6)]
    refined[2] = Refinement(np.array([11]), np.array([256]), np.zeros(1, np.float32), np.zeros(1, np.float32))
    given = replace(pilot, refined=refined), sites, units, 0.6, rendered, alone, TUNING
    plain, linked = differences(*given), differences(*given, error, (first, last))
    assert not plain.linked.any()
    np.testing.assert_array_equal(plain.rays, linked.rays)
    # 0.95·s/16 is below the error alone
    of_all = 0.95 * scatter / 16
    shares = np.where(np.arange(6)[:, None] < 5, first, first & last)
    expected = rendered & (linked.rays == 0) & shares & (of_all < 25)
    expected[2, 11] = False
    np.testing.assert_array_equal(linked.linked, expected)
    np.testing.assert_allclose(linked.error[expected], of_all[expected], rtol=1e-5)
    assert 20 < np.count_nonzero(expected) < 70
    np.testing.assert_array_equal(linked.first().linked, expected[:1])


def test_what_a_linked_pair_becomes():
    """Of five rendered pairs in two windows, three are linked, and one of these holds a line."""
    anchor, todo = Anchor.__new__(Anchor), np.array([[True, True, False], [True, True, True]])
    linked = np.array([[True, False, True], [True, False, True]])
    chosen = SimpleNamespace(linked=linked, error=np.array([[3.0, 0, 0], [5, 0, 8]], np.float32))
    controlled = np.array([[True, False, False], [False, False, True]])
    what = SimpleNamespace(error=np.arange(20.0, 26).reshape(2, 3), differences=chosen, controlled=controlled)
    given = []

    def compared(windows, first, pairs, now):
        given.extend([windows, first, *(values.tolist() for values in pairs), now.half_a.tolist()])
        return PairFlux(now.half_a + 1, now.half_b + 2, now.met), np.array([4.0, 6.0], np.float32)

    anchor.compared = compared
    flux = PairFlux(np.arange(5.0), np.arange(5.0), np.zeros(5, np.bool_))
    edges = SimpleNamespace(is_there=np.array([False, False, True, False, False]))
    error = anchor.link("windows", "first", what, todo, np.array([8, 16, 32, 64, 128]), edges, flux)
    # the first pair, and the last one: window 1, pixel 2
    assert given == ["windows", "first", [0, 1], [0, 2], [8, 128], [True, True], [0.0, 4.0]]
    np.testing.assert_allclose(error, [5, 21, 23, 24, 10])
    np.testing.assert_array_equal(flux.half_a, [1, 1, 2, 3, 5])
    np.testing.assert_array_equal(flux.half_b, [2, 1, 2, 3, 6])
    given.clear()
    chosen.linked[:] = False
    anchor.link("windows", "first", what, todo, np.array([8, 16, 32, 64, 128]), None, flux)
    assert given == []


@pytest.mark.slow
def test_linked_pairs_have_no_bias_and_the_noise_of_their_differences(scene_of):
    """A whole run with few rays of pairs by themselves, for thirty seeds, against paths that share nothing."""
    few = replace(TUNING, most_rays=512, least_shared_rays=32, least_sharing_gain=0.1, difference_gain=1e9)
    scene = scene_of(WALLS + THINGS.split('<shape type="sphere" id="shiny">')[0], motion=MOTION)
    runs, linked = [], []
    for seed in range(30):
        source = source_of(scene, crop=(9, 7, 166, 121), seed=seed, tuning=few)
        given = Anchor.link

        def counted(self, *all, given=given):
            linked.append(int(np.count_nonzero(all[2].differences.linked)))
            return given(self, *all)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Anchor, "link", counted)
            blocks = list(source.sample_blocks(1, 0, 5000))
            flux = source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks)
            runs.append([(np.array(one.half_a), np.array(one.half_b)) for one in flux])
    assert sum(linked) > 30 * 20
    ends_us = np.concatenate([block.end_us[block.wanted] for block in blocks])
    halves = np.array(runs, np.float64)  # [seed, window, half, pixel]
    tracer, pixel, _ = parts_of(source)
    windows, every = Windows(ends_us - 1, ends_us), np.arange(ends_us.size)
    index, window = np.tile(pixel, ends_us.size), np.repeat(every, pixel.size)
    given = index, window, windows, np.full(index.size, 4096), np.zeros(index.size, np.bool_)
    truth = np.mean([tracer.trace(*given, stream=Stream.AUDIT, repeat=k).mean for k in range(8)], axis=0)
    values, truth = halves.mean(axis=2), truth.reshape(ends_us.size, -1)
    total = (values / truth).mean(axis=(1, 2)) - 1
    assert abs(total.mean()) < 4 * total.std(ddof=1) / 30**0.5
    stated = 0.5 * (halves[:, :, 0] - halves[:, :, 1]) / truth
    assert np.sqrt(np.mean((values / truth - 1) ** 2)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.15)

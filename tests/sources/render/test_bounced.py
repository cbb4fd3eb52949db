"""Scenes of which some light has a closed form and some is found by paths: what decides their rays."""

from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from rendering import D65_1000_LUX, make_scene, mono, pair_tracer, traced

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.allocation import allocate, gain_of
from hesim_render.sources.render.change_driven.bends import straightened
from hesim_render.sources.render.change_driven.differences import Differences
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.plan import Plan, plan
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene import surfaces
from hesim_render.sources.render.transport.paths import PathIntegrator

WHERE = Windows(np.array([0.0]), np.array([400.0]))
BALL = {"name": "ball", "shape": "sphere", "size_m": [0.05] * 3, "position_m": [0.06, 0.03, 0.05],
        "material": {"type": "plastic", "diffuse_reflectance": 0.4}}  # fmt: skip


def turning(depth, ball=BALL):
    """A star that turns before a wall under a sky, with a ball of plastic."""
    wall = {"name": "wall", "shape": "rectangle", "size_m": [4, 4, 0], "position_m": [0, 0, -0.05], "reflectance": 0.18}
    ends = [{"t_us": 0}, {"t_us": 100_000, "rotation_axis": [0, 0, 1], "rotation_deg": 21}]
    return make_scene(
        target={"type": "siemens-star", "width_m": 0.2, "height_m": 0.2, "spokes": 9, "light": 0.7, "dark": 0.06},
        objects=[wall, ball], light=D65_1000_LUX, max_depth=depth,
        camera={"origin_m": [0, 0, 0.5], "target_m": [0.02, 0.01, 0], "horizontal_fov_deg": 30},
        motion=[{"object": "target", "keyframes": ends}],
    )  # fmt: skip


def test_paths_decide_where_the_rays_of_closed_forms_leave_too_much_of_what_they_find():
    """By hand: with ε = 2 and a scatter of 40, (0.68 · 20)^(1/0.7) = 41.6 rays leave 0.46 · 41.6^-0.56 = 0.0570 of the
    scatter of what paths find, which is half of the wanted error for 17.5.
    """
    own, paths = Gain(*TUNING.diffuse_gain), Gain(*TUNING.path_gain)
    bounced = np.array([0, 17.0, 18.0, 40.0], np.float32)
    wanted, needed = np.full(4, 2, np.float32), np.full(4, 20, np.float32)
    law, bounces = gain_of(bounced, needed, wanted, own, TUNING)
    assert bounces.tolist() == [False, False, True, True]
    rays, among_few = law.rays(needed), law.at(np.array([3, 0]))
    np.testing.assert_allclose(rays, np.where(bounces, paths.rays(needed), own.rays(needed)), rtol=1e-6)
    np.testing.assert_array_equal(among_few.rays(needed[:2]), rays[[3, 0]])
    many = np.full(4, 512)
    errors = np.where(bounces, paths.error(needed, many), own.error(needed, many))
    np.testing.assert_allclose(law.error(needed, many), errors, rtol=1e-6)


def test_rays_of_a_pair_follow_the_law_that_decides_it():
    """Of nine pixels in a row, paths find much in the sixth; half of the variance is that of those around it."""
    scatter, flux = np.full((1, 9), 0.9, np.float32), np.full((1, 9), 1.5, np.float32)
    bounced = np.zeros((1, 9), np.float32)
    bounced[0, 5] = 0.9
    sites = Sites.around(np.arange(9, dtype=np.uint32), Lattice.whole(1, 9))

    def planned(pilot):
        units = np.full((1, 9), 0.03, np.float32)
        return allocate(pilot, 0, sites, units, 0.5, Gain(*TUNING.diffuse_gain), TUNING, False)

    rays, _, error, floor, bounces = planned(Pilot(flux, flux, scatter, scatter, flux, bounced_scatter=bounced))
    alone, _, own_error, own_floor, none = planned(Pilot(flux, flux, scatter, scatter, flux))
    # the mean of three squares reaches one pixel further: √(0.81/2/3) = 0.37
    assert np.flatnonzero(bounces).tolist() == [4, 5, 6] and not none.any()
    # (0.46 · 60)^(1/0.56) = 374 in place of (0.68 · 60)^(1/0.7) = 200
    assert rays.tolist() == [256] * 4 + [512] * 3 + [256] * 2 and alone.tolist() == [256] * 9
    np.testing.assert_array_equal(floor, own_floor)
    np.testing.assert_allclose(error[bounces], 0.46 * 0.9 * 512**-0.56, rtol=1e-5)
    np.testing.assert_array_equal(error[~bounces], own_error[~bounces])


@pytest.mark.parametrize("depth", [2, 4])
def test_a_pilot_knows_the_scatter_of_what_paths_find(depth):
    """All of the flux where the ball is seen; beside it nothing with direct light, and little with bounced light."""
    tracer = pair_tracer(turning(depth), mono(48, 36))
    pixel = tracer.sensor.layout.full_index.ravel()
    given = pixel, np.zeros(pixel.size, np.int64), WHERE, 64, 1.0
    seen, mild = tracer.pilot(*given), tracer.pilot(*given, mild=True)
    share = seen.bounced_scatter / np.maximum(seen.plain_scatter, 1e-6)
    on_ball = np.isclose(share, 1.0, rtol=1e-4) & (seen.plain_scatter > 0)
    assert 0.01 < on_ball.mean() < 0.2
    rest = seen.bounced_scatter[~on_ball]
    assert (np.median(rest) == 0.0) == (depth == 2)
    assert np.median(rest) < 0.1 * np.median(seen.plain_scatter[~on_ball])
    # nothing is known of what hides light from it
    np.testing.assert_allclose(seen.unshadowed[on_ball], seen.plain[on_ball], rtol=1e-5)
    # it is never mild
    np.testing.assert_array_equal(mild.bounced_scatter, seen.bounced_scatter)
    assert np.all(mild.plain_scatter <= seen.plain_scatter * 1.0001)
    some = np.arange(pixel.size) % 7 == 2
    again = tracer.pilot(pixel[some], given[1][some], WHERE, 64, 1.0, Stream.AUDIT_PILOT)
    joined = seen.with_pairs(np.flatnonzero(some), again)
    np.testing.assert_array_equal(joined.bounced_scatter[some], again.bounced_scatter)
    np.testing.assert_array_equal(joined.bounced_scatter[~some], seen.bounced_scatter[~some])


@pytest.mark.slow
def test_a_ball_of_plastic_does_not_make_a_scene_dear(monkeypatch):
    """One that nobody sees: rays of 3 ms, those by paths alone, and true errors of all pairs of four seeds against
    4 × 4096 rays of these.
    """
    sensor, pixels = hr.load_sensor("davis346").crop(40, 30, 150, 110), np.arange(40 * 30, dtype=np.uint32)
    scene = turning(8, {**BALL, "position_m": [0.06, 0.03, -0.5]})

    def run(seed):
        flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=seed)
        blocks = list(flux.sample_blocks(1, 0, 3_000))
        samples = [(np.array(s.half_a) + np.array(s.half_b)) / 2 for s in flux.flux_of_blocks(pixels, blocks)]
        return np.array(samples, np.float64), flux, blocks

    seen, fluxes, _ = zip(*map(run, (6, 7, 8, 9)), strict=True)
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    _, alone, blocks = run(6)
    assert not alone._renderer.tracer.has_bounced and fluxes[0].rays_traced < 0.4 * alone.rays_traced
    begin, end = (np.concatenate([getattr(b, name)[b.wanted] for b in blocks]) for name in ("begin_us", "end_us"))
    window = np.repeat(np.arange(begin.size), pixels.size)
    given = np.tile(sensor.layout.full_index.ravel(), begin.size), window, Windows(begin, end)
    many = *given, np.full(window.size, 4096), np.zeros(window.size, np.bool_)
    traced_often = [alone._renderer.tracer.trace(*many, repeat=k).mean for k in range(4)]
    truth = np.mean(traced_often, axis=0, dtype=np.float64).reshape(begin.size, -1)
    unit = alone.noise_unit(pixels, truth, True)
    off, changes = (np.array(seen) - truth) / unit, np.abs(truth - truth[0]) > 3 * unit
    assert np.count_nonzero(changes) > 200
    for which in (changes, ~changes):
        assert np.sqrt(np.mean(off[:, which] ** 2)) < 0.5


def test_what_passes_before_a_lamp_of_glossy_things_comes_near():
    """A speck between a point light and a floor of plastic: shadow rays alone come through its box."""
    floor = {"name": "floor", "shape": "rectangle", "size_m": [3, 3, 0], "material": {"type": "plastic"}}
    speck = {"name": "speck", "shape": "sphere", "size_m": [0.012] * 3, "position_m": [0.25, 0, 0.5]}
    beside = {"name": "beside", "shape": "rectangle", "size_m": [0.1, 0.1, 0], "position_m": [2, 2, 0]}
    scene = make_scene(
        objects=[floor, {**speck, "reflectance": 0.3}, {**beside, "reflectance": 0.3}], max_depth=2,
        light={"type": "point", "position_m": [0.5, 0, 1], "illuminant": "D65", "illuminance_lux": 500,
               "plane_point_m": [0, 0, 0], "plane_normal": [0, 0, 1]},
        camera={"origin_m": [0, 0, 1.5], "target_m": [0, 0, 0], "horizontal_fov_deg": 12},
        motion=[{"object": "speck", "keyframes": [{"t_us": 0}, {"t_us": 50_000, "translation_m": [0, 0.01, 0]}]}],
    )  # fmt: skip
    tracer = pair_tracer(scene, mono(48, 36))
    assert tracer.has_bounced
    met = traced(tracer, 8, 0.0, 100.0).met.reshape(36, 48)
    row, col = np.nonzero(met)
    # around the middle of the picture lies its shadow, of the size of the speck twice
    assert 0.002 < met.mean() < 0.3 and abs(row.mean() - 17.5) < 6 and abs(col.mean() - 23.5) < 6
    assert met[16:20, 22:26].all()


@pytest.mark.parametrize("depth", [2, 3])
def test_a_lamp_in_a_mirror_is_as_bright_as_by_paths_alone(monkeypatch, depth):
    mirror = {"name": "mirror", "shape": "rectangle", "size_m": [0.1, 0.3, 0], "material": {"type": "conductor"}}
    card = {"name": "card", "shape": "rectangle", "size_m": [1, 1, 0], "position_m": [0, 0, -0.1], "reflectance": 0.4}
    lamp = {
        "type": "area",
        "illuminant": "D65",
        "illuminance_lux": 700,
        "position_m": [0.1, 0, 2.2],
        "size_m": [1.3, 1],
    }
    camera = {"origin_m": [0, 0, 1.5], "target_m": [0, 0, 0], "horizontal_fov_deg": 12}
    scene = make_scene(objects=[mirror, card], light=lamp, camera=camera, max_depth=depth)
    both = traced(pair_tracer(scene, mono(48, 36)), 256).mean
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    alone = traced(pair_tracer(scene, mono(48, 36)), 256).mean
    assert alone.max() > 5 * np.median(alone), "the mirror does not show the lamp"
    # but in the shadow of the mirror, of which either has few rays
    assert np.isclose(both, alone, rtol=0.02).mean() > 0.97


def test_a_mirror_lights_a_floor_below_a_sky_as_by_paths_alone(monkeypatch):
    """Some directions of the floor lead to the image of the lamp, none of them to where the sky's shadow ray went."""
    mirror = {"name": "mirror", "shape": "rectangle", "size_m": [1.1, 0.9, 0], "position_m": [0.4, 0, 0.5],
              "rotation_axis": [0, 1, 0], "rotation_deg": -90, "material": {"type": "conductor"}}  # fmt: skip
    floor = {"name": "floor", "shape": "rectangle", "size_m": [2, 2, 0], "reflectance": 0.4}
    lamp = {"type": "area", "illuminant": "D65", "illuminance_lux": 900, "position_m": [-0.2, 0.1, 1.6]}
    scene = make_scene(
        objects=[mirror, floor], light=[{**lamp, "size_m": [0.6, 0.7]}, {**D65_1000_LUX, "illuminance_lux": 60}],
        camera={"origin_m": [0.05, 0, 1.5], "target_m": [0.05, 0, 0], "horizontal_fov_deg": 12}, max_depth=4,
    )  # fmt: skip
    sensor = mono(24, 18)
    tracer = pair_tracer(scene, sensor)
    assert tracer.paths.sees_images and tracer.has_bounced
    both = traced(tracer, 4096).mean
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    alone = traced(pair_tracer(scene, sensor), 4096).mean
    assert abs(both.mean() / alone.mean() - 1) < 0.002
    # 0.010; without directions to the image 0.026
    assert np.std(both / alone) < 0.016


@pytest.mark.parametrize("with_lamp", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_ray_brings_the_light_of_the_sky_or_of_what_hides_it(monkeypatch, with_lamp):
    """A card that turns beside a bright wall, below a sky: h is 1 where the wall hides it, which sends L in place of S.
    One direction for both scatters by (S - L)²·h(1 - h), two by (S² + L²)·h(1 - h).
    """
    tilt = {"rotation_axis": [0.2, 1, 0], "rotation_deg": 25}
    lamp = {"position_m": [0.5, -1.2, 2.5], "size_m": [0.2, 0.3], "illuminant": "D65", "illuminance_lux": 300}
    light = [D65_1000_LUX, {"type": "area", **lamp}] if with_lamp else D65_1000_LUX
    scene = make_scene(
        objects=[
            {"name": "card", "shape": "rectangle", "size_m": [0.5, 0.4, 0], "reflectance": 0.4},
            # on edge to the camera
            {"name": "wall", "shape": "box", "size_m": [0.02, 1.7, 1.4], "position_m": [-0.3, 0.1, 0.6],
             "reflectance": 0.93},
        ],
        light=light, max_depth=3, camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 9},
        motion=[{"object": "card", "keyframes": [{"t_us": 0, **tilt}, {"t_us": 50_000, **tilt, "rotation_deg": 38}]}],
    )  # fmt: skip
    sensor, count = mono(12, 9), 12 * 9
    given = sensor.layout.full_index.ravel(), np.zeros(count, np.int64), WHERE, np.full(count, 64)

    def of_repeats(tracer):
        means = [tracer.trace(*given, np.zeros(count, np.bool_), repeat=k).mean for k in range(40)]
        return np.mean(means, axis=0), np.var(means, axis=0, ddof=1).mean()

    together, square = of_repeats(pair_tracer(scene, sensor))
    monkeypatch.setattr(PathIntegrator, "sees_images", property(lambda paths: True))
    _, apart = of_repeats(pair_tracer(scene, sensor))
    monkeypatch.setattr(surfaces, "_MOST_ENTRIES", -1)
    alone, _ = of_repeats(pair_tracer(scene, sensor))
    assert square < 0.5 * apart
    np.testing.assert_allclose(together, alone, rtol=0.02)


def test_aimed_rays_bring_by_paths_what_they_bring_where_nothing_else_is_seen():
    """A speck of plastic before a wall of plastic; rays aimed at it have weights."""
    plastic = {"type": "roughplastic", "alpha": 0.3}
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "material": plastic}
    speck = {"name": "speck", "shape": "sphere", "size_m": [0.0011] * 3, "position_m": [0.002, 0.001, 0.2]}
    card = {"name": "card", "shape": "rectangle", "size_m": [0.1, 0.1, 0], "position_m": [2, 2, 0], "reflectance": 0.3}
    ends = [{"t_us": 0}, {"t_us": 50_000, "translation_m": [0.01, 0.003, 0]}]
    scene = make_scene(
        objects=[wall, {**speck, "material": plastic}, card], light=D65_1000_LUX, max_depth=2,
        camera={"origin_m": [0.01, 0.02, 1.5], "target_m": [0, 0.01, 0], "horizontal_fov_deg": 5},
        motion=[{"object": "speck", "keyframes": ends}],
    )  # fmt: skip
    renderer = ChangeDrivenFlux(scene, mono(24, 18), 0.5, seed=4)._renderer
    band = next(renderer.bands(np.arange(24 * 18, dtype=np.uint32), "any"))
    windows, first = Windows(np.array([100.0]), np.array([700.0])), np.zeros((1, band.sites.size), np.int64)
    pilot, _ = renderer.pilot(band, windows, first, None)
    assert pilot.aims is not None and renderer.tracer.has_bounced
    np.testing.assert_allclose(pilot.bounced_scatter, pilot.plain_scatter, rtol=1e-4)


def test_only_pixels_that_paths_decide_are_looked_at_for_bends():
    class Tracer:
        def pilot(self, pixel, *_, **__):
            looked.append(np.unique(pixel).tolist())
            raise RuntimeError

    shape, looked = (5, 4), []
    every, no = np.ones(shape, np.bool_), np.zeros(shape, np.bool_)
    ones = np.ones(shape, np.float32)
    what = Plan(every, np.full(shape, 4096, np.int16), every, ones, ones, np.ones(shape, np.int16),
                Differences.none(*shape), no, no, no, ones)  # fmt: skip
    windows = Windows(np.arange(5.0) * 100, np.arange(5.0) * 100 + 100)
    for among in (None, np.array([1, 3])):
        with pytest.raises(RuntimeError):
            straightened(Tracer(), np.arange(20, 24, dtype=np.uint32), windows, what, TUNING, among)
    assert looked == [[20, 21, 22, 23], [21, 23]]
    assert straightened(Tracer(), np.arange(4, dtype=np.uint32), windows, what, TUNING, np.array([], int)) is what


def test_a_plan_says_which_of_its_pairs_follow_the_law_of_paths():
    """Paths find much in the first pixel in the first window, and in the last one in the third."""
    scatter, flux = np.full((3, 7), 0.9, np.float32), np.full((3, 7), 1.5, np.float32)
    bounced = np.zeros((3, 7), np.float32)
    bounced[0, 0] = bounced[2, 6] = 0.9
    sites, gain = Sites.around(np.arange(7, dtype=np.uint32), Lattice.whole(1, 7)), Gain(*TUNING.diffuse_gain)

    def planned(**others):
        pilot = Pilot(flux, flux, scatter, scatter, flux, **others)
        return plan(pilot, sites, lambda seen: 0.03 + 0 * seen, 0.5, gain, TUNING, is_knot=True)

    what = planned(bounced_scatter=bounced)
    assert what.bounces.astype(int).tolist() == [[1, 1, 0, 0, 0, 0, 0], [0] * 7, [0, 0, 0, 0, 0, 1, 1]]
    assert what.first().bounces.astype(int).tolist() == [[1, 1, 0, 0, 0, 0, 0]]
    assert planned().bounces is None and planned().first().bounces is None


def test_lines_follow_the_law_of_their_pair():
    shape, given = (4, 3), []
    window, pixel = np.indices(shape)
    todo, bounces = (window + 2 * pixel) % 3 == 1, (window + pixel) % 2 == 0
    what = SimpleNamespace(rays=np.full(shape, 512), controlled=todo, wanted=1.5 + pixel, floor=0 * pixel, shadows=None)
    own = SimpleNamespace(
        tracer=SimpleNamespace(rays=SimpleNamespace(is_box=True)), gain=Gain(*TUNING.diffuse_gain), tuning=TUNING
    )
    with mock.patch.object(adaptive, "about_edges", lambda *some, **_: given.append(some[6])):
        for what.bounces in (bounces, None):
            AdaptiveRenderer.rays_of(own, None, what, todo, None)
    np.testing.assert_allclose(given[0].factor, np.where(bounces[todo], 0.46, 0.68))
    np.testing.assert_allclose(given[0].power, np.where(bounces[todo], 0.56, 0.7))
    assert given[1] is own.gain


@pytest.mark.slow
@pytest.mark.parametrize("of_changes", [False, True])
def test_references_follow_the_law_of_paths_where_these_decide(of_changes):
    """By the law of closed forms everywhere, and by that of paths: more rays."""
    pixel, ends, rays = np.arange(0, 40 * 30, 29, dtype=np.uint32), np.array([400.0, 1400.0]), []
    for part in (1e9, 0.0):
        source = ChangeDrivenFlux(turning(4), mono(40, 30), 0.5, seed=2)
        source._renderer.tuning = replace(source._renderer.tuning, bounced_part=part)
        before = source.rays_traced
        if of_changes:
            end = np.repeat(ends[:, None], pixel.size, axis=1)
            planned = source._references._planned(source._index[pixel], end - 100, end, 0, 0.1)
            # where most of the sky is open, the closed form scatters less
            assert set(np.unique(planned[2])) == {0.0, 1.0} and 0.3 < planned[2].mean() < 0.7
            rays.append(int((planned[0] * planned[1]).sum()))
        else:
            source.reference_flux(pixel, np.full(pixel.size, 300.0), np.full(pixel.size, 400.0), 0.1, True)
            rays.append(source.rays_traced - before)
    assert rays[1] > (1.0 if of_changes else 1.1) * rays[0]

"""Scenes of which some light has a closed form and some is found by paths: what decides their rays."""

import numpy as np
import pytest
from rendering import D65_1000_LUX, make_scene, mono, pair_tracer

import hesim_render as hr
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.allocation import allocate, gain_of
from hesim_render.sources.render.change_driven.bends import straightened
from hesim_render.sources.render.change_driven.differences import Differences
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.scene import surfaces

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
    # it is never mild
    np.testing.assert_array_equal(mild.bounced_scatter, seen.bounced_scatter)
    assert np.all(mild.plain_scatter <= seen.plain_scatter * 1.0001)
    some = np.arange(pixel.size) % 7 == 2
    again = tracer.pilot(pixel[some], given[1][some], WHERE, 64, 1.0, Stream.AUDIT_PILOT)
    joined = seen.with_pairs(np.flatnonzero(some), again)
    np.testing.assert_array_equal(joined.bounced_scatter[some], again.bounced_scatter)
    np.testing.assert_array_equal(joined.bounced_scatter[~some], seen.bounced_scatter[~some])


def test_a_ball_of_plastic_does_not_make_a_scene_dear(monkeypatch):
    """One that nobody sees: rays of 3 ms, those by paths alone, and true errors against 4 × 4096 rays of these."""
    sensor, pixels = hr.load_sensor("davis346").crop(40, 30, 150, 110), np.arange(40 * 30, dtype=np.uint32)
    scene, rays, seen = turning(8, {**BALL, "position_m": [0.06, 0.03, -0.5]}), [], []
    for most in (surfaces._MOST_ENTRIES, -1):
        monkeypatch.setattr(surfaces, "_MOST_ENTRIES", most)
        flux = ChangeDrivenFlux(scene, sensor, 0.5, seed=6)
        blocks = list(flux.sample_blocks(1, 0, 3_000))
        seen.append(
            np.array([(np.array(s.half_a) + np.array(s.half_b)) / 2 for s in flux.flux_of_blocks(pixels, blocks)])
        )
        rays.append(flux.rays_traced)
    assert rays[0] < 0.4 * rays[1]
    begin, end = (np.concatenate([getattr(b, name)[b.wanted] for b in blocks]) for name in ("begin_us", "end_us"))
    unit, tracer = flux.noise_unit(pixels, seen[0], True), flux._renderer.tracer
    assert not tracer.has_bounced
    changes = np.abs(seen[0] - seen[0][0]) > 3 * unit
    for which in (changes, ~changes):
        window, pixel = (each[np.random.default_rng(2).permutation(which.sum())[:400]] for each in np.nonzero(which))
        given = sensor.layout.full_index.ravel()[pixel], window, Windows(begin, end), np.full(pixel.size, 4096)
        several = [tracer.trace(*given, np.zeros(pixel.size, np.bool_), repeat=k).mean for k in range(4)]
        off = (seen[0][window, pixel] - np.mean(several, axis=0, dtype=np.float64)) / unit[window, pixel]
        assert pixel.size > 200 and np.sqrt(np.mean(off**2)) < 0.5


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

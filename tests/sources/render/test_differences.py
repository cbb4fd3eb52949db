"""Pairs as differences to other windows: how many rays they take, that they have no bias, and what the pilot skips."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rendering import make_scene
from test_change_driven import fluxes, noisy

import hesim_render as hr
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import tick_blocks
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven import pilot as pilots
from hesim_render.sources.render.change_driven.anchor import anchor_us, period_us
from hesim_render.sources.render.change_driven.differences import difference_of, differences
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.held_pairs import HeldPairs
from hesim_render.sources.render.change_driven.kept_pilots import Anchored
from hesim_render.sources.render.change_driven.neighbours import Lattice, Sites
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, PilotFlux, PilotRays, not_negative
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.pilot import Change, Pilot, Refinement, take_pilot
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.exact import used_responses
from hesim_render.sources.render.transport import outlines

UNIT, QUALITY = 40.0, 0.6
WANTED = TUNING.difference_part * QUALITY * UNIT
CENTRE = 5 * 11 + 5


def sites_of(size=11):
    return Sites.around(np.arange(size * size, dtype=np.uint32), Lattice.whole(size, size))


def pilot_of(windows, open_flux=0.0, **tables):
    """A pilot of 11×11 sites with changes; tables not given are 0."""
    zero = np.zeros((windows, 121), np.float32)
    change = {name: np.broadcast_to(np.asarray(table, np.float32), zero.shape).copy() for name, table in tables.items()}
    names = "controlled", "plain", "controlled_scatter", "plain_scatter"
    found = Change(*(change.get(name, zero.copy()) for name in names))
    return Pilot(zero, zero, zero, zero, zero + np.float32(open_flux), change=found)


def rays_of(pilot, controlled=True):
    chosen = np.full(121, controlled)
    return difference_of(pilot, 0, chosen, sites_of(), np.full(121, UNIT, np.float32), QUALITY, TUNING)


def one_site(value, others=0.0):
    table = np.full(121, others, np.float32)
    table[CENTRE] = value
    return table


def test_pairs_with_known_shadows_are_no_differences():
    """The rays with which they would be compared know no shadow."""
    pilot, units = pilot_of(5, open_flux=200.0), np.full((5, 121), UNIT, np.float32)
    given = sites_of(), units, QUALITY, np.ones((5, 121), bool), np.full((5, 121), 4096, np.int16), TUNING
    shadows = np.zeros((5, 121), np.uint32)
    shadows[[0, 2, 3], CENTRE] = 7 + (3 << 8)
    every, some = differences(pilot, *given), differences(replace(pilot, shadows=shadows), *given)
    assert np.all(every.rays > 0) and (some.rays[:, CENTRE] > 0).tolist() == [False, True, False, False, True]
    others = np.arange(121) != CENTRE
    np.testing.assert_array_equal(some.rays[:, others], every.rays[:, others])


def test_a_choice_does_not_depend_on_pairs_that_are_not_rendered():
    """They would not be differences either if they took no rays by themselves."""
    rng = np.random.default_rng(8)
    tables = {name: rng.uniform(0, 60, (5, 121)) for name in ("controlled_scatter", "plain_scatter", "plain")}
    pilot, units = pilot_of(5, open_flux=200.0, **tables), np.full((5, 121), UNIT, np.float32)
    rendered = rng.random((5, 121)) < 0.4
    alone = (2 ** rng.integers(5, 13, (5, 121))).astype(np.int16)
    given = pilot, sites_of(), units, QUALITY
    some = differences(*given, rendered, alone, TUNING)
    every = differences(*given, np.ones_like(rendered), np.where(rendered, alone, 0).astype(np.int16), TUNING)
    np.testing.assert_array_equal(some.rays, every.rays)
    assert 0.05 < np.mean(some.rays[rendered] > 0) < 0.95
    chosen = some.rays > 0
    np.testing.assert_array_equal(some.error[chosen], every.error[chosen])
    np.testing.assert_array_equal(some.controlled[chosen], every.controlled[chosen])


def test_rays_of_a_pilot_are_kept_in_order_however_many_are_traced_at_a_time():
    scene, sensor = hr.load_scene("rotating-star"), noisy(16, 12)
    pixel, windows = np.arange(5, 137, dtype=np.uint32), Windows(np.array([100.0]), np.array([900.0]))
    kept = []
    for block_rays in (1 << 12, 1 << 10):
        tracer = PairTracer(scene, sensor, 3, used_responses(sensor), block_rays=block_rays)
        flux, rays = tracer.pilot_rays(pixel, np.zeros(pixel.size, np.int64), windows, 16, 1.25)
        kept.append([np.array(rays.controlled), np.array(rays.plain)])
        means = kept[-1][1].reshape(-1, 16).mean(axis=1) * tracer.axis_factor(pixel)
        np.testing.assert_allclose(flux.plain, means, rtol=1e-5)
    np.testing.assert_array_equal(*kept)


def test_rays_follow_the_scatter_of_a_pixel_and_of_those_around():
    """s² = ½·300² + ½·(300² + 8·90²)/9; n = (0.95·s/ε)²."""
    rays, scatter = rays_of(pilot_of(1, controlled_scatter=one_site(300, 90), plain_scatter=7.0))
    square = 0.5 * 300**2 + 0.5 * (300**2 + 8 * 90**2) / 9
    assert scatter[CENTRE] == pytest.approx(square**0.5, rel=1e-5)
    assert rays[CENTRE] == pytest.approx((0.95 / WANTED) ** 2 * square, rel=1e-4)
    assert rays_of(pilot_of(1, controlled_scatter=300.0, plain_scatter=7.0), controlled=False)[0][CENTRE] == 64


def test_what_a_pilot_does_not_show_has_rays_too():
    """Half of all light over the root of 144 rays, 2400/24 = 100 e⁻/s, beside a scatter of 240; and never less than 64
    rays. A pixel without neighbours has but 32 rays of its own.
    """
    rays, scatter = rays_of(pilot_of(1, open_flux=2400, controlled_scatter=240.0))
    assert scatter[CENTRE] == pytest.approx(260, rel=1e-5)
    assert rays[CENTRE] == pytest.approx((0.95 * 260 / WANTED) ** 2, rel=1e-4)
    assert rays_of(pilot_of(1))[0][CENTRE] == 64
    alone = Sites.alone(np.arange(121, dtype=np.uint32))
    units, controlled = np.full(121, UNIT, np.float32), np.ones(121, bool)
    _, scatter = difference_of(
        pilot_of(1, open_flux=2400, controlled_scatter=240.0), 0, controlled, alone, units, QUALITY, TUNING
    )
    assert scatter[CENTRE] == pytest.approx(np.hypot(240, 1200 / 32**0.5), rel=1e-5)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_change_beside_a_pixel_may_reach_into_it(sign):
    """A 32nd of a pixel may have changed as the neighbour did: (0.95/ε)²·contrast²/32; two away, by its light alone."""
    moved = sign * 1500.0
    rays, _ = rays_of(pilot_of(1, controlled=one_site(moved, sign * 150.0)))
    assert rays[CENTRE + 1] == pytest.approx((0.95 * 1350 / WANTED) ** 2 / 32, rel=1e-4)
    assert rays[CENTRE + 12] == rays[CENTRE + 1] > rays[CENTRE + 2]
    far, _ = rays_of(pilot_of(1, controlled=one_site(sign * 16_000.0)))
    assert far[CENTRE + 2] == pytest.approx(0.25 * 16_000 / UNIT) and far[CENTRE + 3] == 64
    lamp, _ = rays_of(pilot_of(1, controlled=one_site(sign * 1e6)))
    assert lamp[CENTRE + 2] == 512  # at most


@pytest.mark.parametrize("sign", [1, -1])
def test_if_the_camera_moves_an_edge_beside_a_pixel_may_reach_into_it(sign):
    """The level beside differs, though no ray saw a change: (0.95/ε)²·contrast²/32, and nothing bounds it."""
    flux = np.full((1, 121), 9000.0, np.float32)
    flux[0, CENTRE] += sign * 3000
    still = replace(pilot_of(1), plain=flux)
    assert np.all(rays_of(still, controlled=False)[0] == 64)
    rays, _ = rays_of(replace(still, all_move=True), controlled=False)
    expected = (0.95 * 3000 / WANTED) ** 2 / 32
    assert expected > 512 and rays[CENTRE] == pytest.approx(expected, rel=1e-4)
    assert rays[CENTRE + 12] == rays[CENTRE] and rays[CENTRE + 2] == 64
    assert np.all(rays_of(replace(still, all_move=True))[0] == 64)  # the other estimator sees no edge


def chosen(pilot, alone, rendered=None):
    shape = pilot.controlled.shape
    rendered = np.ones(shape, bool) if rendered is None else rendered
    units = np.full(shape, UNIT, np.float32)
    return differences(pilot, sites_of(), units, QUALITY, rendered, np.broadcast_to(np.int16(alone), shape), TUNING)


def test_a_difference_takes_a_quarter_of_the_rays_or_is_not_made():
    """Without any scatter 64 rays: worth it beside 256 rays, not beside 128."""
    for alone, expected in ((256, 64), (128, 0)):
        rays = chosen(pilot_of(2), alone).rays
        assert rays.shape == (2, 121) and np.all(rays == expected)
    assert np.all(chosen(replace(pilot_of(2), change=None), 4096).rays == 0)


def test_windows_within_a_block_share_their_rays_and_pay_for_those_in_its_first():
    """Scatters of 93 and 143 want 64 and 128 rays; both windows take 128, and 128 more in the first window."""
    scatter = np.zeros((4, 1))
    scatter[1:3, 0] = 93, 143
    pilot = pilot_of(4, controlled_scatter=scatter, plain_scatter=5e4)
    found = chosen(pilot, 1024)
    assert found.rays[:, CENTRE].tolist() == [64, 128, 128, 64] and found.controlled.all()
    np.testing.assert_allclose(found.error[1:3, CENTRE], 0.95 * np.array([93, 143]) / np.sqrt(128), rtol=1e-5)
    # one window alone would take 128 rays and 128 in the first, which is as much as 256 of its own
    once = np.ones((4, 121), bool)
    once[1] = False
    assert chosen(pilot_of(4, controlled_scatter=143.0, plain_scatter=5e4), 512, once).rays[:, CENTRE].tolist() == [
        128,
        0,
        128,
        128,
    ]
    alone = np.full((4, 121), 512, np.int16)
    alone[2] = 256
    found = differences(pilot_of(4), sites_of(), np.full((4, 121), UNIT, np.float32), QUALITY, once, alone, TUNING)
    assert found.rays[:, CENTRE].tolist() == [64, 0, 64, 64]


def test_the_estimator_is_the_steadier_one():
    controlled = np.array([[3.0], [900.0], [40.0], [500.0]])
    plain = np.array([[8.0], [70.0], [600.0], [20.0]])
    found = chosen(pilot_of(4, controlled_scatter=controlled, plain_scatter=plain), 4096)
    # ends by themselves; the two windows between together: 940 against 670
    assert found.controlled[:, CENTRE].tolist() == [True, False, False, False]


def test_pixels_with_small_objects_are_rendered_by_themselves():
    looks = [Refinement(*(np.empty(0, kind) for kind in (int, int, np.float32, np.float32))) for _ in range(3)]
    looks[1] = Refinement(np.array([7]), np.array([256]), np.zeros(1, np.float32), np.zeros(1, np.float32))
    rays = chosen(replace(pilot_of(3), refined=looks), 1024).rays
    assert rays[1, 7] == 0 and np.count_nonzero(rays == 0) == 1


def test_anchors_lie_at_multiples_of_64_ms_or_of_four_blocks():
    begin = np.array([129_999.0, 130_099, 130_199])
    assert anchor_us(begin, begin + 1, False) == (127_999, 128_000)
    # the last window of a block has an anchor of its own, with the period of the whole block
    ends = np.array([124_800.0, 127_000, 128_300])
    assert anchor_us(ends - [7, 8, 9], ends, False, -1) == (127_991, 128_000)
    slow = ends * [1, 1, 2]
    assert anchor_us(slow - 700, slow, True, -1) == (-700, 0)
    ticks = np.arange(17) * 2000.0 + 130_000  # a block of 32 ms
    assert period_us(ticks, True) == 128_000 and anchor_us(ticks - 700, ticks, True) == (127_300, 128_000)
    # blocks of instants have different lengths, and one period
    assert period_us(ticks, False) == 64_000 and anchor_us(ticks + 1300, ticks + 2000, False) == (127_300, 128_000)


@pytest.mark.parametrize("name", ["davis346", "imx636"])
def test_blocks_of_asynchronous_sensors_are_long(name):
    sensor = hr.load_sensor(name).crop(20, 12)
    blocks = list(ChangeDrivenFlux(shadow_scene(), sensor, seed=1).sample_blocks(1, 0, 33_000))
    assert max(block.wanted.size for block in blocks) == 65


def test_sites_near_a_mark():
    marked = np.zeros(121, bool)
    marked[3 * 11 + 9] = True
    row, col = np.indices((11, 11))
    expected = (abs(row - 3) <= 2) & (abs(col - 9) <= 2)
    np.testing.assert_array_equal(sites_of().near(marked, 2), expected.ravel())
    alone = Sites.alone(np.arange(121, dtype=np.uint32))
    np.testing.assert_array_equal(alone.near(marked, 2), marked)


def shadow_scene(keys=None, **lens):
    """A plate that turns before a wall in even light: its shadow is one wide penumbra. Without a focal length, the
    region that is read out sees 24°.
    """
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "position_m": [0, 0, -0.09], "reflectance": 0.37}
    plate = {"name": "plate", "shape": "rectangle", "size_m": [0.14, 0.05, 0], "position_m": [0.01, 0, 0],
             "reflectance": 0.8, "pattern": 0.25, "pattern_count": [3, 2]}  # fmt: skip
    keys = keys or [{"t_us": 0, "rotation_deg": 7}, {"t_us": 60_000, "rotation_deg": 95}]
    return make_scene(
        objects=[wall, plate],
        light={"type": "uniform", "illuminant": "D65", "illuminance_lux": 700},
        camera={"origin_m": [0, 0, 0.6], "target_m": [0, 0, 0], **(lens or {"horizontal_fov_deg": 24})},
        motion=[{"object": "plate", "keyframes": keys}],
    )


@pytest.fixture(autouse=True)
def no_outlines(monkeypatch):
    """Light whose noise differences are made for: nothing is known in closed form of what hides the sky."""
    monkeypatch.setattr(outlines, "outlines_of", lambda scene: [])


def test_differences_have_no_bias_and_the_error_that_is_stated():
    """Every pair as a difference that may be one, with few rays: nine seeds against the mean of 4 times 4096 rays.

    The mean over pixels is right within four standard errors of the seeds; the rms error of pixels is what the halves
    say, within a tenth.
    """
    # without decision rays, which save rays on their own
    scene, alone = shadow_scene(), replace(TUNING, edge_least_rays=1 << 14)
    few, sensor = replace(alone, difference_gain=0.0, difference_part=3.0), noisy(20, 14)
    runs = [ChangeDrivenFlux(scene, sensor, 0.5, seed, tuning=few) for seed in range(9)]
    got = np.array([fluxes(run, 0, 22_000) for run in runs])  # [seed, tick, half, pixel]
    tracer, ticks = ChangeDrivenFlux(scene, sensor, seed=99)._tracer, np.array([3, 9, 16])
    assert runs[0].counts.rays < 0.8 * rays_without(scene, sensor, alone)
    ends = (ticks + 1) * 1250.0
    windows = Windows(ends - sensor.spec.evs.window_us, ends)
    pixel = np.tile(runs[0]._index[sensor.layout.evs_pixel.ravel()], 3)
    window = np.repeat(np.arange(3), pixel.size // 3)
    every = np.full(pixel.size, 4096), np.ones(pixel.size, bool)
    truth = np.mean([tracer.trace(pixel, window, windows, *every, repeat=k).mean for k in range(4)], axis=0)
    values = got[:, ticks].mean(axis=2).reshape(9, -1)
    stated = (0.5 * (got[:, ticks, 0] - got[:, ticks, 1])).reshape(9, -1)
    error = values - truth
    total = error.mean(axis=1)
    assert abs(total.mean()) < 4 * total.std(ddof=1) / 3
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.1)


def rays_without(scene, sensor, tuning):
    """Rays of the picture without any difference."""
    source = ChangeDrivenFlux(scene, sensor, 0.5, 0, tuning=replace(tuning, difference_gain=1e9))
    fluxes(source, 0, 22_000)
    return source.counts.rays


def test_looks_that_halve_find_what_all_looks_find(monkeypatch):
    """The same flux to the bit but at a few pairs, which are no farther off than noise, for fewer rays of the pilot."""
    sensor = hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(40, 24)
    monkeypatch.setattr(pilots, "DETECTOR_RAYS", 1000)
    # looks alone: no edge is followed, and no pair is held, where the pilot looks in each window
    monkeypatch.setattr(adaptive, "held_pairs", lambda *_: HeldPairs.none())
    found = []
    for stride in (1, TUNING.look_stride):
        source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4, tuning=replace(TUNING, look_stride=stride))
        pixels = source.sensor.layout.evs_pixel.ravel()
        samples = source.flux_of_blocks(pixels, source.sample_blocks(1, 30_000, 33_000))
        found.append((np.array([np.array(one.half_a) for one in samples]), source.counts.pilot_rays))
    (every, most), (some, fewer) = found
    assert np.ptp(every, axis=0).max() > 0.2 * every.max() and fewer < 0.7 * most
    assert np.mean(every != some) < 0.05
    unit = source.noise_unit(pixels, every, True)
    assert np.sqrt(np.mean(((every - some) / unit) ** 2)) < 0.08


class MadeUp:
    """A tracer whose pilot has the flux `light` [window, site], and as scatter the place it is compared with."""

    camera = parts = rays = None
    knows_shadows = False

    def __init__(self, light, near):
        self.light, self.near, self.traced = light, near, []
        self.rays, self.parts = SimpleNamespace(spreads=False), SimpleNamespace(groups=[])

    def pilot(self, index, window, windows, rays, width_px, span_us=None, before=None, mild=False, shadows=None):
        self.traced += zip(window.tolist(), index.tolist(), strict=True)
        found = PilotFlux.empty(index.size)
        found.controlled[:], found.plain[:] = self.light[window, index], 0.5 * self.light[window, index]
        found.controlled_change[:], found.met[:] = 3000 + (before[1] if before else 0), self.near[index]
        return found

    def pilot_rays(self, index, window, windows, rays, width_px, span_us=None, before=None, mild=False):
        zeros = from_host(jit().Float, np.zeros(rays * index.size, np.float32))
        return self.pilot(index, window, windows, rays, width_px, before=before), PilotRays(
            zeros, zeros, rays, (5.0, 6.0)
        )


def test_a_pilot_says_whether_the_camera_moves():
    sites, windows = sites_of(), Windows(np.arange(2.0), np.arange(2.0) + 1)
    tracer = MadeUp(np.full((2, 121), 250.0, np.float32), np.ones(121, bool))
    given = sites, windows, np.zeros((2, 121), np.int64), 16, 1.25, None
    assert not take_pilot(tracer, *given)[0].all_move
    tracer.camera = object()
    assert take_pilot(tracer, *given)[0].all_move


@pytest.mark.parametrize("moves_on", [False, True])
@pytest.mark.parametrize(("width_px", "reach"), [(1.09, (2, 1)), (1.15, (2, 0)), (1.25, (0, 0))])
def test_what_a_pilot_compares_and_between_which_looks_it_traces(width_px, reach, moves_on):
    """Nine windows and looks at every fourth, 11×11 sites: one changes from window 6 on, one is far from all motion."""
    sites, far = sites_of(), 10 * 11 + 10
    light, near = np.full((9, 121), 250.0, np.float32), np.ones(121, bool)
    light[6:, CENTRE], near[far] = 700.0, False
    tracer, (anchor, later) = MadeUp(light, near), (PilotFlux.empty(121) for _ in range(2))
    anchor.controlled[:], anchor.plain[:] = 240.0, 90.0
    later.controlled[:], later.plain[:] = 170.0, 30.0
    zeros = from_host(jit().Float, np.zeros(16 * 121, np.float32))
    anchored, other = (
        Anchored(each, PilotRays(zeros, zeros, 16, (1.0, 2.0)), (-3.0, -2.0)) for each in (anchor, later)
    )
    ending = other if moves_on else None
    numbers = np.repeat(np.arange(9)[:, None], 121, axis=1)
    windows = Windows(np.arange(9.0), np.arange(9.0) + 1)
    given = tracer, sites, windows, numbers, 16, width_px, None
    pilot, _ = take_pilot(*given, anchored=anchored, stride=4, ending=ending)
    np.testing.assert_array_equal(pilot.controlled, light)
    assert not pilot.all_move
    row, col = np.indices((11, 11))
    # within half of the stride, what comes from one pixel away; what a wide look sees by itself asks for none beside it
    busy, beside = (np.flatnonzero(((abs(row - 5) <= k) & (abs(col - 5) <= k)).ravel()) for k in reach)
    looks = [(window, site) for window in (0, 4, 8) for site in range(121) if window == 0 or site != far]
    halved = [(6, site) for site in busy] + [(5, site) for site in beside]
    # what rests is compared with the anchor of the last window, where that is another one
    halved += [(8, far)] * moves_on
    assert sorted(tracer.traced) == sorted([*looks, *halved])
    # the ends are compared with the anchor, those between with the first window
    scatter, site = pilot.change.controlled_scatter, np.arange(121)
    near_by = site != far
    np.testing.assert_array_equal(scatter[0], 3000 + site)
    np.testing.assert_array_equal(scatter[8, near_by], (3000 + site + 121)[near_by])
    assert scatter[8, far] == (3000 + far + 121 if moves_on else scatter[0, far])
    assert np.all(scatter[1:4] == 0) and np.all(scatter[1:8, far] == 0)
    np.testing.assert_array_equal(scatter[4:8, near_by], np.tile((3000 + site)[near_by], (4, 1)))
    np.testing.assert_array_equal(pilot.change.controlled[0], light[0] - 240)
    np.testing.assert_array_equal(pilot.change.controlled[8], light[8] - (170 if moves_on else 240))
    np.testing.assert_array_equal(pilot.change.plain[8], 0.5 * light[8] - (30 if moves_on else 90))
    np.testing.assert_array_equal(pilot.change.controlled[1:8], light[1:8] - 250)


def test_windows_that_save_less_than_their_rays_in_the_first_one_are_rendered_by_themselves():
    """One window wants 512 rays in place of 2048, five want 64 in place of 256: 512 in all save 1536 − 5·256 = 256."""
    scatter, alone = np.zeros((8, 1)), np.full((8, 121), 256, np.int16)
    scatter[3, 0], alone[3] = 285, 2048
    units, every = np.full((8, 121), UNIT, np.float32), np.ones((8, 121), bool)
    pilot = pilot_of(8, controlled_scatter=scatter, plain_scatter=5e4)
    for rendered, expected in ((range(8), 0), ((0, 3, 4, 5, 7), 512)):
        some = np.zeros_like(every)
        some[list(rendered)] = True
        found = differences(pilot, sites_of(), units, QUALITY, some, alone, TUNING).rays[:, CENTRE]
        assert found[3] == expected and found[0] == 64


def test_a_negative_mean_is_raised_to_zero_and_keeps_its_halves_apart():
    flux = PairFlux(*(np.array(half, np.float32) for half in ([-3.0, 5, -7], [1.0, 2, 19])), np.zeros(3, bool))
    not_negative(flux)
    assert flux.half_a.tolist() == [-2, 5, -7] and flux.half_b.tolist() == [2, 2, 19]


def test_the_expected_error_of_a_difference_holds_that_of_what_it_is_compared_with():
    """With so many rays that the difference has none to speak of, a pixel of the wall has that of its anchor."""
    many = replace(TUNING, difference_gain=0.0, difference_part=0.02)
    source = ChangeDrivenFlux(shadow_scene(), noisy(20, 14), 0.5, 3, tuning=many)
    pixels = source.sensor.layout.evs_pixel.ravel()
    sample = list(source.flux_of_blocks(pixels, tick_blocks(source.sensor.spec.evs, 0, 5000)))[-1]
    flux = 0.5 * (np.array(sample.half_a) + np.array(sample.half_b))
    in_units = sample.error / source.noise_unit(pixels, flux[None], True)[0]
    assert np.quantile(in_units, 0.3) > 0.2  # 0.34; that of the differences alone is 0.04

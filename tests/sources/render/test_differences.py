"""Pairs as differences to other windows: how many rays they take, that they have no bias, and what the pilot skips."""

from dataclasses import replace

import numpy as np
import pytest
from rendering import make_scene
from test_change_driven import fluxes, noisy

import hesim_render as hr
from hesim_render.sources.render.change_driven.anchor import anchor_us, period_us
from hesim_render.sources.render.change_driven.differences import difference_of, differences
from hesim_render.sources.render.change_driven.event_blocks import intervals_of
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pilot import Change, Closer, Pilot
from hesim_render.sources.render.change_driven.tuning import TUNING
from hesim_render.sources.render.change_driven.windows import Windows

UNIT, QUALITY = 40.0, 0.6
WANTED = TUNING.difference_part * QUALITY * UNIT
CENTRE = 5 * 11 + 5


def sites_of(size=11):
    return Sites.around(np.arange(size * size, dtype=np.uint32), size, size)


def pilot_of(windows, open_flux=0.0, **tables):
    """A pilot of 11×11 sites with changes; tables not given are 0."""
    zero = np.zeros((windows, 121), np.float32)
    change = {name: np.broadcast_to(np.asarray(table, np.float32), zero.shape).copy() for name, table in tables.items()}
    names = "lit", "hidden", "lit_scatter", "hidden_scatter"
    found = Change(*(change.get(name, zero.copy()) for name in names))
    return Pilot(zero, zero, zero, zero, zero + np.float32(open_flux), change=found)


def rays_of(pilot, lit=True):
    chosen = np.full(121, lit)
    return difference_of(pilot, 0, chosen, sites_of(), np.full(121, UNIT, np.float32), QUALITY, TUNING)


def one_site(value, others=0.0):
    table = np.full(121, others, np.float32)
    table[CENTRE] = value
    return table


def test_rays_follow_the_scatter_of_a_pixel_and_of_those_around():
    """s² = ½·300² + ½·(300² + 8·90²)/9; n = (0.95·s/ε)²."""
    rays, scatter = rays_of(pilot_of(1, lit_scatter=one_site(300, 90), hidden_scatter=7.0))
    square = 0.5 * 300**2 + 0.5 * (300**2 + 8 * 90**2) / 9
    assert scatter[CENTRE] == pytest.approx(square**0.5, rel=1e-5)
    assert rays[CENTRE] == pytest.approx((0.95 / WANTED) ** 2 * square, rel=1e-4)
    assert rays_of(pilot_of(1, lit_scatter=300.0, hidden_scatter=7.0), lit=False)[0][CENTRE] == 64


def test_what_a_pilot_does_not_show_has_rays_too():
    """Half of all light over the root of 144 rays, 2400/24 = 100 e⁻/s, beside a scatter of 240; and never less than 64
    rays. A pixel without neighbours has but 32 rays of its own.
    """
    rays, scatter = rays_of(pilot_of(1, open_flux=2400, lit_scatter=240.0))
    assert scatter[CENTRE] == pytest.approx(260, rel=1e-5)
    assert rays[CENTRE] == pytest.approx((0.95 * 260 / WANTED) ** 2, rel=1e-4)
    assert rays_of(pilot_of(1))[0][CENTRE] == 64
    alone = Sites.alone(np.arange(121, dtype=np.uint32))
    units, lit = np.full(121, UNIT, np.float32), np.ones(121, bool)
    _, scatter = difference_of(pilot_of(1, open_flux=2400, lit_scatter=240.0), 0, lit, alone, units, QUALITY, TUNING)
    assert scatter[CENTRE] == pytest.approx(np.hypot(240, 1200 / 32**0.5), rel=1e-5)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_change_beside_a_pixel_may_reach_into_it(sign):
    """A 32nd of a pixel may have changed as the neighbour did: (0.95/ε)²·contrast²/32; two away, by its light alone."""
    moved = sign * 1500.0
    rays, _ = rays_of(pilot_of(1, lit=one_site(moved, sign * 150.0)))
    assert rays[CENTRE + 1] == pytest.approx((0.95 * 1350 / WANTED) ** 2 / 32, rel=1e-4)
    assert rays[CENTRE + 12] == rays[CENTRE + 1] > rays[CENTRE + 2]
    far, _ = rays_of(pilot_of(1, lit=one_site(sign * 16_000.0)))
    assert far[CENTRE + 2] == pytest.approx(0.25 * 16_000 / UNIT) and far[CENTRE + 3] == 64
    lamp, _ = rays_of(pilot_of(1, lit=one_site(sign * 1e6)))
    assert lamp[CENTRE + 2] == 512  # at most


def chosen(pilot, alone, rendered=None):
    shape = pilot.lit.shape
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
    pilot = pilot_of(4, lit_scatter=scatter, hidden_scatter=5e4)
    found = chosen(pilot, 1024)
    assert found.rays[:, CENTRE].tolist() == [64, 128, 128, 64] and found.lit.all()
    np.testing.assert_allclose(found.error[1:3, CENTRE], 0.95 * np.array([93, 143]) / np.sqrt(128), rtol=1e-5)
    # one window alone would take 128 rays and 128 in the first, which is as much as 256 of its own
    once = np.ones((4, 121), bool)
    once[1] = False
    assert chosen(pilot_of(4, lit_scatter=143.0, hidden_scatter=5e4), 512, once).rays[:, CENTRE].tolist() == [
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
    lit = np.array([[3.0], [900.0], [40.0], [500.0]])
    hidden = np.array([[8.0], [70.0], [600.0], [20.0]])
    found = chosen(pilot_of(4, lit_scatter=lit, hidden_scatter=hidden), 4096)
    # ends by themselves; the two windows between together: 940 against 670
    assert found.lit[:, CENTRE].tolist() == [True, False, False, False]


def test_pixels_with_small_objects_are_rendered_by_themselves():
    looks = [Closer(*(np.empty(0, kind) for kind in (int, int, np.float32, np.float32))) for _ in range(3)]
    looks[1] = Closer(np.array([7]), np.array([256]), np.zeros(1, np.float32), np.zeros(1, np.float32))
    rays = chosen(replace(pilot_of(3), closer=looks), 1024).rays
    assert rays[1, 7] == 0 and np.count_nonzero(rays == 0) == 1


def test_anchors_lie_at_multiples_of_64_ms_or_of_four_blocks():
    begin = np.array([129_999.0, 130_099, 130_199])
    assert anchor_us(begin, begin + 1) == (127_999, 128_000)
    ticks = np.arange(17) * 2000.0 + 130_000  # a block of 32 ms
    assert period_us(ticks) == 128_000 and anchor_us(ticks - 700, ticks) == (127_300, 128_000)


def test_small_asynchronous_sensors_have_longer_blocks():
    """By the size of the sensor, not of what is read out, so that a crop has the values of the whole."""
    assert [intervals_of(rows * cols) for rows, cols in ((260, 346), (480, 640), (720, 1280))] == [64, 32, 16]
    sensor = hr.load_sensor("davis346").crop(20, 12)
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


def shadow_scene():
    """A plate that turns before a wall in even light: its shadow is one wide penumbra."""
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "position_m": [0, 0, -0.09], "reflectance": 0.37}
    plate = {"name": "plate", "shape": "rectangle", "size_m": [0.14, 0.05, 0], "position_m": [0.01, 0, 0],
             "reflectance": 0.8, "pattern": 0.25, "pattern_count": [3, 2]}  # fmt: skip
    keys = [{"t_us": 0, "rotation_deg": 7}, {"t_us": 60_000, "rotation_deg": 95}]
    return make_scene(
        objects=[wall, plate],
        light={"type": "uniform", "illuminant": "D65", "illuminance_lux": 700},
        camera={"origin_m": [0, 0, 0.6], "target_m": [0, 0, 0], "horizontal_fov_deg": 24},
        motion=[{"object": "plate", "keyframes": keys}],
    )


def test_differences_have_no_bias_and_the_error_that_is_stated():
    """Every pair as a difference that may be one, with few rays: nine seeds against the mean of 16 times 4096 rays.

    The mean over pixels is right within four standard errors of the seeds; the rms error of pixels is what the halves
    say, within a tenth.
    """
    scene, few = shadow_scene(), replace(TUNING, difference_gain=0.0, difference_part=2.5)
    sensor = noisy(20, 14)
    runs = [ChangeDrivenFlux(scene, sensor, 0.5, seed, tuning=few) for seed in range(9)]
    got = np.array([fluxes(run, 0, 22_000) for run in runs])  # [seed, tick, half, pixel]
    tracer, ticks = ChangeDrivenFlux(scene, sensor, seed=99)._tracer, np.array([3, 9, 16])
    assert runs[0].counts.rays < 0.8 * rays_without(scene, sensor)
    ends = (ticks + 1) * 1250.0
    windows = Windows(ends - sensor.spec.evs.window_us, ends)
    pixel = np.tile(runs[0]._index[sensor.layout.evs_pixel.ravel()], 3)
    window = np.repeat(np.arange(3), pixel.size // 3)
    every = np.full(pixel.size, 4096), np.ones(pixel.size, bool)
    truth = np.mean([tracer.trace(pixel, window, windows, *every, repeat=k).mean for k in range(16)], axis=0)
    values = got[:, ticks].mean(axis=2).reshape(9, -1)
    stated = (0.5 * (got[:, ticks, 0] - got[:, ticks, 1])).reshape(9, -1)
    error = values - truth
    total = error.mean(axis=1)
    assert abs(total.mean()) < 4 * total.std(ddof=1) / 3
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.1)


def rays_without(scene, sensor):
    """Rays of the picture without any difference."""
    source = ChangeDrivenFlux(scene, sensor, 0.5, 0, tuning=replace(TUNING, difference_gain=1e9))
    fluxes(source, 0, 22_000)
    return source.counts.rays


def test_a_look_at_every_fourth_instant_finds_what_all_looks_find():
    """The same flux to the bit but at a few pairs, for fewer rays of the pilot."""
    sensor = hr.load_sensor("davis346", {"evs.threshold_mismatch_std": 0.02}).crop(40, 24)
    found = []
    for stride in (1, TUNING.look_stride):
        source = ChangeDrivenFlux(shadow_scene(), sensor, seed=4, tuning=replace(TUNING, look_stride=stride))
        pixels = source.sensor.layout.evs_pixel.ravel()
        samples = source.flux_of_blocks(pixels, source.sample_blocks(1, 30_000, 33_000))
        found.append((np.array([np.array(one.half_a) for one in samples]), source.counts.pilot_rays))
    (every, most), (some, fewer) = found
    assert np.ptp(every, axis=0).max() > 0.2 * every.max() and fewer < 0.7 * most
    assert np.mean(every != some) < 4e-3

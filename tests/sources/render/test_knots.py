"""Flux between knots: straight lines in time, per pixel, whatever the order in which windows are asked for."""

import pickle

import numpy as np
import pytest
from rendering import D65_1000_LUX, make_scene

import hesim_render as hr
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.event_blocks import BlockFlux, Knots, is_between, with_next
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux

CENTRE_US = np.array([3.0, 10, 30, 60, 100, 170])


def flux_of(seed, pixels):
    rng = np.random.default_rng(seed)
    return Flux(*(rng.uniform(2, 900, (CENTRE_US.size, pixels)).astype(np.float32) for _ in range(3)))


def known_of(seed, pixels):
    """Random knots; the first window is one, the last one of most pixels."""
    known = np.random.default_rng(seed).random((CENTRE_US.size, pixels)) < 0.4
    known[0] = True
    known[-1, ::3] = known[-1, 1::3] = True
    return known


def truth(flux, known):
    """NumPy's interpolation of each pixel; 0 after its last knot."""
    found = []
    for values in flux.arrays:
        out = np.zeros(values.shape)
        for pixel in range(values.shape[1]):
            own = np.flatnonzero(known[:, pixel])
            upto = slice(0, own[-1] + 1)
            out[upto, pixel] = np.interp(CENTRE_US[upto], CENTRE_US[own], values[own, pixel])
        found.append(out)
    return found


@pytest.mark.parametrize("order", [range(6), (4, 2, 3, 0, 5, 1)])
def test_flux_lies_on_straight_lines_between_knots(order):
    sizes, places = (7, 5), (np.array([11, 0, 3, 5, 6, 9, 2]), np.array([1, 4, 10, 8, 7]))
    fluxes = [flux_of(seed, size) for seed, size in enumerate(sizes)]
    knowns = [known_of(seed + 5, size) for seed, size in enumerate(sizes)]
    assert any((~known[-1]).any() for known in knowns)
    block = BlockFlux(12, [(p, Knots.of(f, k, CENTRE_US)) for p, f, k in zip(places, fluxes, knowns, strict=True)])
    for window in order:
        got = block.at(window)
        for place, flux, known in zip(places, fluxes, knowns, strict=True):
            for values, wanted in zip(got.at(place).arrays, truth(flux, known), strict=True):
                np.testing.assert_allclose(values[0], wanted[window], rtol=2e-6)


def test_a_knot_keeps_its_bits():
    flux, known = flux_of(3, 9), known_of(4, 9)
    block = BlockFlux(9, [(np.arange(9), Knots.of(flux, known, CENTRE_US))])
    for window in range(CENTRE_US.size):
        own = known[window]
        for values, wanted in zip(block.at(window).arrays, flux.arrays, strict=True):
            np.testing.assert_array_equal(values[0, own], wanted[window, own])


def test_a_block_of_no_pixel_has_no_flux():
    assert BlockFlux(0, []).at(2).half_a.shape == (1, 0)


def test_windows_asked_for_again_after_others_or_in_another_process_have_the_same_bits():
    block = BlockFlux(9, [(np.arange(9), Knots.of(flux_of(6, 9), known_of(7, 9), CENTRE_US))])
    every = [block.at(window) for window in range(CENTRE_US.size)]
    for flux in (block, pickle.loads(pickle.dumps(block))):
        for window in (2, 3, 1, 1, 4, 0, 1, 2):
            for values, wanted in zip(flux.at(window).arrays, every[window].arrays, strict=True):
                np.testing.assert_array_equal(values, wanted)


def test_joined_lists_stand_one_after_the_other():
    parts = [
        BlockFlux(size, [(np.arange(size)[::-1], Knots.of(flux_of(size, size), known_of(8, size), CENTRE_US))])
        for size in (4, 7)
    ]
    joined = BlockFlux.joined([parts[0], BlockFlux(0, []), parts[1], parts[0]])
    for window in (3, 4):
        wanted = [part.at(window).arrays for part in (*parts, parts[0])]
        for values, lists in zip(joined.at(window).arrays, zip(*wanted, strict=True), strict=True):
            np.testing.assert_array_equal(values, np.concatenate(lists, axis=1))


def test_a_time_between_the_first_two_windows_is_on_the_line_to_the_next_knot():
    """At 5.1 µs, between 3 and 10; a pixel without a second knot keeps its flux."""
    flux, known = flux_of(2, 9), known_of(9, 9)
    known[1:, 4], known[1, 5] = False, True
    block = BlockFlux(12, [(np.arange(9) + 2, Knots.of(flux, known, CENTRE_US))])
    for values, given in zip(block.between(5.1).at(0).arrays, flux.arrays, strict=True):
        assert not values[0, [0, 1, 11]].any()
        for pixel in range(9):
            own = np.flatnonzero(known[:, pixel])
            wanted = np.interp(5.1, CENTRE_US[own], given[own, pixel])
            np.testing.assert_allclose(values[0, pixel + 2], wanted, rtol=2e-6)


def windows(*times):
    """A block of windows, from pairs of begin and end."""
    begin, end = np.array(times, float).T
    return Block(begin, end, np.ones(begin.size, np.bool_))


@pytest.mark.parametrize(("single", "following", "is_it"), [
    ([(0, 3)], [(-3, 0), (40, 43), (90, 93)], True),
    ([(0, 3)], [(0, 3), (40, 43)], True),
    ([(40, 43)], [(-3, 0), (40, 43), (90, 93)], True),
    ([(0, 3), (1, 4)], [(-3, 0), (40, 43)], False),  # not single
    ([(41, 44)], [(-3, 0), (40, 43), (90, 93)], False),  # behind the second window
    ([(-4, -1)], [(-3, 0), (40, 43)], False),  # before the first one
    ([(-3, 0)], [(-3, 0)], False),  # nothing to lie between
])  # fmt: skip
def test_which_windows_lie_between_those_of_the_block_that_follows(single, following, is_it):
    assert is_between(windows(*single), windows(*following)) is is_it


def test_blocks_know_the_next_one():
    assert list(with_next("abc")) == [("a", "b"), ("b", "c"), ("c", None)] and not list(with_next([]))


def test_the_window_with_which_a_run_begins_takes_no_ray():
    """A plate slides before a wall: as many rays as without this window, whose flux is on the line between knots."""
    plate = {"name": "plate", "shape": "rectangle", "size_m": [0.05, 0.07, 0], "position_m": [0.01, 0.02, 0.1]}
    wall = {"name": "wall", "shape": "rectangle", "size_m": [3, 3, 0], "reflectance": 0.2}
    keys = [{"t_us": -500}, {"t_us": 40_000, "translation_m": [0.1, 0.02, 0]}]
    scene = make_scene(
        objects=[{**plate, "reflectance": 0.6, "rotation_deg": 12}, wall], light=D65_1000_LUX,
        camera={"origin_m": [0, 0, 1.5], "horizontal_fov_deg": 20}, motion=[{"object": "plate", "keyframes": keys}],
    )  # fmt: skip
    sensor, pixels = hr.load_sensor("davis346").crop(40, 30), np.arange(40 * 30, dtype=np.uint32)
    seen, rays = [], []
    for skip in (0, 1):
        source = ChangeDrivenFlux(scene, sensor, seed=8)
        blocks = list(source.sample_blocks(1, 0, 1500))[skip:]
        assert blocks[0].wanted.size == 1 or skip
        if skip:
            # the window before the run, of which the line begins
            blocks[0].wanted[0] = True
        seen.append([[np.array(s.half_a), np.array(s.half_b), s.error] for s in source.flux_of_blocks(pixels, blocks)])
        rays.append(source.rays_traced)
    assert rays[0] == rays[1] and np.unique(seen[0][0]).size > 10
    np.testing.assert_array_equal(seen[0][1:], seen[1][1:])
    middle = 0.5 * (blocks[0].begin_us + blocks[0].end_us)
    begin, end = np.array(seen[1][:2], np.float64)
    moved = np.abs(end - begin)[:2] > 0
    assert 0.01 < moved.mean() < 0.95
    wanted = begin + (0.5 - middle[0]) / (middle[1] - middle[0]) * (end - begin)
    np.testing.assert_allclose(seen[0][0], wanted, rtol=2e-6)

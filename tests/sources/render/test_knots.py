"""Flux between knots: straight lines in time, per pixel, whatever the order in which windows are asked for."""

import pickle

import numpy as np
import pytest

from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.event_blocks import BlockFlux, Knots

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

"""Flux between knots: straight lines over the middles of windows, however windows are asked for."""

import pickle

import numpy as np
import pytest

from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.event_blocks import BlockFlux, Knots

WINDOWS, SIZE = 13, 40


@pytest.fixture(scope="module")
def made():
    """Flux of two lists of pixels with knots at random windows, and what it is by NumPy, [3, window, pixel]."""
    rng = np.random.default_rng(5)
    centre_us = 300 + np.cumsum(rng.uniform(20, 90, WINDOWS))
    order = rng.permutation(SIZE)
    parts, truth = [], np.zeros((3, WINDOWS, SIZE))
    for place in (np.sort(order[:23]), np.sort(order[23:])):
        known = rng.random((WINDOWS, place.size)) < 0.3
        known[0], known[-1] = True, rng.random(place.size) < 0.7
        values = rng.uniform(50, 900, (3, WINDOWS, place.size)).astype(np.float32)
        parts.append((place, Knots.of(Flux(*values), known, centre_us)))
        for k, pixel in enumerate(place):
            at = np.flatnonzero(known[:, k])
            for truth_of, value in zip(truth, values, strict=True):
                line = np.interp(centre_us, centre_us[at], value[at, k])
                # behind the last knot nothing is known
                truth_of[:, pixel] = np.where(np.arange(WINDOWS) <= at[-1], line, 0)
    return BlockFlux(SIZE, parts), truth


def values_of(flux, windows):
    return np.stack([np.concatenate(flux.at(window).arrays) for window in windows], axis=1)


def test_windows_in_order_are_straight_lines_between_knots(made):
    flux, truth = made
    np.testing.assert_allclose(values_of(flux, range(WINDOWS)), truth, rtol=3e-6)


def test_windows_in_any_order_and_again_have_the_same_bits(made):
    flux, _ = made
    every = values_of(flux, range(WINDOWS))
    order = [7, 8, 3, 3, 12, 0, 1, 2, 11]
    np.testing.assert_array_equal(values_of(flux, order), every[:, order])
    sent = pickle.loads(pickle.dumps(flux))
    np.testing.assert_array_equal(values_of(sent, order), every[:, order])


def test_joined_lists_stand_one_after_the_other(made):
    flux, truth = made
    joined = BlockFlux.joined([flux, BlockFlux(0, []), flux])
    np.testing.assert_allclose(values_of(joined, [4, 5]), np.concatenate([truth, truth], axis=2)[:, [4, 5]], rtol=3e-6)

"""Pixels are rendered in bands to bound memory. No value depends on how a list of pixels is divided into them."""

import tracemalloc
import weakref

import numpy as np
import pytest
from test_change_driven import ball_before_a_wall, noisy

import hesim_render as hr
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.estimates import Flux, Still
from hesim_render.sources.render.change_driven.event_blocks import Blocks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.neighbours import Lattice, RowWindows, Sites, squares
from hesim_render.sources.render.change_driven.one_window import render_one_window


def test_parts_are_about_square_and_hold_each_pixel_once():
    rng = np.random.default_rng(4)
    # a region of 61 × 337 pixels away from the corner, of which a few are missing, in any order
    row, col = (values.ravel()[: 61 * 337 - 400] for values in np.mgrid[13:74, 29:366])
    order = rng.permutation(row.size)
    row, col, most = row[order], col[order], 700
    parts = squares(row, col, most)
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(row.size))
    assert max(part.size for part in parts) <= most and len(parts) <= 1.5 * row.size / most
    lattice = Lattice.whole(80, 400)
    around = [Sites.around(lattice.index(row[part], col[part]), lattice).size for part in parts]
    # three pixels around squares of 26 × 26 are half as many as those in them, around two rows of 337 thrice as many
    assert sum(around) < 1.65 * row.size
    # each part by row, then by column
    for part in [*parts, *squares(row, col, row.size)]:
        assert np.all(np.diff(row[part] * 400 + col[part]) > 0)
    assert len(squares(row, col, row.size)) == 1 and squares(row[:0], col[:0], most) == []


def test_rows_without_listed_pixels_have_the_window_of_the_nearest_one():
    of_rows = RowWindows(np.array([12, 5, 12, 6]), np.array([3, 9, 3, 7]))
    assert of_rows.at(np.array([0, 5, 6, 8, 10, 12, 40])).tolist() == [9, 9, 7, 7, 3, 3, 3]


def test_constant_pixels_have_the_flux_that_they_were_noted_with_and_take_no_memory_beside_it():
    rng, count = np.random.default_rng(8), 3_000_000
    pixel = rng.permutation(count)[:70_000].astype(np.uint32)
    flux = Flux(*(rng.uniform(1, 9, (1, pixel.size)).astype(np.float32) for _ in range(3)))
    tracemalloc.start()
    still, begin = Still((-5.0, 70.0), count), 0
    for end in (20_000, 23_000, 70_000):
        still.put(pixel[begin:end], flux.at(slice(begin, end)))
        # of those that are known by now, in any order
        asked = rng.permutation(end)[: end // 2]
        for values, given in zip(still.at(pixel[asked]).arrays, flux.at(asked).arrays, strict=True):
            np.testing.assert_array_equal(values, given)
        np.testing.assert_array_equal(np.flatnonzero(still.known), np.sort(pixel[:end]))
        begin = end
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # a byte of every pixel, and four numbers of those that are known
    assert held < 1.3 * (count + 16 * pixel.size)


@pytest.fixture
def small_bands(monkeypatch):
    """Bands of so many pixels."""
    return lambda most: monkeypatch.setattr(adaptive, "pixels_at_once", lambda *_: most)


@pytest.mark.slow
def test_events_are_the_same_in_small_bands(small_bands):
    sensor = hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(46, 30, 151, 113)

    def flux():
        source = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor, seed=6)
        pixel, blocks = source.sensor.layout.evs_pixel.ravel(), source.sample_blocks(1, 0, 2500)
        return np.array([np.array(one.half_a) for one in source.flux_of_blocks(pixel, blocks)])

    whole = flux()
    small_bands(300)
    np.testing.assert_array_equal(flux(), whole)
    assert np.any(np.ptp(whole, axis=0) > 0)


@pytest.mark.slow
def test_memory_of_a_block_is_that_of_a_band(small_bands):
    """Tables of 65 windows of 64 × 48 pixels take 0.8 MB each, of which a block without bands holds two dozen."""
    sensor, peaks = hr.load_sensor("davis346", {"evs.threshold_mismatch_rel": 0.02}).crop(64, 48, 141, 107), []
    for most in (64 * 48, 400):
        small_bands(most)
        source = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor, seed=6)
        pixel, blocks = source.sensor.layout.evs_pixel.ravel(), source.sample_blocks(1, 0, 1000)
        tracemalloc.start()
        for _ in source.flux_of_blocks(pixel, blocks):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    whole, in_bands = peaks
    assert whole > 12e6 and in_bands < 0.4 * whole


def test_frames_of_a_rolling_shutter_are_the_same_in_small_bands(small_bands):
    """Neighbours beyond a band have the exposure of their own row, in which the picture may be another one."""
    sensor = hr.load_sensor("eiger", {"aps.shutter": "rolling"}).crop(44, 40, 1608, 1204)
    scene = hr.load_scene("rotating-star")

    def flux():
        source = ChangeDrivenFlux(scene, sensor, seed=6)
        pixel = np.arange(44 * 40, dtype=np.uint32)
        begin_us = 3000.0 * (pixel // 44)
        return np.array(source.mean_flux(pixel, begin_us, begin_us + 700))

    whole = flux()
    small_bands(200)
    np.testing.assert_array_equal(flux(), whole)


@pytest.mark.parametrize("moves", [True, False])
def test_the_rays_of_all_pixels_are_kept_only_where_nearly_all_may_change(small_bands, moves):
    small_bands(500)
    sensor = noisy(64, 48)
    source = ChangeDrivenFlux(hr.load_scene("camera-sweep") if moves else ball_before_a_wall(), sensor, seed=2)
    pixel = source.sensor.layout.evs_pixel.ravel()
    begin = np.zeros(pixel.size)
    kept = render_one_window(
        source._renderer, pixel, begin, begin + 900, "events", Flux.zeros(1, pixel.size), keep=(0.0, 2000.0)
    )
    assert sum(band.place.size for band, _ in kept) == (pixel.size if moves else 0)


def test_a_block_is_rendered_when_the_one_before_is_no_longer_held(monkeypatch):
    """The knots of a block of a large sensor take tens of megabytes."""
    sensor = hr.load_sensor("davis346").crop(12, 10, 174, 130)
    source = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor, seed=6)
    take, taken = Blocks.take, []

    def watched(self, block, following):
        assert all(one() is None for one in taken)
        flux = take(self, block, following)
        taken.append(weakref.ref(flux))
        return flux

    monkeypatch.setattr(Blocks, "take", watched)
    for _ in source.flux_of_blocks(sensor.layout.evs_pixel.ravel(), source.sample_blocks(1, 0, 40_000)):
        pass
    assert len(taken) > 1


def test_every_ray_of_a_run_is_counted():
    """0.07 s of an asynchronous sensor: a block begins with a new anchor, which is one of its own windows."""
    sensor = hr.load_sensor("davis346").crop(12, 10, 174, 130)
    source = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor, seed=6)
    pixel, blocks = source.sensor.layout.evs_pixel.ravel(), list(source.sample_blocks(1, 0, 70_000))
    assert len(blocks) > 1
    for _ in source.flux_of_blocks(pixel, blocks):
        pass
    assert source.counts.rays + source.counts.pilot_rays == source.rays_traced > 0

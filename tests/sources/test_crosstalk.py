"""Crosstalk: its kernel, that no electron is lost, and both roles of pixels behind it."""

import dataclasses

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.recording.frame import Frame
from hesim_render.sources.crosstalk import CrosstalkFlux, mixed, with_crosstalk
from hesim_render.sources.still import WindowByWindow

PART = 0.12


class Still(WindowByWindow):
    """A source that shows an image of flux, e⁻/s, with two halves that differ."""

    is_static = True

    def __init__(self, image):
        self.image, self.asked = np.asarray(image, dtype=float), []

    def slice_edges_us(self, begin_us, end_us):
        return np.empty(0)

    sample_times_us = slice_edges_us

    def level(self, begin_us, end_us):
        return 1.0

    def mean_flux(self, pixel, begin_us, end_us):
        assert pixel.dtype == np.uint32
        self.asked.append(pixel)
        values = self.image.ravel()[pixel] * self.level(np.asarray(begin_us), np.asarray(end_us))
        return from_host(jit().Float, 1.01 * values), from_host(jit().Float, 0.99 * values)


class Rising(Still):
    """Light that grows in proportion to time."""

    is_static = False

    def slice_edges_us(self, begin_us, end_us):
        edges = np.arange(3000.0, end_us, 3000.0)
        return edges[edges > begin_us]

    sample_times_us = slice_edges_us

    def level(self, begin_us, end_us):
        return 0.5e-6 * (begin_us + end_us)


def kernel_by_hand(image, part):
    """Every pixel gives part/4 to each neighbour it has and keeps the rest."""
    result = np.zeros_like(image, dtype=float)
    rows, cols = image.shape
    for i in range(rows):
        for j in range(cols):
            given = 0.0
            for y, x in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                if 0 <= y < rows and 0 <= x < cols:
                    result[y, x] += part / 4 * image[i, j]
                    given += part / 4
            result[i, j] += (1 - given) * image[i, j]
    return result


def halves_mean(halves):
    return 0.5 * (np.array(halves[0], dtype=float) + np.array(halves[1], dtype=float))


def test_kernel_conserves_electrons():
    image = np.random.default_rng(0).uniform(0, 1000, (7, 11))
    expected = kernel_by_hand(image, PART)
    assert expected.sum() == pytest.approx(image.sum(), rel=1e-12)
    np.testing.assert_allclose(mixed(image, PART), expected, rtol=1e-12)
    np.testing.assert_allclose(mixed(np.full((5, 5), 3.0), PART), 3.0, rtol=1e-12)
    source = CrosstalkFlux(Still(image), image.shape, PART)
    everything = halves_mean(source.mean_flux(np.arange(77, dtype=np.uint32), 0.0, 10.0))
    np.testing.assert_allclose(everything, expected.ravel(), rtol=1e-6)
    half_a, half_b = source.mean_flux(np.arange(77, dtype=np.uint32), 0.0, 10.0)
    np.testing.assert_allclose(np.array(half_a) / np.array(half_b), 1.01 / 0.99, rtol=1e-6)


def test_listed_pixels_get_the_same_and_only_neighbours_are_asked_for():
    image = np.random.default_rng(1).uniform(0, 1000, (9, 8))
    still = Still(image)
    listed = np.array([50, 0, 71, 13], dtype=np.uint32)  # any order, corners too
    found = halves_mean(CrosstalkFlux(still, image.shape, PART).mean_flux(listed, 0.0, 1.0))
    np.testing.assert_allclose(found, kernel_by_hand(image, PART).ravel()[listed], rtol=1e-6)
    neighbours = {50, 42, 58, 49, 51, 0, 1, 8, 71, 70, 63, 13, 12, 14, 5, 21}
    assert {int(p) for p in still.asked[0]} == neighbours and len(still.asked[0]) == len(neighbours)
    assert with_crosstalk(still, image.shape, 0.0) is still


def test_each_pixel_collects_over_its_own_interval():
    image = np.random.default_rng(2).uniform(0, 1000, (6, 5))
    begin = np.repeat(np.arange(6) * 100.0, 5)
    end = begin + np.repeat(np.arange(6) * 10.0 + 500.0, 5)
    found = halves_mean(
        CrosstalkFlux(Rising(image), image.shape, PART).mean_flux(np.arange(30, dtype=np.uint32), begin, end)
    )
    np.testing.assert_allclose(found, kernel_by_hand(image, PART).ravel() * 0.5e-6 * (begin + end), rtol=1e-6)


def captured(name, source, without=(), part=PART, duration_us=40_000):
    """Mean electrons of the first frame [row, col] and mean flux of the event pixels [y, x]."""
    sensor = hr.load_sensor(name, {"geometry.crosstalk": part}).crop(48, 24)
    aps, evs = noise_models(sensor, without=without)
    aps = dataclasses.replace(aps, spec=aps.spec.model_copy(update={"exposure_us": 5000}))
    capture = Capture(source, sensor, aps, evs, duration_us, seed=1)
    frames = [item for item in capture.run() if isinstance(item, Frame)]
    return sensor, frames[0], capture.event_flux.mean_e_per_s().reshape(sensor.layout.evs_shape)


@pytest.mark.parametrize("name", ("mipi-hybridevs", "reference-mono", "eiger"))
def test_frames_and_events_of_a_static_scene(name):
    image = np.random.default_rng(3).uniform(0, 50_000, (24, 48))
    for without, aps_part, evs_part in (
        ((), PART, PART), (("aps.crosstalk",), 0, PART), (("evs.crosstalk",), PART, 0),
        (("aps.crosstalk", "evs.crosstalk"), 0, 0),
    ):  # fmt: skip
        still = Still(image)
        sensor, frame, events = captured(name, still, without)
        assert len(still.asked) == (1 if aps_part == evs_part else 2)
        valid = sensor.layout.aps_mask
        expected = kernel_by_hand(image, aps_part) * 5e-3
        np.testing.assert_allclose(frame.electrons_mean[valid], expected[valid], rtol=1e-5)
        np.testing.assert_allclose(frame.electrons_stderr[valid], 0.01 * expected[valid], rtol=1e-3)
        place = sensor.layout.evs_pixel
        np.testing.assert_allclose(events, kernel_by_hand(image, evs_part).ravel()[place], rtol=1e-5)


def test_light_on_event_pixels_alone_reaches_frame_pixels_and_back():
    """mipi-hybridevs has them apart: at (1, 1) and (3, 3) of each 4×4 tile."""
    sensor = hr.load_sensor("mipi-hybridevs").crop(48, 24)
    image = np.where(sensor.layout.aps_mask, 0.0, 1e5)
    _, frame, events = captured("mipi-hybridevs", Still(image))
    np.testing.assert_allclose(events[:-1, :-1], (1 - PART) * 1e5, rtol=1e-5)
    # what frame pixels received is what event pixels lost; those at the border lost less
    assert np.nansum(frame.electrons_mean) == pytest.approx((1e5 * events.size - events.sum()) * 5e-3, rel=1e-5)
    assert frame.electrons_mean[1, 2] == pytest.approx(PART / 4 * 500.0, rel=1e-5)


def test_rolling_shutter_in_changing_light():
    """Row r integrates from r lines on: its neighbours' light over that time, closed form for light ∝ t."""
    image = np.random.default_rng(4).uniform(0, 50_000, (24, 48))
    sensor, frame, events = captured("eiger", Rising(image), duration_us=400_000)
    middle_us = frame.exposure_start_us + frame.line_time_us * np.arange(24) + 2500.0
    expected = kernel_by_hand(image, PART) * 1e-6 * middle_us[:, None] * 5e-3
    valid = sensor.layout.aps_mask
    np.testing.assert_allclose(frame.electrons_mean[valid], expected[valid], rtol=1e-5)
    ratio = events / kernel_by_hand(image, PART).ravel()[sensor.layout.evs_pixel]
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=1e-5)


def test_bench_of_the_lab_sees_it_too():
    from hesim_render.capture.lab_bench import set_up

    sensor = hr.load_sensor("eiger", {"geometry.crosstalk": PART}).crop(80, 48)
    bench = set_up(sensor, (1000, 4000))
    expected = kernel_by_hand(bench.flux_e_per_s, PART)
    np.testing.assert_allclose(bench.frame_flux_e_per_s, expected, rtol=1e-12)
    signal = expected.ravel()[sensor.layout.evs_pixel] * bench.event_dn_per_e_per_s
    np.testing.assert_allclose(bench.event_signal_dn, signal, rtol=1e-12)
    plain = set_up(sensor, (1000, 4000), without=("aps.crosstalk", "evs.crosstalk"))
    np.testing.assert_array_equal(plain.frame_flux_e_per_s, plain.flux_e_per_s)

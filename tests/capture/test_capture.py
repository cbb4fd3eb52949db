"""The capture loop against closed forms, with sources of flux that are formulas, not renders."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core.backend import jit
from hesim_render.core.errors import RangeError
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import exposures, tick_blocks
from hesim_render.sources.still import WindowByWindow


class RampFlux(WindowByWindow):
    """Φ = (1 + col) · (base + slope · t), exactly integrated; halves differ by ±1 % if asked to."""

    is_static = False

    def __init__(self, sensor, base=1e5, slope=2e6, edges=(), split=0.0, pace_us=1000.0):
        self.cols, self.base, self.slope = sensor.cols, base, slope
        self.edges, self.split, self.pace_us = np.asarray(edges, dtype=float), split, pace_us
        self.calls = 0

    def slice_edges_us(self, begin_us, end_us):
        return self.edges[(self.edges > begin_us) & (self.edges < end_us)]

    def sample_times_us(self, begin_us, end_us):
        return np.arange(begin_us + self.pace_us, end_us, self.pace_us)

    def mean_flux(self, pixel, begin_us, end_us):
        self.calls += 1
        middle = 0.5 * (np.asarray(begin_us, dtype=float) + np.asarray(end_us, dtype=float)) * 1e-6
        flux = (1.0 + pixel % self.cols) * (self.base + self.slope * middle)
        types = jit()
        return from_host(types.Float, flux * (1 + self.split)), from_host(types.Float, flux * (1 - self.split))


def run(flux, sensor, duration_us, clean=True, seed=1):
    aps, evs = noise_models(sensor, clean=clean)
    frames, events = [], []
    for item in Capture(flux, sensor, aps, evs, duration_us, seed).run():
        (events if isinstance(item, np.ndarray) else frames).append(item)
    return frames, np.concatenate(events) if events else None


def test_exposures_end_inside_the_run_and_carry_their_times():
    spec = hr.load_sensor("eiger").spec.aps
    # 10 ms + 383 rows × 14.2 µs = 15.4386 ms after the start of the frame
    assert [e.start_us for e in exposures(spec, 384, 15_438)] == []
    assert [e.t_us for e in exposures(spec, 384, 15_439)] == [10_000]
    assert [e.start_us for e in exposures(spec, 384, 400_000)] == [0, 125_000, 250_000, 375_000]
    blocks = tick_blocks(hr.load_sensor("eiger").spec.evs, 0, 5000)
    assert [t for block in blocks for t in block.end_us[block.wanted]] == [1239, 2478, 3717, 4956]


@pytest.mark.parametrize("edges", [(), np.arange(137.0, 100_000, 137.0)], ids=["one slice", "many slices"])
def test_rolling_shutter_integrates_each_rows_own_window(edges):
    sensor = hr.load_sensor("gen2").crop(16, 32)
    frames, _ = run(RampFlux(sensor, edges=edges), sensor, 100_000)
    # GEN2: 20 frames/s, 10 ms, 14.3 µs a row; the second frame would end at 60.4 ms
    assert [f.t_us for f in frames] == [10_000, 60_000]
    rows = np.arange(32)[:, None]
    for frame, start in zip(frames, (0, 50_000), strict=True):
        middle_s = (start + rows * 14.3 + 5000) * 1e-6
        expected = (1 + np.arange(16)[None, :]) * (1e5 + 2e6 * middle_s) * 0.010
        valid = sensor.layout.aps_mask
        np.testing.assert_allclose(frame.electrons_mean[valid], expected[valid], rtol=2e-6)
        assert np.isnan(frame.electrons_mean[~valid]).all() and (frame.raw[~valid] == 0).all()


def test_slices_do_not_change_the_electrons():
    sensor = hr.load_sensor("gen2").crop(24, 16)
    one, _ = run(RampFlux(sensor), sensor, 30_000)
    many, _ = run(RampFlux(sensor, edges=np.linspace(50, 29_950, 333)), sensor, 30_000)
    np.testing.assert_allclose(one[0].electrons_mean, many[0].electrons_mean, rtol=2e-6)


def test_standard_error_is_half_the_difference_of_the_halves_accumulated_over_time():
    sensor = hr.load_sensor("gen2").crop(24, 16)
    frames, _ = run(RampFlux(sensor, edges=np.arange(500.0, 30_000, 500), split=0.01), sensor, 30_000)
    valid = frames[0].valid
    np.testing.assert_allclose(frames[0].electrons_stderr[valid], 0.01 * frames[0].electrons_mean[valid], rtol=1e-4)


def test_event_window_straddling_slices_is_integrated_whole():
    """ON events of a clean ramp: ticks at which ln(x₁/x₀) of the window electrons passes θ."""
    sensor = hr.load_sensor("reference-mono").crop(8, 4)
    spec = sensor.spec.evs
    for edges in ((), np.arange(333.0, 40_000, 333.0)):
        _, events = run(RampFlux(sensor, slope=1e7, edges=edges), sensor, 40_000)
        t = np.arange(1, 41) * 1000e-6
        signal = np.multiply.outer(1.0 + np.arange(8), (1e5 + 1e7 * (t - 0.5e-3)) * 1e-3)  # electrons of 1 ms
        x = signal * 0.2 * 10 + 1.0  # I = K·N·t_ref/t_evs; x = β1 I + β2
        fires = np.diff(np.log(x), axis=1) > spec.contrast_threshold_on
        expected = {(int(1000 * (k + 2)), c) for c in range(8) for k in np.flatnonzero(fires[c])}
        assert {(int(e["t_us"]), int(e["x"])) for e in events} == expected
        assert len(events) == 4 * len(expected) and (events["polarity"] == 1).all()


def test_last_event_sensor_samples_at_the_sources_own_pace():
    sensor = hr.load_sensor("davis346").crop(4, 2)
    flux = RampFlux(sensor, base=1e5, slope=4e6, pace_us=500.0)
    _, events = run(flux, sensor, 50_000)
    assert len(events) > 20 and (np.diff(events["t_us"]) >= 0).all()
    # clean: crossings of ln x at multiples of θ above the first sample (t = 1 µs), x = β1 K Φ t_ref + β2
    x0 = (1e5 + 4e6 * 0.5e-6) * 0.036 * 0.010 + 5.0
    levels = x0 * np.exp(0.2 * np.arange(1, 40))
    times = ((levels - 5.0) / (0.036 * 0.010) - 1e5) / 4e6 * 1e6
    first_pixel = events[(events["x"] == 0) & (events["y"] == 0)]["t_us"]
    expected = times[times < 50_000]
    assert len(first_pixel) == len(expected)
    # ln x between samples 500 µs apart is a curve, taken as a line: (Δt)²/8 · curvature, below 10 µs here
    np.testing.assert_allclose(first_pixel, expected, atol=12)


def test_static_source_is_asked_once():
    sensor = hr.load_sensor("gen2").crop(24, 16)
    flux = RampFlux(sensor, slope=0.0)
    flux.is_static = True
    frames, events = run(flux, sensor, 100_000)
    assert flux.calls == 1 and len(frames) == 2 and len(events) == 0
    np.testing.assert_allclose(frames[1].electrons_mean[0, 5], 6 * 1e5 * 0.010, rtol=1e-6)


def test_unknown_noise_term_is_named():
    with pytest.raises(RangeError, match=r"aps\.thermal.*aps\.read"):
        noise_models(hr.load_sensor("eiger"), without=["aps.thermal"])

"""Events that a motion gives, from brightness in closed form; and the outline of a ball as rays touch it."""

from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.truth import motion_look
from hesim_render.sources.render.truth.boxes import _outline


def expected(monkeypatch, spec, log_of, fast=0.0, duration_us=40_000, pixels=900):
    """The forecast of a hybrid sensor of 48 × 80 px, whose event pixels are 12 × 20, for ln brightness of (x, y, t)."""
    monkeypatch.setattr(motion_look, "_PIXELS", pixels)
    monkeypatch.setattr(motion_look, "_seen", lambda rays, col, row, t_us: np.exp(log_of(col, row, t_us)))
    sensor = hr.load_sensor("gen2").crop(80, 48)
    return motion_look._events(SimpleNamespace(sensor=sensor), spec, duration_us, fast), sensor


@pytest.mark.parametrize(("pixels", "stride", "shape"), [(900, 1, (12, 20)), (100, 2, (6, 10)), (20, 4, (3, 5))])
def test_a_steady_rise_gives_its_thresholds_in_every_pixel(monkeypatch, pixels, stride, shape):
    """1.3 in ln are six events of 0.2 from each pixel in 40 ms; the pixels that are asked stand for all 240."""
    spec = SimpleNamespace(contrast_threshold_on=0.2, contrast_threshold_off=0.35, reference="last_event", tick_us=None)
    speed = motion_look._STEP_PX / 0.001  # a sample each ms
    found, _ = expected(monkeypatch, spec, lambda x, y, t: 0 * x + 1.3 * t / 40_000, speed, pixels=pixels)
    assert found.stride == stride and found.density_hz.shape == shape and found.rates_hz.size == 40
    np.testing.assert_allclose(found.density_hz, 6 / 0.04)
    assert found.mean_hz == pytest.approx(6 * 240 / 0.04)
    falling, _ = expected(monkeypatch, spec, lambda x, y, t: 0 * x - 1.3 * t / 40_000, pixels=pixels)
    assert falling.rates_hz.size == 1 and falling.mean_hz == pytest.approx(3 * 240 / 0.04)


def test_places_are_those_of_the_event_pixels(monkeypatch):
    """Only the pixels right of column c and below row r of the mosaic, at the sensor's own places, brighten."""
    spec = SimpleNamespace(contrast_threshold_on=0.2, contrast_threshold_off=0.35, reference="last_event", tick_us=None)
    layout = hr.load_sensor("gen2").crop(80, 48).layout
    cut = layout.col0 + 31, layout.row0 + 17
    found, _ = expected(monkeypatch, spec, lambda x, y, t: ((x > cut[0]) & (y > cut[1])) * 0.5 * t / 40_000)
    place = layout.evs_pixel.reshape(layout.evs_shape)
    lit = (place % layout.cols > 31) & (place // layout.cols > 17)
    np.testing.assert_array_equal(found.density_hz > 0, lit)


def test_fixed_ticks_see_the_change_of_one_tick(monkeypatch):
    """A rise of 0.25 within each of the first ten ticks of 1000 µs is an event of each pixel and tick; 0.15 is none."""
    spec = SimpleNamespace(
        contrast_threshold_on=0.2, contrast_threshold_off=0.2, reference="previous_sample", tick_us=1000
    )
    for rise, events in ((0.25, 10), (0.15, 0), (-0.25, 10)):
        found, _ = expected(
            monkeypatch, spec, lambda x, y, t, rise=rise: 0 * x + rise * min(t / 1000, 10), motion_look._STEP_PX / 0.002
        )
        assert found.rates_hz.size == 20  # two ticks a sample
        np.testing.assert_allclose(found.density_hz, events / 0.04, atol=1e-9)


def test_rays_touch_a_ball_on_its_outline():
    """Each point is on the ball, and the ray to it is at right angles with the radius there; they go all around."""
    middle, radius = np.array([0.4, -0.7, 2.1]), 0.6
    points = _outline(middle, radius)
    np.testing.assert_allclose(np.linalg.norm(points - middle, axis=1), radius, rtol=1e-12)
    np.testing.assert_allclose(np.sum(points * (points - middle), axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0) / middle, 1 - radius**2 / (middle @ middle), rtol=1e-9)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    np.testing.assert_allclose(steps, steps[0])
    assert len(np.unique(points.round(9), axis=0)) == len(points)
    assert np.isnan(_outline(middle, 2.3)).all()

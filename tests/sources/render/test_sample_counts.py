"""Counts and figures that rounding of double precision would make one smaller."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.sources.render.audit.audit import _rounded_down
from hesim_render.sources.render.truth import imu


@pytest.mark.parametrize(("rate_hz", "count"), [(330.0, 3), (300.0, 7), (900.0, 59)])
def test_a_sample_ends_with_the_run(monkeypatch, rate_hz, count):
    """Of a camera at rest: gravity alone. The quotient of so many periods and one is below their number."""
    period_us = 1e6 / rate_hz
    monkeypatch.setattr(imu, "_velocity", lambda camera, place, edges: np.zeros((edges.size, 3)))
    view = SimpleNamespace(camera_to_world=np.eye(4))
    rays = SimpleNamespace(
        camera_to_world=lambda times: np.broadcast_to(np.eye(4), (np.size(times), 4, 4)), camera=None, view=view
    )
    for end_us, expected in ((period_us * count, count), (period_us * (count - 0.01), count - 1)):
        found = imu.imu_samples(rays, imu.ImuModel(rate_hz=rate_hz), 0.0, end_us, 3)
        np.testing.assert_allclose(found.t_us, period_us * np.arange(1, expected + 1))
    assert (period_us * count) / period_us < count or count * 1e6 / rate_hz / period_us < count


@pytest.mark.parametrize(("value", "shown"), [(0.29, 0.29), (0.2999, 0.29), (0.57, 0.57), (5.8, 5.8), (0.0346, 0.034)])
def test_a_quality_is_rounded_down_to_two_digits(value, shown):
    assert _rounded_down(value) == pytest.approx(shown, rel=1e-9)

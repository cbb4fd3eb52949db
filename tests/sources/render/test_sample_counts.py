"""Counts and figures that rounding of double precision would make one smaller."""

from types import SimpleNamespace

import numpy as np
import pytest

from hesim_render.sources.render import timeline
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


def test_vertices_of_a_deforming_mesh_are_taken_some_at_a_time(monkeypatch):
    """Eleven vertices, four at once: each once, in order."""
    monkeypatch.setattr(timeline, "_CHUNK", 4)
    vertices = np.arange(2 * 11 * 3.0).reshape(2, 11, 3)

    def part(which):
        return SimpleNamespace(at=lambda times: np.stack([vertices[0, which] + t for t in times]))

    made = timeline.Timeline.__new__(timeline.Timeline)
    made._deformations, made._corners = {"a": SimpleNamespace(vertices_m=vertices, part=part)}, {"b": vertices[0, :8]}
    found = list(made._points("a", np.array([0.0, 5.0])))
    assert [points.shape[1] for points in found] == [4, 4, 3]
    np.testing.assert_array_equal(np.concatenate(found, axis=1), np.stack([vertices[0], vertices[0] + 5]))
    (corners,) = made._points("b", np.zeros(1))
    assert corners is made._corners["b"]


def test_a_camera_at_rest_is_sampled_at_the_edges_of_slices_alone():
    made = timeline.Timeline.__new__(timeline.Timeline)
    made._camera, made.edges_us = None, lambda begin, end: np.array([30.0, 70.0, 90.0])
    assert made.sample_times_us(10.0, 100.0).tolist() == [30, 70, 90]
    made._camera, made._camera_pieces = "moves", lambda a, b: {20.0: 2, 40.0: 4}.get(b - a, 1)
    assert made.sample_times_us(10.0, 100.0).tolist() == [20, 30, 40, 50, 60, 70, 80, 90]

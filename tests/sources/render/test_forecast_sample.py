"""The pixels of which a forecast counts the rays: squares of a list that may be sparse."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.mosaic.schedule import BlockSample
from hesim_render.sources.render.change_driven import forecast
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.renderer import Demand


@pytest.mark.parametrize(("row_step", "col_step"), [(1, 1), (2, 2), (3, 1)])
def test_a_square_has_as_many_pixels_of_a_sparse_list(monkeypatch, row_step, col_step):
    """One square about the pixel in the middle of the list, of 61 × 140 px: wider by the root of what is left out."""
    monkeypatch.setattr(forecast, "_PATCHES", 1)
    source = SimpleNamespace(is_apart=lambda role: False, sensor=SimpleNamespace(rows=61, cols=140))
    row, col = np.mgrid[:61:row_step, :140:col_step]
    pixel = (row * 140 + col).ravel().astype(np.uint32)
    chosen = forecast._sample(pixel, source, "any", SimpleNamespace(random=lambda count: np.full(count, 0.51)))
    centre = int(pixel[int(0.51 * pixel.size)])
    half = forecast._SIDE * np.sqrt(61 * 140 / pixel.size) / 2
    assert half < 20
    inside = (abs(pixel.astype(int) // 140 - centre // 140) <= half) & (
        abs(pixel.astype(int) % 140 - centre % 140) <= half
    )
    np.testing.assert_array_equal(chosen, pixel[inside])


def test_pixels_that_lie_apart_are_taken_one_by_one(monkeypatch):
    """One of each fifth of the list, at a place that the random numbers tell."""
    monkeypatch.setattr(forecast, "_SINGLE", 5)
    source = SimpleNamespace(is_apart=lambda role: True, sensor=SimpleNamespace(rows=61, cols=140))
    pixel = np.arange(0, 8000, 8, dtype=np.uint32)
    rng = SimpleNamespace(random=lambda count: np.array([0.0, 0.5, 0.25, 0.875, 0.125]))
    assert forecast._sample(pixel, source, "any", rng).tolist() == [8 * k for k in (0, 300, 450, 775, 825)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "is_short"), [pytest.param("davis346", True, marks=pytest.mark.slow), ("reference-mono", False)]
)
def test_only_asynchronous_pixels_that_see_paths_have_short_audits(sensor, is_short):
    scene = hr.load_scene(Path(__file__).parents[3] / "benchmarks/scenes/floor-ball.yaml")
    sensor = hr.load_sensor(sensor).crop(8, 6, 30, 20)
    nothing = np.empty(0, np.uint32)
    source = ChangeDrivenFlux(scene, sensor)
    for duration_us, rays in ((7000, 13e6 * 0.35), (20_000, 13e6), (90_000, 13e6)):
        demand = Demand(duration_us, nothing, BlockSample([], 1.0), nothing, [])
        assert source.estimate(demand).audit_rays == (pytest.approx(rays) if is_short else np.inf)
    star = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor)
    assert star.estimate(demand).audit_rays == np.inf

"""Forecasts of the rays of a run from a sample of its pixels."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.sources.render.change_driven import forecast
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux


@pytest.mark.parametrize(("scene", "sensor", "region", "duration_us"), [
    ("camera-sweep", "gen2", (1400, 1100, 900, 700), 20_000), ("camera-sweep", "davis346", (160, 120, 90, 60), 1500),
    ("pendulum", "davis346", (200, 150, 70, 50), 1500),
])  # fmt: skip
def test_samples_of_pixels_have_the_rays_of_all(scene, sensor, region, duration_us):
    """Most rays are spent on few pixels: twelve large patches were off by up to a factor of 2.5."""
    source = ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor(sensor).crop(*region), seed=6)
    pixels = source.sensor.layout.evs_pixel.ravel()
    tick_us = source.sensor.spec.evs.tick_us
    block = next(iter(source.sample_blocks(tick_us or 100, 0, duration_us)))

    def rays(of):
        return source.foretell(of, block.begin_us, block.end_us, "events")[[0, 3]].sum()

    samples = [forecast._sample(pixels, source, "events", np.random.default_rng(seed)) for seed in range(5)]
    assert max(part.size for part in samples) < 0.5 * pixels.size
    found = np.array([rays(part) for part in samples]) / rays(pixels)
    np.testing.assert_allclose(found, 1, atol=0.2)

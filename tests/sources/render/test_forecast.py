"""Forecasts of the rays of a run from a sample of its pixels."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.mosaic.schedule import BlockSample, tick_blocks
from hesim_render.sources.render.change_driven import forecast
from hesim_render.sources.render.change_driven.anchor import anchor_us
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.renderer import Demand


@pytest.mark.parametrize(("scene", "sensor", "region", "duration_us"), [
    ("camera-sweep", "gen2", (1400, 1100, 900, 700), 20_000), ("camera-sweep", "davis346", (160, 120, 90, 60), 1500),
    pytest.param("pendulum", "davis346", (200, 150, 70, 50), 1500, marks=pytest.mark.slow),
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


class Counted:
    """A renderer of 800 pixels of which some may change: 70 rays of each in a block, 20 to compare with in its anchor,
    5 of the flux there, 30 of pilots; 64 and 32 in the first anchor.
    """

    is_static, has_ticks, sees_paths, seed, sensor = False, True, True, 3, None

    def __init__(self, constant):
        self.constant = constant

    def may_change(self, pixel, begin_us, end_us):
        return pixel >= self.constant * pixel.size

    def is_apart(self, role):
        return True

    def foretell(self, pixel, begin_us, end_us, role, until=None, is_anchor=False):
        return np.array([64.0, 0, 0, 32]) if is_anchor else np.array([70.0, 20, 5, 30])

    def rays_per_second(self):
        return 1e7


@pytest.mark.parametrize(("constant", "saved"), [(0.0, 32), (0.003, 32), (0.01, 0)])
def test_the_first_pilot_goes_on_where_nearly_all_pixels_may_change(constant, saved):
    """It is traced again for what may change where more than one pixel of 256 is constant."""
    pixels = np.arange(800, dtype=np.uint32)
    spec = hr.load_sensor("gen2").spec.evs
    blocks = list(tick_blocks(spec, 0, 40_000))
    demand = Demand(40_000, pixels, BlockSample(blocks, 1.0), np.empty(0, np.uint32), [])
    source, alive = Counted(constant), 1 - np.ceil(constant * 800) / 800
    first_is_anchor = anchor_us(blocks[0].begin_us, blocks[0].end_us, False) == (
        blocks[0].begin_us[0],
        blocks[0].end_us[0],
    )
    each = 96 + alive * ((0 if first_is_anchor else 70) - saved + 20 + (70 + 30) * len(blocks))
    assert forecast.forecast(source, demand).rays == pytest.approx(800 * each)


#: A plate flies past one corner of the picture; most of the wall never sees it.
PLATE = """
schema_version: 1
name: plate
description: A plate that flies past a corner of the picture.
objects:
  - {name: wall, shape: rectangle, size_m: [3, 3, 0], position_m: [0, 0, -0.3], reflectance: 0.43}
  - {name: plate, shape: rectangle, size_m: [0.06, 0.04, 0], position_m: [-0.3, 0.22, 0], reflectance: 0.8}
light: {type: point, illuminant: D50, position_m: [0.2, -0.3, 2.1], illuminance_lux: 700}
camera: {origin_m: [0, 0, 1.3], target_m: [0, 0, 0]}
motion:
  - object: plate
    keyframes:
      - {t_us: 0, translation_m: [0, 0, 0]}
      - {t_us: 20000, translation_m: [0.36, 0, 0]}
"""


def test_what_never_changes_is_counted_once(tmp_path):
    """Pixels that nothing moving comes near were counted in each of the blocks of a run: 1.4 times the rays here."""
    (tmp_path / "plate.yaml").write_text(PLATE)
    estimates, sensor = [], hr.load_sensor("davis346").crop(80, 80, 60, 50)
    recording = hr.simulate(
        tmp_path / "plate.yaml", sensor, duration_s=0.003, audit=False, progress=False, on_estimate=estimates.append
    )
    render = recording.manifest["settings"]["render"]
    np.testing.assert_allclose(estimates[0].rays, render["rays"] + render["pilot_rays"], rtol=0.2)

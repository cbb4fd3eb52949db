"""Forecasts of the rays of a run from a sample of its pixels, and of its memory."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.mosaic.schedule import Block, BlockSample, Exposure, tick_blocks
from hesim_render.sources.render.change_driven import forecast, foresight
from hesim_render.sources.render.change_driven.anchor import anchor_us
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.foresight import Foretold, Speed
from hesim_render.sources.renderer import Demand


@pytest.mark.parametrize(("scene", "sensor", "region", "duration_us"), [
    pytest.param("camera-sweep", "gen2", (1400, 1100, 900, 700), 20_000, marks=pytest.mark.slow),
    ("camera-sweep", "davis346", (160, 120, 90, 60), 1500),
    pytest.param("pendulum", "davis346", (200, 150, 70, 50), 1500, marks=pytest.mark.slow),
])  # fmt: skip
def test_samples_of_pixels_have_the_rays_of_all(scene, sensor, region, duration_us):
    """Most rays are spent on few pixels: twelve large patches were off by up to a factor of 2.5."""
    source = ChangeDrivenFlux(hr.load_scene(scene), hr.load_sensor(sensor).crop(*region), seed=6)
    pixels = source.sensor.layout.evs_pixel.ravel()
    tick_us = source.sensor.spec.evs.tick_us
    block = next(iter(source.sample_blocks(tick_us or 100, 0, duration_us)))

    def rays(of):
        return source.foresight.block(of, block.begin_us, block.end_us, "events").rays[[0, 3]].sum()

    samples = [forecast._sample(pixels, source, "events", np.random.default_rng(seed)) for seed in range(5)]
    assert max(part.size for part in samples) < 0.5 * pixels.size
    found = np.array([rays(part) for part in samples]) / rays(pixels)
    np.testing.assert_allclose(found, 1, atol=0.2)


class Counted:
    """A renderer of 800 pixels of which some may change: 70 rays of each in a block, 20 to compare with in its anchor,
    5 of the flux there, 30 of pilots; 64 and 32 in the first anchor. Seven traces a block. It looks ahead by itself.
    """

    is_static, has_ticks, sees_paths, seed, sensor, kept_rays = False, True, True, 3, None, 0

    def __init__(self, constant):
        self.constant, self.foresight = constant, self

    def may_change(self, pixel, begin_us, end_us):
        return pixel >= self.constant * pixel.size

    def is_apart(self, role):
        return True

    def block(self, pixel, begin_us, end_us, role, until=None, is_anchor=False):
        if is_anchor:
            return Foretold(np.array([64.0, 0, 0, 32]), 3.0)
        return Foretold(np.array([70.0, 20, 5, 30]), 7.0)

    def speed(self):
        return Speed(picture_ray_s=3e-6, pilot_ray_s=2e-6, start_s=0.04)


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
    estimate = forecast.forecast(source, demand)
    assert estimate.rays == pytest.approx(800 * each)
    # rays of pilots, which cost less than those of the picture where these are; and traces, for 800 pixels at a time
    looks = 800 * (32 + alive * (30 * len(blocks) - saved))
    seconds = 3e-6 * (800 * each - looks) + 2e-6 * looks + 33e-9 * 800 * each + 0.04 * 7 * len(blocks)
    assert estimate.seconds == pytest.approx(seconds)
    assert estimate.ray_s == pytest.approx(3.033e-6) and estimate.trace_s == 0.04
    source.kept_rays = 32
    assert forecast.forecast(source, demand).peak_bytes == estimate.peak_bytes + 800 * 32 * 10
    one = replace(demand, blocks=BlockSample(blocks[:1], 1.0))
    assert forecast.forecast(source, one).peak_bytes == estimate.peak_bytes
    many = replace(demand, event_pixel=np.arange(3 << 17, dtype=np.uint32))
    assert forecast.forecast(source, many).seconds > 0.04 * 7 * len(blocks) * 2 + 3e-6 * 64 * (3 << 17)


def test_the_window_with_which_a_run_begins_costs_nothing():
    pixels, every = np.arange(800, dtype=np.uint32), np.array([-1.0, 340, 800, 1200])
    block = Block(every, every + 1, np.array([False, True, True, True]))
    first = Block(np.zeros(1), np.ones(1), np.ones(1, np.bool_))
    rays = []
    for blocks, count in (([first, block, block], 0.25), ([block, block], 1.0)):
        sample = BlockSample(blocks, count)
        estimate = forecast.forecast(Counted(0.3), Demand(2_000, pixels, sample, np.empty(0, np.uint32), []))
        rays.append((estimate.rays, sample.count))
    # 560 pixels may change: 70 rays and 30 of pilots a block, and 20 in the one anchor
    assert rays == [(pytest.approx(800 * 96 + 560 * (100 * (count - share) + 20)), count)
                    for (_, count), share in zip(rays, (1, 0), strict=True)]  # fmt: skip


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


@pytest.mark.slow
def test_what_never_changes_is_counted_once(tmp_path):
    """Pixels that nothing moving comes near were counted in each of the blocks of a run: 1.4 times the rays here."""
    (tmp_path / "plate.yaml").write_text(PLATE)
    estimates, sensor = [], hr.load_sensor("davis346").crop(80, 80, 60, 50)
    recording = hr.simulate(
        tmp_path / "plate.yaml", sensor, duration_s=0.003, audit=False, progress=False, on_estimate=estimates.append
    )
    render = recording.manifest["settings"]["render"]
    np.testing.assert_allclose(estimates[0].rays, render["rays"] + render["pilot_rays"], rtol=0.2)


def test_the_speed_is_that_of_the_pairs_with_most_rays(monkeypatch):
    """Rays of the picture are timed where its rays are, each pair as often as it has rays; nothing of it counts."""
    source = ChangeDrivenFlux(hr.load_scene("rotating-star"), hr.load_sensor("davis346").crop(24, 18, 150, 110), seed=6)
    tracer, ahead, seen, now_s = source._tracer, source.foresight, [], [7.0]
    trace = tracer.trace

    def noted(pixel, window, windows, samples, *rest):
        seen.append((pixel, windows.begin_us[window], samples))
        # 0.3 s to start, and 20 ns a ray at the run's beginning, 50 ns later; the first pass compiles for 4 s more
        ray_s = np.where(windows.begin_us[window] > 0, 50e-9, 20e-9)
        now_s[0] += 0.3 + np.sum(ray_s * samples) + 4.0 * (len(seen) % 3 == 1)
        return trace(pixel, window, windows, samples, *rest)

    tracer.trace = noted
    pixel = source.sensor.layout.evs_pixel.ravel()
    (block, *_) = (b for b in source.sample_blocks(1, 0, 2000) if b.wanted.size > 2)
    traces = tracer.traces
    foretold = ahead.block(pixel, block.begin_us, block.end_us, "events")
    # the picture is not traced, but it counts
    assert 4 < foretold.traces == tracer.traces - traces - 1 + 4
    pairs = ahead._pairs[-1]
    assert not seen and 0.5 * foretold.rays[0] * pixel.size < pairs[3].sum() <= foretold.rays[0] * pixel.size
    monkeypatch.setattr(foresight.time, "perf_counter", lambda: now_s[0])
    speed = ahead.speed()
    assert source.rays_traced == source.counts.rays == 0 and not ahead._pairs
    few, even, busy = seen[2], seen[5], seen[8]
    assert few[0].size == 8 and even[0].size == 24 * 18 and busy[0].size == 8192 and (busy[2] == 64).all()
    most = np.argmax(pairs[3])
    times = np.sum((busy[0] == pairs[0][most]) & (busy[1] == pairs[1][most]))
    assert times == pytest.approx(8192 * pairs[3][most] / pairs[3].sum(), abs=1)
    # what tracing eight pairs of 64 rays takes is counted as the start
    start_s, busy_s = 0.3 + 20e-9 * 8 * 64, 0.3 + 64 * np.where(busy[1] > 0, 50e-9, 20e-9).sum()
    assert speed.start_s == pytest.approx(start_s, rel=1e-9)
    assert speed.pilot_ray_s == pytest.approx(20e-9 * (432 - 8) / 432, rel=1e-6)
    assert speed.picture_ray_s == pytest.approx((busy_s - start_s) / (8192 * 64), rel=1e-6)
    assert speed.picture_ray_s > 2 * speed.pilot_ray_s
    # without any pairs, all rays are those of the whole region
    whole = ahead.speed()
    assert whole.picture_ray_s == whole.pilot_ray_s == pytest.approx(speed.pilot_ray_s, rel=1e-6)


def test_rays_of_frames_have_less_beside_them():
    """Of 800 event pixels and 300 frame pixels in each of two exposures, with a table of rays for either."""
    spec, pixels = hr.load_sensor("gen2").spec.evs, np.arange(800, dtype=np.uint32)
    blocks = list(tick_blocks(spec, 0, 20_000))
    events = Demand(20_000, pixels, BlockSample(blocks, 1.0), np.empty(0, np.uint32), [])
    exposures = [Exposure(k, 10_000 * k, 9000, 48, 0.0) for k in range(2)]
    both = replace(events, frame_pixel=np.arange(300, dtype=np.uint32), exposures=exposures)
    alone, with_frames = (forecast.forecast(Counted(0.3), demand) for demand in (events, both))
    # 95 rays of the picture and 30 of pilots, and seven traces in each exposure
    assert with_frames.rays - alone.rays == pytest.approx(300 * 2 * 125)
    seconds = 300 * 2 * (95 * 3e-6 + 30 * 2e-6 + 125 * 15e-9) + 2 * 7 * 0.04
    assert with_frames.seconds - alone.seconds == pytest.approx(seconds)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "sensor", "duration_s"), [("fan", "dvxplorer", 0.001), ("camera-sweep", "gen2", 0.005)]
)
def test_the_memory_of_a_run_is_the_estimated_one(scene, sensor, duration_s):
    # the largest memory by `getrusage` is at least that of the process that starts this one, which has run many tests
    code = f"""
import resource
import sys

import hesim_render as hr

told = []
hr.simulate({scene!r}, {sensor!r}, duration_s={duration_s}, on_estimate=told.append)
if sys.platform == "linux":
    peak = next(int(line.split()[1]) * 1024 for line in open("/proc/self/status") if line.startswith("VmHWM"))
else:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
print(told[0].peak_bytes, peak)
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    estimate, peak = map(float, done.stdout.split()[-2:])
    assert 0.7 < estimate / peak < 1.4

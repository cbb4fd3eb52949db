"""The estimate of a run counts start, noise, frames and audit, not its rays alone; a dry run shows what it does."""

from dataclasses import replace

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture import overheads
from hesim_render.capture.overheads import noise_seconds, with_overheads, with_workers
from hesim_render.mosaic.schedule import Block, BlockSample, Exposure
from hesim_render.sources.renderer import Demand, Estimate

RAYS = Estimate(seconds=3.0, peak_bytes=7e8, rays=6e6, ray_s=4.3e-7, trace_s=0.031)
RUN = {"windows": 130.0, "frames": 0, "audited": False, "rests": False}


def told(name, rays=RAYS, size=(64, 48), **changes):
    windows, frames, kind = (changes.pop(key, RUN[key]) for key in ("windows", "frames", "audited"))
    one = Block(np.zeros(13), np.ones(13), np.ones(13, np.bool_))
    blocks = BlockSample([one], 13 / windows) if windows else BlockSample([], 1.0)
    nothing = np.empty(0, np.uint32)
    exposures = [Exposure(k, 10_000 * k, 9000, 48, 0.0) for k in range(frames)]
    demand = Demand(50_000, nothing, blocks, nothing, exposures)
    sensor = hr.load_sensor(name).crop(*size)
    found = with_overheads(rays, sensor, demand, audited=kind, rests=changes.get("rests", RUN["rests"]))
    assert (found.rays, found.peak_bytes) == (rays.rays, rays.peak_bytes)
    return found.seconds


def test_steps_go_to_windows_and_to_nodes_of_the_noise():
    """16 nodes in each period of the noise, in still light as well; steps behind a photoreceptor cost more."""
    sensor = hr.load_sensor("imx636").crop(64, 48)
    steps = RUN["windows"] + 16 * sensor.spec.evs.noise_cutoff_hz * 0.05
    plain, bent = 0.4e-3 + 0.035e-6 * 64 * 48, 2.5e-3 + 0.035e-6 * 64 * 48
    more = told("imx636") - told("imx636", rests=True) - RUN["windows"] * overheads._WINDOW_S
    assert more == pytest.approx(steps * (bent - plain), rel=1e-9)
    assert noise_seconds(sensor, 50_000, 130.0, rests=True) == pytest.approx(steps * plain)
    davis = noise_seconds(hr.load_sensor("davis346").crop(64, 48), 50_000, 130.0, rests=False)
    assert davis == pytest.approx((130 + 16 * 300 * 0.05) * plain)
    # ticks are steps, whatever is rendered
    assert noise_seconds(hr.load_sensor("eiger").crop(64, 48), 123_900, 0.0, rests=True) == pytest.approx(
        100 * (0.4e-3 + 0.035e-6 * 32 * 24)
    )
    bent_ticks = hr.load_sensor("eiger", {"evs.photoreceptor": {"cutoff_hz": 300.0, "follows_light": False}})
    assert noise_seconds(bent_ticks.crop(64, 48), 123_900, 0.0, rests=False) == pytest.approx(
        100 * (0.4e-3 + 0.035e-6 * 32 * 24)
    )
    assert noise_seconds(hr.load_sensor("reference-bayer"), 50_000, 0.0, rests=False) == 0


def test_an_audit_costs_rays_at_the_speed_of_the_picture_and_traces():
    """A small audit starts a hundred traces or more, however few rays each has."""
    for name, most, traces in (("imx636", 24e6, 115), ("eiger", 8e6, 400), ("reference-bayer", 8e6, 400)):
        for rays in (replace(RAYS, seconds=0.5, rays=4e5), RAYS, replace(RAYS, seconds=900.0, rays=3e9)):
            again = min(8 * rays.rays, max(most, rays.rays / 16))
            cost = told(name, rays, audited=True) - told(name, rays)
            assert cost == pytest.approx(0.5 + traces * 0.031 + again * 4.3e-7)
    # scenes may need fewer, of both; a long run looks at a sixteenth all the same
    few = replace(RAYS, audit_rays=1.5e6)
    cost = 0.5 + 115 / 16 * 0.031
    assert told("imx636", few, audited=True) - told("imx636", few) == pytest.approx(cost + 1.5e6 * 4.3e-7)
    long = replace(few, rays=6e7)
    assert told("imx636", long, audited=True) - told("imx636", long) == pytest.approx(cost + 6e7 / 16 * 4.3e-7)
    # what stands still has few values to look at again
    still = told("eiger", audited=True, rests=True) - told("eiger", rests=True)
    assert still == pytest.approx(0.5 + 6e6 * 4.3e-7)
    nothing = Estimate(0.0, 7e8, 0.0)
    assert told("eiger", nothing, audited=True) == told("eiger", nothing)


def test_frames_and_the_start_count():
    assert told("reference-bayer", frames=7) - told("reference-bayer") == pytest.approx(7 * (0.02 + 60e-9 * 64 * 48))
    assert told("reference-bayer", windows=0.0) == pytest.approx(RAYS.seconds + 0.5)


def test_several_processes_divide_what_the_host_does(monkeypatch):
    """Kernels use all processors already, so that more of them leave more to be divided; each process has memory."""
    one = replace(RAYS, seconds=40.0, held_bytes=2e8)
    seconds = {}
    for count in (2, 16):
        monkeypatch.setattr(overheads, "processors", lambda count=count: count)
        for workers in (1, 2, 5, 64):
            told_of = with_workers(one, workers)
            seconds[count, workers] = told_of.seconds
            assert told_of.rays == one.rays
            assert told_of.peak_bytes == (7e8 if workers == 1 else 4e8 + workers * 5e8 + 2e8)
    assert seconds[2, 1] == seconds[16, 1] == 40
    assert seconds[2, 2] == pytest.approx(2.5 + 40 * 1.1 * (0.4 + 0.6 * (0.25 + 0.75 / 2)))
    assert seconds[16, 5] == pytest.approx(2.5 + 40 * 1.1 * (0.05 + 0.95 * (0.25 + 0.75 / 5)))
    # more processes than processors divide nothing further
    assert seconds[2, 64] == seconds[2, 2] and seconds[16, 64] < seconds[16, 5]
    assert seconds[16, 64] == pytest.approx(2.5 + 44 * (0.05 + 0.95 * (0.25 + 0.75 / 16)))


class Stopped(Exception):
    pass


def test_what_comes_before_the_estimate_is_shown_as_progress():
    """A dry run ends at its estimate: until then it says what it does."""
    seen = []

    def stop(expected):
        seen.append(expected)
        raise Stopped

    sensor = hr.load_sensor("reference-mono").crop(16, 12)
    with pytest.raises(Stopped):
        hr.simulate("flat-field", sensor, duration_s=0.02, on_estimate=stop, progress=lambda *given: seen.append(given))
    assert [given[2] for given in seen[:-1]] == ["preparation", "estimate"]
    assert all(0 <= done < total for done, total, _ in seen[:-1])
    assert isinstance(seen[-1], Estimate) and np.isfinite(seen[-1].seconds) and seen[-1].seconds > 1.0

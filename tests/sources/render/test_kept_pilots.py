"""What the pilot sees at the end of a block is what the next block begins with, where the camera moves."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.mosaic.schedule import tick_blocks
from hesim_render.sources.render.change_driven import adaptive
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.kept_pilots import Anchored, Ended
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux, PilotRays
from hesim_render.sources.render.change_driven.windows import Windows


def run(name, sensor, end_us):
    """Halves and errors of all windows, [window, pixel] each, rays of pilots, and the source."""
    source = ChangeDrivenFlux(hr.load_scene(name), sensor, seed=3)
    spec = sensor.spec.evs
    is_ticked = spec.reference == "previous_sample"
    blocks = tick_blocks(spec, 0, end_us) if is_ticked else source.sample_blocks(spec.window_us, 0, end_us)
    flux = list(source.flux_of_blocks(source.sensor.layout.evs_pixel.ravel(), blocks))
    values = np.array([(one.half_a, one.half_b, np.broadcast_to(one.error, one.half_a.shape)) for one in flux])
    return values, source.counts.pilot_rays, source


@pytest.mark.parametrize(
    ("scene", "sensor", "region", "end_us", "begins"),
    [
        # lone pixels and known shadows; six blocks, of which the fifth one has an anchor of its own
        pytest.param("camera-sweep", "gen2", (84, 60), 102_500, 4, id="ticks"),
        pytest.param("camera-sweep", "imx636", (13, 9, 100, 80), 2_700, 4, id="asynchronous"),
        # the camera rests, but rays that a lens spreads cannot tell what rests
        pytest.param("rotating-star", "gen2", (36, 28), 62_500, 2, id="spread"),
    ],
)
def test_values_are_the_same_and_a_block_begins_with_rays_that_are_known(
    monkeypatch, scene, sensor, region, end_us, begins
):
    # of a measured point-spread function, each ray may come from far beyond its pixel
    x_um = 0.7 * np.arange(-9, 10)
    kernel = np.exp(-0.5 * (x_um[:, None] ** 2 + x_um**2) / 2.3**2)
    psf = {
        "type": "measured",
        "kernels": [(kernel / kernel.sum()).tolist()],
        "sample_um": 0.7,
        "image_height_mm": [0.0],
    }
    changes = {"lens.psf": psf} if scene == "rotating-star" else {}
    sensor = hr.load_sensor(sensor, changes).crop(*region)
    values, rays, source = run(scene, sensor, end_us)
    monkeypatch.setattr(adaptive, "_MOST_KEPT_RAYS", 0)
    again, all_rays, _ = run(scene, sensor, end_us)
    assert np.any(np.ptp(again[:, 0], axis=0) > 0)
    np.testing.assert_array_equal(values, again)
    # at least the pixels themselves; beside them are neighbours, and rays that look for shadows
    pixels = sensor.layout.evs_pixel.size
    assert all_rays - rays >= begins * source.kept_rays * pixels > 0


def test_the_last_block_of_a_run_keeps_nothing(monkeypatch):
    pilot, keeps = adaptive.AdaptiveRenderer.pilot, []

    def watched(*given, **named):
        result = pilot(*given, **named)
        if "is_kept" in named:
            keeps.append((named["is_kept"], result[0].ended is not None))
        return result

    monkeypatch.setattr(adaptive.AdaptiveRenderer, "pilot", watched)
    run("camera-sweep", hr.load_sensor("gen2").crop(36, 28), 52_500)
    assert keeps == [(True, True), (True, True), (False, False)]


def test_nothing_is_kept_where_the_camera_rests_or_of_too_many_pixels(monkeypatch):
    sensor = hr.load_sensor("gen2").crop(84, 60)
    star = ChangeDrivenFlux(hr.load_scene("rotating-star"), sensor)
    assert star.kept_rays == 0
    pixels = sensor.layout.evs_pixel.size
    for most, expected in ((32 * pixels, 32), (32 * pixels - 1, 0)):
        monkeypatch.setattr(adaptive, "_MOST_KEPT_RAYS", most)
        assert ChangeDrivenFlux(hr.load_scene("camera-sweep"), sensor).kept_rays == expected


def test_an_estimate_knows_what_is_kept(monkeypatch):
    """A block whose first window is not the anchor itself takes 32 rays of each pixel less."""
    sensor, looks = hr.load_sensor("gen2").crop(84, 60), []
    for most in (1 << 25, 0):
        monkeypatch.setattr(adaptive, "_MOST_KEPT_RAYS", most)
        source = ChangeDrivenFlux(hr.load_scene("camera-sweep"), sensor, seed=3)
        blocks = list(tick_blocks(sensor.spec.evs, 0, 40_000))
        pixel = source.sensor.layout.evs_pixel.ravel()
        looks.append([source.foresight.block(pixel, b.begin_us, b.end_us, "events").rays[3] for b in blocks])
    np.testing.assert_allclose(np.subtract(*looks), [0, -32], atol=1e-9)


def test_a_block_begins_with_the_same_window_and_anchor_only():
    windows = Windows(np.array([600.0, 1600.0, 2600.0]), np.array([1000.0, 2000.0, 3000.0]))
    flux, rays = PilotFlux.empty(2), PilotRays(None, None, 16, (0.0, 1.0))
    anchored, other = (Anchored(flux, rays, (time, time + 400.0)) for time in (600.0, 1600.0))
    ended = Ended.of(flux, rays, np.zeros(2, np.uint32), windows, np.array([2, 2]), anchored)
    assert ended.begins(windows, np.array([2, 2]), anchored)
    assert not ended.begins(windows, np.array([2, 2]), other)
    assert not ended.begins(windows, np.array([2, 2]), None)
    assert not ended.begins(windows, np.array([1, 1]), anchored)
    assert not ended.begins(windows, np.array([2, 1]), anchored)

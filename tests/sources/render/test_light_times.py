"""Rays whose instants are distributed as the power of the light, against closed forms and sums over fine steps."""

import numpy as np
import pytest
from rendering import make_scene, mono

from hesim_render.core.backend import jit
from hesim_render.core.host_arrays import from_host
from hesim_render.mosaic.schedule import Block
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.light_times import LightTimes
from hesim_render.sources.render.renderer import flickering
from hesim_render.spectral.waveform import Mains, Pwm, TableWaveform

WAVEFORMS = {
    "mains": Mains(50, 0.9, 40),
    "full mains": Mains(50, 1.0, 0),
    "pwm": Pwm(500, 0.25, 33),
    "fast pwm": Pwm(20_000, 0.1, 0),
    "repeating table": TableWaveform((0, 100, 300, 1000), (1, 5, 0, 2), True),
    "table": TableWaveform((0, 100, 300, 1000), (1, 5, 0, 2), False),
}


@pytest.mark.parametrize("name", WAVEFORMS)
def test_instants_have_the_density_of_the_power(name):
    """Shares of the energy before 39 times, in windows of many periods, of parts of one, late, early, and dark ones."""
    waveform, types = WAVEFORMS[name], jit()
    begin = np.array([0.0, 3333, 5e7 + 17, -500, 600, 10, 1000.2])
    end = np.array([1e4, 3400, 5e7 + 2017, 1200, 601, 10, 1000.3])
    times, count = LightTimes.of(waveform, begin, end), 20_001
    share = from_host(types.Float, (np.arange(count) + 0.5) / count)
    for k, (low, high) in enumerate(zip(begin, end, strict=True)):
        instant = np.array(times.instant_us(from_host(types.UInt32, np.full(count, k)), share), np.float64)
        assert instant.min() >= 0 and instant.max() <= (high - low) * (1 + 1e-6)
        assert np.diff(instant).min() >= -1e-5 * (high - low)
        if high == low:
            continue
        at = np.linspace(low, high, 41)[1:-1]
        mean = waveform.mean(low, high)
        before = (at - low) / (high - low) * (waveform.mean(low, at) / mean if mean > 0 else 1)
        found = np.searchsorted(instant, at - low) / count
        # a step of the shares, and the bend of a cosine within one of its 32 parts
        np.testing.assert_allclose(found, before, atol=2e-4)


PIXEL_M, COLS, PASSAGE_US = 0.02, 40, 8000
LIGHTS = {
    "pwm": ({"type": "pwm", "frequency_hz": 400, "duty": 0.3, "phase_deg": 20}, Pwm(400, 0.3, 20)),
    "mains": ({"type": "mains", "frequency_hz": 50, "depth": 0.9, "phase_deg": 70}, Mains(50, 0.9, 70)),
}


def plate(motion, waveform=None):
    """A bright plate on black, 0.8 m wide and as large as the picture, in light from the front."""
    light = {"type": "directional", "direction": [0, 0, -1], "illuminance_lux": 3000, "waveform": waveform}
    return make_scene(
        objects=[{"name": "plate", "shape": "rectangle", "size_m": [0.8, 2, 0], "reflectance": 0.5}],
        light=[light],
        camera={"origin_m": [0, 0, 2], "target_m": [0, 0, 0], "horizontal_fov_deg": 22.62},
        motion=motion,
        max_depth=2,
    )


def covered(begin_us, end_us, waveform, steps=20_000):
    """Mean over a window of the plate's part of each pixel, times the waveform, over fine steps: [col]."""
    t = begin_us + (np.arange(steps) + 0.5) * (end_us - begin_us) / steps
    edge_px = COLS * t / PASSAGE_US
    part = np.clip(edge_px[:, None] - np.arange(COLS), 0, 1)
    return np.mean(part * waveform.mean(t, t)[:, None], axis=0)


@pytest.mark.parametrize("kind", LIGHTS)
def test_an_edge_that_passes_under_a_flickering_light(kind):
    """Exposures of many pieces of the light, and windows of events, in the default mode.

    The product of the means over a window would be off by 0.13 to 0.34 of the largest value.
    """
    spec, waveform = LIGHTS[kind]
    sensor = mono(COLS, 8)
    keys = [{"t_us": 0, "translation_m": [-0.8, 0, 0]}, {"t_us": PASSAGE_US, "translation_m": [0, 0, 0]}]
    moving = plate([{"object": "plate", "keyframes": keys}], spec)
    pixels = np.arange(COLS * 8, dtype=np.uint32)
    full = np.array(ChangeDrivenFlux(plate([]), sensor).mean_flux(pixels, 0, 1000)[0]).reshape(8, COLS)
    asked = []

    def make(part, light):
        asked.append(light)
        return ChangeDrivenFlux(part, sensor, 0.2, seed=3, light=light)

    source = flickering(moving, make)
    assert asked == [waveform]
    for begin, end in ((0, PASSAGE_US), (1300, 6900), (2000, 2900)):
        flux = np.mean(source.mean_flux(pixels, begin, end), axis=0).reshape(8, COLS) / full
        expected = covered(begin, end, waveform)
        np.testing.assert_allclose(flux, np.broadcast_to(expected, flux.shape), atol=0.012 * expected.max())
        np.testing.assert_allclose(flux.mean(axis=0), expected, atol=0.006 * expected.max())
    begin = np.arange(5) * 1500.0
    block = Block(begin, begin + 1500, np.ones(5, bool))
    for k, sample in enumerate(source.flux_of_blocks(pixels, [block])):
        flux = 0.5 * (np.array(sample.half_a) + np.array(sample.half_b)).reshape(8, COLS) / full
        expected = covered(begin[k], begin[k] + 1500, waveform)
        np.testing.assert_allclose(flux.mean(axis=0), expected, atol=0.012 * waveform.highest)

"""Pixels and intervals that a source is asked for: the last pixel of a region and an instant are right."""

import numpy as np
import pytest

import hesim_render as hr
from hesim_render.capture.scene_renderer import scene_renderer
from hesim_render.core.errors import RangeError
from hesim_render.sources.cube import CubeFlux, CubeOptions
from hesim_render.sources.render.light_level import in_absolute_light
from hesim_render.sources.video.flux import VideoFlux
from hesim_render.sources.video.options import VideoOptions

COLS, ROWS = 10, 6


def scene(**keys):
    sensor = hr.load_sensor("reference-mono").crop(COLS, ROWS)
    lit = in_absolute_light(hr.load_scene("flat-field", {"light.illuminance_lux": 300.0}))[0]
    return scene_renderer(lit, sensor, 3, **keys)


def video(folder):
    pictures = np.full((2, ROWS, COLS), 90, np.uint8)
    options = VideoOptions.of(fps=100, transfer="srgb", fit="pixel", white_lux=300)
    return VideoFlux(pictures, hr.load_sensor("reference-mono").crop(COLS, ROWS), options)


def cube(folder):
    bands = np.arange(360.0, 831.0, 10.0)
    np.save(folder / "cube.npy", np.full((ROWS, COLS, bands.size), 0.4, np.float32))
    given = {"wavelength_nm": bands.tolist(), "illuminance_lux": 300.0}
    sensor = hr.load_sensor("reference-mono").crop(COLS, ROWS)
    return CubeFlux(folder / "cube.npy", sensor, CubeOptions.model_validate(given))


SOURCES = {
    "change-driven": lambda folder: scene(quality=1.0), "exact": lambda folder: scene(samples=2), "video": video,
    "cube": cube,
}  # fmt: skip


@pytest.mark.parametrize("name", SOURCES)
def test_the_last_pixel_is_inside_and_the_next_one_is_not(name, tmp_path):
    source = SOURCES[name](tmp_path)
    last = COLS * ROWS - 1
    for begin, end in ((1000.0, 3000.0), (1000.0, 1000.0)):
        (value,) = np.array(source.mean_flux(np.array([last], np.uint32), begin, end)[0])
        assert value > 0
    for pixel in ([last + 1], [0, last + 1, 3]):
        with pytest.raises(RangeError, match=f"pixel is {last + 1}; expected 0 to {last}"):
            source.mean_flux(np.array(pixel, np.uint32), 1000.0, 3000.0)
    with pytest.raises(RangeError):
        source.mean_flux(np.array([0, 1], np.uint32), 1000.0, np.array([3000.0, 999.0]))

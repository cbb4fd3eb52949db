"""A contact sheet of the effects of a lens, one in each picture, as in docs/sensors.md.

Run: python examples/lens_sheet.py [picture.png]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import hesim_render as hr
from hesim_render.recording.colour_view import colour_picture

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "lens-effects.png")
WIDTH, HEIGHT, COLS, LINE = 240, 180, 4, 14
#: A board 30 cm away, a ball in front of it and one behind, on pixels of 10 µm that are shown two by two. Effects are
#: stronger than those of real lenses.
SCENE = """schema_version: 1
name: sheet
description: a board, a ball in front of it and one behind
target: {type: checkerboard, rows: 6, cols: 8, width_m: 0.26, height_m: 0.195}
objects:
  - {name: wall, shape: rectangle, size_m: [9, 9, 0], position_m: [0, 0, -0.8], reflectance: 0.6}
  - {name: near, shape: sphere, size_m: [0.04, 0.04, 0.04], position_m: [-0.05, 0.03, 0.16], pattern: 0.1,
     reflectance: {colorchecker: ISO 17321-1, patch: 15}}
  - {name: far, shape: sphere, size_m: [0.3, 0.3, 0.3], position_m: [0.38, -0.1, -0.4], pattern: 0.05,
     reflectance: {colorchecker: ISO 17321-1, patch: 16}}
light: {type: uniform, illuminance_lux: 1000}
camera: {origin_m: [0, 0, 0.3], target_m: [0, 0, 0], horizontal_fov_deg: 60, focus_distance_m: 0.3}
"""


def coma(size=15):
    """A kernel with a tail outwards, as far off the axis."""
    y, x = np.mgrid[:size, :size] - size // 2
    tail = np.exp(-np.hypot(x, y) / 2.5) * (np.abs(y) <= 0.6 * x + 0.5)
    return (tail / tail.sum()).tolist()


def dot(size=15):
    kernel = np.zeros((size, size))
    kernel[size // 2, size // 2] = 1
    return kernel.tolist()


PICTURES = {
    "none: f/2.8, pinhole": (2.8, {}),
    "distortion: k1 -0.3, k2 0.05": (2.8, {"distortion": {"model": "opencv", "k1": -0.3, "k2": 0.05}}),
    "distortion: k1 0.25": (2.8, {"distortion": {"model": "opencv", "k1": 0.25}}),
    "distortion: fisheye": (2.8, {"distortion": {"model": "fisheye", "k1": -0.05}}),
    "depth_of_field: f/0.35": (0.35, {"depth_of_field": True}),
    "diffraction: f/100": (100, {"diffraction": True}),
    "psf: gaussian, to 100 um": (
        2.8,
        {"psf": {"type": "gaussian", "image_height_mm": [0, 3], "fwhm_um": [0, 100]}},
    ),
    "psf: measured, with coma": (
        2.8,
        {"psf": {"type": "measured", "kernels": [dot(), coma()], "sample_um": 14, "image_height_mm": [0, 2.5]}},
    ),
    "lateral_chromatic: 3 %": (
        2.8,
        {"lateral_chromatic": {"wavelength_nm": [420, 540, 660], "magnification_rel": [-0.03, 0, 0.03]}},
    ),
    "relative_illumination: none": (2.8, {"relative_illumination": "none"}),
    "relative_illumination: table": (
        2.8,
        {"relative_illumination": {"image_height_mm": [0, 1, 2, 3], "illumination_rel": [1.0, 0.8, 0.4, 0.1]}},
    ),
    "veiling_glare: 0.4": (2.8, {"veiling_glare": 0.4}),
}

rows = -(-len(PICTURES) // COLS)
sheet = Image.new("RGB", (COLS * (WIDTH + 6), rows * (HEIGHT + LINE + 6)), (40, 40, 40))
draw = ImageDraw.Draw(sheet)
with tempfile.TemporaryDirectory() as name:
    file = Path(name) / "scene.yaml"
    file.write_text(SCENE)
    for number, (title, (f_number, effects)) in enumerate(PICTURES.items()):
        lens = {f"lens.{key}": value for key, value in effects.items()}
        sensor = hr.load_sensor("reference-bayer", {"geometry.pitch_um": 10.0, "lens.f_number": f_number, **lens})
        lux = 80 * (f_number / 2.8) ** 2  # the same light on the sensor at any aperture
        scene = hr.load_scene(file, {"light.illuminance_lux": lux})
        recording = hr.simulate(
            scene, sensor.crop(2 * WIDTH, 2 * HEIGHT), duration_s=0.03, samples=64, seed=1, clean=True
        )
        frame = recording.frames[0]
        x, y = number % COLS * (WIDTH + 6) + 3, number // COLS * (HEIGHT + LINE + 6) + 3
        picture = Image.fromarray(colour_picture(frame.raw, recording.mosaic))
        sheet.paste(picture.resize((WIDTH, HEIGHT), Image.Resampling.BOX), (x, y + LINE))
        draw.text((x, y), title, fill=(255, 255, 255))
        told = ", ".join(recording.manifest["lens"]["effects"]) or "none"
        print(f"{title}: effects {told}; mean of frame {frame.raw.mean():.0f} DN", flush=True)
# a palette keeps the file small
sheet.quantize(256).save(OUT, optimize=True)
print(f"in {OUT}")

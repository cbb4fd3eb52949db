"""A contact sheet of all kinds of targets as a Bayer sensor sees them, as in docs/targets.md.

Run: python examples/target_sheet.py [picture.png]      (needs the extra 'targets')
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import hesim_render as hr
from hesim_render.recording.colour_view import colour_picture

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else "targets.png")
WIDTH, HEIGHT, COLS, LINE = 240, 180, 5, 14
TILTED = "rotation_axis: [0.4, 1, 0.2], rotation_deg: 30"


def write_files(folder):
    """A chart of 12 patches in CIELAB, a picture, and a hyperspectral cube of narrow bands."""
    hues = np.arange(12) * 30
    patches = [f"{hue},60,{35 * np.cos(np.radians(hue)):.1f},{35 * np.sin(np.radians(hue)):.1f}" for hue in hues]
    (folder / "chart.csv").write_text("name,L,a,b\n" + "\n".join(patches) + "\n")
    y, x = np.mgrid[0:1:120j, 0:1:160j]
    waves = [np.cos(6 * np.pi * (x * np.cos(k) + y * np.sin(k))) for k in (0.2, 1.3, 2.4)]
    Image.fromarray((127.5 + 120 * np.stack(waves, axis=-1)).astype(np.uint8)).save(folder / "picture.png")
    wavelength = np.arange(380, 781, 20)
    band = np.exp(-(((wavelength - 400 - 300 * x[..., None]) / 25) ** 2) / 2)
    np.save(folder / "cube.npy", (0.05 + 0.9 * y[..., None] * band).astype(np.float32))
    return ", ".join(str(int(w)) for w in wavelength)


with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    bands = write_files(folder)
    targets = {
        "flat": "type: flat",
        "colorchecker": "type: colorchecker",
        "patch-chart (CIELAB)": "type: patch-chart, patches: chart.csv, rows: 3, cols: 4",
        "step-wedge": "type: step-wedge",
        "grey-ramp": "type: grey-ramp",
        "dead-leaves": "type: dead-leaves, height_m: 0.15",
        "image (sRGB)": "type: image, file: picture.png",
        "image (cube)": f"type: image, file: cube.npy, wavelength_nm: [{bands}], beyond: hold",
        "integrating-sphere": "type: integrating-sphere, luminance_cd_m2: 150",
        "slanted-edge": "type: slanted-edge",
        "edge-field": "type: edge-field, angle_deg: [5, -5, 20]",
        "siemens-star": "type: siemens-star",
        "resolution-wedges": "type: resolution-wedges",
        "zone-plate": "type: zone-plate, cycles: 60",
        "checkerboard": "type: checkerboard",
        "charuco": "type: charuco",
        "aprilgrid": "type: aprilgrid",
        "circle-grid": "type: circle-grid, rows: 11, cols: 4, pitch_m: 0.02, diameter_m: 0.012, asymmetric: true",
        "dot-grid": "type: dot-grid",
        "led-grid": "type: led-grid, luminance_cd_m2: 150",
        "charuco, tilted": f"type: charuco, {TILTED}",
        "checkerboard, bent": f"type: checkerboard, bend_radius_m: 0.12, {TILTED}",
    }
    sensor = hr.load_sensor("reference-bayer").crop(WIDTH, HEIGHT)
    rows = -(-len(targets) // COLS)
    sheet = Image.new("RGB", (COLS * (WIDTH + 6), rows * (HEIGHT + LINE + 6)), (40, 40, 40))
    draw = ImageDraw.Draw(sheet)
    for number, (title, keys) in enumerate(targets.items()):
        file = folder / "scene.yaml"
        file.write_text(
            f"schema_version: 1\nname: sheet\ndescription: one target\ntarget: {{{keys}}}\n"
            "objects: [{name: wall, shape: rectangle, size_m: [9, 9, 0], position_m: [0, 0, -1], reflectance: 0.1}]\n"
            "light: {type: uniform, illuminance_lux: 600}\ncamera: {fit: target, fit_margin: 0.92}\n"
        )
        recording = hr.simulate(hr.load_scene(file), sensor, duration_s=0.03, seed=1)
        frame = recording.frames[0]
        picture = colour_picture(frame.raw, recording.mosaic)
        x, y = number % COLS * (WIDTH + 6) + 3, number // COLS * (HEIGHT + LINE + 6) + 3
        sheet.paste(Image.fromarray(picture), (x, y + LINE))
        draw.text((x, y), title, fill=(255, 255, 255))
        print(f"{title}: mean of frame {frame.raw.mean():.0f} DN", flush=True)
sheet.save(OUT)
print(f"in {OUT}")

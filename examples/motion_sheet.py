"""A contact sheet of the shipped scenes that move: each at two times, as in docs/scenes.md.

Run: python examples/motion_sheet.py [picture.jpg]
"""

import sys

import numpy as np
from PIL import Image, ImageDraw

import hesim_render as hr
from hesim_render.spectral.transfer import encode

OUT = sys.argv[1] if len(sys.argv) > 1 else "motions.jpg"
#: Scenes, and the two times of each, ms.
SCENES = {
    "rotating-star": (0, 60), "camera-sweep": (0, 120), "fan": (0, 20), "pendulum": (0, 250), "robot-arm": (0, 300),
    "falling-objects": (50, 150), "hand-held": (0, 200), "facade-drive": (0, 100), "traffic-light": (0, 300),
    "glass-and-metal": (0, 250),
}  # fmt: skip
ROWS, COLS, RAYS, BANDS_NM = 108, 144, 64, [465.0, 545.0, 610.0]


def picture(scene, t_ms, white=None):
    """Radiance at three wavelengths as sRGB, and the radiance that is shown as white."""
    _, radiance, _ = hr.render_cube(scene, (ROWS, COLS), BANDS_NM, RAYS, t_us=1000 * t_ms)
    radiance = radiance[..., ::-1] / np.mean(radiance[..., ::-1], axis=(0, 1)) * radiance.mean()  # balanced
    white = np.percentile(radiance, 98) if white is None else white
    return encode(np.clip(radiance / white, 0, 1).astype(np.float32), "srgb", depth=8), white


tiles = []
for name, times in SCENES.items():
    scene = hr.load_scene(name)
    first, white = picture(scene, times[0])
    second, _ = picture(scene, times[1], white)
    tile = Image.new("RGB", (2 * COLS + 4, ROWS + 16), "white")
    for place, shown in enumerate((first, second)):
        tile.paste(Image.fromarray(shown), (place * (COLS + 2), 0))
    ImageDraw.Draw(tile).text((2, ROWS + 2), f"{name}, {times[0]} and {times[1]} ms", fill="black")
    tiles.append(tile)
    print(name, flush=True)
width, height = tiles[0].size
sheet = Image.new("RGB", (2 * (width + 6), (len(tiles) + 1) // 2 * (height + 4)), "white")
for number, tile in enumerate(tiles):
    sheet.paste(tile, (number % 2 * (width + 6), number // 2 * (height + 4)))
sheet.save(OUT, quality=88)
print("contact sheet in", OUT)

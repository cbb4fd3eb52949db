"""A contact sheet of the shipped scenes in which something moves, each as a Bayer sensor sees its beginning.

Run: python examples/gallery.py [picture.jpg]
"""

import sys

from PIL import Image, ImageDraw

import hesim_render as hr
from hesim_render.recording.colour_view import colour_picture

OUT = sys.argv[1] if len(sys.argv) > 1 else "scenes.jpg"
WIDTH, HEIGHT, COLS, LINE = 264, 176, 3, 14
SCENES = (
    "fan", "pendulum", "falling-objects", "hand-held", "facade-drive", "robot-arm", "traffic-light", "glass-and-metal",
    "cornell-box",
)  # fmt: skip

#: Scenes in bright sun and at night need exposures of their own, µs.
EXPOSURES_US = {"facade-drive": 1000, "traffic-light": 33000}

rows = -(-len(SCENES) // COLS)
sheet = Image.new("RGB", (COLS * (WIDTH + 6), rows * (HEIGHT + LINE + 6)), (40, 40, 40))
draw = ImageDraw.Draw(sheet)
for number, name in enumerate(SCENES):
    at_rest = {} if name == "cornell-box" else {"motion": []}
    exposure = {"aps.exposure_us": EXPOSURES_US.get(name, 10_000)}
    sensor = hr.load_sensor("reference-bayer", exposure).crop(WIDTH, HEIGHT)
    rec = hr.simulate(hr.load_scene(name, at_rest), sensor, duration_s=0.05, samples=64, seed=1)
    picture = Image.fromarray(colour_picture(rec.frames[0].raw, rec.mosaic))
    x, y = number % COLS * (WIDTH + 6) + 3, number // COLS * (HEIGHT + LINE + 6) + 3
    sheet.paste(picture, (x, y + LINE))
    draw.text((x, y), name, fill=(255, 255, 255))
    print(f"{name}: mean of the frame {rec.frames[0].raw.mean():.0f} DN", flush=True)
sheet.save(OUT, quality=88, optimize=True)
print("in", OUT)

"""The pictures of docs/tutorial.md, from the folder in which its commands were run.

Run: python examples/run_page.py docs/tutorial.md FOLDER --installed
     python examples/tutorial_pictures.py FOLDER [docs/images]
"""

import sys
from pathlib import Path

from PIL import Image

FOLDER = Path(sys.argv[1])
OUT = Path(sys.argv[2] if len(sys.argv) > 2 else "docs/images")
PICTURES = {
    "tutorial-first.jpg": "first/preview.png",
    "tutorial-sensor.png": "my-sensor.png",
    "tutorial-look.png": "ball.png",
    "tutorial-ball.jpg": "ball/preview.png",
}

for name, source in PICTURES.items():
    picture = Image.open(FOLDER / source).convert("RGB")
    picture.thumbnail((1100, 1100))
    if name.endswith(".png"):  # drawings: a palette keeps lines sharp, and this one their colours
        picture.quantize(128, method=Image.Quantize.FASTOCTREE).save(OUT / name, optimize=True)
    else:
        picture.save(OUT / name, quality=82, optimize=True)
    print(f"{OUT / name}: {(OUT / name).stat().st_size // 1000} kB")

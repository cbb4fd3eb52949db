"""Adapter of evlib's ESIM converter (needs torch and opencv-python-headless too): PICTURES OUT.npy, or --version."""

import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np


def main(pictures, out):
    from evlib.simulation import ESIMConfig, ESIMSimulator
    from PIL import Image

    settings = json.loads((pictures / "settings.json").read_text())
    simulator = ESIMSimulator(
        ESIMConfig(
            positive_threshold=settings["contrast_threshold_on"],
            negative_threshold=settings["contrast_threshold_off"],
            refractory_period_ms=settings["refractory_period_us"] / 1000,
            device="cpu",
            **settings["options"],
        )
    )
    scale = 255 / (2 ** settings["bits"] - 1)  # it takes values up to 255
    found = []
    for number, t_us in enumerate(np.loadtxt(pictures / "timestamps.txt", ndmin=1)):
        picture = np.asarray(Image.open(pictures / f"{number:06d}.png"), dtype=np.float64) * scale
        x, y, t, polarity = simulator.process_frame(picture, t_us * 1e-6)
        found.append(np.column_stack([np.asarray(t) * 1e6, x, y, polarity]))
    np.save(out, np.concatenate(found))


if __name__ == "__main__":
    if sys.argv[1:] == ["--version"]:
        print("evlib", importlib.metadata.version("evlib"))
    else:
        main(Path(sys.argv[1]), Path(sys.argv[2]))

"""Adapter of eventcv's simulator, a pixel as of v2e (`pip install eventcv pillow`): PICTURES OUT.npy, or --version."""

import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np

NO_NOISE = {"sigma_thres": 0.0, "leak_rate_hz": 0.0, "shot_noise_rate_hz": 0.0, "cutoff_hz": 0.0}


def main(pictures, out):
    import eventcv
    from PIL import Image

    settings = json.loads((pictures / "settings.json").read_text())
    times = np.loadtxt(pictures / "timestamps.txt", ndmin=1)
    frames = np.stack([np.asarray(Image.open(pictures / f"{k:06d}.png")) for k in range(len(times))])
    noise = {"leak_rate_hz": settings["leak_rate_hz"]} if settings["noise"] else NO_NOISE
    events = eventcv.simulate(
        frames.astype(np.float32) / (2 ** settings["bits"] - 1),
        fps=settings["fps"],
        pos_thres=settings["contrast_threshold_on"],
        neg_thres=settings["contrast_threshold_off"],
        refractory_us=settings["refractory_period_us"],
        seed=settings["seed"],
        **{**noise, **settings["options"]},
    )
    table = events.numpy().astype(np.float64)[:, [list(events.columns).index(name) for name in "txyp"]]
    table[:, 0] += times[0]  # its clock begins with the first picture
    np.save(out, table)


if __name__ == "__main__":
    if sys.argv[1:] == ["--version"]:
        print("eventcv", importlib.metadata.version("eventcv"))
    else:
        main(Path(sys.argv[1]), Path(sys.argv[2]))

"""Adapter of hesim-3d's sensor stage (`pip install hesim-3d`, which needs torch): PICTURES OUT.npy, or --version.

Its renderer is left out: the sensor takes pictures, as it takes those of its renderer, undone from sRGB. A pixel has
one event at most a picture, at the picture's time.
"""

import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np


def main(pictures, out):
    import torch
    from hesim3d.sensor import HESIMEventSimulator, SensorConfig, inverse_srgb_oetf
    from PIL import Image

    settings = json.loads((pictures / "settings.json").read_text())
    threshold = (settings["contrast_threshold_on"] + settings["contrast_threshold_off"]) / 2  # it has one
    quiet = {} if settings["noise"] else {"dark_event_rate_pos": 0.0, "dark_event_rate_neg": 0.0}
    # b0 scales the threshold, b1 and b2 make the voltage, b3 and b4 its noise, which is never 0
    betas = [[[1.0, 1.0, 0.004, 0.04, 0.004, 0.0]]] if settings["noise"] else [[[1.0, 1.0, 1e-6, 1e-6, 1e-9, 0.0]]]
    simulator = HESIMEventSimulator(
        SensorConfig(
            width=settings["width"], height=settings["height"], cfa_pattern="mono", cfa_size=1,
            event_threshold=threshold, refractory_period_us=float(settings["refractory_period_us"]),
            evs_betas=betas, **{**quiet, **settings["options"]},
        ),
        device="cpu",
    )  # fmt: skip
    simulator.rng.manual_seed(settings["seed"])
    times = np.loadtxt(pictures / "timestamps.txt", ndmin=1)
    found, before = [np.empty((0, 4))], None
    for number, t_us in enumerate(times):
        picture = np.asarray(Image.open(pictures / f"{number:06d}.png"), dtype=np.float32) / (2 ** settings["bits"] - 1)
        if settings["encoding"] == "srgb":
            picture = inverse_srgb_oetf(picture)
        light = torch.from_numpy(picture)
        if before is not None:
            _, events = simulator.simulate_interval(before, light, float(times[number - 1]), float(t_us))
            found.append(np.column_stack([events["t"], events["x"], events["y"], events["p"]]).astype(np.float64))
        before = light
    np.save(out, np.concatenate(found))


if __name__ == "__main__":
    if sys.argv[1:] == ["--version"]:
        print("hesim-3d", importlib.metadata.version("hesim-3d"))
    else:
        main(Path(sys.argv[1]), Path(sys.argv[2]))

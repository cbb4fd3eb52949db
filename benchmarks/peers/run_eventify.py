"""Adapter of eventify-dvs (`pip install eventify-dvs pillow`): PICTURES OUT.npy, or --version."""

import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np


def main(pictures, out):
    from eventify import frame_to_event_tuples
    from PIL import Image

    settings = json.loads((pictures / "settings.json").read_text())
    threshold = (settings["contrast_threshold_on"] + settings["contrast_threshold_off"]) / 2  # it has one
    times = np.rint(np.loadtxt(pictures / "timestamps.txt", ndmin=1)).astype(int)
    scale = 255 / (2 ** settings["bits"] - 1)
    found, before = [np.empty((0, 4))], None
    for number, t_us in enumerate(times):
        picture = np.asarray(Image.open(pictures / f"{number:06d}.png"), dtype=np.float32) * np.float32(scale)
        if before is not None:
            events = frame_to_event_tuples(
                before, picture, int(times[number - 1]), int(t_us), c_thresh=threshold, **settings["options"]
            )
            found.append(np.column_stack([events["t"], events["x"], events["y"], events["p"]]).astype(np.float64))
        before = picture
    np.save(out, np.concatenate(found))


if __name__ == "__main__":
    if sys.argv[1:] == ["--version"]:
        print("eventify-dvs", importlib.metadata.version("eventify-dvs"))
    else:
        main(Path(sys.argv[1]), Path(sys.argv[2]))

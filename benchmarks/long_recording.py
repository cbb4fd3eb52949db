"""Time and memory of `calibrate recording` on a long recording: 100 million events of a 640×480 sensor.

    python benchmarks/long_recording.py [--million 100] [--folder FOLDER]

Writes the recording (EVT3) first, block by block, in a process of its own: events of still light at random pixels and
times. Then calibrates on it, and prints the wall-clock and processor time and the largest resident memory of that
process.
"""

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

SHAPE = (480, 640)
#: Events of a block, and mean rate of a pixel, Hz.
BLOCK, RATE_HZ = 1 << 20, 20.0


def write(file, count):
    from hesim_render.exchange import EventStream, evt3
    from hesim_render.pixels.evs.events import EVENT_DTYPE

    per_us = RATE_HZ * SHAPE[0] * SHAPE[1] * 1e-6

    def blocks():
        begin_us = 0
        for k in range(-(-count // BLOCK)):
            rng = np.random.default_rng(k)
            size = min(BLOCK, count - k * BLOCK)
            events = np.empty(size, EVENT_DTYPE)
            end_us = begin_us + round(size / per_us)
            events["t_us"] = np.sort(rng.integers(begin_us, end_us, size))
            events["y"], events["x"] = rng.integers(0, SHAPE[0], size), rng.integers(0, SHAPE[1], size)
            events["polarity"] = np.where(rng.random(size) < 0.6, 1, -1)
            begin_us = end_us
            yield events

    with file.open("wb") as target:
        evt3.write(EventStream(blocks, SHAPE, file), target, file)


def calibrate(file, out):
    from hesim_render.calibrate.recordings import calibrate_recordings

    begin = time.monotonic()
    found = calibrate_recordings([file])
    used = resource.getrusage(resource.RUSAGE_SELF)
    result = {
        "events": found["recordings"][0]["events"], "wall_s": time.monotonic() - begin,
        "processor_s": used.ru_utime + used.ru_stime, "peak_gb": used.ru_maxrss * 1024 / 1e9,
        "on_rate_hz": found["recordings"][0]["on_rate_hz"]["value"], "file_gb": file.stat().st_size / 1e9,
    }  # fmt: skip
    out.write_text(json.dumps(result, indent=1))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--million", type=float, default=100.0)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        file, out = Path(folder) / "long.raw", Path(folder) / "result.json"
        for target, arguments in ((write, (file, round(given.million * 1e6))), (calibrate, (file, out))):
            process = multiprocessing.get_context("spawn").Process(target=target, args=arguments)
            process.start()
            process.join()
        print(out.read_text())


if __name__ == "__main__":
    main()

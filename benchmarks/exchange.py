"""Speed of event files: million events a second, written and read, and bytes an event.

The events are those of a 1632×1224 sensor with 807 samples a second, in row-major order within a sample, as
simulations give them. Time is that of the process (user and system), one thread unless a library takes more, and of the
clock; the best of three runs is printed.

    python benchmarks/exchange.py [MILLIONS]
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hesim_render.exchange import EVENT_FORMATS, EventStream, mcap_file, open_events
from hesim_render.exchange.formats import READABLE
from hesim_render.pixels.evs.events import EVENT_DTYPE

SHAPE = (1224, 1632)
SAMPLE_US = 1239
EVENTS_PER_SAMPLE = 20_000


def simulated(count, seed=1):
    rng = np.random.default_rng(seed)
    events = np.empty(count, dtype=EVENT_DTYPE)
    for first in range(0, count, EVENTS_PER_SAMPLE):
        part = events[first : first + EVENTS_PER_SAMPLE]
        pixel = np.sort(rng.integers(0, SHAPE[0] * SHAPE[1], part.size))
        part["y"], part["x"] = np.divmod(pixel, SHAPE[1])
        part["t_us"] = (first // EVENTS_PER_SAMPLE + 1) * SAMPLE_US
        part["polarity"] = rng.choice(np.array([-1, 1], dtype=np.int8), part.size)
    return events


def best(action):
    """Shortest times of three runs, s: of the clock, and of the process."""
    runs = []
    for _ in range(3):
        clock, process = time.perf_counter(), time.process_time()
        action()
        runs.append((time.perf_counter() - clock, time.process_time() - process))
    return min(run[0] for run in runs), min(run[1] for run in runs)


def main(millions=2.0):
    events = simulated(round(millions * 1e6))
    print(f"{events.size} events; million events/s, of the clock (of processor time)")
    print(f"{'format':8} {'written':>16} {'read':>16} {'bytes/event':>12}")
    with tempfile.TemporaryDirectory() as folder:
        writers = {name: (kind.suffix, kind.write) for name, kind in EVENT_FORMATS.items()}
        writers["mcap"] = ".mcap", lambda stream, *where: mcap_file.write(stream, (), "mono16", *where)
        del writers["nmnist"]  # its sensors have 256x256 px at most
        for name, (suffix, encode) in writers.items():
            path = Path(folder) / f"events{suffix}"

            def write(path=path, encode=encode):
                with path.open("wb") as file:
                    encode(EventStream.of(events, SHAPE), file, path)

            speeds = [best(write)]
            if name in READABLE:
                speeds.append(best(lambda path=path: open_events(path).count()))
            told = [f"{events.size / clock / 1e6:.1f} ({events.size / process / 1e6:.1f})" for clock, process in speeds]
            told += [""] * (2 - len(told))
            print(f"{name:8} {told[0]:>16} {told[1]:>16} {path.stat().st_size / events.size:12.2f}")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))

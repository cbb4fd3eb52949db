"""What bunches gain where many objects move: rays per second with and without them, and their ratio.

    python benchmarks/many_objects.py [--scenes "80 flakes;150 flakes;400 sparks"] [--rays 16]

Every pixel of the hidden scenes is traced in all 18 ticks, as the picture does it, on one thread. Without bunches each
ray is tested against the box of every object; the values have the same bits. The two take turns; the fastest of three
passes of each counts.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import numpy as np
from hidden_checks import COLS, ROWS, TICK_US, TICKS, WINDOW_US, sensor
from hidden_scenes import SCENES
from rendering import pair_tracer

from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.transport import many_objects

BUNCH, ALL = many_objects._BUNCH, 1 << 20


def measure(name: str, rays: int) -> None:
    """Print the speed of passes with bunches, and with all objects in one."""
    tracers = {}
    for bunch in (BUNCH, ALL):
        many_objects._BUNCH = bunch
        tracers[bunch] = pair_tracer(SCENES[name](), sensor())
    pixel = np.tile(tracers[BUNCH].sensor.layout.full_index.ravel(), TICKS)
    ends = TICK_US * np.arange(1.0, TICKS + 1)
    window, windows = np.repeat(np.arange(TICKS), COLS * ROWS), Windows(ends - WINDOW_US, ends)
    best, values = {}, []
    for number in range(4):
        for bunch, tracer in tracers.items():
            start = time.perf_counter()
            got = tracer.trace(pixel, window, windows, np.full(pixel.size, rays), np.ones(pixel.size, np.bool_))
            seconds = time.perf_counter() - start
            values.append(got.half_a)
            if number:  # the first pass compiles
                best[bunch] = min(best.get(bunch, np.inf), seconds)
    assert all(np.array_equal(values[0], other) for other in values)
    print(
        f"{name}: {pixel.size * rays / best[BUNCH] / 1e6:.2f} million rays/s with bunches,"
        f" {pixel.size * rays / best[ALL] / 1e6:.2f} without: {best[ALL] / best[BUNCH]:.2f} times as many"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="80 flakes;150 flakes;400 sparks")
    parser.add_argument("--rays", type=int, default=16)
    options = parser.parse_args()
    from hesim_render.core.backend import jit

    jit()
    import drjit as dr

    dr.set_thread_count(1)
    for name in options.scenes.split(";"):
        measure(name, options.rays)


if __name__ == "__main__":
    main()

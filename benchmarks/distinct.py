"""What `core.distinct` gains over NumPy's `unique` at the sizes of a full sensor; the results are compared.

    python benchmarks/distinct.py [--rows 2448] [--cols 3264]

Pixels: the union of all frame pixels and all event pixels. Columns: windows of all pixels, those of a row alike
(rolling shutter). The fastest of three passes of each counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hesim_render.core.distinct import distinct_columns, distinct_pixels


def fastest(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of the fastest of three calls, and their result."""
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        result = call()
        best = min(best, time.perf_counter() - start)
    return best, result


def compare(what: str, ours: Callable[[], Any], numpys: Callable[[], Any]) -> None:
    """Print both times and their ratio."""
    (own, result), (other, expected) = fastest(ours), fastest(numpys)
    for one, same in zip(result, expected, strict=True):
        np.testing.assert_array_equal(one, same)
    print(f"{what}: {own:.3f} s, NumPy {other:.3f} s: {other / own:.0f} times as fast")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=2448)
    parser.add_argument("--cols", type=int, default=3264)
    options = parser.parse_args()
    count = options.rows * options.cols
    frames, events = np.arange(count, dtype=np.uint32), np.arange(0, count, 4, dtype=np.uint32)
    compare(
        f"pixels, {count} and {events.size}",
        lambda: (distinct_pixels(frames, events),),
        lambda: (np.unique(np.concatenate([frames, events])),),
    )
    begin = np.repeat(20.0 * np.arange(options.rows), options.cols)
    windows = np.stack([begin, begin + 10_000])

    def unique() -> tuple[Any, Any]:
        found, place = np.unique(windows, axis=1, return_inverse=True)
        return found, place.ravel()

    compare(f"windows, {count} in {options.rows} rows", lambda: distinct_columns(windows), unique)


if __name__ == "__main__":
    main()

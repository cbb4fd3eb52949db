"""How much sooner a run is done by several processes (`simulate --workers`); the recordings are compared.

    python benchmarks/processes.py [--scene rotating-star] [--sensor davis346] [--duration 0.02] [--workers 2,4,8]

Each run is one of the command line, start and audit included. One run before them, which is not counted, compiles the
kernels. The first and the last run have one process, so that their difference shows how steady the machine is.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def run(options: argparse.Namespace, workers: int, out: Path) -> tuple[float, bytes]:
    """Seconds of a run, and its file of events."""
    command = [sys.executable, "-m", "hesim_render.cli", "simulate", options.scene, "--sensor", options.sensor]
    command += ["--duration", str(options.duration), "--workers", str(workers), "--yes", "--quiet", "--out", str(out)]
    start = time.perf_counter()
    status = subprocess.run(command).returncode
    assert status in (0, 3), f"{' '.join(command)} ended with {status}"
    return time.perf_counter() - start, (out / "events.h5").read_bytes()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="rotating-star")
    parser.add_argument("--sensor", default="davis346")
    parser.add_argument("--duration", type=float, default=0.02)
    parser.add_argument("--workers", type=lambda text: [int(number) for number in text.split(",")], default=[2, 4, 8])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run(options, 1, Path(folder) / "kernels")
        one, events = run(options, 1, Path(folder) / "one")
        print(f"{options.scene}, {options.sensor}, {options.duration:g} s, one process: {one:.1f} s", flush=True)
        for workers in [*options.workers, 1]:
            seconds, same = run(options, workers, Path(folder) / f"by-{workers}")
            assert same == events, f"{workers} processes have other events"
            print(f"{workers} processes: {seconds:.1f} s, {one / seconds:.2f} times as fast", flush=True)


if __name__ == "__main__":
    main()

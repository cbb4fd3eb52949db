"""Cost and true errors of the scenes that people try first: rays an event, time, memory, and what the audit finds.

    python benchmarks/rows.py [ROW ...] [--folder FOLDER] [--forecast]

Each row is a run of `hesim-render simulate` in a process of its own, in the default mode with its audit: a reference
with other random numbers, which says by how many noise units event pixels deviate, and how many of its events the run
misses. Rows that take hours are forecast only, by `--dry-run`; `--forecast` forecasts all. Times are of this machine,
rays are the same on all. Nothing was tuned on the rows marked with *. The last seven are Mitsuba XML,
64×48 pixels of it (`benchmarks/scenes`): five with light that bounces, two with direct light alone.
"""

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENES, PART = Path(__file__).parent / "scenes", "64x48+140+100"
#: Scene, sensor, seconds, and whether the row is run, of each row; a row of Mitsuba XML is a part of the sensor.
ROWS = {
    "star": ("rotating-star", "davis346", 0.02, True),
    "star-long": ("rotating-star", "davis346", 0.1, True),
    "star-eiger": ("rotating-star", "eiger", 0.02, True),
    "sweep": ("camera-sweep", "gen2", 0.02, True),
    "pendulum*": ("pendulum", "davis346", 0.02, True),
    "robot-arm*": ("robot-arm", "davis346", 0.01, True),
    "fan": ("fan", "davis346", 0.1, False),
    "traffic-light": ("traffic-light", "davis346", 0.1, False),
    "sweep-720p": ("camera-sweep", "imx636", 0.1, False),
    "facade*": ("facade-drive", "gen2", 0.02, False),
    "box*": ("cornell-box", "davis346", 0.02, False),
    "glass": ("glass-and-metal", "davis346", 0.02, False),
    **{
        name: (str(SCENES / f"{name.strip('*')}.yaml"), "davis346", 0.02, True)
        for name in ("room", "floor-ball", "sky-knot*", "copper*", "glass-ball*", "room-direct*", "floor-ball-direct*")
    },
}


def simulate(scene, sensor, seconds, *more):
    return [
        sys.executable,
        "-m",
        "hesim_render.cli",
        "simulate",
        scene,
        "--sensor",
        sensor,
        "--duration",
        str(seconds),
        *(["--roi", PART] if scene.endswith(".yaml") else []),
        *more,
    ]


def forecast(row):
    """Million rays of picture and pilot by the estimate before a run."""
    result = subprocess.run(simulate(*row, "--dry-run"), capture_output=True, text=True, check=True)
    rays = re.search(r"(\d+) million rays", result.stdout + result.stderr)
    return int(rays.group(1)) if rays else 0


def run(name, row, folder):
    """Line of a row that is run."""
    out, begin = folder / name.strip("*"), time.monotonic()
    child = subprocess.run(simulate(*row, "--out", str(out), "--quiet"), capture_output=True, text=True, check=False)
    seconds = time.monotonic() - begin
    if not (out / "recording.json").is_file():
        return f"failed: {child.stderr.strip().splitlines()[-1] if child.stderr.strip() else child.returncode}"
    recording = json.loads((out / "recording.json").read_text())
    render, events = recording["settings"]["render"], recording["counts"]["events"]
    audit = render["audit"]
    seen = audit.get("events") or {}
    every = render["rays"] + render["pilot_rays"] + audit["rays"]
    deviation = seen.get("deviation_noise", {"rms": 0.0, "p99": 0.0})
    return (
        f"{render['rays'] / 1e6:9.0f} {render['pilot_rays'] / 1e6:7.0f} {audit['rays'] / 1e6:7.0f} {events:9,} "
        f"{every / max(events, 1):9,.0f} {seconds:7.0f} "
        f"{deviation['rms']:5.2f} {deviation['p99']:5.2f} {seen.get('missed') or 0:7.2%} {audit['verdict']}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("row", nargs="*", help=f"rows, default all: {' '.join(ROWS)}")
    parser.add_argument("--folder", type=Path, help="keep the recordings in a new folder")
    parser.add_argument("--forecast", action="store_true", help="run nothing")
    asked = parser.parse_args()
    rows = {
        name: row for name, row in ROWS.items() if not asked.row or name in asked.row or name.strip("*") in asked.row
    }
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        heads = (
            f"{'picture':>9} {'pilot':>7} {'audit':>7} {'events':>9} {'per event':>9} {'s':>7} {'rms':>5} {'99 %':>5}"
        )
        print(f"{'row':14} {'scene, sensor, s':34} {heads} {'missed':>7} audit")
        for name, (scene, sensor, seconds, is_run) in rows.items():
            row, what = (scene, sensor, seconds), f"{Path(scene).stem}, {sensor}, {seconds:g}"
            text = (
                run(name, row, folder) if is_run and not asked.forecast else f"{forecast(row):9,} million, by forecast"
            )
            print(f"{name:14} {what:34} {text}", flush=True)
    most_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
    print(f"largest memory of a run: {most_gb:.2f} GB; rays in millions, deviations in noise units")


if __name__ == "__main__":
    main()

"""Estimates before runs against the runs: rays and time of pairs of a scene and a sensor, in the default mode.

    python benchmarks/forecasts.py [PAIR ...] [--again]

Each pair is a process of its own. It prints the estimated and the counted rays (picture and pilot), and the estimated
time beside that from the estimate to the end of the run, with its audit and files. Nothing of the estimate was fitted
on these pairs.
Rays are those of any machine; times need an otherwise idle one, with kernels compiled before: `--again` runs each
pair twice and prints the second time.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENES = Path(__file__).parent / "scenes"
#: Scene, sensor, seconds, region (None for the whole sensor).
PAIRS = {
    "pendulum-dvs128": ("pendulum", "dvs128", 0.02, None),
    "pendulum-davis240": ("pendulum", "davis240", 0.01, None),
    "pendulum-gen2": ("pendulum", "gen2", 0.02, "1600x1200+800+600"),
    "robot-arm-dvs128": ("robot-arm", "dvs128", 0.01, None),
    "robot-arm-genx320": ("robot-arm", "genx320", 0.004, None),
    "fan-dvs128": ("fan", "dvs128", 0.002, None),
    "traffic-light-dvs128": ("traffic-light", "dvs128", 0.01, None),
    "traffic-light-davis240": ("traffic-light", "davis240", 0.003, None),
    "facade-drive-dvs128": ("facade-drive", "dvs128", 0.01, None),
    "facade-drive-gen2": ("facade-drive", "gen2", 0.01, "800x600+1000+900"),
    "falling-objects-dvs128": ("falling-objects", "dvs128", 0.01, None),
    "falling-objects-davis240": ("falling-objects", "davis240", 0.005, None),
    "edge-field-dvs128": ("edge-field", "dvs128", 0.02, None),
    "hand-held-gen2": ("hand-held", "gen2", 0.01, "800x600+1200+900"),
    "sweep-dvs128": ("camera-sweep", "dvs128", 0.01, None),
    "sweep-mono": ("camera-sweep", "reference-mono", 0.02, None),
    "star-genx320": ("rotating-star", "genx320", 0.005, None),
    "star-bayer": ("rotating-star", "reference-bayer", 0.04, None),
    "room-davis346": (str(SCENES / "room.yaml"), "davis346", 0.005, "64x48+140+100"),
    "floor-ball-davis346": (str(SCENES / "floor-ball.yaml"), "davis346", 0.005, "64x48+140+100"),
}
#: Largest deviations that count as right: rays, and times either way.
RAYS_REL, TIME_FACTOR = 0.3, 1.5


def one(scene, sensor, seconds, region):
    """Run a pair in this process, and print what was estimated and what it took."""
    import hesim_render as hr
    from hesim_render.core.region import parse_roi

    estimates, begins = [], []
    sensor = hr.load_sensor(sensor)
    if region is not None:
        sensor = sensor.crop(*parse_roi(region))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        hr.simulate(
            scene, sensor, duration_s=seconds, out=out, progress=False,
            on_estimate=lambda estimate: (estimates.append(estimate), begins.append(time.monotonic())),
        )  # fmt: skip
        own_seconds = time.monotonic() - begins[0]
        recording = json.loads((out / "recording.json").read_text())
    render = recording["settings"]["render"]
    rays = render["rays"] + render["pilot_rays"]
    print(json.dumps([estimates[0].rays, estimates[0].seconds, rays, own_seconds, recording["counts"]["events"]]))


def measured(pair):
    """Estimated rays and time, those of the run, and its events."""
    ran = subprocess.run([sys.executable, __file__, "--one", *map(str, pair)], capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pair", nargs="*", help=f"pairs, default all: {' '.join(PAIRS)}")
    parser.add_argument("--again", action="store_true", help="run each pair twice, so that its kernels are compiled")
    parser.add_argument("--one", nargs=4, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        scene, sensor, seconds, region = asked.one
        return one(scene, sensor, float(seconds), None if region == "None" else region)
    right_rays = right_times = count = 0
    heads = f"{'million rays: estimate, run':>28} {'ratio':>6} {'s: estimate, run':>18} {'ratio':>6} {'events':>9}"
    print(f"{'pair':26} {heads}")
    for name, pair in PAIRS.items():
        if asked.pair and name not in asked.pair:
            continue
        for _ in range(1 + asked.again):
            rays, seconds, own_rays, own_seconds, events = measured(pair)
        of_rays, of_time = rays / own_rays, seconds / own_seconds
        count += 1
        right_rays += abs(of_rays - 1) <= RAYS_REL
        right_times += 1 / TIME_FACTOR <= of_time <= TIME_FACTOR
        print(
            f"{name:26} {rays / 1e6:14.1f} {own_rays / 1e6:13.1f} {of_rays:6.2f} {seconds:9.1f} {own_seconds:8.1f} "
            f"{of_time:6.2f} {events:9,}",
            flush=True,
        )
    print(f"rays within {RAYS_REL:.0%}: {right_rays} of {count}; time within {TIME_FACTOR}: {right_times} of {count}")
    return None


if __name__ == "__main__":
    main()

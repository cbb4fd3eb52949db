"""Every number of a sensor or scene file at an absurd value: refused in one error, or simulated to finite results."""

import subprocess
import sys

import pytest

#: One child process a part: what hangs in native code cannot be stopped from within.
CHILD = """
import sys
import numpy as np
import hesim_render as hr
from hesim_render.core.errors import HesimError

def numbers(node, key=""):
    for name, value in node.items() if isinstance(node, dict) else enumerate(node):
        if isinstance(value, dict | list):
            yield from numbers(value, f"{key}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield f"{key}{name}"

kind, name, values = sys.argv[1], sys.argv[2], [float(v) for v in sys.argv[3].split(",")]
spec = (hr.load_sensor if kind == "sensor" else hr.load_scene)(name).spec.model_dump(mode="json", exclude_none=True)
spec.pop("sources", None), spec.pop("assumptions", None)
whole = {"geometry.rows", "geometry.cols", "device_seed", "aps.bit_depth", "evs.tick_us", "evs.window_us"}
for key in numbers(spec):
    if ".wavelength_nm." in key or ".value." in key or key == "schema_version":
        continue
    for value in values:
        change = {key: int(min(value, 1e18)) if key in whole else value}
        print(f"{change}", flush=True)
        try:
            sensor = hr.load_sensor(name, change) if kind == "sensor" else hr.load_sensor("davis346")
            scene = hr.load_scene("flat-field") if kind == "sensor" else hr.load_scene(name, change)
            run = hr.simulate(scene, sensor.crop(8, 8), duration_s=0.03, quality=20, max_minutes=1, audit=False)
        except HesimError as error:
            assert "\\n" not in str(error) and len(str(error)) < 400, error
            continue
        for frame in run.frames:
            assert np.isfinite(frame.electrons_mean[frame.valid]).all(), "truth"
            assert frame.raw.max() < 2 ** sensor.spec.aps.bit_depth, "RAW"
        assert np.isfinite(run.event_truth.flux_mean_e_per_s).all(), "flux"
"""


def _all_are_answered(kind, name, values, seconds):
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", CHILD, kind, name, values],
            capture_output=True,
            text=True,
            timeout=seconds,
        )
    except subprocess.TimeoutExpired as late:
        pytest.fail(f"hangs at {late.stdout.decode().splitlines()[-1]}")
    assert done.returncode == 0, f"{done.stdout.splitlines()[-1]}: {done.stderr[-600:]}"
    assert len(done.stdout.splitlines()) > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", ["davis346", "eiger"])
def test_numbers_of_sensor_files(name):
    _all_are_answered("sensor", name, "1e300,1e30,1e12,1e-12,1e-300,-1e300", 900)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rotating-star", "colorchecker"])
def test_numbers_of_scene_files(name):
    _all_are_answered("scene", name, "1e300,1e12,1e-12,1e-300,-1e300", 900)

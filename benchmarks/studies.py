"""How long a study of filter sets, a large cube and a design take, and how much memory the cube needs.

Run: python benchmarks/studies.py [sets | demosaic | cube | design]
"""

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

import hesim_render as hr
from hesim_render.specs.design import read_design
from hesim_render.studies import reflectance_set
from hesim_render.studies.design import Problem, optimise

BANDS = np.arange(400.0, 701.0, 10.0)


def cube(file, rows, cols):
    """A cube of mixed reflectances, written in bands of rows."""
    table = np.array([each.at(BANDS) for each in reflectance_set("colorchecker").values()], np.float32)
    stored = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=(rows, cols, BANDS.size))
    rng = np.random.default_rng(1)
    for first in range(0, rows, 64):
        weights = rng.dirichlet(np.full(len(table), 0.2), (min(64, rows - first), cols)).astype(np.float32)
        stored[first : first + 64] = weights @ table
    stored.flush()


def palettes(folder, count):
    """Variations of red, green and blue dyes."""
    rng = np.random.default_rng(2)
    for number in range(count):
        low, high = 500 + rng.normal(0, 8), 586 + rng.normal(0, 8)
        content = {
            "schema_version": 1, "name": f"p{number}", "description": "varied",
            "quantum_efficiency": {"product": [
                {"silicon_depth_um": 3.0}, {"dye": {"edges": [[655.0, 7.0, 4.0], [398.0, -4.0, 4.0]]}},
            ]},
            "filters": {
                "red": {"dye": {"edges": [[float(high), -8.0, 2.0]]}, "scale": 0.93},
                "green": {"dye": {"edges": [[float(low), -11.0, 1.6], [float(high), 11.0, 1.6]]}, "scale": 0.9},
                "blue": {"dye": {"edges": [[float(low), 11.0, 1.8]]}, "scale": 0.88},
            },
        }  # fmt: skip
        with (folder / f"p{number}.yaml").open("w") as file:
            YAML().dump(content, file)
    return [{"set": "rggb", "palette": str(folder / f"p{number}.yaml")} for number in range(count)]


def timed(text, call):
    begin, cpu = time.perf_counter(), time.process_time()
    call()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    wall, own = time.perf_counter() - begin, time.process_time() - cpu
    print(f"{text}: {wall:.1f} s, {own:.1f} s of processor time, {peak:.2f} GB peak so far", flush=True)


def main(parts):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base = {"schema_version": 1, "name": "benchmark", "sensors": ["reference-bayer"]}
        sets = palettes(folder, 50)
        if "sets" in parts:
            cube(folder / "small.npy", 384, 512)
            surfaces = [{"cube": str(folder / "small.npy"), "wavelength_nm": BANDS.tolist(), "beyond": "hold"}]
            spec = {**base, "filter_sets": sets, "surfaces": surfaces, "figures": ["colour", "noise"]}
            timed("50 filter sets over one 512x384x31 cube", lambda: hr.study(spec))
        if "demosaic" in parts:
            more = {**base, "filter_sets": sets, "figures": ["colour", "noise", "demosaic"], "noise": {"repeats": 8}}
            timed("50 filter sets with demosaic figures and 8 noisy frames", lambda: hr.study(more))
        if "cube" in parts:
            cube(folder / "large.npy", 2448, 3264)
            surfaces = [{"cube": str(folder / "large.npy"), "wavelength_nm": BANDS.tolist(), "beyond": "hold"}]
            spec = {**base, "filter_sets": sets[:5], "surfaces": surfaces, "figures": ["colour"]}
            timed("5 filter sets over one 3264x2448x31 cube (NPY, streamed)", lambda: hr.study(spec))
        if "design" in parts:
            problem = Problem(read_design("rggb-dyes"))
            timed("design rggb-dyes, 4 starts of 125 steps", lambda: optimise(problem))


if __name__ == "__main__":
    main(sys.argv[1:] or ["sets", "demosaic", "cube", "design"])

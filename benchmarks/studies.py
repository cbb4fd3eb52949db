"""How long a study of filter sets, large cubes and a design take, and how much memory each kind of cube needs.

Run: python benchmarks/studies.py [sets | demosaic | cubes | ENVI | HDF5 | NPY | EXR | design]

cubes reads 3264x2448x31 values from ENVI, HDF5, NPY and EXR files, each in a process of its own; it needs 1 GB of disk.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

import hesim_render as hr
from hesim_render.specs.design import DesignSpec
from hesim_render.specs.files import read_spec
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
    # the high-water mark of this process; that of getrusage begins with its parent's
    status = Path("/proc/self/status").read_text().splitlines()
    peak = int(next(line for line in status if line.startswith("VmHWM")).split()[1]) / 1e6
    wall, own = time.perf_counter() - begin, time.process_time() - cpu
    print(f"{text}: {wall:.1f} s, {own:.1f} s of processor time, {peak:.2f} GB peak so far", flush=True)


LARGE = ("ENVI", "HDF5", "NPY", "EXR")
ROWS, COLS = 2448, 3264


def large_cube(folder, kind):
    """A file of 3264x2448x31 values: the ColorChecker's reflectances mixed, bands of 64 rows over and over."""
    table = np.array([each.at(BANDS) for each in reflectance_set("colorchecker").values()], np.float32)
    rng = np.random.default_rng(1)
    part = rng.dirichlet(np.full(len(table), 0.2), (64, COLS)).astype(np.float32) @ table
    starts = range(0, ROWS, 64)
    if kind == "NPY":
        file = folder / "large.npy"
        stored = np.lib.format.open_memmap(file, mode="w+", dtype=np.float32, shape=(ROWS, COLS, BANDS.size))
        for first in starts:
            stored[first : first + 64] = part[: ROWS - first]
    elif kind == "HDF5":
        import h5py

        file = folder / "large.h5"
        with h5py.File(file, "w") as opened:  # ARAD-1K's layout: axes in MATLAB's order
            stored = opened.create_dataset("cube", (BANDS.size, COLS, ROWS), np.float32, chunks=(BANDS.size, 64, 64))
            for first in starts:
                stored[:, :, first : first + 64] = part[: ROWS - first].transpose(2, 1, 0)
            opened["bands"] = BANDS
    elif kind == "ENVI":
        file = folder / "large.hdr"
        file.write_text(
            f"ENVI\nsamples = {COLS}\nlines = {ROWS}\nbands = {BANDS.size}\nheader offset = 0\ndata type = 4\n"
            f"interleave = bil\nbyte order = 0\nwavelength units = nm\nwavelength = {{{', '.join(map(str, BANDS))}}}\n"
        )
        with (folder / "large.img").open("wb") as opened:
            for first in starts:
                opened.write(np.ascontiguousarray(part[: ROWS - first].transpose(0, 2, 1)).tobytes())
    else:
        import OpenEXR

        file = folder / "large.exr"
        planes = np.tile(part.astype(np.float16), (-(-ROWS // 64), 1, 1))[:ROWS]
        names = [f"T.{band:g},0nm" for band in BANDS]
        header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {n: np.ascontiguousarray(planes[..., k]) for k, n in enumerate(names)}).write(str(file))
    return file


def read(file, palettes):
    """A study of a large cube."""
    item = {"cube": file, "beyond": "hold"}
    if file.endswith(".npy"):
        item["wavelength_nm"] = BANDS.tolist()
    spec = {
        "schema_version": 1, "name": "large", "sensors": ["reference-bayer"], "figures": ["colour"],
        "filter_sets": [{"set": "rggb", "palette": palette} for palette in palettes], "surfaces": [item],
    }  # fmt: skip
    timed(f"{len(palettes)} filter sets over one {COLS}x{ROWS}x{BANDS.size} cube, {Path(file).suffix}",
          lambda: hr.study(spec))  # fmt: skip


def main(parts):
    if parts[0] == "read":
        read(parts[1], parts[2:])
        return
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
        for kind in LARGE:
            if "cubes" in parts or kind in parts:
                file = large_cube(folder, kind)
                # another process: its peak is of this file alone
                subprocess.run([sys.executable, __file__, "read", str(file), *(use["palette"] for use in sets[:5])],
                               check=True)  # fmt: skip
                for each in folder.glob("large*"):
                    each.unlink()
        if "design" in parts:
            problem = Problem(read_spec(DesignSpec, "rggb-dyes", "studies"))
            timed("design rggb-dyes, 4 starts of 125 steps", lambda: optimise(problem))


if __name__ == "__main__":
    main(sys.argv[1:] or ["sets", "demosaic", "cubes", "design"])

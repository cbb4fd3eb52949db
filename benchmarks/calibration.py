"""Time and memory of a calibration at 1024×1024, against the bounds 20 s, 1 GB and 5 s.

    python benchmarks/calibration.py [--size 1024] [--frames 64] [--keep FOLDER]

Makes 5 exposures × `frames` frames × 2 sets and pooled counts of 20,000 ticks in plain NumPy, then times
`calibrate_aps` (whole, and the part that only inflates the .npz members) and `calibrate_evs`.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
from scipy.special import ndtr

EXPOSURES_S = np.array([1, 2, 5, 10, 20]) * 1e-3
_CHILD = """
import json, resource, sys, time
from hesim_render.calibrate import calibrate_{kind}
start = time.perf_counter()
calibrate_{kind}({folder!r}, {out!r}, {report!r})
seconds = time.perf_counter() - start
print(json.dumps([seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6]))
"""


def make(folder, size, frames):
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "capture.yaml").write_text("bit_depth: 10\ntile_rows: 4\ntile_cols: 4\ntheta_hardware_v: 0.00075\n")
    xx = np.arange(size) / (size - 1) * np.ones((size, 1))
    slope = 40e3 * (0.02 + 0.98 * xx)
    offset = 64 + rng.normal(0, 0.6, (size, size)) + rng.normal(0, 0.8, (size, 1))
    pool = rng.standard_normal(1 << 22, dtype=np.float32)
    for name, lit in (("aps_dark", False), ("aps_lit", True)):
        with zipfile.ZipFile(folder / f"{name}.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            with archive.open("frames.npy", "w", force_zip64=True) as stream:
                shape = (len(EXPOSURES_S), frames, size, size)
                header = {"descr": "<u2", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)
                for t in EXPOSURES_S:
                    light = slope * t if lit else 0 * slope
                    sigma = np.sqrt(2.2 + 0.26 * light + 52 * t).astype(np.float32)
                    for _ in range(frames):
                        noise = np.tile(np.roll(pool, int(rng.integers(pool.size))), -(-size * size // pool.size))
                        value = light + offset + sigma * noise[: size * size].reshape(size, size)
                        stream.write(np.clip(np.rint(value), 0, 1023).astype("<u2").tobytes())
            with archive.open("exposures_us.npy", "w") as stream:
                np.lib.format.write_array(stream, np.rint(EXPOSURES_S * 1e6).astype(np.int64))
    signal = 0.5 + 40 * xx

    def draw(i, trials=20000):
        p = ndtr(-0.75e-3 * (29 * i + 6240) / np.sqrt(2 * (1 + (0.03 * i) ** 2)))
        on = rng.binomial(trials, p)
        return on.astype(np.int32), rng.binomial(trials - on, p / (1 - p)).astype(np.int32)

    on, off = draw(signal)
    dark_on, dark_off = draw(0 * signal)
    np.savez_compressed(
        folder / "evs_static.npz",
        signal_dn=signal,
        n_on=on,
        n_off=off,
        n_trials=20000,
        dark_n_on=dark_on,
        dark_n_off=dark_off,
    )


def inflate(file):
    start = time.perf_counter()
    with zipfile.ZipFile(file) as archive, archive.open("frames.npy") as stream:
        while stream.read(1 << 18):
            pass
    return time.perf_counter() - start


def run(kind, folder):
    out, report = str(folder / "calibration.yaml"), str(folder / "report.html")
    code = _CHILD.format(kind=kind, folder=str(folder), out=out, report=report)
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--keep", type=Path, help="folder for the captures, used again where it exists")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary) / "captures"
        if not (folder / "evs_static.npz").exists():
            print("making the captures ...", flush=True)
            make(folder, given.size, given.frames)
        files = [folder / f"{name}.npz" for name in ("aps_dark", "aps_lit")]
        inflating = [inflate(file) for file in files]
        aps, evs = run("aps", folder), run("evs", folder)
        frames = f"5 exposures x {given.frames} frames x 2 sets at {given.size}x{given.size}"
        print(f"APS calibration, {frames}, with report: {aps[0]:.1f} s, {aps[1]:.0f} MB (bounds 20 s, 1000 MB)")
        print(f"  inflating the two files alone, one after the other: {sum(inflating):.1f} s")
        counts = f"{given.size}x{given.size}, 20000 ticks"
        print(f"EVS calibration, {counts}, with report: {evs[0]:.1f} s, {evs[1]:.0f} MB (bound 5 s)")


if __name__ == "__main__":
    main()

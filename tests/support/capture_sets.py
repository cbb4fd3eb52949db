"""Capture sets for the calibration tests: the independent generator's, and small ones written out here."""

import functools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

GENERATOR = Path(__file__).with_name("make_captures.py")
_ROOT = tempfile.TemporaryDirectory(prefix="capture-sets-")


@functools.cache
def generated(seed, size=256, frames=64, mismatch=0.0):
    """Folder of a set made by make_captures.py; made once per test run."""
    folder = Path(_ROOT.name) / f"{seed}-{size}-{frames}-{mismatch}"
    command = [sys.executable, GENERATOR, folder, "--seed", seed, "--size", size, "--frames", frames]
    subprocess.run([str(c) for c in [*command, "--mismatch", mismatch]], check=True, capture_output=True)
    return folder


def truth(folder):
    return json.loads((folder / "truth.json").read_text())


def shape_of(size):
    """Rows and columns: a pair of them, or one number for both."""
    return (size, size) if isinstance(size, int) else size


def write_description(folder, **keys):
    folder.mkdir(parents=True, exist_ok=True)
    lines = {"bit_depth": 10, "tile_rows": 2, "tile_cols": 2} | keys
    (folder / "capture.yaml").write_text("".join(f"{k}: {v}\n" for k, v in lines.items()))


def write_frames(
    folder, *, size=(56, 72), frames=32, dark_s=(2e-3, 5e-3, 20e-3), lit_s=(2e-3, 5e-3, 20e-3), gain=0.25,
    read_noise_e=6.0, dark_e_per_s=2000.0, dsnu_e=4.0, prnu=0.0, full_well_e=1e9, brightest_e_per_s=1.6e5,
    dimmest=0.02, black=64.0, full_scale=1023, flat=False, seed=5, **keys,
):  # fmt: skip
    """Frames of the physical form, DN = clip(round(K min(Poisson((1 + PRNU) I + D t), full well) + read + N_FP))."""
    rng, shape = np.random.default_rng(seed), shape_of(size)
    xx = np.linspace(0, 1, shape[1]) + np.zeros(shape)
    rate = brightest_e_per_s * (np.ones(shape) if flat else dimmest + (1 - dimmest) * xx)
    rate = rate * (1 + prnu * rng.standard_normal(shape))
    offset = black + gain * dsnu_e * rng.standard_normal(shape)

    def shoot(exposures_s, light):
        stack = np.empty((len(exposures_s), frames, *shape), np.uint16)
        for k, t in enumerate(exposures_s):
            electrons = np.minimum(rng.poisson((light + dark_e_per_s) * t, (frames, *shape)), full_well_e)
            value = gain * (electrons + read_noise_e * rng.standard_normal(electrons.shape)) + offset
            stack[k] = np.clip(np.rint(value), 0, full_scale)
        return stack

    write_description(folder, **keys)
    save_frames(folder, "aps_dark", shoot(dark_s, 0.0 * rate), dark_s)
    save_frames(folder, "aps_lit", shoot(lit_s, rate), lit_s)
    return rate


def save_frames(folder, name, frames, exposures_s, **more):
    np.savez(folder / f"{name}.npz", frames=frames, exposures_us=np.rint(np.array(exposures_s) * 1e6), **more)


def write_events(
    folder, *, size=(56, 72), trials=5000, brightest=40.0, a=29.0, b=6240.0, c=0.03, d=0.0, theta_v=0.75e-3, rho=0.0,
    leak=0.0,     law="linear", dark=True, ramp=True, seed=3, mismatch=0.0, **keys,
):  # fmt: skip
    """Static counts of the event model with thresholds θ (1 ∓ ρ), leak events and a choice of shot law."""
    from scipy.special import ndtr

    rng, shape = np.random.default_rng(seed), shape_of(size)
    xx = np.linspace(0, 1, shape[1]) + np.zeros(shape)
    signal = 0.5 + brightest * xx if ramp else np.full(shape, brightest)
    scale = 1 + mismatch * rng.standard_normal(shape)

    def draw(light):
        y = c * (light if law == "linear" else np.sqrt(light))
        u = theta_v * (a * light + b) / np.sqrt(2 * (1 + 2 * d * y + y * y)) * scale
        p, q = ndtr(-u * (1 - rho)) + leak, ndtr(-u * (1 + rho))
        on = rng.binomial(trials, p)
        return on, rng.binomial(trials - on, q / (1 - p))

    write_description(folder, theta_hardware_v=theta_v, **keys)
    on, off = draw(signal)
    arrays = {"signal_dn": signal, "n_on": on, "n_off": off, "n_trials": trials}
    if dark:
        arrays["dark_n_on"], arrays["dark_n_off"] = draw(np.zeros_like(signal))
    np.savez(folder / "evs_static.npz", **arrays)
    return arrays


def change(file, **arrays):
    """Replace or, with None, remove arrays of an .npz file."""
    with np.load(file, allow_pickle=True) as data:
        found = {name: data[name] for name in data.files}
    found |= arrays
    np.savez(file, **{name: value for name, value in found.items() if value is not None})

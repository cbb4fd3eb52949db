"""Speed and memory of the frame and event stages at 3264×2448 against plain NumPy.

Prints Mpixel/s of the APS stage (Gaussian and Poisson law), Mpixel-samples/s of the EVS stage, the ratio
of each to a whole-frame NumPy version of the same model written here, and the peak memory of a process
that runs one full-resolution slice through both of our stages::

    python benchmarks/stages.py [--repetitions 7]

Every pixel reads frames and events, with all noise terms on. A time covers everything from electrons to
finished numbers on the host: uint16 DN, or the sorted event array. The NumPy version is in single
precision throughout, NumPy's fastest, and runs on one core, as NumPy does; ours takes all there are.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time

import numpy as np

ROWS, COLS = 2448, 3264
MEAN_ELECTRONS = 500.0
OVERRIDES = {
    "geometry.rows": ROWS,
    "geometry.cols": COLS,
    "aps.prnu_rel": 0.005,
    "aps.dsnu_e": 2.0,
    "aps.row_offset_std_dn": 0.5,
    "aps.dark_current_e_per_s": 10.0,
    "aps.dark_current_nonuniformity_rel": 0.5,
    # 3.4 standard deviations of the static difference at 50 electrons: about 4e-4 events per sample and sign
    "evs.contrast_threshold_on": 0.67,
    "evs.contrast_threshold_off": 0.67,
    "evs.threshold_mismatch_rel": 0.03,
    "evs.leak_rate_hz": 0.1,
}
WINDOW_ELECTRONS = 50.0


def build(law):
    from hesim_render.mosaic.layout import Layout
    from hesim_render.pixels.aps.model import ApsNoise
    from hesim_render.pixels.evs.model import EvsNoise
    from hesim_render.sensor.reading import read_sensor

    spec = read_sensor("reference-mono", {**OVERRIDES, "aps.law": law})
    layout = Layout.full(spec)
    return ApsNoise(spec.aps, layout, spec.device_seed), EvsNoise(spec.evs, layout, spec.device_seed, np.ones(1))


def scenes():
    """Electrons of an exposure, flat and from dark to bright, and of an event window."""
    rng = np.random.default_rng(0)
    flat = np.full((ROWS, COLS), MEAN_ELECTRONS, dtype=np.float32)
    mixed = rng.uniform(0, 5000, (ROWS, COLS)).astype(np.float32)
    return {"500 e-": flat, "0 to 5000 e-": mixed}, np.full((ROWS, COLS), WINDOW_ELECTRONS, dtype=np.float32)


def on_device(image):
    import drjit as dr

    from hesim_render.core.backend import jit

    array = jit().Float(image.ravel())
    dr.eval(array)
    dr.sync_thread()
    return array


class NumpyAps:
    """The physical form of the frame model, as one writes it down."""

    def __init__(self, noise):
        self.spec, maps = noise.spec, noise.fixed_pattern
        self.response, self.dark, self.offset = maps.response, maps.dark_e_per_s, maps.offset_dn
        self.rng = np.random.default_rng(1)

    def sample(self, electrons, exposure_us):
        spec, shape = self.spec, electrons.shape
        mean = self.response * electrons + self.dark * np.float32(exposure_us * 1e-6)
        if spec.law == "poisson":
            count = self.rng.poisson(mean).astype(np.float32)
        else:
            count = mean + np.sqrt(mean) * self.rng.standard_normal(shape, dtype=np.float32)
        charge = np.minimum(count, np.float32(spec.full_well_e))
        charge += np.float32(spec.read_noise_e) * self.rng.standard_normal(shape, dtype=np.float32)
        dn = np.rint(np.float32(spec.system_gain_dn_per_e) * charge + self.offset)
        return np.clip(dn, 0, 2**spec.bit_depth - 1).astype(np.uint16)


class NumpyEvs:
    """The event model with previous_sample reference, one noise draw per sample and leak."""

    def __init__(self, noise, event_dtype):
        self.spec, self.dtype = noise.spec, event_dtype
        self.theta_on, self.theta_off = noise.threshold_on_map, noise.threshold_off_map
        self.rng = np.random.default_rng(2)
        self.level = None

    def step(self, electrons, t_us):
        spec, beta, shape = self.spec, self.spec.coefficients[0], electrons.shape
        reference = spec.signal_reference
        signal = np.float32(reference.k_dn_per_e * reference.t_ref_us / spec.window_us) * electrons
        x = np.float32(beta.beta1) * signal + np.float32(beta.beta2)
        variance = np.float32(beta.beta3**2) * signal + np.float32(beta.beta4**2)
        variance += np.float32(2 * beta.beta5 * beta.beta3 * beta.beta4) * np.sqrt(signal)
        level = np.log(x) + np.sqrt(variance) / x * self.rng.standard_normal(shape, dtype=np.float32)
        before, self.level = self.level, level
        if before is None:
            return np.empty(0, self.dtype)
        change = level - before
        off = change < -self.theta_off
        leak = self.rng.random(shape, dtype=np.float32) < -np.expm1(-spec.leak_rate_hz * spec.tick_us * 1e-6)
        on = (change > self.theta_on) | (leak & ~off)
        y, x = np.nonzero(on | off)
        events = np.empty(len(x), self.dtype)
        events["t_us"], events["x"], events["y"] = t_us, x, y
        events["polarity"] = np.where(on[y, x], 1, -1)
        return events


def seconds(call, repetitions):
    """Median time of a call after two to warm up, and the size of its last result per pixel."""
    call(0)
    call(1)
    times = []
    for k in range(repetitions):
        begin = time.perf_counter()
        result = call(k + 2)
        times.append(time.perf_counter() - begin)
    return statistics.median(times), len(result) / (ROWS * COLS)


def report(name, ours_s, numpy_s, goal, goal_ratio):
    speed, plain = ROWS * COLS / ours_s / 1e6, ROWS * COLS / numpy_s / 1e6
    print(f"{name:34s} {speed:8.1f} {plain:8.1f} {speed / plain:7.1f}x   {goal:.0f} and {goal_ratio:.0f}x", flush=True)


def run_speed(repetitions):
    from hesim_render.core.backend import select
    from hesim_render.pixels.evs.events import EVENT_DTYPE
    from hesim_render.pixels.evs.stage import EvsStage

    print(f"{ROWS * COLS / 1e6:.1f} Mpixel, {select().describe()}, {os.cpu_count()} cores, median of {repetitions}")
    print(f"{'':34s} {'ours':>8s} {'NumPy':>8s} {'ratio':>8s}   goal      (Mpixel/s)")
    frames, window = scenes()
    for law, goal, goal_ratio in (("gaussian", 100, 6), ("poisson", 45, 4)):
        noise, _ = build(law)
        plain = NumpyAps(noise)
        for label, image in frames.items():
            electrons = on_device(image)
            ours_s, _ = seconds(lambda k, e=electrons, n=noise: n.sample(e, 10000, seed=1, frame=k), repetitions)
            numpy_s, _ = seconds(lambda k, e=image, p=plain: p.sample(e, 10000), repetitions)
            report(f"APS {law}, {label}", ours_s, numpy_s, goal, goal_ratio)
    _, noise = build("poisson")
    stage, plain = EvsStage(noise, seed=1), NumpyEvs(noise, EVENT_DTYPE)
    electrons = on_device(window)
    tick_us = noise.spec.tick_us
    ours_s, ours_rate = seconds(lambda k: stage.step(electrons, tick_us * (k + 1)), repetitions)
    numpy_s, numpy_rate = seconds(lambda k: plain.step(window, tick_us * (k + 1)), repetitions)
    report("EVS previous_sample, per_instant", ours_s, numpy_s, 80, 6)
    print(f"(events per pixel and sample: ours {ours_rate:.2e}, NumPy {numpy_rate:.2e})")


def run_memory():
    """One slice through both stages, alone in its process."""
    from hesim_render.pixels.evs.stage import EvsStage

    aps, evs = build("poisson")
    frames, window = scenes()
    aps.sample(on_device(frames["0 to 5000 e-"]), 10000, seed=1)
    stage = EvsStage(evs, seed=1)
    electrons = on_device(window)
    for tick in (1, 2):
        stage.step(electrons, 1000 * tick)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--memory-only", action="store_true", help="print the peak memory of this process, in bytes")
    arguments = parser.parse_args()
    if arguments.memory_only:
        run_memory()
        return
    child = [sys.executable, __file__, "--memory-only"]
    peak = int(subprocess.run(child, capture_output=True, text=True, check=True).stdout.split()[-1])
    run_speed(arguments.repetitions)
    print(f"peak memory of one slice with both stages: {peak / 1e9:.2f} GB (goal: below 2)")


if __name__ == "__main__":
    main()

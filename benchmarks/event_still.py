"""Event pixels in still light against a real sensor: rates, silent pixels, spread over pixels, law of the intervals.

    python benchmarks/event_still.py iebcs_noise.npz [--devices 20]

The file holds measured tables of 50×50 pixels of a real DVS [joubert2021], as IEBCS has them: for each light and
polarity the counts of the intervals between successive events of one polarity whose reciprocal is below ``bins_hz[k +
1]``, uint16 [row, col, k]. The eight parameters below were fitted to the six tables (`FITTED`); `devices` sensors of
as many pixels are simulated for as long, and each figure of the real one is compared with those of the simulated ones.
"""

import argparse
from pathlib import Path

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.stage import EvsStage
from hesim_render.sensor.reading import read_sensor

#: θ₊ over the noise's σ at 0.1 lx, bandwidth of the noise (Hz), its spread over pixels, θ₋ over θ₊; leak in the dark
#: (Hz), its growth (Hz/lx), its tail (Hz). `rows` is one figure for two: by so much odd rows have a larger bandwidth
#: and even ones a smaller one, and so much the leak differs from pixel to pixel. Each alone would be 0.30 and 0.29.
FITTED = {"threshold": 2.1, "bandwidth_hz": 24.7, "bandwidth_rel": 0.44, "off": 1.32, "rows": 0.3,
          "leak_hz": 0.0451, "leak_hz_per_lux": 2.7e-5, "tail_hz": 0.01466}  # fmt: skip
#: Light, lx, name in the file and length of the recording, s: not stated, read from the tables (the longest sums of the
#: intervals of a pixel; the fast pixels' counts at 161 and 3000 lx, whose rates are the same, have the ratio 1.2).
LIGHTS = ((0.1, "0p1lux", 8.5), (161.0, "161lux", 16.6), (3000.0, "3klux", 20.0))
#: Dead time: no interval below 0.5 ms is in the tables. Light as bright as the dark current: not seen in them.
DEAD_US, DARK_LUX = 500, 0.01
SIDE = 50


def measured(file, name, sign):
    """Counts [pixel, bin] of intervals of one polarity."""
    below = np.asarray(file[f"{sign}_{name}"], np.int64)[..., :-1]
    return np.diff(below, axis=-1, prepend=0).reshape(SIDE * SIDE, -1)


def simulated(lux, span_s, bins_hz, devices, seed=1):
    """Counts [polarity, device, pixel, bin] of intervals, and events [polarity, device, pixel]."""
    fitted, theta = FITTED, 0.2
    shot = theta / fitted["threshold"] * np.sqrt(0.1 + DARK_LUX)
    leak = {"process": "drift", "rate_hz": fitted["leak_hz"], "rate_hz_per_dn": fitted["leak_hz_per_lux"],
            "spread_rel": fitted["rows"], "tail_hz": fitted["tail_hz"]}  # fmt: skip
    beta = {"beta1": 1.0, "beta2": DARK_LUX, "beta3": shot, "beta4": shot * np.sqrt(DARK_LUX), "beta5": 0.0}
    spec = read_sensor("reference-mono", {
        "geometry.rows": SIDE, "geometry.cols": SIDE * devices, "device_seed": seed, "evs.reference": "last_event",
        "evs.tick_us": None, "evs.window_us": 1000, "evs.contrast_threshold_on": theta,
        "evs.contrast_threshold_off": theta * fitted["off"], "evs.threshold_mismatch_rel": 0.0,
        "evs.signal_reference": {"k_dn_per_e": 1.0, "t_ref_us": 1000.0, "filter": "own"}, "evs.coefficients": [beta],
        "evs.shot_law": "sqrt", "evs.noise_cutoff_hz": fitted["bandwidth_hz"], "evs.leak": leak,
        "evs.refractory_period_us": DEAD_US,
        "evs.noise_spread": {"bandwidth_rel": fitted["bandwidth_rel"], "odd_rows_rel": fitted["rows"]},
    })  # fmt: skip
    noise = EvsNoise(spec.evs, Layout.full(spec), spec.device_seed, np.ones(1))
    size = SIDE * SIDE * devices
    light, stage = jit().Float(np.full(size, lux, np.float32)), EvsStage(noise, seed)
    stage.step(light, 0)
    last = np.full((2, size), -1, np.int64)
    counts = np.zeros((2, devices * SIDE * SIDE, bins_hz.size - 1), np.int64)
    total = np.zeros((2, size), np.int64)
    for end_us in np.arange(250_000, round(span_s * 1e6) + 1, 250_000):
        events = stage.step(light, int(end_us))
        col = events["x"].astype(np.int64)
        pixel = col // SIDE * SIDE * SIDE + events["y"].astype(np.int64) * SIDE + col % SIDE
        for which, polarity in enumerate((1, -1)):
            mine = events["polarity"] == polarity
            order = np.lexsort((events["t_us"][mine], pixel[mine]))
            own, t_us = pixel[mine][order], events["t_us"][mine][order]
            first = np.diff(own, prepend=-1) != 0
            before = np.where(first, last[which, own], np.append(0, t_us[:-1]))
            known = before >= 0
            bin_ = np.searchsorted(bins_hz, 1e6 / np.maximum(t_us - before, 1), side="right") - 1
            bin_ = np.clip(bin_, 0, counts.shape[-1] - 1)
            np.add.at(counts[which], (own[known], bin_[known]), 1)
            np.add.at(total[which], own, 1)
            last[which, own] = t_us
    shape = (2, devices, SIDE * SIDE)
    return counts.reshape(*shape, -1), total.reshape(shape)


def distance(counts, law):
    """Distance of Kolmogorov and Smirnov between counts of bins and a law of them."""
    return np.max(np.abs(np.cumsum(counts) / max(counts.sum(), 1) - np.cumsum(law) / max(law.sum(), 1)))


def spread(counts):
    """Distribution of the counts of pixels, in bins of a factor of about 1.4 above 5."""
    edges = np.unique(np.r_[0:6, np.round(5 * 2 ** np.arange(0.5, 9, 0.5)), 10**6])
    return np.histogram(counts, edges)[0]


def row(name, real, sims, digits):
    """A line of a table: the real figure, mean and deviation over devices, z."""
    mean, deviation = np.mean(sims), np.std(sims, ddof=1)
    z = (real - mean) / deviation if deviation > 0 else 0.0 if real == mean else np.inf
    print(f"  {name:38}{real:10.{digits}f}{mean:10.{digits}f} ± {deviation:<8.{digits}f}{z:+8.1f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--devices", type=int, default=20)
    options = parser.parse_args()
    with np.load(options.file) as file:
        bins_hz = file["bins_hz"]
        for lux, name, span_s in LIGHTS:
            sims, _ = simulated(lux, span_s, bins_hz, options.devices)
            for which, (sign, polarity) in enumerate((("pos", "ON"), ("neg", "OFF"))):
                real = measured(file, name, sign)
                ours = sims[which]
                per_pixel, theirs = real.sum(axis=1), ours.sum(axis=-1)
                print(f"{lux:g} lx, {polarity}, {span_s:g} s: real, simulated, z")
                row("intervals a pixel and second", per_pixel.mean() / span_s, theirs.mean(axis=1) / span_s, 3)
                row("the same without the fastest 1 %", np.sort(per_pixel)[:-25].mean() / span_s,
                    np.sort(theirs, axis=1)[:, :-25].mean(axis=1) / span_s, 3)  # fmt: skip
                silent = 100 * np.mean(theirs == 0, axis=1)
                row("pixels without an interval, %", 100 * np.mean(per_pixel == 0), silent, 2)
                for percent in (5, 50, 95, 99):
                    row(f"intervals of a pixel, {percent} %", np.percentile(per_pixel, percent),
                        np.percentile(theirs, percent, axis=1), 1)  # fmt: skip
                for told, values, law in (
                    ("all intervals", real.sum(axis=0), ours.sum(axis=1)),
                    ("intervals, 1 % fastest pixels left out", slow(real), np.array([slow(one) for one in ours])),
                    ("counts over pixels", spread(per_pixel), np.array([spread(one) for one in theirs])),
                ):
                    if values.sum() == 0 or law.sum() == 0:
                        continue
                    own = [distance(one, law.sum(axis=0) - one) for one in law]
                    found = distance(values, law.sum(axis=0))
                    alarm = np.mean(np.array(own) >= found)
                    print(f"  KS {told:40}{found:8.3f}; devices {np.mean(own):.3f}, at most {max(own):.3f}; "
                          f"false-alarm rate {alarm:.2f}")  # fmt: skip


def slow(counts):
    """Pooled counts of bins without the fastest hundredth of the pixels."""
    return counts[np.argsort(counts.sum(axis=1), kind="stable")[: -counts.shape[0] // 100]].sum(axis=0)


if __name__ == "__main__":
    main()

"""Rates of noise events of asynchronous pixels: makes the table of `hesim_render.pixels.evs.noise_rates`.

    python benchmarks/event_noise.py hesim_render/pixels/evs/noise_rates.npz      (three minutes on 2 cores)

A pixel of unit noise with thresholds a and b compares with the level at the end of its last dead time. The noise is
white noise through two equal poles that are -3 dB at 1/period together, exact at 16 nodes a period and linear between
them, its amplitude scaled so that the time average of its variance is 1: the law of the simulator, written out again.

The rate of a pixel in the stationary state is that of `hesim_render.pixels.evs.start`, for any thresholds, dead
time and rate of leak events. That law holds for rare crossings. So it is corrected: pixels that begin in it are
simulated for some hundred periods, and the ratio of both rates, without leak, is a factor of the table's entries. Where
events are too rare to be counted, the factor is that of the next lower threshold. It is 1.7 where noise is as large as
the thresholds, and near 1 from 2.5 times the noise on.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.pixels.evs.formulas import POLE
from hesim_render.pixels.evs.noise_rates import RateTable
from hesim_render.pixels.evs.start import Law, Pixels, law

LOWER = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.25, 7.0)
DIFFERENCE = (0.0, 0.1, 0.25, 0.5, 0.8, 1.2, 1.8, 2.6, 3.6, 5.0, 7.5)
DEAD_PERIODS = (0.003, 0.01, 0.03, 0.055, 0.1, 0.17, 0.3, 0.6, 1.0, 3.0)
LEAK_PERIODS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
NODES = 16
#: Thresholds up to which pixels are simulated, and pixels of each entry, of low and of higher ones; periods before the
#: count and of it; least rate that is counted.
SIMULATED, LOW, FEW, MANY = 4.0, 2.4, 1024, 4096
BURN_IN, PERIODS, LEAST = 100, 300, 0.008


def simulate(entries: list[tuple[float, float, float]], start: np.ndarray, seed: int) -> np.ndarray:
    """Events per period of pixels of each (a, b, dead time in periods) after `BURN_IN`.

    Parameters
    ----------
    entries : thresholds over noise and dead time; all with a dead time, or none.
    start : [entry, pixel], level with which each pixel compares in the beginning.
    seed : of the noise.
    """
    import drjit as dr

    types = jit()
    h = POLE / NODES
    step = math.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    amplitude = math.sqrt(3 / (2 + (1 + h) * math.exp(-h)))
    (f00, _), (f10, f11) = (amplitude * np.linalg.cholesky(np.eye(2) - step @ step.T)).tolist()
    (s00, s01), (s10, s11) = step.tolist()
    each = np.repeat(np.array(entries, np.float32), start.shape[1], axis=0)
    on, off, dead = (types.Float(np.ascontiguousarray(column)) for column in (each * [1, 1, NODES]).T.astype("f4"))
    moves = entries[0][2] == 0
    generator = sys.modules[types.Float.__module__].PCG32(size=len(each), initstate=seed)

    def normals(generator):
        radius = dr.sqrt(-2 * dr.log(1 - generator.next_float32()))
        sine, cosine = dr.sincos(math.tau * generator.next_float32())
        return radius * sine, radius * cosine

    def node(number, level, speed, reference, ready, count, generator):
        z, w = normals(generator)
        following = s00 * level + s01 * speed + f00 * z
        speed = s10 * level + s11 * speed + f10 * z + f11 * w
        travel = following - level
        reference = dr.select((ready > 0) & (ready <= 1), dr.fma(travel, ready, level), reference)
        for _ in range(2):  # a second event between two nodes is possible with a short dead time
            up = following - reference >= on
            hit = (ready <= 1) & (up | (following - reference <= -off))
            part = dr.maximum((reference + dr.select(up, on, -off) - level) / travel, dr.maximum(ready, 0))
            count += dr.select(hit, 1, 0)
            if moves:
                reference += dr.select(hit, dr.select(up, on, -off), 0.0)
                continue
            ready = dr.select(hit, part + dead, ready)
            reference = dr.select(hit & (ready <= 1), dr.fma(travel, ready, level), reference)
        return number + 1, following, speed, reference, ready - 1, count, generator

    level, speed = (amplitude * z for z in normals(generator))
    zero = dr.zeros(types.UInt32, len(each))
    reference = types.Float(start.ravel().astype(np.float32))
    state = (zero, level, speed, reference, dr.full(types.Float, -1.0, len(each)), zero, generator)
    counts = []
    for period in (BURN_IN, BURN_IN + PERIODS):
        last = dr.opaque(types.UInt32, NODES * period)
        state = dr.while_loop(state, lambda number, *_, last=last: number < last, node, label="noise")
        counts.append(np.array(state[5]).reshape(start.shape).sum(axis=1))
    return (counts[1] - counts[0]) / (start.shape[1] * PERIODS)


def levels(found: Law, pixels: int) -> np.ndarray:
    """Levels [entry, pixel] of the law, evenly over its quantiles."""
    below = np.concatenate([np.zeros((len(found.share), 1)), np.cumsum(found.share, axis=1)], axis=1)
    wanted = np.random.default_rng(1).permutation((np.arange(pixels) + 0.5) / pixels)
    return np.stack([np.interp(wanted, one, found.edges) for one in below])


def factors(lower: np.ndarray, difference: np.ndarray, dead: float) -> np.ndarray:
    """Simulated rates over those of the law, [lower, difference]."""
    shape = np.broadcast_shapes(lower.shape, difference.shape)
    on, off = np.broadcast_to(lower, shape).ravel(), np.broadcast_to(lower + difference, shape).ravel()
    found = law(Pixels(on, off, dead, LEAK_PERIODS[1], POLE / NODES))
    ratio = np.full(on.size, np.nan)
    counted = (found.events > LEAST) & (on <= SIMULATED)
    for pixels, group in ((FEW, counted & (on < LOW)), (MANY, counted & (on >= LOW))):
        if group.any():
            part = Law(found.edges, *(values[group] for values in found[1:]))
            entries = [(a, b, dead) for a, b in zip(on[group], off[group], strict=True)]
            ratio[group] = simulate(entries, levels(part, pixels), round(1000 * dead) + pixels) / part.events
    ratio = ratio.reshape(shape)
    for along in (ratio, ratio.T):
        for k in range(1, len(along)):
            along[k] = np.where(np.isnan(along[k]), along[k - 1], along[k])
    return ratio


def main(path: str | Path) -> None:
    """Write the table to a file."""
    lower, difference = np.array(LOWER)[:, None], np.array(DIFFERENCE)
    on, off = (np.broadcast_to(each, (len(LOWER), len(DIFFERENCE))).ravel() for each in (lower, lower + difference))

    def rates(dead: float, leak: float) -> np.ndarray:
        return law(Pixels(on, off, dead, leak, POLE / NODES)).events.reshape(len(LOWER), -1)

    table = np.stack([factors(lower, difference, dead)[..., None]
                      * np.stack([rates(dead, leak) for leak in LEAK_PERIODS], axis=-1)
                      for dead in DEAD_PERIODS], axis=2)  # fmt: skip
    without = factors(lower, difference, 0.0) * rates(0.0, LEAK_PERIODS[0])
    rounded = (np.rint(1000 * np.log(values)).astype(np.int16) for values in (without, table))
    axes = (np.array(values) for values in (LOWER, DIFFERENCE, DEAD_PERIODS, LEAK_PERIODS))
    np.savez_compressed(path, **RateTable(*axes, *rounded)._asdict())


if __name__ == "__main__":
    main(sys.argv[1])

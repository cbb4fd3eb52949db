"""Rates of noise events of asynchronous pixels with a dead time: makes hesim_render/specs/event_noise_table.py.

    python benchmarks/event_noise.py > hesim_render/specs/event_noise_table.py      (half an hour on 2 cores)

A pixel of unit noise with thresholds a and b compares with the level at the end of its last dead time. The noise is
white noise through two equal poles that are -3 dB at 1/period together, exact at 16 nodes a period and linear between
them, its amplitude scaled so that the time average of its variance is 1: the law of the simulator, written out again.
Each entry is the mean over the last two thirds of 3000 periods, from at least 6000 events or 16384 pixels. With equal
thresholds and a dead time below 0.1 periods the level wanders slowly, and longer runs differ by up to 40 %.

A pixel without a dead time (the last column) moves its level of comparison by exactly a or b with each event. Its rate
falls for as long as one looks: the entries are means over the 900 periods after the first 100.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from hesim_render.core.backend import jit

MEAN = (0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5)
DIFFERENCE = (0.0, 0.1, 0.25, 0.5, 0.8, 1.2, 1.8, 2.6, 3.6)
DEAD_PERIODS = (0.01, 0.03, 0.055, 0.1, 0.17, 0.3, 0.6, 1.0, 3.0)
NO_DEAD_TIME = -1.0
NODES, ENOUGH, MOST_PIXELS = 16, 6000, 16384
#: First and last period of the mean, with and without a dead time.
SPAN, SPAN_NO_DEAD_TIME = (1000, 3000), (100, 1000)
#: Smallest threshold: larger differences of low thresholds are cut to it.
LEAST = 0.4


def simulate(entries: list[tuple[float, float, float]], pixels: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Events and rates per period of `pixels` pixels of each (a, b, dead time in periods)."""
    import drjit as dr

    types = jit()
    h = math.tau / math.sqrt(math.sqrt(2) - 1) / NODES
    step = math.exp(-h) * np.array([[1 + h, h], [-h, 1 - h]])
    amplitude = math.sqrt(3 / (2 + (1 + h) * math.exp(-h)))
    (f00, _), (f10, f11) = (amplitude * np.linalg.cholesky(np.eye(2) - step @ step.T)).tolist()
    (s00, s01), (s10, s11) = step.tolist()
    each = np.repeat(np.array(entries, np.float32), pixels, axis=0)
    on, off, dead = (types.Float(np.ascontiguousarray(column)) for column in (each * [1, 1, NODES]).T.astype("f4"))
    moves = entries[0][2] < 0  # all entries are of the same kind
    span = SPAN_NO_DEAD_TIME if moves else SPAN
    first, last = (types.UInt32(NODES * period) for period in span)
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
            count += dr.select(hit & (number >= first), 1, 0)
            if moves:
                reference += dr.select(hit, dr.select(up, on, -off), 0.0)
                continue
            ready = dr.select(hit, part + dead, ready)
            reference = dr.select(hit & (ready <= 1), dr.fma(travel, ready, level), reference)
        return number + 1, following, speed, reference, ready - 1, count, generator

    level, speed = (amplitude * z for z in normals(generator))
    zero = dr.zeros(types.UInt32, len(each))
    start = (zero, level, speed, types.Float(level), dr.full(types.Float, -1.0, len(each)), zero, generator)
    end = dr.while_loop(start, lambda number, *_: number < last, node, label="noise")
    events = np.array(end[5]).reshape(len(entries), pixels).sum(axis=1)
    return events, events / (pixels * (span[1] - span[0]))


def row(mean: float, dead: float) -> list[float]:
    """Rates of all differences of the thresholds."""
    entries = []
    for difference in DIFFERENCE:
        half = min(difference / 2, mean - LEAST)
        entries.append((mean - half, mean + half, dead))
    rates = np.zeros(len(entries))
    left, pixels, seed = list(range(len(entries))), 256, round(1000 * mean + 100 * abs(dead))
    while left and pixels <= MOST_PIXELS:
        events, found = simulate([entries[k] for k in left], pixels, seed)
        rates[left] = found
        left = [k for k, count in zip(left, events, strict=True) if count < ENOUGH]
        pixels, seed = 4 * pixels, seed + 7919
    return rates.tolist()


def main() -> None:
    """Print the module."""
    print('"""Events per period of noisy asynchronous pixels; made by ``benchmarks/event_noise.py``."""\n')
    print("#: Mean of both thresholds, and their difference, over σ; dead time times the bandwidth of the noise.")
    print(f"MEAN = {MEAN}\nDIFFERENCE = {DIFFERENCE}\nDEAD_PERIODS = {DEAD_PERIODS}")
    print(
        "#: ON and OFF events per period, [mean, difference, dead time], and without a dead time, [mean, difference]."
    )
    columns = {"EVENTS": DEAD_PERIODS, "EVENTS_NO_DEAD_TIME": (NO_DEAD_TIME,)}
    for name, dead_times in columns.items():
        print(f"{name} = (")
        for mean in MEAN:
            rates = np.array([row(mean, dead) for dead in dead_times])
            lines = [", ".join(f"{rate:.4g}" for rate in line) for line in (rates.T if len(rates) > 1 else rates)]
            if len(lines) == 1:
                print(f"    ({lines[0]}),", flush=True)
            else:
                print("\n".join(["    (", *(f"        ({line})," for line in lines), "    ),"]), flush=True)
        print(")")


if __name__ == "__main__":
    main()

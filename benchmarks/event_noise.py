"""Rates of noise events of asynchronous pixels with a dead time: makes the tables of hesim_render/specs.

    python benchmarks/event_noise.py > hesim_render/specs/event_noise_table.py      (half an hour on 2 cores)
    python benchmarks/event_noise.py after_reset > hesim_render/specs/noise_after_reset_table.py      (9 minutes)

A pixel of unit noise with thresholds a and b compares with the level at the end of its last dead time. The noise is
white noise through two equal poles that are -3 dB at 1/period together, exact at 16 nodes a period and linear between
them, its amplitude scaled so that the time average of its variance is 1: the law of the simulator, written out again.
Each entry is the mean over the last two thirds of 3000 periods, from at least 6000 events or 16384 pixels. With equal
thresholds and a dead time below 0.1 periods the level wanders slowly, and longer runs differ by up to 40 %.

The second table has the rates of the periods before, over that mean. In the beginning each pixel compares with a random
level, as after an event of the leak.

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
#: The entries of the second table: lower threshold and pixels, difference of the thresholds, dead time; and its ages in
#: periods, the first of which are of more pixels.
AFTER_LOWER, AFTER_PIXELS = (1.0, 2.0, 3.0, 3.75, 4.5, 5.25), (512, 1024, 2048, 4096, 8192, 16384)
AFTER_DIFFERENCE = (0.0, 0.1, 0.25, 0.5, 0.8, 1.8, 3.6, 5.0, 7.5)
AFTER_DEAD_PERIODS = (0.01, 0.03, 0.055, 0.1, 0.3, 1.0)
AGE, EARLY_AGES, MORE_PIXELS = (0, 1, 3, 10, 30, 100, 300, 1000), 5, 8
#: Smallest threshold: larger differences of low thresholds are cut to it.
LEAST = 0.4


def simulate(entries: list[tuple[float, float, float]], pixels: int, seed: int, periods: tuple[int, ...]) -> np.ndarray:
    """Events of `pixels` pixels of each (a, b, dead time in periods) from each of the periods to the next one."""
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
    state = (zero, level, speed, types.Float(level), dr.full(types.Float, -1.0, len(each)), zero, generator)
    counts = []
    for period in periods:
        last = dr.opaque(types.UInt32, NODES * period)
        state = dr.while_loop(state, lambda number, *_, last=last: number < last, node, label="noise")
        counts.append(np.array(state[5]).reshape(len(entries), pixels).sum(axis=1))
    return np.diff(counts, axis=0).T


def thresholds_of(mean: float, difference: float) -> tuple[float, float]:
    """a, b of a mean and a difference."""
    half = min(difference / 2, mean - LEAST)
    return mean - half, mean + half


def row(mean: float, dead: float) -> list[float]:
    """Rates of all differences of the thresholds."""
    entries = [(*thresholds_of(mean, difference), dead) for difference in DIFFERENCE]
    span = SPAN_NO_DEAD_TIME if dead == NO_DEAD_TIME else SPAN
    rates = np.zeros(len(entries))
    left, pixels, seed = list(range(len(entries))), 256, round(1000 * mean + 100 * abs(dead))
    while left and pixels <= MOST_PIXELS:
        events = simulate([entries[k] for k in left], pixels, seed, span)[:, 0]
        rates[left] = events / (pixels * (span[1] - span[0]))
        left = [k for k, count in zip(left, events, strict=True) if count < ENOUGH]
        pixels, seed = 4 * pixels, seed + 7919
    return rates.tolist()


def after_reset(lower: float, pixels: int) -> np.ndarray:
    """Rates of all ages over the mean of `SPAN`, [difference, dead time, age]."""
    entries = [(lower, lower + d, dead) for d in AFTER_DIFFERENCE for dead in AFTER_DEAD_PERIODS]
    more, seed = MORE_PIXELS * pixels, round(1000 * lower)
    early = simulate(entries, more, seed, AGE[: EARLY_AGES + 1]) / more
    late = simulate(entries, pixels, seed + 7919, (*AGE[EARLY_AGES:], SPAN[1])) / pixels
    rates = np.concatenate([early, late], axis=1) / np.diff((*AGE, SPAN[1]))
    rates = rates.reshape(len(AFTER_DIFFERENCE), len(AFTER_DEAD_PERIODS), -1)
    # the first table ends at the difference of 3.6
    return rates / rates[np.minimum(np.arange(len(rates)), AFTER_DIFFERENCE.index(DIFFERENCE[-1])), :, -1:]


def main_after_reset() -> None:
    """Print the module of the second table."""
    print('"""Noise events after a reset to a random level; made by ``benchmarks/event_noise.py``."""\n')
    print("#: Lower threshold, and difference of both, over σ; dead time times the bandwidth of the noise.")
    print(f"LOWER = {AFTER_LOWER}\nDIFFERENCE = {AFTER_DIFFERENCE}\nDEAD_PERIODS = {AFTER_DEAD_PERIODS}")
    print(f"#: Periods since the reset, begins of the spans; the last one ends with the 3000th.\nAGE = {AGE}")
    print(f"#: Events over those of the last span at a difference of at most {DIFFERENCE[-1]}, [lower threshold,")
    print("#: difference, dead time, age].\nAFTER_RESET = (")
    for lower, pixels in zip(AFTER_LOWER, AFTER_PIXELS, strict=True):
        print("    (")
        for block in after_reset(lower, pixels):
            lines = [f"            ({', '.join(f'{value:.3g}' for value in line)})," for line in block]
            print("\n".join(["        (", *lines, "        ),"]), flush=True)
        print("    ),")
    print(")")


def main() -> None:
    """Print the module of the first table."""
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
    main_after_reset() if sys.argv[1:] == ["after_reset"] else main()

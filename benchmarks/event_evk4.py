"""Background of event pixels against the published model of a real EVK4: counts in 5 s from 0.1 to 200 lx.

    python benchmarks/event_evk4.py

Root, Mujo and Xu [root2026] fitted a probabilistic model to events of still images. Its figures are
stated; its formula is read here as: in each microsecond a pixel compares two Poisson counts N₀, N₁ of mean λ, and fires
ON where ln((N₁ + Θ)/(N₀ + Θ)) ≥ B, OFF where it is ≤ −B, with Θ = c₁ + c₂·√λ + c₃·λ of each polarity; a floor is added.
The threshold, its spread and the dead time of our pixel are theirs. What theirs does not state for a pixel that
remembers the level of its last event, five figures, is fitted at every second light; the other lights are predicted.
"""

import numpy as np
from scipy import optimize, stats

from hesim_render.pixels.evs.noise_rates import noise_rates_hz

#: Threshold, its standard deviation, dead time (s), photo-electrons per lux and comparison, seconds.
THRESHOLD, SPREAD, DEAD_S, PER_LUX, SECONDS = 0.15, 0.0065, 79e-6, 4.5, 5.0
LEAK = {1: (18.9, 35.5, 0.44), -1: (16.4, 37.4, 0.068)}
FLOOR_PER_US = {1: 9.6e-9, -1: 3.2e-8}
LUX = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0])
FITTED = slice(None, None, 2)
FACTOR = 1.5


def published(lux, polarity):
    """Mean counts of a pixel in 5 s."""
    mean = PER_LUX * lux
    first, root, line = LEAK[polarity]
    offset = first + root * np.sqrt(mean) + line * mean
    before = np.arange(int(mean + 12 * np.sqrt(mean) + 60))
    weight = stats.poisson.pmf(before, mean)
    chance = 0.0
    for z in np.linspace(-3, 3, 61):
        threshold = THRESHOLD + SPREAD * z
        goal = np.exp(polarity * threshold) * (before + offset) - offset
        if polarity > 0:
            fires = stats.poisson.sf(np.ceil(goal - 1e-9) - 1, mean)
        else:
            fires = stats.poisson.cdf(np.floor(goal + 1e-9), mean)
        chance += stats.norm.pdf(z) * 0.1 * float(weight @ fires)
    per_us = chance + FLOOR_PER_US[polarity]
    return SECONDS * 1e6 * per_us / (1 + DEAD_S * 1e6 * per_us)


def ours(lux, values):
    """Mean counts of a pixel in 5 s, ON and OFF: σ² = B/(L + L₀)·min(f/f_n, 1), corner f = g·(L + L₀)."""
    shot, dark_lux, noise_hz, per_lux_hz, ratio = np.exp(values)
    corner_hz = per_lux_hz * (lux + dark_lux)
    sigma = np.sqrt(shot / (lux + dark_lux) * min(corner_hz / noise_hz, 1.0))
    thetas = THRESHOLD / np.sqrt(ratio), THRESHOLD * np.sqrt(ratio)
    leak_hz = 1e6 * FLOOR_PER_US[1]
    on, off = noise_rates_hz(thetas, SPREAD / THRESHOLD, sigma, min(corner_hz, noise_hz), DEAD_S, leak_hz)
    return SECONDS * np.array([on + leak_hz, off])


def main():
    wanted = np.array([[published(lux, sign) for sign in (1, -1)] for lux in LUX])

    def rest(values):
        found = np.array([ours(lux, values) for lux in LUX[FITTED]])
        return np.log((found + 1e-3) / (wanted[FITTED] + 1e-3)).ravel()

    low, high = np.log([1e-4, 1e-3, 1.0, 1e-2, 0.8]), np.log([0.1, 3.0, 3e3, 1e3, 1.25])
    starts = [
        np.log([shot, 0.3, noise_hz, noise_hz / knee, 1.0])
        for shot in (0.003, 0.01)
        for noise_hz in (10.0, 100.0, 1000.0)
        for knee in (1.0, 5.0)
    ]
    fits = [optimize.least_squares(rest, start, bounds=(low, high), loss="soft_l1") for start in starts]
    best = min(fits, key=lambda one: one.cost)
    names = ("B, lx", "dark light, lx", "bandwidth of the noise, Hz", "corner, Hz/lx", "θ₋/θ₊")
    print(", ".join(f"{name} {value:.4g}" for name, value in zip(names, np.exp(best.x), strict=True)))
    print("lx: published ON, OFF; ours ON, OFF; ours over published")
    within = []
    for k, lux in enumerate(LUX):
        found = ours(lux, best.x)
        ratio = found / wanted[k]
        within.append(np.abs(np.log(np.maximum(ratio, 1e-9))) <= np.log(FACTOR))
        role = "fitted" if k % 2 == 0 else "predicted"
        marks = ", ".join(f"{one:.2f}{'' if good else ' !'}" for one, good in zip(ratio, within[-1], strict=True))
        print(f"{lux:g} ({role}): {wanted[k].round(3)}; {found.round(3)}; {marks}")
    within = np.array(within)
    for name, part in (("fitted", within[::2]), ("predicted", within[1::2])):
        print(f"{name}: within {FACTOR} at {part[:, 0].sum()} (ON) and {part[:, 1].sum()} (OFF) of {len(part)} lights")


if __name__ == "__main__":
    main()

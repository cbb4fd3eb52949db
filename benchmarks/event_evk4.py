"""Background of event pixels against the published model of a real EVK4: counts in 5 s from 0.1 to 200 lx.

    python benchmarks/event_evk4.py

Root, Mujo and Xu [root2026] fitted a probabilistic model to events of still images, without pixels that they had listed
as hot. As in their code, in each microsecond a pixel compares two Poisson counts N₀, N₁ of mean λ, and fires ON where
ln((N₁ + Θ)/(N₀ + Θ)) ≥ B, OFF where it is ≤ −B, with Θ = c₁ + c₂·√λ + c₃·λ of each polarity; a floor is added. They
take a saddle-point approximation of these chances, which is within 6 % of the sums here (14 % for OFF at 0.1 lx).

The threshold, its spread, the dead time and both floors of our pixel are theirs. What theirs does not state for a pixel
that remembers the level of its last event, five figures, is fitted: at all lights, and at every second one, where the
other half of the lights is predicted. The corner comes to its limit gradually; in one fit it ends abruptly. The last
fit takes the limit from the data sheet. Each fit prints the photo-electrons whose shot noise its noise would be.
"""

import numpy as np
from scipy import optimize, stats

from hesim_render.pixels.evs.formulas import POLE_HZ, in_series
from hesim_render.pixels.evs.noise_rates import noise_rates_hz, rate_table
from hesim_render.sensor.reading import read_sensor

#: Threshold, its standard deviation, dead time (s), photo-electrons per lux and comparison, seconds.
THRESHOLD, SPREAD, DEAD_S, PER_LUX, SECONDS = 0.15, 0.0065, 79e-6, 4.5, 5.0
LEAK = {1: (18.9, 35.5, 0.44), -1: (16.4, 37.4, 0.068)}
FLOOR_PER_US = {1: 9.6e-9, -1: 3.2e-8}
FLOOR_HZ = np.array([1e6 * FLOOR_PER_US[sign] for sign in (1, -1)])
LUX = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0])
EVERY, FIRST, SECOND = slice(None), slice(None, None, 2), slice(1, None, 2)
FACTOR = 1.5
#: The table of noise rates ends at this bandwidth.
MOST_HZ = rate_table().dead_periods[-1] / DEAD_S
NAMES = ("B, lx", "dark light, lx", "limit of the corner, Hz", "corner, Hz/lx", "θ₋/θ₊")


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


def ours(lux, values, gradual=True):
    """Mean counts of a pixel in 5 s, ON and OFF: σ² = B/(L + L₀)·f/f_n, with f of the line g·(L + L₀) and its limit."""
    shot, dark_lux, noise_hz, per_lux_hz, ratio = np.exp(values)
    line_hz = per_lux_hz * (lux + dark_lux)
    corner_hz = in_series(line_hz, noise_hz) if gradual else min(line_hz, noise_hz)
    sigma = np.sqrt(shot / (lux + dark_lux) * corner_hz / noise_hz)
    thetas = THRESHOLD / np.sqrt(ratio), THRESHOLD * np.sqrt(ratio)
    found = noise_rates_hz(thetas, SPREAD / THRESHOLD, sigma, corner_hz, DEAD_S, FLOOR_HZ.sum())
    return SECONDS * (np.array(found) + FLOOR_HZ)


def fitted(wanted, lights, gradual, limit_hz=None):
    """The five figures that fit the counts at some lights best, as logarithms; four where the limit is given."""

    def rest(values):
        return np.log([ours(lux, values, gradual) for lux in LUX[lights]]).ravel() - np.log(wanted[lights]).ravel()

    low, high = np.log([1e-4, 1e-3, 1.0, 1e-2, 0.6]), np.log([1.0, 3.0, MOST_HZ, 1e4, 1.6])
    starts = [
        np.log([(THRESHOLD / 3.5) ** 2 * (2 + knee), 0.3, noise_hz, noise_hz / knee, 0.85])
        for noise_hz in (3.0, 30.0, 300.0, 3000.0, 20000.0)
        for knee in (1.0, 10.0, 50.0, 200.0)
    ]
    if limit_hz:
        low[2], high[2] = np.log(limit_hz) - 1e-5, np.log(limit_hz) + 1e-5
    fits = [
        optimize.least_squares(rest, np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high), max_nfev=40)
        for start in starts
    ]
    return min(fits, key=lambda one: one.cost).x


def main():
    wanted = np.array([[published(lux, sign) for sign in (1, -1)] for lux in LUX])
    sheet_hz = read_sensor("imx636").evs.photoreceptor.cutoff_hz
    for title, lights, gradual, limit_hz in (
        ("all lights fitted", EVERY, True, None), ("the first and every second fitted", FIRST, True, None),
        ("the second and every second fitted", SECOND, True, None),
        ("all fitted, the corner ends abruptly", EVERY, False, None),
        ("all fitted, limit of the data sheet", EVERY, True, sheet_hz),
    ):  # fmt: skip
        best = fitted(wanted, lights, gradual, limit_hz)
        print(f"\n{title}: " + ", ".join(f"{n} {v:.4g}" for n, v in zip(NAMES, np.exp(best), strict=True)))
        # σ² of two equal poles behind shot noise is (π/2)·f·POLE_HZ over the electrons per second
        electrons = np.pi / 2 * POLE_HZ * np.exp(best[2] - best[0])
        print(f"noise as the shot noise of {electrons:.3g} electrons/(s lx)")
        print("lx: published ON, OFF; ours ON, OFF; ours over published")
        found = np.array([ours(lux, best, gradual) for lux in LUX])
        ratio, used = found / wanted, np.isin(np.arange(LUX.size), np.arange(LUX.size)[lights])
        within = np.abs(np.log(ratio)) <= np.log(FACTOR)
        for k, lux in enumerate(LUX):
            marks = ", ".join(f"{r:.2f}{'' if good else ' !'}" for r, good in zip(ratio[k], within[k], strict=True))
            print(
                f"{lux:g} ({'fitted' if used[k] else 'predicted'}): {wanted[k].round(3)}; {found[k].round(3)}; {marks}"
            )
        for name, part in (("fitted", used), ("predicted", ~used)):
            if part.any():
                on, off = within[part].sum(axis=0)
                worst = np.exp(np.abs(np.log(ratio[part])).max(axis=0))
                print(
                    f"{name}: within {FACTOR} at {on} (ON) and {off} (OFF) of {part.sum()} lights; farthest off by "
                    f"{worst[0]:.2f} and {worst[1]:.2f}"
                )


if __name__ == "__main__":
    main()

"""Recordings of event pixels on a bench, written in NumPy alone: each pixel answers a step by a law of its own.

Nothing of the package's simulator is used. A bench is a folder with ``bench.yaml`` and ``.npz`` files.
"""

import numpy as np
import yaml
from scipy.stats import norm

from hesim_render.pixels.evs.events import EVENT_DTYPE
from tests.support.slow_pixels import events_of
from tests.support.still_pixels import _events as in_order

SHAPE = (21, 27)
PIXELS = SHAPE[0] * SHAPE[1]
HALF_US = 5000
#: Light of the S-curve, lx.
LUX = 730.0


def _pixel(events):
    return events["y"].astype(int) * SHAPE[1] + events["x"]


def none():
    return [(np.empty(0, int), np.empty(0, int), np.empty(0, int))]


class Pixels:
    """A sensor of its own for each seed, and its bench."""

    def __init__(self, seed):
        rng = self.rng = np.random.default_rng(seed)
        self.slow_rng = np.random.default_rng((seed, 1))
        theta = rng.uniform(0.12, 0.3)
        self.theta = np.array([theta, theta * rng.uniform(0.9, 1.1)])
        self.spread, self.noise = rng.uniform(0.06, 0.15), rng.uniform(0.05, 0.12) * theta
        self.chance = rng.uniform(0.004, 0.03)
        self.own = self.theta[:, None] * (1 + self.spread * rng.standard_normal((2, PIXELS)))
        self.latency_us, self.jitter_us = rng.uniform(200, 900), rng.uniform(15, 70)
        self.pixel_us = self.latency_us * (1 + 0.08 * rng.standard_normal(PIXELS))
        self.background_hz = rng.uniform(0.5, 3.0, 2)
        self.doubling_c = rng.uniform(6.0, 14.0)
        # share of steps of 2θ that are found: Φ(a·ln(L/L₀))
        self.slope, self.least_lux = rng.uniform(0.7, 1.4), rng.uniform(0.3, 0.8)
        self.corner_hz, self.steep = rng.uniform(90.0, 250.0), rng.uniform(0.7, 1.5)
        self.dead = rng.choice(PIXELS, 4, replace=False)
        self.files, self.content = {}, {
            "sensor": "made in NumPy", "rows": SHAPE[0], "cols": SHAPE[1], "steady": [], "steps": [], "modulation": [],
        }  # fmt: skip

    @property
    def truth(self):
        """By figure and polarity; of the whole population of such pixels."""
        on, off = self.theta
        z = norm.ppf(0.9)
        # mean of 1/θᵢ over pixels
        harmonic = 1 / (1 + self.spread**2 + 3 * self.spread**4)
        return {
            ("threshold_by_counts", "ON"): on * harmonic, ("threshold_by_counts", "OFF"): off * harmonic,
            ("threshold", "ON"): on, ("threshold", "OFF"): off,
            ("threshold_spread_percent", "ON"): 100 * self.spread,
            ("threshold_spread_percent", "OFF"): 100 * self.spread,
            ("pixel_noise", "ON"): self.noise, ("pixel_noise", "OFF"): self.noise,
            ("contrast_sensitivity", "ON"): 100 * np.expm1(on), ("contrast_sensitivity", "OFF"): -100 * np.expm1(-off),
            ("latency", "ON"): self.latency_us, ("latency", "OFF"): self.latency_us,
            ("jitter", "ON"): self.jitter_us, ("jitter", "OFF"): self.jitter_us,
            ("least_light", "ON"): self.least_lux * np.exp(z / self.slope),
            ("least_light", "OFF"): self.least_lux * np.exp(z / self.slope),
            ("background", "ON"): self.background_hz[0], ("background", "OFF"): self.background_hz[1],
            ("doubling", "ON"): self.doubling_c, ("doubling", "OFF"): self.doubling_c,
            ("bandwidth", "ON"): self.corner_hz * np.sqrt(2) ** (1 / self.steep),
        }  # fmt: skip

    def alive(self, answered):
        answered[..., self.dead] = False
        return answered

    def step_file(self, lux, size, periods, chance_of, name):
        """Steps up and down; `chance_of(polarity)` is the chance of an answer of each pixel."""
        found, rng = none(), self.rng
        for k in range(2 * periods):
            answered = self.alive(rng.random(PIXELS) < chance_of(k % 2))
            pixel = np.flatnonzero(answered)
            delay = self.pixel_us[pixel] + self.jitter_us * rng.standard_normal(pixel.size)
            jump_us = 1000 + k * HALF_US
            time_us, sign = np.ceil(jump_us + np.maximum(delay, 1)).astype(int), 1 - 2 * (k % 2)
            found.append((time_us, pixel, np.full(pixel.size, sign)))
            again = pixel[rng.random(pixel.size) < 0.3]  # a second event does not count, nor one of the other polarity
            for late_us, turn in ((3, sign), (HALF_US - 3, -sign)):
                found.append((np.full(again.size, jump_us + HALF_US - late_us), again, np.full(again.size, turn)))
        self.files[name] = in_order(found, SHAPE[1])
        self.content["steps"].append({
            "file": name, "lux": lux, "contrast": float(np.expm1(size)), "begin_us": 1000, "period_us": 2 * HALF_US,
            "reset": True, "interval_us": [0, 1000 + 2 * periods * HALF_US],
        })  # fmt: skip

    def steady_file(self, lux, celsius, rate_hz, seconds, name):
        found = none()
        for sign, rate in zip((1, -1), rate_hz, strict=True):
            count = self.rng.poisson(rate * seconds, PIXELS)
            pixel = np.repeat(np.arange(PIXELS), count)
            found.append((self.rng.integers(0, round(seconds * 1e6), pixel.size), pixel, np.full(pixel.size, sign)))
        self.files[name] = in_order(found, SHAPE[1])
        self.content["steady"].append({
            "file": name, "lux": lux, "temperature_c": celsius, "interval_us": [0, round(seconds * 1e6)],
        })  # fmt: skip

    def s_curves(self):
        for k, part in enumerate((0.05, 0.6, 0.8, 0.9, 1.0, 1.1, 1.25, 1.6)):
            size = part * self.theta.mean()

            def chance_of(polarity, size=size):
                return self.chance + (1 - self.chance) * norm.cdf((size - self.own[polarity]) / self.noise)

            self.step_file(LUX, size, 6, chance_of, f"s{k}.npz")
        self.step_file(LUX, 2.4 * self.theta.mean(), 6, lambda polarity: 1.0, "all.npz")

    def lights(self):
        """Steps of 2θ, and steady light whose events are as frequent as those that answer by chance."""
        for k, lux in enumerate((0.2, 0.6, 1.5, 4.0, 70.0)):
            chance = 1 - np.exp(-self.background_hz * HALF_US * 1e-6)
            share = norm.cdf(self.slope * np.log(lux / self.least_lux))
            self.step_file(
                lux, 2 * self.theta.mean(), 8, lambda polarity, s=share, q=chance: q[polarity] + (1 - q[polarity]) * s,
                f"two{k}.npz",
            )  # fmt: skip
            self.steady_file(lux, 25.0, self.background_hz, 1.0, f"steady{k}.npz")

    def temperatures(self):
        for k, celsius in enumerate((15.0, 40.0)):
            factor = 2 ** ((celsius - 25.0) / self.doubling_c)
            self.steady_file(9.0, celsius, self.background_hz * factor, 3.0, f"warm{k}.npz")

    def modulations(self):
        """Cycles are answered with the chance Φ(ln(A/A_f)/w), each pixel by its own A_f; A_f rises from a corner on."""
        own = self.theta[0] * np.exp(0.1 * self.rng.standard_normal(PIXELS))
        for k, hz in enumerate(self.corner_hz * np.array([0.25, 0.5, 1.0, 4.0])):
            half = own * max(hz / self.corner_hz, 1.0) ** self.steep
            for j, swing in enumerate(self.theta[0] * np.array([0.5, 0.8, 1.25, 2.0, 3.2, 5.0, 8.0, 12.5])):
                found, period_us = none(), 1e6 / hz
                for cycle in range(12):
                    seen = self.alive(self.rng.random(PIXELS) < norm.cdf(np.log(swing / half) / 0.4))
                    pixel = np.flatnonzero(seen)
                    time_us = np.floor((cycle + 0.1 + 0.3 * self.rng.random(pixel.size)) * period_us).astype(int)
                    found.append((time_us, pixel, np.ones(pixel.size, int)))
                name = f"sine{k}-{j}.npz"
                self.files[name] = in_order(found, SHAPE[1])
                self.content["modulation"].append({
                    "file": name, "lux": LUX, "hz": float(hz), "depth": float(np.tanh(swing / 2)),
                    "interval_us": [0, int(12 * period_us)],
                })  # fmt: skip

    def counts(self):
        """Two large swings of slow light, which no reset precedes."""
        for k, swing in enumerate(self.theta.mean() * np.array([8.0, 15.0])):
            t_us = np.arange(0, 1_200_000, 400) + 200
            log_light = np.log1p(np.tanh(swing / 2) * np.sin(2e-6 * np.pi * 5.0 * t_us))
            name = f"slow{k}.npz"
            self.files[name] = events_of(
                log_light, 400, self.own, noise=self.noise, background_hz=1.0, cols=SHAPE[1], rng=self.slow_rng
            )
            self.files[name] = self.files[name][~np.isin(_pixel(self.files[name]), self.dead)]
            self.content["modulation"].append({
                "file": name, "lux": 3.0, "hz": 5.0, "depth": float(np.tanh(swing / 2)),
                "interval_us": [0, 1_200_000],
            })  # fmt: skip

    def everything(self):
        self.counts()
        self.s_curves()
        self.lights()
        self.temperatures()
        self.modulations()
        return self

    def write(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, events in self.files.items():
            np.savez(folder / name, t=events["t_us"], x=events["x"], y=events["y"], p=events["polarity"] > 0)
        content = {key: value for key, value in self.content.items() if value}
        (folder / "bench.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        return folder


assert EVENT_DTYPE.names == ("t_us", "x", "y", "polarity")

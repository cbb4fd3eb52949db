"""What calibrated noise buys: the same small network, trained on kinds of noise, tested on a sensor with other physics.

Textured discs move before a textured wall at rest, in closed form, so that the light has no error and no frame rate.
The network learns to tell signal from noise events

- with noise of the same rate at all pixels, at all times, of both polarities (uniform);
- with the noise model of the sensor: temporal noise, mismatch, hot pixels (calibrated).

It is tested on a sensor that neither has seen (`SENSORS`). Training and test share no texture and no motion.
Each repetition has textures, motions, noise and first weights of its own; the differences within a repetition are
averaged, and their standard error is that of the repetitions::

    python benchmarks/learned_denoising.py [--repetitions 6] [--duration 0.2] [--clips 8] [--sensors ...]

needs the extra `torch`.
"""

import argparse
import time

import numpy as np
from learned_filter import LearnedFilter, area_under_curve, uniform_noise

import hesim_render as hr
from hesim_render.benchmark.event_filters import FILTERS
from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models
from hesim_render.core import backend
from hesim_render.pixels.evs.events import EventLabels, Label, no_events
from hesim_render.sources.still import WindowByWindow
from hesim_render.sources.video.flux import VideoFlux
from hesim_render.sources.video.options import VideoOptions

SHAPE = (48, 64)
#: Hot pixels of the known sensors, and defects of those of the test: more of them, of other rates, and another kind.
HOT = {"hot_share": 0.002, "hot_rate_hz": 20.0, "hot_rate_spread_decades": 0.3}
DEFECTS = {
    "hot_share": 0.003, "hot_rate_hz": 40.0, "hot_rate_spread_decades": 0.4, "flickering_share": 0.003,
    "flickering_rate_hz": 50.0, "flickering_firing_s": 0.05, "flickering_quiet_s": 0.2,
}  # fmt: skip
#: A sensor with 400 comparisons a second, that of benchmarks/specs/full.yaml.
TICKS = {
    "evs.tick_us": 2500, "evs.window_us": 2500, "evs.contrast_threshold_on": 0.3, "evs.contrast_threshold_off": 0.3,
    "evs.threshold_mismatch_rel": 0.03,
    "evs.coefficients": [{"beta1": 1.0, "beta2": 40.0, "beta3": 0.894427, "beta4": 2.0, "beta5": 0.0}],
}  # fmt: skip
#: Of each sensor: changes that make the known one, those that make the one of the test, and lux on white.
SENSORS = {
    # a photoreceptor that slows with the light, more mismatch, a dead time, defects
    "davis346": (
        {"evs.leak_rate_hz": 0.3, "evs.defects": HOT},
        {
            "evs.leak_rate_hz": 0.3, "evs.threshold_mismatch_rel": 0.2, "evs.refractory_period_us": 500,
            "evs.photoreceptor": {"cutoff_hz": 300.0, "signal_dn": 20.0, "min_cutoff_hz": 20.0},
            "evs.defects": DEFECTS,
        },
        (5.0, 50.0),
    ),
    # thresholds that differ more, twice the noise that does not depend on light, defects
    "reference-mono": (
        TICKS | {"evs.defects": HOT},
        TICKS | {
            "evs.threshold_mismatch_rel": 0.1, "evs.defects": DEFECTS,
            "evs.coefficients": [{"beta1": 1.0, "beta2": 40.0, "beta3": 0.894427, "beta4": 4.0, "beta5": 0.0}],
        },
        (50.0, 150.0, 500.0),
    ),
}  # fmt: skip
#: Clips of a test.
TESTS = 2
TRAININGS = ("uniform", "calibrated")


class Texture:
    """A random texture of mean 0 and variance 1 in closed form: plane waves of all directions, with power of 1/f².

    Parameters
    ----------
    rng : random numbers.
    """

    def __init__(self, rng):
        length_px = 4 * 16 ** rng.random(24)  # 4 to 64 px
        angle = 2 * np.pi * rng.random(24)
        self.wave = 2 * np.pi / length_px * np.array([np.cos(angle), np.sin(angle)])
        self.phase = 2 * np.pi * rng.random(24)
        amplitude = np.sqrt(length_px)  # on a logarithmic axis of lengths
        self.amplitude = amplitude * np.sqrt(2 / np.sum(amplitude**2))

    def at(self, x, y):
        phase = np.multiply.outer(x, self.wave[0]) + np.multiply.outer(y, self.wave[1]) + self.phase
        return np.cos(phase) @ self.amplitude


class MovingDiscs(WindowByWindow):
    """Three textured discs that cross the view and turn, before a textured wall at rest; implements `FluxSource`.

    Parameters
    ----------
    white_e_per_s : [pixel], flux of a white surface.
    seed : of textures, sizes and motions.
    duration_s : time in which the discs cross.
    """

    is_static = False

    def __init__(self, white_e_per_s, seed, duration_s):
        rng = np.random.default_rng(seed)
        self._white, self._duration_s = white_e_per_s, duration_s
        y, x = np.indices(SHAPE)
        self._x, self._y = x.ravel() - SHAPE[1] / 2 + 0.5, y.ravel() - SHAPE[0] / 2 + 0.5
        self._wall = Texture(rng).at(self._x, self._y)
        self._discs = []
        for _ in range(3):
            angle, speed = 2 * np.pi * rng.random(), 30 * 10 ** rng.uniform(0, 1)  # px/s
            velocity = speed * np.array([np.cos(angle), np.sin(angle)])
            self._discs.append({
                "texture": Texture(rng), "radius": rng.uniform(6, 12), "turn": rng.uniform(-10, 10),
                "middle": rng.uniform(-1, 1, 2) * (24, 16), "velocity": velocity,
                "level": rng.uniform(-1, 1),
            })  # fmt: skip

    def slice_edges_us(self, begin_us, end_us):
        return np.empty(0)

    def sample_times_us(self, begin_us, end_us):
        times = np.arange(begin_us // 1000 + 1, -(-end_us // 1000)) * 1000.0
        return times[(times > begin_us) & (times < end_us)]

    def mean_flux(self, pixel, begin_us, end_us):
        """The flux in the middle of the interval, which is short."""
        t = 0.5e-6 * (float(np.min(begin_us)) + float(np.max(end_us)))
        value = self._wall.copy()
        for disc in self._discs:
            middle = disc["middle"] + disc["velocity"] * (t - self._duration_s / 2)
            x, y = self._x - middle[0], self._y - middle[1]
            distance = np.hypot(x, y)
            near = np.flatnonzero(distance < disc["radius"] + 4)
            x, y, turn = x[near], y[near], disc["turn"] * t
            own = disc["texture"].at(np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x)
            inside = 1 / (1 + np.exp(4 * (distance[near] - disc["radius"])))  # an edge of about a pixel
            value[near] += inside * (own + disc["level"] - value[near])
        flux = backend.jit().Float((self._white * np.clip(0.18 * np.exp(0.8 * value), 0.005, 1))[pixel])
        return flux, flux


def clip(name, changes, seed, duration_s, lux):
    """Events, labels, noise-free events and length of a clip, µs. White has `lux` lux; each clip has its own device."""
    sensor = hr.load_sensor(name, changes | {"device_seed": seed}).crop(SHAPE[1], SHAPE[0])
    every = np.arange(SHAPE[0] * SHAPE[1], dtype=np.uint32)
    white = np.ones((2, *SHAPE), np.float32)
    lamp = VideoFlux(white, sensor, VideoOptions.of(fps=100, transfer="linear", white_lux=lux))
    flux = MovingDiscs(np.array(lamp.mean_flux(every, 0.0, 1.0)[0], np.float64), seed, duration_s)
    lamp.close()
    duration_us = round(duration_s * 1e6)
    capture = Capture(flux, sensor, None, noise_models(sensor)[1], duration_us, seed, labels=True)
    events = np.concatenate([no_events(), *(item for item in capture.run() if isinstance(item, np.ndarray))])
    labels = EventLabels.of([capture.labeller.taken()])
    return events, np.isin(labels.label, [Label.SIGNAL, Label.MISMATCH]), labels.clean, duration_us


def repetition(name, lux, clips, duration_s, seed):
    """Areas under the curve by training, shares of the test's signal and noise that filters keep, and event counts."""
    known, other, _ = SENSORS[name]
    first = 1000 * seed
    seen = [clip(name, known, first + k, duration_s, lux) for k in range(clips)]
    tests = [clip(name, other, first + 500 + k, duration_s, lux) for k in range(TESTS)]
    # uniform noise has the number of noise events of the known sensor
    noise = sum(np.count_nonzero(~signal) for _, signal, *_ in seen)
    rate = noise / (SHAPE[0] * SHAPE[1] * duration_s * clips)
    rng = np.random.default_rng(first)
    streams = {
        "uniform": [(*uniform_noise(clean, SHAPE, rate, end, rng), SHAPE) for *_, clean, end in seen],
        "calibrated": [(events, signal, SHAPE) for events, signal, *_ in seen],
    }
    truth = np.concatenate([signal for _, signal, *_ in tests])
    areas = {}
    for training in TRAININGS:
        network = LearnedFilter(streams[training], seed)
        score = np.concatenate([network.score(events, SHAPE) for events, *_ in tests])
        areas[training] = area_under_curve(score, truth)
    kept = {}
    for filter_name, filtered in FILTERS.items():
        mask = np.concatenate([filtered(events, SHAPE) for events, *_ in tests])
        kept[filter_name] = float(mask[truth].mean()), float(mask[~truth].mean())
    counts = int(np.count_nonzero(truth)), int(np.count_nonzero(~truth))
    return areas, kept, counts


def run(name, lux, clips, duration_s, repetitions):
    """Areas [training, repetition], shares kept by other filters, and mean counts of signal and noise in the test."""
    backend.jit()
    found = [repetition(name, lux, clips, duration_s, seed) for seed in range(1, repetitions + 1)]
    areas = np.array([[areas[training] for areas, *_ in found] for training in TRAININGS])
    kept = {key: np.mean([k[key] for _, k, _ in found], axis=0) for key in FILTERS}
    return areas, kept, np.mean([counts for *_, counts in found], axis=0)


def with_error(values):
    """Mean and standard error of the repetitions."""
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return f"{np.mean(values):+.3f} ± {error:.3f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=0.2)
    parser.add_argument("--clips", type=int, default=8, help="of a training")
    parser.add_argument("--repetitions", type=int, default=6)
    parser.add_argument("--sensors", nargs="+", choices=list(SENSORS), default=list(SENSORS))
    given = parser.parse_args()
    begin = time.process_time()
    for name in given.sensors:
        for lux in SENSORS[name][2]:
            areas, kept, (signal, noise) = run(name, lux, given.clips, given.duration, given.repetitions)
            uniform, calibrated = areas
            print(f"{name}, {lux:g} lux: {signal:.0f} signal and {noise:.0f} noise events in the mean test")
            for training, values in zip(TRAININGS, areas, strict=True):
                print(f"  {training}: {with_error(values)} ({', '.join(f'{v:.3f}' for v in values)})")
            print(f"  calibrated - uniform: {with_error(calibrated - uniform)}")
            for key, (kept_signal, kept_noise) in kept.items():
                print(f"  {key}: keeps {100 * kept_signal:.0f} % of the signal, {100 * kept_noise:.0f} % of the noise")
            print(f"  {time.process_time() - begin:.0f} s of processor time so far", flush=True)


if __name__ == "__main__":
    main()

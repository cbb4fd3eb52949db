"""What calibrated noise buys: the same small network, trained on two kinds of noise, tested on a third kind of sensor.

Textures move in front of an asynchronous sensor of 64×48 pixels at a few lux. The network learns to tell signal from
noise events once with noise of the same rate at all pixels, at all times, of both polarities, and once with the noise
model of the sensor. It is tested on a sensor that neither has seen: its photoreceptor slows with the light and filters
the noise, its thresholds differ more, it has a dead time, and hot and flickering pixels. Training and test share no
texture and no motion::

    python benchmarks/learned_denoising.py [--duration 0.3] [--clips 3]

needs the extra `torch`.
"""

import argparse
import time

import numpy as np

import hesim_render as hr
from hesim_render.benchmark.event_filters import FILTERS
from hesim_render.benchmark.learned_filter import LearnedFilter, area_under_curve, uniform_noise
from hesim_render.capture.loop import Capture
from hesim_render.capture.noise_terms import noise_models
from hesim_render.core import backend
from hesim_render.pixels.evs.events import EventLabels, Label, no_events
from hesim_render.sources.video.flux import VideoFlux
from hesim_render.sources.video.options import VideoOptions

SHAPE, FPS = (48, 64), 250.0
#: The sensor of the noise model, and what the test's sensor has beyond it.
KNOWN = {"evs.leak_rate_hz": 0.3}
HELD_OUT = KNOWN | {
    "evs.threshold_mismatch_std": 0.2, "evs.refractory_period_us": 500,
    "evs.photoreceptor": {"cutoff_hz": 300.0, "signal_dn": 20.0, "min_cutoff_hz": 20.0, "filters_noise": True},
    "evs.defects": {
        "hot_share": 0.003, "hot_rate_hz": 30.0, "hot_rate_spread_decades": 0.4, "flickering_share": 0.003,
        "flickering_rate_hz": 50.0, "flickering_firing_s": 0.05, "flickering_quiet_s": 0.2,
    },
}  # fmt: skip


def pictures(seed, duration_s):
    """A texture with a spectrum of 1/f that moves and turns, [time, row, col], linear light of two decades."""
    rng = np.random.default_rng(seed)
    size = 512
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    wave[0, 0] = 1
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) / wave).real
    field = (field - field.mean()) / field.std()
    y, x = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2
    speed, angle = 15 * 10 ** rng.uniform(0, 1), rng.uniform(0, 2 * np.pi)
    made = []
    for t in np.arange(round(duration_s * FPS) + 2) / FPS:
        turn = 0.3 * np.sin(3 * t)
        col = np.cos(turn) * x - np.sin(turn) * y + speed * np.cos(angle) * t + size / 2
        row = np.sin(turn) * x + np.cos(turn) * y + speed * np.sin(angle) * t + size / 2
        i, j = np.floor(row).astype(int), np.floor(col).astype(int)
        a, b = row - i, col - j
        corners = [field[(i + k) % size, (j + m) % size] for k in (0, 1) for m in (0, 1)]
        value = (1 - a) * ((1 - b) * corners[0] + b * corners[1]) + a * ((1 - b) * corners[2] + b * corners[3])
        made.append(np.clip(0.1 * np.exp(1.1 * value), 0.003, 1))
    return np.stack(made).astype(np.float32)


def clip(seed, changes, duration_s, lux):
    """Events, labels, noise-free events and length of a clip, µs."""
    sensor = hr.load_sensor("davis346", changes).crop(SHAPE[1], SHAPE[0])
    options = VideoOptions.of(fps=FPS, transfer="linear", white_lux=lux, interpolation="linear")
    flux = VideoFlux(pictures(seed, duration_s), sensor, options)
    duration_us = round(duration_s * 1e6)
    capture = Capture(flux, sensor, None, noise_models(sensor)[1], duration_us, seed, labels=True)
    events = np.concatenate([no_events(), *(item for item in capture.run() if isinstance(item, np.ndarray))])
    flux.close()
    labels = EventLabels.of([capture.labeller.taken()])
    return events, np.isin(labels.label, [Label.SIGNAL, Label.MISMATCH]), labels.clean, duration_us


def run(clips, duration_s, lux, seeds=3):
    """Figures of each filter on the events of all clips of the test.

    Of a network, for each seed of its training: area under the curve, and the share of noise that it keeps together
    with 90 % of the signal. Of the other filters: shares of signal and of noise that they keep.
    """
    backend.jit()
    known = [clip(100 + k, KNOWN, duration_s, lux) for k in range(clips)]
    tests = [clip(200 + k, HELD_OUT, duration_s, lux) for k in range(clips)]
    pixels = SHAPE[0] * SHAPE[1]
    # both trainings have the same number of noise events: that of the sensor whose noise is known
    rate = sum(np.count_nonzero(~signal) for _, signal, *_ in known) / (pixels * duration_s * clips)
    rng = np.random.default_rng(1)
    streams = {
        "uniform noise": [(*uniform_noise(clean, SHAPE, rate, end, rng), SHAPE) for *_, clean, end in known],
        "calibrated noise": [(events, signal, SHAPE) for events, signal, *_ in known],
    }
    for name, part in (("training", known), ("test", tests)):
        counts = [f"{np.count_nonzero(s)} + {np.count_nonzero(~s)}" for _, s, *_ in part]
        print(f"{name}: signal + noise events {', '.join(counts)}")
    networks, filters = {}, {}
    truth = np.concatenate([signal for _, signal, *_ in tests])
    for name, given in streams.items():
        networks[name] = []
        for seed in range(seeds):
            network = LearnedFilter(given, seed)
            values = np.concatenate([network.score(events, SHAPE) for events, *_ in tests])
            kept = values >= np.quantile(values[truth], 0.1)
            networks[name].append((area_under_curve(values, truth), float(kept[~truth].mean())))
    for name, filtered in FILTERS.items():
        mask = np.concatenate([filtered(events, SHAPE) for events, *_ in tests])
        filters[name] = float(mask[truth].mean()), float(mask[~truth].mean())
    return networks, filters


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=0.3)
    parser.add_argument("--clips", type=int, default=3)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--lux", type=float, default=20.0)
    given = parser.parse_args()
    begin = time.process_time()
    networks, filters = run(given.clips, given.duration, given.lux, given.seeds)
    for name, values in networks.items():
        areas, kept = np.array(values).T
        limits = f"{areas.min():.3f} to {areas.max():.3f}"
        print(f"trained on {name}: area under the curve {areas.mean():.3f} ({limits}),")
        print(f"  with 90 % of the signal {100 * kept.mean():.0f} % of the noise")
    for name, (signal, noise) in filters.items():
        print(f"{name}: keeps {100 * signal:.0f} % of the signal, {100 * noise:.0f} % of the noise")
    print(f"{time.process_time() - begin:.0f} s of processor time")


if __name__ == "__main__":
    main()

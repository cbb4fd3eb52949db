"""What the default mode gives for a random scene, against the reference from elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from random_scenes import DURATION_US, RandomScene

from hesim_render.capture.loop import Capture
from hesim_render.capture.noise_terms import noise_models
from hesim_render.sources.flicker import flickering
from hesim_render.sources.render.audit.compare import Counted, compare_crossings, compare_ticks
from hesim_render.sources.render.change_driven.error_target import Noise
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.reference import WindowReference

QUALITY = 0.5
#: Samples in a row whose events are compared.
_MOST_WINDOWS = 40


@dataclass(frozen=True)
class Checked:
    """Values of some pixels in some windows, arrays [value], all in units of the pixels' own noise.

    Parameters
    ----------
    deviation : from the reference.
    stated : standard error that the default mode expects; 0 where it holds a value to be exact.
    reference_error : standard error of the reference.
    """

    deviation: np.ndarray
    stated: np.ndarray
    reference_error: np.ndarray


def event_flux(random: RandomScene, duration_us: int, quality: float = QUALITY):
    """Windows [w, 2], flux and expected error [w, n], of all event pixels in the default mode; and the capture."""
    sensor, spec = random.sensor, random.sensor.spec.evs

    def make(part, light):
        return ChangeDrivenFlux(part, sensor, quality, seed=random.seed, light=light)

    source = flickering(random.scene, make, spec.window_us)
    aps, evs = noise_models(source.sensor)
    capture = Capture(source, source.sensor, aps, evs, duration_us, random.seed)
    blocks = list(capture.event_blocks())
    windows = np.concatenate([np.stack([b.begin_us[b.wanted], b.end_us[b.wanted]], axis=1) for b in blocks])
    samples = list(source.flux_of_blocks(capture.event_pixels, blocks))
    flux = np.array([0.5 * (np.array(s.half_a, np.float64) + np.array(s.half_b)) for s in samples])
    error = np.array([s.error for s in samples], np.float64)
    return windows, flux, error, capture


def noise_unit(capture_pixels: np.ndarray, sensor, flux: np.ndarray) -> np.ndarray:
    """One standard deviation of the event pixels' noise, e⁻/s."""
    unit = Noise(sensor).of("events", sensor.layout.full_index.ravel()[capture_pixels])
    return unit(flux.astype(np.float32)).astype(np.float64)


def check(random: RandomScene, windows: int, pixels: int, duration_us: int = DURATION_US) -> Checked:
    """Random windows; in each, pixels drawn half at random and half among those that change."""
    rng = np.random.default_rng([77, random.seed])
    times, flux, error, capture = event_flux(random, duration_us)
    reference = WindowReference(random.scene, random.sensor)
    unit = noise_unit(capture.event_pixels, reference.sensor, flux)
    deviation, stated, own = [], [], []
    for window in np.sort(rng.choice(len(times), min(windows, len(times)), replace=False)):
        change = np.abs(flux - flux[window]).max(axis=0) / unit[window]
        busy = np.flatnonzero(change > QUALITY)
        chosen = rng.choice(flux.shape[1], min(pixels, flux.shape[1]), replace=False)
        if busy.size:
            chosen[: pixels // 2] = rng.choice(busy, chosen[: pixels // 2].size)
        chosen = np.unique(chosen)
        one = np.maximum(unit[window, chosen], 1e-9)
        found = reference.flux(times[window], capture.event_pixels[chosen], 0.2 * QUALITY * one, seed=random.seed)
        deviation.append((flux[window, chosen] - found.flux[0]) / one)
        stated.append(error[window, chosen] / one)
        own.append(found.stderr[0] / one)
    return Checked(*map(np.concatenate, (deviation, stated, own)))


def check_exposure(random: RandomScene, pixels: int, begin_us: float = 1000.0, end_us: float = 3000.0) -> Checked:
    """Pixels drawn at random, in one exposure. Stated is half the difference of both halves: right in mean square."""
    rng = np.random.default_rng([76, random.seed])
    window_us = random.sensor.spec.evs.window_us

    def make(part, light):
        return ChangeDrivenFlux(part, random.sensor, QUALITY, seed=random.seed, light=light)

    source = flickering(random.scene, make, window_us)
    every = np.arange(random.sensor.rows * random.sensor.cols, dtype=np.uint32)
    half_a, half_b = (np.array(half, np.float64) for half in source.mean_flux(every, begin_us, end_us))
    chosen = rng.choice(every.size, pixels, replace=False)
    flux, half = 0.5 * (half_a + half_b)[chosen], 0.5 * (half_a - half_b)[chosen]
    reference = WindowReference(random.scene, random.sensor)
    index = reference.sensor.layout.full_index.ravel()[chosen]
    unit = np.maximum(Noise(reference.sensor).of("any", index)(flux.astype(np.float32)).astype(np.float64), 1e-9)
    found = reference.flux([[begin_us, end_us]], chosen, 0.2 * QUALITY * unit, seed=random.seed)
    return Checked((flux - found.flux[0]) / unit, np.abs(half) / unit, found.stderr[0] / unit)


@dataclass(frozen=True)
class EventErrors:
    """Events of some pixels over a whole run, noise-free: of the default mode and of the reference.

    Parameters
    ----------
    counted : as `renderer.compare` counts them.
    off, values : of their samples, those off by more than three wanted errors, and all.
    """

    counted: Counted
    off: int
    values: int

    def against(self, audit: dict) -> Iterator[tuple[str, float, int, float]]:
        """Name, count, total and bound of each share that an audit bounds."""
        yield "off", self.off, self.values, audit["off_at_most"]
        for name, of in (("missed", "true"), ("extra", "found")):
            total = int(getattr(self.counted, of).sum())
            yield name, float(getattr(self.counted, name).sum()), total, audit[f"{name}_at_most"]


def event_errors(random: RandomScene, pixels: int, duration_us: int = DURATION_US) -> EventErrors:
    """Of pixels drawn among those that change most, half of them, and at random."""
    rng = np.random.default_rng([78, random.seed])
    times, flux, error, capture = event_flux(random, duration_us)
    reference = WindowReference(random.scene, random.sensor)
    sensor = reference.sensor
    unit = noise_unit(capture.event_pixels, sensor, flux)
    swing = np.ptp(flux, axis=0) / unit.max(axis=0)
    busy = np.flatnonzero(swing > QUALITY)
    chosen = rng.choice(flux.shape[1], pixels, replace=False)
    if busy.size:
        chosen[: pixels // 2] = rng.choice(busy, pixels // 2)
    chosen = np.unique(chosen)
    # of an asynchronous sensor's many samples a stretch is looked at
    first = int(rng.integers(max(1, len(times) - _MOST_WINDOWS + 1)))
    part = slice(first, first + _MOST_WINDOWS)
    own, unit = flux[part, chosen], np.maximum(unit[part, chosen], 1e-9)
    found = reference.flux(times[part], capture.event_pixels[chosen], 0.2 * QUALITY * unit, seed=random.seed)
    noise = sensor.evs
    levels = [noise.log_signal(values, chosen) for values in (own, found.flux, own + error[part, chosen])]
    shape = noise.layout.evs_shape
    maps = (noise.threshold_on_map, noise.threshold_off_map)
    thresholds = tuple(np.broadcast_to(theta, shape).ravel()[chosen].astype(np.float64) for theta in maps)
    arguments = levels[0], levels[1], levels[2] - levels[0], thresholds, np.ones(len(own), np.bool_)
    if noise.spec.reference == "previous_sample":
        counted = compare_ticks(*arguments)
    else:
        counted = compare_crossings(*arguments, 1 << 30)
    off = np.abs(own - found.flux) > 3 * QUALITY * unit
    return EventErrors(counted, int(off.sum()), off.size)

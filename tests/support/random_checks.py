"""What the default mode gives for a random scene, against the reference from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
from mitsuba_reference import WindowReference
from random_scenes import DURATION_US, RandomScene
from scipy import stats

import hesim_render as hr
from hesim_render.sources.render.audit.compare import Counted, compare_crossings, compare_ticks
from hesim_render.sources.render.audit.units import NotedFlux
from hesim_render.sources.render.change_driven.error_target import Noise
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.renderer import flickering

QUALITY = 0.5
#: Share of values off by more than three wanted errors that a run should have at most.
MOST_OFF = 0.01


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


def noise_unit(capture_pixels: np.ndarray, sensor, flux: np.ndarray) -> np.ndarray:
    """One standard deviation of the event pixels' noise, e⁻/s."""
    unit = Noise(sensor).of("events", sensor.layout.full_index.ravel()[capture_pixels])
    return unit(flux.astype(np.float32)).astype(np.float64)


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


class _Seen(NotedFlux):
    """A source that keeps what passes through it."""

    made: list[_Seen] = []

    def __init__(self, source, event_pixel, *rest) -> None:
        super().__init__(source, event_pixel, *rest)
        self.pixels, self.windows, self.flux, self.error = event_pixel, [], [], []
        #: Number of the window in which the block of each window begins.
        self.begins: list[int] = []
        _Seen.made.append(self)

    def flux_of_blocks(self, pixel, blocks):
        assert not self.windows and np.array_equal(pixel, self.pixels)

        def told():
            for block in blocks:
                # the first window of a block is the last one of the block before
                begin = len(self.windows) - (not block.wanted[0] and bool(self.windows))
                self.begins += [begin] * int(block.wanted.sum())
                self.windows += np.stack([block.begin_us, block.end_us], axis=1)[block.wanted].tolist()
                yield block

        for sample in super().flux_of_blocks(pixel, told()):
            self.flux.append(0.5 * (np.array(sample.half_a) + np.array(sample.half_b)))
            self.error.append(sample.error)
            yield sample


def judged_run(random: RandomScene, most_windows: int = 24) -> dict[str, Any]:
    """Simulate a random scene, and compare what the manifest says with the reference from elsewhere.

    Some pixels are looked at in a stretch of windows: half of them drawn at random, half among those that change.

    Returns
    -------
    Plain values: `mode` and `verdict` of the run. ``off``, ``missed`` and ``extra``: count, total, and the bound of the
    audit, which judges changes; values that are off are those of the pixels drawn at random. `values`: of all values,
    in noise units, where the reference is exact enough (`exact` of `all`): mean deviation, number off, and mean square
    over the errors.
    """
    _Seen.made.clear()
    with mock.patch("hesim_render.capture.scene_run.NotedFlux", _Seen):
        run = hr.simulate(
            random.scene, random.sensor, duration_s=DURATION_US * 1e-6, seed=random.seed, max_minutes=None
        )
    settings, (seen,) = run.manifest["settings"], _Seen.made
    audit = settings["render"]["audit"]
    rng, pixels = np.random.default_rng([78, random.seed]), 2 if random.is_asynchronous else 4
    first = int(rng.integers(max(1, len(seen.windows) - most_windows + 1)))
    part = slice(first, first + most_windows)
    flux, error = np.array(seen.flux, np.float64), np.array(seen.error, np.float64)
    reference = WindowReference(random.scene, random.sensor)
    unit = noise_unit(seen.pixels, reference.sensor, flux)
    busy = np.flatnonzero(np.ptp(flux, axis=0) / unit.max(axis=0) > QUALITY)
    chosen = rng.choice(flux.shape[1], pixels, replace=False)
    at_random = np.arange(pixels) >= pixels // 2
    if busy.size:
        chosen[: pixels // 2] = rng.choice(busy, pixels // 2)
    # the windows of the stretch, and those that their changes are counted from
    windows = np.arange(len(seen.windows))[part]
    earlier = np.array(seen.begins)[part] if random.is_asynchronous else np.maximum(windows - 1, 0)
    every, place = np.unique([windows, earlier], return_inverse=True)
    wanted = 0.2 * QUALITY * np.maximum(unit[every][:, chosen], 1e-9)
    looked = reference.flux([seen.windows[k] for k in every], seen.pixels[chosen], wanted, seed=random.seed)
    is_off = off_by_change(reference.sensor, chosen, flux[every][:, chosen], looked.flux, *place.reshape(2, -1))
    own, stated, unit = flux[part, chosen], error[part, chosen], np.maximum(unit[part, chosen], 1e-9)
    found = replace(looked, **{name: getattr(looked, name)[place.reshape(2, -1)[0]] for name in ("flux", "stderr")})
    counted = count_events(reference.sensor, chosen, own, found.flux, stated, found.stderr)
    deviation, exact = (own - found.flux) / unit, found.stderr <= 1.5 * 0.2 * QUALITY * unit
    square = (deviation**2 / ((stated**2 + found.stderr**2) / unit**2 + QUALITY**2))[exact]
    off = np.abs(deviation) > 3 * QUALITY
    events = audit["events"]
    counts = {"off": (int(is_off[:, at_random].sum()), int(is_off[:, at_random].size))}
    for name, of in (("missed", "true"), ("extra", "in_run")):
        counts[name] = float(getattr(counted, name).sum()), float(getattr(counted, of).sum())
    return {
        "seed": random.seed, "scene": random.text, "mode": settings["mode"], "verdict": audit["verdict"],
        **{name: [*both, events[f"{name}_at_most"]] for name, both in counts.items()},
        "values": {
            "all": int(exact.size), "exact": int(exact.sum()), "off": int((off & exact).sum()),
            "mean": float(deviation[exact].mean()) if exact.any() else 0.0,
            "mean_square": float(square.mean()) if exact.any() else 0.0,
        },
    }  # fmt: skip


def off_by_change(sensor, chosen, own, reference, now, earlier) -> np.ndarray:
    """Values in the windows `now` whose change of ln x since `earlier` is off by more than three wanted errors, or
    whose level is, and by more than a tenth; fluxes are [window, pixel], e⁻/s.
    """
    level = sensor.evs.log_signal(own, chosen) - sensor.evs.log_signal(reference, chosen)
    full = sensor.layout.full_index.ravel()[sensor.layout.evs_pixel.ravel()[chosen]]
    unit = Noise(sensor).of("events", full)(reference[now].astype(np.float32))
    unit = sensor.evs.log_signal(reference[now] + unit, chosen) - sensor.evs.log_signal(reference[now], chosen)
    change, most = np.abs(level[now] - level[earlier]), 3 * QUALITY * unit
    return (change > most) | (np.abs(level[now]) > np.maximum(most, 0.1))


def count_events(sensor, chosen, own, reference, stated, reference_error) -> Counted:
    """Events of some pixels by their own flux and by the reference, both [window, pixel].

    What is sure depends on both standard errors, because a diffuse scene can be more exact than its reference.
    """
    noise = sensor.evs
    levels = [noise.log_signal(values, chosen) for values in (own, reference, own + np.hypot(stated, reference_error))]
    shape = noise.layout.evs_shape
    maps = (noise.threshold_on_map, noise.threshold_off_map)
    thresholds = tuple(np.broadcast_to(theta, shape).ravel()[chosen].astype(np.float64) for theta in maps)
    arguments = levels[0], levels[1], levels[2] - levels[0], thresholds, np.ones(len(own), np.bool_)
    if noise.spec.reference == "previous_sample":
        return compare_ticks(*arguments)
    return compare_crossings(*arguments, 1 << 30)


def judge(records: list[dict[str, Any]]) -> list[str]:
    """What many runs say that does not hold; empty if all holds.

    Scenes are independent, values of one scene are not. A bound of an audit holds with 99 % confidence for its run: a
    run breaks one if its count has a probability below 1e-3 there, and so many runs break one by chance with a
    probability of 1e-5. Over all runs, the count is at most what the bounds allow. Bias: Student's t over scenes, false
    alarm 1e-4.
    """
    wrong = [f"seed {one['seed']}: mode {one['mode']}" for one in records if one["mode"] != "change-driven"]

    def t(values) -> float:
        values = np.array(values)
        return float(values.mean() / (values.std(ddof=1) / np.sqrt(values.size))) if np.ptp(values) > 0 else 0.0

    for name in ("off", "missed", "extra"):
        count, total, bound = np.array([one[name] for one in records], float).T
        broken = int(np.sum(count > stats.binom.isf(1e-3, np.maximum(total, 1), np.minimum(bound, 1))))
        if broken > stats.binom.isf(1e-5, count.size, 0.011):
            wrong.append(f"{name}: {broken} of {count.size} runs break the bound of their audit")
        if count.sum() > bound @ total:
            wrong.append(f"{name}: {count.sum():.0f} of {total.sum():.0f}, where the bounds allow {bound @ total:.1f}")
    values = [one["values"] for one in records]
    every, exact = (sum(one[name] for one in values) for name in ("all", "exact"))
    if exact <= 0.85 * every:
        wrong.append(f"the reference is exact enough in {exact} of {every} values only")
    means = [one["mean"] for one in values if one["exact"]]
    if abs(t(means)) > stats.t.isf(5e-5, len(means) - 1):
        wrong.append(f"bias: {np.mean(means):.4f} noise units")
    off = sum(one["off"] for one in values)
    if off > MOST_OFF * exact:
        wrong.append(f"off by more than three wanted errors: {off} of {exact}")
    # what is filled in may be off by a part of the tolerance on top of its stated error
    square = sum(one["mean_square"] * one["exact"] for one in values) / max(exact, 1)
    if square >= 1:
        wrong.append(f"mean square over the errors: {square:.2f}")
    return wrong

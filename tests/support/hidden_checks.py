"""Runs of the hidden scenes against many rays for every pair of a pixel and a tick."""

from functools import cache
from unittest import mock

import hidden_scenes
import numpy as np
import pytest
from rendering import pair_tracer

import hesim_render as hr
from hesim_render.sources.render.audit.compare import compare_ticks
from hesim_render.sources.render.change_driven.flux import ChangeDrivenFlux
from hesim_render.sources.render.change_driven.windows import Windows

TICKS, TICK_US, WINDOW_US, COLS, ROWS, QUALITY = 18, 1250, 1000, 40, 30, 0.5

#: Share of events that may be missed, or be too many, at quality 0.5.
MOST_MISSED, MOST_EXTRA = 0.02, 0.01
#: Share of the runs of a scene that may have more wrong than their audits say.
MOST_BROKEN = 0.05
#: Rays of the truth. Uniform ones, as it has them, meet a spark once in a thousand.
RAYS = dict.fromkeys(hidden_scenes.SCENES, 1024) | {"400 sparks": 4096, "pop-in plates": 256}


def sensor():
    changes = {
        "evs.tick_us": TICK_US,
        "evs.window_us": WINDOW_US,
        "evs.coefficients": [{"beta1": 1e-3, "beta2": 5e-3, "beta3": 3.1e-5, "beta4": 2.116e-4, "beta5": 0.0}],
        "evs.shot_law": "linear",
        "evs.contrast_threshold_on": 0.2,
        "evs.contrast_threshold_off": 0.2,
    }
    return hr.load_sensor("reference-mono", changes).crop(COLS, ROWS)


@cache
def truth(name, rays, times=2):
    """Flux of every pair, [tick, pixel]: the mean of some traces, in turn of the hidden and of the lit estimate."""
    tracer = pair_tracer(hidden_scenes.SCENES[name](), sensor(), 4711)
    pixel = np.tile(tracer.sensor.layout.full_index.ravel(), TICKS)
    window = np.repeat(np.arange(TICKS), COLS * ROWS)
    ends = TICK_US * np.arange(1.0, TICKS + 1)
    count = pixel.size
    # neither estimate is chosen
    traces = [
        tracer.trace(
            *(pixel, window, Windows(ends - WINDOW_US, ends), np.full(count, rays), np.full(count, bool(k % 2))),
            repeat=k,
        ).mean
        for k in range(times)
    ]
    return np.mean(traces, axis=0, dtype=np.float64).reshape(TICKS, -1)


@cache
def run_of(name, seed):
    """A recording in the default mode, and the flux that it was made of: both halves and the stated error, [3, tick,
    pixel].
    """
    samples, given = [], ChangeDrivenFlux.flux_of_blocks

    def noted(self, pixel, blocks):
        np.testing.assert_array_equal(pixel, self.sensor.layout.evs_pixel.ravel())
        for one in given(self, pixel, blocks):
            samples.append((np.array(one.half_a), np.array(one.half_b), one.error))
            yield one

    with mock.patch.object(ChangeDrivenFlux, "flux_of_blocks", noted):
        rec = hr.simulate(
            hidden_scenes.SCENES[name](),
            sensor(),
            duration_s=TICKS * TICK_US * 1e-6,
            seed=seed,
            clean=True,
            quality=QUALITY,
        )
    assert len(samples) == TICKS
    return rec, np.array(samples, np.float64).swapaxes(0, 1)


def compared(seen, wanted, run):
    """Events of a run's flux, with its stated error, against those of the truth, in total."""
    evs, pixels = sensor().evs, np.arange(COLS * ROWS)
    levels = [evs.log_signal(flux, pixels) for flux in (run, wanted, run + seen[2])]
    theta = np.full(pixels.size, 0.2)
    counted = compare_ticks(levels[0], levels[1], levels[2] - levels[0], (theta, theta), np.ones(TICKS, np.bool_))
    return {field: float(values.sum()) for field, values in vars(counted).items()}


def shares(name, seed, rays):
    """What a run has wrong, by the truth; and what its manifest says of that."""
    rec, seen = run_of(name, seed)
    total = compared(seen, truth(name, rays), seen[:2].mean(axis=0))
    assert rec.events.size == pytest.approx(total["in_run"], abs=0.02 * total["in_run"] + 1)
    return total, rec.manifest["settings"]["render"]["audit"]


def flips(name, seed):
    """Flips of a run, and those that errors as large as half the difference of its halves cause on the truth.

    The truth has eight times 4096 rays: margins are about as small as the run's errors, so its own must be far smaller.
    """
    (_, seen), wanted = run_of(name, seed), truth(name, 4096, 8)
    run, alone = seen[:2].mean(axis=0), wanted + 0.5 * (seen[0] - seen[1])
    return compared(seen, wanted, run)["flips"], compared(seen, wanted, alone)["flips"]


def judge(name, seed):
    """Counts by the truth, what the manifest says of events, and the shares of events missed and extra."""
    total, audit = shares(name, seed, RAYS[name])
    told = audit["events"]
    missed, extra = total["missed"] / max(1, total["true"]), total["extra"] / max(1, total["in_run"])
    return total, told, missed, extra


def not_held(runs):
    """What the runs of a scene say that does not hold, as lines; empty if all holds.

    Parameters
    ----------
    runs : for each ``true`` events and those ``in_run``, and of ``missed`` and ``extra`` the share and the audit's
        bound; and the audit's ``verdict``, which a run needs only where a share is above its limit.
    """
    wrong = []
    broken = sum(any(one[kind][0] > one[kind][1] for kind in ("missed", "extra")) for one in runs)
    if broken > max(1, MOST_BROKEN * len(runs)):
        wrong.append(f"{broken} of {len(runs)} runs have more wrong than their audits say")
    for kind, of, most in (("missed", "true", MOST_MISSED), ("extra", "in_run", MOST_EXTRA)):
        share = pooled(runs, kind, of)
        silent = sum(one[kind][0] > most and one.get("verdict") != "not met" for one in runs)
        if share > most:
            wrong.append(f"{100 * share:.2f} % {kind}")
        if silent:
            wrong.append(f"{silent} of {len(runs)} runs have more than {100 * most:.0f} % {kind} and do not say so")
    return wrong


def pooled(runs, kind, of):
    """Share of the events of all runs together that are missed, or extra."""
    return sum(one[kind][0] * one[of] for one in runs) / max(1, sum(one[of] for one in runs))


def record_of(name, seed):
    """One run, as `not_held` takes it."""
    total, told, missed, extra = judge(name, seed)
    rec, _ = run_of(name, seed)
    return {
        "verdict": rec.manifest["settings"]["render"]["audit"]["verdict"],
        "true": total["true"], "in_run": total["in_run"],
        "missed": [missed, told["missed_at_most"]], "extra": [extra, told["extra_at_most"]],
    }  # fmt: skip

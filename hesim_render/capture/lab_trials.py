"""The event captures of an asynchronous sensor: trials that begin with a reset, in steady light and with steps.

The events are those of the event stage: a trial is a stage of its own, whose first sample sets the reference of every
pixel, as the end of a reset does. The light is uniform.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.host_arrays import from_host
from hesim_render.core.npz import NpzWriter
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.pixels.evs.defects import DefectEvents
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.stage import EvsStage

#: Steady light: β1 I/β2 of each level, from the dark to where leak is all that is left.
_STEADY = (0.0, 0.8, 2.4, 8.0, 200.0)
#: Steps: β1 I/β2 before the step, and how many steps each way.
_LIGHTS = ((80.0, 22), (8.0, 10), (1.6, 10))
#: Steps of ln x, in thresholds, from the least to the largest.
_REACH = (0.25, 1.9)
#: Settling, and the ends of the time bins after a step and in steady light, in periods of the cut-off.
_SETTLE, _STEP_BINS, _STEADY_BINS = 0.75, (0.03, 1.25), (20.0,)
#: Trials of a part, where trials in the brightest light are counted in parts as well.
_PART_TRIALS = 8
#: From the seed of one trial to that of the next: odd, so that none comes twice (2⁶⁴ over the golden section).
_SEEDS_APART = 0x9E3779B97F4A7C15
#: Time from one level of light to the next.
_STEP_US = 1
#: Time from the end of a trial to the next reset.
_PAUSE_US = 1


@dataclass(frozen=True)
class TrialPlan:
    """Kinds of trials of one file.

    Attributes
    ----------
    signal_dn, contrast : [kind], light before the step and ln I₁/I₀.
    settle_us : from the reset to the step. edges_us : [bin + 1], bounds of the time bins after it, the first 0.
    trials : [kind], number of each.
    parts : number of parts into which the trials of the last kind are divided; 0 for none.
    """

    signal_dn: NDArray[np.float64]
    contrast: NDArray[np.float64]
    settle_us: int
    edges_us: NDArray[np.int64]
    trials: NDArray[np.int64]
    parts: int = 0

    @property
    def trial_us(self) -> int:
        """Time from the reset of a trial to its end."""
        return self.settle_us + int(self.edges_us[-1])

    @property
    def duration_s(self) -> float:
        """Time of all trials together."""
        return int(self.trials.sum()) * self.trial_us * S_PER_US


def plan_trials(noise: EvsNoise, trials: int, parts: int = 0) -> dict[str, TrialPlan]:
    """What is captured of a sensor: name of the file → trials in it.

    Parameters
    ----------
    noise : model of the event pixels.
    trials : number of trials of each kind.
    parts : number of parts of 8 trials in the brightest steady light that are counted separately; 0 for none.
    """
    spec = noise.spec
    assert spec.noise_cutoff_hz is not None
    first = spec.coefficients[0]
    dn = first.beta2 / max(first.beta1, 1e-12)
    period_us = US_PER_S / spec.noise_cutoff_hz
    settle_us = max(math.ceil(_SETTLE * period_us), 2)

    def edges(ends: tuple[float, ...]) -> NDArray[np.int64]:
        return np.array([0, *(max(math.ceil(end * period_us), k + 4) for k, end in enumerate(ends))])

    signal, contrast = [], []
    for light, count in _LIGHTS:
        for sign, theta in ((1.0, spec.contrast_threshold_on), (-1.0, spec.contrast_threshold_off)):
            after = (1.0 + light) * np.exp(sign * theta * np.linspace(*_REACH, count)) - 1.0
            reached = np.log(after[after > 1e-3 * light] / light)
            contrast.append(reached)
            signal.append(np.full(reached.size, light * dn))
    steady = np.full(len(_STEADY), trials)
    if parts:
        steady[-1] = parts * _PART_TRIALS
    steps = np.concatenate(contrast)
    return {
        "evs_noise_rate": TrialPlan(
            np.array(_STEADY) * dn, np.zeros(len(_STEADY)), settle_us, edges(_STEADY_BINS), steady, parts
        ),
        "evs_s_curve": TrialPlan(
            np.concatenate(signal), steps, settle_us, edges(_STEP_BINS), np.full(steps.size, trials)
        ),
    }


@dataclass
class TrialBench:
    """Runs trials one after the other.

    Parameters
    ----------
    dn_per_e_per_s : [y, x], I/Φ of every event pixel.
    count : trials so far; each has its own noise and leak. Hot and flickering pixels go on from trial to trial.
    advance : called with seconds of a sensor's time that were simulated.
    """

    noise: EvsNoise
    dn_per_e_per_s: NDArray[np.float64]
    seed: int
    advance: Callable[[float], None]
    t_us: int = 0
    count: int = 0

    def __post_init__(self) -> None:
        self._defects = DefectEvents(self.noise.defects, self.seed) if self.noise.defects else None

    def write(self, file: Path, plan: TrialPlan) -> None:
        """All kinds of trials of a plan, as the arrays of one file."""
        bins, shape = len(plan.edges_us) - 1, self.noise.layout.evs_shape
        count_type = np.min_scalar_type(int(plan.trials.max()))
        kinds = plan.signal_dn.size
        calm = np.zeros((kinds, *shape), count_type)
        on, off = np.zeros((2, kinds, bins, *shape), count_type)
        disturbed = np.zeros((plan.parts, *shape), count_type)
        for k in range(kinds):
            before = self._electrons(plan.signal_dn[k])
            after = self._electrons(plan.signal_dn[k] * math.exp(plan.contrast[k]))
            for number in range(plan.trials[k]):
                quiet, first, polarity = self._trial(before, after if plan.contrast[k] else None, plan)
                calm[k] += quiet.reshape(shape)
                for j in range(bins):
                    on[k, j] += ((first == j) & (polarity > 0)).reshape(shape)
                    off[k, j] += ((first == j) & (polarity < 0)).reshape(shape)
                if plan.parts and k == kinds - 1:
                    disturbed[number * plan.parts // plan.trials[k]] += (~quiet | (first >= 0)).reshape(shape)
                self.advance(plan.trial_us * S_PER_US)
        with NpzWriter(file) as archive:
            archive.add("signal_dn", plan.signal_dn)
            archive.add("contrast", plan.contrast)
            archive.add("settle_us", np.array(plan.settle_us))
            archive.add("edges_us", plan.edges_us)
            archive.add("n_calm", calm)
            archive.add("n_on", on)
            archive.add("n_off", off)
            if plan.parts:
                each = int(plan.trials[-1]) // plan.parts
                archive.add("bright_parts", disturbed)
                archive.add("part_trials", np.array(each))
                archive.add("part_us", np.array(each * (plan.trial_us + _PAUSE_US)))

    def _electrons(self, signal_dn: float) -> Float:
        seconds = self.noise.spec.window_us * S_PER_US
        return from_host(jit().Float, signal_dn / self.dn_per_e_per_s * seconds)

    def _trial(
        self, before: Float, after: Float | None, plan: TrialPlan
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int8]]:
        """Which pixels were calm while settling, the time bin of each one's first event (−1: none), its polarity."""
        # waits for leak events begin with the stage: each needs its own seed
        seed, start_us = (self.seed + _SEEDS_APART * self.count) % 2**64, self.t_us
        stage = EvsStage(self.noise, seed, defects=self._defects, is_reset=True)
        self.count += 1
        step_us = start_us + plan.settle_us
        end_us = step_us + int(plan.edges_us[-1])
        stage.step(before, start_us)
        early = stage.step(before, step_us)
        parts = []
        if after is not None:
            parts.append(stage.step(after, step_us + _STEP_US))
            before = after
        parts.append(stage.step(before, end_us))
        self.t_us = end_us + _PAUSE_US
        events = np.concatenate(parts)  # in the order of their times
        cols = self.noise.layout.evs_shape[1]
        count = math.prod(self.noise.layout.evs_shape)
        quiet = np.ones(count, bool)
        quiet[early["y"].astype(np.int64) * cols + early["x"]] = False
        pixel, where = np.unique(events["y"].astype(np.int64) * cols + events["x"], return_index=True)
        first, polarity = np.full(count, -1), np.zeros(count, np.int8)
        first[pixel] = np.searchsorted(plan.edges_us, events["t_us"][where] - step_us, side="left") - 1
        polarity[pixel] = events["polarity"][where]
        first[~quiet] = -1
        return quiet, first, polarity

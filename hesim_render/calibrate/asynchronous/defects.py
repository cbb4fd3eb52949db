"""Outlying asynchronous event pixels: detected where no possible threshold explains the counts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from hesim_render.calibrate.asynchronous.fit import Fit
from hesim_render.calibrate.asynchronous.likelihood import TrialCounts, chances
from hesim_render.calibrate.asynchronous.trials import Parts, Trials
from hesim_render.calibrate.flicker import dynamics, unsteady
from hesim_render.calibration.rates import rate_hz
from hesim_render.calibration.spec import Defect

#: Probability that a good pixel's counts are called bad.
_CHANCE = 1e-7
#: If more pixels than this fraction fail one test, the model is wrong and not the pixels. The checks report it.
_MOST_BAD = 0.02
#: Least fraction of the trials in the brightest light in which a good pixel is calm while settling.
_CALM = 0.5
#: Distance of a probability from 0 or 1 below which an event is certain or excluded.
_SURE = 0.02
#: Number of pixels processed together.
_CHUNK = 8192


@dataclass(frozen=True)
class TrialDefects:
    """Bad pixels; flat arrays [pixel].

    Attributes
    ----------
    bad : all bad pixels.
    kind : `Defect`.
    on_hz, off_hz : events per second of hot pixels, and of flickering pixels while they fire; 0 elsewhere.
    firing_share, change_hz : fraction of the time in which a flickering pixel fires, and the rate at which it forgets
        whether it does, Hz; 1 and 0 elsewhere.
    """

    bad: NDArray[np.bool_]
    kind: NDArray[np.uint8]
    on_hz: NDArray[np.float32]
    off_hz: NDArray[np.float32]
    firing_share: NDArray[np.float32]
    change_hz: NDArray[np.float32]


def plainly_bad(steady: Trials, steps: Trials) -> NDArray[np.bool_]:
    """Pixels [pixel] that lack a polarity, are never calm, or have events of their own in the brightest light."""
    bad = (steps.on.sum(axis=(0, 1)) == 0) | (steps.off.sum(axis=(0, 1)) == 0)
    for trials in (steady, steps):
        # a pixel that is hardly ever calm in the brightest light fires by itself
        bright = trials.signal_dn == trials.signal_dn.max()
        most = trials.calm[bright].max(axis=1).sum()
        bad |= trials.calm[bright].sum(axis=0) < _CALM * most
    k = int(np.argmax(steady.signal_dn))
    for events in (n[k].sum(axis=0, dtype=np.float64) for n in (steady.on, steady.off)):
        # the mean of what good pixels give, which the few hot ones do not raise
        usual = np.minimum(events, np.quantile(events, 0.99) + 1).mean()
        bad |= poisson.sf(events - 1, max(usual, 1.0 / events.size)) < _CHANCE
    return bad


def unlike(fit: Fit, steady: Trials, steps: Trials, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Good pixels [pixel] whose counts no threshold that their S-curve allows could give.

    Three tests of each polarity: too many events in steady light, events missing at steps that certainly give one, and
    events at steps that certainly give none.
    """
    result = np.zeros((6, good.size), bool)
    pixels = np.flatnonzero(good)
    for begin in range(0, pixels.size, _CHUNK):
        some = pixels[begin : begin + _CHUNK]
        for k, polarity in enumerate((1, -1)):
            result[3 * k : 3 * k + 3, some] = _tests(fit, steady.of(some), steps.of(some), polarity)
    # a test that so many pixels fail is a fault of the model, not of the pixels
    wrong = result[result.sum(axis=1) <= _MOST_BAD * pixels.size]
    return np.any(wrong, axis=0) if wrong.size else np.zeros(good.size, bool)


def _tests(fit: Fit, steady: Trials, steps: Trials, polarity: int) -> NDArray[np.bool_]:
    """[test, pixel]."""
    k = 0 if polarity > 0 else 1
    grid = fit.likelihood.grids[k]
    counts = TrialCounts.of([steps], polarity)
    # what the S-curve of each pixel leaves of the grid of thresholds, [pixel, threshold]
    weight = fit.law_given(counts)
    chance = chances(fit.values, counts.sets[0], polarity, grid, fit.law).sum(axis=1)  # [kind, threshold]
    events = counts.events.reshape(weight.shape[0], chance.shape[0], -1).sum(axis=2)
    trials = events + counts.silent
    sure, never = chance > 1 - _SURE, chance < _SURE
    quiet = TrialCounts.of([steady], polarity)
    seen = quiet.events.sum(axis=1, keepdims=True)
    usual = chances(fit.values, quiet.sets[0], polarity, grid, fit.law).sum(axis=1)
    bins = len(steady.edges_s) - 1
    own = quiet.events.reshape(weight.shape[0], -1, bins).sum(axis=2) + quiet.silent
    # counts of each test, and their means for every threshold of the grid
    tests = (
        (np.broadcast_to(seen, weight.shape), own @ usual),
        (counts.silent @ sure, trials @ (sure * (1 - chance))),
        (events @ never, trials @ (never * chance)),
    )
    return np.array(
        [np.sum(weight * poisson.sf(n - 1, np.maximum(mean, 1e-12)), axis=1) < _CHANCE for n, mean in tests]
    )


def classify(steady: Trials, steps: Trials, bad: NDArray[np.bool_]) -> TrialDefects:
    """Classify the bad pixels: stuck, hot, flickering or other.

    The parts of the trials in the brightest light distinguish a flickering pixel from a hot one: their scatter has a
    chance below 1e-6 at a constant rate.
    """
    kind = np.zeros(bad.size, np.uint8)
    own_hz = np.zeros((2, bad.size), np.float32)
    firing_share, change_hz = np.ones(bad.size, np.float32), np.zeros(bad.size, np.float32)
    some = np.flatnonzero(bad)
    if some.size == 0:
        return TrialDefects(bad, kind, own_hz[0], own_hz[1], firing_share, change_hz)
    ours, light = steady.of(some), int(np.argmax(steady.signal_dn))
    seconds = max(float(steady.calm[light, ~bad].sum(dtype=np.float64) * steady.edges_s[-1]), 1e-12)
    duration = np.maximum(ours.calm[light] * steady.edges_s[-1], 1e-12)
    # hot: hardly ever calm, or more events in the brightest light than usual pixels would give by chance
    never_calm = ours.calm[light] < _CALM * steady.calm[light].max()
    rates = [np.where(never_calm, 0, n[light].sum(axis=0, dtype=np.float64)) / duration for n in (ours.on, ours.off)]
    usual = [float(n[light][:, ~bad].sum(dtype=np.float64)) / seconds for n in (steady.on, steady.off)]
    excess = [poisson.sf(r * duration - 1, max(u, 1e-9) * duration) < 1e-3 for r, u in zip(rates, usual, strict=True)]
    hot = never_calm | excess[0] | excess[1]
    # stuck: no event from any step
    silent = (steps.on[..., some].sum(axis=(0, 1)) == 0) & (steps.off[..., some].sum(axis=(0, 1)) == 0) & ~never_calm
    kind[some] = np.where(silent, Defect.STUCK, np.where(hot, Defect.HOT, Defect.OTHER))
    own = _own_rates(ours, light, never_calm, float(steady.calm[light].max()))
    # flickering: a hot pixel whose events come in some parts of the time and not in others
    if steady.parts is not None:
        flickers = hot & ~silent & unsteady(steady.parts.disturbed[:, some], steady.parts.trials)
        which = some[flickers]
        kind[which] = Defect.FLICKERING
        own_hz[:, which], firing_share[which], change_hz[which] = _flicker(bad, which, steady.parts, own[:, flickers])
    is_hot = kind[some] == Defect.HOT
    own_hz[:, some[is_hot]] = own[:, is_hot]
    return TrialDefects(bad, kind, own_hz[0], own_hz[1], firing_share, change_hz)


def _flicker(
    bad: NDArray[np.bool_], pixels: NDArray[np.intp], parts: Parts, own: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Times and rates of flickering pixels.

    The state of a pixel is taken to be constant during a trial: the share of trials with an event while it fires is
    1 − exp(−rate · trial).

    Parameters
    ----------
    bad : [pixel], all bad pixels.
    pixels : the flickering pixels.
    own : [polarity, flickering pixel], mean rates of ON and OFF events, Hz, for the share of ON events.

    Returns
    -------
    rates : [polarity, flickering pixel], of events while a pixel fires, Hz.
    firing_share, change_hz : [flickering pixel], as in `TrialDefects`.
    """
    counts = parts.disturbed[:, pixels]
    good = parts.disturbed[:, ~bad]
    usual = float(good.mean(dtype=np.float64)) / parts.trials if good.size else 0.0
    share, correlation = dynamics(counts, parts.trials, usual)
    chance = np.maximum(counts.mean(axis=0, dtype=np.float64) / parts.trials - usual, 0.0) / share
    # the trials show no more than that one is silent in all of those in which the pixel fires
    most = 1 - 0.5 / np.maximum(counts.shape[0] * parts.trials * share, 1.0)
    rate = rate_hz(np.minimum(chance, most), parts.trial_s)
    on_share = own[0] / np.maximum(own.sum(axis=0), 1e-300)
    switching = (correlation > 0) & (share < 1)
    with np.errstate(divide="ignore"):
        change = -np.log(np.where(switching, correlation, 1.0)) / parts.trial_s
    return np.stack([on_share * rate, (1 - on_share) * rate]), np.where(switching, share, 1.0), change


def _own_rates(steady: Trials, light: int, never_calm: NDArray[np.bool_], most: float) -> NDArray[np.float64]:
    """Rates of ON and OFF events [2, pixel] of pixels that fire at random, Hz.

    Only first events are counted, so the rate is −ln(fraction of trials without one)/duration. Where hardly a trial is
    calm, the rate is that of the preceding settling time, with ON events unless OFF events were seen.

    Parameters
    ----------
    steady : trials in steady light.
    light : number of the kind of trials.
    never_calm : [pixel], pixels of which hardly a trial is calm.
    most : calm trials of a good pixel.
    """
    calm = steady.calm[light].astype(np.float64)
    events = np.stack([n[light].sum(axis=0, dtype=np.float64) for n in (steady.on, steady.off)])
    # a Poisson process leaves the share exp(−rate · time) of the trials without an event
    silent = np.maximum(calm - events.sum(axis=0), 0.5)
    total = np.log(np.maximum(calm, 0.5) / silent) / steady.edges_s[-1]
    total = np.where(never_calm, -np.log(np.maximum(calm, 0.5) / most) / steady.settle_s, np.maximum(total, 0))
    seen = events.sum(axis=0)
    on_share = np.where(seen > 0, events[0] / np.maximum(seen, 1), 1.0)
    return np.stack([on_share, 1 - on_share]) * total

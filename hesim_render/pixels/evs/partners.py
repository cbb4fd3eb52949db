"""Partners of the events of asynchronous pixels: which steps of noise-free pixels they follow from.

The noise-free pixels compare with the reference level that the real pixel has, wherever no step waits for its partner.
With a dead time, each pixel begins anew from the level at its release. There, the noise-free pixels have the dead time
as well. Others without it tell what is lost in it.

Steps of a pixel with thresholds of its own that the nominal thresholds give as well.

A step in one direction leads from a reference level to the pixel's own threshold. The nominal threshold gives it as
well if the level goes on from the same reference to that one before the pixel steps back. Each step is decided by
itself, so that the two thresholds cannot drift apart however long the pixel runs.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.host_arrays import from_host
from hesim_render.pixels.evs.cause_pairs import CAUSE, EFFECT, Balance, LastSteps, PixelSteps
from hesim_render.pixels.evs.events import Label, Origin
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.on_device import Map
from hesim_render.pixels.evs.stage import EvsStage

#: Levels are float32: thresholds that differ by less are the same, ln units.
_ROUNDING = 1e-5


class _Waiting(NamedTuple):
    """Steps that are not decided yet, [n] each: pixel, direction, number, and the level that decides, ln x."""

    pixel: NDArray[np.int64]
    sign: NDArray[np.int64]
    number: NDArray[np.int64]
    goal: NDArray[np.float64]

    def at(self, which: NDArray) -> "_Waiting":
        return _Waiting(*(values[which] for values in self))


class NominalSteps:
    """Steps whose level has not reached the nominal threshold yet; at most a few for each pixel.

    Parameters
    ----------
    own, nominal : θ₊ and θ₋, numbers or one for each pixel, ln units.
    pixels : number of pixels.
    """

    def __init__(self, own: tuple[Map, Map], nominal: tuple[Map, Map], pixels: int) -> None:
        self._own, self._nominal = (
            np.stack([np.broadcast_to(np.asarray(theta, np.float64).ravel(), pixels) for theta in thetas])
            for thetas in (own, nominal)
        )
        none = np.empty(0, np.int64)
        self._waiting = _Waiting(none, none, none, np.empty(0))

    @property
    def undecided(self) -> NDArray[np.int64]:
        """Numbers of the steps that are not decided yet."""
        return self._waiting.number

    def take(self, steps: PixelSteps, reference: NDArray[np.float32], level: NDArray[np.float32]) -> NDArray[np.int64]:
        """Take all steps between two samples.

        Parameters
        ----------
        steps : of the pixels with their own thresholds, in order of time.
        reference, level : of all pixels at the second sample, ln x.

        Returns
        -------
        Numbers of the steps, these and earlier ones, that the nominal thresholds have given now.
        """
        # steps by pixel, then by time; own and nominal threshold of each step, by its direction
        order = np.argsort(steps.pixel, kind="stable")
        pixel, sign, number = (values[order] for values in (steps.pixel, steps.sign, steps.number))
        own, nominal = (theta[(sign < 0).astype(np.intp), pixel] for theta in (self._own, self._nominal))
        # from the reference at the end back to those after each step
        new_pixel = np.diff(pixel, prepend=-1) != 0
        moved = np.cumsum(sign * own)
        last = np.append(np.flatnonzero(new_pixel), pixel.size)[1:] - 1
        of_pixel = np.cumsum(new_pixel) - 1
        after = reference[pixel].astype(np.float64) - (moved[last[of_pixel]] - moved)
        # runs of steps in one direction; the last of a pixel goes on to the level at the end
        starts = np.flatnonzero(new_pixel | (np.diff(sign, prepend=0) != 0))
        ends = np.append(starts, pixel.size)[1:] - 1
        run = np.repeat(np.arange(starts.size), ends - starts + 1)
        goes_on = np.isin(ends, last)
        farthest = sign[ends] * after[ends]
        farthest[goes_on] = np.maximum(farthest[goes_on], (sign[ends] * level[pixel[ends]])[goes_on])

        # steps of earlier samples wait on: how far the level has gone for them is in the first run of their pixel.
        # Where that runs the other way, the pixel has stepped back, and the goal is out of reach.
        before = self._waiting
        first_run = np.full(self._own.shape[1], -1)
        first_run[pixel[new_pixel]] = run[new_pixel]
        run_before = first_run[before.pixel]
        none = run_before < 0
        ends_before = before.sign * level[before.pixel].astype(np.float64)
        if starts.size:
            of_run = pixel[starts[run_before]], sign[starts[run_before]]
            turned = ~none & (of_run[1] != before.sign)
            ends_before[~none] = np.where(turned, -np.inf, farthest[run_before])[~none]
        else:
            turned = np.zeros(none.size, np.bool_)

        # a step is reached if its run comes to the nominal threshold; it is final if its pixel has turned since
        every = _Waiting(*(np.concatenate(both) for both in zip(
            before, (pixel, sign, number, after + sign * (nominal - own)), strict=True
        )))  # fmt: skip
        reached = every.sign * every.goal <= np.concatenate([ends_before, farthest[run]]) + _ROUNDING
        final = np.concatenate([turned, ~goes_on[run]])
        self._waiting = every.at(~reached & ~final)
        return every.number[reached]

    def shift(self, pixel: NDArray[np.int64], by: NDArray[np.float32]) -> None:
        """Move the references of some pixels, in rising order, by differences of ln x."""
        if pixel.size == 0:
            return
        # `pixel` is sorted: the place of the pixel of each waiting step in it, if it is there
        place = np.minimum(np.searchsorted(pixel, self._waiting.pixel), pixel.size - 1)
        result = pixel[place] == self._waiting.pixel
        self._waiting.goal[result] += by[place[result]]


#: Pairs and steps that may wait for each other before those without hope are looked for.
_FEW = 4096


class StepLabels(NamedTuple):
    """Labels that a step of the stage has decided.

    Parameters
    ----------
    asleep : steps of the noise-free pixels within a dead time, `EVENT_DTYPE`.
    changed, changed_to : numbers of events whose label is another now, and that.
    """

    asleep: NDArray[np.void]
    changed: NDArray[np.int64]
    changed_to: NDArray[np.uint8]


class Partners:
    """Noise-free pixels beside asynchronous ones.

    Parameters
    ----------
    own, nominal : noise models without noise, with the dead time of the sensor: with each pixel's own thresholds and
        with nominal ones; the latter None if they are alike.
    seed : seed of the stage.
    """

    def __init__(self, own: EvsNoise, nominal: EvsNoise | None, seed: int) -> None:
        self._cols = own.layout.evs_shape[1]
        pixels = int(np.prod(own.layout.evs_shape))
        dead_us = own.refractory_period_us
        #: Pixels without a dead time; what they do within that of the real ones is lost.
        self._own = EvsStage(own.without("refractory"), seed)
        self._of_events = Balance(pixels, dead_us)
        #: Pixels that had steps since they took over the reference level of the real ones.
        self._stepped = np.ones(pixels, np.bool_)
        self._nominal: NominalSteps | None = None
        self._with_dead_time = None if dead_us is None else _WithDeadTime(own, nominal, seed)
        if dead_us is None and nominal is not None:
            by_own, by_nominal = ((noise.threshold_on_map, noise.threshold_off_map) for noise in (own, nominal))
            self._nominal = NominalSteps(by_own, by_nominal, pixels)
        self._steps = 0
        self._verdicts = _Verdicts(nominal is not None)

    def take(
        self,
        stage: EvsStage,
        electrons: Float,
        events: NDArray[np.void],
        origin: NDArray[np.int8],
        number: NDArray[np.int64],
    ) -> StepLabels:
        """Take one step of the stage.

        Parameters
        ----------
        stage : the real pixels, after the step.
        electrons : the sample, as the stage got it.
        events, origin : all events since the previous sample, and their `Origin`.
        number : what names them; −1 for those that need no label.
        """
        assert stage.t_us is not None
        is_first = self._own.t_us is None
        # the noise-free pixels take the same sample; each of their steps gets a number
        own = self._own.step(electrons, stage.t_us)
        steps = as_steps(own, self._steps + np.arange(own.size), self._cols)
        # only events of a crossing can follow from a step; leaks and defects come by themselves
        of_comparator = (origin == Origin.COMPARATOR) | (origin == Origin.DRIFT)
        effects = as_steps(events[of_comparator], number[of_comparator], self._cols)
        cause, effect, lost = self._of_events.take(steps, effects)
        asleep = own[np.sort(lost) - self._steps]
        self._steps += own.size
        self._stepped[steps.pixel] = self._stepped[effects.pixel] = True
        # with a dead time, noise-free pixels that have it as well decide the labels
        if self._with_dead_time is not None:
            decided = self._with_dead_time.take(stage, electrons, stage.t_us, effects, self._verdicts)
        else:
            given = undecided = np.empty(0, np.int64)
            if self._nominal is not None and (steps.pixel.size or self._nominal.undecided.size):
                given = self._nominal.take(steps, self._own.reference.numpy(), self._own.level.numpy())
            undecided = undecided if self._nominal is None else self._nominal.undecided
            decided = self._verdicts.take(cause, effect, given, undecided, self._of_events)
        self._share_reference(stage, stage.t_us, is_first)
        return StepLabels(asleep, *decided)

    def _share_reference(self, stage: EvsStage, t_us: int, is_first: bool) -> None:
        """Let noise-free pixels compare with the level of the real one where no step of either waits for its partner.

        Noise moves the level of a real pixel whose two thresholds differ: an event up and one down leave it beside
        where it was, and so does a dead time.
        """
        place = np.flatnonzero(self._stepped)
        idle = place if is_first else place[self._of_events.is_idle(place, t_us)]
        if idle.size == 0:
            return
        self._stepped[idle] = False
        moved = _take_over(self._own, stage.reference, idle)
        if self._nominal is not None:
            self._nominal.shift(idle, moved)


def _take_over(pixels: EvsStage, reference: Float, which: NDArray[np.int64]) -> NDArray[np.float32]:
    """Let some pixels compare with other levels. Returns how far their references have moved, ln x."""
    if which.size == 0:
        return np.empty(0, np.float32)
    types = jit()
    index = from_host(types.UInt32, which)
    before, now = (dr.gather(types.Float, level, index) for level in (pixels.reference, reference))
    dr.eval(before, now)
    own = dr.copy(pixels.reference)
    dr.scatter(own, now, index)
    dr.eval(own)
    pixels.compare_with(own)
    return np.asarray(now.numpy() - before.numpy())


class _WithDeadTime:
    """Noise-free pixels with the dead time of the real ones; parameters as for `Partners`."""

    def __init__(self, own: EvsNoise, nominal: EvsNoise | None, seed: int) -> None:
        self._cols = own.layout.evs_shape[1]
        pixels = int(np.prod(own.layout.evs_shape))
        self._own, self._nominal = EvsStage(own, seed), None if nominal is None else EvsStage(nominal, seed)
        dead_us = own.refractory_period_us
        assert dead_us is not None
        self._of_events, self._of_own = LastSteps(pixels, dead_us), LastSteps(pixels, dead_us)
        self._steps = 0
        self._stepped = np.ones(pixels, np.bool_)

    def take(
        self, stage: EvsStage, electrons: Float, t_us: int, effects: PixelSteps, verdicts: "_Verdicts"
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        own = self._own.step(electrons, t_us)
        steps = as_steps(own, self._steps + np.arange(own.size), self._cols)
        self._steps += own.size
        cause, effect = self._of_events.take(steps, effects)
        given = np.empty(0, np.int64)
        if self._nominal is not None:
            nominal = self._nominal.step(electrons, t_us)
            _, given = self._of_own.take(as_steps(nominal, np.zeros(nominal.size, np.int64), self._cols), steps)
        self._stepped[steps.pixel] = self._stepped[effects.pixel] = True
        place = np.flatnonzero(self._stepped)
        idle = place[self._of_events.is_idle(place, t_us) & self._of_own.is_idle(place, t_us)]
        self._stepped[idle] = False
        for pixels in filter(None, (self._own, self._nominal)):
            _take_over(pixels, stage.reference, idle)
        return verdicts.take(cause, effect, given, self._of_own.waiting(EFFECT), self._of_events)


class _Verdicts:
    """Labels of events that have partners. Those of a pair and of its step come in any order.

    Parameters
    ----------
    differ : nominal and own thresholds differ; if not, all events with partners are signal.
    """

    def __init__(self, differ: bool) -> None:
        self._differ = differ
        #: Pairs of a step and an event, [2, n], whose step the nominal threshold has not given yet, and steps that it
        #: has given, without an event yet.
        self._open, self._given = np.empty((2, 0), np.int64), np.empty(0, np.int64)
        self._enough = _FEW

    def take(
        self,
        cause: NDArray[np.int64],
        effect: NDArray[np.int64],
        given: NDArray[np.int64],
        undecided: NDArray[np.int64],
        pairs: Balance | LastSteps,
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Events whose label is decided now, or another for the time being, and these labels.

        Parameters
        ----------
        cause, effect : new pairs of the numbers of a step and of an event.
        given : steps, new ones or earlier ones, that the nominal threshold has given now.
        undecided : steps that it may give later.
        pairs : where steps wait for events.
        """
        # pairs [2, n] of events that are in the recording
        new = np.stack([cause, effect])[:, effect >= 0]
        if not self._differ:
            return new[1], np.full(new.shape[1], Label.SIGNAL, np.uint8)
        old = self._open.shape[1]
        self._open = np.concatenate([self._open, new], axis=1)
        self._given = np.concatenate([self._given, given])
        cause, effect = self._open
        # signal is final; a new pair without its step is mismatch until that step comes
        signal = np.isin(cause, self._given)
        decided = signal | (np.arange(cause.size) >= old)
        self._open, self._given = self._open[:, ~signal], self._given[~np.isin(self._given, cause[signal])]
        # what no step or event can complete any more is let go, now and then, so that memory does not grow
        if self._open.shape[1] + self._given.size > self._enough:
            self._open = self._open[:, np.isin(self._open[0], undecided)]
            self._given = self._given[np.isin(self._given, pairs.waiting(CAUSE))]
            self._enough = 2 * (self._open.shape[1] + self._given.size) + _FEW
        return effect[decided], np.where(signal[decided], Label.SIGNAL, Label.MISMATCH).astype(np.uint8)


def as_steps(events: NDArray[np.void], number: NDArray[np.int64], cols: int) -> PixelSteps:
    """Events as steps, with numbers that name them; `cols` of the event grid."""
    pixel = events["y"].astype(np.int64) * cols + events["x"]
    return PixelSteps(events["t_us"], pixel, events["polarity"].astype(np.int64), number)

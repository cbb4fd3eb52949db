"""What caused each event: labels by comparison with the same pixels without noise.

Noise-free pixels run beside the real ones and see the same light, some with the nominal thresholds and some with each
pixel's own. They have the bandwidth of the sensor, but no dead time and no limit of the read-out. Those with nominal
thresholds give the noise-free stream.

With fixed ticks, an event is `signal` if the nominal pixel gives the same event at the same tick, and `mismatch` if
only the one with its own threshold does. Asynchronous pixels give their events a little earlier or later than without
noise. There, the noise-free pixels compare with the reference level that the real pixel has, and an event is paired
with the step that the noise-free pixel makes sooner or later, unless the real one goes back before (`balance`). What
has no partner is `leak` or `hot` if that process gave it, else `noise`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.pixels.evs.balance import Balance, Steps
from hesim_render.pixels.evs.events import EventLabels, Label, Lost, Origin, no_events
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.stage import EvsStage

#: Terms that the noise-free pixels lack; the spread of thresholds besides in the nominal ones.
_NOISE = (
    *("shot", "dark_current", "leak", "refractory", "readout_limit"),
    *("stuck", "hot", "flickering"),
)


class Labeller:
    """Runs the noise-free pixels beside an `EvsStage`, and labels its events.

    Parameters
    ----------
    noise : the noise model of the stage.
    seed : seed of the stage.
    begin_us, end_us : events after the begin and up to the end belong to the run, µs.
    """

    def __init__(self, noise: EvsNoise, seed: int, begin_us: int, end_us: int) -> None:
        self._cols = noise.layout.evs_shape[1]
        self._span = begin_us, end_us
        nominal, own = noise.without(*_NOISE, "mismatch"), noise.without(*_NOISE)
        alike = isinstance(noise.threshold_on_map, float) and isinstance(noise.threshold_off_map, float)
        self._by_tick = noise.spec.reference == "previous_sample"
        #: The noise-free stream; and pixels with the reference of the real ones: with own thresholds, and with nominal
        #: ones if these differ. With fixed ticks there is no reference to share.
        self._clean_pixels = EvsStage(nominal, seed)
        self._own = None if alike and self._by_tick else EvsStage(own, seed)
        self._nominal = None if alike or self._by_tick else EvsStage(nominal, seed)
        pixels = int(np.prod(noise.layout.evs_shape))
        dead_us = noise.refractory_period_us
        self._of_own = Balance(pixels)
        self._of_events = Balance(pixels, dead_us)
        self._clean: list[NDArray[np.void]] = [no_events()]
        self._label: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)]
        self._events = self._steps = 0
        #: Pixels that had steps since they took over the reference level of the real ones.
        self._stepped = np.ones(pixels, np.bool_)
        #: Pairs of an event and a step of the pixel's own, and of that and a nominal step; and steps in dead time.
        self._pairs: list[tuple[NDArray, NDArray]] = []
        self._nominal_too: list[NDArray] = []
        self._asleep: list[NDArray[np.void]] = [no_events()]
        self._unread: list[NDArray[np.void]] = [no_events()]

    def take(
        self,
        stage: EvsStage,
        electrons: Float,
        events: NDArray[np.void],
        origin: NDArray[np.int8],
        kept: NDArray[np.bool_] | None,
    ) -> None:
        """Take one step of the stage.

        Parameters
        ----------
        stage : the stage, after the step.
        electrons : the sample, as the stage got it.
        events : all events since the previous sample, sorted.
        origin : their `Origin`.
        kept : which of them the read-out has let through; None: all.
        """
        assert stage.t_us is not None
        is_first = self._clean_pixels.t_us is None
        clean = self._clean_pixels.step(electrons, stage.t_us)
        own = clean if self._own is None else self._own.step(electrons, stage.t_us)
        nominal = own if self._nominal is None else self._nominal.step(electrons, stage.t_us)
        self._clean.append(self._in_run(clean))
        through = np.ones(events.size, np.bool_) if kept is None else kept
        self._unread.append(self._in_run(events[~through]))
        counted = through & self._of_run(events)
        number = np.where(counted, self._events + np.cumsum(counted) - 1, -1)
        self._events += int(np.count_nonzero(counted))
        found = np.choose(origin - 1, [Label.NOISE, Label.LEAK, Label.HOT]).astype(np.uint8)
        if self._by_tick:
            place = self._key(events)
            found[np.isin(place, self._key(own))] = Label.MISMATCH
            found[np.isin(place, self._key(clean))] = Label.SIGNAL
        else:
            self._pair(nominal, own, events, origin, number)
            self._share_reference(stage, stage.t_us, is_first)
        self._label.append(found[counted])

    def _pair(
        self,
        nominal: NDArray[np.void],
        own: NDArray[np.void],
        events: NDArray[np.void],
        origin: NDArray[np.int8],
        number: NDArray[np.int64],
    ) -> None:
        """Pair the events of the comparator with steps of the noise-free pixels, of asynchronous pixels."""
        step = self._steps + np.arange(own.size)
        self._steps += own.size
        compared = origin == Origin.COMPARATOR
        cause, effect, asleep = self._of_events.take(
            self._as_steps(own, step), self._as_steps(events[compared], number[compared])
        )
        self._pairs.append((cause, effect))
        for steps in (own, events[compared]):
            self._stepped[self._place(steps)] = True
        first = self._steps - own.size
        self._asleep.append(self._in_run(own[np.sort(asleep) - first]))
        if self._nominal is not None:
            causes = self._as_steps(nominal, np.zeros(nominal.size, np.int64))
            self._nominal_too.append(self._of_own.take(causes, self._as_steps(own, step))[1])

    def finish(self) -> EventLabels:
        """The labels of all events so far."""
        label = np.concatenate(self._label)
        if self._pairs:
            cause, effect = (np.concatenate(values) for values in zip(*self._pairs, strict=True))
            nominal = np.zeros(self._steps, np.bool_)
            if self._nominal is None:
                nominal[:] = True
            else:
                nominal[np.concatenate(self._nominal_too)] = True
            real = effect >= 0
            label[effect[real]] = np.where(nominal[cause[real]], Label.SIGNAL, Label.MISMATCH)
        unread, asleep = np.concatenate(self._unread), np.concatenate(self._asleep)
        lost = np.concatenate([unread, asleep])
        where = np.repeat(np.array([Lost.READOUT, Lost.REFRACTORY], np.uint8), [unread.size, asleep.size])
        order = np.argsort(lost["t_us"], kind="stable")
        return EventLabels(label, lost[order], where[order], np.concatenate(self._clean))

    def _of_run(self, events: NDArray[np.void]) -> NDArray[np.bool_]:
        return (events["t_us"] > self._span[0]) & (events["t_us"] <= self._span[1])

    def _in_run(self, events: NDArray[np.void]) -> NDArray[np.void]:
        return events[self._of_run(events)]

    def _key(self, events: NDArray[np.void]) -> NDArray[np.int64]:
        """A number for each pixel and polarity."""
        return 2 * self._place(events) + (events["polarity"] > 0)

    def _place(self, events: NDArray[np.void]) -> NDArray[np.int64]:
        return events["y"].astype(np.int64) * self._cols + events["x"]

    def _share_reference(self, stage: EvsStage, t_us: int, is_first: bool) -> None:
        """Let noise-free pixels compare with the level of the real one where no step of either waits for its partner.

        Noise moves the level of a real pixel whose two thresholds differ: an event up and one down leave it beside
        where it was, and so does a dead time. The nominal pixel follows the other noise-free one.
        """
        import drjit as dr

        assert self._own is not None
        place = np.flatnonzero(self._stepped)
        idle = place if is_first else place[self._of_events.is_idle(place, t_us)]
        if idle.size == 0:
            return
        self._stepped[idle] = False
        types = jit()
        index = types.UInt32(idle.astype(np.uint32))
        before, now = (dr.gather(types.Float, level.reference, index) for level in (self._own, stage))
        dr.eval(before, now)
        for pixels in filter(None, (self._own, self._nominal)):
            reference = dr.copy(pixels.reference)
            dr.scatter(reference, now if is_first else dr.gather(types.Float, reference, index) + (now - before), index)
            dr.eval(reference)
            pixels.compare_with(reference)

    def _as_steps(self, events: NDArray[np.void], number: NDArray[np.int64]) -> Steps:
        return Steps(events["t_us"], self._place(events), events["polarity"].astype(np.int64), number)

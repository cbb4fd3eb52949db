"""What caused each event: labels by comparison with the same pixels without noise.

Noise-free pixels run beside the real ones and see the same light, some with the nominal thresholds and some with each
pixel's own. They have the bandwidth of the sensor, and no limit of the read-out. Those with nominal thresholds and no
dead time give the noise-free stream. Labels leave in blocks as time goes on; what is held does not grow with it.

With fixed ticks, an event is `signal` if the nominal pixel gives the same event at the same tick, and `mismatch` if
only the one with its own threshold does. Asynchronous pixels give their events a little earlier or later than without
noise. There, an event is paired with the step that the noise-free pixel makes sooner or later, unless the real one goes
back before (`partners`, `balance`). It is `signal` if the nominal threshold gives that step as well (`nominal`), else
`mismatch`. What has no partner is `leak` or `hot` if that process gave it (of a
leak that drifts: at least half of the step), else `noise`.
"""

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device_types import Float
from hesim_render.pixels.evs.events import Label, LabelBlock, Lost, no_events
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.partners import Partners, StepLabels
from hesim_render.pixels.evs.stage import EvsStage

#: Terms that the noise-free stream lacks; the spread of thresholds besides in the nominal ones.
_NOISE = (
    *("shot", "dark_current", "leak", "comparator_noise", "refractory", "readout_limit"),
    *("stuck", "hot", "flickering"),
)


class Labeller:
    """Runs the noise-free pixels beside an `EvsStage`, and labels its events.

    Parameters
    ----------
    noise : the noise model of the stage.
    seed : seed of the stage.
    end_us : events after 0 and up to the end belong to the run, µs.
    """

    def __init__(self, noise: EvsNoise, seed: int, end_us: int) -> None:
        self._cols = noise.layout.evs_shape[1]
        self._end_us = end_us
        nominal, own = noise.without(*_NOISE, "mismatch"), noise.without(*_NOISE)
        alike = isinstance(noise.threshold_on_map, float) and isinstance(noise.threshold_off_map, float)
        #: The noise-free stream, and with ticks the pixels with own thresholds if these differ.
        self._clean_pixels = EvsStage(nominal, seed)
        self._own: EvsStage | None = None
        self._partners: Partners | None = None
        if noise.spec.reference == "last_event":
            kept = [term for term in _NOISE if term != "refractory"]
            self._partners = Partners(noise.without(*kept), None if alike else noise.without(*kept, "mismatch"), seed)
        elif not alike:
            self._own = EvsStage(own, seed)
        self._events = 0
        self._block = [LabelBlock.empty()]

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
        clean = self._clean_pixels.step(electrons, stage.t_us)
        through = np.ones(events.size, np.bool_) if kept is None else kept
        # number of each event in the recording; −1 for those that are not in it
        counted = through & self._of_run(events)
        before = self._events
        number = np.where(counted, before + np.cumsum(counted) - 1, -1)
        self._events += int(np.count_nonzero(counted))
        # first by what made it; then by whether pixels without noise give it as well
        result = np.choose(origin - 1, [Label.NOISE, Label.LEAK, Label.HOT, Label.LEAK, Label.NOISE]).astype(np.uint8)
        step = StepLabels(no_events(), np.empty(0, np.int64), np.empty(0, np.uint8))
        if self._partners is not None:
            step = self._partners.take(stage, electrons, events, origin, number)
        else:
            own = clean if self._own is None else self._own.step(electrons, stage.t_us)
            place = self._key(events)
            result[np.isin(place, self._key(own))] = Label.MISMATCH
            result[np.isin(place, self._key(clean))] = Label.SIGNAL
        result, new = result[counted], step.changed >= before
        result[step.changed[new] - before] = step.changed_to[new]
        # events that the sensor lost: by the read-out, or because a pixel was in its dead time
        unread, asleep = self._in_run(events[~through]), self._in_run(step.asleep)
        lost = np.concatenate([unread, asleep])
        where = np.repeat(np.array([Lost.READOUT, Lost.REFRACTORY], np.uint8), [unread.size, asleep.size])
        order = np.argsort(lost["t_us"], kind="stable")
        changes = step.changed[~new], step.changed_to[~new]
        self._block.append(LabelBlock(result, *changes, lost[order], where[order], self._in_run(clean)))

    def taken(self) -> LabelBlock:
        """The labels since the last call, which are no longer held."""
        every, self._block = self._block, [LabelBlock.empty()]
        names = (field.name for field in fields(LabelBlock))
        return LabelBlock(*(np.concatenate([getattr(block, name) for block in every]) for name in names))

    def _of_run(self, events: NDArray[np.void]) -> NDArray[np.bool_]:
        return (events["t_us"] > 0) & (events["t_us"] <= self._end_us)

    def _in_run(self, events: NDArray[np.void]) -> NDArray[np.void]:
        return events[self._of_run(events)]

    def _key(self, events: NDArray[np.void]) -> NDArray[np.int64]:
        """A number for each pixel and polarity."""
        return 2 * (events["y"].astype(np.int64) * self._cols + events["x"]) + (events["polarity"] > 0)

"""The event stage. It takes one sample per step, keeps the state of each pixel between samples and returns events.

The input of `EvsStage` is the noise-free electrons of each event pixel's window. In ``previous_sample`` mode the
sensor's own tick sets the sample times; in ``last_event`` mode the source may be sampled at any times.

The event read-out is a first-in, first-out buffer that a clocked bus empties.
"""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.errors import RangeError
from hesim_render.core.units import S_PER_US, US_PER_S
from hesim_render.pixels.arrays import restore, saved
from hesim_render.pixels.evs.defects import DefectEvents
from hesim_render.pixels.evs.last_event import LastEvent
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.previous_sample import PreviousSample

#: Rows by which the start of the scan moves per microsecond, as a fraction of all rows: the golden section × 2³².
_GOLDEN = 2654435769


class _Mode(Protocol):
    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        """Events; the size of their polarity is their `Origin`, its sign the polarity itself."""


class Labels(Protocol):
    """Takes all that a step has, to tell later what caused each event; see `EventLabels`."""

    def take(
        self,
        stage: "EvsStage",
        electrons: Float,
        events: NDArray[np.void],
        origin: NDArray[np.int8],
        kept: NDArray[np.bool_] | None,
    ) -> None: ...


class EvsStage:
    """Turns a sequence of samples into events.

    Parameters
    ----------
    noise : the sensor's noise model (`Sensor.evs`, perhaps `without` some terms).
    seed : the events are a pure function of the seed, the device seed, the sample times and the electrons.
    defects : events of defective pixels, where several stages share them; default those of this `seed`.
    labels : takes the events with their origins; it changes none of them.
    is_reset : asynchronous pixels compare with their own level at the first sample, as after a reset of all. Otherwise
        they begin as they are after a long time in the light of that sample.

    Notes
    -----
    ``previous_sample``: each sample is compared with the previous one; there is at most one event per pixel and
    tick, at the sample's time. With ``noise_mode: per_instant`` the noise n_t is drawn once per sample and
    differenced, so successive differences correlate by −½; with ``independent`` N(0, σ_n²) is drawn per
    difference. A leak event is an ON event that comes with probability 1 − exp(−rate·Δt), where the
    comparison itself gave none.

    ``last_event``: the level of the last event is the reference. ln x is linear in time between samples; a
    change of several thresholds gives several events, each at its own crossing, rounded up to whole µs. The
    noise is stationary and band-limited at the photoreceptor's cut-off (`BandNoise`), on time nodes of
    the sensor's own; its time-averaged variance is s²/x² at the current signal; `noise_mode` has no
    meaning. Leak events come as a Poisson process and do not change the reference, or the leak is a drift of the
    reference (`LeakDrift`). The result does not depend on how
    often `step` is called.

    Where the sensor has a photoreceptor, ln x (without its noise) first passes its low-pass, with ln x
    linear in time between samples in both modes. With a refractory period (``last_event``), see `Refractory`; with
    a read-out limit, see `EventReadout`.
    """

    STATE = ("_mode", "_t_us", "_readout")

    def __init__(
        self,
        noise: EvsNoise,
        seed: int,
        defects: DefectEvents | None = None,
        labels: Labels | None = None,
        is_reset: bool = False,
    ) -> None:
        self.noise, self._labels = noise, labels
        has_ticks = noise.spec.reference == "previous_sample"
        if defects is None and noise.defects:
            tick_s = noise.spec.tick_us * S_PER_US if has_ticks and noise.spec.tick_us else None
            defects = DefectEvents(noise.defects, int(seed), tick_s)
        self._mode: _Mode
        if has_ticks:
            self._mode = PreviousSample(noise, int(seed), defects)
        else:
            self._mode = LastEvent(noise, int(seed), defects, is_reset)
        self._t_us: int | None = None
        self._readout: EventReadout | None = None
        if noise.readout_max_events_per_s is not None:
            rows = noise.layout.evs_shape[0]
            self._readout = EventReadout(noise.readout_max_events_per_s, noise.readout_buffer_events, rows)

    def state(self) -> dict[str, Any]:
        """State of the pixels, as plain values and NumPy arrays. A resumed run continues as if it had never stopped."""
        return saved(self)

    def resume(self, state: dict[str, Any]) -> None:
        """Continue from a `state` of a stage with the same sensor, region, terms and seed."""
        restore(self, state)

    @property
    def reference(self) -> Float:
        """Level with which each asynchronous pixel compares, ln x; None before the first sample."""
        assert isinstance(self._mode, LastEvent)
        return self._mode.of_pixel(self._mode.reference)

    @property
    def level(self) -> Float:
        """Level of each asynchronous pixel at the last sample, ln x, with its noise."""
        assert isinstance(self._mode, LastEvent)
        return self._mode.of_pixel(self._mode.level)

    def compare_with(self, reference: Float) -> None:
        """Let the asynchronous pixels compare with other levels, ln x, from now on."""
        assert isinstance(self._mode, LastEvent)
        self._mode.compare_with(reference)

    @property
    def t_us(self) -> int | None:
        """Time of the last sample; None before the first."""
        return self._t_us

    @property
    def dropped(self) -> int:
        """Events lost in the read-out so far."""
        return self._readout.dropped if self._readout is not None else 0

    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        """Take one sample.

        Parameters
        ----------
        electrons : Dr.Jit Float [event pixels], row-major on the event grid: noise-free electrons of the
            window of ``window_us`` that ends at `t_us`.
        t_us : time of the sample, µs, later than that of the previous sample.

        Returns
        -------
        Events since the previous sample, `EVENT_DTYPE`, sorted by time and then row-major. The first sample
        sets the reference and gives none.

        Raises
        ------
        RangeError
            If `t_us` does not increase or the array has another size.
        """
        rows, cols = self.noise.layout.evs_shape
        if dr.width(electrons) != rows * cols:
            raise RangeError("number of event pixels", dr.width(electrons), f"{rows}×{cols}")
        if self._t_us is not None and t_us <= self._t_us:
            raise RangeError("t_us", t_us, f"a time after the last sample, {self._t_us}")
        self._t_us = int(t_us)
        events = self._mode.step(electrons, self._t_us)
        # until here the size of the polarity says where an event comes from, see `labels`
        origin = np.abs(events["polarity"])
        events["polarity"] = np.sign(events["polarity"])
        kept = None if self._readout is None else self._readout.admitted(events)
        if self._labels is not None:
            self._labels.take(self, electrons, events, origin, kept)
        return events if kept is None else events[kept]


def scan_start_row(t_us: NDArray[np.int64], rows: int) -> NDArray[np.int64]:
    """Row at which the arbiter's scan begins at each time: a golden-section (Weyl) sequence over the rows."""
    return ((t_us.astype(np.uint64) * np.uint64(_GOLDEN) % np.uint64(2**32)) * np.uint64(rows) >> np.uint64(32)).astype(
        np.int64
    )


class EventReadout:
    """Which events get through to the outside.

    The bus takes one event at each tick k/rate of its clock from a buffer of `capacity` events. An event
    that finds the buffer full is lost. Events queue by time; events of one microsecond queue by rows, from a row
    that moves on with time (`scan_start_row`), so that no part of the sensor is favoured. An event keeps the
    time at which its pixel fired. The loss of an event does not change the state of its pixel.

    Parameters
    ----------
    rate_hz : events the bus takes per second.
    capacity : events the buffer holds.
    rows : rows of the event grid.

    Attributes
    ----------
    dropped : events lost so far.
    """

    STATE = ("_waiting", "_clock", "dropped")

    def __init__(self, rate_hz: float, capacity: int, rows: int) -> None:
        self._rate_hz, self._capacity, self._rows = float(rate_hz), int(capacity), rows
        self._waiting = 0
        self._clock = 0  # clock ticks up to the last event seen
        self.dropped = 0

    def take(self, events: NDArray[np.void]) -> NDArray[np.void]:
        """The events that get through, in the order given; see `admitted`."""
        return events[self.admitted(events)]

    def admitted(self, events: NDArray[np.void]) -> NDArray[np.bool_]:
        """Whether each event gets through.

        Parameters
        ----------
        events : `EVENT_DTYPE`, sorted by time and then row-major, none before those of earlier calls.
        """
        if events.size == 0:
            return np.zeros(0, np.bool_)
        t_us = events["t_us"].astype(np.int64)
        row = (events["y"] - scan_start_row(t_us, self._rows)) % self._rows
        # the order in which the arbiter serves them
        order = np.lexsort((events["x"], row, t_us))
        clock = np.floor(t_us * self._rate_hz / US_PER_S).astype(np.int64)
        kept = np.empty(events.size, dtype=bool)
        kept[order] = self._admit(clock[order])
        self.dropped += int(np.count_nonzero(~kept))
        return kept

    def _admit(self, clock: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the buffer has room for each event, in order; `clock` [event] is the time in clock ticks."""
        # the bus takes one event a clock tick from what waits
        served = np.diff(clock, prepend=self._clock)
        added = np.cumsum(1 - served)
        # content of the buffer just after each event if it had no limit; it is never negative
        after = added + np.maximum(self._waiting, np.maximum.accumulate(1 - added))
        if after.max() > self._capacity:
            # each event adds 1 to the content left after serving, and the buffer stays within its capacity
            add, low, high = _running(1 - served, np.ones_like(served), np.full_like(served, self._capacity))
            after = np.clip(self._waiting + add, low, high)
        before = np.maximum(np.concatenate([[self._waiting], after[:-1]]) - served, 0)
        self._waiting, self._clock = int(after[-1]), int(clock[-1])
        return before < self._capacity


def _running(
    add: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Each map w → clip(w + add, low, high) after all maps before it, as one such map; log₂ n passes.

    Clips of sums are closed under composition, so the buffer is a prefix scan [hillis1986].

    Parameters
    ----------
    add, low, high : [n], one map each.

    Returns
    -------
    add, low, high : [n], the composed maps.
    """
    reach = 1
    while reach < add.size:
        first = tuple(v[:-reach] for v in (add, low, high))
        second = tuple(v[reach:] for v in (add, low, high))
        together = (
            first[0] + second[0],
            np.clip(first[1] + second[0], second[1], second[2]),
            np.clip(first[2] + second[0], second[1], second[2]),
        )
        add, low, high = (np.concatenate([v[:reach], w]) for v, w in zip((add, low, high), together, strict=True))
        reach *= 2
    return add, low, high

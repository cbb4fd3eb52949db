"""The event stage. It takes one sample per step, keeps the state of each pixel between samples and returns events.

The input of `EvsStage` is the noise-free electrons of each event pixel's window. In ``previous_sample`` mode the
sensor's own tick sets the sample times; in ``last_event`` mode the source may be sampled at any times.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device_types import Float
from hesim_render.core.errors import RangeError
from hesim_render.core.rng import Stream, philox
from hesim_render.core.units import S_PER_US
from hesim_render.pixels.arrays import restore, saved, take
from hesim_render.pixels.evs.defects import DefectEvents
from hesim_render.pixels.evs.events import EVENT_DTYPE, Origin, no_events
from hesim_render.pixels.evs.formulas import leak_probability
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.photoreceptor import Photoreceptor
from hesim_render.pixels.evs.processes import BandNoise, LeakProcess
from hesim_render.pixels.evs.readout import EventReadout
from hesim_render.pixels.evs.refractory import Refractory
from hesim_render.pixels.normal import normal_pair


class _Mode(Protocol):
    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        """Events; the size of their polarity is their `Origin`, its sign the polarity itself."""
        ...


class Labels(Protocol):
    """Takes all that a step has, to tell later what caused each event; see `EventLabels`."""

    def take(
        self,
        stage: EvsStage,
        electrons: Float,
        events: NDArray[np.void],
        origin: NDArray[np.int8],
        kept: NDArray[np.bool_] | None,
    ) -> None: ...


def _events(t_us: ArrayLike, pixel: NDArray[np.integer], polarity: ArrayLike, cols: int) -> NDArray[np.void]:
    """Structured array of events at flat pixel indices of an event grid `cols` wide."""
    events = np.empty(len(pixel), EVENT_DTYPE)
    events["t_us"], events["polarity"] = t_us, polarity
    events["y"], events["x"] = np.divmod(pixel.astype(np.uint32), np.uint32(cols))
    return events


class EvsStage:
    """Turns a sequence of samples into events.

    Parameters
    ----------
    noise : the sensor's noise model (`Sensor.evs`, perhaps `without` some terms).
    seed : the events are a pure function of the seed, the device seed, the sample times and the electrons.
    defects : events of defective pixels, where several stages share them; default those of this `seed`.
    labels : takes the events with their origins; it changes none of them.

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
    meaning. Leak events come as a Poisson process and do not change the reference. The result does not depend on how
    often `step` is called.

    Where the sensor has a photoreceptor, ln x (without its noise) first passes its low-pass, with ln x
    linear in time between samples in both modes. With a refractory period (``last_event``), see `Refractory`; with
    a read-out limit, see `EventReadout`.
    """

    STATE = ("_mode", "_t_us", "_readout")

    def __init__(
        self, noise: EvsNoise, seed: int, defects: DefectEvents | None = None, labels: Labels | None = None
    ) -> None:
        self.noise, self._labels = noise, labels
        has_ticks = noise.spec.reference == "previous_sample"
        if defects is None and noise.defects:
            tick_s = noise.spec.tick_us * S_PER_US if has_ticks and noise.spec.tick_us else None
            defects = DefectEvents(noise.defects, int(seed), tick_s)
        self._mode: _Mode = (_PreviousSample if has_ticks else _LastEvent)(noise, int(seed), defects)
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
        assert isinstance(self._mode, _LastEvent)
        return self._mode._reference

    @property
    def level(self) -> Float:
        """Level of each asynchronous pixel at the last sample, ln x, with its noise."""
        assert isinstance(self._mode, _LastEvent)
        return self._mode._level

    def compare_with(self, reference: Float) -> None:
        """Let the asynchronous pixels compare with other levels, ln x, from now on."""
        assert isinstance(self._mode, _LastEvent)
        self._mode._reference = reference

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
        import drjit as dr

        rows, cols = self.noise.layout.evs_shape
        if dr.width(electrons) != rows * cols:
            raise RangeError("number of event pixels", dr.width(electrons), f"{rows}×{cols}")
        if self._t_us is not None and t_us <= self._t_us:
            raise RangeError("t_us", t_us, f"a time after the last sample, {self._t_us}")
        self._t_us = int(t_us)
        events = self._mode.step(electrons, self._t_us)
        origin = np.abs(events["polarity"])
        events["polarity"] = np.sign(events["polarity"])
        kept = None if self._readout is None else self._readout.admitted(events)
        if self._labels is not None:
            self._labels.take(self, electrons, events, origin, kept)
        return events if kept is None else events[kept]


class _PreviousSample:
    """Compares successive samples."""

    STATE = ("_t_us", "_level", "_variance", "_photoreceptor")

    def __init__(self, noise: EvsNoise, seed: int, defects: DefectEvents | None) -> None:
        self._noise, self._seed, self._defects = noise, seed, defects
        self._cols = noise.layout.evs_shape[1]
        self._independent = noise.spec.noise_mode == "independent"
        self._photoreceptor = Photoreceptor(noise) if noise.photoreceptor else None
        self._t_us = 0
        self._level: Float = None  # ln x, with the noise of its instant where that is shared
        self._variance: Float = None  # s²/x² of the last sample, where noise is independent

    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        import drjit as dr

        types = jit()
        level, variance = self._noise.log_level(electrons)
        if self._photoreceptor:
            level = self._photoreceptor.follow(level, t_us)
        word = philox(self._seed, Stream.EVS, self._noise.on_device.key, t_us).next_uint32x4()
        deviate = normal_pair(word[0], word[1])[0]
        if not self._independent:
            level = dr.fma(dr.sqrt(variance), deviate, level)
        if self._level is None:
            self._keep(level, variance, t_us)
            return no_events()
        change = level - self._level
        if self._independent:
            change = dr.fma(dr.sqrt(variance + self._variance), deviate, change)
        theta_on, theta_off = self._noise.on_device.thresholds
        on, off = change > theta_on, change < -theta_off
        polarity = dr.select(on, types.Int8(1), dr.select(off, types.Int8(-1), types.Int8(0)))
        if self._noise.leak_rate_hz > 0:
            probability = leak_probability(self._noise.leak_rate_hz, (t_us - self._t_us) * S_PER_US)
            leaks = word[2] < dr.opaque(types.UInt32, min(round(probability * 2**32), 2**32 - 1))
            polarity = dr.select(~on & ~off & leaks, types.Int8(Origin.LEAK), polarity)
        begin_us = self._t_us
        dr.schedule(polarity)
        self._keep(level, variance, t_us)
        found = polarity.numpy()
        if self._defects is not None:
            found = self._defects.at_tick(found, begin_us, t_us)
        pixel = np.flatnonzero(found != 0)  # in row-major order
        return _events(t_us, pixel, found[pixel], self._cols)

    def _keep(self, level: Float, variance: Float, t_us: int) -> None:
        import drjit as dr

        self._t_us, self._level = t_us, level
        if self._independent:
            self._variance = variance
            dr.schedule(variance)
        dr.eval(self._level)


class _LastEvent:
    """Keeps the level of each pixel's last event."""

    STATE: tuple[str, ...] = (
        *("_t_us", "_log", "_spread", "_level", "_reference"),
        *("_band_noise", "_photoreceptor", "_refractory", "_leak"),
    )

    def __init__(self, noise: EvsNoise, seed: int, defects: DefectEvents | None) -> None:
        self._noise, self._defects = noise, defects
        self._cols = noise.layout.evs_shape[1]
        self._t_us = 0
        self._log: Float = None  # ln x of the last sample
        self._spread: Float = None  # s/x of the last sample
        self._level: Float = None  # ln x with its noise, at the end of the last segment
        self._reference: Float = None  # level of the last event
        self._photoreceptor = Photoreceptor(noise) if noise.photoreceptor else None
        self._band_noise: BandNoise | None = None
        if not noise.is_noiseless:
            self._band_noise = BandNoise(noise, seed, self._photoreceptor if noise.filters_noise else None)
        self._refractory: Refractory | None = None
        if noise.refractory_period_us is not None:
            self._refractory = Refractory(noise.refractory_period_us, math.prod(noise.layout.evs_shape))
        self._leak = LeakProcess(noise, seed) if noise.leak_rate_hz > 0 else None

    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        import drjit as dr

        parts: list[NDArray[np.void]] = []
        log, variance = self._noise.log_level(electrons)
        spread = dr.sqrt(variance)
        dr.eval(log, spread)
        if self._log is None:
            start = self._photoreceptor.start(log, t_us) if self._photoreceptor else log
            self._level = start + (spread * self._band_noise.start(t_us) if self._band_noise else 0.0)
            self._reference = dr.copy(self._level)
            dr.eval(self._level, self._reference)
            if self._leak:
                self._leak.start(t_us)
        else:
            begin_us = float(self._t_us)
            for end_us in self._nodes_us(t_us):
                part = dr.opaque(jit().Float, (end_us - self._t_us) / (t_us - self._t_us))
                level = dr.fma(log - self._log, part, self._log)
                if self._photoreceptor:
                    level = self._photoreceptor.to(level, end_us)
                if self._band_noise:
                    level = dr.fma(
                        dr.fma(spread - self._spread, part, self._spread), self._band_noise.at(end_us), level
                    )
                parts.append(self._crossings(level, begin_us, end_us))
                begin_us = end_us
            if self._leak and not self._refractory:
                for due_us, pixel in self._leak.until(t_us):
                    parts.append(_events(self._stamp(due_us), pixel, Origin.LEAK, self._cols))
            if self._defects and not self._refractory:
                own_us, pixel, polarity = self._defects.between(self._t_us, t_us)
                parts.append(_events(self._stamp(own_us), pixel, polarity * Origin.DEFECT, self._cols))
        self._t_us, self._log, self._spread = t_us, log, spread
        events = np.concatenate(parts) if parts else no_events()
        if self._defects:
            events = self._defects.alive(events, self._cols)
        # stable: the events of a pixel in one microsecond keep their order
        return events[np.lexsort((events["x"], events["y"], events["t_us"]))]

    def _nodes_us(self, t_us: int) -> list[float]:
        """Ends of the segments up to the sample at `t_us`, in each of which the level goes on a straight line."""
        grids = [grid.nodes_us(t_us) for grid in (self._band_noise, self._photoreceptor) if grid]
        return [*sorted(set().union(*grids)), float(t_us)]

    def _stamp(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whole µs after the last sample: the end of the microsecond of each event, so that steps do not overlap."""
        return np.maximum(np.ceil(t_us), self._t_us + 1)

    def _crossings(self, level: Float, begin_us: float, end_us: float) -> NDArray[np.void]:
        """Events of one segment in which the level goes on a straight line to `level`, unsorted."""
        import drjit as dr

        if self._refractory:
            return self._crossings_with_dead_time(self._refractory, level, begin_us, end_us)
        types = jit()
        theta_on, theta_off = self._noise.on_device.thresholds
        distance = level - self._reference
        theta = dr.select(distance > 0, theta_on, theta_off)
        crossed = dr.mulsign(dr.floor(dr.abs(distance) / theta), distance)  # thresholds, with the direction
        reference = dr.fma(crossed, theta, self._reference)
        dr.eval(level, reference, crossed)
        before = self._reference, self._level
        self._reference, self._level = reference, level
        found = np.flatnonzero(crossed.numpy())
        if len(found) == 0:
            return no_events()
        pixel = types.UInt32(found.astype(np.uint32))
        gathered = [dr.gather(types.Float, value, pixel) for value in (crossed, *before, level)]
        gathered.append(dr.select(gathered[0] > 0, take(theta_on, pixel), -take(theta_off, pixel)))
        dr.eval(gathered)
        count, *values = (np.array(value).astype(np.float64) for value in gathered)
        repeats = np.abs(count).astype(np.int64)
        number = np.arange(1, repeats.sum() + 1) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        reference_0, level_0, level_1, theta_signed = (np.repeat(value, repeats) for value in values)
        travel = level_1 - level_0
        # a crossing that rounding moved out of the previous segment is due at once
        part = (reference_0 + number * theta_signed - level_0) / np.where(travel == 0, np.inf, travel)
        t_us = begin_us + np.clip(part, 0.0, 1.0) * (end_us - begin_us)
        return _events(self._stamp(t_us), np.repeat(found, repeats), np.sign(theta_signed), self._cols)

    def _crossings_with_dead_time(
        self, refractory: Refractory, level: Float, begin_us: float, end_us: float
    ) -> NDArray[np.void]:
        """Events of one segment where pixels rest after each event, including leak events. Both kinds are returned
        together.

        Parameters
        ----------
        refractory : dead time of the pixels.
        level : level at the end of the segment, one value per pixel.
        begin_us, end_us : bounds of the segment, µs.
        """
        due = [(np.empty(0), np.empty(0, np.uint32)), *(self._leak.until(end_us) if self._leak else ())]
        origins = [np.full(len(part[0]), Origin.LEAK, np.float64) for part in due]
        if self._defects:  # of asynchronous sensors they are ON events, as those of leak
            due.append(self._defects.between(begin_us, end_us)[:2])
            origins.append(np.full(len(due[-1][0]), Origin.DEFECT, np.float64))
        due_us, due_pixel = (np.concatenate(values) for values in zip(*due, strict=True))
        levels, thresholds = (self._level, level), self._noise.on_device.thresholds
        self._reference, t_us, pixel, polarity = refractory.crossings(
            self._reference, levels, thresholds, begin_us, end_us, (due_us, due_pixel, np.concatenate(origins))
        )
        self._level = level
        return _events(self._stamp(t_us), pixel, polarity, self._cols)

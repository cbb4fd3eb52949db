"""Asynchronous event pixels: each compares its level with that of its last event."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float
from hesim_render.core.host_arrays import from_host, spread_out
from hesim_render.core.rng import Stream
from hesim_render.pixels.arrays import take
from hesim_render.pixels.evs.crossings import DueEvents, events_on_paths, listed
from hesim_render.pixels.evs.defects import DefectEvents
from hesim_render.pixels.evs.events import Origin, events_at, no_events
from hesim_render.pixels.evs.leak_drift import LeakDrift
from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.pixels.evs.photoreceptor import Instant, Photoreceptor
from hesim_render.pixels.evs.processes import BandNoise, RandomEvents
from hesim_render.pixels.evs.refractory import LONG_AGO_US, Refractory
from hesim_render.pixels.evs.start import start_chances, start_of

#: Periods of the noise in still light before the first sample, in which noise and level of comparison become those of
#: one another.
_SETTLING_PERIODS = 4

#: Share of a threshold by which a level must stay below it to count as far from it: rounding is smaller.
_MARGIN_REL = 1e-4
#: Pixels that are followed at a time.
_PATHS = 1 << 18
#: Processes of events at random times: the polarity times the `Origin` of their events, and their random numbers.
_RANDOM = {
    int(Origin.LEAK): Stream.EVS_LEAK,
    int(Origin.COMPARATOR_NOISE): Stream.COMPARATOR_ON,
    -int(Origin.COMPARATOR_NOISE): Stream.COMPARATOR_OFF,
}


class LastEvent:
    """Keeps the level of each pixel's last event."""

    STATE: tuple[str, ...] = (
        *("_t_us", "_log", "_spread", "level", "reference"),
        *("_band_noise", "_photoreceptor", "_refractory", "_leak", "_own_on", "_own_off", "_drift"),
    )

    def __init__(self, noise: EvsNoise, seed: int, defects: DefectEvents | None, is_reset: bool) -> None:
        self._noise, self._seed, self._defects, self._is_reset = noise, seed, defects, is_reset
        self._cols, self._pixels = noise.layout.evs_shape[1], math.prod(noise.layout.evs_shape)
        self._t_us = 0
        self._log: Float = None  # ln x of the last sample
        self._spread: Float = None  # s/x of the last sample
        self.level: Float = None  # ln x with its noise, at the end of the last segment
        self.reference: Float = None  # level of the last event
        self._photoreceptor = Photoreceptor(noise) if noise.photoreceptor else None
        self._band_noise: BandNoise | None = None
        if not noise.is_noiseless:
            self._band_noise = BandNoise(noise, seed, self._photoreceptor if noise.filters_noise else None)
        self._refractory: Refractory | None = None
        if noise.refractory_period_us is not None:
            self._refractory = Refractory(noise.refractory_period_us, self._pixels)
        self._leak, self._own_on, self._own_off = (
            RandomEvents(noise.on_device.key, seed, stream, rate_hz) if rate_hz > 0 else None
            for stream, rate_hz in zip(_RANDOM.values(), (noise.leak_rate_hz, *noise.comparator_noise_hz), strict=True)
        )
        #: Events at random times, by the polarity times the `Origin` of each.
        self._random = {
            origin: process
            for origin, process in zip(_RANDOM, (self._leak, self._own_on, self._own_off), strict=True)
            if process
        }
        self._drift = LeakDrift(noise) if noise.leak_drift is not None else None

    def of_pixel(self, level: Float) -> Float:
        """A level of this stage, which the drift of the leak has raised, as ln x."""
        return level if self._drift is None or level is None else level - self._drift.way

    def compare_with(self, reference: Float) -> None:
        """Let the pixels compare with other levels, ln x."""
        self.reference = reference if self._drift is None else reference + self._drift.way

    def step(self, electrons: Float, t_us: int) -> NDArray[np.void]:
        log, variance = self._noise.log_level(electrons)
        spread = dr.sqrt(variance)
        dr.eval(log, spread)
        if self._log is None:
            self._start(electrons, log, spread, t_us)
            return no_events()
        return self._go_on(electrons, log, spread, t_us)

    def _start(self, electrons: Float, log: Float, spread: Float, t_us: int) -> None:
        """Begin in still light: where noise makes events, as pixels are after a long time in it, or all at a reset."""
        # without noise, or after a reset, all pixels begin with the level of the first sample
        settles = self._band_noise is not None and not self._is_reset
        self._t_us = t_us - self._band_noise.periods_us(_SETTLING_PERIODS) if settles and self._band_noise else t_us
        start = self._photoreceptor.start(log, self._t_us) if self._photoreceptor else log
        self.level = start + (spread * self._band_noise.start(self._t_us) if self._band_noise else 0.0)
        self.reference = dr.copy(self.level)
        for process in self._random.values():
            process.start(self._t_us)
        self._log, self._spread = log, spread
        events_hz, chance = np.zeros(self._pixels), None
        if self._band_noise and settles:
            count = self._pixels
            share = self._band_noise.share(count)
            # reference and dead time of each pixel are drawn from the stationary law of its light
            spreads = np.broadcast_to(spread.numpy(), count)
            begin = start_of(self._noise, self._seed, spreads, share, self._band_noise.angle)
            self.reference = dr.fma(spread, from_host(jit().Float, begin.reference), log)
            if self._refractory:
                self._refractory.begin(np.where(begin.dead_us > 0, self._t_us + begin.dead_us, LONG_AGO_US))
            events_hz, chance = begin.events_hz, begin.chance
        if self._drift:
            if chance is None:
                chance = start_chances(self._noise, self._seed)[2]
            self._drift.start(electrons, self._is_reset, events_hz, chance)
            self.level = self.level + self._drift.way
        dr.eval(self.level, self.reference)
        if self._t_us < t_us:
            self._go_on(electrons, log, spread, t_us)

    def _go_on(self, electrons: Float, log: Float, spread: Float, t_us: int) -> NDArray[np.void]:
        """Events up to the sample at `t_us`."""
        parts: list[NDArray[np.void]] = []
        begin_us = float(self._t_us)
        low_pass = self._photoreceptor
        if low_pass and low_pass.rests(log, t_us):
            low_pass = None
        # between two nodes of the noise everything goes on straight lines, but for what the photoreceptor bends
        for end_us in [*(self._band_noise.nodes_us(t_us) if self._band_noise else ()), float(t_us)]:
            part = dr.opaque(jit().Float, (end_us - self._t_us) / (t_us - self._t_us))
            # ln x on a line from sample to sample, then through the filter
            level = dr.fma(log - self._log, part, self._log)
            # the photoreceptor at the begin, and its nodes on the way
            begin, bends_us = (low_pass.now, low_pass.nodes_us(end_us)) if low_pass else (None, [])
            if low_pass:
                level = low_pass.to(level, end_us)
            if self._band_noise:
                level = dr.fma(dr.fma(spread - self._spread, part, self._spread), self._band_noise.at(end_us), level)
            if self._drift:
                elapsed_us = end_us - self._t_us
                level = level + self._drift.at(electrons, elapsed_us / (t_us - self._t_us), elapsed_us)
            if low_pass and begin and bends_us:
                parts.append(self._crossings_on_curves(low_pass, begin, level, [begin_us, *bends_us, end_us]))
            else:
                parts.append(self._crossings(level, begin_us, end_us))
            begin_us = end_us
        beside: list[NDArray[np.void]] = []  # events that leave the reference as it is, which the drift must not count
        if not self._refractory:
            for origin, process in self._random.items():
                into = beside if self._drift else parts
                for due_us, pixel in process.until(t_us):
                    into.append(events_at(self._stamp(due_us), pixel, origin, self._cols))
        if self._defects and not self._refractory:
            own_us, pixel, polarity = self._defects.between(self._t_us, t_us)
            parts.append(events_at(self._stamp(own_us), pixel, polarity * Origin.DEFECT, self._cols))
        events = np.concatenate(parts)
        if self._drift:
            events = events[np.argsort(events["t_us"], kind="stable")]
            # a long way of the drift is taken off level and reference together, so that float32 keeps small steps
            lower = from_host(jit().Float, self._drift.pass_by(events, self._cols, electrons, self._t_us, t_us))
            self.level, self.reference = self.level - lower, self.reference - lower
            dr.eval(self.level, self.reference)
        events = np.concatenate([events, *beside])
        self._t_us, self._log, self._spread = t_us, log, spread
        if self._defects:
            events = self._defects.alive(events, self._cols)
        # stable: the events of a pixel in one microsecond keep their order
        return events[np.lexsort((events["x"], events["y"], events["t_us"]))]

    def _stamp(self, t_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Whole µs after the last sample: the end of the microsecond of each event, so that steps do not overlap."""
        return np.maximum(np.ceil(t_us), self._t_us + 1)

    def _crossings(self, level: Float, begin_us: float, end_us: float) -> NDArray[np.void]:
        """Events of one segment in which the level goes on a straight line to `level`, unsorted."""
        if self._refractory:
            return self._crossings_with_dead_time(self._refractory, level, begin_us, end_us)
        types = jit()
        theta_on, theta_off = self._noise.on_device.thresholds
        # [pixel]; the threshold of the direction in which the level went
        distance = level - self.reference
        theta = dr.select(distance > 0, theta_on, theta_off)
        crossed = dr.mulsign(dr.floor(dr.abs(distance) / theta), distance)  # thresholds, with the direction
        reference = dr.fma(crossed, theta, self.reference)
        dr.eval(level, reference, crossed)
        before = self.reference, self.level
        self.reference, self.level = reference, level
        result = np.flatnonzero(crossed.numpy())
        if len(result) == 0:
            return no_events()
        # only pixels with an event go to the host
        pixel = from_host(types.UInt32, result)
        gathered = [dr.gather(types.Float, value, pixel) for value in (crossed, *before, level)]
        gathered.append(dr.select(gathered[0] > 0, take(theta_on, pixel), -take(theta_off, pixel)))
        dr.eval(gathered)
        count, *values = (np.array(value).astype(np.float64) for value in gathered)
        # a pixel that crosses k thresholds has k events: number 1 to k of each, [event]
        repeats = np.abs(count).astype(np.int64)
        number = np.arange(1, repeats.sum() + 1) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        reference_0, level_0, level_1, theta_signed = (np.repeat(value, repeats) for value in values)
        # part of the segment at which the line reaches the threshold of that number
        travel = level_1 - level_0
        # a crossing that rounding moved out of the previous segment is due at once
        part = (reference_0 + number * theta_signed - level_0) / np.where(travel == 0, np.inf, travel)
        t_us = begin_us + np.clip(part, 0.0, 1.0) * (end_us - begin_us)
        return events_at(self._stamp(t_us), np.repeat(result, repeats), np.sign(theta_signed), self._cols)

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
        levels, thresholds = (self.level, level), self._noise.on_device.thresholds
        self.reference, t_us, pixel, polarity = refractory.crossings(
            self.reference, levels, thresholds, begin_us, end_us, self._due(begin_us, end_us)
        )
        self.level = level
        return events_at(self._stamp(t_us), pixel, polarity, self._cols)

    def _crossings_on_curves(
        self, low_pass: Photoreceptor, begin: Instant, level: Float, nodes_us: list[float]
    ) -> NDArray[np.void]:
        """Events of one segment in which the photoreceptor bends the levels, unsorted.

        Both poles are low-passes: until the end y stays between the least and the largest of its own begin, that of
        the first pole, and the light at both ends. Only pixels that may come to a threshold within these bounds are
        followed from node to node.

        Parameters
        ----------
        low_pass : the photoreceptor, at the end.
        begin : the photoreceptor at the begin.
        level : level of each pixel at the end.
        nodes_us : times of the begin, of the nodes and of the end, µs.
        """
        types, times_us = jit(), np.array(nodes_us)
        due, end = self._due(nodes_us[0], nodes_us[-1]), low_pass.now
        # noise and drift go on a line
        first, last = self.level - (begin.log + begin.y), level - (end.log + end.y)
        levels = begin.log, end.log, begin.log + begin.y, begin.log + begin.z
        lowest, highest = dr.minimum(first, last), dr.maximum(first, last)
        below = dr.minimum(dr.minimum(*levels[:2]), dr.minimum(*levels[2:])) + lowest - self.reference
        above = dr.maximum(dr.maximum(*levels[:2]), dr.maximum(*levels[2:])) + highest - self.reference
        on, off = (theta * (1 - _MARGIN_REL) for theta in self._noise.on_device.thresholds)
        near = (above >= on) | (below <= -off)
        if self._refractory:
            near = self._refractory.may_fire(near, nodes_us[0], nodes_us[-1])
        dr.eval(level, first, last, near, on, off)
        before, self.level = self.level, level
        every = listed(np.array(near), due)
        is_due = np.zeros(self._pixels, np.bool_)
        is_due[due[1]] = True
        parts = [no_events()]
        for pixel in np.split(every, range(_PATHS, every.size, _PATHS)) if every.size else ():
            index = from_host(types.UInt32, pixel)
            line = take(first, index), take(last, index)
            curve, least, most = low_pass.along(begin, end.log, index, times_us[1:], line)
            own = take(self.reference, index)
            crosses = (most - own >= take(on, index)) | (least - own <= -take(off, index))
            if self._refractory:
                crosses = self._refractory.may_fire(crosses, nodes_us[0], nodes_us[-1], index)
            dr.eval(curve, crosses)
            # only paths with an event or a new reference go to the host
            kept = np.flatnonzero(np.array(crosses) | is_due[pixel]).astype(np.uint32)
            if kept.size:
                start = np.array(take(before, from_host(types.UInt32, pixel[kept])))
                followed = np.array(_columns(curve, kept, pixel.size, len(times_us) - 1)).reshape(-1, kept.size)
                paths = np.concatenate([start[None], followed])
                parts.append(self._events_on_paths(pixel[kept], paths, times_us, due))
        dr.eval(self.reference)
        return np.concatenate(parts)

    def _events_on_paths(
        self, pixel: NDArray[np.uint32], paths: NDArray[np.float32], times_us: NDArray[np.float64], due: DueEvents
    ) -> NDArray[np.void]:
        """Events of some pixels, whose references go on with them; see `events_on_paths`."""
        types = jit()
        index = from_host(types.UInt32, pixel)
        own = np.array(take(self.reference, index)).astype(np.float64)
        on, off = (
            np.broadcast_to(np.array(take(theta, index)), own.shape).astype(np.float64)
            for theta in self._noise.on_device.thresholds
        )
        given = pixel, paths, times_us, own, (on, off), due
        if self._refractory:
            own, t_us, fired, polarity = self._refractory.crossings_on_curves(*given)
        else:
            own, _, t_us, fired, polarity = events_on_paths(*given, np.full(own.size, LONG_AGO_US), None)
        dr.scatter(self.reference, from_host(types.Float, own), index)
        return events_at(self._stamp(t_us), fired, polarity, self._cols)

    def _due(self, begin_us: float, end_us: float) -> DueEvents:
        """Leak events, events of comparators and of defects of one segment, where pixels rest after them."""
        due: list[Any] = [(np.empty(0), np.empty(0, np.uint32))]
        origins = [np.empty(0)]
        if not self._refractory:
            return *due[0], origins[0]  # they leave the reference as it is
        for origin, process in self._random.items():
            for part in process.until(end_us):
                due.append(part)
                origins.append(np.full(len(part[0]), origin, np.float64))
        if self._defects:  # of asynchronous sensors they are ON events, as those of leak
            due.append(self._defects.between(begin_us, end_us)[:2])
            origins.append(np.full(len(due[-1][0]), Origin.DEFECT, np.float64))
        # leaks and defects end or lengthen dead times, so that all events are taken together
        t_us, pixel = (np.concatenate(values) for values in zip(*due, strict=True))
        return t_us, pixel, np.concatenate(origins)


def _columns(values: Float, chosen: NDArray[np.uint32], columns: int, rows: int) -> Float:
    """Some columns of a table that is stored row by row."""
    types = jit()
    entry, width = dr.arange(types.UInt32, rows * chosen.size), dr.opaque(types.UInt32, chosen.size)
    row = entry // width
    column = spread_out(types.UInt32, chosen, entry - row * width)
    return dr.gather(types.Float, values, row * dr.opaque(types.UInt32, columns) + column)

"""Waveforms of a light's power, with time mean 1 and the exact mean over any interval.

A waveform w multiplies a light's mean level, so its own time mean is 1: over a period, or over a table that
does not repeat. All times are in µs. The functions take arrays, so that every row of a rolling shutter
has its own interval.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.units import US_PER_S

#: Largest deviation of ln w from straight lines between the times of `follow_us`.
FOLLOW_TOLERANCE = 0.002
#: Least number of steps in a period of a smooth waveform; largest number in a segment of a table.
_LEAST_STEPS, _MOST_TABLE_STEPS = 32, 64
#: Power over the mean below which relative changes are ignored.
_FLOOR = 0.02


class Waveform(Protocol):
    """Power of a light over its time mean."""

    @property
    def is_constant(self) -> bool:
        """True if it is 1 at all times."""

    @property
    def highest(self) -> float:
        """Highest value, 1 or more."""

    def mean(self, begin_us: ArrayLike, end_us: ArrayLike) -> NDArray[np.float64]:
        """Mean over each interval in closed form, arrays of any compatible shapes; the value at `begin_us` if it is
        empty.
        """

    def follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval between which ln w is linear to `FOLLOW_TOLERANCE`; jumps are included."""

    def jumps_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times strictly inside an interval at which w jumps."""


def _inside(times_us: NDArray[np.float64], begin_us: float, end_us: float) -> NDArray[np.float64]:
    return times_us[(times_us > begin_us) & (times_us < end_us)]


def _every_period(
    place: NDArray[np.float64], period_us: float, zero_us: float, begin_us: float, end_us: float
) -> NDArray[np.float64]:
    """Times strictly inside an interval at the places 0 … 1 of every period; one period starts at `zero_us`."""
    first, last = np.floor((begin_us - zero_us) / period_us), np.ceil((end_us - zero_us) / period_us)
    cycles = np.arange(first, last + 1)[:, None] + place[None, :]
    return _inside(zero_us + period_us * np.unique(cycles), begin_us, end_us)


@dataclass(frozen=True)
class Mains:
    """A lamp on alternating current: w(t) = 1 + depth · cos(2π · 2 f t + phase), f the mains frequency.

    Power is proportional to the square of the voltage, so it has twice its frequency. The mean over [a, b] is
    1 + depth · sinc(2 f (b − a)) · cos(2π f (a + b) + phase), with sinc x = sin(πx)/(πx).

    Parameters
    ----------
    frequency_hz : mains frequency, 50 or 60 Hz.
    depth : (max − min)/(max + min), 0 to 1.
    phase_deg : phase of the light at t = 0, degrees.
    """

    frequency_hz: float
    depth: float
    phase_deg: float = 0.0

    @property
    def is_constant(self) -> bool:
        return self.depth == 0

    @property
    def highest(self) -> float:
        return 1 + self.depth

    def mean(self, begin_us: ArrayLike, end_us: ArrayLike) -> NDArray[np.float64]:
        """See `Waveform.mean`."""
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        cycles = self.frequency_hz / US_PER_S * (begin + end) + self.phase_deg / 360
        span = 2 * self.frequency_hz / US_PER_S * (end - begin)
        return 1 + self.depth * np.sinc(span) * np.cos(2 * np.pi * np.mod(cycles, 1.0))

    def follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """See `Waveform.follow_us`."""
        if self.is_constant:
            return np.empty(0)
        # |d² ln w/dφ²| is largest in the minimum, d/(1 − d); the deviation from a chord over h is h²/8 times that
        curvature = self.depth / max(1 - self.depth, _FLOOR)
        wanted = np.ceil(2 * np.pi * np.sqrt(curvature / (8 * FOLLOW_TOLERANCE)))
        steps = max(int(wanted), _LEAST_STEPS)
        period_us = US_PER_S / (2 * self.frequency_hz)
        return _every_period(np.arange(steps) / steps, period_us, 0.0, begin_us, end_us)

    def jumps_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """No jumps."""
        return np.empty(0)


@dataclass(frozen=True)
class Pwm:
    """A light switched on and off: w = 1/duty where frac(f t + phase/360°) < duty, else 0.

    Parameters
    ----------
    frequency_hz : switching frequency, Hz.
    duty : part of each period in which it is on, above 0 to 1.
    phase_deg : phase at t = 0, degrees; at 0 it has just been switched on.
    """

    frequency_hz: float
    duty: float
    phase_deg: float = 0.0

    @property
    def is_constant(self) -> bool:
        return self.duty == 1

    @property
    def highest(self) -> float:
        return 1 / self.duty

    def _on(self, cycles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Time switched on since the begin of a period, in periods."""
        whole = np.floor(cycles)
        return whole * self.duty + np.minimum(cycles - whole, self.duty)

    def mean(self, begin_us: ArrayLike, end_us: ArrayLike) -> NDArray[np.float64]:
        """See `Waveform.mean`."""
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        start = np.mod(self.frequency_hz / US_PER_S * begin + self.phase_deg / 360, 1.0)
        span = self.frequency_hz / US_PER_S * (end - begin)
        start, span = np.broadcast_arrays(start, span)
        now = np.where(start < self.duty, 1 / self.duty, 0.0)
        # time that it is on in the interval; of an instant, the power then
        total = (self._on(start + span) - self._on(start)) / self.duty
        return np.divide(total, span, out=now, where=span > 0)

    def follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """The jumps: between them w is constant."""
        return self.jumps_us(begin_us, end_us)

    def jumps_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Every switching on and off."""
        if self.is_constant:
            return np.empty(0)
        period_us = US_PER_S / self.frequency_hz
        zero_us = -period_us * self.phase_deg / 360
        return _every_period(np.array([0.0, self.duty]), period_us, zero_us, begin_us, end_us)


@dataclass(frozen=True)
class TableWaveform:
    """Measured power, linear between its samples and divided by its own time mean.

    Parameters
    ----------
    t_us : strictly increasing, 2 or more.
    value : power at those times in any unit, 0 or more and not 0 throughout.
    repeat : start over after the last sample (a jump where it differs from the first); else the first and the
        last value hold outside the table.
    """

    t_us: tuple[float, ...]
    value: tuple[float, ...]
    repeat: bool = False
    _times: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _power: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _before: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        times = np.array(self.t_us, dtype=np.float64) - self.t_us[0]
        power = np.array(self.value, dtype=np.float64)
        power = power / (np.trapezoid(power, times) / times[-1])
        before = np.concatenate([[0.0], np.cumsum(np.diff(times) * (power[1:] + power[:-1]) / 2)])
        for name, array in (("_times", times), ("_power", power), ("_before", before)):
            object.__setattr__(self, name, array)

    @property
    def is_constant(self) -> bool:
        return bool(np.ptp(self._power) == 0)

    @property
    def highest(self) -> float:
        return float(self._power.max())

    def _integral(self, local_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """∫ w from the first sample on, µs; `local_us` is relative to that sample and may lie outside the table."""
        times, power = self._times, self._power
        place = np.clip(np.searchsorted(times, local_us, side="right") - 1, 0, times.size - 2)
        # inside the table the integral of straight lines, outside that of the held end
        held = np.clip(local_us, 0.0, times[-1])
        since = held - times[place]
        slope = (power[place + 1] - power[place]) / (times[place + 1] - times[place])
        outside = np.where(local_us < 0, power[0], power[-1]) * (local_us - held)
        return self._before[place] + since * (power[place] + 0.5 * slope * since) + outside

    def mean(self, begin_us: ArrayLike, end_us: ArrayLike) -> NDArray[np.float64]:
        """See `Waveform.mean`."""
        begin, end = np.asarray(begin_us, dtype=np.float64), np.asarray(end_us, dtype=np.float64)
        begin, end = np.broadcast_arrays(begin, end)
        span, period_us = end - begin, self._times[-1]
        start, whole = begin - self.t_us[0], np.zeros(begin.shape)
        if self.repeat:
            start = np.mod(start, period_us)
            # whole periods have the integral of the table, the rest is looked up
            whole = np.floor((start + span) / period_us)
        now = np.array(np.interp(start, self._times, self._power))
        total = whole * self._before[-1] + self._integral(start + span - whole * period_us) - self._integral(start)
        return np.divide(total, span, out=now, where=span > 0)

    def follow_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """See `Waveform.follow_us`: its samples, and steps between those where it changes much."""
        if self.is_constant:
            return np.empty(0)
        change = np.abs(np.diff(self._power))
        least = np.maximum(np.minimum(self._power[1:], self._power[:-1]), _FLOOR)
        # along a straight line ln w has the curvature (slope/w)²
        wanted = np.ceil(change / (least * np.sqrt(8 * FOLLOW_TOLERANCE)))
        steps = np.clip(wanted, 1, _MOST_TABLE_STEPS).astype(int)
        parts = [
            np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(self._times[:-1], self._times[1:], steps, strict=True)
        ]
        times = np.concatenate([*parts, self._times[-1:]])
        if self.repeat:
            return _every_period(times / times[-1], times[-1], self.t_us[0], begin_us, end_us)
        return _inside(times + self.t_us[0], begin_us, end_us)

    def jumps_us(self, begin_us: float, end_us: float) -> NDArray[np.float64]:
        """Times at which a repeating table starts again with another value."""
        if not self.repeat or self._power[0] == self._power[-1]:
            return np.empty(0)
        return _every_period(np.zeros(1), self._times[-1], self.t_us[0], begin_us, end_us)

"""Rates of pixels that misbehave, per second, from what captures tell: chances per comparison, correlations per frame.

A calibration holds rates per second, so that a sensor behaves the same at any tick and frame rate. Those of
captures whose interval nobody stated hold values per interval. They are converted with the interval that the section
states (`tick_us`, `frame_rate_hz`), else with that of the sensor file that names the calibration.

`EventDefectRates` and `TelegraphRates` are the rates of a sensor; ``…PerTrial`` and ``…PerFrame`` are what captures
tell. Each of them knows the names of its maps in the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray


def rate_hz(probability: ArrayLike, interval_s: float) -> NDArray[np.float64]:
    """Rate of the Poisson process that gives an event in an interval with this probability, Hz.

    Parameters
    ----------
    probability : probability of an event; 1 is taken as 1 − 1e-9.
    interval_s : Δt, s.
    """
    return -np.log1p(-np.clip(probability, 0.0, 1.0 - 1e-9)) / interval_s


def change_hz(correlation: ArrayLike, interval_s: float) -> NDArray[np.float64]:
    """Rate at which a telegraph signal forgets its state, from the correlation of the state over an interval, Hz.

    Parameters
    ----------
    correlation : exp(−rate·Δt), taken to lie 1e-9 inside of 0 and 1.
    interval_s : Δt, s.
    """
    return -np.log(np.clip(correlation, 1e-9, 1.0 - 1e-9)) / interval_s


@dataclass(frozen=True, eq=False)
class RateMaps:
    """Maps of one file, all of one shape; `PREFIX` and the name of a field are the name of its map."""

    PREFIX: ClassVar[str]

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the maps in a file."""
        return tuple(f"{cls.PREFIX}{field.name}" for field in fields(cls))

    @classmethod
    def of(cls, maps: Mapping[str, NDArray]) -> Self:
        """From the maps of a file.

        Raises
        ------
        KeyError
            If one of them is not there.
        """
        return cls(*(maps[name] for name in cls.names()))

    def maps(self) -> dict[str, NDArray]:
        """{name in the file: array}."""
        return dict(zip(self.names(), (getattr(self, field.name) for field in fields(self)), strict=True))


@dataclass(frozen=True, eq=False)
class TelegraphRates(RateMaps):
    """Random telegraph noise of frame pixels, [row, col].

    Attributes
    ----------
    amplitude_dn : high level minus low level, DN; 0 of a pixel that does not jump.
    high_share : part of the time at the high level.
    change_hz : 1/(mean time high) + 1/(mean time low), Hz.
    """

    PREFIX: ClassVar[str] = "telegraph_"
    amplitude_dn: NDArray
    high_share: NDArray
    change_hz: NDArray


@dataclass(frozen=True, eq=False)
class TelegraphPerFrame(RateMaps):
    """What frames tell of `TelegraphRates`: the correlation of the state from one frame to the next."""

    PREFIX: ClassVar[str] = "telegraph_"
    amplitude_dn: NDArray
    high_share: NDArray
    correlation: NDArray

    @property
    def misbehaves(self) -> bool:
        """Whether any pixel has a rate."""
        return bool(np.any(self.amplitude_dn > 0))

    def per_second(self, interval_s: float) -> TelegraphRates:
        """The rates of captures with this time from one frame to the next, s."""
        rates = change_hz(self.correlation.astype(np.float64), interval_s)
        changes = np.where(self.amplitude_dn > 0, rates, 0.0)
        return TelegraphRates(_single(self.amplitude_dn), _single(self.high_share), _single(changes))


@dataclass(frozen=True, eq=False)
class _EventDefects(RateMaps):
    """Maps that begin with the kind of defect, which is called ``defect`` in a file."""

    PREFIX: ClassVar[str] = "defect_"
    kind: NDArray

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the maps in a file."""
        return ("defect", *super().names()[1:])


@dataclass(frozen=True, eq=False)
class EventDefectRates(_EventDefects):
    """Event pixels that are stuck or give events of their own, [y, x].

    Attributes
    ----------
    kind : a `Defect`.
    on_hz, off_hz : rates of their own events while they fire, Hz.
    firing_share : part of the time in which they fire; 1 of all but flickering pixels.
    change_hz : 1/(mean time firing) + 1/(mean time quiet), Hz; 0 of pixels that do not flicker.
    """

    on_hz: NDArray
    off_hz: NDArray
    firing_share: NDArray
    change_hz: NDArray


@dataclass(frozen=True, eq=False)
class EventDefectsPerTrial(_EventDefects):
    """What counts tell of `EventDefectRates`: chances of an event in a comparison, and the correlation of the state."""

    on_per_trial: NDArray
    off_per_trial: NDArray
    firing_share: NDArray
    correlation: NDArray

    @property
    def misbehaves(self) -> bool:
        """Whether any pixel has a rate."""
        return bool(np.any(self.on_per_trial > 0) or np.any(self.off_per_trial > 0))

    def per_second(self, interval_s: float) -> EventDefectRates:
        """The rates of captures with this time from one comparison to the next, s."""
        share, correlation = self.firing_share.astype(np.float64), self.correlation.astype(np.float64)
        switches = (correlation > 0) & (share < 1)
        return EventDefectRates(
            self.kind,
            _single(rate_hz(self.on_per_trial.astype(np.float64), interval_s)),
            _single(rate_hz(self.off_per_trial.astype(np.float64), interval_s)),
            _single(np.where(switches, share, 1.0)),
            _single(np.where(switches, change_hz(correlation, interval_s), 0.0)),
        )


def _single(values: NDArray) -> NDArray[np.float32]:
    return values.astype(np.float32)


#: By section of a calibration: rates per second, and what stands for them in a file without an interval.
RATES: dict[str, type[TelegraphRates | EventDefectRates]] = {"aps": TelegraphRates, "evs": EventDefectRates}
COUNTED: dict[str, type[TelegraphPerFrame | EventDefectsPerTrial]] = {
    "aps": TelegraphPerFrame,
    "evs": EventDefectsPerTrial,
}


def needs_interval(section: str, maps: Mapping[str, NDArray]) -> bool:
    """Whether a section's maps are per interval, and have a pixel that misbehaves."""
    counted = COUNTED[section]
    if set(RATES[section].names()) <= set(maps) or not set(counted.names()) <= set(maps):
        return False
    return counted.of(maps).misbehaves

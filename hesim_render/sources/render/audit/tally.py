"""What an audit has counted so far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.audit.compare import Counted


class Tally:
    """Results of the units, arrays [unit] in the random order in which units are examined.

    Parameters
    ----------
    units : number of units.

    Attributes
    ----------
    off : share of values off by more than the tolerance, times the weight of the unit.
    expected : the share that the stated error of the run alone would put there, times the weight.
    events : counts from `compare`. `by_error` : counts after the stated error is added to the reference.
    eventful : length of the first part in which all units with events in the run were examined.
    looked_at : length of the first part in which all units were examined.
    """

    def __init__(self, units: int) -> None:
        self.off, self.expected, self.by_error = (np.zeros(units) for _ in range(3))
        self.events = Counted(*(np.zeros(units) for _ in range(5)))
        self.has_event = np.zeros(units, np.bool_)
        self.eventful = self.looked_at = 0
        self._deviations: list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]] = []

    def note(self, place: NDArray[np.int64], deviation: NDArray[np.float64], weight: NDArray[np.float64]) -> None:
        """Note absolute deviations of some units, [window, unit], in units of noise, with the weight of each unit."""
        each = np.broadcast_to(place, deviation.shape), deviation, np.broadcast_to(weight, deviation.shape)
        self._deviations.append(tuple(values.ravel() for values in each))  # type: ignore[arg-type]

    def deviations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Deviations and weights of all examined units, in increasing order of deviation."""
        place, deviation, weight = (np.concatenate(values) for values in zip(*self._deviations, strict=True))
        among = np.flatnonzero(place < self.looked_at)
        order = among[np.argsort(deviation[among])]
        return deviation[order], weight[order]

    def rate(self, values: NDArray[np.float64]) -> float:
        """Mean over units of a quantity that is 0 in units without events."""
        rare = values[: self.eventful][self.has_event[: self.eventful]].sum() / max(1, self.eventful)
        other = values[: self.looked_at][~self.has_event[: self.looked_at]].sum() / max(1, self.looked_at)
        return float(rare + other)

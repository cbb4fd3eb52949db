"""Compare the noise-free events of a run with those of a reference: missed and extra events, counted."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.audit.deviations import Deviations

#: An event counts as missed or extra only if its signal exceeds the threshold by this many standard errors.
SURE = 3.0


@dataclass(frozen=True)
class Counted:
    """Events of each unit within its core, [unit].

    Parameters
    ----------
    true, in_run : number of events of the reference and of the run.
    missed : true events without a matching one of the run, where the reference exceeds the threshold by more than
        `SURE` standard errors.
    extra : events of the run without a matching true one, where the run exceeds the threshold by that much.
    flips : all other events without a match.
    """

    true: NDArray[np.float64]
    in_run: NDArray[np.float64]
    missed: NDArray[np.float64]
    extra: NDArray[np.float64]
    flips: NDArray[np.float64]


def compare_ticks(
    run: NDArray[np.float64],
    reference: NDArray[np.float64],
    error: NDArray[np.float64],
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    core: NDArray[np.bool_],
) -> Counted:
    """Compare events of a sensor with a tick, which compares successive samples.

    Two events match if their polarities agree and their ticks differ by at most one.

    Parameters
    ----------
    run, reference : ln x, [window, unit].
    error : standard error of `run`, [window, unit].
    thresholds : θ₊ and θ₋ of each unit's pixel, [unit].
    core : [window], windows in which events are counted.
    """
    true, in_run, missed, extra, flips = counts = [np.zeros(run.shape[1]) for _ in range(5)]
    change, wanted = np.diff(run, axis=0), np.diff(reference, axis=0)
    spread = np.hypot(error[1:], error[:-1])
    counted = core[1:, None]
    for sign, theta in ((1.0, thresholds[0]), (-1.0, thresholds[1])):
        # by how much each signal passes the threshold; above 0 it gives an event
        own, other = sign * change - theta, sign * wanted - theta
        is_in_run, is_true = own > 0, other > 0
        lost, added = is_true & ~_near(is_in_run), is_in_run & ~_near(is_true)
        # beyond the stated error an event is missed or extra; within it, either may be right
        sure_lost, sure_added = lost & (other > SURE * spread), added & (own > SURE * spread)
        for total, which in (
            (true, is_true),
            (in_run, is_in_run),
            (missed, sure_lost),
            (extra, sure_added),
            (flips, (lost | added) & ~sure_lost & ~sure_added),
        ):
            total += np.sum(which & counted, axis=0)
    return Counted(*counts)


def _near(which: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The marked windows and their direct neighbours in time, [window, unit]."""
    widened = which.copy()
    widened[1:] |= which[:-1]
    widened[:-1] |= which[1:]
    return widened


def compare_crossings(
    run: NDArray[np.float64],
    reference: NDArray[np.float64],
    error: NDArray[np.float64],
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    core: NDArray[np.bool_],
    most: int,
) -> Counted:
    """Compare events of an asynchronous sensor, which compares with the level of its last event.

    Both signals start from the reference level. Every event of the reference sets the level of both. An event of one
    signal has a match if the other signal crosses the same level within one step of the source.

    Parameters
    ----------
    run, reference, error, thresholds, core : as for `compare_ticks`.
    most : largest number of events that is counted in a unit.
    """
    count = run.shape[1]
    true, in_run, missed, extra, flips = (np.zeros(count) for _ in range(5))
    level = reference[0].copy()
    theta_on, theta_off = thresholds
    last = run.shape[0] - 1
    for k in range(1, last + 1):
        around = slice(k - 1, min(k + 1, last) + 1)
        spread = error[around].max(axis=0)
        for sign, theta in ((1.0, theta_on), (-1.0, theta_off)):
            ahead, own = sign * reference, sign * run
            goal = sign * level + theta
            # a crossing of the run at a level that the reference does not reach within one step
            over = (own[k] > goal) & (own[k - 1] <= goal) & (ahead[around].max(axis=0) < goal)
            sure = over & (own[around].max(axis=0) > goal + SURE * spread)
            if core[k]:
                extra += sure
                flips += over & ~sure
                in_run += over
            # the reference may cross several levels within a step, and each event moves both signals on
            for _ in range(most):
                crosses = ahead[k] > goal
                if not crosses.any():
                    break
                like = own[around].max(axis=0) > goal
                sure = crosses & ~like & (ahead[around].max(axis=0) > goal + SURE * spread)
                if core[k]:
                    true += crosses
                    in_run += crosses & like
                    missed += sure
                    flips += crosses & ~like & ~sure
                level = np.where(crosses, level + sign * theta, level)
                goal = sign * level + theta
    return Counted(*(np.minimum(total, most) for total in (true, in_run, missed, extra, flips)))


class Tally:
    """Results of the units, arrays [unit] in the random order in which units are examined.

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
        self._deviations: list[tuple[NDArray[np.int64], Deviations, NDArray[np.float64]]] = []

    def note(self, place: NDArray[np.int64], deviation: Deviations, weight: NDArray[np.float64]) -> None:
        """Note deviations of some units, with the weight of each unit."""
        self._deviations.append((place, deviation, weight))

    def deviations(self, of_levels: bool = False) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Deviations and weights of all examined units, in increasing order of deviation.

        Parameters
        ----------
        of_levels : those of levels, `Deviations.level`, in place of what is judged.
        """
        parts = []
        for place, deviations, weight in self._deviations:
            values = deviations.level if of_levels else deviations.noise
            assert values is not None
            # units in their random order, up to the last of the part that was examined as a whole
            among = place < self.looked_at
            parts.append((values[:, among].ravel(), np.broadcast_to(weight, values.shape)[:, among].ravel()))
        deviation, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(deviation)
        return deviation[order], weight[order]

    def rate(self, values: NDArray[np.float64]) -> float:
        """Mean over units of a quantity that is 0 in units without events."""
        rare = values[: self.eventful][self.has_event[: self.eventful]].sum() / max(1, self.eventful)
        other = values[: self.looked_at][~self.has_event[: self.looked_at]].sum() / max(1, self.looked_at)
        return float(rare + other)

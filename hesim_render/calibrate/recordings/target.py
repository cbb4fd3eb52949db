"""Thresholds and their spread from a recording of a target of known contrast that moves through the picture.

Each pixel sees its light rise and fall by Δ = ln(bright/dark) again and again. Its reference follows in steps of its
own thresholds. It turns back up to a threshold before the light does, so that its ON events in a cycle are fewer than
Δ/θ₊ by a number that depends on where it turns. The counts of pixels with given thresholds are therefore simulated, and
θ₊, θ₋ and their spread are those whose mean counts and scatter over pixels are the measured ones. The light must change
slowly enough for the pixels, and noise must be small against the thresholds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.still import UNSURE_LEAK, jackknife
from hesim_render.calibrate.recordings.tally import GROUPS, EventTally

#: Simulated pixels, cycles before their counts begin, and most cycles that are simulated.
_PIXELS, _WARM, _MOST_CYCLES = 8192, 4, 60
#: Cycles, and ON and OFF events a cycle, that are needed.
_LEAST_CYCLES, _LEAST_EVENTS = 3, 1.5


class TargetThresholds(NamedTuple):
    """Figures of a moving target.

    Parameters
    ----------
    entries : ``theta_on``, ``theta_off`` (ln units) and ``threshold_mismatch_rel``, as entries of the result.
    ratio : ρ = θ₋/θ₊, as an entry of the result.
    """

    entries: dict[str, dict[str, Any]]
    ratio: dict[str, Any]


def thresholds(tally: EventTally, contrast: float, cycles_hz: float | None, leak_hz: float = 0.0) -> TargetThresholds:
    """θ₊, θ₋ and their relative mismatch over pixels, each with its interval, a jackknife over groups of pixels.

    Parameters
    ----------
    tally : of the recording.
    contrast : bright over dark light of the target.
    cycles_hz : bright–dark cycles of a pixel per second; None: read from the times between its turns to ON events.
    leak_hz : leak while the target moved, Hz: half of it is in the ON events of the rise, half missing in the fall.
    """
    count = tally.per_pixel().astype(np.float64)
    both = np.where(tally.used, count.min(axis=0), 0.0)
    seen = both > 0.25 * np.median(both[both > 0]) if both.any() else np.zeros(both.size, np.bool_)
    if np.count_nonzero(seen) < 2 * GROUPS:
        return unknown(f"{np.count_nonzero(seen)} pixels have events of both polarities; {2 * GROUPS} are needed")
    period_s = 1 / cycles_hz if cycles_hz is not None else tally.period_s()
    cycles = tally.seconds / period_s if period_s is not None else 0.0
    count = count[:, seen]
    leaked = leak_hz * tally.seconds  # in thresholds of ON events
    share = np.array([[-0.5], [0.5 * count[1].mean() / max(count[0].mean() - leaked, 1.0)]])
    unsure = UNSURE_LEAK * np.abs(share[:, 0] * leaked) / count.mean(axis=1)
    count = (count + share * leaked) / max(cycles, 1e-300)
    if cycles < _LEAST_CYCLES or count.mean(axis=1).min() < _LEAST_EVENTS:
        return unknown(
            f"a pixel sees {cycles:.3g} cycles of the target, with {count.mean(axis=1).min() if cycles else 0:.3g} "
            f"events of a polarity in each; {_LEAST_CYCLES} cycles of {_LEAST_EVENTS} events are needed"
        )
    simulated = _Simulated(float(np.log(contrast)), round(min(cycles, _MOST_CYCLES)))
    group = tally.group.astype(np.int64)[seen]
    whole = _moments(count)
    parts = np.array([_moments(count[:, group != k]) for k in range(GROUPS)])
    fitted, slope = simulated.fit(whole)
    every = np.concatenate([fitted[:, None], fitted[:, None] + np.linalg.solve(slope, (parts - whole).T)], axis=1)
    # the simulated pixels scatter as the real ones do
    of_simulated = simulated.moment_covariance(fitted)
    inverse = np.linalg.inv(slope)
    of_simulated = inverse @ of_simulated @ inverse.T
    errors = np.sqrt(jackknife(every) ** 2 + np.diag(of_simulated) + (fitted * np.append(unsure, 0.0)) ** 2)
    entries = {
        "theta_on": estimated(fitted[0], errors[0], "ln", GROUPS),
        "theta_off": estimated(fitted[1], errors[1], "ln", GROUPS),
    }
    if fitted[2] > 2 * errors[2]:
        spread = float(np.sqrt(fitted[2]))
        entries["threshold_mismatch_rel"] = estimated(spread, errors[2] / (2 * spread), "relative std", GROUPS)
    else:
        entries["threshold_mismatch_rel"] = {
            "value": 0.0, "upper_limit": float(np.sqrt(max(fitted[2], 0.0) + 2 * errors[2])),
            "note": "the pixels scatter no more than the place of their turns makes them",
        }  # fmt: skip
    ratio = every[1] / every[0]
    away = np.array([-1 / fitted[0], 1 / fitted[1], 0.0])  # slope of ln ρ
    error = float(np.sqrt(jackknife(ratio) ** 2 + ratio[0] ** 2 * (unsure.sum() ** 2 + away @ of_simulated @ away)))
    return TargetThresholds(entries, estimated(ratio[0], error, "", GROUPS))


def unknown(reason: str) -> TargetThresholds:
    """Figures of a target that tells none, with the reason."""
    entry = not_identifiable(reason)
    return TargetThresholds(dict.fromkeys(("theta_on", "theta_off", "threshold_mismatch_rel"), entry), entry)


def _moments(count: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean ON and OFF events a cycle, and the relative variance over pixels, mean of both polarities."""
    mean = count.mean(axis=1)
    return np.array([*mean, np.mean(count.var(axis=1, ddof=1) / mean**2)])


class _Simulated:
    """Counts of pixels whose light rises and falls by `rise`, ln units."""

    def __init__(self, rise: float, cycles: int) -> None:
        self._rise, self._cycles = rise, cycles
        rng = np.random.default_rng(1)
        # even steps of each law in random order: a sample would have a mean of its own
        place = (np.arange(_PIXELS) + 0.5) / _PIXELS
        self._z = np.array([special.ndtri(rng.permutation(place)) for _ in range(2)])
        self._start = rng.permutation(place)

    def moments(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """`_moments` of θ₊, θ₋ and the variance of the relative mismatch."""
        return _moments(self._counts(values))

    def moment_covariance(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of `moments` from sample to sample of the simulated pixels."""
        count = self._counts(values)
        group = np.arange(_PIXELS) % GROUPS
        parts = np.array([_moments(count[:, group == k]) for k in range(GROUPS)])
        return np.asarray(np.cov(parts.T)) / GROUPS

    def _counts(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """ON and OFF events a cycle of each simulated pixel."""
        spread = np.sqrt(max(values[2], 0.0))
        theta = np.maximum(values[:2, None] * (1 + spread * self._z), 0.05 * values[:2, None])
        reference, count = self._start * self._rise, np.zeros((2, _PIXELS))
        for cycle in range(_WARM + self._cycles):
            up = np.maximum(np.floor((self._rise - reference) / theta[0] + 1e-9), 0.0)
            reference = reference + up * theta[0]
            down = np.maximum(np.floor(reference / theta[1] + 1e-9), 0.0)
            reference = reference - down * theta[1]
            if cycle >= _WARM:
                count += np.stack([up, down])
        return count / self._cycles

    def fit(self, wanted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values of the given moments, and the slope of the moments there, over 5 %: counts are whole."""
        swing = self._rise / (1 + 0.5 * np.sum(1 / wanted[:2]))
        values = np.array([swing / wanted[0], swing / wanted[1], max(wanted[2], 1e-4)])
        slope = np.eye(3)
        for _ in range(8):
            slope = self._slope(values)
            step = np.linalg.solve(slope, wanted - self.moments(values))
            bound = np.array([0.3 * values[0], 0.3 * values[1], max(0.5 * values[2], 2e-3)])
            values = values + np.clip(step, -bound, bound)
            values[2] = max(values[2], -1e-2)
        return values, slope

    def _slope(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = []
        for k, wide in enumerate((0.05 * values[0], 0.05 * values[1], max(0.3 * values[2], 1e-3))):
            away = np.zeros(3)
            away[k] = wide
            low = values - away if k < 2 or values[2] > wide else values
            columns.append((self.moments(values + away) - self.moments(low)) / ((values + away)[k] - low[k]))
        return np.stack(columns, axis=1)

"""Rates of pixels that misbehave, per second, from what captures tell: chances per comparison, correlations per frame.

A calibration holds rates per second, so that a sensor behaves the same at any tick and frame rate. Older calibrations,
and those of captures whose interval nobody stated, hold values per interval. They are converted with the interval that
the section states (`tick_us`, `frame_rate_hz`), else with that of the sensor file that names the calibration.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Maps of pixels that misbehave, by section: per second, and per comparison or frame.
PER_SECOND = {
    "aps": ("telegraph_amplitude_dn", "telegraph_high_share", "telegraph_change_hz"),
    "evs": ("defect", "defect_on_hz", "defect_off_hz", "defect_firing_share", "defect_change_hz"),
}
PER_INTERVAL = {
    "aps": ("telegraph_amplitude_dn", "telegraph_high_share", "telegraph_correlation"),
    "evs": ("defect", "defect_on_per_trial", "defect_off_per_trial", "defect_firing_share", "defect_correlation"),
}


def rate_hz(probability: ArrayLike, interval_s: float) -> NDArray[np.float64]:
    """Rate of the Poisson process that gives an event in an interval with this probability.

    Parameters
    ----------
    probability : probability of an event; 1 is taken as 1 − 1e-9.
    interval_s : Δt, s.

    Returns
    -------
    Rate, Hz.
    """
    return -np.log1p(-np.clip(probability, 0.0, 1.0 - 1e-9)) / interval_s


def change_hz(correlation: ArrayLike, interval_s: float) -> NDArray[np.float64]:
    """Rate at which a telegraph signal forgets its state, from the correlation of the state over an interval.

    Parameters
    ----------
    correlation : exp(−rate·Δt), taken to lie 1e-9 inside of 0 and 1.
    interval_s : Δt, s.

    Returns
    -------
    Rate, Hz.
    """
    return -np.log(np.clip(correlation, 1e-9, 1.0 - 1e-9)) / interval_s


def per_second(section: str, maps: Mapping[str, NDArray], interval_s: float) -> dict[str, NDArray]:
    """The maps `PER_SECOND` of a section from the maps `PER_INTERVAL`.

    Parameters
    ----------
    section : ``aps`` or ``evs``.
    maps : {name: array}, those of `PER_INTERVAL`.
    interval_s : between two frames or comparisons, s.
    """
    if section == "aps":
        amplitude, share, correlation = (maps[name].astype(np.float64) for name in PER_INTERVAL[section])
        values: tuple[NDArray, ...] = amplitude, share, np.where(amplitude > 0, change_hz(correlation, interval_s), 0.0)
    else:
        on, off, share, correlation = (maps[name].astype(np.float64) for name in PER_INTERVAL[section][1:])
        switches = (correlation > 0) & (share < 1)
        changes = np.where(switches, change_hz(correlation, interval_s), 0.0)
        rates = rate_hz(on, interval_s), rate_hz(off, interval_s)
        values = maps["defect"], *rates, np.where(switches, share, 1.0), changes
    return {
        name: array.astype(np.float32) if array.dtype.kind == "f" else array
        for name, array in zip(PER_SECOND[section], values, strict=True)
    }


def needs_interval(section: str, maps: Mapping[str, NDArray]) -> bool:
    """Whether a section's maps are per interval, and have a pixel that misbehaves."""
    above = PER_INTERVAL[section][:1] if section == "aps" else PER_INTERVAL[section][1:3]
    return PER_SECOND[section][-1] not in maps and any(np.any(maps[name] > 0) for name in above if name in maps)

"""How far values of a run are from those of a reference: of frames the flux, of event pixels the change of ln x."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Largest deviation of ln x itself that does not count as off, for event pixels. From 1 to 10,000 lx, the rate of
#: background events of the shipped sensors that leak changes by at most four times as much as the light: a third of
#: this, as one standard error, is 13 % of that rate, where it is most sensitive. Without a leak (`reference-mono`) it
#: is seven times where a pixel has 0.2 events a second, and more where it has fewer.
LEVEL_TOLERANCE = 0.1
_PARTS = {"median": 0.5, "p95": 0.95, "p99": 0.99}


@dataclass(frozen=True)
class Deviations:
    """Absolute deviations of some values, [window, unit].

    Parameters
    ----------
    noise : what is judged, in units of the sensor's noise.
    level : of ln x itself; None for frames.
    unit : noise unit of each value as a change of ln x; None for frames.
    """

    noise: NDArray[np.float64]
    level: NDArray[np.float64] | None = None
    unit: NDArray[np.float64] | None = None

    def is_off(self, tolerance_noise: float) -> NDArray[np.bool_]:
        """Values that are off by more than a tolerance, in units of noise, or whose level is, and by more than
        `LEVEL_TOLERANCE` too.
        """
        off = self.noise > tolerance_noise
        if self.level is None or self.unit is None:
            return off
        return off | (self.level > np.maximum(LEVEL_TOLERANCE, tolerance_noise * self.unit))


def of_frames(flux: NDArray[np.float64], reference: NDArray[np.float64], unit: NDArray[np.float64]) -> Deviations:
    """Deviations of frame pixels; fluxes and noise units are [window, unit], e⁻/s."""
    return Deviations(np.abs(flux - reference) / unit)


def of_changes(
    log: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    run: tuple[NDArray[np.float64], NDArray[np.float64]],
    reference: tuple[NDArray[np.float64], NDArray[np.float64]],
    unit: NDArray[np.float64],
) -> Deviations:
    """Deviations of event pixels, by how far ln x has changed since an earlier window.

    Parameters
    ----------
    log : maps fluxes, [window, unit], to ln x.
    run, reference : fluxes of both, e⁻/s: [window, unit], and in the earlier window [1, unit].
    unit : noise unit of each value, [window, unit], e⁻/s.
    """
    # one noise unit of flux, as a change of ln x
    noise = log(reference[0] + unit) - log(reference[0])
    level, before = (log(own) - log(other) for own, other in zip(run, reference, strict=True))
    return Deviations(np.abs(level - before) / noise, np.abs(level), noise)


def summary(deviation: NDArray[np.float64], weight: NDArray[np.float64]) -> dict[str, float]:
    """Root mean square, quantiles and largest of deviations in increasing order, with weights."""
    cumulated = np.cumsum(weight)
    parts = {name: deviation[np.searchsorted(cumulated, p * cumulated[-1])] for name, p in _PARTS.items()}
    return {
        "rms": float(np.sqrt(np.sum(weight * deviation**2) / weight.sum())),
        **{name: float(value) for name, value in parts.items()},
        "largest": float(deviation[-1]),
    }

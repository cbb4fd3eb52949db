"""How much more event counts scatter over pixels than counting makes them, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.event_model import mean_probability, probability_variance
from hesim_render.calibrate.event_pool import PooledEvents

#: What counts as significant: chances of 6e-5.
_SIGMAS = 4.0


@dataclass(frozen=True)
class Dispersion:
    """How much more a pixel's counts scatter than a binomial law.

    Attributes
    ----------
    temporal, temporal_error : variance of ON + OFF in time over the trinomial one. Noise drawn once a tick and
        differenced makes an ON the likelier after an OFF, so it is above 1 there ...
    temporal_difference, temporal_difference_error : ... and below 1 for ON − OFF.
    common, difference : relative standard deviation over pixels of the thresholds' half sum and half
        difference, 0 where not significant; *_error of their squares.
    """

    temporal: float
    temporal_error: float
    temporal_difference: float
    temporal_difference_error: float
    common: float
    difference: float
    common_error: float
    difference_error: float

    @property
    def in_time(self) -> tuple[float, float]:
        """The two temporal factors, 1 where they do not differ from it by 4 standard errors."""
        pairs = (self.temporal, self.temporal_error), (self.temporal_difference, self.temporal_difference_error)
        total, difference = (factor if abs(factor - 1) > _SIGMAS * error else 1.0 for factor, error in pairs)
        return total, difference

    @property
    def mismatch(self) -> float:
        """Relative standard deviation of the threshold of one polarity."""
        return float(np.hypot(self.common, self.difference))


def dispersion(pooled: PooledEvents, u: NDArray, mismatch: float) -> Dispersion:
    """Split the scatter over pixels into counting (in time) and thresholds (over pixels) by how each grows with P.

    Parameters
    ----------
    u : [position, bin], fitted θ/σ_n of the mean threshold.
    mismatch : a first value of the thresholds' spread; the growth with it is taken from the exact law there.
    """
    n, scatter = pooled.trials, pooled.scatter()
    use = pooled.pixels > 1
    rate = mean_probability(u, mismatch)
    unit = mismatch if mismatch > 0 else 0.003
    between = probability_variance(u, unit) / unit**2
    # variance of half sum and half difference of a trinomial pixel of P₊ = P₋, averaged over thresholds
    counted_sum = (n * (rate - 2 * rate**2 - 2 * between * mismatch**2) / 2)[use]
    counted_difference = (n * rate / 2)[use]
    growth = (n * n * between)[use]
    half_sum = ((scatter[..., 0, 0] + scatter[..., 1, 1] + 2 * scatter[..., 0, 1]) / 4)[use]
    half_difference = ((scatter[..., 0, 0] + scatter[..., 1, 1] - 2 * scatter[..., 0, 1]) / 4)[use]
    free = pooled.pixels[use] - 1

    def fit(variance: NDArray, counted: NDArray, columns: int) -> tuple[NDArray, NDArray]:
        design = np.stack([counted, growth], axis=1)[:, :columns]
        expected = counted
        for _ in range(4):
            weight = free / (2 * np.maximum(expected, 1e-9) ** 2 + expected / 4)  # the last: Poisson's kurtosis
            normal = (design * weight[:, None]).T @ design
            solution = np.linalg.lstsq(normal, (design * weight[:, None]).T @ variance, rcond=None)[0]
            expected = np.maximum(design @ np.maximum(solution, [0.1, 0.0][:columns]), counted / 2)
        return solution, np.sqrt(np.diag(np.linalg.pinv(normal)))

    def split(variance: NDArray, counted: NDArray) -> tuple[float, float, float, float]:
        """Factor in time and its error, square of the thresholds' spread and its error."""
        (time, square), (time_error, square_error) = fit(variance, counted, 2)
        if square <= _SIGMAS * square_error:
            # Nothing grows with P²: what is left is the factor alone, better known without the other.
            (time,), (time_error,) = fit(variance, counted, 1)
            square = 0.0
        return float(time), float(time_error), float(square), float(square_error)

    total, apart = split(half_sum, counted_sum), split(half_difference, counted_difference)
    return Dispersion(
        temporal=total[0],
        temporal_error=total[1],
        temporal_difference=apart[0],
        temporal_difference_error=apart[1],
        common=float(np.sqrt(total[2])),
        difference=float(np.sqrt(apart[2])),
        common_error=total[3],
        difference_error=apart[3],
    )

"""A variance-stabilising transform, and its unbiased inverse.

With a variance v(I) = a + b I + c I², f(I) = ∫₀ᴵ dI / √(v + 3/8 b²) has a variance of 1 to first order; for a sum of
Poisson and Gaussian noise it is the generalised Anscombe transform. Below 0 the variance of 0 is used, so that read
noise around black is not distorted. The mean of f over the noise differs from f of the mean. The inverse is therefore
that of I → E f(I + noise), as Mäkitalo and Foi have it [makitalo2013], for a Poisson count of gain b plus Gaussian
noise.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import poisson

from hesim_render.core.bands import in_bands

_ENTRIES = 1 << 13
#: Nodes of the quadrature over the noise; more nodes do not change the fourth digit.
_NODES = 15
#: Range of the quadrature beyond the signal range, standard deviations.
_FAR = 8.0
#: Mean count above which a Gaussian replaces the Poisson law, and the largest count used below it.
_MANY, _MOST = 40, 100


class Stabiliser:
    """The transform for one variance.

    Parameters
    ----------
    a, b, c : coefficients of the variance a + b I + c I², DN²; the variance is at least a thousandth of a.
    top_dn : largest signal, DN.
    """

    def __init__(self, a: float, b: float, c: float, top_dn: float) -> None:
        self._a, self._b, self._c = a, b, c
        # even steps in the square root of the signal: small steps where f is strongly curved
        self._top = float(top_dn + _FAR * self.sigma(top_dn))
        signal = np.linspace(0, 1, _ENTRIES) ** 2 * self._top
        slope = 1 / self._scale(signal)
        self._signal = signal
        self._stable = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(signal))])

    def sigma(self, signal_dn: ArrayLike) -> NDArray[np.float64]:
        """Standard deviation at a signal, DN; below 0, that at 0."""
        signal = np.maximum(np.asarray(signal_dn, dtype=np.float64), 0)
        return np.sqrt(np.maximum(self._a + signal * (self._b + signal * self._c), 1e-3 * self._a))

    def _scale(self, signal_dn: ArrayLike) -> NDArray[np.float64]:
        """Reciprocal of the slope of f: the standard deviation, with Anscombe's 3/8 of a count for few counts."""
        return np.sqrt(self.sigma(signal_dn) ** 2 + 3 / 8 * self._b**2)

    def forward(self, signal_dn: NDArray[np.float32]) -> NDArray[np.float32]:
        """f of a signal in DN, [row, col]."""
        out = np.empty(signal_dn.shape, dtype=np.float32)
        table, below = self._stable.astype(np.float32), np.float32(1 / self._scale(0.0))

        def work(rows: slice) -> None:
            place = np.sqrt(np.maximum(signal_dn[rows], 0) * np.float32(1 / self._top))
            out[rows] = _between(table, place) + np.minimum(signal_dn[rows], 0) * below

        in_bands(signal_dn.shape[0], work)
        return out

    def backward(self, stable: NDArray[np.float32]) -> NDArray[np.float32]:
        """The signal in DN for which the mean of f over the noise is `stable`, [row, col]."""
        out = np.empty(stable.shape, dtype=np.float32)
        first, last, table = self._inverse

        def work(rows: slice) -> None:
            out[rows] = _between(table, (stable[rows] - np.float32(first)) * np.float32(1 / (last - first)))

        in_bands(stable.shape[0], work)
        return out

    @cached_property
    def _inverse(self) -> tuple[float, float, NDArray[np.float32]]:
        """Signals at even steps of the mean of f, and its first and last value."""
        below = -_FAR * float(self._scale(0.0)) * np.linspace(1, 0, 256, endpoint=False)
        signal = np.concatenate([below, self._signal])
        mean = self._mean(signal, self.sigma(signal))
        few = (signal > 0) & (signal < _MANY * self._b)
        if few.any():
            counts = np.arange(_MOST)
            chance = poisson.pmf(counts, signal[few, None] / self._b)
            rest = np.sqrt(np.maximum(self.sigma(signal[few]) ** 2 - self._b * signal[few], 0))
            mean[few] = sum(p * self._mean(np.full_like(rest, self._b * k), rest) for k, p in enumerate(chance.T))
        steps = np.linspace(mean[0], mean[-1], _ENTRIES)
        return mean[0], mean[-1], np.interp(steps, mean, signal).astype(np.float32)

    def _mean(self, signal: NDArray, sigma: NDArray) -> NDArray[np.float64]:
        """Mean of f over Gaussian noise."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
        return self._exactly(signal[:, None] + nodes * sigma[:, None]) @ (weights / weights.sum())

    def _exactly(self, signal: NDArray) -> NDArray[np.float64]:
        beyond = np.maximum(signal - self._top, 0) / self._scale(self._top)
        inside = np.interp(np.maximum(signal, 0), self._signal, self._stable)
        return inside + beyond + np.minimum(signal, 0) / self._scale(0.0)


def _between(table: NDArray[np.float32], place: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear interpolation in a table at places 0 to 1; constant beyond its ends."""
    index = np.clip(place, 0, 1) * np.float32(len(table) - 1)
    low = np.minimum(index.astype(np.int32), len(table) - 2)
    before = table[low]
    return before + (index - low) * (table[low + 1] - before)

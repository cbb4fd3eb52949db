"""A variance-stabilising transform, and its unbiased inverse.

With a variance v(I) = a + b I + c I², f(I) = ∫₀ᴵ dI / √(v + 3/8 b²) has a variance of 1 to first order; for a sum of
Poisson and Gaussian noise it is the generalised Anscombe transform. Below 0 the variance of 0 is used, so that read
noise around black is not distorted. The mean of f over the noise differs from f of the mean. The inverse is therefore
that of I → E f(I + noise), as Mäkitalo and Foi have it [makitalo2013], for a Poisson count of gain b plus Gaussian
noise.

A mosaic as planes, one for each position of a block of whole tiles. Each plane has one colour and one noise.
"""

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import poisson

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError

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
        # signals from far below 0, where noise leads, up to the end of the table
        below = -_FAR * float(self._scale(0.0)) * np.linspace(1, 0, 256, endpoint=False)
        signal = np.concatenate([below, self._signal])
        mean = self._mean(signal, self.sigma(signal))
        # few counts have a Poisson law, whose mean of f is a sum over counts
        few = (signal > 0) & (signal < _MANY * self._b)
        if few.any():
            counts = np.arange(_MOST)
            chance = poisson.pmf(counts, signal[few, None] / self._b)
            rest = np.sqrt(np.maximum(self.sigma(signal[few]) ** 2 - self._b * signal[few], 0))
            mean[few] = sum(p * self._mean(np.full_like(rest, self._b * k), rest) for k, p in enumerate(chance.T))
        # the mean of f rises with the signal: looked up the other way round
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


#: Number of block rows that are processed at once.
BAND_BLOCKS = 8
_LEAST_PX = 4


def block_of(tile: ArrayLike) -> NDArray[np.int64]:
    """The tile repeated until it measures at least 4×4. Blocks of that size are processed at once.

    Parameters
    ----------
    tile : [tile_row, tile_col], channel number of each position from 0 on, -1 where there is no value.

    Raises
    ------
    RangeError
        If the tile has no samples, or leaves out a channel number.
    """
    given = np.atleast_2d(np.asarray(tile, dtype=np.int64))
    if given.ndim != 2 or given.size == 0 or given.max() < 0:
        raise RangeError("tile", np.asarray(tile).tolist(), "rows of channel numbers with at least one >= 0")
    missing = sorted(set(range(int(given.max()))) - set(given.ravel().tolist()))
    if missing:
        raise RangeError("tile", given.tolist(), f"channel numbers without gaps ({missing[0]} does not occur)")
    return np.tile(given, [-(-_LEAST_PX // size) for size in given.shape])


def split(image: NDArray[np.float32], block: tuple[int, ...]) -> NDArray[np.float32]:
    """Planes [block position, block row, block col] with a border of one block on each side.

    The border repeats the outermost whole block, so that every colour stays in its place.
    """
    rows, cols = (_padded_index(size, period) for size, period in zip(image.shape, block, strict=True))
    padded_rows, padded_cols = rows.size // block[0], cols.size // block[1]
    planes = np.empty((*block, padded_rows, padded_cols), dtype=np.float32)

    def work(part: slice) -> None:
        band = image[rows[part.start * block[0] : part.stop * block[0]]][:, cols]
        planes[:, :, part] = band.reshape(-1, block[0], padded_cols, block[1]).transpose(1, 3, 0, 2)

    in_bands(padded_rows, work, BAND_BLOCKS)
    return planes.reshape(-1, padded_rows, padded_cols)


def _padded_index(size: int, period: int) -> NDArray[np.int64]:
    """Indices into a line of `size`, with one block before it and whole blocks up to one block after its end."""
    index = np.arange(-period, -(-size // period) * period + period)
    index[index < 0] += period
    over = index - size + 1
    index -= np.where(over > 0, -(-over // period) * period, 0)
    return np.where(index < 0, np.arange(index.size) % max(1, min(size, period)), index)


def join(planes: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """Planes [row in block, col in block, block row, block col], without border, back into an image."""
    height, width, block_rows, block_cols = planes.shape
    cols = out.shape[1]

    def work(part: slice) -> None:
        image = planes[:, :, part].transpose(2, 0, 3, 1).reshape(-1, block_cols * width)
        rows = slice(part.start * height, min(part.stop * height, out.shape[0]))
        out[rows] = image[: rows.stop - rows.start, :cols]

    in_bands(block_rows, work, BAND_BLOCKS)


def bordered(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Planes [position, block row, block col] with their outermost blocks repeated once."""
    return np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")

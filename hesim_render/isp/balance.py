"""White balance: one gain per channel, so that white is equal in all."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hesim_render.core.bands import in_bands
from hesim_render.core.errors import RangeError

#: Samples outside this part of the range are not used: below it there is noise, above it saturation.
_DARKEST, _BRIGHTEST = 0.01, 0.95


def white_balance(
    raw: NDArray[np.float32], tile: ArrayLike, gains: Sequence[float], clip: bool = True
) -> NDArray[np.float32]:
    """A mosaic with each channel multiplied by its gain, float32 [row, col].

    Parameters
    ----------
    raw : [row, col], black at 0, saturation at 1.
    tile : channel number of each tile position, -1 where there is none.
    gains : one per channel; used relative to the smallest.
    clip : clip all channels at 1, where the channel with the smallest gain saturates. Otherwise highlights turn
        magenta.
    """
    channels = np.asarray(tile)
    given = np.asarray(gains, dtype=np.float64)
    if given.ndim != 1 or given.size <= channels.max() or not (given > 0).all() or not np.isfinite(given).all():
        raise RangeError("white balance", np.asarray(gains).tolist(), f"{channels.max() + 1} positive gains")
    relative = np.append(given / given.min(), 1.0).astype(np.float32)  # the last is for -1
    height, width = channels.shape
    line_gains = relative[channels][:, np.arange(raw.shape[1]) % width]
    out = np.empty(raw.shape, dtype=np.float32)

    def work(part: slice) -> None:
        for row in range(height):
            first = part.start + (row - part.start) % height
            lines = slice(first, part.stop, height)
            np.multiply(raw[lines], line_gains[row], out=out[lines])
        if clip:
            np.minimum(out[part], 1, out=out[part])

    in_bands(raw.shape[0], work)
    return out


def grey_world(raw: NDArray[np.float32], tile: ArrayLike) -> list[float]:
    """Gains that make the mean of all channels equal [buchsbaum1980], over tiles that are neither dark nor saturated.

    Raises
    ------
    RangeError
        If no tile of the frame is well exposed in all channels.
    """
    channels = np.asarray(tile)
    shape = channels.shape
    rows, cols = (size // period for size, period in zip(raw.shape, shape, strict=True))
    tiles = raw[: rows * shape[0], : cols * shape[1]].reshape(rows, shape[0], cols, shape[1])
    means = np.stack(
        [np.mean([tiles[:, i, :, j] for i, j in np.argwhere(channels == c)], axis=0) for c in range(channels.max() + 1)]
    )
    good = (means.min(axis=0) > _DARKEST) & (means.max(axis=0) < _BRIGHTEST)
    if not good.any():
        raise RangeError("exposure", float(raw.max()), "tiles between black and saturation, for grey-world balance")
    return _relative(means[:, good].mean(axis=1))


def from_neutral(patches: ArrayLike) -> list[float]:
    """Gains from grey patches of a chart, [patch, channel]: dark and saturated ones are left out.

    Raises
    ------
    RangeError
        If none is well exposed.
    """
    values = np.atleast_2d(np.asarray(patches, dtype=np.float64))
    good = (values.min(axis=1) > _DARKEST) & (values.max(axis=1) < _BRIGHTEST)
    if not good.any():
        raise RangeError("grey patches", values.round(4).tolist(), "at least one between black and saturation")
    return _relative(values[good].sum(axis=0))


def _relative(response: NDArray) -> list[float]:
    return (response.max() / response).tolist()

"""The cumulative representation of events of EFNet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError


def cumulative_grid(
    events: NDArray, shape: tuple[int, int], begin_us: float, end_us: float, bins: int = 6
) -> NDArray[np.float32]:
    """Symmetric cumulative event representation [sun2022]: sums of polarities from the middle of the exposure outwards.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    begin_us, end_us : the exposure, µs.
    bins : even number of bins. The first half holds minus the sums from each of the times begin, begin + h, … to the
        middle, the second half the sums from the middle to middle + h, …, end, with h the exposure over `bins`.

    Returns
    -------
    float32 [bin, y, x].

    Raises
    ------
    RangeError
        If the number of bins is odd.
    """
    if bins < 2 or bins % 2:
        raise RangeError("bins", bins, "an even number, 2 or more")
    rows, cols = shape
    edges = np.linspace(begin_us, end_us, bins + 1)
    part = np.searchsorted(edges, events["t_us"], side="left") - 1  # (edge, next edge]: a time stamp is an end
    inside = (part >= 0) & (part < bins)
    place = part[inside] * rows * cols + events["y"][inside].astype(np.int64) * cols + events["x"][inside]
    each = np.bincount(place, events["polarity"][inside], bins * rows * cols).reshape(bins, rows, cols)
    half = bins // 2
    before = -np.cumsum(each[:half][::-1], axis=0)[::-1]
    return np.concatenate([before, np.cumsum(each[half:], axis=0)]).astype(np.float32)

"""Events as images: voxel grids over time, and the cumulative representation of EFNet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import RangeError


def voxel_grid(
    events: NDArray, shape: tuple[int, int], begin_us: float, end_us: float, bins: int
) -> NDArray[np.float32]:
    """Voxel grid: each event gives its polarity to the two bins nearest in time, by their distance [zhu2019].

    Bin k stands for the time begin + k/(bins − 1) · (end − begin). Events outside of the interval are left out.

    Parameters
    ----------
    events : structured array of `EVENT_DTYPE`.
    shape : rows and columns of the event grid.
    begin_us, end_us : the interval, µs.
    bins : number of bins, 2 or more.

    Returns
    -------
    float32 [bin, y, x].

    Raises
    ------
    RangeError
        If there are fewer than 2 bins, or the interval is empty.
    """
    if bins < 2:
        raise RangeError("bins", bins, "2 or more")
    if not end_us > begin_us:
        raise RangeError("end_us", end_us, f"above begin_us, {begin_us}")
    rows, cols = shape
    given = events[(events["t_us"] >= begin_us) & (events["t_us"] <= end_us)]
    at = (given["t_us"] - begin_us) / (end_us - begin_us) * (bins - 1)
    low = np.minimum(at.astype(np.int64), bins - 2)
    place = given["y"].astype(np.int64) * cols + given["x"]
    weight = at - low
    grid = np.zeros(bins * rows * cols)
    for k, part in ((low, 1 - weight), (low + 1, weight)):
        grid += np.bincount(k * rows * cols + place, part * given["polarity"], grid.size)
    return grid.reshape(bins, rows, cols).astype(np.float32)


def cumulative_grid(
    events: NDArray, shape: tuple[int, int], begin_us: float, end_us: float, bins: int = 6
) -> NDArray[np.float32]:
    """Symmetric cumulative event representation [sun2022]: sums of polarities from the middle of the exposure outwards.

    Parameters
    ----------
    events, shape : as for `voxel_grid`.
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

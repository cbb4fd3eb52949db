"""Tile shares: from shares of the frame pixels to a tile with whole pixels, each filter spread evenly."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.errors import SpecError
from hesim_render.specs.filter_set import FilterSetSpec

#: Width of the repulsion between pixels of one filter, px.
_REPULSION_PX = 1.2


def counts_of(shares: NDArray[np.float64], pixels: int) -> NDArray[np.int64]:
    """Whole pixels [filter] with nearly the given shares: largest remainders, and one of each at least.

    Parameters
    ----------
    shares : [filter], sum 1.
    pixels : number of pixels, at least that of filters.
    """
    is_free = np.ones(len(shares), dtype=bool)
    while True:  # who would get less than a pixel gets one, and the others share the rest
        wanted = np.where(is_free, shares / shares[is_free].sum() * (pixels - np.sum(~is_free)), 1.0)
        few = is_free & (wanted < 1)
        if not few.any():
            break
        is_free &= ~few
    result = np.floor(wanted + 1e-9).astype(np.int64)
    rest = np.argsort(result - wanted, kind="stable")
    result[rest[: pixels - int(result.sum())]] += 1
    return result


def repeated(filters: FilterSetSpec, rows: int, cols: int) -> NDArray[np.str_]:
    """The letters of a set over a larger tile, [row, col].

    Raises
    ------
    SpecError
        If the size is no multiple of the set's tile, or the set numbers its event pixels by its own tile.
    """
    tile = np.array([list(row) for row in filters.tile.split("\n")])
    if rows % tile.shape[0] or cols % tile.shape[1]:
        raise SpecError(
            f"a tile of {rows}x{cols} px is no multiple of the {tile.shape[0]}x{tile.shape[1]} px of {filters.name!r}",
            key="tile_px",
        )
    if filters.evs_grid is not None and tile.shape != (rows, cols):
        raise SpecError(
            f"the set {filters.name!r} numbers its event pixels by its tile of {tile.shape[0]}x{tile.shape[1]} px",
            key="tile_px",
        )
    return np.tile(tile, (rows // tile.shape[0], cols // tile.shape[1]))


def spread_tile(letters: NDArray[np.str_], places: NDArray[np.bool_], wanted: dict[str, int]) -> NDArray[np.str_]:
    """A tile with given numbers of letters on some places, equal letters as far from each other as they can.

    Pairs of letters are exchanged as long as that lowers the sum of exp(−d²/2w²) over pairs of equal letters, d their
    distance in the endless repetition of the tile.

    Parameters
    ----------
    letters : [row, col], the tile; what lies outside of `places` stays.
    places : [row, col], which pixels are free.
    wanted : number of pixels of each letter.

    Returns
    -------
    [row, col].
    """
    rows, cols = letters.shape
    place = np.argwhere(places)
    shift = place[:, None] - place[None]
    period = np.array([rows, cols])
    images = period * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    square = ((shift[:, :, None] + images) ** 2).sum(axis=-1)
    near = np.exp(-square / (2 * _REPULSION_PX**2)).sum(axis=-1)
    np.fill_diagonal(near, 0)
    names = list(wanted)
    best: NDArray[np.int64] | None = None
    least = np.inf
    for seed in range(8):
        kind = np.repeat(np.arange(len(names)), [wanted[name] for name in names])
        np.random.default_rng(seed).shuffle(kind)
        is_better = True
        while is_better:
            is_better = False
            same = near @ np.eye(len(names))[kind]  # repulsion of each place by each letter
            for a in range(len(kind)):
                for b in range(a):
                    # exchanged, each of the two leaves its own letter and no longer meets itself
                    gain = same[a, kind[b]] + same[b, kind[a]] - same[a, kind[a]] - same[b, kind[b]] - 2 * near[a, b]
                    if kind[a] != kind[b] and gain < -1e-12:
                        kind[a], kind[b] = kind[b], kind[a]
                        same = near @ np.eye(len(names))[kind]
                        is_better = True
        energy = float(np.sum(near * (kind[:, None] == kind[None])))
        if energy < least - 1e-12:
            best, least = kind.copy(), energy
    assert best is not None
    result = letters.copy()
    result[places] = np.array(names)[best]
    return result

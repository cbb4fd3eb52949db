"""Pairs that keep the flux of an earlier window, because decision rays show the same in both.

Where an edge passes, its neighbours are rendered too, since it may reach into them between the rays of their pilots.
Mostly it does not. Decision rays of such a pair allow an interval of fluxes: of an edge, those of the line anywhere in
its gap; otherwise from the lower to the upper level. A pair whose interval, together with that of an earlier window,
is narrow keeps the flux of that window in place of being rendered. Only the past decides, so the end of a run does not.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.edge_share import halfplane_share
from hesim_render.sources.render.change_driven.edges import EdgeFit
from hesim_render.sources.render.change_driven.estimates import Flux

#: Largest width of the interval of fluxes of two windows, and largest difference of their levels, in wanted errors.
_SAME = 1.0


@dataclass(frozen=True)
class HeldPairs:
    """Pairs with the flux of an earlier window of their pixel, arrays [n].

    Parameters
    ----------
    window, pixel : which pair.
    source : window whose flux it has.
    """

    window: NDArray[np.int64]
    pixel: NDArray[np.int64]
    source: NDArray[np.int64]

    @classmethod
    def none(cls) -> "HeldPairs":
        """No pairs."""
        nothing = np.empty(0, np.int64)
        return cls(nothing, nothing, nothing)

    def fill(self, flux: Flux) -> None:
        """Put their flux into `flux` [window, pixel], where that of the earlier windows is known."""
        for values in flux.arrays:
            values[self.window, self.pixel] = values[self.source, self.pixel]


def held_pairs(
    window: NDArray[np.int64],
    pixel: NDArray[np.int64],
    fit: EdgeFit,
    wanted: NDArray[np.float32],
    low_contrast: float,
    rendered: NDArray[np.bool_],
    asked: NDArray[np.bool_],
) -> HeldPairs:
    """Pairs that need not be rendered, because they show what an earlier window does.

    Parameters
    ----------
    window, pixel : [k], of each fit, in order of the window.
    fit : fits to decision rays; fluxes as those of the pilot, e⁻/s.
    wanted : [k], wanted error of each pair, e⁻/s.
    low_contrast : contrast below which levels alone are compared, wanted errors.
    rendered : [window, pixel], rendered pairs.
    asked : [window, pixel], those for which only neighbours ask; no other pair is held.
    """
    count, pixels = asked.shape
    contrast, gap = fit.high - fit.low, np.float32(0.5) * fit.gap
    # least and largest flux that the decision rays allow, [k]: an edge lies anywhere in its gap, and its sides scatter
    least, most = (
        fit.low + contrast * halfplane_share(fit.normal_x, fit.normal_y, fit.offset + sign * gap) + sign * fit.scatter
        for sign in (-1, 1)
    )
    # without a line, anything between both levels
    least, most = np.where(fit.is_edge, least, fit.low), np.where(fit.is_edge, most, fit.high)
    # levels of an edge say nothing by themselves
    uneven = np.where(fit.is_edge, np.inf, contrast)
    now = np.stack([least, most, uneven]).astype(np.float32)
    # of each pixel: the last window that is rendered and has a fit, −1 for none, and what is known of it
    source, then = np.full(pixels, -1, np.int64), np.zeros((3, pixels), np.float32)
    first = np.searchsorted(window, np.arange(count + 1))
    parts = [HeldPairs.none()]
    for number in range(count):
        # what changes by itself is compared with nothing before
        source[rendered[number] & ~asked[number]] = -1
        here = slice(first[number], first[number + 1])
        place, own, bound = pixel[here], now[:, here], np.float32(_SAME) * wanted[here]
        before = then[:, place]
        is_narrow = np.maximum(own[1], before[1]) - np.minimum(own[0], before[0]) <= bound
        # little contrast, on the same levels
        is_alike = np.maximum(own[2], before[2]) < np.float32(low_contrast) * wanted[here]
        is_alike &= (np.abs(own[:2] - before[:2]) <= bound).all(axis=0)
        holds = asked[number, place] & (source[place] >= 0) & (is_narrow | is_alike)
        parts.append(HeldPairs(np.full(np.count_nonzero(holds), number), place[holds], source[place[holds]]))
        # all others are rendered, and later ones are compared with them
        new = place[~holds]
        source[new], then[:, new] = number, own[:, ~holds]
    names = "window", "pixel", "source"
    return HeldPairs(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

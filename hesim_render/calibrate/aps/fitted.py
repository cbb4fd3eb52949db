"""Results of the frames of a capture set before they are written."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.aps.common_mode import Shared
from hesim_render.calibrate.aps.composite import Composite
from hesim_render.calibrate.aps.dark import DarkModel
from hesim_render.calibrate.aps.telegraph import TelegraphMaps
from hesim_render.calibrate.aps.variance import Pooled, VarianceFit

Position = tuple[int, int]


@dataclass(frozen=True)
class ApsCalibration:
    """Results of the frames.

    Attributes
    ----------
    fits, bins : fit and pooled variances of each tile position with an APS value.
    bad : pixels [row, col] left out: clipped in the dark, dead, stuck, or of a variance unlike their kind's.
    signals : float32 [exposure, row, col], light above black, DN.
    usable : [exposure, row, col], lit values clear of clipping.
    rows : temporal row noise.
    telegraph : pixels with two levels; they are among the bad ones.
    """

    dark: DarkModel
    composite: Composite
    fits: dict[Position, VarianceFit]
    bins: dict[Position, Pooled]
    bad: NDArray[np.bool_]
    signals: NDArray[np.float32]
    usable: NDArray[np.bool_]
    transfer: dict[str, Any]
    rows: Shared
    telegraph: TelegraphMaps

    def beta(self, tile: tuple[int, int]) -> NDArray[np.float64]:
        """β0 … β5 in DN and s, [tile_row, tile_col, 6]; 0 for terms and positions without a number."""
        beta = np.zeros((*tile, 6))
        for position, fit in self.fits.items():
            beta[position] = fit.beta
        return beta

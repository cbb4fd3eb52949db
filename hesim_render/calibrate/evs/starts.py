"""The multi-start study: maximum likelihood from many starts must end at one point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.evs.cells import PixelCounts
from hesim_render.calibrate.evs.fit import search
from hesim_render.calibrate.evs.fitted import EventFit
from hesim_render.calibrate.evs.model import from_natural, natural

_STARTS = 200


def multi_start(
    pixels: PixelCounts, fit: EventFit, theta_v: float, seed: int, starts: int = _STARTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Maximum likelihood from many starts: A, B, C vary by e² in either direction, D over (−0.9, 0.9).

    Parameters
    ----------
    pixels : counts.
    fit : the fit whose parameters the starts surround.
    theta_v : Θ, threshold in V.
    seed : seed of the starts.
    starts : number of starts.

    Returns
    -------
    (A, B, C, D) [start, 4] at the end of each search, and their standard errors [4] from the Fisher information.
    """
    rng = np.random.default_rng(seed)
    begin = np.tile(fit.values, (starts, 1))
    free = np.array(fit.free)
    spread = np.where(free[:3], rng.uniform(-2, 2, (starts, 3)), 0)
    begin[:, :3] *= np.exp(spread)
    if free[3]:
        begin[:, 3] = rng.uniform(-0.9, 0.9, starts)
    begin[:, 4:] = np.where(free[4:], 0.0, begin[:, 4:])
    eta, fisher, _ = search(pixels.cells.coarser(), from_natural(begin), theta_v, fit.law, fit.free)
    values, covariance = natural(eta, np.linalg.pinv(fisher))
    errors = np.sqrt(np.maximum(np.einsum("fii->fi", covariance)[:, :4], 0))
    return values[:, :4], np.where(free[:4], np.median(errors, axis=0), np.nan)

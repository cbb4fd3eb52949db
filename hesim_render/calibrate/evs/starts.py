"""The multi-start study: maximum likelihood from many starts must end at one point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.evs.cells import PixelCounts
from hesim_render.calibrate.evs.fit import search
from hesim_render.calibrate.evs.fitted import EventFit
from hesim_render.calibrate.evs.model import from_natural, log_likelihood, log_probability, natural

_STARTS = 200
#: ln L below the best end from which an end does not describe the counts: 4 standard errors of a likelihood ratio.
_TOO_UNLIKELY = 8.0


@dataclass(frozen=True)
class Ends:
    """Where the searches of the multi-start study ended.

    Parameters
    ----------
    values : (A, B, C, D) [start, 4].
    standard_error : [4], from the Fisher information; NaN for what is not free.
    log_likelihood_below : [start], ln L of the best end minus that of this one.
    """

    values: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    log_likelihood_below: NDArray[np.float64]

    def describe_counts(self, chi2_per_dof: float) -> NDArray[np.bool_]:
        """Whether each end is about as likely as the best, [start]. The others only say that a search was lost.

        Parameters
        ----------
        chi2_per_dof : of the fit. Counts that scatter more than the binomial law has it make ln L differ by more.
        """
        return self.log_likelihood_below < _TOO_UNLIKELY * max(1.0, chi2_per_dof)


def multi_start(pixels: PixelCounts, fit: EventFit, theta_v: float, seed: int) -> Ends:
    """Maximum likelihood from many starts: A, B, C vary by e² in either direction, D over (−0.9, 0.9).

    Parameters
    ----------
    pixels : counts. Of pixels with known thresholds those near the mean are used.
    fit : the fit whose parameters the starts surround.
    theta_v : Θ, threshold in V.
    seed : seed of the starts.
    """
    rng = np.random.default_rng(seed)
    begin = np.tile(fit.values, (_STARTS, 1))
    free = np.array(fit.free)
    spread = np.where(free[:3], rng.uniform(-2, 2, (_STARTS, 3)), 0)
    begin[:, :3] *= np.exp(spread)
    if free[3]:
        begin[:, 3] = rng.uniform(-0.9, 0.9, _STARTS)
    begin[:, 4:] = np.where(free[4:], 0.0, begin[:, 4:])
    cells = pixels.cells.typical().coarser()
    eta, fisher, _ = search(cells, from_natural(begin), theta_v, fit.law, fit.free)
    values, covariance = natural(eta, np.linalg.pinv(fisher))
    errors = np.sqrt(np.maximum(np.einsum("fii->fi", covariance)[:, :4], 0))
    level = log_likelihood(cells, log_probability(eta, cells, theta_v, fit.law)[0])
    return Ends(values[:, :4], np.where(free[:4], np.median(errors, axis=0), np.nan), level.max() - level)

"""Whether the event model describes the counts: χ² by brightness, with the scatter measured over pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.event_cells import PixelCounts
from hesim_render.calibrate.event_model import Law, probability

#: Least events of a polarity and least pixels in a group, so that its mean has a normal law.
_LEAST_EVENTS, _LEAST_PIXELS = 100.0, 200


@dataclass(frozen=True)
class Goodness:
    """χ² of the groups' residuals (ON, OFF), and the chance of a larger one."""

    chi2: float
    dof: int

    @property
    def per_dof(self) -> float:
        return self.chi2 / self.dof

    @property
    def p_value(self) -> float:
        return float(chi2_law.sf(self.chi2, self.dof))


def goodness(pixels: PixelCounts, parameters: NDArray, theta_v: float, law: Law, fitted: int) -> Goodness:
    """Residuals of pixels alike in brightness, ON and OFF, against their own scatter over those pixels.

    That scatter holds whatever makes counts of a pixel vary or correlate (thresholds, noise from tick to tick), so
    that the sum of squares has a χ² law of two degrees of freedom a group, less the parameters `fitted`.
    """
    chi2, groups = 0.0, 0
    for session in np.unique(pixels.is_dark):
        on, off = np.flatnonzero(pixels.is_dark == session)
        means = [
            pixels.cells.trials * probability(parameters, pixels.single(int(k)), theta_v, law) for k in (on, off)
        ]
        group = np.zeros(pixels.signal_dn.size, np.intp) if session else _groups(pixels.signal_dn, means)
        residual = [pixels.counts[k] - mean for k, mean in zip((on, off), means, strict=True)]
        number = np.bincount(group, pixels.weight).astype(np.float64)

        def mean_of(values: NDArray, group: NDArray = group, number: NDArray = number) -> NDArray[np.float64]:
            weighted = values if pixels.weight is None else values * pixels.weight
            return np.bincount(group, weighted) / np.maximum(number, 1e-30)

        a, b = (mean_of(r) for r in residual)
        free = np.maximum(number - 1, 1)
        aa, bb, ab = (
            (mean_of(x * y) - p * q) / free
            for x, y, p, q in ((residual[0], residual[0], a, a), (residual[1], residual[1], b, b), (*residual, a, b))
        )
        # a group without any event of a polarity tells by the other alone
        aa, bb = (np.maximum(v, 0.1 * mean_of(m) / number) for v, m in zip((aa, bb), means, strict=True))
        determinant = np.maximum(aa * bb - ab * ab, 1e-6 * aa * bb)
        squares = (a * a * bb - 2 * a * b * ab + b * b * aa) / np.maximum(determinant, 1e-300)
        used = number > 1
        chi2 += float(squares[used].sum())
        groups += int(used.sum())
    return Goodness(chi2, max(2 * groups - fitted, 1))


def _groups(signal_dn: NDArray, means: list[NDArray]) -> NDArray[np.intp]:
    """Pixels in order of brightness, in groups that hold enough of them and of their events."""
    order = np.argsort(signal_dn, kind="stable")
    steps = np.minimum(*means)[order] / _LEAST_EVENTS
    reached = np.minimum(np.cumsum(steps), np.arange(1, order.size + 1) / _LEAST_PIXELS)
    number = np.maximum(np.floor(reached - 1e-9).astype(np.intp), 0)
    # what is left at the end joins the group before
    _, number = np.unique(np.minimum(number, max(int(number[-1]) - 1, 0)), return_inverse=True)
    group = np.empty(order.size, np.intp)
    group[order] = number
    return group

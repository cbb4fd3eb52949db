"""Test whether the event model describes the counts: χ² by brightness, with the scatter measured over pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_law

from hesim_render.calibrate.evs.cells import PixelCounts
from hesim_render.calibrate.evs.model import Law, probability

#: Least events of a polarity and least pixels in a group, so that its mean has a normal law; with few events the
#: first is lowered to give this many groups.
_LEAST_EVENTS, _LEAST_PIXELS, _GROUPS = 100.0, 200, 20
_FEWEST_EVENTS = 10.0


@dataclass(frozen=True)
class Goodness:
    """χ² of the groups' residuals (ON, OFF), and the probability of a larger one."""

    chi2: float
    dof: int

    @property
    def per_dof(self) -> float:
        """1 where there are not more groups than parameters, and nothing is left to judge by."""
        return self.chi2 / self.dof if self.dof > 0 else 1.0

    @property
    def p_value(self) -> float:
        return float(chi2_law.sf(self.chi2, self.dof)) if self.dof > 0 else 1.0


def goodness(pixels: PixelCounts, parameters: NDArray, theta_v: float, law: Law, fitted: int) -> Goodness:
    """Residuals of pixels alike in brightness, ON and OFF, against their own scatter over those pixels.

    That scatter includes every cause of variation or correlation (thresholds, noise from tick to tick), so
    that the sum of squares has a χ² law of two degrees of freedom a group, less the parameters `fitted`.
    """
    chi2, groups = 0.0, 0
    for session in np.unique(pixels.is_dark):
        on, off = np.flatnonzero(pixels.is_dark == session)
        means = [pixels.cells.trials * probability(parameters, pixels.single(int(k)), theta_v, law) for k in (on, off)]
        residual = [pixels.counts[k] - mean for k, mean in zip((on, off), means, strict=True)]
        # counts that scatter more than by counting have the information of fewer counts
        effect = max(
            1.0, *(float(r @ r) / max(float(mean.sum()), 1e-9) for r, mean in zip(residual, means, strict=True))
        )
        group = np.zeros(pixels.signal_dn.size, np.intp)
        if not session:
            group = _groups(pixels.signal_dn, np.minimum(*means) / effect)

        def total(values: NDArray, group: NDArray = group) -> NDArray[np.float64]:
            return np.bincount(group, values).astype(np.float64)

        expected = [np.maximum(total(mean), 1e-9) for mean in means]
        # the scatter relative to counting is that of several groups together: a few events do not determine it
        wide = _wider(np.minimum(*expected) / effect)
        squares = [
            np.bincount(wide, total(x * y))[wide] / np.sqrt(np.bincount(wide, p)[wide] * np.bincount(wide, q)[wide])
            for x, y, p, q in (
                (residual[0], residual[0], expected[0], expected[0]),
                (residual[1], residual[1], expected[1], expected[1]),
                (*residual, *expected),
            )
        ]
        # a correlation matrix that can be inverted, whatever few counts say
        aa, bb = np.maximum(squares[0], 0.1), np.maximum(squares[1], 0.1)
        ab = np.clip(squares[2], -0.99 * np.sqrt(aa * bb), 0.99 * np.sqrt(aa * bb))
        # residuals of ON and OFF in units of counting, and their quadratic form with the measured scatter
        a, b = (total(r) / np.sqrt(e) for r, e in zip(residual, expected, strict=True))
        chi2 += float(np.sum((a * a * bb - 2 * a * b * ab + b * b * aa) / (aa * bb - ab * ab)))
        groups += a.size
    return Goodness(chi2, 2 * groups - fitted)


def _wider(events: NDArray[np.float64]) -> NDArray[np.intp]:
    """Neighbouring groups together until they hold enough events: the number of each group's wider one."""
    number = np.floor(np.cumsum(events) / _LEAST_EVENTS - 1e-9).astype(np.intp)
    _, number = np.unique(np.minimum(number, max(int(number[-1]) - 1, 0)), return_inverse=True)
    return number


def _groups(signal_dn: NDArray, events: NDArray) -> NDArray[np.intp]:
    """Pixels in order of brightness, in groups that hold enough of them and of their events."""
    order = np.argsort(signal_dn, kind="stable")
    events = np.cumsum(events[order])
    # events that a group needs
    enough = float(np.clip(events[-1] / _GROUPS, _FEWEST_EVENTS, _LEAST_EVENTS))
    ends: list[int] = []
    start, before = 0, 0.0
    while start < order.size:
        # enough events and enough pixels
        end = max(int(np.searchsorted(events, before + enough)) + 1, start + _LEAST_PIXELS)
        if end > order.size:
            break
        ends.append(end)
        start, before = end, float(events[end - 1])
    # the rest at the end joins the previous group
    group = np.empty(order.size, np.intp)
    group[order] = np.searchsorted(np.array(ends[:-1], np.intp), np.arange(order.size), side="right")
    return group

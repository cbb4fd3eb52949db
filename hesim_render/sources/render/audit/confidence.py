"""Bounds for means of bounded variables that hold at any number of draws and for any distribution: by betting.

Who bets on every draw x in [0, 1] that the mean is below m, with a stake λ in [0, 1), has after n draws the capital Π
(1 − λ (x − m)). If the mean is m or more, that capital has no drift upwards, and by Ville's inequality [ville1939] it
ever reaches 1/α with a chance of at most α: all m for which it has are ruled out with confidence 1 − α, no matter when
one looks or why one stops [waudby2024]. A portfolio of stakes is a bet as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Stakes and the parts of the first capital that are put on them: one for what never happens, the others for what
#: happens now and then.
_STAKES = np.concatenate([[0.99], np.geomspace(0.8, 0.02, 8)])
_PARTS = np.concatenate([[0.5], np.full(8, 0.5 / 8)])
#: Relative step in which bounds are looked for.
_STEP = 1e-3


def _log_capital(gain: NDArray[np.float64]) -> float:
    """Of the portfolio, from what one stake of 1 wins on each draw, above -1 each."""
    each = np.log1p(_STAKES[:, None] * gain[None]).sum(axis=1)
    return float(np.logaddexp.reduce(each + np.log(_PARTS)))


def upper_bound(values: NDArray[np.float64], confidence: float) -> float:
    """Upper bound for the mean of independent draws of one distribution on [0, 1].

    Parameters
    ----------
    values : [n], in [0, 1].
    confidence : 1 − α; it holds for all n together.
    """
    return _least(lambda m: m - values, confidence, values.size)


def lower_bound(values: NDArray[np.float64], confidence: float) -> float:
    """Lower bound for the mean, see `upper_bound`."""
    return 1.0 - upper_bound(1.0 - values, confidence)


def ratio_upper_bound(part: NDArray[np.float64], whole: NDArray[np.float64], most: float, confidence: float) -> float:
    """Upper bound for mean(part)/mean(whole) of independent pairs of draws, at most 1.

    If the ratio is r or more, part − r·whole has no drift downwards, and at most `most` is won by who bets on the
    contrary.

    Parameters
    ----------
    part, whole : [n], 0 or more.
    most : that a `part` can be.
    confidence : 1 − α; it holds for all n together.
    """
    return _least(lambda r: (r * whole - part) / most, confidence, part.size)


def _least(gain: object, confidence: float, count: int) -> float:
    """Least parameter up to 1 from which on all are ruled out, to `_STEP` of itself."""
    assert callable(gain)
    if count == 0:
        return 1.0
    wanted = -np.log1p(-confidence)
    low, high = 0.0, 1.0
    if _log_capital(gain(high)) < wanted:
        return 1.0
    while high - low > _STEP * high:  # the capital grows with the parameter
        middle = np.sqrt(max(low, 1e-9) * high) if low else max(high / 2, 1e-9)
        if _log_capital(gain(middle)) >= wanted:
            high = middle
        elif middle <= 1e-9:
            return middle
        else:
            low = middle
    return float(high)

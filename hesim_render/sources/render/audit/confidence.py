"""Confidence bounds for the mean of bounded variables, valid at any number of draws and for any distribution.

The method is testing by betting. A player bets on every draw x in [0, 1] that the mean is below m, with a stake λ in
[0, 1). After n draws the capital is Π (1 − λ (x − m)). If the mean is m or more, the capital has no upward drift, and
by Ville's inequality [ville1939] it reaches 1/α with a probability of at most α. All m for which the capital has
reached 1/α are therefore excluded with confidence 1 − α, at whatever time and for whatever reason the draws stop
[waudby2024]. A portfolio of several stakes is a valid bet as well.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

#: Stakes and their parts of the initial capital: one stake suits what never happens, the others what
#: happens now and then.
_STAKES = np.concatenate([[0.99], np.geomspace(0.8, 0.02, 8)])
_PARTS = np.concatenate([[0.5], np.full(8, 0.5 / 8)])
#: Relative step of the search for a bound.
_STEP = 1e-3


def _log_capital(gain: NDArray[np.float64], count: NDArray[np.int64]) -> float:
    """Logarithm of the portfolio's final capital, from the gain of a stake of 1 on a draw (above -1), so often each."""
    each = np.log1p(_STAKES[:, None] * gain[None]) @ count
    return float(np.logaddexp.reduce(each + np.log(_PARTS)))


def upper_bound(values: NDArray[np.float64], confidence: float) -> float:
    """Upper confidence bound for the mean of independent draws from one distribution on [0, 1].

    Parameters
    ----------
    values : [n], in [0, 1].
    confidence : 1 − α; it holds for all n together.
    """
    # most draws are alike: each value is looked at once
    distinct, count = np.unique(values, return_counts=True)
    return _least(lambda m: m - distinct, confidence, count)


def lower_bound(values: NDArray[np.float64], confidence: float) -> float:
    """Lower confidence bound for the mean; parameters as for `upper_bound`."""
    return 1.0 - upper_bound(1.0 - values, confidence)


def ratio_upper_bound(part: NDArray[np.float64], whole: NDArray[np.float64], most: float, confidence: float) -> float:
    """Upper confidence bound for mean(part)/mean(whole) of independent pairs of draws, at most 1.

    If the ratio is r or more, part − r·whole has no downward drift. The bet is on the contrary, and one draw wins
    at most in proportion to `most`.

    Parameters
    ----------
    part, whole : [n], 0 or more.
    most : largest possible value of `part`.
    confidence : 1 − α; it holds for all n together.
    """
    pairs, count = np.unique(part + 1j * whole, return_counts=True)
    return _least(lambda r: (r * pairs.imag - pairs.real) / most, confidence, count)


def _least(gain: Callable[[float], NDArray[np.float64]], confidence: float, count: NDArray[np.int64]) -> float:
    """Smallest parameter up to 1 from which on all values are excluded, to a relative step of `_STEP`."""
    if count.size == 0:
        return 1.0
    wanted = -np.log1p(-confidence)
    low, high = 0.0, 1.0
    if _log_capital(gain(high), count) < wanted:
        return 1.0
    while high - low > _STEP * high:  # the capital grows with the parameter
        middle = np.sqrt(max(low, 1e-9) * high) if low else max(high / 2, 1e-9)
        if _log_capital(gain(middle), count) >= wanted:
            high = middle
        elif middle <= 1e-9:
            return middle
        else:
            low = middle
    return float(high)


def is_hopeless(shares: list[tuple[float, float, float]], times: float) -> bool:
    """True if so many times the units would hardly change the verdict.

    The distance of a bound from its estimate falls with the root of their number: a bound would not be below the limit,
    or an estimate is as far above it. An estimate that is above its limit by less says nothing yet.

    Parameters
    ----------
    shares : estimate, bound and limit of each share.
    times : possible number of units over that so far.
    """
    above = [(share, bound - share, most) for share, bound, most in shares if share > most]
    if above:
        return any(share - distance > most for share, distance, most in above)
    return any(share + (bound - share) / np.sqrt(times) > most for share, bound, most in shares)

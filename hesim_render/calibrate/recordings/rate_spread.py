"""Spread of the rates of event pixels over pixels, and how even their intervals are, in recordings of still scenes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import estimated, not_identifiable
from hesim_render.calibrate.recordings.still import jackknife
from hesim_render.calibrate.recordings.tally import GROUPS, EventTally

#: Events of all pixels that a spread needs.
_LEAST_EVENTS = 60
#: Pairs of ON intervals that the local variation needs.
_LEAST_PAIRS = 200
#: ON events of a pixel in half of the time, as the mean, with which the spread of the rates is known.
_EVENTS_OF_HALF = 2.0


def rate_spread(tally: EventTally, polarity: int) -> dict[str, Any]:
    """Standard deviation of the rates over pixels, relative: the covariance of both halves of the time, in which the
    counting of random events has no part. The error is that of a jackknife over groups of pixels.

    Even intervals of a leak make one half of the counts smaller where the other is larger. With V the variance over
    the squared mean of the intervals, here that of gamma laws with their local variation, the covariance of the counts
    of a renewal process is (V² − 1)/12 in the mean over rates [cox1962]. A tenth of it counts as its error, and twice
    the whole where the counts of all pixels have like places between two whole numbers.
    """
    halves = tally.counts[polarity].astype(np.float64)
    if halves[:, tally.used].sum() < _LEAST_EVENTS:
        return not_identifiable(f"{int(halves[:, tally.used].sum())} events in all")
    # sums of each group of pixels: number, counts of both halves, and their product, [4, group]
    sums = np.array([tally.by_group(v) for v in (np.ones(tally.pixels), *halves, halves[0] * halves[1])])

    def relative(s: NDArray[np.float64]) -> NDArray[np.float64]:
        means = s[1:] / s[0]
        return (means[2] - means[0] * means[1]) / np.maximum(means[0] * means[1], 1e-300)

    whole = float(relative(sums.sum(axis=1)))
    # the same without each group, for the jackknife
    parts = relative(sums.sum(axis=1)[:, None] - sums)
    error = float(jackknife(np.append(whole, parts)))
    first, second = sums[1:3].sum(axis=1) / sums[0].sum()
    if polarity == 0:
        if min(first, second) < _EVENTS_OF_HALF:
            return not_identifiable(
                f"a pixel has {min(first, second):.2g} events in half of the time; {_EVENTS_OF_HALF:g} are needed, as "
                "even intervals scatter less than chance: record longer"
            )
        own = regularity(tally)
        if own["value"] is None:
            return own
        local, both = own["value"], first * second
        even = max(1 - (2 * local / (3 - local)) ** 2, 0.0) / 12 / both
        whole += even
        alike = np.exp(-2 * np.pi**2 * max(whole, 0.0) * both)
        error = float(np.hypot(error, (0.1 + 2 * alike) * even))
    if whole <= 2 * error:
        limit = float(np.sqrt(max(whole, 0.0) + 2 * error))
        return {"value": 0.0, "upper_limit": limit, "note": "the pixels scatter no more than counting makes them"}
    return estimated(np.sqrt(whole), error / (2 * np.sqrt(whole)), "relative std", GROUPS)


def regularity(tally: EventTally) -> dict[str, Any]:
    """Local variation of a pixel's ON intervals [shinomoto2003]: 1 for a Poisson process, 0 for equal intervals."""
    of_groups, variation = tally.by_group(tally.pairs), tally.by_group(tally.variation)
    pairs = int(of_groups.sum())
    if pairs < _LEAST_PAIRS:
        return not_identifiable(f"{pairs} pairs of successive ON intervals; {_LEAST_PAIRS} are needed")
    # mean over pairs of intervals, then the same without each group
    whole = variation.sum() / pairs
    parts = (variation.sum() - variation) / np.maximum(pairs - of_groups, 1)
    error = float(jackknife(np.append(whole, parts)))
    return estimated(whole, error, "", GROUPS)

"""Signs that a recording is not one of a still scene in steady light."""

import numpy as np
from scipy import stats

from hesim_render.calibrate.recordings.tally import LAMPS_HZ, SLICES, EventTally

#: Chance of a slice of three times the mean rate that counts as one of such a rate.
_BURST_CHANCE = 1e-3
#: Part of the ON events that have one phase of a lamp, and their power over that of chance, from which it flickers.
_LEAST_FLICKER, _FLICKER_POWER = 0.1, 4.0
#: Periods of a lamp in a slice of a recording that tells it.
_LEAST_PERIODS = 2.0
#: Turns from OFF to ON events that tell a period.
_FEWEST_TURNS = 300
#: Side of the squares of pixels in which both halves of the time are compared, px; the difference of their events over
#: both, and over the counting error, from which something moved; so many squares, and their part of all events.
_SQUARE, _MOVED, _BEYOND, _FEWEST_SQUARES, _MOVED_PART = 16, 0.25, 6.0, 4, 0.25


def unsteady(tally: EventTally) -> str | None:
    """A line that says that the rate of a recording changes; None where it is steady enough.

    The last quarter of the slices against the first, and the largest against the mean, each beyond what counting does.
    """
    count = tally.slices.sum(axis=(0, 2))
    if count.sum() == 0:
        return None
    # rate of each slice of time, Hz a pixel
    each = count / (tally.pixels * tally.seconds / SLICES)
    mean = each.mean()
    early, late = each[: SLICES // 4].mean(), each[-SLICES // 4 :].mean()
    error = max(each.std(ddof=1), np.sqrt(2 / count.mean()) * mean) / np.sqrt(SLICES / 4)
    burst = count.max() > stats.poisson.isf(_BURST_CHANCE / SLICES, 3 * count.mean())
    if abs(late - early) > max(0.5 * mean, 4 * error) or burst:
        return (
            f"its rate goes from {early:.4g} to {late:.4g} Hz a pixel, at most {each.max():.4g}: the scene moves, the "
            "lamp flickers, or the camera was not settled"
        )
    return None


def not_still(tally: EventTally) -> str | None:
    """A line that says that a recording is not one of a still scene in steady light; None where it may be."""
    return unsteady(tally) or of_a_lamp(tally) or moving(tally) or wandering(tally)


def changes(tally: EventTally) -> bool:
    """The light of the pixels changes, other than by a lamp, so that their levels are not in balance."""
    return any(sign(tally) is not None for sign in (unsteady, moving, wandering))


def moving(tally: EventTally) -> str | None:
    """A line that says that the pixels see their light change again and again, at a steady rate; None where they do
    not, or a lamp does it.
    """
    period_s = tally.period_s()
    if period_s is None or sum(one.size for one in tally.turns_us) < _FEWEST_TURNS or of_a_lamp(tally) is not None:
        return None
    return (
        f"most of its pixels turn from OFF to ON events every {period_s:.3g} s: a target that moves by, or light that "
        "changes; a target is given by --target"
    )


def of_a_lamp(tally: EventTally) -> str | None:
    """A line that says that the ON events follow alternating current; None where chance makes as much of it.

    Of independent events at any time, the squared length of their sum of phases over their number has mean 1.
    """
    on = tally.slices[0].sum(axis=1).astype(np.float64)
    if on.min() == 0 or tally.seconds / SLICES < _LEAST_PERIODS / min(LAMPS_HZ):
        return None
    # a slice that is no whole number of periods has a sum of its own
    turns = np.outer(LAMPS_HZ, np.linspace(0.0, tally.seconds, SLICES + 1))
    even = np.diff(np.exp(2j * np.pi * turns), axis=1) / (2j * np.pi * np.diff(turns, axis=1))
    squares = np.abs(tally.waves - on * even) ** 2
    depth = np.sqrt(np.maximum(np.mean((squares - on) / on**2, axis=1), 0.0))
    power = np.mean(squares / on, axis=1)
    k = int(np.argmax(depth))
    if depth[k] < _LEAST_FLICKER or power[k] < _FLICKER_POWER:
        return None
    return (
        f"its ON events come with a lamp of {LAMPS_HZ[k]:g} Hz (the sum of their phases is {100 * depth[k]:.2g} % of "
        "that of equal ones): the lamp flickers; take one on direct current, or daylight"
    )


def wandering(tally: EventTally) -> str | None:
    """A line that says that the events are elsewhere in the second half of the recording; None where they are not.

    Squares of pixels count whose events differ between both halves by half of their mean rate, and beyond what counting
    makes of events that come in groups. A single pixel that flickers is none of many squares.
    """
    rows, cols = tally.shape
    rows, cols = -(-rows // _SQUARE) * _SQUARE, -(-cols // _SQUARE) * _SQUARE
    count = tally.counts.sum(axis=0).reshape(2, *tally.shape)
    count = np.pad(count, ((0, 0), (0, rows - tally.shape[0]), (0, cols - tally.shape[1])))
    first, second = count.reshape(2, rows // _SQUARE, _SQUARE, cols // _SQUARE, _SQUARE).sum(axis=(2, 4))
    both = first + second
    moved = np.abs(first - second) > np.maximum(_MOVED * both, _BEYOND * np.sqrt(both))
    part = both[moved].sum() / max(both.sum(), 1)
    if np.count_nonzero(moved) < _FEWEST_SQUARES or part < _MOVED_PART:
        return None
    return (
        f"{100 * part:.2g} % of its events are in {np.count_nonzero(moved)} squares of {_SQUARE}x{_SQUARE} px "
        "whose rate changes by half from the first to the second half of the time: something in the scene moves"
    )

"""Where the flux of a pixel bends, by more rays than the pilot has.

The pilot's rays are the same in all windows, but few: on a surface that turns, or in noisy light that moves, their mean
wanders, and marks windows between which the flux of the pixel is a straight line. Where the marked windows of a pixel
would take many rays, each is therefore looked at with a part of these, and of those only the ones are rendered that a
polyline through them needs.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.tuning import Tuning
from hesim_render.sources.render.change_driven.windows import Windows

#: Repetition of these rays in the stream of decision rays, of which lines have 0 to 2.
_REPEAT = 3


def straightened(
    tracer: PairTracer,
    index: NDArray[np.uint32],
    windows: Windows,
    what: Plan,
    tuning: Tuning,
    among: NDArray[np.int64] | None = None,
    until: int | None = None,
) -> Plan:
    """A plan without the windows between which the flux of a pixel is a straight line.

    Parameters
    ----------
    tracer : traces the looks.
    index : [n], pixels of the plan on the full sensor.
    windows : the windows of the plan.
    what : plan of a whole block, so that no value depends on the end of a run.
    tuning : constants.
    among : places of the pixels that are looked at; None for all.
    until : last window that is asked for, see `Plan.until`; None for the last one. What is rendered behind the first
        window that a pixel needs from there on is unknown.
    """
    last = what.rendered.shape[0] - 1
    # windows that are rendered by themselves, and may be left out: neither ends of the block nor small objects
    marked = what.rendered & (what.differences.rays == 0) & ~what.barred
    marked[[0, last]] = False
    count = np.count_nonzero(marked, axis=0)
    rays = np.where(marked, what.rays, 0).sum(axis=0, dtype=np.int64)
    # where the looks at these and at both ends take a small part of the rays
    asks = (count > 1) & (rays >= tuning.bend_gain * tuning.bend_rays * (count + 2))
    place = np.flatnonzero(asks) if among is None else among[asks[among]]
    if place.size == 0:
        return what
    looks = marked[:, place]
    looks[[0, last]] = True

    def look(window: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.float32]:
        pixel = place[column]
        of = index[pixel], window, windows, tuning.bend_rays, 1.0, Stream.RENDER_EDGE
        seen = tracer.pilot(*of, repeat=_REPEAT)
        return np.where(what.controlled[window, pixel], seen.controlled, seen.plain)

    centre_us = 0.5 * (windows.begin_us + windows.end_us)
    most = np.float32(tuning.bend) * what.wanted[:, place]
    window, column = np.nonzero(looks & ~polyline(look, looks, centre_us, most, last if until is None else until))
    what = what.without(window, place[column])
    # their looks say which windows may be left out; following edges would need fits behind the end of the run as well
    followed = np.ones(index.size, np.bool_)
    followed[place] = False
    return replace(what, fitted=what.fitted & followed, asked=what.asked & followed)


def polyline(
    look: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float32]],
    known: NDArray[np.bool_],
    time_us: NDArray[np.float64],
    most: NDArray[np.float32],
    until: int,
) -> NDArray[np.bool_]:
    """Windows that a line from one to the next needs, so that no other that can be looked at is further from it than
    its bound.

    From one needed window to the next goes the longest line of that kind, by the cone of slopes that pass all windows
    between [williams1978]. What is needed up to a window therefore follows from looks a little beyond it: those behind
    are not taken.

    Parameters
    ----------
    look : gives the flux in windows [k] of pixels [k], e⁻/s.
    known : [window, n], windows that can be looked at; the first and the last one are among them.
    time_us : [window], µs.
    most : [window, n], largest distance from the line, e⁻/s.
    until : behind the first needed window from this one on, all known windows count as needed.

    Returns
    -------
    The needed windows, [window, n].
    """
    pixels, count = known.shape[1], np.count_nonzero(known, axis=0)
    # the windows of each pixel in order of time, [number, n]; filled up with the last one
    window = np.sort(np.where(known, np.arange(known.shape[0])[:, None], known.shape[0] - 1), axis=0)[: count.max()]
    number, times = np.arange(window.shape[0])[:, None], time_us[window]
    flux, bound = np.zeros(window.shape), np.take_along_axis(most, window, axis=0).astype(np.float64)
    # numbers [n]: of looks that were taken, of the last needed window, of the furthest one that a line from there
    # reaches, and of the next one to be tried
    taken, begin, furthest, trying = np.zeros((4, pixels), np.int64)
    trying += 1
    # slopes of the lines from there that pass all windows between
    least, largest = np.full(pixels, -np.inf), np.full(pixels, np.inf)
    needed, active = known.copy(), np.arange(pixels)
    # the first looks: all up to the end, and one behind it; the others one by one
    at_first = np.count_nonzero(known[: until + 1], axis=0) + 1
    while active.size:
        # more looks, where the next window has none yet
        short = active[trying[active] >= taken[active]]
        if short.size:
            upto = np.minimum(np.maximum(at_first[short], taken[short] + 1), count[short])
            row, col = np.nonzero((number >= taken[short]) & (number < upto))
            flux[row, short[col]] = look(window[row, short[col]], short[col])
            taken[short] = upto
        # the line to the next window passes all between if its slope is one of those that do
        start, now = begin[active], trying[active]
        span = times[now, active] - times[start, active]
        rise, room = flux[now, active] - flux[start, active], bound[now, active]
        slope = rise / span
        reaches = (least[active] <= slope) & (slope <= largest[active])
        furthest[active[reaches]] = now[reaches]
        # of these, fewer pass that window as well
        least[active] = np.maximum(least[active], (rise - room) / span)
        largest[active] = np.minimum(largest[active], (rise + room) / span)
        trying[active] += 1
        # no line goes further, or no window is left: the furthest one is needed, and none before it
        ends = active[(least[active] > largest[active]) | (trying[active] == count[active])]
        row, col = np.nonzero((number > begin[ends]) & (number < furthest[ends]))
        needed[window[row, ends[col]], ends[col]] = False
        # the next line begins there
        begin[ends], trying[ends] = furthest[ends], furthest[ends] + 1
        least[ends], largest[ends] = -np.inf, np.inf
        is_done = (furthest[ends] == count[ends] - 1) | (window[furthest[ends], ends] >= until)
        active = np.setdiff1d(active, ends[is_done], assume_unique=True)
    return needed

"""Where the flux of a pixel bends, by more rays than the pilot has.

The pilot's rays are the same in all windows, but few: on a surface that turns, or in noisy light that moves, their mean
wanders, and marks windows between which the flux of the pixel is a straight line. Where the marked windows of a pixel
would take many rays, each is therefore looked at with a part of these, and of those only the ones are rendered that a
polyline through them needs.
"""

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
    window, column = np.nonzero(looks)
    pixel = place[column]
    seen = tracer.pilot(*(index[pixel], window, windows, tuning.bend_rays, 1.0, Stream.RENDER_EDGE), repeat=_REPEAT)
    flux = np.zeros(looks.shape, np.float32)
    flux[window, column] = np.where(what.controlled[window, pixel], seen.controlled, seen.plain)
    centre_us = 0.5 * (windows.begin_us + windows.end_us)
    needed = polyline(flux, looks, centre_us, np.float32(tuning.bend) * what.wanted[:, place])
    window, column = np.nonzero(looks & ~needed)
    what = what.without(window, place[column])
    return replace(what, fitted=what.fitted & what.rendered, asked=what.asked & what.rendered)


def polyline(
    flux: NDArray[np.float32], known: NDArray[np.bool_], time_us: NDArray[np.float64], most: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Known windows that a line from one to the next needs, so that no other is further from it than its bound.

    The first and the last window are needed. Of those between, the one that is furthest off is added, for each stretch
    by itself, until none is off [douglas1973].

    Parameters
    ----------
    flux : [window, n], e⁻/s.
    known : [window, n], the first and the last window are.
    time_us : [window], µs.
    most : [window, n], largest distance from the line, e⁻/s.

    Returns
    -------
    The needed windows, [window, n].
    """
    count = flux.shape[0]
    needed = np.zeros(known.shape, np.bool_)
    needed[[0, -1]] = True
    every = np.arange(count)[:, None]
    while True:
        # needed windows before and after each one
        before = np.maximum.accumulate(np.where(needed, every, 0), axis=0)
        after = np.minimum.accumulate(np.where(needed, every, count - 1)[::-1], axis=0)[::-1]
        begin, end = time_us[before], time_us[after]
        low, high = (np.take_along_axis(flux, number, axis=0) for number in (before, after))
        part = (time_us[:, None] - begin) / np.where(end > begin, end - begin, 1)
        off = np.where(known & ~needed, np.abs(flux - (low + part * (high - low))) / most, 0)
        # of each stretch the window that is furthest off; stretches of a pixel are named by their first window
        worst = np.zeros(flux.shape)
        np.maximum.at(worst, (before, np.broadcast_to(np.arange(flux.shape[1]), before.shape)), off)
        add = (off > 1) & (off == np.take_along_axis(worst, before, axis=0))
        if not add.any():
            return needed
        needed |= add

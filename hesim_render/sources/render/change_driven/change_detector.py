"""Few rays tell which pixels are even, and in which windows these show anything new.

A sensor with a tick has to be looked at in each window, since things move by pixels from one tick to the next, but most
pixels show the same in all windows of a block. A part of the pilot's rays is enough to see that in an *even* pixel,
whose rays all see the same light: whatever comes is brighter or darker. Where rays differ, as at an edge or in a
penumbra, a small change turns few of them, and such pixels are looked at with all pilot rays.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.windows import Windows

#: Rays of the detector.
DETECTOR_RAYS = 8
#: Largest scatter of single rays of an even pixel, in wanted errors; of one deviating ray in 32, the mild scatter is
#: this part. Chosen on `camera-sweep` on `gen2` with known shadows, judged on `pendulum` on `gen2`; with 2 more looks,
#: and with 16 fewer, at the same errors.
_EVEN, _MILD = np.float32(6.0), np.float32(32**-0.25)
#: Relative differences of fluxes that rounding explains, and differences over the wanted error that count as none;
#: chosen on `camera-sweep` on `gen2`, judged on it and on `rotating-star` and `pendulum` on `davis346`.
_ROUNDING, _SAME = np.float32(1e-5), np.float32(1.0)
#: Maps the flux of each site to the wanted error of a pair, both [site], e⁻/s.
Wanted = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def least_change(flux: NDArray[np.float32], wanted: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Smallest change of the pilot's flux that means that a pixel shows something new, [site], e⁻/s.

    Parameters
    ----------
    flux : [site], e⁻/s.
    wanted : [site], wanted error of a pair with this flux, e⁻/s; None: any change counts that is not due to rounding.
    """
    least = _ROUNDING * np.abs(flux)
    return least if wanted is None else np.maximum(least, _SAME * wanted)


def better_estimate(seen: PilotFlux) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Flux by the estimator that scatters less, and its scatter, e⁻/s."""
    controlled = seen.controlled_scatter <= seen.plain_scatter
    flux = np.where(controlled, seen.controlled, seen.plain)
    return flux, np.where(controlled, seen.controlled_scatter, seen.plain_scatter)


def _turns(sites: Sites, place: NDArray[np.int64], count: int, stride: int) -> Iterator[NDArray[np.bool_]]:
    """Windows in which each set of rays looks at the sites at some places, [window, place]; the first one always."""
    if sites.board is None:
        # two sets, so that what one misses is seen a window later
        for one in range(2):
            turn = np.zeros((count, place.size), np.bool_)
            turn[[0, *range(1 + one, count - 1, 2)]] = True
            yield turn
        return
    # the fields of a chequered board; which of them is the sequence of Thue and Morse, with which no motion keeps pace
    which = np.array([window.bit_count() % 2 for window in range(count)], np.bool_)
    turn = which[:, None] ^ sites.board.odd[place]
    turn[np.arange(count) % stride > 0] = False
    # what comes between the last look of few rays and that of all would go unseen
    turn[[0, count - 2]], turn[-1] = True, False
    yield turn


def seen_with_few_or_all(
    tracer: PairTracer,
    sites: Sites,
    window: NDArray[np.integer],
    windows: Windows,
    rays: int,
    width_px: float,
    span_us: tuple[float, float] | None,
    wanted: Wanted,
) -> PilotFlux:
    """What sites with neighbours show in one window each: few rays see that of even sites, all rays that of the others,
    of those beside them, whose few rays may have missed what is there, and of those that seem to be constant.

    Parameters
    ----------
    sites, window, windows : the sites, their windows [site], and all windows. Of the outermost ones it is not known
        whether sites beside them are even, so that nothing may follow from what these show.
    rays, width_px, span_us : of the pilot, see `PairTracer.pilot`; without `span_us` no site is constant.
    wanted : wanted error of each site.
    """
    few = tracer.pilot(sites.index, window, windows, DETECTOR_RAYS, width_px, span_us=span_us)
    flux, scatter = better_estimate(few)
    asks = sites.near(scatter > _EVEN * wanted(flux), 1)
    if span_us is not None:
        # what nothing comes near keeps its flux for the whole run
        asks |= ~sites.near(few.met, 1)
    some = np.flatnonzero(asks)
    if some.size:
        seen = tracer.pilot(sites.index[some], window[some], windows, rays, width_px, span_us=span_us)
        few = few.with_pairs(some, seen)
    return few


def windows_with_changes(
    tracer: PairTracer,
    sites: Sites,
    numbers: NDArray[np.int64],
    windows: Windows,
    first: PilotFlux,
    near: NDArray[np.bool_],
    wanted: Wanted,
    width_px: float,
    mild: bool = False,
    shadows: NDArray[np.uint32] | None = None,
    stride: int = 1,
) -> NDArray[np.bool_]:
    """Windows between the first and the last one in which the pilot looks with all its rays, [window, site].

    Few rays look at sites that are even in the first window: where pixels lie on no lattice in each window, by two
    sets of rays in turn, else by one set, at a site or at those beside it, in every `stride`-th window. The pilot
    looks where they differ from what they saw last, or among each other, and in the windows before and after. Sites
    that are not even in the first window are looked at in all windows.

    Parameters
    ----------
    tracer : traces the rays, which have random numbers of their own.
    sites : pixels with their neighbours.
    numbers : [window, site], window number of each site; three windows at least.
    windows : all windows.
    first : what the pilot saw in the first window, [site].
    near : [site], True where anything may change.
    wanted : wanted error of each site.
    width_px : width of the area in which the rays start, px.
    mild : take the mild scatter, see `PilotFlux`.
    shadows : [site], known shadows, see `PairTracer.trace`; None for none.
    stride : windows in which nothing moves by more than a pixel, a power of two.
    """
    count, size = numbers.shape
    most = _EVEN * _MILD if mild else _EVEN
    flux, scatter = better_estimate(first)
    even = near & (scatter <= most * wanted(flux))
    place = np.flatnonzero(even)
    # [window, site]; `seen` where few rays have looked
    new, seen = np.zeros((2, count, size), np.bool_)
    for number, turn in enumerate(_turns(sites, place, count, stride)):
        window, column = np.nonzero(turn)
        site = place[column]
        got = tracer.pilot(
            *(sites.index[site], numbers[window, site], windows, DETECTOR_RAYS, width_px, Stream.RENDER_DETECTOR),
            repeat=number,
            mild=mild,
            shadows=None if shadows is None else shadows[site],
        )
        flux_there, scatter_there = better_estimate(got)
        # what this set saw of each site the last time, and when
        last, when = np.zeros(size, np.float32), np.zeros(size, np.int16)
        wanted_there = wanted(last)
        ends = np.searchsorted(window, np.arange(count + 1))
        for now, (begin, end) in enumerate(pairwise(ends.tolist())):
            if begin == end:
                continue
            some, level, spread = site[begin:end], last.copy(), np.zeros(size, np.float32)
            level[some], spread[some] = flux_there[begin:end], scatter_there[begin:end]
            wanted_before, wanted_there = wanted_there, wanted(level)
            if now:
                differs = np.abs(level - last) > least_change(last, wanted_before)
                differs |= spread > most * wanted_there
                new[now, some], seen[now, some] = differs[some], True
                if sites.board is not None:
                    # in windows since the last look, in which these rays did not look
                    for between in range(int(when[differs].min(initial=now)) + 1, now):
                        new[between] |= differs & (when < between)
            last, when[some] = level, now
    out = new.copy()
    out[1:] |= new[:-1]
    out[:-1] |= new[1:]
    if sites.board is not None:
        # neighbours look in the windows in which a site is not looked at
        for each in range(1, count - 1):
            out[each] |= sites.board.near(new[each] & seen[each], 1) & ~seen[each] & even
    out |= near & ~even
    out[[0, -1]] = False
    return out

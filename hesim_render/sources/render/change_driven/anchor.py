"""Anchors: a window of every 64 ms in which pixels are rendered with many rays, to compare other windows with.

The anchor of a window depends on its time alone, so that a pixel has the same values in all runs.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.edges import PairEdges
from hesim_render.sources.render.change_driven.estimates import Band, Flux
from hesim_render.sources.render.change_driven.kept_pilots import Anchored
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, not_negative
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.windows import Windows

#: Time from one anchor to the next, µs; for ticks, at least so many blocks.
_PERIOD_US, _BLOCKS = 64_000, 4
#: Blocks of one anchor from which on its pilot tells what comes near in any of them: each asks again, but for fewer
#: sites. Chosen on `traffic-light`, so that blocks of the star stay as they are.
_MANY_BLOCKS = 16


def period_us(end_us: NDArray[np.float64], has_ticks: bool) -> float:
    """Time from one anchor to the next, µs, for blocks with windows that end at these times, which may be ticks."""
    return max(_PERIOD_US, _BLOCKS * float(end_us[-1] - end_us[0])) if has_ticks else _PERIOD_US


def anchor_us(
    begin_us: NDArray[np.float64], end_us: NDArray[np.float64], has_ticks: bool, window: int = 0
) -> tuple[float, float]:
    """Begin and end of the anchor of a window of a block, µs: a window as long as this one.

    Parameters
    ----------
    begin_us, end_us : [w], the windows of the block, µs.
    has_ticks : True if they may be ticks.
    window : number of the window, the first or the last one.
    """
    end, period = float(end_us[window]), period_us(end_us, has_ticks)
    last = float(np.floor(end / period) * period)
    return last - (end - float(begin_us[window])), last


def is_short(renderer: AdaptiveRenderer, block_us: float) -> bool:
    """True if many blocks of this length, µs, have the same anchor, whose pilot tells what rests in all of them."""
    # where outlines before a sky move, the same rays, which meet nothing that moves, bring another flux
    return not (renderer.has_ticks or renderer.tracer.moves_outlines) and _MANY_BLOCKS * block_us <= _PERIOD_US


class Anchor:
    """The pixels of a band in one anchor. They are rendered when they are first needed.

    Parameters
    ----------
    renderer, band : renders these pixels.
    span_us : begin and end of the anchor, µs.
    block_us : interval of a block that begins with the anchor, in which the pilot tells what comes near, µs; None: it
        tells nothing. Where blocks are so short that many have one anchor, it tells what comes near in any of them.
    flux : [1, n], flux of the pixels there, where it is known already.
    pilot : the pilot, where it is known.

    Attributes
    ----------
    span_us : as given.
    pilot : the pilot of all sites.
    """

    def __init__(
        self,
        renderer: AdaptiveRenderer,
        band: Band,
        span_us: tuple[float, float],
        block_us: tuple[float, float] | None = None,
        flux: Flux | None = None,
        pilot: Anchored | None = None,
    ) -> None:
        self.span_us, self._renderer, self._band = span_us, renderer, band
        self._windows = Windows(*(np.array([time]) for time in span_us))
        near_us, is_long = None, False
        if block_us is not None:
            # rays look for objects in the boxes of this interval, so that it has to hold the anchor
            near_us, length_us = (min(span_us[0], block_us[0]), max(span_us[1], block_us[1])), block_us[1] - block_us[0]
            if is_short(renderer, length_us):
                # the last block may go on behind the next anchor
                near_us, is_long = (span_us[0], max(near_us[1], span_us[1] + _PERIOD_US + length_us)), True
        self.pilot = pilot or renderer.pilot_rays(band, self._windows, near_us, is_long)
        count = band.place.size
        self._flux, self._is_known = Flux.zeros(1, count) if flux is None else flux, np.full(count, flux is not None)
        self._plan: Plan | None = None
        #: Means of a number of rays by one estimator, and where they are known.
        self._means: dict[tuple[int, bool], tuple[PairFlux, NDArray[np.bool_]]] = {}

    def render(self, windows: Windows, what: Plan, first: Flux | None, out: Flux) -> None:
        """Render the differences of a plan: of the first and the last window to this anchor, of others to the first.

        Parameters
        ----------
        windows : the windows of the block.
        what : plan of the block.
        first : [1, n], flux in the first window, where it is known; it is not rendered again.
        out : [w, n], where the flux is put.
        """
        renderer, band, chosen = self._renderer, self._band, what.differences
        # [window, pixel]
        todo = what.rendered & (chosen.rays > 0)
        if first is not None:
            todo[0] = False
        before = renderer.uncounted
        window, place = np.nonzero(todo)
        if place.size == 0:
            return
        pairs = window, place, chosen.rays[todo], chosen.controlled[todo]
        now = renderer.tracer.trace(band.index[place], window, windows, *pairs[2:], signed=True)
        got, error = self.compared(windows, first, pairs, now)
        out.half_a[todo], out.half_b[todo], out.error[todo] = (
            got.half_a,
            got.half_b,
            np.hypot(error, chosen.error[todo]),
        )
        renderer.counts.rays += renderer.uncounted - before
        renderer.counts.pairs += place.size

    def link(
        self,
        windows: Windows,
        first: Flux | None,
        what: Plan,
        todo: NDArray[np.bool_],
        rays: NDArray[np.integer],
        edges: PairEdges | None,
        flux: PairFlux,
    ) -> NDArray[np.float32]:
        """Make differences of the linked pairs of a plan that were rendered by themselves.

        Parameters
        ----------
        windows, first : see `render`.
        what, todo : the plan, and the pairs [window, pixel] that were rendered.
        rays : [k], numbers of rays of these.
        edges : their lines; those that have one have less noise than most that they could be compared with, and stay.
        flux : [k], changed in place.

        Returns
        -------
        Expected errors, [k].
        """
        error, chosen = what.error[todo], what.differences
        linked = np.flatnonzero(chosen.linked[todo] & (True if edges is None else ~edges.is_there))
        if linked.size == 0:
            return error
        window, place = (values[linked] for values in np.nonzero(todo))
        pairs = window, place, rays[linked], what.controlled[todo][linked]
        moved, base = self.compared(windows, first, pairs, flux.at(linked))
        flux.put_at(linked, moved)
        error[linked] = np.hypot(base, chosen.error[todo][linked])
        return error

    def compared(
        self, windows: Windows, first: Flux | None, pairs: tuple[NDArray, NDArray, NDArray, NDArray], now: PairFlux
    ) -> tuple[PairFlux, NDArray[np.float32]]:
        """Flux of pairs from the means of some rays in their windows, by the same rays in the windows that they are
        compared with: ends of the block with the anchor, the windows between them with the first window.

        Parameters
        ----------
        windows, first : see `render`.
        pairs : window, place, number of rays and estimator of each pair, [k].
        now : means of these rays.

        Returns
        -------
        Flux, and the expected error of the other windows, [k].
        """
        window, place, rays, controlled = pairs
        then, other, error = PairFlux.empty(place.size), PairFlux.empty(place.size), np.empty(place.size, np.float32)
        inner = (window > 0) & (window < windows.size - 1)
        for is_inner in np.unique(inner):
            some = np.flatnonzero(inner == is_inner)
            own, given = place[some], (rays[some], controlled[some])
            if is_inner:
                assert first is not None
                means, base = self._in_first(windows, own, *given), first.at(own)
            else:
                means, base = self._means_of(own, *given), self.flux_of(own)
            then.half_a[some], then.half_b[some] = means.half_a, means.half_b
            other.half_a[some], other.half_b[some], error[some] = (values[0] for values in base.arrays)
        # the flux of the window that was compared with, and the difference of the same rays, for each half apart
        halves = other.half_a + (now.half_a - then.half_a), other.half_b + (now.half_b - then.half_b)
        got = PairFlux(halves[0], halves[1], now.met)
        # a difference may be larger than the flux itself where both are near zero
        not_negative(got)
        return got, error

    def _in_first(
        self, windows: Windows, place: NDArray[np.int64], rays: NDArray[np.integer], controlled: NDArray[np.bool_]
    ) -> PairFlux:
        """Means of numbers of rays of some pixels in the first window; the same rays serve all other windows."""
        # each pixel once, by each number of rays and each estimator
        distinct, which = np.unique(np.stack([place, rays, controlled]).astype(np.int64), axis=1, return_inverse=True)
        of = self._band.index[distinct[0]], np.zeros(distinct.shape[1], np.int64), windows
        return self._renderer.tracer.trace(*of, distinct[1], distinct[2] > 0, signed=True).at(which.ravel())

    def rays_of(self, what: Plan, todo: NDArray[np.bool_]) -> tuple[int, int, int]:
        """Rays of the differences `todo` of a plan, of those in the anchor to compare with, and of the flux there."""
        rays = np.where(todo, what.differences.rays, 0).astype(np.int64)
        is_at_end = np.zeros(todo.shape[0], np.bool_)
        is_at_end[[0, -1]] = True
        # each pair once, and of the inner windows of a pixel the rays in the first window once
        own = int(rays.sum() + rays[~is_at_end].max(axis=0, initial=0).sum())
        # pixels whose flux in the anchor is needed
        compared = (rays[is_at_end] > 0).any(axis=0)
        flux = int(self._own_plan().rays[0][compared].sum(dtype=np.int64))
        return own, int(rays[is_at_end].sum()), flux

    def _own_plan(self) -> Plan:
        """How the pixels are rendered in the anchor."""
        if self._plan is None:
            renderer, band = self._renderer, self._band
            first = np.zeros((1, band.sites.size), np.int64)
            pilot, _ = renderer.pilot(band, self._windows, first, None, known=self.pilot.flux)
            self._plan = renderer.sharing.planned(renderer.plan(pilot, band, is_knot=True), band, renderer.counts)
        return self._plan

    @property
    def shares(self) -> NDArray[np.bool_] | None:
        """Pixels that share in the anchor, [n]; None where nothing is shared."""
        shared = self._own_plan().shared if self._renderer.sharing.lattice is not None else None
        return None if shared is None else shared[0]

    def flux_of(self, place: NDArray[np.int64]) -> Flux:
        """Flux of some pixels in the anchor, [1, n]."""
        new = np.zeros(self._band.place.size, np.bool_)
        new[place] = True
        # only pixels that no earlier block has asked for
        new &= ~self._is_known
        if new.any():
            renderer, band = self._renderer, self._band
            what = replace(self._own_plan(), rendered=new[None])
            numbers = np.zeros((1, new.size), np.int64)
            flux, _ = renderer.render(band, self._windows, numbers, what, is_anchor=True)
            self._flux.put(new, flux.at(new))
            self._is_known |= new
        return self._flux.at(place)

    def _means_of(self, place: NDArray[np.int64], rays: NDArray[np.integer], controlled: NDArray[np.bool_]) -> PairFlux:
        """Means of numbers of rays of some pixels in the anchor."""
        means = PairFlux.empty(place.size)
        size = self._band.place.size
        for count, is_controlled in {
            (int(n), bool(by)) for n, by in zip(*np.unique([rays, controlled], axis=1), strict=True)
        }:
            # means by number of rays and estimator are kept: later blocks compare with the same anchor
            values, is_known = self._means.setdefault(
                (count, is_controlled), (PairFlux.empty(size), np.zeros(size, np.bool_))
            )
            own = np.flatnonzero((rays == count) & (controlled == is_controlled))
            new = np.unique(place[own])
            new = new[~is_known[new]]
            if new.size:
                every = np.zeros(new.size, np.int64)
                got = self._renderer.tracer.trace(
                    *(self._band.index[new], every, self._windows, every + count, np.full(new.size, is_controlled)),
                    signed=True,
                )
                values.half_a[new], values.half_b[new], is_known[new] = got.half_a, got.half_b, True
            means.half_a[own], means.half_b[own] = values.half_a[place[own]], values.half_b[place[own]]
        return means

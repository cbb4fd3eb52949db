"""Anchors: a window of every 64 ms in which pixels are rendered with many rays, to compare other windows with.

The anchor of a window depends on its time alone, so that a pixel has the same values in all runs.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.estimates import Band, Flux
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, not_negative
from hesim_render.sources.render.change_driven.pilot import Anchored
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.windows import Windows

#: Time from one anchor to the next, µs; for ticks, at least so many blocks.
_PERIOD_US, _BLOCKS = 64_000, 4


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


class Anchor:
    """The pixels of a band in one anchor. They are rendered when they are first needed.

    Parameters
    ----------
    renderer, band : renders these pixels.
    span_us : begin and end of the anchor, µs.
    flux : [1, n], flux of the pixels there, where it is known already.
    near_us : interval in which the pilot tells what comes near, µs; that of a block which begins with the anchor.
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
        flux: Flux | None = None,
        near_us: tuple[float, float] | None = None,
        pilot: Anchored | None = None,
    ) -> None:
        self.span_us, self._renderer, self._band = span_us, renderer, band
        self._windows = Windows(*(np.array([time]) for time in span_us))
        self.pilot = renderer.pilot_rays(band, self._windows, near_us) if pilot is None else pilot
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
        before, last = renderer.tracer.rays_done, todo.shape[0] - 1
        number = np.arange(todo.shape[0])[:, None]
        # ends of the block are compared with the anchor, the windows between them with the first window
        for is_inner in (False, True):
            some = todo & (((number > 0) & (number < last)) == is_inner)
            window, place = np.nonzero(some)
            if place.size == 0:
                continue
            rays, controlled = chosen.rays[some], chosen.controlled[some]
            now = renderer.tracer.trace(band.index[place], window, windows, rays, controlled, signed=True)
            if is_inner:
                assert first is not None
                # the same rays of a pixel in the first window serve all others
                # all inner windows of a pixel have one number of rays, so any of them tells it
                pixel, own = np.unique(place, return_index=True)
                of = band.index[pixel], np.zeros(pixel.size, np.int64), windows, rays[own], controlled[own]
                then = renderer.tracer.trace(*of, signed=True).at(np.searchsorted(pixel, place))
                base = first.at(place)
            else:
                then, base = self._means_of(place, rays, controlled), self.flux_of(place)
            # the flux of the window that was compared with, and the difference of the same rays, for each half apart
            halves = [
                own[0] + (new - old)
                for own, new, old in zip(
                    base.arrays, (now.half_a, now.half_b), (then.half_a, then.half_b), strict=False
                )
            ]
            got = PairFlux(halves[0], halves[1], now.met)
            # a difference may be larger than the flux itself where both are near zero
            not_negative(got)
            out.half_a[some], out.half_b[some] = got.half_a, got.half_b
            out.error[some] = np.hypot(base.error[0], chosen.error[some])
        renderer.counts.rays += renderer.tracer.rays_done - before
        renderer.counts.pairs += int(np.count_nonzero(todo))

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
            self._plan = renderer.plan(pilot, band, is_knot=True)
        return self._plan

    def flux_of(self, place: NDArray[np.int64]) -> Flux:
        """Flux of some pixels in the anchor, [1, n]."""
        new = np.zeros(self._band.place.size, np.bool_)
        new[place] = True
        # only pixels that no earlier block has asked for
        new &= ~self._is_known
        if new.any():
            renderer, band = self._renderer, self._band
            what = replace(self._own_plan(), rendered=new[None])
            before = renderer.tracer.rays_done
            flux, _ = renderer.render(band, self._windows, np.zeros((1, new.size), np.int64), what)
            # they are counted with the differences
            renderer.counts.rays -= renderer.tracer.rays_done - before
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

"""What some pixels would take in a block of windows, and how long: pilot and plan of a run, without its picture."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.anchor import Anchor, anchor_us, is_short
from hesim_render.sources.render.change_driven.error_target import Role
from hesim_render.sources.render.change_driven.neighbours import REACH
from hesim_render.sources.render.change_driven.windows import Windows

#: Pairs of which the speed is measured, and rays of each of them; pairs of which the start of a trace is measured.
_PAIRS, _RAYS, _FEW_PAIRS = 8192, 64, 8
#: Traces of a block besides those of its pilot and its decision rays: the picture, and differences with what they are
#: compared with.
_PICTURES = 4


@dataclass(frozen=True)
class Foretold:
    """What a block takes.

    Parameters
    ----------
    rays : [4], rays per pixel: of the block without its first window; in its anchor, to compare with; those of the flux
        there; and those of pilots in the block.
    traces : number of traces, each of which has to be started.
    """

    rays: NDArray[np.float64]
    traces: float


@dataclass(frozen=True)
class Speed:
    """Speed of a tracer on this machine.

    Parameters
    ----------
    picture_ray_s, pilot_ray_s : time of a ray of the picture, which most pairs with many rays decide, and of one
        somewhere, s.
    start_s : time to start a trace, s.
    """

    picture_ray_s: float
    pilot_ray_s: float
    start_s: float


class Foresight:
    """Looks ahead at a run. Nothing of it is work of the run.

    Parameters
    ----------
    renderer : of the run.
    is_dark : no light reaches any pixel.
    """

    def __init__(self, renderer: AdaptiveRenderer, is_dark: bool) -> None:
        self._renderer, self._tracer, self._is_dark = renderer, renderer.tracer, is_dark
        #: Pairs with rays: pixel on the full sensor, begin and end of the window, and number of rays, [n] each.
        self._pairs: list[tuple[NDArray[np.uint32], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]] = []

    def block(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        role: Role,
        until: int | None = None,
        is_anchor: bool = False,
    ) -> Foretold:
        """What listed pixels take in a block of windows without its first one, or in a single window.

        Parameters
        ----------
        pixel : [n], mosaic indices.
        begin_us, end_us : [w], the windows, µs.
        role : use of the pixels.
        until : number of the last window on whose values something depends; None for the last one.
        is_anchor : True for an anchor, which is compared with nothing.
        """
        if self._is_dark or pixel.size == 0:
            return Foretold(np.zeros(4), 0)
        renderer, windows, rays, traces = self._renderer, Windows(begin_us, end_us), np.zeros(4), 0
        # what is traced here is no work of the run: its counts are put back at the end
        counts, done = replace(renderer.counts), self._tracer.rays_done
        for band in renderer.bands(pixel, role):
            numbers = np.broadcast_to(np.arange(windows.size)[:, None], (windows.size, band.sites.size))
            # of the sites, some are neighbours beyond the patch
            share, before = band.place.size / band.sites.size, renderer.counts.pilot_rays
            is_compared = role == "events" and not is_anchor
            anchor = None
            if is_compared:
                block_us = windows.span_us if is_short(renderer, float(np.ptp(end_us))) else None
                anchor = Anchor(renderer, band, anchor_us(begin_us, end_us, renderer.has_ticks), block_us)
            rays[1] += share * (renderer.counts.pilot_rays - before)
            before, started = renderer.counts.pilot_rays, self._tracer.traces
            against = () if anchor is None else (anchor.pilot, renderer.look_stride)
            pilot, _ = renderer.pilot(band, windows, numbers, windows.span_us, *against)
            rays[3] += share * (renderer.counts.pilot_rays - before)
            if anchor is not None and not anchor.pilot.is_in(windows, numbers[0]):
                # the first window is known from the block before
                rays[3] -= band.place.size * renderer.kept_rays
            # the same plan as in a run, of which the rays are counted and not traced
            before, fit = self._tracer.rays_done, None
            block = windows if role == "events" and windows.size > 1 else None
            shares = None if anchor is None or anchor.shares is None else (anchor.shares, anchor.shares)
            what = renderer.plan(pilot, band, is_knot=role == "events", windows=block, shares=shares, until=until)
            if is_anchor:
                what = renderer.sharing.planned(what, band, renderer.counts)
            if windows.size > 1:
                what, fit, *_ = renderer.follow(band, windows, numbers[:, : band.place.size], what)
            rays[0] += self._tracer.rays_done - before
            # the first window of a block belongs to the block before
            todo = what.rendered.copy()
            todo[: -max(1, windows.size - 1)] = False
            if anchor is not None:
                rays[:3] += anchor.rays_of(what, todo)
            todo &= what.differences.rays == 0
            window, place = np.nonzero(todo)
            aims = None if what.aims is None else what.aims.at(window, band.sites.listed[place])
            before = self._tracer.rays_done
            each, _ = renderer.rays_of((band.index[place], window, windows), what, todo, aims, fit, is_anchor)
            rays[0] += int(each.sum(dtype=np.int64)) + self._tracer.rays_done - before
            # what linked pairs are compared with: each pixel once, by each number of rays
            linked = what.differences.linked[todo]
            inner = (window > 0) & (window < windows.size - 1)
            rays[0] += np.unique(np.stack([place, each])[:, linked & inner], axis=1)[1].sum(dtype=np.int64)
            rays[1] += each[linked & ~inner].sum(dtype=np.int64)
            traces += self._tracer.traces - started + _PICTURES
            self._pairs.append((band.index[place], begin_us[window], end_us[window], each.astype(np.int64)))
        renderer.counts, self._tracer.rays_done = counts, done
        return Foretold(rays / pixel.size, traces)

    def may_change(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Event pixels [n] near which a moving object may come at any time, as the pilot of a window says; all others
        are rendered once.
        """
        renderer, windows = self._renderer, Windows(begin_us, end_us)
        always_us, near_by = renderer.still("events").span_us, np.ones(pixel.size, np.bool_)
        if self._is_dark or always_us is None:
            return near_by
        counts, done = replace(renderer.counts), self._tracer.rays_done
        for band in renderer.bands(pixel, "events"):
            _, near = renderer.pilot(band, windows, np.zeros((1, band.sites.size), np.int64), always_us)
            near_by[band.place] = band.sites.most(near, REACH)
        renderer.counts, self._tracer.rays_done = counts, done
        return near_by

    def speed(self) -> Speed:
        """Measured speed: of pixels from the whole region, and of pairs of the blocks that were foretold, where most of
        the rays of the picture are.
        """
        if self._is_dark:
            return Speed(0.0, 0.0, 0.0)
        index = self._renderer.index
        # pixels evenly over the region, as rays cost more where there is more to meet
        even = index[np.linspace(0, index.size - 1, min(index.size, _PAIRS)).astype(np.int64)]
        nothing = np.zeros(even.size)
        start_s = self._seconds(even[:_FEW_PAIRS], nothing[:_FEW_PAIRS], nothing[:_FEW_PAIRS] + 1000)
        pilot_ray_s = self._ray_s(start_s, even, nothing, nothing + 1000)
        if not any(pixel.size for pixel, *_ in self._pairs):
            return Speed(pilot_ray_s, pilot_ray_s, start_s)
        pixel, begin_us, end_us, rays = (np.concatenate(column) for column in zip(*self._pairs, strict=True))
        self._pairs.clear()
        # as often as they have rays
        upto = np.cumsum(rays)
        some = np.searchsorted(upto, (np.arange(_PAIRS) + 0.5) * (upto[-1] / _PAIRS))
        return Speed(self._ray_s(start_s, pixel[some], begin_us[some], end_us[some]), pilot_ray_s, start_s)

    def _ray_s(
        self, start_s: float, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
    ) -> float:
        """Time of a ray of some pairs, s."""
        return max(0.0, self._seconds(pixel, begin_us, end_us) - start_s) / (_RAYS * pixel.size)

    def _seconds(self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]) -> float:
        """Time to trace some pairs, s."""
        done, seconds = self._tracer.rays_done, np.inf
        span_us, window = np.unique(np.stack([begin_us, end_us]), axis=1, return_inverse=True)
        windows = Windows(span_us[0], span_us[1])
        count, controlled = np.full(pixel.size, _RAYS), np.ones(pixel.size, np.bool_)
        for _ in range(3):  # the first pass compiles the kernel
            start = time.perf_counter()
            self._tracer.trace(pixel, window.ravel(), windows, count, controlled)
            seconds = min(seconds, time.perf_counter() - start)
        self._tracer.rays_done = done
        return seconds

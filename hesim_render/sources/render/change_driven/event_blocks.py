"""Event pixels through successive blocks of windows: constant pixels once, the others where they change."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hesim_render.mosaic.schedule import Block
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.anchor import Anchor, anchor_us
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.knots import BlockFlux, Knots
from hesim_render.sources.render.change_driven.windows import Windows

#: Largest number of intervals of a block of an asynchronous sensor. The last window of each block is rendered at all
#: pixels, so that fewer blocks cost less; of a band of pixels, the plan of all windows is held in memory.
INTERVALS = 64


class Blocks:
    """A list of event pixels over successive blocks.

    Parameters
    ----------
    renderer : renders their flux.
    pixel : [n], mosaic indices.
    first : the first block.

    Attributes
    ----------
    alive : places of the pixels that may change.
    base : [1, n], flux of all pixels in the anchor of the first window.
    """

    def __init__(self, renderer: AdaptiveRenderer, pixel: NDArray[np.uint32], first: Block) -> None:
        self._renderer = renderer
        self.base = Flux.zeros(1, pixel.size)
        span_us = anchor_us(first.begin_us, first.end_us)
        begin, end = (np.full(pixel.size, time) for time in span_us)
        renderer.alone(pixel, begin, end, "events", self.base)
        renderer.counts.values -= pixel.size
        self.alive = np.flatnonzero(~renderer.still("events").known[pixel])
        self._bands = list(renderer.bands(pixel[self.alive], "events"))
        known = self.base.at(self.alive)
        self._anchors = [Anchor(renderer, band, span_us, known.at(band.place)) for band in self._bands]
        #: Window whose flux is `_last`.
        self._time: tuple[float, float] | None = None
        self._last = known

    def take(self, block: Block) -> BlockFlux:
        """Flux of the pixels that may change."""
        renderer, windows = self._renderer, Windows(block.begin_us, block.end_us)
        is_next = self._time == (block.begin_us[0], block.end_us[0])
        parts: list[tuple[NDArray[np.int64], Knots]] = []
        centre = 0.5 * (block.begin_us + block.end_us)
        span_us = anchor_us(block.begin_us, block.end_us)
        for number, band in enumerate(self._bands):
            if self._anchors[number].span_us != span_us:
                self._anchors[number] = Anchor(renderer, band, span_us)
            anchor = self._anchors[number]
            first = self._last.at(band.place) if is_next else None
            if first is not None and windows.size == 1:
                parts.append((band.place, Knots.of(first, np.ones((1, band.place.size), np.bool_), centre)))
                continue
            numbers = np.repeat(np.arange(windows.size)[:, None], band.sites.size, axis=1)
            pilot, _ = renderer.pilot(band, windows, numbers, windows.span_us, anchor.pilot, renderer.look_stride)
            what = renderer.plan(pilot, band, is_knot=True).until(int(np.flatnonzero(block.wanted)[-1]))
            numbers = np.repeat(np.arange(windows.size)[:, None], band.place.size, axis=1)
            if first is None:
                # by itself, so that the other windows are traced by the calls of a run that comes from the block before
                first = renderer.render(band, windows, numbers[:1], what.first())[0]
                anchor.render(windows, what.first(), None, first)
            what, fit, followed = renderer.follow(band, windows, numbers, what)
            flux, _ = renderer.render(band, windows, numbers, what, first=first, fit=fit)
            anchor.render(windows, what, first, flux)
            followed.fill(flux, centre)
            known = what.rendered.copy()
            known[followed.window, followed.pixel] = True
            parts.append((band.place, Knots.of(flux, known, centre)))
        out = BlockFlux(self.alive.size, parts)
        # where a block goes on after the run, its last window may be unknown
        is_whole = bool(block.wanted[-1])
        self._time = (float(block.begin_us[-1]), float(block.end_us[-1])) if is_whole else None
        self._last = out.at(windows.size - 1)
        return out

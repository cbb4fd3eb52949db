"""Event pixels through successive blocks of windows: constant pixels once, the others where they change.

Knots are the rendered windows of each pixel in a block, between which its flux is interpolated linearly. Most pixels
have two of them, at both ends of the block. Only knots are held, so that a block of a large sensor may have many
windows.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice, tee, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.mosaic.schedule import BLOCK_CELLS, CELL_US, Block
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.anchor import Anchor, anchor_us, is_short
from hesim_render.sources.render.change_driven.estimates import Flux
from hesim_render.sources.render.change_driven.kept_pilots import Ended
from hesim_render.sources.render.change_driven.one_window import render_one_window
from hesim_render.sources.render.change_driven.plan import Plan
from hesim_render.sources.render.change_driven.windows import Windows

#: Largest number of intervals of a block of an asynchronous sensor. The last window of each block is rendered at all
#: pixels, so that fewer blocks cost less; of a band of pixels, the plan of all windows is held in memory.
INTERVALS = 64
#: Longest block of an asynchronous sensor, µs.
_LONGEST_US = BLOCK_CELLS * CELL_US


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
    own : places of these among the pixels that `take` gives: all of them, or all pixels, where few are constant.
    count : number of pixels that `take` gives.
    base : [1, n], flux of all pixels in the anchor of the first window.
    """

    def __init__(self, renderer: AdaptiveRenderer, pixel: NDArray[np.uint32], first: Block) -> None:
        self._renderer = renderer
        self.base = Flux.zeros(1, pixel.size)
        span_us = anchor_us(first.begin_us, first.end_us, renderer.has_ticks)
        # the anchor of the first window at all pixels: constant pixels keep this flux for the whole run
        begin, end = (np.full(pixel.size, time) for time in span_us)
        block_us = Windows(first.begin_us, first.end_us).span_us
        kept = render_one_window(renderer, pixel, begin, end, "events", self.base, keep=block_us)
        # values of the anchor are no samples of the sensor
        renderer.counts.values -= pixel.size
        self.alive = np.flatnonzero(~renderer.still("events").known[pixel])
        self.own, known = np.arange(self.alive.size), self.base.at(self.alive)
        kept_pixels = sum(band.place.size for band, _ in kept)
        if kept_pixels == pixel.size:
            # few are constant
            self.own, known = self.alive, self.base
        self.count = known.error.shape[1]
        # all pixels that may change, or nearly only these: their bands and pilots go on
        if self.count == kept_pixels:
            pilots = [pilot for _, pilot in kept]
            self._bands = [band for band, _ in kept]
        else:
            kept.clear()
            pilots, self._bands = [], list(renderer.bands(pixel[self.alive], "events"))
        self._anchors = [
            Anchor(renderer, band, span_us, block_us, known.at(band.place), pilot)
            for band, pilot in zip_longest(self._bands, pilots)
        ]
        #: What the pilot of each band saw in the last window of the block before, where it is kept, as a next block may
        #: come.
        self._ended: list[Ended | None] = [None] * len(self._bands)
        self._keeps = False
        #: Window whose flux is `_last`.
        self._time: tuple[float, float] | None = None
        self._last = known
        #: Flux of the next block, where it is known already.
        self._next: BlockFlux | None = None

    def through(self, blocks: Iterable[Block]) -> Iterator[tuple[Block, "BlockFlux"]]:
        """Successive blocks, and what `take` gives for each."""
        for block, following in with_next(blocks):
            yield block, self.take(block, following)

    def take(self, block: Block, following: Block | None = None) -> "BlockFlux":
        """Flux of the pixels that may change; with that of the others where few are constant.

        Parameters
        ----------
        block : its windows.
        following : the block after it; None if there is none.
        """
        if self._next is not None:
            out, self._next = self._next, None
            return out
        if following is not None and is_between(block, following):
            # it is interpolated like any other window in which nothing bends
            self._next = self._taken(following, is_last=False)
            return self._next.between(0.5 * float(block.begin_us[0] + block.end_us[0]))
        return self._taken(block, following is None)

    def _taken(self, block: Block, is_last: bool) -> "BlockFlux":
        """See `take`."""
        windows = Windows(block.begin_us, block.end_us)
        # the block begins with the window that ended the one before, whose flux is known
        is_next = self._time == (block.begin_us[0], block.end_us[0])
        # Dr.Jit keeps memory for arrays of sizes that it had; those of rays, of frames and of pixels are all others
        dr.flush_malloc_cache()
        self._keeps = self._renderer.kept_rays > 0 and not is_last
        parts = [(band.place, self._knots(number, block, windows, is_next)) for number, band in enumerate(self._bands)]
        dr.flush_malloc_cache()
        out = BlockFlux(self._last.half_a.shape[1], parts)
        # where a block goes on after the run, its last window may be unknown
        is_whole = bool(block.wanted[-1])
        self._time = (float(block.begin_us[-1]), float(block.end_us[-1])) if is_whole else None
        self._last = out.at(windows.size - 1)
        return out

    def _knots(self, number: int, block: Block, windows: Windows, is_next: bool) -> "Knots":
        """Knots of one band in a block; what else is known of it there, of which there is much, is let go."""
        renderer, band, last = self._renderer, self._bands[number], windows.size - 1
        # interpolation runs between the middles of windows
        centre = 0.5 * (block.begin_us + block.end_us)
        # anchors of the first and of the last window, which is the first of the next block
        span_us, end_us = (anchor_us(block.begin_us, block.end_us, renderer.has_ticks, k) for k in (0, -1))
        # a new anchor every 64 ms; the old one is no longer compared with
        if self._anchors[number].span_us != span_us:
            self._anchors[number] = Anchor(renderer, band, span_us, windows.span_us)
        anchor = ending = self._anchors[number]
        first = self._last.at(band.place) if is_next else None
        if first is not None and windows.size == 1:
            return Knots.of(first, np.ones((1, band.place.size), np.bool_), centre)
        if end_us != span_us:
            # what the next block will be compared with, which is no longer than this one or 32 ms
            length_us = float(np.ptp(block.end_us))
            if not is_short(renderer, length_us):
                length_us = max(length_us, _LONGEST_US)
            ending = self._anchors[number] = Anchor(renderer, band, end_us, (end_us[0], end_us[1] + length_us))
        what = self._plan(number, block, windows, anchor, ending)
        numbers = np.broadcast_to(np.arange(windows.size)[:, None], (windows.size, band.place.size))
        if first is None and anchor.span_us == (block.begin_us[0], block.end_us[0]):
            first = anchor.flux_of(np.arange(band.place.size))
        if first is None:
            # by itself, so that the other windows are traced by the calls of a run that comes from the block before
            link = partial(anchor.link, windows, None)
            first = renderer.render(band, windows, numbers[:1], what.first(), link=link)[0]
            anchor.render(windows, what.first(), None, first)
        # windows between two fits of one edge, and those that show what an earlier one does, drop out of the plan
        what, fit, followed, held = renderer.follow(band, windows, numbers, what)
        todo, known = what, what.rendered.copy()
        if ending is not anchor and end_us == (block.begin_us[-1], block.end_us[-1]):
            # the last window is the anchor of the next block
            place = np.flatnonzero(what.rendered[last])
            todo = what.without(np.full(place.size, last), place)
        link = partial(ending.link, windows, first)
        flux, _ = renderer.render(band, windows, numbers, todo, first=first, fit=fit, link=link)
        # differences are put beside the pairs that were rendered by themselves
        ending.render(windows, todo, first, flux)
        if todo is not what:
            for values, own in zip(flux.arrays, ending.flux_of(place).arrays, strict=True):
                values[last, place] = own[0]
        # a fit of an edge may be held
        held.fill(flux)
        followed.fill(flux, centre)
        # knots are windows that were rendered, those that an edge was followed through, and those that were held
        known[followed.window, followed.pixel] = True
        known[held.window, held.pixel] = True
        return Knots.of(flux, known, centre)

    def _plan(self, number: int, block: Block, windows: Windows, anchor: Anchor, ending: Anchor) -> Plan:
        """Plan of a band in a block; what lies behind the last wanted window, at the end of a run, is not rendered."""
        renderer, band = self._renderer, self._bands[number]
        numbers = np.broadcast_to(np.arange(windows.size)[:, None], (windows.size, band.sites.size))
        begun, self._ended[number] = self._ended[number], None
        given = band, windows, numbers, windows.span_us, anchor.pilot, renderer.look_stride
        pilot, _ = renderer.pilot(*given, ending=ending.pilot, begun=begun, is_kept=self._keeps)
        self._ended[number] = pilot.ended
        shares = None
        if anchor.shares is not None and ending.shares is not None:
            shares = anchor.shares, ending.shares
        until = int(np.flatnonzero(block.wanted)[-1])
        return renderer.plan(pilot, band, is_knot=True, windows=windows, shares=shares, until=until)


def is_between(block: Block, following: Block) -> bool:
    """True for a single window between the first two of the block that follows: the one with which a run begins."""
    begin, end = block.begin_us, block.end_us
    if begin.size != 1 or following.begin_us.size == 1:
        return False
    return bool(following.begin_us[0] <= begin[0] and end[0] <= following.end_us[1])


def with_next(blocks: Iterable[Block]) -> Iterator[tuple[Block, Block | None]]:
    """Blocks, and the one after each; None after the last one."""
    these, those = tee(blocks)
    return zip_longest(these, islice(those, 1, None))


@dataclass(frozen=True)
class Knots:
    """Knots of n pixels, one pixel after the other, each in order of time; arrays [k].

    Parameters
    ----------
    first : [n + 1], place of the first knot of each pixel, and the number of all knots.
    window : window of each knot; that of the first knot of a pixel is 0.
    values : half A, half B and error, e⁻/s.
    centre_us : [window], middles of the windows, µs.
    """

    first: NDArray[np.int64]
    window: NDArray[np.int16]
    values: tuple[NDArray[np.float32], ...]
    centre_us: NDArray[np.float64]

    @classmethod
    def of(cls, flux: Flux, known: NDArray[np.bool_], centre_us: NDArray[np.float64]) -> "Knots":
        """The known windows [window, pixel] of some pixels; the first window is among them."""
        # in order of pixel, then of window
        pixel, window = np.nonzero(known.T)
        first = np.append(0, np.cumsum(np.count_nonzero(known, axis=0)))
        values = tuple(values[window, pixel] for values in flux.arrays)
        return cls(first, window.astype(np.int16), values, centre_us)

    def places(self, window: int) -> NDArray[np.int64]:
        """Last knot of each pixel up to a window, [n]."""
        # knots in order of pixel and window; one before the first knot that is later
        count = self.centre_us.size
        key = np.repeat(np.arange(self.first.size - 1), np.diff(self.first)) * count + self.window
        return np.searchsorted(key, np.arange(self.first.size - 1) * count + window, side="right") - 1


class _BetweenKnots:
    """Flux of pixels on straight lines from knot to knot; quick for windows one after the other.

    Parameters
    ----------
    knots : of the pixels.
    """

    #: Window of the next knot where there is none.
    _NEVER = np.iinfo(np.int16).max

    def __init__(self, knots: Knots) -> None:
        self._knots, self._at = knots, -2
        size = knots.first.size - 1
        #: Last knot of each pixel, window of the next one, and the windows of both as one number, [n].
        self._low, self._next = np.zeros(size, np.int64), np.zeros(size, np.int16)
        self._pair = np.zeros(size, np.intp)
        #: Values at the last knot, and what they change by up to the next one, [3, n].
        self._start, self._change = np.zeros((3, size), np.float32), np.zeros((3, size), np.float32)

    def _pass(self, place: NDArray[np.int64], low: NDArray[np.int64]) -> None:
        """Note the last knot of some pixels."""
        knots = self._knots
        has_next = low + 1 < knots.first[place + 1]
        high = low + has_next
        self._low[place] = low
        self._next[place] = np.where(has_next, knots.window[high], self._NEVER)
        self._pair[place] = knots.window[low].astype(np.intp) * knots.centre_us.size + knots.window[high]
        for values, start, change in zip(knots.values, self._start, self._change, strict=True):
            start[place] = begin = values[low]
            change[place] = values[high] - begin

    def at(self, window: int) -> NDArray[np.float32]:
        """Half A, half B and error in one window, [3, n]; 0 where no knot is at or after it."""
        centre = self._knots.centre_us
        if window == self._at + 1:
            # most pixels stay between the same two knots; a pixel moves on by one where the next one is reached
            place = np.flatnonzero(self._next <= window)
            self._pass(place, self._low[place] + 1)
        elif window != self._at:
            self._pass(np.arange(self._low.size), self._knots.places(window))
        self._at = window
        # how far the window is on the way from one knot to the next, by the windows of both; 0 from a knot to itself
        begin, span = centre[:, None], centre - centre[:, None]
        way = ((centre[window] - begin) / np.where(span > 0, span, np.inf)).astype(np.float32)
        result = self._start + way.ravel()[self._pair] * self._change
        ended = np.flatnonzero(self._next == self._NEVER)
        result[:, ended[self._pair[ended] // centre.size != window]] = 0
        return result

    def between(self, centre_us: float) -> Flux:
        """Flux at a time between the middles of the first two windows, [1, n]."""
        values, centre = self.at(0), self._knots.centre_us
        span = centre - centre[0]
        way = ((centre_us - centre[0]) / np.where(span > 0, span, np.inf)).astype(np.float32)
        # the first knot is window 0, so `_pair` is the number of the window of the next knot
        return Flux(*(values + way[self._pair] * self._change)[:, None])


class BlockFlux:
    """Flux of pixels in the windows of a block.

    Parameters
    ----------
    size : number of pixels.
    parts : places of some pixels, and their knots.
    """

    def __init__(self, size: int, parts: list[tuple[NDArray[np.int64], Knots]]) -> None:
        self._size, self._parts, self._between = size, parts, [_BetweenKnots(knots) for _, knots in parts]

    def __reduce__(self) -> tuple[Any, ...]:
        """From process to process without what was computed for windows."""
        return BlockFlux, (self._size, self._parts)

    @classmethod
    def joined(cls, lists: "Sequence[BlockFlux]") -> "BlockFlux":
        """Of several lists of pixels, one after the other."""
        begins = np.cumsum([0, *(each._size for each in lists)])
        begun = zip(begins[:-1].tolist(), lists, strict=True)
        return cls(int(begins[-1]), [(begin + place, knots) for begin, each in begun for place, knots in each._parts])

    def between(self, centre_us: float) -> "BlockFlux":
        """A single window whose middle lies between those of the first two."""
        centre, parts = np.array([centre_us]), []
        for (place, _), own in zip(self._parts, self._between, strict=True):
            flux = own.between(centre_us)
            parts.append((place, Knots.of(flux, np.ones(flux.error.shape, np.bool_), centre)))
        return BlockFlux(self._size, parts)

    def at(self, window: int) -> Flux:
        """Flux in one window, [1, size]; quick for windows one after the other."""
        out = np.zeros((3, self._size), np.float32)
        for (place, _), own in zip(self._parts, self._between, strict=True):
            for whole, values in zip(out, own.at(window), strict=True):
                whole[place] = values
        return Flux(*out[:, None])

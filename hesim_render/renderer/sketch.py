"""A few rays of each pixel at many times: where the picture changes, and how many rays it will need there.

Windows come in chunks. The last of a chunk is sketched everywhere; in between, intervals are halved as
long as something may happen in them:

1. A pixel none of whose paths (to the surface, to the lights, onwards) meets the box that a moving object
   sweeps during an interval is constant in it, shadows, mirrors and caustics included.
2. Of the others, the middle of an interval is sketched where the pixel, or one from which the motion can
   reach it, differs between the interval's ends by more than the tolerance.
3. Where the picture moves farther than a few pixels in the interval, or an object by a good part of its own
   size, the ends say nothing: the middle is sketched in any case.

The rays have random numbers of their own (`Stream.RENDER_PILOT`), the same at all times: what they show may
decide about the picture without favouring what its rays happen to miss, and differences between two times
are changes of the scene, not of the rays. They start in an area somewhat larger than the pixel, to see an edge
before the pixel does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.adaptive import AdaptiveTracer, NoiseUnit
from hesim_render.renderer.paths import MET_PASSING, MET_SWEPT
from hesim_render.renderer.surroundings import REACH, Surroundings
from hesim_render.renderer.timed import PairFlux, SweptBoxes

#: Change that counts, in tolerances of the audit.
_CHANGE = 0.7
#: Error of a sketch that moves, over the scatter of its rays: an edge is where they say to within about a fifth.
_DOUBT = 0.1
#: Pixels that need fewer than so many rays get more than they need, n^0.6 in proportion: with an error that falls by
#: n^-0.75 that is the least time for the same error over all pixels. 512 did better than 128 on all three scenes of the
#: benchmark, and 1024 no better on the one where it was tried.
_MANY, _CHEAP = 512, 0.6
#: Rays for each noise unit by which the brightest of the next pixels is above a pixel: what they may miss of it is
#: worth four units at most. So many rays at most for that.
_SLIVER, _MOST_FOR_SLIVERS = 0.25, 512
#: How far away a pixel may be from which something bright comes unseen: a penumbra that ends in deep shadow is so
#: dark in its last pixels that sixteen rays find no light there, nor in the pixel before.
_NEXT = 2
#: Change of one of the next pixels, in tolerances of a pixel's own, of which this one may have a part unseen.
_BESIDE = 128
#: Gaps whose flux in all windows is held at a time.
_GAPS_AT_ONCE = 1 << 16


def generous(needed: NDArray[np.integer] | float) -> NDArray[np.float64]:
    """Rays that a pixel gets where it needs so many."""
    return np.maximum(needed, np.power(needed, _CHEAP) * _MANY ** (1 - _CHEAP))


@dataclass
class Sketch:
    """A few rays' worth of some successive windows, [window, pixel].

    Parameters
    ----------
    begin_us, end_us : its windows.
    flux : mean, e⁻/s; on straight lines where it was not traced.
    scatter : standard deviation of single rays, e⁻/s; likewise.
    met : bits of boxes met, of the interval that a window is the middle of.
    known : what was traced.
    pace, group : motion around each pixel, listed pixels per µs, and the moving group that it sees; [n].
    samples : rays that each pixel needs, [n], of the windows that were asked for.
    """

    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    flux: NDArray[np.float32]
    scatter: NDArray[np.float32]
    met: NDArray[np.uint8]
    known: NDArray[np.bool_]
    pace: NDArray[np.float32] = field(default_factory=lambda: np.empty(0, np.float32))
    group: NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))
    samples: dict[int, NDArray[np.int16]] = field(default_factory=dict)

    @classmethod
    def after(
        cls, begin_us: NDArray[np.float64], end_us: NDArray[np.float64], flux: NDArray, scatter: NDArray
    ) -> Sketch:
        """A sketch whose first window is known."""
        shape = begin_us.size, flux.size
        empty = np.empty(shape, np.float32), np.empty(shape, np.float32)
        sketch = cls(begin_us, end_us, *empty, np.zeros(shape, np.uint8), np.zeros(shape, np.bool_))
        sketch.flux[0], sketch.scatter[0], sketch.known[0] = flux, scatter, True
        return sketch

    @property
    def last(self) -> int:
        return self.begin_us.size - 1

    def span_us(self, low: int, high: int) -> tuple[float, float]:
        return float(self.begin_us[low]), float(self.end_us[high])

    def part(self, low: Any, middle: Any, high: Any) -> Any:
        """Where windows lie between two others, 0 to 1."""
        centre = self.begin_us + self.end_us
        return ((centre[middle] - centre[low]) / (centre[high] - centre[low])).astype(np.float32)


class Gaps(NamedTuple):
    """Windows between two others of a pixel, [k] each: places in the list, and the windows at both ends."""

    place: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]

    def of(self, kept: NDArray) -> Gaps:
        return Gaps(self.place[kept], self.low[kept], self.high[kept])

    def split(self, middle: NDArray[np.int64]) -> Gaps:
        """Both parts of each; first all earlier ones."""
        low, high = np.concatenate([self.low, middle]), np.concatenate([middle, self.high])
        return Gaps(np.tile(self.place, 2), low, high)


def halvings(last: int) -> Iterator[list[tuple[int, int, int]]]:
    """Intervals (low, middle, high) of windows 0 … last, halved level by level down to single windows."""
    level = [(0, last)]
    while level := [(low, high) for low, high in level if high - low >= 2]:
        yield [(low, (low + high) // 2, high) for low, high in level]
        level = [half for low, high in level for half in ((low, (low + high) // 2), ((low + high) // 2, high))]


class Sketcher:
    """Draws sketches of one list of pixels.

    Parameters
    ----------
    adaptive : traces their rays.
    around : what may come near them.
    pixel : [n], mosaic indices.
    unit : what the noise of each listed pixel is worth.
    tolerance : of the audit, in units of that.
    """

    def __init__(
        self,
        adaptive: AdaptiveTracer,
        around: Surroundings,
        pixel: NDArray[np.uint32],
        unit: NoiseUnit,
        tolerance: float,
    ) -> None:
        self._adaptive, self._around, self._pixel, self._unit = adaptive, around, pixel, unit
        self._tolerance = tolerance
        self._everywhere = np.arange(pixel.size)

    def begin(self, begin_us: float, end_us: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Flux and scatter of every pixel in one window, e⁻/s."""
        result = self._everywhere_at(begin_us, end_us, None)
        return result.mean, result.scatter

    def end(self, sketch: Sketch) -> NDArray[np.bool_]:
        """Trace the last window of a sketch, everywhere; which pixels the scene's motion can reach within it, [n]."""
        last = sketch.last
        swept = self._around.swept([sketch.span_us(0, last)], [sketch.span_us(last, last)], 1)
        result = self._everywhere_at(float(sketch.begin_us[last]), float(sketch.end_us[last]), swept)
        sketch.flux[last], sketch.scatter[last] = result.mean, result.scatter
        # what a neighbour's rays come near, some of this pixel's may
        bits = self._met(result)
        for bit in (MET_SWEPT, MET_PASSING):
            sketch.met[last] |= np.uint8(bit) * self._around.near.most(bits & np.uint8(bit) != 0, 1)
        sketch.known[last] = True
        sketch.pace, sketch.group = self._around.pace(*sketch.span_us(0, last))
        return (sketch.met[last] & MET_SWEPT) != 0

    def _everywhere_at(self, begin_us: float, end_us: float, swept: SweptBoxes | None) -> PairFlux:
        count = self._pixel.size
        times = np.full(count, begin_us), np.full(count, end_us)
        return self._adaptive.pilot(self._pixel, *times, swept, np.zeros(count, np.uint32))

    def motion(self, sketch: Sketch, spans: list[tuple[float, float]]) -> NDArray[np.float32]:
        """How far the picture moves around each pixel in some intervals, listed pixels, [intervals, n]."""
        return self._around.motion(spans, sketch.pace, sketch.group)

    def refine(self, sketch: Sketch, tightness: float) -> None:
        """Trace what may have changed between the ends of a sketch; what is known already stays.

        Parameters
        ----------
        tightness : divides the change that counts.
        """
        sketch.samples.clear()
        if sketch.last < 2:
            return
        most = REACH / tightness**0.5
        bits = sketch.met[-1:]
        change = self._beyond(sketch, [(0, sketch.last)], (bits & MET_SWEPT) != 0, tightness)
        for level in halvings(sketch.last):
            spans = [sketch.span_us(low, high) for low, _, high in level]
            middles = np.array([middle for _, middle, _ in level])
            motion = self.motion(sketch, spans)
            active = (bits & MET_SWEPT) != 0
            active &= ((bits & MET_PASSING) != 0) | (motion > most) | self._around.spread(change, motion)
            for low, middle, high in level:
                part, known = sketch.part(low, middle, high), sketch.known[middle]
                for table in (sketch.flux, sketch.scatter):
                    line = table[low] + part * (table[high] - table[low])
                    table[middle] = np.where(known, table[middle], line)
            active &= ~sketch.known[middles]
            if active.any():
                self._trace(sketch, spans, middles, active, bits)
            bits = np.where(sketch.known[middles], sketch.met[middles], bits & np.uint8(MET_SWEPT))
            halves = [
                (number, half)
                for number, (low, middle, high) in enumerate(level)
                for half in ((low, middle), (middle, high))
                if half[1] - half[0] >= 2
            ]
            bits = bits[[number for number, _ in halves]]
            change = self._beyond(sketch, [half for _, half in halves], (bits & MET_SWEPT) != 0, tightness)

    def _trace(
        self,
        sketch: Sketch,
        spans: list[tuple[float, float]],
        middles: NDArray[np.integer],
        where: NDArray[np.bool_],
        bits: NDArray[np.uint8],
    ) -> None:
        """The middles of some intervals, [intervals, n]; `bits` is what the intervals' own parents met."""
        which, place = np.nonzero(where)
        window = middles[which]
        swept = self._around.swept(spans, [sketch.span_us(m, m) for m in middles], 2)
        times = sketch.begin_us[window], sketch.end_us[window]
        result = self._adaptive.pilot(self._pixel[place], *times, swept, which.astype(np.uint32))
        sketch.flux[window, place] = result.mean
        sketch.scatter[window, place] = result.scatter
        sketch.met[window, place] = bits[which, place] & MET_SWEPT if swept is None else self._met(result)
        sketch.known[window, place] = True

    def _met(self, result: PairFlux) -> NDArray[np.uint8]:
        """What was met; everything is, where the camera moves."""
        always = 0 if self._adaptive.tracer.camera is None else MET_SWEPT
        return result.met.astype(np.uint8) | np.uint8(always)

    def _beyond(
        self, sketch: Sketch, intervals: list[tuple[int, int]], where: NDArray[np.bool_], tightness: float
    ) -> NDArray[np.bool_]:
        """Where the ends of some intervals differ by enough to look closer, [intervals, n]."""
        found = np.zeros_like(where)
        for (low, high), asked, out in zip(intervals, where, found, strict=True):
            place = np.flatnonzero(asked)
            first, second = sketch.flux[low, place], sketch.flux[high, place]
            out[place] = np.abs(second - first) > self.allowed(np.minimum(first, second), place, tightness)
        return found

    def steps(self, sketch: Sketch, tightness: float) -> NDArray[np.bool_]:
        """Windows from or to which a pixel's sketch makes a step, [windows, n].

        Of the tolerance where the rays of a pixel agree; of nearly anything where they do not, for what they say of
        an edge that moves is in steps of one ray.
        """
        found = np.zeros_like(sketch.known)
        for window in range(1, sketch.last + 1):
            before, flux = sketch.flux[window - 1], sketch.flux[window]
            tolerance = self.allowed(np.minimum(before, flux), self._everywhere, tightness)
            least = np.maximum(tolerance - _DOUBT * sketch.scatter[window], 0.1 * tolerance)
            change = np.abs(flux - before)
            beside = self._around.near.most(change, _NEXT) > _BESIDE * tolerance
            found[window - 1 : window + 1] |= (change > least) | beside
        return found

    def bends(self, sketch: Sketch, gaps: Gaps, tightness: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Whether the sketch leaves the straight line across gaps by more than it may, and in which window most."""
        window = np.arange(sketch.last + 1)[:, None]
        traced = np.cumsum(sketch.known, axis=0, dtype=np.int8)
        found, where = np.zeros(gaps.place.size, np.bool_), np.zeros(gaps.place.size, np.int64)
        # only what was traced can leave the line
        inside = np.flatnonzero(traced[gaps.high - 1, gaps.place] > traced[gaps.low, gaps.place])
        for part in np.split(inside, range(_GAPS_AT_ONCE, inside.size, _GAPS_AT_ONCE)):
            place, low, high = gaps.place[part], gaps.low[part], gaps.high[part]
            flux, column = sketch.flux[:, place], np.arange(place.size)
            begin, end = flux[low, column], flux[high, column]
            off = np.abs(flux - (begin + sketch.part(low, window, high) * (end - begin)))
            allowed = self.allowed(np.minimum(begin, end), place, tightness).astype(np.float32)
            off /= np.maximum(allowed, 2 * _DOUBT * sketch.scatter[:, place])
            off[(window <= low) | (window >= high)] = 0
            where[part] = off.argmax(axis=0)
            found[part] = off[where[part], column] > 1
        return found, where

    def misses(self, sketch: Sketch, gaps: Gaps, change: NDArray[np.float32], tightness: float) -> NDArray[np.bool_]:
        """Whether the picture changes across gaps by what the sketch, for all its doubt, does not say half of.

        Parameters
        ----------
        change : of the picture, e⁻/s, one a gap.
        """
        begin, end = sketch.flux[gaps.low, gaps.place], sketch.flux[gaps.high, gaps.place]
        doubt = _DOUBT * np.maximum(sketch.scatter[gaps.low, gaps.place], sketch.scatter[gaps.high, gaps.place])
        least = np.maximum(self.allowed(np.minimum(begin, end), gaps.place, tightness), doubt)
        return np.abs(change - (end - begin)) > np.maximum(least, 0.5 * np.abs(change))

    def allowed(self, flux: NDArray[np.float32], place: NDArray[np.integer], tightness: float) -> NDArray[np.float64]:
        """Change that counts, e⁻/s."""
        return _CHANGE / tightness * self._tolerance * self._unit(flux.astype(np.float64), place)

    def samples(
        self, flux: NDArray[np.float32], scatter: NDArray[np.float32], brightest: NDArray[np.float32] | None = None
    ) -> NDArray[np.int64]:
        """How many rays each pixel needs in a sketched window, its neighbours' scatter counted in, [n].

        Parameters
        ----------
        brightest : flux in this window and those before and after it, e⁻/s.
        """
        noise = self._unit(flux.astype(np.float64), self._everywhere)
        needed = self._adaptive.needed_near(scatter / noise, self._around.near)
        plenty = np.rint(np.log2(generous(needed))).astype(np.int64)
        # something bright near the pixel or next to the window, too little of it for the pilot to see
        beside = self._around.near.most(flux if brightest is None else brightest, _NEXT) - flux
        unseen = np.ceil(np.log2(np.clip(_SLIVER * beside / noise, 1, _MOST_FOR_SLIVERS))).astype(np.int64)
        return np.maximum(needed, np.int64(1) << np.maximum(plenty, unseen))

    def samples_at(self, sketch: Sketch, window: NDArray[np.integer], place: NDArray[np.integer]) -> NDArray[np.int64]:
        """The same for some pixels of some windows."""
        numbers = np.unique(window)
        for number in numbers:
            if number not in sketch.samples:
                brightest = sketch.flux[max(0, number - 1) : number + 2].max(axis=0)
                samples = self.samples(sketch.flux[number], sketch.scatter[number], brightest)
                sketch.samples[number] = samples.astype(np.int16)
        table = np.stack([sketch.samples[number] for number in numbers])
        return table[np.searchsorted(numbers, window), place].astype(np.int64)

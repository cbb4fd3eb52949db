"""The same pixels in many time windows, at the cost of what changes between them.

Windows come in chunks. The last of a chunk is rendered everywhere; in between, intervals are halved as
long as something happens in them:

1. Random numbers are the same at all times. A pixel none of whose paths (to the surface, to the lights,
   onwards) meets the box that a moving object sweeps during an interval is therefore exactly constant
   in it, shadows, mirrors and caustics included, and needs no second look.
2. Of the others, an interval is halved and its middle rendered where the pixel, or one from which the
   motion can reach it, changes by more than the tolerance: between the ends at first, then between the
   middle and the straight line through the ends.
3. Where the picture moves farther than a few pixels in the interval, or an object by a good part of its
   own size, the ends say nothing: the middle is rendered in any case.

What is left is filled in on straight lines. A random sample of it is rendered after all to control the
refinement, and another one to state what it has missed (`Audit`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.adaptive import AdaptiveTracer, NoiseUnit, PairResult, Pairs
from hesim_render.renderer.audit import MOST_EXCEEDED, Audit, least_checked
from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.paths import MET_PASSING, MET_SWEPT
from hesim_render.renderer.timed import LEAST_SAMPLES, SweptBoxes
from hesim_render.renderer.timeline import Timeline

#: Change that has an interval halved, in tolerances of the audit.
_REFINE_AT = 0.7
#: Farthest motion within an interval that can be followed from its ends, in listed pixels.
_REACH = 6.0
#: Motion is measured along straight lines, from one ray a pixel.
_PACE_MARGIN = np.float32(1.1)
#: Part of its own extent that an object may move within an interval without passing something unseen.
_PASSING = 0.5
#: Part of its own extent below which the box swept by an object is about the box of an interval twice as long.
_SLOW = 0.1
#: Windows in a chunk at most, and what a chunk may take of memory.
_CHUNK, _CHUNK_BYTES = 32, 256 * 2**20
#: Bytes per pixel and window: both halves, two flags, temporaries.
_BYTES_PER_PAIR = 16
#: Times that a chunk is refined further before all of it is rendered.
_REPEATS = 3


def chunk_length(pixels: int) -> int:
    """Windows in a chunk of so many pixels, a power of two from 4 on."""
    room = _CHUNK_BYTES // (_BYTES_PER_PAIR * pixels)
    return max(4, min(_CHUNK, 1 << max(0, room.bit_length() - 1)))


@dataclass
class _Chunk:
    """Flux in some successive windows, [window, pixel], the first of them known.

    Parameters
    ----------
    first : number of its first window.
    half_a, half_b : e⁻/s.
    rendered : what was, not filled in.
    begin_us, end_us : its windows.
    """

    first: int
    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    rendered: NDArray[np.bool_]
    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]

    @property
    def last(self) -> int:
        return self.half_a.shape[0] - 1

    def mean(self, window: Any, place: Any = slice(None)) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a[window, place] + self.half_b[window, place])

    def put(self, window: Any, place: Any, result: PairResult) -> None:
        self.half_a[window, place], self.half_b[window, place] = result.half_a, result.half_b
        self.rendered[window, place] = True

    def fill(self, low: int, middle: int, high: int) -> None:
        """Put a window on the straight line through two others."""
        centre = self.begin_us + self.end_us
        part = np.float32((centre[middle] - centre[low]) / (centre[high] - centre[low]))
        for half in (self.half_a, self.half_b):
            half[middle] = half[low] + part * (half[high] - half[low])

    def span_us(self, low: int, high: int) -> tuple[float, float]:
        return float(self.begin_us[low]), float(self.end_us[high])


class Refinement:
    """One list of pixels through all its windows.

    Parameters
    ----------
    adaptive : renders pairs.
    timeline : how far objects move.
    audit : counts what filling in has cost.
    pixel : [n], mosaic indices, about evenly spread over the region.
    begin_us, end_us : [m], windows in order of time.
    unit : what the noise of each listed pixel is worth.
    seed : of the audit's choice.
    """

    def __init__(
        self,
        adaptive: AdaptiveTracer,
        timeline: Timeline,
        audit: Audit,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        unit: NoiseUnit,
        seed: int,
    ) -> None:
        self._adaptive, self._tracer, self._timeline, self._audit = adaptive, adaptive.tracer, timeline, audit
        self._pixel, self._begin_us, self._end_us, self._unit, self._seed = pixel, begin_us, end_us, unit, seed
        self._groups = self._tracer.parts.groups
        self._near = Neighbours(pixel, self._tracer.sensor.layout.shape)
        self._chunk = chunk_length(pixel.size)
        chunks = max(1, -(-(begin_us.size - 1) // self._chunk))
        self._checks = max(256, -(-4 * least_checked(MOST_EXCEEDED) // chunks))
        self._extent_px = np.array([timeline.extent_px(group.name, float(begin_us[0])) for group in self._groups])
        self._samples = np.full(pixel.size, LEAST_SAMPLES)
        self._tightness = 1.0  # divides the change that has an interval halved

    def run(self) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Both halves of the flux, e⁻/s [n], window after window."""
        start = self._render_all(0, None)
        half_a, half_b = start.half_a, start.half_b
        yield half_a, half_b
        count, windows, first = self._pixel.size, self._begin_us.size, 0
        while first < windows - 1:
            last = min(first + self._chunk, windows - 1)
            shape, part = (last - first + 1, count), slice(first, last + 1)
            halves = np.empty((2, *shape), np.float32)
            chunk = _Chunk(
                first, halves[0], halves[1], np.zeros(shape, np.bool_), self._begin_us[part], self._end_us[part]
            )
            chunk.half_a[0], chunk.half_b[0], chunk.rendered[0] = half_a, half_b, True
            self._settle(chunk)
            half_a, half_b = chunk.half_a[-1].copy(), chunk.half_b[-1].copy()
            for k in range(1, last - first + 1):
                yield chunk.half_a[k], chunk.half_b[k]
            first = last

    # ---- rendering --------------------------------------------------------------------------------

    def _render(
        self,
        window: NDArray[np.integer],
        place: NDArray[np.integer],
        samples: NDArray[np.int64],
        interval: NDArray[np.uint32] | None = None,
        swept: SweptBoxes | None = None,
    ) -> PairResult:
        """Pairs of a window and a place in the list."""
        unit = self._unit
        pairs = Pairs(self._pixel[place], self._begin_us[window], self._end_us[window], samples, interval)
        return self._adaptive.render(pairs, lambda flux, which: unit(flux, place[which]), swept)

    def _render_all(self, window: int, swept: SweptBoxes | None) -> PairResult:
        """Every pixel in one window."""
        windows, interval = np.full(self._pixel.size, window), np.zeros(self._pixel.size, np.uint32)
        pairs = Pairs(self._pixel, self._begin_us[windows], self._end_us[windows], self._samples, interval)
        result = self._adaptive.render_all(pairs, self._unit, self._near, swept)
        self._samples = result.samples
        return result

    # ---- what is near -----------------------------------------------------------------------------

    def _spread(self, changed: NDArray[np.bool_], motion: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels that what changed another can reach, interval by interval, [intervals, n].

        Whatever passes over a pixel between two windows was within half its way of it in one of them.

        Parameters
        ----------
        motion : around each pixel within each interval, [intervals, n], listed pixels.
        """
        spread = changed.copy()
        for row, far, out in zip(changed, motion, spread, strict=True):
            if not row.any():
                continue
            radius = np.minimum(far / 2 + 0.25, _REACH).astype(np.int8)
            for size in range(1, int(radius.max()) + 1):
                there = radius == size
                if there.any():
                    out[there] = self._near.most(row.view(np.uint8), size)[there].view(np.bool_)
        return spread

    def _pace(self, begin_us: float, end_us: float) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Motion around each pixel, listed pixels per µs: the most within reach of it; and which group it sees."""
        motion, group = self._tracer.motion_px(self._pixel, begin_us, end_us)
        most = self._near.most(motion / np.float32(self._near.cell_px), int(_REACH))
        return _PACE_MARGIN * most / np.float32(max(end_us - begin_us, 1e-3)), group

    def _motion(
        self, chunk: _Chunk, intervals: list[tuple[int, int]], pace: NDArray[np.float32], seen: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """Motion around each pixel in each interval, listed pixels, [intervals, n].

        A pixel that does not see an object now, but lies where it comes by within the interval, has the motion of
        that object.
        """
        length = np.array([[chunk.end_us[high] - chunk.end_us[low]] for low, high in intervals], np.float32)
        motion = pace * length
        for number, group in enumerate(self._groups, start=1):
            for row, interval in zip(motion, intervals, strict=True):
                span = chunk.span_us(*interval)
                far = self._timeline.object_motion_px(group.name, *span) / self._near.cell_px
                if far > 0:
                    there = self._near.inside(self._timeline.outlines_px(group.name, *span)) & (seen != number)
                    row[there] = np.maximum(row[there], np.float32(far))
        return motion

    def _swept(
        self, intervals: list[tuple[float, float]], windows: list[tuple[float, float]], parts: int
    ) -> SweptBoxes | None:
        """Boxes of every interval; an object that goes far in one of its `parts` may pass something unseen.

        None where all are so slow that nothing would be ruled out that the interval twice as long has not.
        """
        if not self._groups:
            return None
        names = [group.name for group in self._groups]
        own = np.array([[self._timeline.object_motion_px(n, *interval) for n in names] for interval in intervals])
        if parts > 1 and np.all(own / parts < _SLOW * self._extent_px):
            return None
        swept = np.array([[group.swept_box(*interval) for group in self._groups] for interval in intervals])
        present = np.array([[group.swept_box(*window) for group in self._groups] for window in windows])
        return SweptBoxes(swept, present, own / parts > _PASSING * self._extent_px)

    # ---- a chunk ----------------------------------------------------------------------------------

    def _settle(self, chunk: _Chunk) -> None:
        """Fill a chunk; refine it further until the control sample is content."""
        rng = np.random.Generator(np.random.Philox(key=[self._seed % 2**64, chunk.first]))
        for repeat in range(_REPEATS + 1):
            self._refine(chunk, everything=repeat == _REPEATS)
            checked, exceeded = self._check(chunk, rng)
            if repeat == _REPEATS or 2 * exceeded <= MOST_EXCEEDED * checked:
                break
            self._tightness *= 2.0
        if repeat == 0:
            self._tightness = max(1.0, self._tightness / 2**0.25)
        # a fresh sample, which has decided nothing
        self._audit.add(int(np.count_nonzero(~chunk.rendered)), *self._check(chunk, rng))
        self._audit.refined += repeat > 0

    def _check(self, chunk: _Chunk, rng: np.random.Generator) -> tuple[int, int]:
        """Render a random sample of the filled-in pairs; how many, and how many are off by too much."""
        skipped = np.flatnonzero(~chunk.rendered.ravel())
        if skipped.size == 0:
            return 0, 0
        chosen = np.sort(rng.choice(skipped, size=min(self._checks, skipped.size), replace=False))
        window, place = np.divmod(chosen, self._pixel.size)
        truth = self._render(chunk.first + window, place, self._samples[place]).mean
        noise = self._unit(truth.astype(np.float64), place)
        off = np.abs(truth - chunk.mean(window, place)) > self._audit.tolerance * noise
        return chosen.size, int(np.count_nonzero(off))

    def _refine(self, chunk: _Chunk, everything: bool) -> None:
        """Render the last window, then halve intervals as long as something happens in them."""
        last, count = chunk.last, self._pixel.size
        most = _REACH / self._tightness**0.5
        pace, seen = self._pace(*chunk.span_us(0, last))
        swept = self._swept([chunk.span_us(0, last)], [chunk.span_us(last, last)], 1)
        result = self._render_all(chunk.first + last, swept)
        chunk.rendered[1:] = False
        chunk.put(last, slice(None), result)
        met = self._met(result)[None]
        # what nothing came near is exactly as before, whatever number of rays it was given now
        still = (met[0] & MET_SWEPT) == 0
        for half in (chunk.half_a, chunk.half_b):
            half[1:, still] = half[0, still]
        change = self._beyond(chunk, np.array([last]), chunk.mean(0)[None], ~still[None])
        intervals = [(0, last)]
        while True:
            active = (met & MET_SWEPT) != 0
            if not everything:
                motion = self._motion(chunk, intervals, pace, seen)
                active &= ((met & MET_PASSING) != 0) | (motion > most) | self._spread(change, motion)
            wide = [k for k, (low, high) in enumerate(intervals) if high - low >= 2]
            if not wide:
                return
            intervals, active, met = [intervals[k] for k in wide], active[wide], met[wide]
            middles = np.array([(low + high) // 2 for low, high in intervals])
            for (low, high), middle in zip(intervals, middles, strict=True):
                chunk.fill(low, int(middle), high)
            which, place = np.nonzero(active)
            change = np.zeros_like(active)
            if place.size:
                straight = np.stack([chunk.mean(middle) for middle in middles])
                spans = [chunk.span_us(*interval) for interval in intervals]
                swept = self._swept(spans, [chunk.span_us(m, m) for m in middles], 2)
                windows = chunk.first + middles[which]
                result = self._render(windows, place, self._samples[place], which.astype(np.uint32), swept)
                chunk.put(middles[which], place, result)
                met = met & np.uint32(MET_SWEPT)
                if swept is not None or not self._groups:
                    met[which, place] = self._met(result)
                change = self._beyond(chunk, middles, straight, active)
            halves = [[(low, int(m)), (int(m), high)] for (low, high), m in zip(intervals, middles, strict=True)]
            intervals = [interval for pair in halves for interval in pair]
            met, change = np.repeat(met, 2, axis=0), np.repeat(change, 2, axis=0)
            assert met.shape == (len(intervals), count)

    def _met(self, result: PairResult) -> NDArray[np.uint32]:
        """What was met; everything is, where the camera moves."""
        return result.met if self._tracer.camera is None else result.met | np.uint32(MET_SWEPT)

    def _beyond(
        self, chunk: _Chunk, window: NDArray, expected: NDArray[np.float32], where: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Where rendered flux departs from what was expected by enough to look closer, [windows, n]."""
        found = np.zeros_like(where)
        which, place = np.nonzero(where)
        seen, wanted = chunk.mean(window[which], place).astype(np.float64), expected[which, place]
        least = _REFINE_AT / self._tightness * self._audit.tolerance * self._unit(np.minimum(seen, wanted), place)
        found[which, place] = np.abs(seen - wanted) > least
        return found

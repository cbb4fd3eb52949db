"""The same pixels in many time windows, at the cost of what changes between them.

Windows come in chunks. A sketch of a few rays per pixel (`Sketcher`) says in which of them a pixel may change and
how many rays it will need there; the picture itself is rendered in the last window of a chunk, wherever the scene's
motion can reach, and in between only where straight lines will not do. Random numbers are the same at all times, so
what nothing comes near is constant to the bit.

A random sample of what was filled in is rendered after all to control the refinement, and another one to state what
it has missed (`Audit`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.adaptive import AdaptiveTracer, NoiseUnit, PairResult, Pairs
from hesim_render.renderer.audit import MOST_EXCEEDED, Audit, least_checked
from hesim_render.renderer.sketch import Gaps, Sketch, Sketcher
from hesim_render.renderer.surroundings import Surroundings
from hesim_render.renderer.timed import LEAST_SAMPLES, MOST_SAMPLES
from hesim_render.renderer.timeline import Timeline

#: Motion between two rendered windows, in listed pixels, up to which a straight line is believed where it fits.
_STEP_PX = 0.5
#: A pair that stands for k windows gets k^0.4 times the rays: squared error falls by n^-1.5, so that least time for
#: the sum of squared errors has n^2.5 in proportion to k.
_LASTING = 0.4
#: Scatter of the rays of a picture over that of its sketch, neighbours together, from which on the sketch is known to
#: miss what counts: light that few rays find.
_HIDDEN = 2.0
#: Windows in a chunk at most, and what a chunk may take of memory.
_CHUNK, _CHUNK_BYTES = 32, 2**30
#: Bytes per pixel and window, added up, not measured: both halves, the sketch, flags, temporaries.
BYTES_PER_PAIR = 40
#: Times that a chunk is refined further before all of it is rendered.
_REPEATS = 4


def chunk_length(pixels: int) -> int:
    """Windows in a chunk of so many pixels, a power of two from 4 on."""
    room = _CHUNK_BYTES // (BYTES_PER_PAIR * pixels)
    return max(4, min(_CHUNK, 1 << max(0, room.bit_length() - 1)))


@dataclass
class _Chunk:
    """Flux in some successive windows, [window, pixel], the first of them known.

    Parameters
    ----------
    first : number of its first window.
    half_a, half_b : e⁻/s.
    rendered : what was, not filled in.
    """

    first: int
    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    rendered: NDArray[np.bool_]

    def mean(self, window: Any, place: Any = slice(None)) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a[window, place] + self.half_b[window, place])

    def put(self, window: Any, place: Any, result: PairResult) -> None:
        self.half_a[window, place], self.half_b[window, place] = result.half_a, result.half_b
        self.rendered[window, place] = True

    def fill(self, centre_us: NDArray[np.float64]) -> None:
        """Put what was not rendered on straight lines between what was; both ends always count as that."""
        there = self.rendered.copy()
        there[0] = there[-1] = True
        before, after = nearest(there)
        for window in range(1, there.shape[0] - 1):
            place = np.flatnonzero(~there[window])
            low, high = before[window, place], after[window, place]
            part = ((centre_us[window] - centre_us[low]) / (centre_us[high] - centre_us[low])).astype(np.float32)
            for half in (self.half_a, self.half_b):
                begin = half[low, place]
                half[window, place] = begin + part * (half[high, place] - begin)


def nearest(there: NDArray[np.bool_]) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """The last window up to each one, and the first from it on, where something is; -1 and their number for none."""
    number = np.arange(there.shape[0], dtype=np.int8)[:, None]
    before = np.maximum.accumulate(np.where(there, number, np.int8(-1)), axis=0)
    after = np.minimum.accumulate(np.where(there, number, np.int8(there.shape[0]))[::-1], axis=0)[::-1]
    return before, after


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
        self._adaptive, self._audit = adaptive, audit
        self._pixel, self._begin_us, self._end_us, self._unit, self._seed = pixel, begin_us, end_us, unit, seed
        self._around = Surroundings(adaptive.tracer, timeline, pixel, float(begin_us[0]) if begin_us.size else 0.0)
        self._sketcher = Sketcher(adaptive, self._around, pixel, unit, audit.tolerance)
        self._chunk = chunk_length(pixel.size)
        chunks = max(1, -(-(begin_us.size - 1) // self._chunk))
        self._checks = max(256, -(-4 * least_checked(MOST_EXCEEDED) // chunks))
        self._samples = np.full(pixel.size, LEAST_SAMPLES)
        self._hidden = np.zeros(pixel.size, np.bool_)
        self._stands = np.full(pixel.size, self._chunk)
        self._tightness = 1.0  # divides the change that counts

    def run(self) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Both halves of the flux, e⁻/s [n], window after window."""
        count, windows, first = self._pixel.size, self._begin_us.size, 0
        everywhere = np.arange(count)
        flux, scatter = self._sketcher.begin(float(self._begin_us[0]), float(self._end_us[0]))
        self._samples = self._lasting(flux, scatter)
        start = self._render(np.zeros(count, np.int64), everywhere, self._samples)
        half_a, half_b = start.half_a, start.half_b
        yield half_a, half_b
        while first < windows - 1:
            last = min(first + self._chunk, windows - 1)
            shape, part = (last - first + 1, count), slice(first, last + 1)
            halves = np.empty((2, *shape), np.float32)
            chunk = _Chunk(first, halves[0], halves[1], np.zeros(shape, np.bool_))
            chunk.half_a[0], chunk.half_b[0], chunk.rendered[0] = half_a, half_b, True
            sketch = Sketch.after(self._begin_us[part], self._end_us[part], flux, scatter)
            self._settle(chunk, sketch)
            half_a, half_b = chunk.half_a[-1].copy(), chunk.half_b[-1].copy()
            flux, scatter = sketch.flux[-1].copy(), sketch.scatter[-1].copy()
            for k in range(1, last - first + 1):
                yield chunk.half_a[k], chunk.half_b[k]
            first = last

    # ---- rendering --------------------------------------------------------------------------------

    def _render(
        self,
        window: NDArray[np.integer],
        place: NDArray[np.integer],
        samples: NDArray[np.int64],
    ) -> PairResult:
        """Pairs of a window and a place in the list."""
        unit = self._unit
        pairs = Pairs(self._pixel[place], self._begin_us[window], self._end_us[window], samples)
        return self._adaptive.render(pairs, lambda flux, which: unit(flux, place[which]))

    # ---- a chunk ----------------------------------------------------------------------------------

    def _settle(self, chunk: _Chunk, sketch: Sketch) -> None:
        """Render the last window and what changes before it, and more until the control sample is content."""
        rng = np.random.Generator(np.random.Philox(key=[self._seed % 2**64, chunk.first]))
        moving = self._render_last(chunk, sketch)
        for repeat in range(_REPEATS + 1):
            if repeat < _REPEATS:
                self._sketcher.refine(sketch, self._tightness)
                self._render_changes(chunk, sketch, moving)
            else:
                self._render_at(chunk, sketch, *np.nonzero(~chunk.rendered))
            chunk.fill(0.5 * (sketch.begin_us + sketch.end_us))
            checked, exceeded = self._check(chunk, rng)
            if 2 * exceeded <= MOST_EXCEEDED * checked:
                break
            self._tightness *= 2**0.5
        if repeat == 0:
            self._tightness = max(1.0, self._tightness / 2**0.125)
        # a fresh sample, which has decided nothing
        self._audit.add(int(np.count_nonzero(~chunk.rendered)), *self._check(chunk, rng))
        self._audit.refined += repeat > 0
        self._stands = sketch.last // np.maximum(1, np.count_nonzero(chunk.rendered[1:], axis=0))

    def _lasting(self, flux: NDArray[np.float32], scatter: NDArray[np.float32]) -> NDArray[np.int64]:
        """Rays of each pixel in the last window of a chunk, which stands for as many as one did in the chunk before."""
        factor = np.int64(1) << np.rint(_LASTING * np.log2(self._stands)).astype(np.int64)
        return np.minimum(factor * self._sketcher.samples(flux, scatter), MOST_SAMPLES)

    def _render_last(self, chunk: _Chunk, sketch: Sketch) -> NDArray[np.int64]:
        """The last window of a chunk, where the scene's motion can reach; those pixels.

        All others stay as they were at its begin, to the bit.
        """
        last = sketch.last
        moving = np.flatnonzero(self._sketcher.end(sketch))
        self._samples[moving] = self._lasting(sketch.flux[last], sketch.scatter[last])[moving]
        for half in (chunk.half_a, chunk.half_b):
            half[last] = half[0]
        result = self._render(np.full(moving.size, chunk.first + last), moving, self._samples[moving])
        self._samples[moving] = result.samples
        chunk.put(last, moving, result)
        scatter, drawn = np.zeros((2, self._pixel.size))
        noise = self._unit(result.mean.astype(np.float64), moving)
        scatter[moving], drawn[moving] = result.scatter, sketch.scatter[last, moving] / noise
        near = self._around.near
        self._hidden = near.mean(scatter**2) > _HIDDEN**2 * near.mean(drawn**2)
        return moving

    def _render_changes(self, chunk: _Chunk, sketch: Sketch, place: NDArray[np.int64]) -> None:
        """Render some pixels in the windows between which straight lines will not do.

        Gaps between rendered windows are split, all pixels' at once, for one of three reasons: the sketch bends; it
        makes steps, and motion is too far for the picture's own straightness to be believed, or it is not straight;
        or the picture changes across the gap and the sketch, whose rays are few, does not.
        """
        tightness, last = self._tightness, sketch.last
        if last < 2:
            return
        earlier_step, later_step = nearest(self._sketcher.steps(sketch, tightness))
        pace = self._sketcher.motion(sketch, [sketch.span_us(0, last)])[0] / np.float32(last)
        # where the sketch was not enough before, the picture itself says where it is not straight
        hidden = self._hidden if tightness == 1 else np.ones_like(self._hidden)
        gaps, bent = Gaps(place, np.zeros_like(place), np.full_like(place, last)), hidden[place]
        while gaps.place.size:
            place, low, high = gaps
            first, second = chunk.mean(low, place), chunk.mean(high, place)
            middle = (low + high) // 2
            earlier, later = (steps[middle, place].astype(np.int64) for steps in (earlier_step, later_step))
            step = np.where((later < high) & (later - middle <= middle - earlier), later, earlier)
            moves = (step > low) & (step < high) & (bent | (pace[place] * (high - low) > _STEP_PX))
            bends, bend = self._sketcher.bends(sketch, gaps, tightness)
            blind = self._sketcher.misses(sketch, gaps, second - first, tightness) | (hidden[place] & bent)
            kept = np.flatnonzero(moves | bends | blind)
            gaps, middle = gaps.of(kept), np.where(moves, step, np.where(bends, bend, middle))[kept]
            self._render_at(chunk, sketch, middle, gaps.place)
            first, second = first[kept], second[kept]
            straight = first + sketch.part(gaps.low, middle, gaps.high) * (second - first)
            allowed = self._sketcher.allowed(np.minimum(first, second), gaps.place, tightness)
            bent = np.tile(np.abs(chunk.mean(middle, gaps.place) - straight) > allowed, 2)
            gaps = gaps.split(middle)
            wide = gaps.high - gaps.low >= 2
            gaps, bent = gaps.of(wide), bent[wide]

    def _render_at(self, chunk: _Chunk, sketch: Sketch, window: NDArray[np.int64], place: NDArray[np.int64]) -> None:
        """Pairs, each with the rays it needs at its own time; those that are there already are left."""
        missing = ~chunk.rendered[window, place]
        window, place = window[missing], place[missing]
        if window.size:
            samples = self._sketcher.samples_at(sketch, window, place)
            chunk.put(window, place, self._render(chunk.first + window, place, samples))

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

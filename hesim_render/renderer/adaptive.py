"""As many rays as each pixel needs for an error that is a stated part of its own sensor's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.timed import LEAST_SAMPLES, MOST_SAMPLES, SweptBoxes, TimedTracer

#: What twice the rays gain over independent ones where that was not measured yet, and pairs that measure it.
_GAIN_STEP, _ENOUGH = 0.9, 200
#: Times that a pair is rendered again with more rays, each time with as many as its scatter then asks for.
_ROUNDS = 3
#: Rays of a pixel that decide how many it gets.
_PILOT_SAMPLES = 16
_LEAST_BIT, _MOST_BIT = LEAST_SAMPLES.bit_length() - 1, MOST_SAMPLES.bit_length() - 1

#: Flux of pairs, e⁻/s → what their noise is worth, e⁻/s; both [n], the second argument tells which pairs.
NoiseUnit = Callable[[NDArray[np.float64], NDArray[np.integer]], NDArray[np.float64]]


@dataclass
class Reached:
    """Errors of all pairs rendered so far, in units of the sensor's noise.

    Parameters
    ----------
    pairs : how many.
    squares : sum of squared errors, from the difference of the two halves.
    over : pairs that the largest number of rays left above the wanted error, by estimate.
    rays : of pairs that were kept.
    """

    pairs: int = 0
    squares: float = 0.0
    over: int = 0
    rays: int = 0

    @property
    def rms(self) -> float:
        """Root mean square error in units of the sensor's noise."""
        return float(np.sqrt(self.squares / max(1, self.pairs)))


@dataclass(frozen=True)
class Pairs:
    """Pairs of pixel and time window to be rendered, all arrays [n].

    Parameters
    ----------
    pixel : mosaic index.
    begin_us, end_us : window.
    samples : rays to begin with, powers of two.
    interval : which set of boxes each pair is tested against, or None.
    """

    pixel: NDArray[np.uint32]
    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    samples: NDArray[np.int64]
    interval: NDArray[np.uint32] | None = None


@dataclass
class PairResult:
    """Flux of pairs: both halves in e⁻/s, bits of boxes met, rays used, scatter of rays in units of noise; [n]."""

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
    met: NDArray[np.uint32]
    samples: NDArray[np.int64]
    scatter: NDArray[np.float32]

    @property
    def mean(self) -> NDArray[np.float32]:
        return np.float32(0.5) * (self.half_a + self.half_b)


@dataclass
class AdaptiveTracer:
    """Renders pairs until each one's estimated error is below `quality` times its noise.

    The error of a pair is estimated from the scatter of its rays times what stratification was measured to
    gain over independent ones at that number of rays, over all pairs so far; a pair's own two halves say too
    little. The measure of what was reached uses the halves.

    Parameters
    ----------
    tracer : renders pairs with given numbers of rays.
    quality : wanted error over the sensor's noise.
    """

    tracer: TimedTracer
    quality: float
    reached: Reached = field(default_factory=Reached)
    #: Summed squares of measured errors and of those of independent rays, and their number, per power of two of rays.
    _measured: NDArray[np.float64] = field(default_factory=lambda: np.zeros(_MOST_BIT + 1))
    _independent: NDArray[np.float64] = field(default_factory=lambda: np.zeros(_MOST_BIT + 1))
    _pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_MOST_BIT + 1, np.int64))

    def _gains(self) -> NDArray[np.float64]:
        """Error over that of as many independent rays, by power of two; extrapolated where nothing was measured."""
        gains = np.ones(_MOST_BIT + 1)
        for bit in range(_LEAST_BIT, _MOST_BIT + 1):
            if self._independent[bit] > 0 and self._pairs[bit] >= _ENOUGH:
                gains[bit] = np.sqrt(self._measured[bit] / self._independent[bit])
            elif bit > _LEAST_BIT:
                gains[bit] = gains[bit - 1] * _GAIN_STEP
        return np.minimum(gains, 1.0)

    def needed(self, scatter: NDArray[np.floating]) -> NDArray[np.int64]:
        """Least power of two of rays whose expected error is small enough, from the scatter of single rays."""
        bits = np.arange(_LEAST_BIT, _MOST_BIT + 1)
        most = self.quality * np.sqrt(2.0**bits) / self._gains()[bits]
        most = np.maximum.accumulate(most)
        return np.int64(1) << (_LEAST_BIT + np.searchsorted(most[:-1], scatter))

    def render(self, pairs: Pairs, unit: NoiseUnit, swept: SweptBoxes | None = None) -> PairResult:
        """Flux of pairs, each with as many rays as it needs."""
        count = pairs.pixel.size
        halves = np.empty((2, count), np.float32)
        out = PairResult(
            halves[0], halves[1], np.zeros(count, np.uint32), pairs.samples.copy(), np.empty(count, np.float32)
        )
        waiting = np.arange(count)
        for repeat in range(_ROUNDS):
            interval = None if pairs.interval is None else pairs.interval[waiting]
            samples = out.samples[waiting]
            begin, end = pairs.begin_us[waiting], pairs.end_us[waiting]
            flux = self.tracer.trace(pairs.pixel[waiting], begin, end, samples, swept, interval)
            noise = unit(0.5 * (flux.half_a.astype(np.float64) + flux.half_b), waiting)
            measured = 0.5 * (flux.half_a.astype(np.float64) - flux.half_b) / noise
            scatter = flux.scatter / noise
            bit = _bit(samples)
            self._measured += np.bincount(bit, measured**2, _MOST_BIT + 1)
            self._independent += np.bincount(bit, scatter**2 / samples, _MOST_BIT + 1)
            self._pairs += np.bincount(bit, minlength=_MOST_BIT + 1)
            out.half_a[waiting], out.half_b[waiting], out.scatter[waiting] = flux.half_a, flux.half_b, scatter
            # what any of a pair's rays came near stays true of it, also where more rays follow
            out.met[waiting] |= flux.met
            needed = self.needed(scatter)
            again = needed > samples if repeat < _ROUNDS - 1 else np.zeros(waiting.size, np.bool_)
            kept = ~again
            self.reached.pairs += int(np.count_nonzero(kept))
            self.reached.squares += float(np.sum(measured[kept] ** 2))
            self.reached.rays += int(np.sum(samples[kept]))
            capped = kept & (self._gains()[bit] * scatter / np.sqrt(samples) > self.quality)
            self.reached.over += int(np.count_nonzero(capped))
            out.samples[waiting[again]] = needed[again]
            waiting = waiting[again]
            if waiting.size == 0:
                break
        return out

    def render_all(
        self, pairs: Pairs, unit: NoiseUnit, near: Neighbours, swept: SweptBoxes | None = None
    ) -> PairResult:
        """The same for a whole picture; the pairs' own numbers of rays are not used.

        A few rays with random numbers of their own decide on the number, each pixel's with its neighbours': were
        it the picture's own rays, those that miss what a pixel sees a little of would be believed too often.
        """
        rays = np.full(pairs.pixel.size, _PILOT_SAMPLES)
        pilot = self.tracer.trace(pairs.pixel, pairs.begin_us, pairs.end_us, rays, pilot=True)
        mean = 0.5 * (pilot.half_a.astype(np.float64) + pilot.half_b)
        scatter = pilot.scatter / unit(mean, np.arange(pairs.pixel.size))
        needed = self.needed(np.sqrt(near.mean(scatter**2)))
        return self.render(replace(pairs, samples=needed), unit, swept)


def _bit(samples: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.log2(samples).astype(np.int64)

"""As many rays as each pixel needs for an error that is a stated part of its own sensor's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.renderer.neighbours import Neighbours
from hesim_render.renderer.timed import LEAST_SAMPLES, MOST_SAMPLES, PairFlux, SweptBoxes, TimedTracer

#: What twice the rays gain over independent ones where that was not measured yet, and pairs that measure it.
_GAIN_STEP, _ENOUGH = 0.9, 200
#: Times that a pair is rendered again with more rays, each time with as many as its scatter then asks for.
_ROUNDS = 3
#: A pair is rendered again where it needs so many times the rays that it got.
_FAR_OFF = 2
#: Rays of a pixel that decide how many it gets.
PILOT_SAMPLES = 16
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
    """

    pixel: NDArray[np.uint32]
    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    samples: NDArray[np.int64]


@dataclass
class PairResult:
    """Flux of pairs: both halves in e⁻/s, rays used, scatter of rays in units of noise; [n]."""

    half_a: NDArray[np.float32]
    half_b: NDArray[np.float32]
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

    def needed_near(self, scatter: NDArray[np.floating], near: Neighbours) -> NDArray[np.int64]:
        """The same from the few rays of a pilot, which say more together with the neighbours'."""
        return self.needed(np.sqrt(0.5 * (scatter**2 + near.mean(scatter**2))))

    def render(self, pairs: Pairs, unit: NoiseUnit) -> PairResult:
        """Flux of pairs, each with as many rays as it needs."""
        count = pairs.pixel.size
        half_a, half_b, scatter = np.empty((3, count), np.float32)
        out = PairResult(half_a, half_b, pairs.samples.copy(), scatter)
        waiting = np.arange(count)
        for repeat in range(_ROUNDS):
            samples = out.samples[waiting]
            begin, end = pairs.begin_us[waiting], pairs.end_us[waiting]
            flux = self.tracer.trace(pairs.pixel[waiting], begin, end, samples)
            noise = unit(0.5 * (flux.half_a.astype(np.float64) + flux.half_b), waiting)
            measured = 0.5 * (flux.half_a.astype(np.float64) - flux.half_b) / noise
            scatter = flux.scatter / noise
            bit = _bit(samples)
            self._measured += np.bincount(bit, measured**2, _MOST_BIT + 1)
            self._independent += np.bincount(bit, scatter**2 / samples, _MOST_BIT + 1)
            self._pairs += np.bincount(bit, minlength=_MOST_BIT + 1)
            out.half_a[waiting], out.half_b[waiting], out.scatter[waiting] = flux.half_a, flux.half_b, scatter
            needed = self.needed(scatter)
            again = (needed >= _FAR_OFF * samples) & (repeat < _ROUNDS - 1)
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

    def pilot(
        self,
        pixel: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        swept: SweptBoxes | None = None,
        interval: NDArray[np.uint32] | None = None,
    ) -> PairFlux:
        """A few rays of each pair, with random numbers of their own: what they show may decide about the pair.

        Were they the picture's own rays, those that miss what a pixel sees a little of would be believed too often.
        """
        return self.tracer.trace(
            pixel, begin_us, end_us, np.full(pixel.size, PILOT_SAMPLES), swept, interval, pilot=True
        )

    def render_all(self, pairs: Pairs, unit: NoiseUnit, near: Neighbours) -> PairResult:
        """A whole picture; a pilot decides on the number of rays of each pixel with its neighbours."""
        pilot = self.pilot(pairs.pixel, pairs.begin_us, pairs.end_us)
        mean = 0.5 * (pilot.half_a.astype(np.float64) + pilot.half_b)
        scatter = pilot.scatter / unit(mean, np.arange(pairs.pixel.size))
        return self.render(replace(pairs, samples=self.needed_near(scatter, near)), unit)


def _bit(samples: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.log2(samples).astype(np.int64)

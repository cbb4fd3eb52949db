"""Error of a render in units of the sensor's own noise, from its two independent halves.

Verdict on a run of the exact mode, from its stated errors alone.

All pixels of the exact mode get the same number of independent rays in every slice, and no value is interpolated, so
half the difference of a value's two halves is distributed as its error. The limit is the audit's: at most `MOST_OFF` of
the values are off by more than `TOLERANCE` wanted errors.
"""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.audit.audit import MOST_OFF, TOLERANCE

#: Number of values sampled per picture, and bins per decade of the histogram after its first bin.
_VALUES, _BINS, _FIRST, _DECADES = 1 << 15, 50, 1e-5, 10
#: Lower ends of the bins.
_LOWER = np.concatenate([[0.0], _FIRST * 10 ** (np.arange(_BINS * _DECADES + 1) / _BINS)])


class ErrorMeter:
    """Measures the error of the values of a run, over the sensor's noise.

    Half the difference of a value's two halves has the variance of the value's own error and, with many rays, its
    distribution. In large pictures a sample of the values is used, the same in every picture.

    Attributes
    ----------
    values : number of values so far.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS * _DECADES + 2, np.int64)
        self._square, self.values = 0.0, 0
        self._where: tuple[NDArray[np.int64], UInt32] | None = None

    def add(
        self,
        half_a: Float,
        half_b: Float,
        noise: Callable[[NDArray[np.float64], NDArray[np.int64]], NDArray[np.float64]],
    ) -> None:
        """Add one picture.

        Parameters
        ----------
        half_a, half_b : Dr.Jit Float [n], electrons; the same array if a source has no error of this kind.
        noise : maps electrons [k] and places in the picture [k] to one standard deviation of the noise, electrons.
        """
        types, count = jit(), dr.width(half_a)
        if half_a is half_b or count == 0:
            return
        if self._where is None or self._where[0][-1] >= count or self._where[0].size < min(_VALUES, count):
            chosen = np.random.default_rng(0).choice(count, min(_VALUES, count), replace=False)
            place = np.sort(chosen)
            self._where = place, from_host(types.UInt32, place)
        place, index = self._where
        one, other = (np.array(dr.gather(types.Float, half, index), np.float64) for half in (half_a, half_b))
        error = np.abs(one - other) / 2 / noise((one + other) / 2, place)
        with np.errstate(divide="ignore"):
            bins = np.floor(_BINS * np.log10(error / _FIRST)) + 1
        self._counts += np.bincount(
            np.clip(bins, 0, self._counts.size - 1).astype(np.int64), minlength=self._counts.size
        )
        self._square += float(np.sum(error * error))
        self.values += error.size

    def as_dict(self, wanted: float | None = None) -> dict[str, float] | None:
        """Statistics for the manifest, in units of noise, with the error that was `wanted`; None without values."""
        if not self.values:
            return None
        result = {"rms": float(np.sqrt(self._square / self.values))}
        result |= {name: self.quantile(part) for name, part in (("median", 0.5), ("p95", 0.95), ("p99", 0.99))}
        if wanted is not None:
            result["share_above_wanted"] = self.share_from(wanted)
        return result

    def quantile(self, part: float) -> float:
        """Error that a part of the values does not exceed, to 5 %."""
        cumulated = np.cumsum(self._counts)
        # centre of the bin, which is 4.7 % wide
        return float(_LOWER[np.searchsorted(cumulated, part * cumulated[-1])] * 10 ** (0.5 / _BINS))

    def share_from(self, limit: float) -> float:
        """Share of the values with an error of `limit` or more; the limit is rounded up to the begin of a bin."""
        return float(self._counts[limit * (1 - 1e-9) <= _LOWER].sum() / self.values)


def stated_verdict(errors: Mapping[str, ErrorMeter], samples: int, wanted: float) -> dict[str, object]:
    """The entry ``audit`` of a run in the exact mode, as plain values.

    Parameters
    ----------
    errors : error meters of frames and events.
    samples : rays per pixel and slice.
    wanted : largest error that is good enough, over the sensor's noise.

    Returns
    -------
    The verdict, shares that are off, and where it is not met ``samples_needed``: the next power of two that suffices,
    as the error of independent rays falls with the root of their number.
    """
    limit = TOLERANCE * wanted
    measured = {name: meter for name, meter in errors.items() if meter.values}
    off = {f"{name}_off": meter.share_from(limit) for name, meter in measured.items()}
    failed = any(share > MOST_OFF for share in off.values())
    enough = [samples * (meter.quantile(1 - MOST_OFF) / limit) ** 2 for meter in measured.values()]
    needed = max([samples + 1.0, *enough])
    return {
        "compares_with": "the two halves of each value's own rays; nothing was rendered again",
        "tolerance_noise": limit,
        "off_wanted_at_most": MOST_OFF,
        **off,
        "verdict": "not met" if failed else "met",
        "samples_needed": 1 << int(np.ceil(np.log2(needed))) if failed else None,
    }


class EventFlux:
    """Truth of the event pixels: mean flux over all samples, with both halves kept apart."""

    STATE = ("_half_a", "_half_b", "samples")

    def __init__(self, count: int) -> None:
        self._half_a, self._half_b = np.zeros(count), np.zeros(count)
        self.samples = 0

    def add(self, half_a: Float, half_b: Float) -> None:
        self._half_a += np.array(half_a)
        self._half_b += np.array(half_b)
        self.samples += 1

    def mean_e_per_s(self) -> NDArray[np.float32]:
        """[event pixel], e⁻/s."""
        return ((self._half_a + self._half_b) / (2 * max(1, self.samples))).astype(np.float32)

    def stderr_e_per_s(self) -> NDArray[np.float32]:
        """[event pixel], standard error of that mean from its two halves, e⁻/s."""
        return (np.abs(self._half_a - self._half_b) / (2 * max(1, self.samples))).astype(np.float32)

"""Statistics of the single rays of pairs: means, scatter, and how far the rays differ from those of another window.

One kernel goes through the rays of each pair, in order. With a kernel for each sum over the rays, they took a third of
the time of a pilot pass.
"""

from collections.abc import Callable, Sequence
from typing import Any

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32

#: (number of the ray in its pair, sums so far) → the sums with this ray.
Step = Callable[..., Sequence[Any]]


def power_below(values: Float) -> Float:
    """The powers of two not above positive values; dividing by them rounds nothing. Of 0 it is the least normal one."""
    types = jit()
    exponent = dr.reinterpret_array(types.UInt32, values) & types.UInt32(0x7F800000)
    power: Float = dr.reinterpret_array(types.Float, exponent)
    return dr.maximum(power, 2.0**-120)


class RayStatistics:
    """The rays of pairs, one pair after the other.

    Parameters
    ----------
    count, samples : number of pairs, and of rays of each.
    alike : number of successive rays that are of one kind, all or half of them.
    """

    def __init__(self, count: int, samples: int, alike: int) -> None:
        assert alike in (samples, samples // 2)
        types = jit()
        # numbers are no part of the kernel, so that it serves any number of rays
        self._samples, self._alike = dr.opaque(types.UInt32, samples), dr.opaque(types.UInt32, alike)
        self._share, self._kind_share = dr.opaque(types.Float, 1 / samples), dr.opaque(types.Float, 1 / alike)
        # these rays are a sample of the scatter in the scene
        self._unbiased = dr.opaque(types.Float, alike / (alike - 1))
        self._first = dr.arange(types.UInt32, count) * self._samples

    def mean(self, values: Float) -> Float:
        """Mean of the rays of each pair, [n], of values of all rays in memory, [n · samples]."""
        (total,) = self._over_rays(lambda ray, total: (total + self._at(values, ray),), 1)
        return total * self._share

    def any_bits(self, bits: UInt32) -> UInt32:
        """Bits that any ray of a pair has, [n]."""
        types = jit()
        either: UInt32
        (either,) = self._over_rays(
            lambda ray, some: (some | dr.gather(types.UInt32, bits, self._first + ray),), 1, types.UInt32
        )
        return either

    def mean_and_scatter(self, values: Float, mild: bool = False) -> tuple[Float, Float]:
        """Mean of the rays of each pair, and the root of the mean fourth power of deviations over their mean square; of
        a `mild` scatter the fourth root of the mean fourth power.

        Deviations are those from the mean of each kind: what differs between kinds is no scatter.
        """

        def add(ray: UInt32, early: Float, late: Float) -> tuple[Float, Float]:
            value, is_early = self._at(values, ray), ray < self._alike
            return early + dr.select(is_early, value, 0), late + dr.select(is_early, 0, value)

        early, late = self._over_rays(add, 2)

        def deviation(ray: UInt32) -> Float:
            return self._at(values, ray) - dr.select(ray < self._alike, early, late) * self._kind_share

        unit, second, fourth = self._powers(deviation)
        # the choice is no part of the kernel, so that one serves both
        is_mild = dr.opaque(jit().Bool, mild)
        square = dr.select(is_mild, dr.sqrt(fourth * self._share), dr.select(second > 0, fourth / second, 0))
        return (early + late) * self._share, unit * dr.sqrt(square * self._unbiased)

    def change(self, values: Float, before: Float, first_before: UInt32) -> Float:
        """Standard deviation of the difference of single rays to the same rays in another window, [n].

        What all rays of a pair have in common drops out.

        Parameters
        ----------
        values : as for `mean`.
        before, first_before : the rays to compare with, and place of the first one of each pair among them.
        """

        def difference(ray: UInt32) -> Float:
            return self._at(values, ray) - dr.gather(jit().Float, before, first_before + ray)

        (total,) = self._over_rays(lambda ray, total: (total + difference(ray),), 1)
        mean = total * self._share
        unit, second, _ = self._powers(lambda ray: difference(ray) - mean)
        return unit * dr.sqrt(second * (self._share * self._unbiased))

    def _powers(self, deviation: Callable[[UInt32], Float]) -> tuple[Float, Float, Float]:
        """A unit, and the sums of second and fourth powers of deviations in this unit.

        It is about the largest deviation of the pair, as fourth powers of fluxes leave the range of float32.
        """
        (largest,) = self._over_rays(lambda ray, most: (dr.maximum(most, dr.abs(deviation(ray))),), 1)
        unit = power_below(largest)
        per_unit = 1 / unit

        def add(ray: UInt32, second: Float, fourth: Float) -> tuple[Float, Float]:
            square = dr.square(deviation(ray) * per_unit)
            return second + square, fourth + square * square

        second, fourth = self._over_rays(add, 2)
        return unit, second, fourth

    def _at(self, values: Float, ray: UInt32) -> Float:
        each: Float = dr.gather(jit().Float, values, self._first + ray)
        return each

    def _over_rays(self, step: Step, states: int, kind: Any = None) -> Sequence[Any]:
        """Sums over the rays of each pair, from 0."""
        types, count = jit(), len(self._first)
        zeros = [dr.zeros(kind or types.Float, count) for _ in range(states)]
        _, *sums = dr.while_loop(
            (dr.zeros(types.UInt32, count), *zeros),
            lambda ray, *_: ray < self._samples,
            lambda ray, *sums: (ray + 1, *step(ray, *sums)),
        )
        return sums

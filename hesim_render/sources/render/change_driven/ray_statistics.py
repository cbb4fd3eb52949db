"""Statistics of the single rays of pairs: means, scatter, and how far the rays differ from those of another window.

One kernel goes through the rays of each pair, in order. With a kernel for each sum over the rays, they took a third of
the time of a pilot pass. Sums that need no other ones are taken in one pass: with a loop for each they took 8.5
in place of 5.3 ns a ray (`camera-sweep`, 32 rays a pair, one thread).
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

    def of(
        self,
        means: Sequence[Float],
        bits: UInt32,
        estimates: Sequence[Float],
        others: Sequence[Float] = (),
        first_other: UInt32 | None = None,
        mild: int = 0,
    ) -> tuple[list[Float], UInt32, list[tuple[Float, Float]], list[Float]]:
        """All statistics of the rays of pairs, in three passes over the rays.

        Scatter is the root of the mean fourth power of deviations over their mean square; of a `mild` scatter the
        fourth root of the mean fourth power. Deviations are those from the mean of each kind: what differs between
        kinds is no scatter.

        Parameters
        ----------
        means : values of all rays in memory, [n · samples], of which means are wanted.
        bits : of all rays.
        estimates : values of all rays, of which mean and scatter are wanted.
        others, first_other : for the first of `estimates`, the same rays in another window, and place of the first one
            of each pair among them; empty where there are none.
        mild : number of estimates, from the first one on, whose scatter is the mild one.

        Returns
        -------
        means : of each of `means`, [n].
        bits : that any ray of a pair has, [n].
        estimates : mean and scatter of each of `estimates`, [n].
        changes : standard deviation of the difference of single rays to the same rays in another window, [n]. What all
            rays of a pair have in common drops out.
        """
        types, count = jit(), len(estimates)
        compared = list(zip(estimates, others, strict=False))
        early_late = slice(len(means) + 1, len(means) + 1 + 2 * count)

        def difference(values: Float, other: Float, ray: UInt32) -> Float:
            return self._at(values, ray) - dr.gather(types.Float, other, first_other + ray)

        def add(ray: UInt32, *sums: Any) -> list[Any]:
            is_early, out = (
                ray < self._alike,
                [total + self._at(each, ray) for each, total in zip(means, sums, strict=False)],
            )
            out.append(sums[len(means)] | dr.gather(types.UInt32, bits, self._first + ray))
            for number, each in enumerate(estimates):
                value, place = self._at(each, ray), early_late.start + 2 * number
                out += [sums[place] + dr.select(is_early, value, 0), sums[place + 1] + dr.select(is_early, 0, value)]
            return out + [t + difference(*pair, ray) for pair, t in zip(compared, sums[early_late.stop :], strict=True)]

        kinds = [types.Float] * len(means) + [types.UInt32] + [types.Float] * (2 * count + len(compared))
        sums = self._over_rays(add, kinds)
        both = sums[early_late]
        kind_means = [total * self._kind_share for total in both]
        changes = [total * self._share for total in sums[early_late.stop :]]

        def deviations(ray: UInt32) -> list[Float]:
            is_early = ray < self._alike
            own = [
                self._at(each, ray) - dr.select(is_early, kind_means[2 * k], kind_means[2 * k + 1])
                for k, each in enumerate(estimates)
            ]
            return own + [difference(*pair, ray) - mean for pair, mean in zip(compared, changes, strict=True)]

        # fourth powers of fluxes leave the range of float32: a unit about the largest deviation of the pair
        size = count + len(compared)
        largest = self._over_rays(
            lambda ray, *most: [dr.maximum(m, dr.abs(d)) for m, d in zip(most, deviations(ray), strict=True)],
            [types.Float] * size,
        )
        units = [power_below(each) for each in largest]
        per_unit = [1 / unit for unit in units]

        def add_powers(ray: UInt32, *powers: Float) -> list[Float]:
            squares = [dr.square(d * per) for d, per in zip(deviations(ray), per_unit, strict=True)]
            fourths = [square * square for square in squares[:count]]
            return [total + power for total, power in zip(powers, squares + fourths, strict=True)]

        powers = self._over_rays(add_powers, [types.Float] * (size + count))
        # the choice is no part of the kernel, so that one serves both
        is_mild, scattered = [dr.opaque(types.Bool, k < mild) for k in range(count)], []
        for k in range(count):
            second, fourth = powers[k], powers[size + k]
            square = dr.select(is_mild[k], dr.sqrt(fourth * self._share), dr.select(second > 0, fourth / second, 0))
            mean = (both[2 * k] + both[2 * k + 1]) * self._share
            scattered.append((mean, units[k] * dr.sqrt(square * self._unbiased)))
        spread = [
            units[k] * dr.sqrt(powers[k] * (self._share * self._unbiased)) for k in range(count, count + len(compared))
        ]
        return [total * self._share for total in sums[: len(means)]], sums[len(means)], scattered, spread

    def _at(self, values: Float, ray: UInt32) -> Float:
        each: Float = dr.gather(jit().Float, values, self._first + ray)
        return each

    def _over_rays(self, step: Step, kinds: Sequence[Any]) -> Sequence[Any]:
        """Sums over the rays of each pair, from 0, of some types."""
        types, count = jit(), len(self._first)
        _, *sums = dr.while_loop(
            (dr.zeros(types.UInt32, count), *(dr.zeros(kind, count) for kind in kinds)),
            lambda ray, *_: ray < self._samples,
            lambda ray, *sums: (ray + 1, *step(ray, *sums)),
        )
        return sums

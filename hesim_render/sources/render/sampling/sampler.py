"""Random numbers of a rendered sample: a pure function of (seed, pixel, half, sample, dimension).

Every draw of every pixel and half, of one to three dimensions, is a Sobol' sequence of its own. Sample j
of n takes point π(j) of the sequence, with π a random permutation, and each coordinate is shifted digitally
(XOR) by random bits. Permutation and shifts are hashed from the number of the draw and four keys, which
Philox4x32 computes from the counters (pixel on the full sensor, half, repetition). Each sample is uniform, so estimates
are unbiased. The n samples of a half are stratified in every single dimension, and jointly in the dimensions of one
draw. Different draws are independent, and so are the halves. (At the vertex of a path one point serves
two decisions whose results are never multiplied, see `next_vertex`.) (Owen scrambling instead of the shift was
measured: 1.6 times the error at 16 samples, because the spectra are smooth.)

The position in the pixel and the instant are one draw, because a moving edge is a surface in these three dimensions.
Where an edge passes over a pixel or two within the window, 128 rays of a half have 0.6 times the error that they have
if the instant is drawn separately (0.37 instead of 0.6 times the error of independent rays).

The first surface that a ray meets takes the point of the start too, in another order: a penumbra is a surface in place
and point on the lamp, and on a checked floor colour and light are multiplied. Pixels that change have 0.7 times the
error of 1024 rays whose directions are drawn apart (`camera-sweep`, and `floor-ball` of the benchmarks).

Padding of low-dimensional sequences: [kollig2002]; permutation: [kensler2013]; hash: lowbias32 of [wellons2018].
"""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaModule, MitsubaObject, Point2, UInt32, UInt64
from hesim_render.core.host_arrays import from_host

#: Number of index bits that one table of the third generator matrix covers.
_TABLE_BITS = 11
#: Order of the points of first surfaces: bit j of the number of a point is the parity of row j and the number of the
#: start; bits beyond the eleven of the table stay. With it, place and direction are a net in four dimensions: the first
#: 2^m points fill all boxes of a volume of 2^(t - m), t being 2 for m from 5 to 9 and for 11, and 3 for 10. Either pair
#: alone is a net of t = 0, as without it. It was searched for bit by bit (the 600 best, 200 columns more of each), by
#: the t of place and direction together, of three and two of their coordinates, and of all with the instant.
_ORDER = (0x3A7, 0x592, 0x144, 0x488, 0x2F0, 0x0A0, 0x4C0, 0x680, 0x100, 0x200, 0x400)
#: 2^32 over the golden ratio: distance of successive draw numbers before they are hashed.
_ODD = 0x9E3779B9


def permute(index: UInt32, mask: UInt32 | int, key: UInt32) -> UInt32:
    """Kensler's hashed permutation of 0 … mask, mask + 1 a power of two; UInt32 in and out."""
    i = index ^ key
    i = i * 0xE170893D
    i = i ^ (key >> 16)
    i = i ^ ((i & mask) >> 4)
    i = i ^ (key >> 8)
    i = i * 0x0929EB3F
    i = i ^ (key >> 23)
    i = i ^ ((i & mask) >> 1)
    i = i * (1 | (key >> 27))
    i = i * 0x6935FA69
    i = i ^ ((i & mask) >> 11)
    i = i * 0x74DCB303
    i = i ^ ((i & mask) >> 2)
    i = i * 0x9E501CC3
    i = i ^ ((i & mask) >> 2)
    i = i * 0xC860A3DF
    i = i & mask
    i = i ^ (i >> 5)
    return (i + key) & mask


def scramble(x: UInt32) -> UInt32:
    """A bijective hash of UInt32 to UInt32; every bit of the result depends on all bits of `x`."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def zero_two_point(index: UInt32) -> tuple[UInt32, UInt32]:
    """Point of the (0, 2)-sequence of van der Corput and Sobol', as two UInt32 binary fractions.

    The second generator matrix is Pascal's triangle modulo 2, the fifth Kronecker power of [[1, 1], [0, 1]]: five
    steps, one for each.
    """
    x = dr.brev(index)
    y = x
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        y = y ^ ((y << shift) & mask)
    return x, y


def third_coordinates(first_bit: int, bits: int) -> NDArray[np.uint32]:
    """Sobol's third coordinate of the indices 0 … 2^bits - 1, shifted left by `first_bit`, as binary fractions.

    Direction numbers of the primitive polynomial x² + x + 1 with m = 1, 3: [joe2008].
    """
    m = [1, 3]
    while len(m) < first_bit + bits:
        m.append(2 * m[-1] ^ 4 * m[-2] ^ m[-2])
    directions = [value << (31 - bit) for bit, value in enumerate(m)][first_bit:]
    table = np.zeros(1, np.uint32)
    for direction in directions[:bits]:
        table = np.concatenate([table, table ^ np.uint32(direction)])
    return table


def surface_points() -> NDArray[np.uint32]:
    """Number of the point of the first surface, for each number of a point of the start."""
    number = np.arange(1 << _TABLE_BITS, dtype=np.uint32)
    return sum((np.bitwise_count(number & row) & 1).astype(np.uint32) << j for j, row in enumerate(_ORDER))


@functools.cache
def sampler_class(variant: str) -> type[MitsubaObject]:
    """`CounterSampler` for one Mitsuba variant (its base class differs between variants)."""
    import mitsuba

    mi: MitsubaModule = mitsuba
    assert mi.variant() == variant

    def _unit(bits: UInt32) -> Float:
        """The centre of one of 2^23 strata. At exactly 0 some surfaces reflect no ray, and the sample would be lost."""
        return (mi.Float(bits >> 9) + 0.5) * 2.0**-23

    class CounterSampler(mi.Sampler):
        """See the module docstring. Its state is plain Dr.Jit arrays, because only those take part in symbolic
        loops.
        """

        def __init__(self, props: MitsubaObject = None) -> None:
            super().__init__(props if props is not None else mi.Properties())
            self._tables = [from_host(mi.UInt32, third_coordinates(first, _TABLE_BITS)) for first in (0, _TABLE_BITS)]
            self._surface_points = from_host(mi.UInt32, surface_points())
            dr.make_opaque(*self._tables, self._surface_points)
            self.rest()

        def rest(self) -> None:
            """Release the state of a wavefront. A leftover state would change the next kernel, which would compile
            again.
            """
            self.keys: tuple[UInt32, ...] | UInt32 = ()
            self.sample, self.dimension = mi.UInt32(), mi.UInt32()
            self._mask: UInt32 | int = 0
            self._bits = 0

        def setup(
            self,
            key: UInt64,
            pixel: UInt32,
            half: UInt32,
            sample: UInt32,
            samples_per_half: UInt32 | int,
            most: int = 0,
            repeat: UInt32 | int = 0,
        ) -> None:
            """Start one wavefront.

            Parameters
            ----------
            key : UInt64, opaque.
            pixel, half, sample : UInt32 per lane; `sample` counts within its half.
            samples_per_half : n, a power of two: a number, or with `most` a UInt32 per lane.
            most : largest n of all lanes.
            repeat : number of the repetition, UInt32 per lane; each has random numbers of its own.
            """
            self.start(self.keys_of(key, pixel, half, repeat), sample, samples_per_half, most)

        @staticmethod
        def keys_of(key: UInt64, pixel: UInt32, half: UInt32, repeat: UInt32 | int = 0) -> tuple[UInt32, ...]:
            """The four keys of a half of a pixel; see `setup`."""
            return tuple(mi.Philox4x32(key, pixel, half, mi.UInt32(repeat)).next_uint32x4())

        def start(
            self, keys: tuple[UInt32, ...], sample: UInt32, samples_per_half: UInt32 | int, most: int = 0
        ) -> None:
            """Start one wavefront whose keys are known; see `setup`."""
            self.keys = keys
            self.dimension = dr.zeros(mi.UInt32, dr.width(sample))
            self._bits = max(0, ((most or samples_per_half) - 1).bit_length())
            self._mask = samples_per_half - 1 if most else (1 << self._bits) - 1
            # the point that the start of a ray and its first surface share
            self.sample = permute(sample, self._mask, scramble(keys[0])) if self._bits else sample

        @property
        def state(self) -> tuple[object, ...]:
            """What the next draws are made from. Where it is evaluated between two draws, the next ones belong to
            another kernel.
            """
            return self.keys, self.sample, self._mask

        def _draw(self) -> tuple[UInt32, list[UInt32]]:
            """Index of the next point, and the random bits that shift its coordinates."""
            self.dimension = self.dimension + 1
            bits = [scramble(key + self.dimension * _ODD) for key in self.keys]
            return (permute(self.sample, self._mask, bits[0]) if self._bits else self.sample), bits

        def next_1d(self, active: Mask = True) -> Float:
            return self.next_2d()[0]

        def next_2d(self, active: Mask = True) -> Point2:
            point, bits = self._draw()
            x, y = zero_two_point(point)
            return mi.Point2f(_unit(x ^ bits[1]), _unit(y ^ bits[2]))

        def start_3d(self) -> tuple[Point2, Float]:
            """Place in the pixel and a third number, stratified jointly; for up to 2^22 samples in a half."""
            _, bits = self._draw()
            x, y = zero_two_point(self.sample)
            return mi.Point2f(_unit(x ^ bits[1]), _unit(y ^ bits[2])), _unit(self._third(self.sample) ^ bits[3])

        def surface_2d(self) -> Point2:
            """A pair for the first surface, stratified jointly with `start_3d`. Successive ones are the same point with
            other shifts: their results may be added, but not multiplied.
            """
            _, bits = self._draw()
            x, y = zero_two_point(self._surface_point())
            return mi.Point2f(_unit(x ^ bits[1]), _unit(y ^ bits[2]))

        def _surface_point(self) -> UInt32:
            """Number of the point of the first surface."""
            low = (1 << _TABLE_BITS) - 1
            return dr.gather(mi.UInt32, self._surface_points, self.sample & low) | (self.sample & ~mi.UInt32(low))

        def _third(self, point: UInt32) -> UInt32:
            """Third coordinate of a point, as a binary fraction."""
            z = dr.gather(mi.UInt32, self._tables[0], point & ((1 << _TABLE_BITS) - 1))
            if self._bits > _TABLE_BITS:
                z ^= dr.gather(mi.UInt32, self._tables[1], point >> _TABLE_BITS)
            return z

        def next_vertex(self, is_first: Mask) -> tuple[Point2, Float, Point2, Float]:
            """Random numbers for one vertex of a path.

            Parameters
            ----------
            is_first : lanes whose vertex is the first one: its numbers are stratified jointly with `start_3d`.

            Returns
            -------
            place, lobe : [0, 1)² and [0, 1), stratified jointly: sampling of the surface.
            light : [0, 1)², a point on a lamp. It is the same point as `place` with other shifts, because the results
                of the two are never multiplied.
            luck : [0, 1), for Russian roulette.
            """
            point, bits = self._draw()
            point = dr.select(is_first, self._surface_point(), point)
            x, y = zero_two_point(point)
            place = mi.Point2f(_unit(x ^ bits[1]), _unit(y ^ bits[2]))
            light = mi.Point2f(_unit(x ^ (bits[1] * _ODD)), _unit(y ^ (bits[2] * _ODD)))
            return place, _unit(self._third(point) ^ bits[3]), light, self.next_1d()

        def fork(self) -> "CounterSampler":
            return self

        def clone(self) -> "CounterSampler":
            return self

        def seed(self, *_: Any) -> None:
            """Does nothing: the counters are the seed. Some integrators call it."""

        def schedule_state(self) -> None:
            dr.schedule(self.dimension)

    return CounterSampler

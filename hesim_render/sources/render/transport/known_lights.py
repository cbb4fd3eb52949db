"""Lights whose direct light is known on some surfaces, which paths leave out there.

Paths from these surfaces sample the other lights alone. Mitsuba gives each light a share of [0, 1), and draws the one
in whose share a random number lies. Here the number is mapped into the shares of the other lights, and their densities
are multiplied by one over the length of these shares.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, MitsubaModule, MitsubaObject, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.sources.render.transport.moving_scene import MovingScene

#: Largest number of runs of lights, in Mitsuba's order, that are drawn alone.
_MOST_RUNS = 4


@dataclass(frozen=True)
class KnownLights:
    """See the module docstring.

    Parameters
    ----------
    table : 1 for each of these lights, by the number that Dr.Jit gives it; else 0.
    runs : begin and length of the shares of other lights that are drawn in place of all; empty for all.
    lanes : lanes in which their direct light is known.
    """

    table: UInt32
    runs: Sequence[tuple[Float, Float]]
    lanes: Mask

    def has(self, light: MitsubaObject) -> Mask:
        """True where the light of a lane is left out."""
        kind = type(self.table)
        number: UInt32 = dr.reinterpret_array(kind, light)
        return self.lanes & (dr.gather(kind, self.table, number, self.lanes) != 0)

    def drawn(self, number: Float) -> Float:
        """A number in [0, 1) that Mitsuba draws a light by, from a uniform one."""
        rest, result = number / self.density, number
        for begin, length in self.runs:
            result = dr.select(self.lanes & (rest >= 0), begin + rest, result)
            rest -= length
        return result

    @property
    def density(self) -> Float | float:
        """Density of `drawn` numbers, where it is not 0."""
        return dr.select(self.lanes, dr.rcp(sum(length for _, length in self.runs)), 1.0) if self.runs else 1.0

    def among(self, lanes: Mask) -> "KnownLights":
        """The same in some of the lanes."""
        return replace(self, lanes=self.lanes & lanes)


class KnownTable:
    """Which lights of a scene have a known direct light.

    Parameters
    ----------
    scene : the scene.
    lamps : names of the shapes whose direct light is known.
    others : numbers of lights whose direct light is not known, among those that no shape is.
    """

    def __init__(self, scene: MovingScene, lamps: Collection[str], others: Collection[int]) -> None:
        mi = scene.mi
        shapes = {number_of(mi, scene.shapes[name]) for name in lamps}
        known, apart = dict[int, bool](), 0
        for light in scene.lights:
            shape = light.get_shape()
            known[number_of(mi, light)] = apart not in others if shape is None else number_of(mi, shape) in shapes
            apart += shape is None
        table = np.array([known.get(number, False) for number in range(max(known) + 1)], np.uint32)
        self._table: UInt32 = from_host(mi.UInt32, table)
        dr.make_opaque(self._table)
        # lights in the order in which Mitsuba draws them, and where their shares of [0, 1) begin
        drawn = scene.static.emitters()
        weights = np.array([light.sampling_weight() for light in drawn], np.float64)
        bounds = np.concatenate([[0.0], np.cumsum(weights) / max(weights.sum(), 1e-30)])
        is_other = [
            weight > 0 and not known[number_of(mi, light)] for light, weight in zip(drawn, weights, strict=True)
        ]
        # a run of others begins and ends where this changes
        changes = np.diff(np.array([False, *is_other, False], np.int8))
        begins, ends = bounds[changes > 0], bounds[changes < 0]
        runs = np.stack([begins, ends - begins], axis=1) if begins.size <= _MOST_RUNS else ()
        self._runs = [(dr.opaque(mi.Float, float(begin)), dr.opaque(mi.Float, float(length))) for begin, length in runs]

    def where(self, lanes: Mask) -> KnownLights:
        """These lights, known in some lanes."""
        return KnownLights(self._table, self._runs, lanes)


def number_of(mi: MitsubaModule, instance: MitsubaObject) -> int:
    """Number that Dr.Jit gives a shape or a light, from 1."""
    kind = mi.ShapePtr if isinstance(instance, mi.Shape) else mi.EmitterPtr
    number: UInt32 = dr.reinterpret_array(mi.UInt32, kind(instance))
    return int(number[0])

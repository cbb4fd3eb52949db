"""Wavelengths of a ray, importance-sampled from the response of its pixel: filter × QE × λ."""

import functools
import operator
from collections.abc import Mapping

import numpy as np

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, Mask, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.spectral.spectrum import Spectrum

#: Parts of a response's integral with a tabulated first cell. Few parts contain more than one end of a cell.
_BINS = 4096
#: Marks the parts that contain more.
_SEVERAL = 1 << 31


class WavelengthSampler:
    """Four wavelengths per ray, distributed exactly as the response R(λ) of its filter.

    R is piecewise linear, so its normalised integral is inverted in closed form within a cell (a
    quadratic). The mean of L(λ) over samples, times ∫R dλ, estimates ∫ L R dλ without bias and without
    variance from R. All tables lie in flat arrays with the same length for each filter, so the filter is
    an offset.

    Parameters
    ----------
    responses : R per filter, in the order of the filter index; e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹.
    """

    def __init__(self, responses: Mapping[str, Spectrum]) -> None:
        types = jit()
        room = max(response.wavelength_nm.size for response in responses.values()) + 1
        cells, shares, starts, totals = [], [], [], []
        for response in responses.values():
            grid, values = response.wavelength_nm, response.values
            area = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(grid))])
            share, more = (area / area[-1]).astype(np.float32), room - grid.size
            place = np.arange(_BINS + 1, dtype=np.float32) / _BINS
            start = np.clip(np.searchsorted(share, place, side="right") - 1, 0, grid.size - 2)
            # share at which a part enters the next cell; 2 (never reached) where it stays in one
            over = np.where(start[1:] > start[:-1], share[start[:-1] + 1], np.float32(2)).view(np.uint32)
            first = start[:-1] | np.where(start[1:] > start[:-1] + 1, _SEVERAL, 0)
            starts.append(np.append(np.stack([first, over], axis=1), [[start[-1], 0]], axis=0))
            ends = np.stack([x for each in (share, values, grid, 0 * grid) for x in (each[:-1], each[1:])], axis=1)
            cells.append(np.pad(ends, ((0, more), (0, 0)), mode="edge"))
            shares.append(np.pad(share[:-1], (0, more), constant_values=2.0))  # never reached
            totals.append(area[-1])
        self._room = room - 1
        self._cells, self._shares, self._totals = (
            from_host(types.Float, values)
            for values in (np.concatenate(cells), np.concatenate(shares), np.array(totals))
        )
        self._starts = from_host(types.UInt32, np.concatenate(starts))
        dr.make_opaque(self._cells, self._shares, self._totals, self._starts)

    def total(self, filter_index: UInt32) -> Float:
        """∫R dλ of each lane's filter, e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹ × nm."""
        return dr.gather(jit().Float, self._totals, filter_index)

    def sample(self, filter_index: UInt32, u: Float) -> list[Float]:
        """Four wavelengths in nm, one from each quarter of the response's integral, at (u + k)/4.

        Parameters
        ----------
        filter_index : Dr.Jit UInt32 per ray.
        u : Float in [0, 1).
        """
        types = jit()
        floats, uints = types.Float, types.UInt32
        base = filter_index * self._room
        places = [(u + k) * 0.25 for k in range(4)]
        bins = [filter_index * (_BINS + 1) + dr.minimum(uints(place * _BINS), _BINS - 1) for place in places]
        low, high = [], []
        for place, number in zip(places, bins, strict=True):
            first, over = dr.gather(types.Array2u, self._starts, number)
            several = first >= _SEVERAL
            first = (first & (_SEVERAL - 1)) + dr.select(dr.reinterpret_array(floats, over) <= place, uints(1), 0)
            end = dr.gather(uints, self._starts, 2 * number + 2, several) & (_SEVERAL - 1)
            low.append(first)
            high.append(dr.select(several, end, first))

        def halve(low: list[UInt32], high: list[UInt32]) -> tuple[list[UInt32], list[UInt32]]:
            new_low, new_high = [], []
            for place, a, b in zip(places, low, high, strict=True):
                middle = (a + b + 1) >> 1
                beyond = dr.gather(floats, self._shares, base + middle) <= place
                new_low.append(dr.select(beyond, middle, a))
                new_high.append(dr.select(beyond, b, dr.minimum(middle - 1, b)))
            return new_low, new_high

        def unsure(low: list[UInt32], high: list[UInt32]) -> Mask:
            return functools.reduce(operator.or_, (a < b for a, b in zip(low, high, strict=True)))

        # this loop rarely takes a step: only in the tails does a part contain many cells
        low, _ = dr.while_loop((low, high), unsure, halve, label="wavelengths")
        wavelengths = []
        for place, cell in zip(places, (base + a for a in low), strict=True):
            # fetch whole packets: gathers of single numbers cost more than the arithmetic
            begin, end, first, second = dr.gather(types.Array4f, self._cells, 2 * cell)
            left, right = dr.gather(types.Array2f, self._cells, 4 * cell + 2)
            share = dr.clip((place - begin) / dr.maximum(end - begin, 1e-30), 0, 1)
            root = dr.sqrt(dr.maximum(first * first + share * (second * second - first * first), 0))
            within = share * (first + second) / dr.maximum(first + root, 1e-30)
            wavelengths.append(left + (right - left) * within)
        return wavelengths

"""Which wavelengths a ray carries: importance-sampled from its pixel's own filter × QE × λ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hesim_render.backend import jit
from hesim_render.spectra import Spectrum


class WavelengthSampler:
    """Four wavelengths per ray, distributed exactly as its filter's response R(λ).

    R is piecewise linear, so its normalised integral is inverted in closed form within a cell (a
    quadratic) and the mean of L(λ) over samples, times ∫R dλ, is ∫ L R dλ without bias and with no
    variance from R. All tables lie in flat arrays, the same length for each filter: the filter is
    an offset.

    Parameters
    ----------
    responses : R per filter, in the order of the filter index; e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹.
    """

    def __init__(self, responses: Mapping[str, Spectrum]) -> None:
        import drjit as dr

        types = jit()
        longest = max(response.wavelength_nm.size for response in responses.values())
        self._bits = int(longest - 1).bit_length()
        room = (1 << self._bits) + 1
        nodes, values, shares, totals = [], [], [], []
        for response in responses.values():
            grid, table = response.wavelength_nm, response.values
            area = np.concatenate([[0.0], np.cumsum((table[1:] + table[:-1]) / 2 * np.diff(grid))])
            more = room - grid.size
            nodes.append(np.pad(grid, (0, more), mode="edge"))
            values.append(np.pad(table, (0, more), mode="edge"))
            shares.append(np.pad(area / area[-1], (0, more), constant_values=2.0))  # never reached
            totals.append(area[-1])
        self._room = room
        self._nodes, self._values, self._shares = (
            types.Float(np.concatenate(table).astype(np.float32)) for table in (nodes, values, shares)
        )
        self._totals = types.Float(np.array(totals, dtype=np.float32))
        self._last = types.UInt32(np.array([r.wavelength_nm.size - 2 for r in responses.values()], dtype=np.uint32))
        dr.make_opaque(self._nodes, self._values, self._shares, self._totals, self._last)

    def total(self, filter_index: Any) -> Any:
        """∫R dλ of each lane's filter, e⁻ s⁻¹ per W m⁻² sr⁻¹ nm⁻¹ × nm."""
        import drjit as dr

        return dr.gather(jit().Float, self._totals, filter_index)

    def sample(self, filter_index: Any, u: Any) -> list[Any]:
        """Four wavelengths in nm, one from each quarter of the response's integral, at (u + k)/4.

        Parameters
        ----------
        filter_index : Dr.Jit UInt32 per ray.
        u : Float in [0, 1).
        """
        import drjit as dr

        floats = jit().Float
        base = filter_index * self._room
        last = base + dr.gather(jit().UInt32, self._last, filter_index)
        wavelengths = []
        for k in range(4):
            place = (u + k) * 0.25
            cell = base
            for bit in reversed(range(self._bits)):
                further = cell + (1 << bit)
                cell = dr.select(dr.gather(floats, self._shares, further) <= place, further, cell)
            cell = dr.minimum(cell, last)
            begin, end = dr.gather(floats, self._shares, cell), dr.gather(floats, self._shares, cell + 1)
            share = dr.clip((place - begin) / dr.maximum(end - begin, 1e-30), 0, 1)
            low, high = dr.gather(floats, self._values, cell), dr.gather(floats, self._values, cell + 1)
            root = dr.sqrt(dr.maximum(low * low + share * (high * high - low * low), 0))
            within = share * (low + high) / dr.maximum(low + root, 1e-30)
            left, right = dr.gather(floats, self._nodes, cell), dr.gather(floats, self._nodes, cell + 1)
            wavelengths.append(left + (right - left) * within)
        return wavelengths

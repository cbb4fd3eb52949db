"""Instants of rays, distributed within their windows as the power of a light.

Under a light of power w(t), ∫ Φ w dt / ∫ w dt is the mean of Φ over instants whose density is w. A window is cut at the
times between which the waveform is nearly a straight line (`Waveform.follow_us`), and the density is a straight line in
each part. The energy of each half of a part is exact.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.backend import jit
from hesim_render.core.device import dr
from hesim_render.core.device_types import Float, UInt32
from hesim_render.core.host_arrays import from_host
from hesim_render.spectral.waveform import Waveform


@dataclass(frozen=True)
class LightParts:
    """Parts of windows in which the power of a light is a straight line.

    Parameters
    ----------
    first, last : [window], number of its first part, and of its last part with any energy.
    energy_before, energy : [part], shares of the energy of the window.
    begin_us, length_us : [part], since the begin of the window, µs.
    tilt : [part], difference of the power at end and begin over the mean power, −2 to 2.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    energy_before: NDArray[np.float64]
    energy: NDArray[np.float64]
    begin_us: NDArray[np.float64]
    length_us: NDArray[np.float64]
    tilt: NDArray[np.float64]

    @classmethod
    def of(cls, waveform: Waveform, begin_us: NDArray[np.float64], end_us: NDArray[np.float64]) -> "LightParts":
        """Cut windows [w], µs. A window without any energy is one part of constant power."""
        knots = waveform.follow_us(float(begin_us.min()), float(end_us.max()))
        low, high = np.searchsorted(knots, begin_us, "right"), np.searchsorted(knots, end_us, "left")
        # every knot inside a window cuts it once more; parts of all windows in one list, [part]
        counts = np.maximum(high - low, 0) + 1
        first = np.cumsum(counts) - counts
        window = np.repeat(np.arange(begin_us.size), counts)
        place = np.arange(window.size) - first[window]
        knots = np.append(knots, np.inf)
        after = low[window] + place
        left = np.where(place == 0, begin_us[window], knots[after - 1])
        right = np.where(place == counts[window] - 1, end_us[window], knots[after])
        middle = 0.5 * (left + right)
        # exact means over both halves of a part give the power and its slope
        early, late = waveform.mean(left, middle), waveform.mean(middle, right)
        power, length = 0.5 * (early + late), right - left
        tilt = np.divide(2 * (late - early), power, out=np.zeros_like(power), where=power > 0)
        # energy of each window, by which the energies of its parts become shares
        total = np.add.reduceat(power * length, first)
        has_energy = (total > 0)[window]
        # of a dark or empty window the first part is all of it: any instant will do, its power is 0 or its length is
        energy = np.where(has_energy, power * length / np.where(has_energy, total[window], 1), place == 0)
        length = np.where(has_energy, length, (end_us - begin_us)[window])
        before = np.cumsum(energy) - energy
        before -= before[first][window]
        # the search for an instant must not end in a part without energy
        last = np.maximum.reduceat(np.where(energy > 0, np.arange(window.size), 0), first)
        tilt = np.where(has_energy, np.clip(tilt, -2, 2), 0)
        return cls(first, last, before, energy, left - begin_us[window], length, tilt)


@dataclass(frozen=True)
class LightTimes:
    """`LightParts` on the device.

    Parameters
    ----------
    first, last : UInt32 [window].
    energy_until : Float [part], share of the window's energy up to the end of a part.
    rows : Float, 4 entries per part: energy before it, energy, begin and length, µs.
    tilt : Float [part].
    """

    first: UInt32
    last: UInt32
    energy_until: Float
    rows: Float
    tilt: Float

    @classmethod
    def of(cls, waveform: Waveform, begin_us: NDArray[np.float64], end_us: NDArray[np.float64]) -> "LightTimes":
        """Put windows [w], µs, on the device."""
        parts, types = LightParts.of(waveform, begin_us, end_us), jit()
        rows = np.stack([parts.energy_before, parts.energy, parts.begin_us, parts.length_us], axis=1)
        # padded, because a table of one entry becomes a constant in the kernel
        numbers = [from_host(types.UInt32, np.append(values, values[-1:])) for values in (parts.first, parts.last)]
        tables = [
            from_host(types.Float, np.append(values.ravel(), np.zeros(8)).astype(np.float32))
            for values in (parts.energy_before + parts.energy, rows, parts.tilt)
        ]
        dr.make_opaque(numbers, tables)
        return cls(*numbers, *tables)

    def instant_us(self, window: UInt32, share: Float) -> Float:
        """Instants before which a share of the energy of each lane's window arrives, µs since its begin.

        Parameters
        ----------
        window : number of the window.
        share : [0, 1).
        """
        types: Any = jit()
        low, high = (dr.gather(types.UInt32, numbers, window) for numbers in (self.first, self.last))

        def halve(low: UInt32, high: UInt32) -> tuple[UInt32, UInt32]:
            middle = (low + high) // 2
            is_before = dr.gather(types.Float, self.energy_until, middle) > share
            return dr.select(is_before, low, middle + 1), dr.select(is_before, middle, high)

        # the part in which the share falls, by bisection
        part, _ = dr.while_loop((low, high), lambda low, high: low < high, halve, label="light times")
        before, energy, begin, length = dr.gather(types.Array4f, self.rows, part)
        inside = dr.clip((share - before) / energy, 0, 1)
        # the energy up to x is c·x + t·x²/2 of the part's, with c = 1 − t/2
        tilt = dr.gather(types.Float, self.tilt, part)
        steep = 1 - 0.5 * tilt
        root = dr.sqrt(dr.maximum(dr.fma(2 * tilt, inside, steep * steep), 0))
        x = 2 * inside / dr.maximum(steep + root, 1e-12)
        return dr.fma(dr.minimum(x, 1), length, begin)

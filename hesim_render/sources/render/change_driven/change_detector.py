"""Few rays tell in which windows a pixel shows anything new.

Pixels without neighbours of their own kind take many pilot rays, and a sensor with a tick has to be looked at in each
window, since things move by pixels from one tick to the next. Most pixels show the same in all windows of a block. A
quarter of the rays is enough to see that in a pixel whose rays all see the same light in the first window: whatever
comes is brighter or darker. Where rays differ already, as in a penumbra, a small change turns few of them, and such
pixels are looked at with all pilot rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.windows import Windows

#: Rays of the detector, and how many times as many pilot rays make it worth its rays.
DETECTOR_RAYS, WORTH = 8, 4
#: Sets of rays between which windows take turns, so that what one misses is seen a window later.
_SETS = 2
#: Largest scatter of single rays of an even pixel, in wanted errors; with 1 or 4, errors and rays are the same.
_EVEN = np.float32(2.0)
#: Relative differences of fluxes that rounding explains, and differences over the wanted error that count as none.
_ROUNDING, _SAME = np.float32(1e-5), np.float32(0.2)


def least_change(
    flux: NDArray[np.float32], wanted: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None
) -> NDArray[np.float32]:
    """Smallest change of the pilot's flux that means that a pixel shows something new, [site], e⁻/s.

    Parameters
    ----------
    flux : [site], e⁻/s.
    wanted : maps it to the wanted error of a pair, e⁻/s; None: any change counts that is not due to rounding.
    """
    least = _ROUNDING * np.abs(flux)
    return least if wanted is None else np.maximum(least, _SAME * wanted(flux))


@dataclass(frozen=True)
class FirstLook:
    """What the pilot saw in the first window, arrays [site].

    Parameters
    ----------
    controlled : estimator that scatters less, see `DiffuseIntegrator`.
    even : True where all rays see the same.
    least : smallest change that counts, e⁻/s.
    """

    controlled: NDArray[np.bool_]
    even: NDArray[np.bool_]
    least: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        flux: NDArray[np.float32],
        first: PilotFlux,
        wanted: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    ) -> FirstLook:
        """From the statistics of the first window, its flux by the better estimator, and wanted errors, e⁻/s."""
        controlled = first.controlled_scatter <= first.plain_scatter
        scatter = np.where(controlled, first.controlled_scatter, first.plain_scatter)
        return cls(controlled, scatter <= _EVEN * wanted(flux), least_change(flux, wanted))

    def at(self, place: NDArray[np.int64] | NDArray[np.bool_]) -> FirstLook:
        """Those of some sites."""
        return FirstLook(self.controlled[place], self.even[place], self.least[place])


def windows_with_changes(
    tracer: PairTracer,
    index: NDArray[np.uint32],
    numbers: NDArray[np.int64],
    windows: Windows,
    first: FirstLook,
    width_px: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Windows between the first and the last one that are refined, in order of windows.

    Each is compared with the first window, by the same rays. It counts if it, or the one before or after it, differs;
    of pixels that are not even, all windows count.

    Parameters
    ----------
    tracer : traces the rays, which have random numbers of their own.
    index : [n], numbers of the sites on the full sensor.
    numbers : [w, n], window number of each site.
    windows : all windows.
    first : what the pilot saw in the first window.
    width_px : width of the area in which the rays start, px.

    Returns
    -------
    window, place : [k] each, number of the row of `numbers`, and place in `index`.
    """
    count = numbers.shape[0]
    differs = np.zeros(numbers.shape, np.bool_)
    differs[:, ~first.even] = True
    place = np.flatnonzero(first.even)
    least, controlled = first.least[place], first.controlled[place]
    for number in range(_SETS):
        own = np.arange(1 + number, count - 1, _SETS)
        if own.size == 0 or place.size == 0:
            continue
        # the first window, and those that have its turn
        looked_at = np.append(0, own)
        seen = tracer.pilot(
            *(np.tile(index[place], looked_at.size), numbers[np.ix_(looked_at, place)].ravel(), windows),
            *(DETECTOR_RAYS, width_px, Stream.RENDER_DETECTOR),
            repeat=number,
        )
        # [window, site]
        flux = np.where(controlled, *(v.reshape(looked_at.size, -1) for v in (seen.controlled, seen.plain)))
        differs[np.ix_(own, place)] = np.abs(flux[1:] - flux[0]) > least
    # the other set of rays may have missed in one window what it shows in the next
    near = differs.copy()
    near[1:] |= differs[:-1]
    near[:-1] |= differs[1:]
    near[[0, -1]] = False
    window, which = np.nonzero(near)
    return window, which

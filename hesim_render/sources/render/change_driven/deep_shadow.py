"""Sites in deep shadow, at which the pilot looks with many rays in a few windows of a block.

Where nearly all light is hidden, a pilot of 16 or 32 rays meets none of what is left, and yet a hundredth of the light
is many times the noise of so dark a pixel. Without these looks nothing would tell when such a pixel brightens: its
light would be a straight line from one end of the block to the other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.change_detector import Wanted
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.tuning import Tuning
from hesim_render.sources.render.change_driven.windows import Windows


@dataclass(frozen=True)
class DeepShadow:
    """Flux of sites in deep shadow.

    Parameters
    ----------
    place : [k], places among the sites.
    flux : [window, k], flux of many rays in some windows, interpolated between them, e⁻/s.
    """

    place: NDArray[np.int64]
    flux: NDArray[np.float32]


def deep_shadow(
    tracer: PairTracer,
    sites: Sites,
    numbers: NDArray[np.int64],
    windows: Windows,
    seen: tuple[NDArray[np.float32], NDArray[np.float32]],
    near: NDArray[np.bool_],
    wanted: Wanted,
    width_px: float,
    tuning: Tuning,
) -> DeepShadow | None:
    """Look at the sites in deep shadow in some windows of a block.

    Parameters
    ----------
    tracer, sites, windows, width_px : see `take_pilot`.
    numbers : [window, site], window number of each site; three windows at least.
    seen : [window, site] each, flux that the pilot saw, and that if nothing hid any light, e⁻/s.
    near : [site], True where anything may change.
    wanted : wanted error of each site.
    tuning : constants.

    Returns
    -------
    Their flux; None where there is no such site.
    """
    last = numbers.shape[0] - 1
    looks = np.unique(np.rint(np.linspace(0, last, tuning.deep_looks)).astype(np.int64))
    flux, unshadowed = seen
    is_deep = np.zeros(sites.size, np.bool_)
    for window in looks:
        heavy = np.float32(tuning.deep_weight) * wanted(flux[window])
        dark = flux[window] < np.float32(tuning.deep_part) * unshadowed[window]
        is_deep |= near & dark & (unshadowed[window] >= heavy)
    place = np.flatnonzero(is_deep)
    if place.size == 0:
        return None
    window, which = np.repeat(looks, place.size), np.tile(place, looks.size)
    given = sites.index[which], numbers[window, which], windows, tuning.deep_rays, width_px, Stream.RENDER_ZOOM
    got: PilotFlux = tracer.pilot(*given)
    # nothing is controlled where hardly any light arrives
    values = got.plain.reshape(looks.size, place.size)
    every = np.arange(last + 1)
    after = np.clip(np.searchsorted(looks, every), 1, looks.size - 1)
    begin, end = looks[after - 1], looks[after]
    part = ((every - begin) / (end - begin)).astype(np.float32)[:, None]
    return DeepShadow(place, values[after - 1] + part * (values[after] - values[after - 1]))

"""Pairs that know which shapes hide their lamps: where these shadows in closed form save rays."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.change_detector import Wanted, better_estimate
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.tuning import TUNING, Gain
from hesim_render.sources.render.change_driven.windows import Windows

# All chosen on `camera-sweep` on `gen2`, and judged on it on `davis346`, on `pendulum`, `robot-arm` and `fan`.
#: Occluded light, in wanted errors, from which on shapes that hide it are looked for.
_OCCLUDED = np.float32(4)
#: Rays of a pair from which on they may save any, and the part of them that may be left, since each takes longer.
_WORTH_RAYS, _FEWER = np.float32(64), np.float32(0.5)
#: Law of direct light, the only one with known shadows.
_GAIN = Gain(*TUNING.diffuse_gain)


def with_known_shadows(
    tracer: PairTracer,
    pairs: tuple[NDArray[np.uint32], NDArray[np.integer], Windows],
    seen: PilotFlux,
    rays: int,
    width_px: float,
    wanted: Wanted | None,
    mild: bool = False,
    stream: Stream = Stream.RENDER_PILOT,
    among: NDArray[np.bool_] | None = None,
) -> tuple[PilotFlux, NDArray[np.uint32]]:
    """What the pilot's rays see with known shadows, where these help, and the shadows of each pair; see
    `PairTracer.shadows`.

    Parameters
    ----------
    pairs : pixels [n] on the full sensor, their windows, and all windows.
    seen : what the pilot saw of them.
    rays, width_px, mild, stream : of the pilot, see `PairTracer.pilot`.
    wanted : maps the flux of each pair to its wanted error, both e⁻/s; None: no shadows are known.
    among : [n], pairs that are asked; None for all.

    Returns
    -------
    seen : with the means and the scatter of the same rays with known shadows.
    shadows : [n], 0 where none are known.
    """
    pixel, window, windows = pairs
    shadows = np.zeros(pixel.size, np.uint32)
    if wanted is None or not tracer.knows_shadows:
        return seen, shadows
    flux, scatter = better_estimate(seen)
    error = wanted(flux)

    def needed(scatter: NDArray[np.float32], light: NDArray[np.float32], error: NDArray[np.float32]) -> NDArray:
        """Rays by their scatter, and by what one of them may bring."""
        return np.maximum(_GAIN.rays(scatter / error), light / (np.float32(TUNING.ray_weight) * error))

    without = needed(scatter, seen.unshadowed, error)
    asks = (seen.unshadowed - flux > _OCCLUDED * error) & (without >= _WORTH_RAYS)
    some = np.flatnonzero(asks if among is None else asks & among)
    shadows[some] = tracer.shadows(pixel[some], window[some], windows, width_px, stream)
    some = np.flatnonzero(shadows)
    if some.size:
        of = pixel[some], window[some], windows, rays, width_px, stream
        again = tracer.pilot(*of, mild=mild, shadows=shadows[some])
        # a ray takes longer with shadows, so these must save rays
        pays = needed(again.controlled_scatter, again.unshadowed, error[some]) <= _FEWER * without[some]
        shadows[some[~pays]] = 0
        seen = seen.with_means(some[pays], again, pays)
    return seen, shadows

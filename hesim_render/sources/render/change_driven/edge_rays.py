"""How many rays a pair needs, once decision rays have said whether it holds an edge."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.edges import EdgeFit, PairEdges
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows


def about_edges(
    tracer: PairTracer,
    pairs: tuple[NDArray[np.uint32], NDArray[np.integer], Windows],
    rays: NDArray[np.integer],
    controlled: NDArray[np.bool_],
    wanted: NDArray[np.float32],
    floor: NDArray[np.integer],
    gain: Gain,
    tuning: Tuning,
    *,
    tried: NDArray[np.bool_] | None = None,
    flat_part: float | None = None,
    contrast_rays: float = 0.0,
    known: tuple[NDArray[np.bool_], EdgeFit] | None = None,
    shadows: NDArray[np.uint32] | None = None,
    stream: Stream = Stream.RENDER_EDGE,
) -> tuple[NDArray[np.integer], PairEdges | None]:
    """Models of the edges in listed pairs, and the numbers of rays that are left to trace.

    Decision rays have a stream of their own, so that nothing which they say depends on the rays of the picture.

    Parameters
    ----------
    tracer : traces the decision rays.
    pairs : pixels [n] on the full sensor, their windows, and all windows.
    rays : [n], by the law of errors, powers of two.
    controlled : [n], estimator of each pair.
    wanted : [n], wanted error, e⁻/s.
    floor : [n], number of rays that knowledge of an edge does not lower.
    gain : error law of stratified rays.
    tuning : constants.
    tried : [n], pairs that may have an edge; None for all.
    flat_part : in place of `Tuning.flat_part`.
    contrast_rays : least rays of a pair with a line for each wanted error of contrast, if `Tuning` has fewer.
    known : [n], pairs whose lines are known, and these lines.
    shadows : [n], see `PairTracer.trace`.
    stream : stream of the decision rays.

    Returns
    -------
    rays : [n], powers of two, never more than before.
    edges : models of all pairs; None where no pair has one.
    """
    # decision rays cost as much as a cheap pair
    is_worth_it = rays >= tuning.edge_least_rays
    if known is not None:
        is_worth_it |= known[0]
    place = np.flatnonzero(is_worth_it if tried is None else is_worth_it & tried)
    if place.size == 0:
        return rays, None
    pixel, window, windows = pairs
    # lines that are known from following edges are taken, all others are fitted now
    fit, new = EdgeFit.empty(place.size), np.arange(place.size)
    if known is not None:
        fit.replace(np.flatnonzero(known[0][place]), known[1])
        new = np.flatnonzero(~known[0][place])
    # fluxes of fits are those on the optical axis
    wanted = wanted[place] / tracer.axis_factor(pixel[place])
    some, little = place[new], np.float32(tuning.flat_contrast) * wanted[new]
    of = pixel[some], window[some], windows, tuning.edge_rays, tuning.edge_footprint_px, controlled[some], little
    moves = tracer.moves_within(windows)
    fit.replace(new, tracer.edges(*of, stream, moves, None if shadows is None else shadows[some]))
    # from here on in wanted errors: contrast, and rays by the law of stratified scatter
    contrast = (fit.high - fit.low) / wanted
    is_edge = fit.is_edge & (contrast >= 1)
    # both levels belong to the scatter of a pair that has no edge. Few rays may have missed the rarer one, so two rays
    # more than were seen count on either side
    share = (fit.fewer + 2) / (fit.rays + 4)
    between = np.where(is_edge, 0, np.sqrt(share * (1 - share)) * contrast)
    by_scatter = gain.at(place).rays(between + fit.scatter / wanted)
    # what moves within the window passes by more of the decision rays than a sliver that rests, so these tell enough
    is_flat = ~is_edge & ((contrast < tuning.low_contrast) | moves)
    # an edge: its contrast says how much a ray weighs that finds the model wrong; half of the rays start in the strip
    per_contrast = max(contrast_rays, tuning.moving_contrast_rays if moves else tuning.edge_contrast_rays)
    needed = np.where(is_edge, np.maximum(2 * by_scatter, per_contrast * contrast), by_scatter)
    # the neighbours gave this pair its rays, and what they show does not reach it
    part = tuning.flat_part if flat_part is None else flat_part
    needed = np.where(is_flat, np.maximum(needed, part * rays[place].astype(np.float32)), needed)
    least = np.where(is_flat, tuning.edge_rays // 2, tuning.edge_rays)
    # the next power of two, which counts where it is below what the law of errors asks for
    needed = np.clip(np.maximum(needed, floor[place]), least, tuning.most_rays)
    fewer = 1 << np.ceil(np.log2(needed)).astype(np.int64)
    # all other pairs, such as corners and penumbrae of short windows, keep the rays of the law
    pays = (is_edge | is_flat) & (fewer < rays[place])
    out = rays.copy()
    out[place[pays]] = fewer[pays]
    lines = np.flatnonzero(pays & is_edge)
    return out, PairEdges.at(rays.size, place[lines], fit.models(lines)) if lines.size else None

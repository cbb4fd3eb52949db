"""One window of each listed pixel, such as the exposures of a frame and the first anchor of all event pixels."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_columns
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.error_target import Role
from hesim_render.sources.render.change_driven.estimates import Band, Flux
from hesim_render.sources.render.change_driven.kept_pilots import Anchored
from hesim_render.sources.render.change_driven.neighbours import REACH, RowWindows, turns
from hesim_render.sources.render.change_driven.windows import Windows

#: Part of the pixels that may be constant and yet be traced in each block, so that the pilot of all goes on.
FEW = 1 / 256


def render_one_window(
    renderer: AdaptiveRenderer,
    pixel: NDArray[np.uint32],
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    role: Role,
    out: Flux,
    keep: tuple[float, float] | None = None,
) -> list[tuple[Band, Anchored]]:
    """Put the flux of listed pixels, each in its own window, into `out` [1, n]. Constant pixels are rendered once.

    Parameters
    ----------
    renderer : renders the flux, and knows which pixels are constant.
    pixel : [n], mosaic indices.
    begin, end : [n], the window of each, µs.
    role : use of the pixels.
    out : [1, n], results.
    keep : keep the pilot's rays, where all pixels have one window; with what comes near within an interval, µs.

    Returns
    -------
    Bands with their pilots, where these are kept; none where more than few pixels are newly known to be constant.
    """
    kept: list[tuple[Band, Anchored]] = []
    sensor, at_rest = renderer.tracer.sensor, 0
    cols = sensor.spec.geometry.cols
    renderer.counts.values += pixel.size
    still = renderer.still(role)
    known = still.known[pixel]
    if known.any():
        out.put(known, still.at(pixel[known]))
    waiting = np.flatnonzero(~known)
    span, number = distinct_columns(np.stack([begin[waiting], end[waiting]]))
    windows = Windows(span[0], span[1])
    # neighbours use the window of their own row; a row with several windows is rendered once for each
    turn = turns(pixel[waiting] // sensor.cols, number)
    for k in range(int(turn.max(initial=-1)) + 1):
        listed, window = waiting[turn == k], number[turn == k]
        of_rows = RowWindows(renderer.index[pixel[listed]] // cols, window)
        for band in renderer.bands(pixel[listed], role):
            place, own = listed[band.place], window[band.place]
            numbers = of_rows.at(band.sites.index // cols)[None]
            own_pilot = None
            if keep is not None:
                # the pilot of constant pixels looks at all times
                anchored = renderer.pilot_rays(band, windows, still.span_us or keep)
                own_pilot = anchored.flux
                kept.append((band, anchored))
            pilot, near = renderer.pilot(band, windows, numbers, still.span_us, known=own_pilot)
            what = renderer.plan(pilot, band, is_knot=role == "events")
            if role == "events":
                what = renderer.sharing.planned(what, band, renderer.counts)
            flux, met = renderer.render(band, windows, own[None], what, still.span_us, is_anchor=role == "events")
            out.put(place, flux)
            if still.span_us is not None:
                fixed = ~(band.sites.most(near, REACH) | met[0])
                still.put(pixel[place[fixed]], flux.at(fixed))
                at_rest += int(np.count_nonzero(fixed))
                if at_rest > FEW * pixel.size:
                    # the rays of all pixels hold half a gigabyte of a large sensor
                    kept.clear()
    return kept

"""The pilot pass: a few rays of each pixel in each window, which decide how the picture is rendered.

Its rays have random numbers of their own, so that what they show may decide about the picture without favouring what
the picture's rays happen to miss [kirk1991]. They are the
same at all times: differences between two windows are changes of the scene, not of the rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.neighbours import REACH, Sites
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer, PilotFlux
from hesim_render.sources.render.change_driven.small_objects import Look
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows

#: Fluxes times this have squares that float32 can hold, with digits to spare.
_SMALLER = np.float32(1e-4)


@dataclass(frozen=True)
class Closer:
    """Sites by which something small may come in a window, and what many rays say of them.

    Parameters
    ----------
    place : [k], places among the sites.
    rays : [k], so many.
    lit_scatter, hidden_scatter : [k], e⁻/s.
    """

    place: NDArray[np.int64]
    rays: NDArray[np.int64]
    lit_scatter: NDArray[np.float32]
    hidden_scatter: NDArray[np.float32]


@dataclass(frozen=True)
class Pilot:
    """Of sites in successive windows, all arrays [window, site]; see `PilotFlux` and `MattIntegrator`.

    Parameters
    ----------
    lit, hidden : mean flux by both estimates, e⁻/s.
    lit_scatter, hidden_scatter : of single rays in both, e⁻/s.
    unshadowed : flux if nothing hid any light, e⁻/s.
    closer : what more rays say of some sites, one entry a window; none where there were no more.
    """

    lit: NDArray[np.float32]
    hidden: NDArray[np.float32]
    lit_scatter: NDArray[np.float32]
    hidden_scatter: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    closer: list[Closer] = field(default_factory=list)

    @property
    def windows(self) -> int:
        return self.lit.shape[0]

    def flux_of(self, window: int) -> NDArray[np.float32]:
        """In one window, by the estimate that scatters less there, [site]."""
        chosen = self.lit_scatter[window] <= self.hidden_scatter[window]
        return np.where(chosen, self.lit[window], self.hidden[window])

    @property
    def steady_flux(self) -> NDArray[np.float32]:
        """By one estimate at all times: what changes is the scene."""
        chosen = self.lit_scatter.sum(axis=0) <= self.hidden_scatter.sum(axis=0)
        return np.where(chosen, self.lit, self.hidden)


def take_pilot(
    tracer: PairTracer,
    sites: Sites,
    windows: Windows,
    numbers: NDArray[np.int64],
    rays: int,
    width_px: float,
    span_us: tuple[float, float] | None,
    closer: Sequence[Sequence[Look]] = (),
) -> tuple[Pilot, NDArray[np.bool_]]:
    """Trace the pilot.

    Parameters
    ----------
    numbers : of each site's windows, [window, site].
    rays : of each site in each window.
    width_px : of the area in which they start.
    span_us : interval, with all windows in it, for which the second result is told; None for not at all.
    closer : of each window, sites that are looked at closer; see `Zoom`.

    Returns
    -------
    pilot : of all windows; where nothing comes near the rays, they are traced in the first one only.
    near : [site], whether a ray came near what moves within the interval; True where the camera moves.
    """
    found = tracer.pilot(sites.index, numbers[0], windows, rays, width_px, span_us=span_us)
    near = found.met if tracer.camera is None else np.ones(sites.size, np.bool_)
    lit, hidden, *others = (np.repeat(values[None], numbers.shape[0], axis=0) for values in _tables(found))
    pilot = Pilot(lit, hidden, others[0], others[1], others[2])
    moving = np.flatnonzero(near)
    if numbers.shape[0] > 1 and moving.size:
        pixel, later = np.tile(sites.index[moving], numbers.shape[0] - 1), numbers[1:, moving]
        more = tracer.pilot(pixel, later.ravel(), windows, rays, width_px)
        for values, told in zip(_tables(pilot), _tables(more), strict=True):
            values[1:, moving] = told.reshape(later.shape)
    pilot.closer.extend(_look_closer(tracer, sites, windows, numbers, pilot, width_px, closer))
    return pilot, near


def _look_closer(
    tracer: PairTracer,
    sites: Sites,
    windows: Windows,
    numbers: NDArray[np.int64],
    pilot: Pilot,
    width_px: float,
    closer: Sequence[Sequence[Look]],
) -> list[Closer]:
    """What more rays say: of large things it takes the pilot's place, of small ones it is returned for each window."""
    looks = [(window, look) for window, row in enumerate(closer) for look in row if look.place.size]
    nothing = Closer(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))
    parts = [[nothing] for _ in closer]
    # large things first: a pixel may show something small as well
    for is_small, rays in sorted({(look.is_small, look.rays) for _, look in looks}):
        alike = [(window, look.place) for window, look in looks if (look.is_small, look.rays) == (is_small, rays)]
        place = np.concatenate([places for _, places in alike])
        window = np.concatenate([np.full(places.size, window) for window, places in alike])
        told = tracer.pilot(sites.index[place], numbers[window, place], windows, rays, width_px, Stream.RENDER_ZOOM)
        if not is_small:
            for values, found in zip(_tables(pilot), _tables(told), strict=True):
                values[window, place] = found
            continue
        for number in np.unique(window):
            own = window == number
            counts = np.full(np.count_nonzero(own), rays)
            parts[number].append(Closer(place[own], counts, told.lit_scatter[own], told.hidden_scatter[own]))
    return [Closer(*map(np.concatenate, zip(*map(astuple, each), strict=True))) for each in parts]


def _tables(told: Pilot | PilotFlux) -> tuple[NDArray[np.float32], ...]:
    return told.lit, told.hidden, told.lit_scatter, told.hidden_scatter, told.unshadowed


def allocate(
    pilot: Pilot,
    window: int,
    sites: Sites,
    units: NDArray[np.float32],
    quality: float,
    gain: Gain,
    tuning: Tuning,
    is_knot: bool,
) -> tuple[NDArray[np.int16], NDArray[np.bool_], NDArray[np.float32]]:
    """Rays of each listed pixel in one window, its estimate, and its expected error.

    Parameters
    ----------
    units : what the noise of each site is worth in each window, e⁻/s, [window, site].
    quality : wanted error in these units.
    gain : of stratified rays.
    is_knot : whether the window is the first or the last of its block. It is of two blocks, so that nothing in the
        windows beside it may count.

    Returns
    -------
    rays, lit, error : [n] each; see `Plan`.
    """
    low, high = (window, window + 1) if is_knot else (max(0, window - 1), window + 2)
    flux, here = pilot.flux_of(window), sites.listed
    own, value = units[window][here], flux[here]
    squares = []
    for table in (pilot.lit_scatter, pilot.hidden_scatter):
        square = (table[window] * _SMALLER) ** 2
        squares.append(np.float32(0.5) * (square[here] + sites.mean(square)))
    if pilot.closer:
        closer = pilot.closer[window]
        for square, told in zip(squares, (closer.lit_scatter, closer.hidden_scatter), strict=True):
            seen = np.zeros(sites.size, np.float32)
            seen[closer.place] = (told * _SMALLER) ** 2
            np.maximum(square, seen[here], out=square)
    open_flux = pilot.unshadowed[window]
    lit = (squares[0] <= squares[1]) & (2 * value >= open_flux[here])
    scatter = np.sqrt(np.where(lit, *squares)) / _SMALLER
    # a part of what the next pixels show may reach into this one unseen
    around = np.stack([pilot.flux_of(number) for number in range(low, min(high, units.shape[0]))])
    highest, lowest = around.max(axis=0), around.min(axis=0)
    contrast = np.maximum(sites.most(highest, 1) - value, value + sites.most(-lowest, 1))
    unseen = np.float32(tuning.unseen_area**0.5) * contrast
    # some of the light that is hidden here may be seen, where it is seen near by
    lit_near = sites.most(flux > np.float32(1e-6) * open_flux, REACH)
    brighter = np.maximum(sites.most(highest, 2) - value, np.where(lit_near, open_flux[here] - value, 0))
    wanted_error = np.float32(quality) * own
    for_unseen = np.maximum(gain.rays(unseen / wanted_error), np.float32(tuning.bright_rays) * brighter / own)
    wanted = gain.rays(scatter / wanted_error) * np.float32(tuning.knot_factor if is_knot else 1.0)
    wanted = np.maximum(wanted, np.minimum(for_unseen, np.float32(tuning.most_unseen_rays)))
    if pilot.closer:
        # what so many rays did not meet, one ray of a few could: it would weigh far too much
        looked = np.zeros(sites.size, np.float32)
        np.maximum.at(looked, pilot.closer[window].place, pilot.closer[window].rays.astype(np.float32))
        wanted = np.maximum(wanted, looked[here])
    wanted = np.maximum(wanted, open_flux[here] / (np.float32(tuning.ray_weight * quality) * own))
    bits = np.rint(np.log2(np.clip(wanted, tuning.least_rays, tuning.most_rays))).astype(np.int16)
    rays = np.left_shift(np.int16(1), bits)
    return rays, lit, gain.error(scatter, rays)

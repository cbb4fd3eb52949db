"""Differences of a pair to the same pixel in another window, by the same rays in both.

Where little changes, most rays see in both windows the same, and the mean of their differences has a small error. The
flux of a pair is then that of the other window, which was rendered with many rays, plus the difference of few:

    Φ̂(p, w) = Φ̂(p, v) + [ mean of m rays in w − mean of the same m rays in v ],

which is unbiased for any m, because the rays that choose m are the pilot's. The first and the last window of a block
are compared with the anchor of the block (`anchor`), all others with the first window.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.tuning import Tuning

#: Pixels [n] that share in the anchors of the first and of the last window; None if none do.
Shares = tuple[NDArray[np.bool_], NDArray[np.bool_]] | None
#: Scale of fluxes before they are squared, so that float32 can hold the squares.
_SMALLER = np.float32(1e-4)


@dataclass(frozen=True)
class Differences:
    """Pairs that are rendered as differences, arrays [window, pixel].

    Parameters
    ----------
    rays : number of rays of each in either window, a power of two; 0 for pairs that are rendered by themselves.
    controlled : estimator of the difference, see `DiffuseIntegrator`.
    error : expected standard error of the difference, e⁻/s.
    linked : pairs that are rendered with all their rays, and as differences of these where no line is found in them, as
        the other window has less noise than they would have.
    """

    rays: NDArray[np.int16]
    controlled: NDArray[np.bool_]
    error: NDArray[np.float32]
    linked: NDArray[np.bool_]

    def first(self) -> "Differences":
        """Those in the first window."""
        return Differences(self.rays[:1], self.controlled[:1], self.error[:1], self.linked[:1])

    @classmethod
    def none(cls, windows: int, pixels: int) -> "Differences":
        """No differences."""
        shape = windows, pixels
        rays, error = np.zeros(shape, np.int16), np.zeros(shape, np.float32)
        return cls(rays, np.zeros(shape, np.bool_), error, np.zeros(shape, np.bool_))


def difference_of(
    pilot: Pilot,
    window: int,
    controlled: NDArray[np.bool_],
    sites: Sites,
    units: NDArray[np.float32],
    quality: float,
    tuning: Tuning,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rays that the difference of each listed pixel needs in one window, from the pilot.

    Parameters
    ----------
    pilot, window : statistics with their changes, and number of the window.
    controlled : [site], estimator of the difference.
    sites : the pixels with their neighbours.
    units : [site], noise units, e⁻/s.
    quality : wanted error of a pair in noise units.

    Returns
    -------
    rays : [n], not yet a power of two.
    scatter : [n], expected scatter of single differences, e⁻/s.
    """
    assert pilot.change is not None
    change, here = pilot.change, sites.listed
    # Few rays change, and a pixel's own pilot may have met none of them: half of the scatter is that of pixels around.
    square = (np.where(controlled, change.controlled_scatter[window], change.plain_scatter[window]) * _SMALLER) ** 2
    scatter = np.sqrt(np.float32(0.5) * (square[here] + sites.mean(square))) / _SMALLER
    # What these rays can not have seen: a small part of the light that changed, the larger the fewer rays looked.
    # a listed pixel with neighbours was looked at by the rays of 3 × 3 pixels
    looked = tuning.lone_pilot_rays if sites.apart else 9 * tuning.pilot_rays
    open_flux = pilot.unshadowed[window][here]
    scatter = np.hypot(scatter, np.float32(tuning.unseen_change / looked**0.5) * open_flux)
    # the error of the other window comes on top of it
    wanted_error = np.float32(tuning.difference_part * quality) * units[here]
    # the error of m rays is factor · scatter/√m
    rays = (np.float32(tuning.difference_factor) * scatter / wanted_error) ** 2
    # An edge that has moved in a neighbour may reach into this pixel between the pilot rays.
    moved = np.where(controlled, change.controlled[window], change.plain[window])
    # the larger of the steps up and down to a neighbour of 3 × 3
    contrast = np.maximum(sites.most(moved, 1) - moved[here], moved[here] + sites.most(-moved, 1))
    # a share `unseen_area` of the pixel with this contrast, as an error in units of the wanted one
    per_contrast = np.float32(tuning.difference_factor * tuning.unseen_area**0.5) / wanted_error
    unseen = (per_contrast * contrast) ** 2
    brighter = np.float32(tuning.bright_rays) * sites.most(np.abs(moved), 2) / units[here]
    # what was not seen may ask for a limited number of rays only
    rays = np.maximum(rays, np.minimum(np.maximum(unseen, brighter), np.float32(tuning.most_unseen_rays)))
    if pilot.all_move:
        # Every edge moves, even by less than the distance of two pilot rays, and may come into this pixel.
        flux = np.where(controlled, pilot.controlled[window], pilot.plain[window])
        beside = np.maximum(sites.most(flux, 1) - flux[here], flux[here] + sites.most(-flux, 1))
        rays = np.maximum(rays, (per_contrast * beside) ** 2)
    return np.maximum(rays, np.float32(tuning.least_difference_rays)), scatter


def differences(
    pilot: Pilot,
    sites: Sites,
    units: NDArray[np.float32],
    quality: float,
    rendered: NDArray[np.bool_],
    alone: NDArray[np.int16],
    tuning: Tuning,
    alone_error: NDArray[np.float32] | None = None,
    shares: Shares = None,
) -> Differences:
    """Choose the pairs that are rendered as differences: where that takes a small part of the rays.

    Parameters
    ----------
    pilot, sites, quality, tuning : see `plan`.
    units : [window, site], noise units, e⁻/s.
    rendered : [window, pixel], rendered pairs.
    alone, alone_error : [window, pixel], rays of pairs that are rendered by themselves, and their expected errors,
        e⁻/s.
    shares : see `plan`.
    """
    last = rendered.shape[0] - 1
    out = Differences.none(*rendered.shape)
    change = pilot.change
    if change is None:
        return out
    # the windows that are compared with the first one
    inner = slice(1, max(1, last))
    steadier = change.controlled_scatter <= change.plain_scatter
    # those windows share rays in the first one, and so the estimator
    steadier[inner] = change.controlled_scatter[inner].sum(axis=0) <= change.plain_scatter[inner].sum(axis=0)
    for window, (controlled, some) in enumerate(zip(steadier, map(np.flatnonzero, rendered), strict=True)):
        chosen = sites.only(some)
        wanted, scatter = difference_of(pilot, window, controlled, chosen, units[window], quality, tuning)
        # to the nearest power of two, so that stratified sequences are used whole
        bits = np.rint(np.log2(np.minimum(wanted, tuning.most_rays))).astype(np.int16)
        rays = np.left_shift(np.int16(1), bits)
        # the other window is rendered as well, so that a difference has to be several times cheaper
        pays = np.float32(tuning.difference_gain) * rays <= alone[window, some]
        out.rays[window, some] = np.where(pays, rays, 0)
        out.controlled[window, some], out.error[window, some] = controlled[chosen.listed], scatter
    may = rendered.copy()
    for window, refined in enumerate(pilot.refined):
        # a small object passes: many rays look for it
        looked_at = np.zeros(sites.size, np.bool_)
        looked_at[refined.place] = True
        may[window, looked_at[sites.listed]] = False
    if pilot.aims is not None:
        # pairs with small objects in them have rays aimed at these, which a difference has not
        which, place = np.nonzero(may)
        is_aimed = pilot.aims.at(which, sites.listed[place]).count > 0
        may[which[is_aimed], place[is_aimed]] = False
    if pilot.shadows is not None:
        # the rays to compare with do not know any shadows
        may &= pilot.shadows[:, sites.listed] == 0
    out.rays[~may] = 0
    # all windows between take as many rays as the one that needs most, and together pay for those in the first window
    some = np.flatnonzero(out.rays[inner].any(axis=0))
    own = out.rays[inner, some]
    most = own.max(axis=0, initial=0)
    # rays that all inner windows of a pixel save together, [pixel], against `most` rays once more in the first window
    saved = np.where(own > 0, alone[inner, some].astype(np.int32) - most, 0).sum(axis=0)
    out.rays[inner, some] = np.where((own > 0) & (saved > most), most, 0)
    if shares is not None and alone_error is not None:
        # where the other window has little noise, a pair is as far off as its difference; that may be less than alone
        of_all = np.float32(tuning.difference_factor) * out.error / np.sqrt(np.maximum(alone, 1).astype(np.float32))
        out.linked[:] = may & (out.rays == 0) & shares[0] & (of_all < alone_error)
        out.linked[last] &= shares[1]
        np.copyto(out.error, of_all, where=out.linked)
    # from the scatter of single differences to the error of their mean
    pairs = out.rays > 0
    out.error[pairs] *= np.float32(tuning.difference_factor) / np.sqrt(out.rays[pairs].astype(np.float32))
    return out

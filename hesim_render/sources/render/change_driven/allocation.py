"""Rays of each pair, from what the pilot saw of the pixel and of its neighbours."""

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.neighbours import REACH, Sites
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning

#: Scale of fluxes before they are squared, so that float32 can hold the squares.
_SMALLER = np.float32(1e-4)


def gain_of(
    bounced: NDArray[np.float32],
    needed: NDArray[np.float32],
    wanted: NDArray[np.float32],
    gain: Gain,
    tuning: Tuning,
) -> tuple[Gain, NDArray[np.bool_]]:
    """Error law of each pair, where paths find some light beside closed forms: that of paths, where the rays that the
    other law asks for leave too large an error of what they find.

    Parameters
    ----------
    bounced : [n], scatter of what paths find, e⁻/s.
    needed : [n], scatter of all light over the wanted error.
    wanted : [n], wanted error, e⁻/s.
    gain : law of closed forms.
    tuning : constants.

    Returns
    -------
    The laws, and the pairs with that of paths, [n].
    """
    law_of_paths = Gain(*tuning.path_gain)
    left = law_of_paths.error(bounced, np.maximum(gain.rays(needed), np.float32(tuning.least_rays)))
    bounces = left > np.float32(tuning.bounced_part) * wanted
    return gain.or_other(law_of_paths, bounces), bounces


def allocate(
    pilot: Pilot,
    window: int,
    sites: Sites,
    units: NDArray[np.float32],
    quality: float,
    gain: Gain,
    tuning: Tuning,
    is_knot: bool,
) -> tuple[NDArray[np.int16], NDArray[np.bool_], NDArray[np.float32], NDArray[np.int16], NDArray[np.bool_]]:
    """Allocate rays to each listed pixel in one window.

    Parameters
    ----------
    pilot, window, sites : statistics of the pilot, number of the window, and pixels with neighbours.
    units : [window, site], noise units, e⁻/s.
    quality : wanted error in noise units.
    gain : error law of stratified rays.
    tuning : constants.
    is_knot : True if the window is the first or the last of its block. It then belongs to two blocks, and the windows
        beside it must not influence it.

    Returns
    -------
    rays, controlled, error, floor, bounces : [n] each: number of rays, choice of the estimator with a control variate,
        expected error, number of rays that knowledge of an edge does not lower, and pairs with the law of paths; see
        `Plan`.
    """
    low, high = (window, window + 1) if is_knot else (max(0, window - 1), window + 2)
    flux, here = pilot.flux_in(window), sites.listed
    # noise unit and flux of the listed pixels, [n]; tables of the pilot have their neighbours as well, [site]
    own, value = units[window][here], flux[here]
    # variance of a single ray by either estimator, [n]: half from the pixel itself, half from those around it, as the
    # few rays of one pilot miss what covers a small part of the pixel
    tables, squares = [pilot.controlled_scatter, pilot.plain_scatter], []
    if pilot.bounced_scatter is not None:
        tables.append(pilot.bounced_scatter)
    for table in tables:
        square = (table[window] * _SMALLER) ** 2
        squares.append(np.float32(0.5) * (square[here] + sites.mean(square)))
    if pilot.refined:
        # where the pilot looked again with many rays, their scatter counts if it is the larger one
        refined = pilot.refined[window]
        for square, scatter_there in zip(squares, (refined.controlled_scatter, refined.plain_scatter), strict=False):
            seen = np.zeros(sites.size, np.float32)
            seen[refined.place] = (scatter_there * _SMALLER) ** 2
            np.maximum(square, seen[here], out=square)
    open_flux = pilot.unshadowed[window]
    # the control variate pays where most of the unshadowed light arrives; deep in shadow it would add its own noise
    controlled = (squares[0] <= squares[1]) & (2 * value >= open_flux[here])
    scatter = np.sqrt(np.where(controlled, *squares[:2])) / _SMALLER
    # an edge in a neighbour may reach into this pixel between the pilot rays
    around = pilot.flux_in(slice(low, high))
    highest, lowest = around.max(axis=0), around.min(axis=0)
    contrast = np.maximum(sites.most(highest, 1) - value, value + sites.most(-lowest, 1))
    unseen = np.float32(tuning.unseen_area**0.5) * contrast
    # if a neighbour sees light that is occluded here, part of it may be visible here too
    is_light_near = sites.most(flux > np.float32(1e-6) * open_flux, REACH)
    brighter = np.maximum(sites.most(highest, 2) - value, np.where(is_light_near, open_flux[here] - value, 0))
    wanted_error = np.float32(quality) * own
    # where paths find much beside closed forms, the law is that of paths
    bounces = np.zeros(value.shape, np.bool_)
    if pilot.bounced_scatter is not None:
        bounced = np.sqrt(squares[2]) / _SMALLER
        gain, bounces = gain_of(bounced, scatter / wanted_error, wanted_error, gain, tuning)
    # rays for what the pilot may have missed: an edge that covers `unseen_area` of the pixel, or light beside it
    for_unseen = np.maximum(gain.rays(unseen / wanted_error), np.float32(tuning.bright_rays) * brighter / own)
    # rays for what it has seen; interpolated windows lean on the ends of a block, so these get more
    wanted = gain.rays(scatter / wanted_error) * np.float32(tuning.knot_factor if is_knot else 1.0)
    # what was not seen may ask for a limited number of rays only
    wanted = np.maximum(wanted, np.minimum(for_unseen, np.float32(tuning.most_unseen_rays)))
    looked = None
    if pilot.refined:
        # With fewer rays than the refinement took, a single ray could hit the small object and weigh far too much.
        looked = np.zeros(sites.size, np.float32)
        np.maximum.at(looked, pilot.refined[window].place, pilot.refined[window].rays.astype(np.float32))
        wanted = np.maximum(wanted, looked[here])
    # no ray may weigh more than so many wanted errors: one ray carries at most the light without shadows over their
    # number
    heavy = np.float32(tuning.ray_weight) * wanted_error
    wanted = np.maximum(wanted, open_flux[here] / heavy)
    # light that is occluded for all pilot rays may still come through a gap
    floor = np.maximum(np.zeros_like(value) if looked is None else looked[here], (open_flux[here] - value) / heavy)
    # to the nearest power of two, so that stratified sequences are used whole
    bits = np.rint(np.log2(np.clip(wanted, tuning.least_rays, tuning.most_rays))).astype(np.int16)
    rays = np.left_shift(np.int16(1), bits)
    return rays, controlled, gain.error(scatter, rays), np.clip(floor, 0, tuning.most_rays).astype(np.int16), bounces

"""Reference values of the audit: pairs traced again, with a stream of random numbers of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.aim import Aims, PairAims
from hesim_render.sources.render.change_driven.error_target import NoiseUnit
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows


def traced_again(
    tracer: PairTracer,
    zoom: Zoom,
    index: NDArray[np.uint32],
    begin_us: NDArray[np.float64],
    end_us: NDArray[np.float64],
    unit_of: Callable[[NDArray[np.uint32]], NoiseUnit],
    quality: float,
    gain: Gain,
    tuning: Tuning,
) -> NDArray[np.float64]:
    """Mean Φ of each listed pixel in its own window, with random numbers that only the audit uses; and its error.

    Parameters
    ----------
    tracer : the renderer.
    zoom : finds the small objects at which rays are aimed.
    index : [n], numbers on the full sensor.
    begin_us, end_us : [n], the windows, µs.
    unit_of : gives the noise unit of listed pixels by their numbers on the full sensor.
    quality : wanted error in noise units.
    gain : error law of stratified rays.
    tuning : constants.

    Returns
    -------
    [2, n], e⁻/s: the flux, and half the difference of its halves.
    """
    pairs, place = np.unique(np.stack([index.astype(np.float64), begin_us, end_us]), axis=1, return_inverse=True)
    pixel = pairs[0].astype(np.uint32)
    span, window = np.unique(pairs[1:], axis=1, return_inverse=True)
    windows, window = Windows(span[0], span[1]), window.ravel()
    aims = _aims(zoom, pixel, tracer.sensor.spec.geometry.cols, windows, window)
    pilot = _pilot(tracer, pixel, windows, window, tuning.audit_pilot_rays, aims)
    lit = (pilot.lit_scatter <= pilot.hidden_scatter) & (2 * pilot.lit >= pilot.unshadowed)
    flux = np.where(lit, pilot.lit, pilot.hidden)
    scatter = np.where(lit, pilot.lit_scatter, pilot.hidden_scatter)
    own_unit = unit_of(pixel)
    wanted_error = np.float32(quality) * own_unit(flux)
    wanted = np.maximum(
        gain.rays(scatter / wanted_error), pilot.unshadowed / (np.float32(tuning.audit_ray_weight) * wanted_error)
    )
    rays = 1 << np.ceil(np.log2(np.clip(wanted, tuning.least_audit_rays, tuning.most_rays))).astype(np.int64)
    times = np.clip(np.ceil((gain.error(scatter, rays) / wanted_error) ** 2), 1, tuning.most_audit_times).astype(
        np.int64
    )
    each, first = np.repeat(np.arange(pixel.size), times), np.cumsum(times) - times
    of = pixel[each], window[each], windows, rays[each], lit[each], Stream.AUDIT
    repeat = np.arange(each.size) - first[each]
    got = tracer.trace(*of, repeat=repeat, aims=None if aims is None else aims.part(each))
    values = 0.5 * np.stack([got.half_a + got.half_b, got.half_a - got.half_b]).astype(np.float64)
    return (np.add.reduceat(values, first, axis=1) / times)[:, place.ravel()]


def _aims(
    zoom: Zoom, pixel: NDArray[np.uint32], cols: int, windows: Windows, window: NDArray[np.int64]
) -> PairAims | None:
    """Objects at which rays of listed pairs are aimed; None if there are none."""
    row, col = np.divmod(pixel.astype(np.int64), cols)
    looks = [look for looks in zoom.sites(row, col, windows, window[None]) for look in looks]
    found = Aims.of([(0, *look.aims) for look in looks if look.aims is not None], pixel.size)
    return None if found is None else found.at(np.zeros(pixel.size, np.int64), np.arange(pixel.size))


def _pilot(
    tracer: PairTracer,
    pixel: NDArray[np.uint32],
    windows: Windows,
    window: NDArray[np.int64],
    rays: int,
    aims: PairAims | None,
) -> PilotFlux:
    """Pilot pass of listed pairs; those with small objects get rays of both kinds."""
    if aims is None:
        return tracer.pilot(pixel, window, windows, rays, 1.0, Stream.AUDIT_PILOT)
    parts = []
    kinds = np.flatnonzero(aims.count == 0), np.flatnonzero(aims.count)
    for some, own in ((kinds[0], None), (kinds[1], aims.part(kinds[1]))):
        parts.append(tracer.pilot(pixel[some], window[some], windows, rays, 1.0, Stream.AUDIT_PILOT, aims=own))
    order = np.argsort(np.concatenate(kinds))
    return PilotFlux(*(np.concatenate(values)[order] for values in zip(*map(astuple, parts), strict=True)))

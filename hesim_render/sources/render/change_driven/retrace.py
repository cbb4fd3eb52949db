"""Reference values of the audit: pairs traced again, with a stream of random numbers of their own."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_columns
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.aim import Aims, PairAims
from hesim_render.sources.render.change_driven.allocation import gain_of
from hesim_render.sources.render.change_driven.edge_rays import about_edges
from hesim_render.sources.render.change_driven.edges import PairEdges
from hesim_render.sources.render.change_driven.error_target import NoiseUnit
from hesim_render.sources.render.change_driven.known_shadows import with_known_shadows
from hesim_render.sources.render.change_driven.pair_flux import PilotFlux
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows

#: Largest number of pairs that are kept.
_MOST_KNOWN = 1 << 18


class KnownPairs:
    """Values of pairs of a pixel and a window that were traced again; they depend on nothing but the pair.

    The audit draws its units at random, with replacement. Of a small region or a short run it draws the same ones many
    times, in calls of a few pairs, and each call costs as much as thousands of rays.
    """

    def __init__(self) -> None:
        self._hash = np.empty(0, np.uint64)
        self._pairs, self._values = np.empty((0, 0)), np.empty((0, 0))

    def values(
        self, pairs: NDArray[np.float64], traced: Callable[[NDArray[np.int64]], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Values of the listed pairs, [k, n].

        Parameters
        ----------
        pairs : [m, n], what values depend on: pixel and window, and what else there is.
        traced : gives the values of some of them, by their places in this list.
        """
        # a hash that is known leads to one place; whether the pair there is the same is compared in full
        hashed = _hash(pairs)
        place = np.minimum(np.searchsorted(self._hash, hashed), max(0, self._hash.size - 1))
        is_known = np.zeros(hashed.size, np.bool_)
        if self._hash.size:
            is_known = np.all(self._pairs[:, place] == pairs, axis=0)
        new = np.flatnonzero(~is_known)
        got = self._values[:, :0]
        if new.size:
            # each pair once, however often it is listed; `back` leads to the list
            _, first, back = np.unique(pairs[:, new], axis=1, return_index=True, return_inverse=True)
            got = traced(new[first])[:, back.ravel()]
        values = np.empty((got.shape[0], hashed.size))
        if self._hash.size:
            values[:, is_known] = self._values[:, place[is_known]]
        values[:, new] = got
        if new.size:
            self._keep(hashed[new], pairs[:, new], got)
        return values

    def _keep(self, hashed: NDArray[np.uint64], pairs: NDArray[np.float64], values: NDArray[np.float64]) -> None:
        if not self._hash.size:
            self._pairs, self._values = np.empty((pairs.shape[0], 0)), np.empty((values.shape[0], 0))
        every, first = np.unique(np.concatenate([self._hash, hashed]), return_index=True)
        if every.size <= _MOST_KNOWN:
            self._hash = every
            self._pairs = np.concatenate([self._pairs, pairs], axis=1)[:, first]
            self._values = np.concatenate([self._values, values], axis=1)[:, first]


def _hash(pairs: NDArray[np.float64]) -> NDArray[np.uint64]:
    """One number for each pair; two pairs may share it."""
    mixed = np.zeros(pairs.shape[1], np.uint64)
    for bits in np.ascontiguousarray(pairs).view(np.uint64):
        mixed = (mixed ^ bits) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed


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
    # each pair once, however often it was drawn; `place` leads back to the draws
    pairs, place = np.unique(np.stack([index.astype(np.float64), begin_us, end_us]), axis=1, return_inverse=True)
    pixel = pairs[0].astype(np.uint32)
    span, window = distinct_columns(pairs[1:])
    windows = Windows(span[0], span[1])
    aims = aims_of(zoom, pixel, tracer.sensor.spec.geometry.cols, windows, window)
    pilot = _pilot(tracer, pixel, windows, window, tuning.audit_pilot_rays, aims)
    # known shadows, as in the run
    own_unit = unit_of(pixel)

    def wanted_of(flux: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.float32(quality) * own_unit(flux)

    listed, alone = (pixel, window, windows), None if aims is None else aims.count == 0
    given = tracer, listed, pilot, tuning.audit_pilot_rays, 1.0, wanted_of
    pilot, shadows = with_known_shadows(*given, stream=Stream.AUDIT_PILOT, among=alone)
    # the estimator with less scatter, as in the run, by a pilot of its own
    controlled = (pilot.controlled_scatter <= pilot.plain_scatter) & (2 * pilot.controlled >= pilot.unshadowed)
    flux = np.where(controlled, pilot.controlled, pilot.plain)
    scatter = np.where(controlled, pilot.controlled_scatter, pilot.plain_scatter)
    # rays for the wanted error of the scatter, and so many that no ray weighs too much
    wanted_error = wanted_of(flux)
    needed = (scatter / wanted_error).astype(np.float32)
    if pilot.bounced_scatter is not None:
        gain = gain_of(pilot.bounced_scatter, needed, wanted_error, gain, tuning)[0]
    by_scatter = gain.rays(needed)
    by_weight = pilot.unshadowed / (np.float32(tuning.audit_ray_weight) * wanted_error)
    # powers of two, of the weight of a ray the nearest one
    wanted = np.maximum(np.ceil(np.log2(np.maximum(by_scatter, 1))), np.rint(np.log2(np.maximum(by_weight, 1))))
    bits = np.clip(wanted, np.log2(tuning.least_audit_rays), np.log2(tuning.most_rays))
    rays: NDArray[np.integer] = 1 << bits.astype(np.int64)
    # where the largest number of rays does not do, the pair is traced several times
    wanted_times = np.ceil((gain.error(scatter, rays) / wanted_error) ** 2)
    edges: PairEdges | None = None
    if tracer.rays.is_box:
        # edges are looked for where that may save rays; what is known of an edge needs no repetition
        law, floor = rays, np.full(rays.size, tuning.least_audit_rays)
        tried = law >= tuning.edge_least_audit_rays
        if aims is not None:
            tried &= aims.count == 0
        rays, edges = about_edges(
            *(tracer, listed, law, controlled, wanted_error, floor, gain, tuning),
            tried=tried, flat_part=1.0, shadows=shadows, stream=Stream.AUDIT_EDGE,
        )  # fmt: skip
        wanted_times = np.where(rays < law, 1, wanted_times)
    times = np.clip(wanted_times, 1, tuning.most_audit_times).astype(np.int64)
    values = traced_repeatedly(tracer, (pixel, window, windows, rays), controlled, times, aims, edges, shadows)
    return values[:, place.ravel()]


def traced_repeatedly(
    tracer: PairTracer,
    pairs: tuple[NDArray[np.uint32], NDArray[np.integer], Windows, NDArray[np.integer]],
    controlled: NDArray[np.bool_],
    times: NDArray[np.int64],
    aims: PairAims | None = None,
    edges: PairEdges | None = None,
    shadows: NDArray[np.uint32] | None = None,
) -> NDArray[np.float64]:
    """Mean of some traces of each pair, and half the difference of its halves, [2, n], e⁻/s.

    Parameters
    ----------
    pairs : pixels [n] on the full sensor, their windows, all windows, and rays of a trace.
    times : [n], number of traces.
    controlled, aims, edges, shadows : see `PairTracer.trace`.
    """
    pixel, window, windows, rays = pairs
    # one entry a repetition, with random numbers by its number; the mean is taken over those of a pair
    each, first = np.repeat(np.arange(pixel.size), times), np.cumsum(times) - times
    of = pixel[each], window[each], windows, rays[each], controlled[each], Stream.AUDIT
    repeat = np.arange(each.size) - first[each]
    got = tracer.trace(
        *of, repeat=repeat, aims=None if aims is None else aims.part(each),
        edges=None if edges is None else edges.part(each), shadows=None if shadows is None else shadows[each],
    )  # fmt: skip
    values = 0.5 * np.stack([got.half_a + got.half_b, got.half_a - got.half_b]).astype(np.float64)
    return np.asarray(np.add.reduceat(values, first, axis=1) / times)


def aims_of(
    zoom: Zoom, pixel: NDArray[np.uint32], cols: int, windows: Windows, window: NDArray[np.int64]
) -> PairAims | None:
    """Objects at which rays of listed pairs are aimed; None if there are none."""
    row, col = np.divmod(pixel.astype(np.int64), cols)
    looks = [look for looks in zoom.sites(row, col, windows, window[None]) for look in looks]
    aims = Aims.of([(0, *look.aims) for look in looks if look.aims is not None], pixel.size)
    return None if aims is None else aims.at(np.zeros(pixel.size, np.int64), np.arange(pixel.size))


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
    return PilotFlux(**{name: np.concatenate([part.tables[name] for part in parts])[order] for name in parts[0].tables})

"""The pilot pass: a few rays of each pixel in each window decide how the final render spends its rays.

Pilot rays have random numbers of their own. Decisions that depend on them therefore do not favour what the rays of the
final render happen to miss [kirk1991]. The pilot rays are the same at all times, so a difference between two windows is
a change of the scene, not of the rays.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.aim import Aims
from hesim_render.sources.render.change_driven.change_detector import (
    DETECTOR_RAYS,
    Wanted,
    windows_with_changes,
)
from hesim_render.sources.render.change_driven.deep_shadow import DeepShadow
from hesim_render.sources.render.change_driven.kept_pilots import Anchored, Ended
from hesim_render.sources.render.change_driven.known_shadows import with_known_shadows
from hesim_render.sources.render.change_driven.looks import Looks
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pair_flux import (
    BOUNCED,
    CHANGES,
    STATISTICS,
    PilotFlux,
    PilotRays,
    joined,
)
from hesim_render.sources.render.change_driven.pair_tracer import PairTracer
from hesim_render.sources.render.change_driven.small_objects import Look
from hesim_render.sources.render.change_driven.windows import Windows


@dataclass(frozen=True)
class Refinement:
    """Sites where a small object may pass during a window, and the statistics of extra pilot rays there.

    Parameters
    ----------
    place : [k], places among the sites.
    rays : [k], number of rays.
    controlled_scatter, plain_scatter : [k], scatter of single rays, e⁻/s.
    """

    place: NDArray[np.int64]
    rays: NDArray[np.int64]
    controlled_scatter: NDArray[np.float32]
    plain_scatter: NDArray[np.float32]


@dataclass(frozen=True)
class Change:
    """Differences of the pilot's rays to the same rays in another window, arrays [window, site], e⁻/s.

    The first and the last window are compared with their anchors, all others with the first window.

    Parameters
    ----------
    controlled, plain : mean of the differences, by both estimators.
    controlled_scatter, plain_scatter : their standard deviation from ray to ray.
    """

    controlled: NDArray[np.float32]
    plain: NDArray[np.float32]
    controlled_scatter: NDArray[np.float32]
    plain_scatter: NDArray[np.float32]


@dataclass(frozen=True)
class Pilot:
    """Statistics of sites in successive windows, all arrays [window, site]; see `PilotFlux` and `DiffuseIntegrator`.

    Parameters
    ----------
    controlled, plain : mean flux by each estimator, e⁻/s.
    controlled_scatter, plain_scatter : scatter of single rays for each estimator, e⁻/s.
    unshadowed : flux if nothing hid any light, e⁻/s.
    refined : results of extra rays at some sites, one entry per window; empty where there were none.
    aims : small objects at which rays are aimed; None if there are none.
    change : differences to other windows; None where nothing is compared.
    all_move : True if the camera moves, and with it every edge in the image.
    deep : sites in deep shadow; None if there are none.
    shadows : [window, site], known shadows, see `PairTracer.trace`; None if there are none.
    bounced_scatter : scatter of what paths find beside closed forms, e⁻/s; None if there is nothing.
    ended : what the next block begins with; None where it has to look again.
    """

    controlled: NDArray[np.float32]
    plain: NDArray[np.float32]
    controlled_scatter: NDArray[np.float32]
    plain_scatter: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    refined: list[Refinement] = field(default_factory=list)
    aims: Aims | None = None
    change: Change | None = None
    all_move: bool = False
    deep: DeepShadow | None = None
    shadows: NDArray[np.uint32] | None = None
    bounced_scatter: NDArray[np.float32] | None = None
    ended: Ended | None = None

    @property
    def windows(self) -> int:
        """Number of windows."""
        return self.controlled.shape[0]

    def flux_in(self, window: int | slice) -> NDArray[np.float32]:
        """Flux by the estimator with less scatter in each window, of one window or some, [(window,) site], e⁻/s."""
        is_controlled = self.controlled_scatter[window] <= self.plain_scatter[window]
        return np.where(is_controlled, self.controlled[window], self.plain[window])

    @cached_property
    def steady_flux(self) -> NDArray[np.float32]:
        """Flux by the same estimator in all windows, [window, site], e⁻/s, so that every difference is a change of
        the scene.
        """
        chosen = self.controlled_scatter.sum(axis=0) <= self.plain_scatter.sum(axis=0)
        return np.where(chosen, self.controlled, self.plain)


def knows_rest(tracer: PairTracer) -> bool:
    """True if what no ray sees come near is at rest: not with a moving camera, or a lens that spreads light of what
    moves.
    """
    return tracer.camera is None and not (tracer.rays.spreads and tracer.parts.groups)


def take_pilot(
    tracer: PairTracer,
    sites: Sites,
    windows: Windows,
    numbers: NDArray[np.int64],
    rays: int,
    width_px: float,
    span_us: tuple[float, float] | None,
    extra_looks: Sequence[Sequence[Look]] = (),
    anchored: Anchored | None = None,
    known: PilotFlux | None = None,
    stride: int = 1,
    wanted: Wanted | None = None,
    mild: bool = False,
    few_stride: int = 1,
    ending: Anchored | None = None,
    begun: Ended | None = None,
    is_kept: bool = False,
) -> tuple[Pilot, NDArray[np.bool_]]:
    """Trace the pilot pass.

    Parameters
    ----------
    tracer, sites, windows : renderer, pixels with neighbours, and all windows.
    numbers : [window, site], window number of each site.
    rays : rays per site and window.
    width_px : width of the area in which the rays start, px.
    span_us : interval around all windows for which `near` is computed, µs; None: not computed.
    extra_looks : for each window, the sites that get extra rays; see `Zoom`.
    anchored : pilot of the anchor with which the first window is compared; None: nothing is compared.
    known : results of the first window, where they are known and nothing is compared.
    stride : number of windows from one look to the next; between two looks that show the same, nothing is traced.
    wanted : maps the flux of each site to the wanted error of a pair, both e⁻/s; needed where `stride` is above 1.
    mild : take the mild scatter, see `PilotFlux`.
    few_stride : number of windows from one look of few rays to the next, see `windows_with_changes`.
    ending : pilot of the anchor with which the last window is compared; None: that of the first window.
    begun : what the block before ended with, see `Ended`; taken if this one begins with the same window.
    is_kept : keep what the last window shows for the next block, unless rays have to tell what comes near there, see
        `knows_rest`.

    Returns
    -------
    pilot : statistics of all windows. Sites near which nothing moves are traced in the first window only.
    near : [site], True if a ray came near a moving object within the interval; always True if the camera moves,
        or if anything moves in front of a lens that spreads light (`RayFactory.spreads`).
    """
    count, every, given = numbers.shape[0], np.arange(sites.size), (windows, rays, width_px)
    ending = anchored if ending is None else ending
    knows = knows_rest(tracer)
    # known shadows [window, site]: shapes that hide light in the first window do so in those that follow
    shadows, given_shadows = np.zeros((count, sites.size), np.uint32), (rays, width_px, wanted, mild)
    if begun is not None and not knows and begun.begins(windows, numbers[0], anchored):
        own_rays: PilotRays | None = begun.rays
        first, own_place, own_count = begun.flux, every, sites.size
        shadows[:] = begun.shadows
    else:
        one = tracer, sites, windows, numbers[0], rays, width_px, span_us, anchored, known, mild, knows
        first, own_rays, own_place, own_count = _in_first(*one)
        first, shadows[:] = with_known_shadows(tracer, (sites.index, numbers[0], windows), first, *given_shadows)
    near = first.met if knows else np.ones(sites.size, np.bool_)

    def look(window: NDArray[np.int64], place: NDArray[np.int64]) -> PilotFlux:
        """Trace sites in windows other than the first."""
        compared = None
        if ending is not None and own_rays is not None:
            compared = joined(own_rays, ending.rays), np.where(window == count - 1, own_count + place, own_place[place])
        return tracer.pilot(
            sites.index[place],
            numbers[window, place],
            *given,
            before=compared,
            mild=mild,
            shadows=shadows[window, place],
        )

    looks, ended = Looks(first, count, near, look), None
    if count > 1 and near.any():
        # the last window is the first of the next block, whose shadows are its own
        shadows[-1, near] = 0
        pairs = sites.index, numbers[-1], windows
        seen, end_rays = None, None
        if is_kept and ending is not None and not knows:
            seen, end_rays = tracer.pilot_rays(*pairs, rays, width_px, before=(ending.rays, every), mild=mild)
        at_end, own = with_known_shadows(tracer, pairs, looks.at_end(seen), *given_shadows, among=near)
        shadows[-1, near] = own[near]
        looks.put(count - 1, at_end)
        if end_rays is not None and ending is not None:
            ended = Ended.of(at_end, end_rays, own, windows, numbers[-1], ending)
        if stride == 1 and rays > DETECTOR_RAYS and wanted is not None and count > 2:
            # few rays tell which windows show anything new
            of = tracer, sites, numbers, windows, first, near, wanted, width_px, mild
            looks.wherever(windows_with_changes(*of, shadows[0], few_stride))
        else:
            looks.every(stride, sites, wanted, 0.5 * (width_px - 1))
    if ending is not anchored and not near.all():
        # what rests shows the same in the last window as in the first, but not the same difference to another anchor
        looks.compare_end(np.flatnonzero(~near))
    # statistics of all windows, [window, site]
    tables = [looks.tables[name] for name in STATISTICS]
    pilot = Pilot(tables[0], tables[1], tables[2], tables[3], tables[4], bounced_scatter=looks.tables.get(BOUNCED))
    change = None
    if anchored is not None and ending is not None:
        # inner windows against the first one, the last and the first against their anchors
        means = [values - values[:1] for values in (pilot.controlled, pilot.plain)]
        for window, other in ((-1, ending.flux), (0, anchored.flux)):
            means[0][window] = pilot.controlled[window] - other.controlled
            means[1][window] = pilot.plain[window] - other.plain
        change = Change(means[0], means[1], looks.tables[CHANGES[0]], looks.tables[CHANGES[1]])
    # extra rays where small objects pass, which the few rays of the pilot may miss
    near_by = [(window, one) for window, row in enumerate(extra_looks) for one in row if one.place.size]
    aims = Aims.of([(window, *one.aims) for window, one in near_by if one.aims is not None], sites.size)
    refined = _refine(tracer, sites, windows, numbers, pilot, width_px, near_by, aims, shadows)
    moves = tracer.camera is not None
    return replace(pilot, refined=refined, aims=aims, change=change, all_move=moves, shadows=shadows, ended=ended), near


def _in_first(
    tracer: PairTracer,
    sites: Sites,
    windows: Windows,
    numbers: NDArray[np.int64],
    rays: int,
    width_px: float,
    span_us: tuple[float, float] | None,
    anchored: Anchored | None,
    known: PilotFlux | None,
    mild: bool,
    knows: bool,
) -> tuple[PilotFlux, PilotRays | None, NDArray[np.int64], int]:
    """What sites show in the first window, and the rays that others are compared with: None where nothing is compared.

    Parameters
    ----------
    tracer, sites, windows, rays, width_px, span_us, anchored, known, mild : see `take_pilot`.
    numbers : [site], window number of each site.
    knows : rays can tell what is at rest.

    Returns
    -------
    first : statistics of the window.
    own_rays : its rays.
    own_place : [site], where those of each site stand among them.
    own_count : number of sites that were traced.
    """
    every = np.arange(sites.size)
    if known is not None:
        return known, None, every, sites.size
    if anchored is None:
        given = windows, rays, width_px
        return tracer.pilot(sites.index, numbers, *given, span_us=span_us, mild=mild), None, every, sites.size
    if anchored.tells(span_us) and not anchored.is_long and anchored.is_in(windows, numbers):
        # the first window is the anchor itself, whose rays are known
        return anchored.flux, anchored.rays, every, sites.size
    some = every
    if anchored.is_long and anchored.tells(span_us) and knows:
        # what nothing comes near for much longer shows here what it does in the anchor; one site at least is traced, as
        # kernels need a ray
        some = np.flatnonzero(anchored.flux.met) if anchored.flux.met.any() else every[:1]
    own_place = np.zeros(sites.size, np.int64)
    own_place[some] = np.arange(some.size)
    which = sites.index[some], numbers[some], windows, rays, width_px
    seen, own_rays = tracer.pilot_rays(*which, span_us=span_us, before=(anchored.rays, some), mild=mild)
    return anchored.flux.with_pairs(some, seen), own_rays, own_place, some.size


def _refine(
    tracer: PairTracer,
    sites: Sites,
    windows: Windows,
    numbers: NDArray[np.int64],
    pilot: Pilot,
    width_px: float,
    looks: Sequence[tuple[int, Look]],
    aims: Aims | None,
    shadows: NDArray[np.uint32],
) -> list[Refinement]:
    """Trace extra pilot rays, listed with their windows. Results for large objects, and those of aimed rays, replace
    those of the pilot; results for small objects are returned.
    """
    nothing = Refinement(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))
    parts = [[nothing] for _ in range(numbers.shape[0])]
    kinds = sorted({(look.is_small, look.aims is not None, look.rays) for _, look in looks})
    # large objects first: a pixel may show a small object as well, whose result must stay
    for is_small, is_aimed, rays in kinds:
        # one trace for all windows of a kind: [k] windows and places
        alike = [
            (window, look.place)
            for window, look in looks
            if (look.is_small, look.aims is not None, look.rays) == (is_small, is_aimed, rays)
        ]
        place = np.concatenate([places for _, places in alike])
        window = np.concatenate([np.full(places.size, window) for window, places in alike])
        # aimed rays start in the pixel itself, others in an area as wide as those of the pilot
        own_aims = aims.at(window, place) if is_aimed and aims is not None else None
        width = 1.0 if is_aimed else width_px
        refined = tracer.pilot(
            *(sites.index[place], numbers[window, place], windows, rays, width, Stream.RENDER_ZOOM),
            aims=own_aims,
            shadows=shadows[window, place],
        )
        # these rays see better than the pilot; those of small objects that are not aimed only tell of more scatter
        if is_aimed or not is_small:
            for name in refined.statistics:
                getattr(pilot, name)[window, place] = getattr(refined, name)
        if not is_small:
            continue
        # scatter of small objects, sorted by window
        for number in np.unique(window):
            own = window == number
            counts = np.full(np.count_nonzero(own), rays)
            parts[number].append(
                Refinement(place[own], counts, refined.controlled_scatter[own], refined.plain_scatter[own])
            )
    return [Refinement(*map(np.concatenate, zip(*map(astuple, each), strict=True))) for each in parts]

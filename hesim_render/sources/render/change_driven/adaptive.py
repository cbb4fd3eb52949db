"""Adaptive rendering of listed pixels: pilot pass, plan, and the rays that the plan names."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.aim import PairAims
from hesim_render.sources.render.change_driven.bends import straightened
from hesim_render.sources.render.change_driven.change_detector import seen_with_few_or_all
from hesim_render.sources.render.change_driven.deep_shadow import deep_shadow
from hesim_render.sources.render.change_driven.edge_courses import Courses, courses
from hesim_render.sources.render.change_driven.edge_rays import about_edges
from hesim_render.sources.render.change_driven.edges import EdgeFit, PairEdges
from hesim_render.sources.render.change_driven.error_target import Noise, Role
from hesim_render.sources.render.change_driven.estimates import Band, Counts, Flux, Still
from hesim_render.sources.render.change_driven.held_pairs import HeldPairs, held_pairs
from hesim_render.sources.render.change_driven.kept_pilots import Anchored, Ended
from hesim_render.sources.render.change_driven.neighbours import Sites, squares
from hesim_render.sources.render.change_driven.pair_flux import PairFlux, PilotFlux
from hesim_render.sources.render.change_driven.pilot import Pilot, knows_rest, take_pilot
from hesim_render.sources.render.change_driven.plan import Plan, Shares, plan
from hesim_render.sources.render.change_driven.sample_instants import MotionClock
from hesim_render.sources.render.change_driven.shared_tracer import SharedTracer
from hesim_render.sources.render.change_driven.sharing import Sharing
from hesim_render.sources.render.change_driven.small_objects import Zoom
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning
from hesim_render.sources.render.change_driven.windows import Windows
from hesim_render.sources.render.tracer import rays_at_once

_ALWAYS_US = (-np.inf, np.inf)
#: See `Anchor.link`.
Link = Callable[[Plan, NDArray, NDArray, PairEdges | None, PairFlux], NDArray[np.float32]]
#: Part of the wanted error below which a flux counts as no light at all.
_NOTHING = np.float32(1e-3)
#: Largest number of pilot rays that are kept from the end of a block for the next one, in 0.27 GB.
_MOST_KEPT_RAYS = 1 << 25


def pixels_at_once(role: Role, has_ticks: bool, apart: bool) -> int:
    """Number of pixels that are processed at a time, to bound memory; no value depends on it. The 32 pilot rays of each
    are traced at once, in arrays of a power of two, as Dr.Jit's memory is. A block of ticks has fewer windows, so
    that twice as many pixels fit; not where event pixels lie apart, as sensors with many of them need the memory.
    """
    return rays_at_once() // (16 if has_ticks and role == "events" and not apart else 32)


class AdaptiveRenderer:
    """Renders each pixel in each window with as many rays as a pilot pass says that its noise requires.

    Parameters
    ----------
    tracer : traces the rays.
    noise : noise of the sensor, in which errors are wanted.
    quality : wanted error over that noise.
    tuning : constants of the method.
    clock : knows how fast anything moves in the image.

    Attributes
    ----------
    tracer, noise, quality, tuning : as given.
    gain : gain of stratified rays in this kind of scene.
    zoom : finds pixels that small objects may cross.
    index : [row · cols + col], number of each mosaic pixel on the full sensor.
    counts : work done so far.
    look_stride : windows from one look of the pilot to the next.
    has_ticks : True if event pixels compare at a fixed tick.
    sharing : pixels that share what their paths find.
    """

    def __init__(self, tracer: SharedTracer, noise: Noise, quality: float, tuning: Tuning, clock: MotionClock) -> None:
        self.tracer, self.noise, self.quality, self._clock = tracer, noise, quality, clock
        has_closed_form = tracer.is_diffuse or tracer.has_bounced
        self.gain = Gain(*(tuning.diffuse_gain if has_closed_form else tuning.path_gain))
        self.counts = Counts()
        self._sensor = tracer.sensor
        self.index = self._sensor.layout.full_index.ravel()
        evs, rays = self._sensor.spec.evs, tracer.rays
        # windows of an asynchronous sensor are so close that nothing moves far from one to the next
        self.has_ticks = evs is None or evs.tick_us is not None
        self.look_stride = 1 if self.has_ticks else tuning.look_stride
        # an asynchronous pixel is looked at so seldom that more rays for the small changes of paths cost little
        if not (tracer.is_diffuse or self.has_ticks):
            tuning = replace(tuning, pilot_rays=tuning.path_pilot_rays)
        self.tuning = tuning
        self.zoom = Zoom(tracer.view, tracer.camera, tracer.parts.groups, tuning, rays.can_aim, rays.blur_px)
        self.sharing = Sharing(tracer, noise, quality, tuning)
        self._kept: dict[Role, Still] = {}

    @property
    def uncounted(self) -> int:
        """Number of rays that were traced and are not counted yet. What is counted in between drops out of the
        difference of two such numbers.
        """
        return self.tracer.rays_done - self.counts.rays - self.counts.pilot_rays

    def still(self, role: Role) -> Still:
        """The pixels of a role that are known to be constant, and their flux."""
        if role not in self._kept:
            may_rest = bool(self.tracer.parts.groups) and knows_rest(self.tracer)
            self._kept[role] = Still(_ALWAYS_US if may_rest else None, self.index.size)
        return self._kept[role]

    @cached_property
    def kept_rays(self) -> int:
        """Pilot rays of an event pixel that a block keeps for the next one: none where they tell what comes near, or of
        too many pixels.
        """
        rays = 0 if knows_rest(self.tracer) else self._pilot_rays("events")
        return rays if rays * self._sensor.layout.evs_pixel.size <= _MOST_KEPT_RAYS else 0

    def _pilot_rays(self, role: Role) -> int:
        if role == "any":
            return self.tuning.frame_pilot_rays
        return self.tuning.lone_pilot_rays if self.noise.is_apart(role) else self.tuning.pilot_rays

    def bands(self, pixel: NDArray[np.uint32], role: Role) -> Iterator[Band]:
        """The listed pixels in bands, each of which is about square."""
        index, lattice = self.index[pixel], self.noise.lattice(role)
        apart, tuning, rays = self.noise.is_apart(role), self.tuning, self._pilot_rays(role)
        # where edges or texels cross a pixel within a window, strata gain less; a pilot in a wide area sees more than
        # its pixel
        quality, mild = self.quality, self.tracer.is_plain and (apart or not self.has_ticks)
        if role == "any":
            quality, mild = quality / tuning.frame_margin, False
        at_once = pixels_at_once(role, self.has_ticks, apart)
        for place in squares(*np.divmod(index, self._sensor.spec.geometry.cols), at_once):
            # a single window is not followed through time, and needs no pixels beside those that lie apart
            few_first = role == "any" and self.tracer.is_diffuse and not (lattice is None or apart)
            if lattice is None or (apart and role == "any"):
                sites = Sites.alone(index[place])
            else:
                sites = Sites.around(index[place], lattice, int(few_first))
            yield Band(place, sites, self.noise.of(role, sites.index), apart, rays, quality, mild, few_first)

    def pilot(
        self,
        band: Band,
        windows: Windows,
        numbers: NDArray[np.int64],
        span_us: tuple[float, float] | None,
        anchored: Anchored | None = None,
        stride: int = 1,
        known: PilotFlux | None = None,
        ending: Anchored | None = None,
        begun: Ended | None = None,
        is_kept: bool = False,
    ) -> tuple[Pilot, NDArray[np.bool_]]:
        """Pilot pass of a band in listed windows; see `take_pilot`."""
        before, cols = self.tracer.rays_done, self._sensor.spec.geometry.cols
        width = self._footprint_px(band)
        row, col = np.divmod(band.sites.index.astype(np.int64), cols)
        looks = self.zoom.sites(row, col, windows, numbers)
        of = self.tracer, band.sites, windows, numbers, band.pilot_rays, width

        def wanted(flux: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.float32(band.quality) * band.unit(flux)

        if band.few_first:
            known = seen_with_few_or_all(*of[:2], numbers[0], windows, *of[4:], span_us, wanted)
        # few rays look at blocks of ticks only; the bound of motion takes rays of its own where the camera moves
        steps, few = len(numbers) - 1, 1
        if self.has_ticks and steps > 1:
            few = self._clock.windows_of_a_pixel(*windows.span_us, steps)
        given = *of, span_us, looks, anchored, known, stride, wanted, band.mild, few, ending, begun, is_kept
        pilot, near = take_pilot(*given)
        if band.apart and pilot.windows > 2:
            # no neighbour tells when deep shadow ends
            seen = pilot.steady_flux, pilot.unshadowed
            deep = deep_shadow(self.tracer, band.sites, numbers, windows, seen, near, wanted, width, self.tuning)
            pilot = replace(pilot, deep=deep)
        self.counts.pilot_rays += self.tracer.rays_done - before
        return pilot, near

    def pilot_rays(
        self, band: Band, windows: Windows, near_us: tuple[float, float] | None, is_long: bool = False
    ) -> Anchored:
        """Pilot of a band in the only window, with its rays, which say what comes near in an interval, µs; see
        `Anchored`.
        """
        before, sites = self.tracer.rays_done, band.sites
        first = np.zeros(sites.size, np.int64)
        given = sites.index, first, windows, band.pilot_rays, self._footprint_px(band), near_us
        anchored = Anchored(*self.tracer.pilot_rays(*given, mild=band.mild), windows.span_us, near_us, is_long)
        self.counts.pilot_rays += self.tracer.rays_done - before
        return anchored

    def _footprint_px(self, band: Band) -> float:
        """Width of the area in which pilot rays of a band start, px."""
        return self.tuning.lone_footprint_px if band.apart else self.tuning.footprint_px

    def plan(
        self,
        pilot: Pilot,
        band: Band,
        is_knot: bool,
        windows: Windows | None = None,
        shares: Shares = None,
        until: int | None = None,
    ) -> Plan:
        """Which pairs of a band are rendered, with how many rays; see `plan`. Of the windows of a block, those between
        which the light of paths is a straight line are left out; this traces rays. With `until`, pairs on which no
        value up to this window depends are left out as well, see `Plan.until`.
        """
        given = pilot, band.sites, band.unit, band.quality, self.gain, self.tuning
        # windows of synchronous sensors are too far apart for an edge to stay within a pixel
        what = plan(*given, is_knot, self.look_stride > 1 and self.tracer.rays.is_box, shares)
        if not self.tracer.is_diffuse:
            # a highlight or a caustic may be there all the same
            dark = what.pilot < _NOTHING * what.wanted
            what.rays[dark] = np.maximum(what.rays[dark], np.int16(self.tuning.dark_rays))
        if windows is not None and not (self.tracer.is_diffuse or self.has_ticks):
            before = self.tracer.rays_done
            among = None if what.bounces is None else np.flatnonzero(what.bounces.any(axis=0))
            what = straightened(self.tracer, band.index, windows, what, self.tuning, among, until)
            self.counts.rays += self.tracer.rays_done - before
        return what if until is None else what.until(until)

    def follow(
        self, band: Band, windows: Windows, numbers: NDArray[np.int64], what: Plan
    ) -> tuple[Plan, EdgeFit | None, Courses, HeldPairs]:
        """Follow edges from window to window, and hold what does not change beside them: a plan without the windows
        between two fits of one edge and without held pairs, its fits, those windows, and those pairs; this traces
        decision rays.

        Parameters
        ----------
        numbers : [w, n], window number of each pair.
        """
        if not what.fitted.any() and not what.asked.any():
            return what, None, Courses.none(), HeldPairs.none()
        fit = self._decided(band, windows, numbers, what, what.fitted)
        window, pixel = np.nonzero(what.fitted)
        centre_us = 0.5 * (windows.begin_us + windows.end_us)
        given = what.pilot, self._footprint_px(band), what.wanted[what.fitted], centre_us, what.barred
        edge_courses = courses(window, pixel, fit.scaled(self.tracer.axis_factor(band.index[pixel])), *given)
        what = what.without(edge_courses.window, edge_courses.pixel)
        # light that is hidden from all decision rays may come through a gap, if one ray of it would weigh too much
        asked = what.asked & what.rendered & (what.differences.rays == 0) & (what.floor <= self.tuning.edge_rays)
        more = asked & ~what.fitted
        # fits of both kinds in order of the window
        fits = EdgeFit.empty(int(np.count_nonzero(what.fitted | more)))
        is_known = what.fitted[what.fitted | more]
        fits.replace(np.flatnonzero(is_known), fit)
        fits.replace(np.flatnonzero(~is_known), self._decided(band, windows, numbers, what, more))
        what = replace(what, fitted=what.fitted | more)
        window, pixel = np.nonzero(what.fitted)
        scaled, wanted = fits.scaled(self.tracer.axis_factor(band.index[pixel])), what.wanted[what.fitted]
        held = held_pairs(window, pixel, scaled, wanted, self.tuning.low_contrast, what.rendered, asked)
        return what.without(held.window, held.pixel), fits, edge_courses, held

    def _decided(
        self, band: Band, windows: Windows, numbers: NDArray[np.int64], what: Plan, which: NDArray[np.bool_]
    ) -> EdgeFit:
        """Fits to decision rays of some pairs of a plan, [w, n]; fluxes on the optical axis."""
        before, tuning = self.tracer.rays_done, self.tuning
        index = band.index[np.nonzero(which)[1]]
        little = np.float32(tuning.flat_contrast) * what.wanted[which] / self.tracer.axis_factor(index)
        of = index, numbers[which], windows, tuning.edge_rays, tuning.edge_footprint_px
        shadows = None if what.shadows is None else what.shadows[which]
        fit = self.tracer.edges(*of, what.controlled[which], little, shadows=shadows)
        self.counts.rays += self.tracer.rays_done - before
        return fit

    def render(
        self,
        band: Band,
        windows: Windows,
        numbers: NDArray[np.int64],
        what: Plan,
        span_us: tuple[float, float] | None = None,
        first: Flux | None = None,
        fit: EdgeFit | None = None,
        link: Link | None = None,
        is_anchor: bool = False,
    ) -> tuple[Flux, NDArray[np.bool_]]:
        """Render the pairs that a plan names, except differences, which need an anchor; see `Anchor.render`.

        Parameters
        ----------
        numbers : [w, n], window number of each pair.
        first : [1, n], flux in the first window, if it is already known.
        fit : lines of the pairs `fitted` of the plan, where they are known.
        link : renders linked pairs as differences, see `Anchor.link`; None where there are none.
        is_anchor : True where the flux counts for all of a long time, as that of event pixels that rest.

        Returns
        -------
        flux : [w, n], 0 where nothing was rendered.
        met : [w, n], True if a path came near a moving object in `span_us`; False where nothing was rendered.
        """
        out, met = Flux.zeros(*what.rendered.shape), np.zeros(what.rendered.shape, np.bool_)
        todo = what.rendered & (what.differences.rays == 0)
        if first is not None:
            todo[0] = False
        before = self.uncounted
        window, place = np.nonzero(todo)
        aims = None if what.aims is None else what.aims.at(window, band.sites.listed[place])
        pairs = band.index[place], numbers[todo], windows
        rays, edges = self.rays_of(pairs, what, todo, aims, fit, is_anchor)
        shared = None if what.shared is None else what.shared[todo]
        shadows = None if what.shadows is None else what.shadows[todo]
        got = self.sharing.trace((*pairs, rays, what.controlled[todo]), shared, span_us, aims, edges, shadows)
        error = what.error[todo] if link is None else link(what, todo, rays, edges, got)
        self.counts.rays += self.uncounted - before
        self.counts.pairs += place.size
        if not self.tracer.is_diffuse:
            # rays that saw nothing do not show that there is nothing: halves of 0 would state an error of 0
            got.set_apart(_NOTHING, what.wanted[todo])
        out.half_a[todo], out.half_b[todo], met[todo] = got.half_a, got.half_b, got.met
        np.copyto(out.error, what.error)
        out.error[todo] = error
        if first is not None:
            for values, known in zip(out.arrays, first.arrays, strict=True):
                values[0] = known[0]
        return out, met

    def rays_of(
        self,
        pairs: tuple[NDArray[np.uint32], NDArray[np.int64], Windows],
        what: Plan,
        todo: NDArray[np.bool_],
        aims: PairAims | None,
        fit: EdgeFit | None = None,
        is_anchor: bool = False,
    ) -> tuple[NDArray[np.integer], PairEdges | None]:
        """Numbers of rays of the pairs `todo` of a plan, and models of their edges; this traces decision rays.

        Parameters
        ----------
        pairs : pixels on the full sensor, their windows, and all windows.
        aims : small objects of these pairs, at which rays are aimed.
        fit : lines of the pairs `fitted` of the plan, where they are known.
        is_anchor : see `render`.
        """
        rays: NDArray[np.integer] = what.rays[todo]
        if not self.tracer.rays.is_box:
            return rays, None
        tried = None if aims is None else aims.count == 0
        given = rays, what.controlled[todo], what.wanted[todo], what.floor[todo]
        known = None if fit is None else (what.fitted[todo], fit.at(todo[what.fitted]))
        shadows, gain = None if what.shadows is None else what.shadows[todo], self.gain
        if what.bounces is not None:
            gain = gain.or_other(Gain(*self.tuning.path_gain), what.bounces[todo])
        # half of the rays are uniform: one that finds the line wrong weighs twice its contrast over their number
        least = 2 / self.tuning.ray_weight if is_anchor else 0.0
        of = self.tracer, pairs, *given, gain, self.tuning
        return about_edges(*of, tried=tried, contrast_rays=least, known=known, shadows=shadows)

"""The plan of a block of windows: which windows of a pixel are rendered, and which are interpolated."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.aim import Aims
from hesim_render.sources.render.change_driven.allocation import allocate
from hesim_render.sources.render.change_driven.differences import Differences, Shares, differences
from hesim_render.sources.render.change_driven.edge_courses import fitted_windows
from hesim_render.sources.render.change_driven.error_target import NoiseUnit
from hesim_render.sources.render.change_driven.neighbours import Sites
from hesim_render.sources.render.change_driven.pilot import Pilot
from hesim_render.sources.render.change_driven.tuning import Gain, Tuning


def changes(flux: NDArray[np.float32], least: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Windows next to which the pilot's flux changes, [window, site].

    A window is marked if the flux differs from that of the last marked window by more than `least`. The window before
    it is marked as well, if most of the change happened in that one step. The first and the last window are not marked
    for their position alone.

    Parameters
    ----------
    flux : [window, site], flux of the pilot, e⁻/s.
    least : [window, site], smallest change that counts, e⁻/s.

    Returns
    -------
    Marks, [window, site].
    """
    marked = np.zeros(flux.shape, np.bool_)
    # the flux of the last marked window of each site, [site]; windows are compared with it, so that slow drifts add up
    level = flux[0].copy()
    bound, step = np.empty((2, flux.shape[1]), np.float32)
    changed = np.empty(flux.shape[1], np.bool_)
    for window in range(1, flux.shape[0]):
        now = flux[window]
        # the noise is that of either window, and the smaller one decides what can be seen
        np.minimum(least[window - 1], least[window], out=bound)
        np.greater(np.abs(np.subtract(now, level, out=step), out=step), bound, out=changed)
        marked[window] |= changed
        # a sudden step: the line to the marked window would begin too early without the window before it
        np.abs(np.subtract(now, flux[window - 1], out=step), out=step)
        marked[window - 1] |= changed & (step > np.float32(0.5) * bound)
        np.copyto(level, now, where=changed)
    return marked


def longer(marked: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Extend marks [window, site] by `by` windows before and after each."""
    extended = marked.copy()
    for shift in range(1, by + 1):
        extended[shift:] |= marked[:-shift]
        extended[:-shift] |= marked[shift:]
    return extended


@dataclass(frozen=True)
class Plan:
    """How the listed pixels of a block are rendered, arrays [window, pixel].

    Parameters
    ----------
    rendered : True for rendered pairs. The first and the last window always are; the others are interpolated linearly.
    rays : number of rays of each rendered pair, a power of two.
    controlled : True for the estimator with a control variate, False for the plain one, see `DiffuseIntegrator`.
    error : expected standard error, e⁻/s.
    wanted : wanted standard error, e⁻/s.
    floor : number of rays that a pair gets whatever is known of its edges.
    differences : pairs that are rendered as differences to another window.
    fitted : rendered pairs in which lines are fitted, to follow edges from one to the next; see `edge_courses`.
    barred : pairs between which no edge is followed.
    asked : rendered pairs that show no change by themselves, for which neighbours ask; none where no edge is followed.
    pilot : flux of the pilot, e⁻/s.
    aims : small objects at which rays are aimed, by window and site; None if there are none.
    shadows : [window, pixel], known shadows, see `PairTracer.trace`; None if there are none.
    shared : pairs that share with those around, see `Sharing`; None if none do.
    bounces : pairs that follow the law of paths; None if all have the same law.
    """

    rendered: NDArray[np.bool_]
    rays: NDArray[np.int16]
    controlled: NDArray[np.bool_]
    error: NDArray[np.float32]
    wanted: NDArray[np.float32]
    floor: NDArray[np.int16]
    differences: Differences
    fitted: NDArray[np.bool_]
    barred: NDArray[np.bool_]
    asked: NDArray[np.bool_]
    pilot: NDArray[np.float32]
    aims: Aims | None = None
    shadows: NDArray[np.uint32] | None = None
    shared: NDArray[np.bool_] | None = None
    bounces: NDArray[np.bool_] | None = None

    def until(self, window: int) -> "Plan":
        """The plan without the pairs on which no value up to a window depends.

        The last block of a run goes beyond its end, since blocks are the same for all runs. Of each pixel, the first
        rendered window after the end is needed for interpolation, and the first one in which a line is fitted; later
        ones are not, and are left as unknown.
        """
        later, fitted = self.rendered[window:].copy(), self.fitted[window:].copy()
        # rendered windows after the first one: those before which another one was rendered
        for which in (later, fitted):
            which &= np.cumsum(which, axis=0) <= 1
        later |= fitted
        return replace(
            self,
            rendered=np.concatenate([self.rendered[:window], later]),
            fitted=np.concatenate([self.fitted[:window], fitted]),
        )

    def without(self, window: NDArray[np.int64], pixel: NDArray[np.int64]) -> "Plan":
        """The plan, some pairs of which are not rendered."""
        rendered = self.rendered.copy()
        rendered[window, pixel] = False
        return replace(self, rendered=rendered)

    def first(self) -> "Plan":
        """The plan of the first window alone."""
        names = "rendered", "rays", "controlled", "error", "wanted", "floor", "fitted", "barred", "asked", "pilot"
        first = {name: getattr(self, name)[:1] for name in names}
        shadows = None if self.shadows is None else self.shadows[:1]
        bounces = None if self.bounces is None else self.bounces[:1]
        return replace(self, differences=self.differences.first(), shadows=shadows, bounces=bounces, **first)


def plan(
    pilot: Pilot,
    sites: Sites,
    unit: NoiseUnit,
    quality: float,
    gain: Gain,
    tuning: Tuning,
    is_knot: bool,
    follows: bool = False,
    shares: Shares = None,
) -> Plan:
    """Plan a block, or a single window, from the pilot pass.

    Parameters
    ----------
    pilot, sites : statistics of the pilot, and pixels with neighbours.
    unit : noise unit of each site at its flux.
    quality : wanted error in noise units.
    gain : error law of stratified rays.
    tuning : constants.
    is_knot : True if the first and the last window may be ends of blocks.
    follows : True if edges are followed from window to window.
    shares : [pixel] each, pixels that share in the anchors of the first and of the last window; None if none do.

    Returns
    -------
    The plan.
    """
    count, last = pilot.windows, pilot.windows - 1
    shape = count, sites.listed.size
    # noise units of all sites, [window, site]; the pilot has neighbours besides the listed pixels
    units = np.stack([unit(pilot.flux_in(window)) for window in range(count)])
    out = Plan(
        np.ones(shape, np.bool_),
        np.zeros(shape, np.int16),
        np.zeros(shape, np.bool_),
        np.zeros(shape, np.float32),
        np.float32(quality) * units[:, sites.listed],
        np.zeros(shape, np.int16),
        # those are chosen last, when all rays are known
        Differences.none(0, 0),
        np.zeros(shape, np.bool_),
        np.zeros(shape, np.bool_),
        np.zeros(shape, np.bool_),
        pilot.steady_flux[:, sites.listed],
        pilot.aims,
        None if pilot.shadows is None else pilot.shadows[:, sites.listed],
        bounces=None if pilot.bounced_scatter is None else np.zeros(shape, np.bool_),
    )
    if last > 1:
        _choose_windows(out, pilot, sites, units, quality, tuning, follows)
    # rays, estimator and expected error of every pair; many windows are interpolated from the ends of a block
    for window, some in enumerate(map(np.flatnonzero, out.rendered)):
        at_end = is_knot and window in (0, last)
        *part, bounces = allocate(pilot, window, sites.only(some), units, quality, gain, tuning, at_end)
        out.rays[window, some], out.controlled[window, some], out.error[window, some], out.floor[window, some] = part
        if out.bounces is not None:
            out.bounces[window, some] = bounces
    # where little changes, few rays of a difference do what many rays of the pair alone would
    chosen = differences(pilot, sites, units, quality, out.rendered, out.rays, tuning, out.error, shares)
    if follows and last > 1:
        # a fit of a line takes decision rays of its own, which must be few against those of the pair
        worth = out.rendered & (out.rays >= tuning.edge_least_rays) & (chosen.rays == 0) & ~out.barred
        out.fitted[:] = fitted_windows(worth)
    return replace(out, differences=chosen)


def _choose_windows(
    out: Plan,
    pilot: Pilot,
    sites: Sites,
    units: NDArray[np.float32],
    quality: float,
    tuning: Tuning,
    follows: bool,
) -> None:
    """Put into a plan which windows between the first and the last are rendered, for whom, and which are barred.

    Parameters
    ----------
    out : the plan.
    units : [window, site], noise units, e⁻/s.
    pilot, sites, quality, tuning, follows : see `plan`.
    """
    last = pilot.windows - 1
    # what must change, at least, for a window to be rendered, [window, site]
    flux, least = pilot.steady_flux, np.float32(tuning.change * tuning.tolerance * quality) * units
    marked = changes(flux, least)
    if pilot.deep is not None:
        # many rays in a few windows say when deep shadow ends
        marked[:, pilot.deep.place] |= changes(pilot.deep.flux, least[:, pilot.deep.place])
    # a large change of a neighbour may reach a pixel, and an extreme one more pixels and windows away
    large = changes(flux, np.float32(tuning.large_change) * least)
    extreme = longer(changes(flux, np.float32(tuning.extreme_change) * least), tuning.extreme_windows)
    # the first and the last window are rendered anyway, as the ends of all interpolation
    for window in range(1, last):
        near = sites.most(large[window], 1) | sites.most(extreme[window], 2)
        own = marked[window][sites.listed]
        out.rendered[window] = own | near
        # from one tick to the next an edge goes too far for a pair to keep the flux of an earlier one
        out.asked[window] = near & ~own & follows
    if pilot.refined:
        # an object that passes within a window or two does not change the flux linearly
        looked_at = np.zeros(flux.shape, np.bool_)
        for window, refined in enumerate(pilot.refined):
            looked_at[window, refined.place] = True
        out.barred[:] = longer(looked_at, 1)[:, sites.listed]
        out.rendered[1:last] |= out.barred[1:last]
        out.asked[:] &= ~out.barred

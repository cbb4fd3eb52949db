"""References of the audit: pairs rendered again, and changes of asynchronous pixels that see paths.

The noise of paths is mostly that of light which stays as it is. Rays with the same random numbers have the same error
of it in all windows of a pixel, as long as there are equally many, and then it drops out of changes of ln x. So all
windows of a unit get one number of rays, which is that for the largest error of a change; the level itself has to be
known much less well.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from hesim_render.core.distinct import distinct_columns
from hesim_render.core.rng import Stream
from hesim_render.sources.render.change_driven.adaptive import AdaptiveRenderer
from hesim_render.sources.render.change_driven.allocation import gain_of
from hesim_render.sources.render.change_driven.error_target import Role
from hesim_render.sources.render.change_driven.retrace import KnownPairs, aims_of, traced_again, traced_repeatedly
from hesim_render.sources.render.change_driven.windows import Windows

#: Wanted error of the level of a reference, as a part of it: a third of what a level may be off, see
#: `audit.deviations.LEVEL_TOLERANCE`.
_LEVEL_ERROR = np.float32(0.03)


class References:
    """Values that the audit compares a run with, by random numbers of their own.

    They depend on nothing but the pair of a pixel and a window, or on the unit.

    Parameters
    ----------
    renderer : of the run.
    """

    def __init__(self, renderer: AdaptiveRenderer) -> None:
        self._renderer = renderer
        # units are drawn at random, and of a small region or a short run often again
        self._known: dict[tuple[Role, float], KnownPairs] = {}
        self._rays, self._changes = KnownPairs(), KnownPairs()

    def values(
        self,
        index: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        quality: float,
        role: Role,
    ) -> NDArray[np.float64]:
        """See `AuditableFlux.reference_flux`; of [n] pixels by their numbers on the full sensor."""
        renderer = self._renderer
        wanted = quality if role == "events" else quality / renderer.tuning.frame_margin

        def traced(which: NDArray[np.int64]) -> NDArray[np.float64]:
            return traced_again(
                *(renderer.tracer, renderer.zoom, index[which], begin_us[which], end_us[which]),
                *(partial(renderer.noise.of, role), wanted, renderer.gain, renderer.tuning),
            )

        known = self._known.setdefault((role, wanted), KnownPairs())
        return known.values(np.stack([index.astype(np.float64), begin_us, end_us]), traced)

    def changes(
        self,
        index: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        needed: NDArray[np.bool_],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """See `AuditableFlux.reference_changes`; of [unit] pixels by their numbers on the full sensor."""
        renderer, values = self._renderer, np.zeros((2, *needed.shape))
        window, unit = np.nonzero(needed)
        # Closed forms make direct light exact, and lines the edges, so that levels are known well enough anyway. From
        # tick to tick so much moves that changes would take more rays than levels.
        is_level_known = renderer.tracer.is_diffuse or renderer.has_ticks
        by_level = np.ones(index.size, np.bool_) if is_level_known else self._is_aimed(index, begin_us, end_us)
        for some, is_level in ((np.flatnonzero(by_level[unit]), True), (np.flatnonzero(~by_level[unit]), False)):
            row, col = window[some], unit[some]
            if some.size and is_level:
                values[:, row, col] = self.values(index[col], begin_us[row, col], end_us[row, col], quality, "events")
            elif some.size:
                own, place = np.unique(col, return_inverse=True)
                rays = self._rays_of(index[own], begin_us[:, own], end_us[:, own], base, quality)[:, place]
                values[:, row, col] = self._traced(index[col], begin_us[row, col], end_us[row, col], *rays)
        return values

    def _is_aimed(
        self, index: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Units with rays that are aimed at small objects in any of their windows."""
        cols = self._renderer.tracer.sensor.spec.geometry.cols
        span, window = distinct_columns(np.stack([begin_us.ravel(), end_us.ravel()]))
        pixel = np.broadcast_to(index, begin_us.shape).ravel()
        aims = aims_of(self._renderer.zoom, pixel, cols, Windows(span[0], span[1]), window)
        if aims is None:
            return np.zeros(index.size, np.bool_)
        return np.asarray((aims.count > 0).reshape(begin_us.shape).any(axis=0))

    def _traced(
        self,
        index: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        rays: NDArray[np.float64],
        times: NDArray[np.float64],
        controlled: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Flux of pairs [n] by numbers of rays and an estimator, and half the difference of its halves, [2, n]."""
        pairs = np.stack([index.astype(np.float64), begin_us, end_us, rays, times, controlled])

        def traced(new: NDArray[np.int64]) -> NDArray[np.float64]:
            span, which = distinct_columns(pairs[1:3, new])
            own = index[new], which, Windows(span[0], span[1]), rays[new].astype(np.int64)
            return traced_repeatedly(self._renderer.tracer, own, controlled[new] > 0, times[new].astype(np.int64))

        return self._changes.values(pairs, traced)

    def _rays_of(
        self,
        index: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """Rays of each unit, the same in all its windows: a power of two, how often they are traced, and whether by the
        estimator with a control variate, [3, unit].
        """
        asked = np.stack([index.astype(np.float64), begin_us[base], begin_us[0], end_us[-1], 0 * end_us[0] + quality])

        def planned(new: NDArray[np.int64]) -> NDArray[np.float64]:
            return self._planned(index[new], begin_us[:, new], end_us[:, new], base, quality)

        return self._rays.values(asked, planned)

    def _planned(
        self,
        index: NDArray[np.uint32],
        begin_us: NDArray[np.float64],
        end_us: NDArray[np.float64],
        base: int,
        quality: float,
    ) -> NDArray[np.float64]:
        """See `_rays_of`; by a pilot of its own."""
        renderer, shape = self._renderer, begin_us.shape
        tracer, tuning = renderer.tracer, renderer.tuning
        span, number = distinct_columns(np.stack([begin_us.ravel(), end_us.ravel()]))
        windows, window = Windows(span[0], span[1]), number.reshape(shape)
        given = windows, tuning.audit_pilot_rays, 1.0
        # the single rays of the first window, and how far the same rays differ from them in each of the others
        first, kept = tracer.pilot_rays(index, window[base], *given, stream=Stream.AUDIT_PILOT)
        every, place = np.tile(index, shape[0]), np.tile(np.arange(index.size), shape[0])
        seen = tracer.pilot(every, window.ravel(), *given, Stream.AUDIT_PILOT, before=(kept, place))
        # one estimator for all windows of a unit, so that a difference is one of the scene
        chosen = first.controlled_scatter <= first.plain_scatter
        flux, scatter, change = (
            np.where(chosen, *(getattr(seen, f"{name}{what}").reshape(shape) for name in ("controlled", "plain")))
            for what in ("", "_scatter", "_change")
        )
        base_flux, base_scatter = (
            np.where(chosen, *(getattr(first, f"{name}{what}") for name in ("controlled", "plain")))
            for what in ("", "_scatter")
        )
        wanted_error = np.float32(quality) * renderer.noise.of("events", index)(flux)
        # a change of ln x by rays in both windows: f_w/F_w − f_b/F_b = (f_w − f_b)/F_w + f_b·(1/F_w − 1/F_b),
        # where the second part is what both have in common, if the flux itself has changed
        moved = np.abs(flux - base_flux) / np.where(base_flux > 0, base_flux, np.inf)
        single = change + base_scatter * moved
        by_change = (np.float32(tuning.difference_factor) * single / wanted_error) ** 2
        level_error, gain = np.maximum(_LEVEL_ERROR * flux, wanted_error), renderer.gain
        if seen.bounced_scatter is not None:
            gain, _ = gain_of(seen.bounced_scatter.reshape(shape), scatter / level_error, level_error, gain, tuning)
        by_level = gain.rays(scatter / level_error)
        # no ray may weigh too much
        by_weight = seen.unshadowed.reshape(shape) / (np.float32(tuning.audit_ray_weight) * wanted_error)
        # the window that needs most decides for all of them
        wanted = np.maximum(np.maximum(by_change, by_level), by_weight).max(axis=0)
        bits = np.ceil(np.log2(np.clip(wanted, tuning.least_audit_rays, tuning.most_rays)))
        # where the largest number of rays does not do, they are traced several times
        times = np.clip(np.ceil(by_change.max(axis=0) / tuning.most_rays), 1, tuning.most_audit_times)
        return np.stack([2.0**bits, times.astype(np.float64), chosen.astype(np.float64)])

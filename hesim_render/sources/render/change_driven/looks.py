"""In which windows the pilot looks with all its rays, and what sites show in the windows between two looks."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hesim_render.sources.render.change_driven.change_detector import Wanted, least_change
from hesim_render.sources.render.change_driven.neighbours import REACH, Sites
from hesim_render.sources.render.change_driven.pair_flux import CHANGES, PilotFlux
from hesim_render.sources.render.change_driven.sample_instants import STEP_PX


class Looks:
    """Looks of the pilot at sites in successive windows; the first window is known.

    Parameters
    ----------
    first : what the sites show in the first window, [site].
    count : number of windows.
    near : [site], True where anything may change.
    trace : gives what some sites show in windows other than the first, from the numbers [k] of both.

    Attributes
    ----------
    tables : [window, site] each, by the names of `PilotFlux.statistics` and `CHANGES`, e⁻/s.
    """

    def __init__(
        self,
        first: PilotFlux,
        count: int,
        near: NDArray[np.bool_],
        trace: Callable[[NDArray[np.int64], NDArray[np.int64]], PilotFlux],
    ) -> None:
        self._trace, self._last, self._near, self._place = trace, count - 1, near, np.flatnonzero(near)
        self.tables = {name: np.repeat(getattr(first, name)[None], count, axis=0) for name in first.statistics}
        for name in CHANGES:
            self.tables[name] = np.zeros((count, near.size), np.float32)
            # where nothing is near, the last window has the difference of the first one to the anchor
            self.tables[name][[0, -1]] = getattr(first, name)

    def at(self, window: NDArray[np.int64], place: NDArray[np.int64]) -> None:
        """Look at some sites in windows other than the first."""
        if place.size:
            seen = self._trace(window, place)
            for name, values in self.tables.items():
                values[window, place] = getattr(seen, name)

    def at_end(self, seen: PilotFlux | None = None) -> PilotFlux:
        """Look at all sites in the last window, which is the first of the next block, unless it is known what they show
        there; what they show.
        """
        if seen is None:
            self._in_all([self._last])
        else:
            for name, values in self.tables.items():
                values[self._last] = getattr(seen, name)
        return PilotFlux(met=self._near, **{name: values[self._last] for name, values in self.tables.items()})

    def compare_end(self, place: NDArray[np.int64]) -> None:
        """Compare what some sites show in the last window with its anchor; what they show stays."""
        seen = self._trace(np.full(place.size, self._last), place)
        for name in CHANGES:
            self.tables[name][self._last, place] = getattr(seen, name)

    def put(self, window: int, seen: PilotFlux) -> None:
        """Put in what all sites show in a window; their changes stay."""
        for name in seen.statistics:
            self.tables[name][window] = getattr(seen, name)

    def wherever(self, marked: NDArray[np.bool_]) -> None:
        """Look at sites in the windows in which they are marked, [window, site], the last one left out; in all others
        they show what they do in the one before.
        """
        self.at(*np.nonzero(marked))
        for window in range(1, self._last):
            self._keep(window, window - 1, ~marked[window])

    def every(self, stride: int, sites: Sites, wanted: Wanted | None, margin_px: float) -> None:
        """Look in every so many windows, then half way between two looks that differ, and so on, after `at_end`.

        Parameters
        ----------
        stride : windows from one look to the next.
        sites : the sites; what shows the same in two looks, in all sites around, has kept its light between them.
        wanted : wanted error of each site; needed where `stride` is above 1.
        margin_px : how far a look goes beyond its pixel. What comes into the pixel and leaves it between two looks that
            are so close that it can not come further is seen by these themselves, and no site around is asked.
        """
        # coarse looks, then halves of those spans whose ends differ
        looks = [*range(0, self._last, stride), self._last]
        self._in_all(looks[1:-1])
        spans = [span for span in pairwise(looks) if span[1] - span[0] > 1]
        while spans:
            windows, places = [], []
            for early, late in spans:
                # what comes from two pixels away takes the whole stride; it comes and goes within half the time
                radius = REACH - 1 if 2 * (late - early) > stride else 1
                if 0.5 * (late - early) * STEP_PX <= margin_px:
                    radius = 0
                busy = np.flatnonzero(sites.near(self._differ(early, late, wanted), radius) & self._near)
                # until a look says otherwise, all windows between show what the early one does
                for between in range(early + 1, late):
                    self._keep(between, early)
                windows.append(np.full(busy.size, (early + late) // 2))
                places.append(busy)
            self.at(np.concatenate(windows), np.concatenate(places))
            halves = [half for a, b in spans for half in ((a, (a + b) // 2), ((a + b) // 2, b))]
            spans = [span for span in halves if span[1] - span[0] > 1]

    def _in_all(self, windows: list[int]) -> None:
        """Look at all sites where anything may change in some windows."""
        self.at(np.repeat(np.array(windows, np.int64), self._place.size), np.tile(self._place, len(windows)))

    def _keep(self, window: int, before: int, where: NDArray[np.bool_] | bool = True) -> None:
        """Let sites show in a window what they do in an earlier one."""
        for name, values in self.tables.items():
            # the first window is compared with the anchor, those between with the first, from which they do not differ
            is_anchors = name in CHANGES and before == 0
            np.copyto(values[window], np.float32(0) if is_anchors else values[before], where=where)

    def _differ(self, early: int, late: int, wanted: Wanted | None) -> NDArray[np.bool_]:
        """Sites [site] that show something else in two windows, by the estimator of less scatter in the first."""
        tables = self.tables
        # one estimator for both windows, so that a difference is one of the scene
        is_controlled = tables["controlled_scatter"][early] <= tables["plain_scatter"][early]
        begin, end = (np.where(is_controlled, tables["controlled"][k], tables["plain"][k]) for k in (early, late))
        least = least_change(begin, None if wanted is None else wanted(begin))
        return np.asarray(np.abs(end - begin) > least)

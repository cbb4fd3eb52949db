"""Event pixels that are stuck, hot or flickering: which pixels, their rates and their events.

A stuck pixel gives no event. A hot pixel gives events of its own at a steady rate that does not depend on the light, in
addition to those of its comparisons. The rates spread over decades, as noise rates of event pixels do [hu2021]. A
flickering pixel does so only while a random telegraph signal is high (`hesim_render.pixels.poisson_points`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibration.rates import EventDefectRates
from hesim_render.calibration.spec import Defect
from hesim_render.core.rng import Stream, device_normal, device_uniform
from hesim_render.core.units import US_PER_S
from hesim_render.mosaic.layout import Layout
from hesim_render.pixels.evs import formulas
from hesim_render.pixels.evs.events import Origin
from hesim_render.pixels.measured import event_defect_rates
from hesim_render.pixels.poisson_points import PoissonPoints, Telegraph
from hesim_render.specs.event_pixels import EventDefectSpec, EvsSpec

#: Events of a defect per comparison above which more change nothing: the chance of no event is e⁻³⁰.
_MOST_PER_TICK = 30.0
#: Number of events computed at once, approximately.
_AHEAD = 20_000


@dataclass(frozen=True, eq=False)
class PixelDefects:
    """Defects of the event pixels of a region.

    Attributes
    ----------
    stuck : [k], indices on the event grid, row-major.
    place, key : [n], index of each hot or flickering pixel on the event grid and on the full sensor.
    on_hz, off_hz : [n], rates of their own events while they fire, Hz.
    firing_share : [n], fraction of the time in which they fire; 1 for hot pixels.
    change_hz : [n], 1/(mean time firing) + 1/(mean time quiet), Hz; 0 for hot pixels.
    """

    stuck: NDArray[np.intp]
    place: NDArray[np.intp]
    key: NDArray[np.uint32]
    on_hz: NDArray[np.float64]
    off_hz: NDArray[np.float64]
    firing_share: NDArray[np.float64]
    change_hz: NDArray[np.float64]

    def without(self, term: str) -> "PixelDefects":
        """The same defects without the stuck (``stuck``), hot (``hot``) or flickering (``flickering``) pixels."""
        if term == "stuck":
            return replace(self, stuck=self.stuck[:0])
        kept = self.change_hz > 0 if term == "hot" else self.change_hz == 0
        names = ("place", "key", "on_hz", "off_hz", "firing_share", "change_hz")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def __bool__(self) -> bool:
        return self.stuck.size + self.place.size > 0


def defects_of(spec: EvsSpec, layout: Layout, device_seed: int) -> PixelDefects:
    """Defects of a device: measured where a calibration has them, drawn from the device seed otherwise.

    Parameters
    ----------
    spec : the ``evs`` section of the sensor file.
    layout : region read out.
    device_seed : which device of this kind.
    """
    key = layout.full_index.ravel()[layout.evs_pixel.ravel()]
    measured = event_defect_rates(layout)
    if measured is not None:
        return _measured(measured, key)
    return _drawn(spec.defects or EventDefectSpec(), key, device_seed)


def _drawn(spec: EventDefectSpec, key: NDArray[np.uint32], device_seed: int) -> PixelDefects:
    if spec.stuck_share + spec.hot_share + spec.flickering_share == 0:
        number = np.ones(key.size)
    else:
        number = device_uniform(device_seed, Stream.EVENT_DEFECT, key)
    # one number per pixel decides its kind, so that no pixel has two defects
    edges = np.cumsum([spec.stuck_share, spec.hot_share, spec.flickering_share])
    stuck, hot, flickering = (np.flatnonzero(np.searchsorted(edges, number, "right") == k) for k in range(3))
    # hot pixels always fire, at log-normal rates; flickering ones during part of the time
    decades = spec.hot_rate_spread_decades
    spread = 10.0 ** (decades * device_normal(device_seed, Stream.EVENT_DEFECT_RATE, key[hot])) if decades else 1.0
    firing, quiet = spec.flickering_firing_s or 1.0, spec.flickering_quiet_s or 1.0
    ones = np.ones(flickering.size)
    place = np.concatenate([hot, flickering])
    return PixelDefects(
        stuck=stuck,
        place=place,
        key=key[place],
        on_hz=np.concatenate(
            [(spec.hot_rate_hz or 0.0) * spread * np.ones(hot.size), (spec.flickering_rate_hz or 0.0) * ones]
        ),
        off_hz=np.zeros(place.size),
        firing_share=np.concatenate([np.ones(hot.size), formulas.firing_share(firing, quiet) * ones]),
        change_hz=np.concatenate([np.zeros(hot.size), formulas.change_rate_hz(firing, quiet) * ones]),
    )


def _measured(rates: EventDefectRates, key: NDArray[np.uint32]) -> PixelDefects:
    stuck = np.flatnonzero(rates.kind.ravel() == Defect.STUCK)
    every = rates.on_hz, rates.off_hz, rates.firing_share, rates.change_hz
    values = np.stack([values.ravel() for values in every]).astype(np.float64)
    # pixels with a rate of their own, whatever the calibration called them
    place = np.flatnonzero((values[:2] > 0).any(axis=0))
    return PixelDefects(stuck, place, key[place], *values[:, place])


class DefectEvents:
    """Events that hot and flickering pixels give by themselves: a pure function of seed, device and time.

    Parameters
    ----------
    defects : pixels and rates.
    seed : seed of the events.
    tick_s : period of the comparisons where pixels are compared at fixed ticks, s. Rates that a tick cannot tell apart
        are limited.
    """

    def __init__(self, defects: PixelDefects, seed: int, tick_s: float | None = None) -> None:
        self._defects = defects
        total = defects.on_hz + defects.off_hz
        self._on_part = defects.on_hz / np.maximum(total, 1e-300)
        if tick_s is not None:
            total = np.minimum(total, _MOST_PER_TICK / tick_s)
        self._firing = np.flatnonzero(total > 0)
        key = defects.key[self._firing]
        self._events = PoissonPoints(seed, Stream.HOT_EVENTS, key, total[self._firing])
        # events are computed for many steps at once
        ahead = max(_AHEAD, 4 * self._firing.size)
        self._ahead_us = ahead / max(float(total.sum()), 1e-300) * US_PER_S
        self._known_us = (0.0, 0.0)
        self._known = (np.empty(0), np.empty(0, np.uint32), np.empty(0, np.int8))
        self._flickers = np.flatnonzero(defects.change_hz > 0)
        self._number = np.full(total.size, -1)
        self._number[self._flickers] = np.arange(self._flickers.size)
        self._state = Telegraph(
            seed, Stream.EVENT_FLICKER, defects.key[self._flickers],
            defects.change_hz[self._flickers], defects.firing_share[self._flickers],
        )  # fmt: skip

    def between(
        self, begin_us: float, end_us: float
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.int8]]:
        """Events after `begin_us` and up to `end_us`, in order of time.

        Parameters
        ----------
        begin_us, end_us : bounds, µs.

        Returns
        -------
        t_us, place, polarity : [event], times in µs, indices on the event grid, +1 or −1.
        """
        if not (self._known_us[0] <= begin_us and end_us <= self._known_us[1]):
            self._known_us = begin_us, max(end_us, begin_us + self._ahead_us)
            self._known = self._events_of(*self._known_us)
        first, last = np.searchsorted(self._known[0], (begin_us, end_us), side="right")
        t_us, place, polarity = self._known
        return t_us[first:last], place[first:last], polarity[first:last]

    def _events_of(
        self, begin_us: float, end_us: float
    ) -> tuple[NDArray[np.float64], NDArray[np.uint32], NDArray[np.int8]]:
        # events at the rate while firing; those in the quiet times of a flickering pixel are dropped
        which, t_us, mark = self._events.between(begin_us, end_us)
        which = self._firing[which]
        number = self._number[which]
        kept = np.ones(which.size, bool)
        gated = np.flatnonzero(number >= 0)
        kept[gated] = self._state.is_high(number[gated], t_us[gated])
        polarity = np.where(mark < self._on_part[which], 1, -1)[kept].astype(np.int8)
        t_us, place = t_us[kept], self._defects.place[which[kept]].astype(np.uint32)
        order = np.lexsort((place, t_us))
        return t_us[order], place[order], polarity[order]

    def at_tick(self, polarity: NDArray[np.int8], begin_us: float, end_us: float) -> NDArray[np.int8]:
        """Polarity of each pixel at a comparison, 0 for no event. Events of defects count where the comparison gave
        none.

        Parameters
        ----------
        polarity : [pixel], result of the comparisons: +1, −1 or 0, times its `Origin`.
        begin_us, end_us : time of the previous and of this comparison, µs.
        """
        _, place, own = self.between(begin_us, end_us)
        place, own = place[::-1], own[::-1]  # the earliest of a pixel is written last
        free = polarity[place] == 0
        polarity = polarity.copy()
        polarity[place[free]] = own[free] * Origin.DEFECT
        polarity[self._defects.stuck] = 0
        return polarity

    def alive(self, events: NDArray[np.void], cols: int) -> NDArray[np.void]:
        """Events without those of stuck pixels, on a grid of `cols` columns."""
        if self._defects.stuck.size == 0 or events.size == 0:
            return events
        place = events["y"].astype(np.int64) * cols + events["x"]
        return events[~np.isin(place, self._defects.stuck)]

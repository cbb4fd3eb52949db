"""The audit of a run: random pixels over stretches of time are rendered again, with other random numbers.

The audit does not influence the picture. Its units are stretches of successive windows of one pixel (`units`). Each
stretch of time has the same number of units, and their pixels are drawn independently. For a sensor with a tick, only
one window of a stretch is judged, so that correlated windows are not counted twice. The reference uses random numbers
of its own, and so many rays that its error is a small part of the tolerance. Frames are judged by their values, event
pixels by how far ln x has changed since an earlier window, because their comparators see nothing else; the level itself
only decides the rate of their noise events. Every bound holds with `CONFIDENCE` for
the whole run, at whatever number of units the audit stops (`confidence`).
"""

from functools import partial
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.pixels.evs.model import EvsNoise
from hesim_render.sources.protocol import AuditableFlux
from hesim_render.sources.render.audit.compare import Counted, Tally, compare_crossings, compare_ticks
from hesim_render.sources.render.audit.confidence import is_hopeless, lower_bound, ratio_upper_bound, upper_bound
from hesim_render.sources.render.audit.deviations import of_changes, of_frames, summary
from hesim_render.sources.render.audit.units import Batch, NotedFlux, Units, first_units, in_random_order
from hesim_render.sources.render.change_driven.tuning import FINEST_QUALITY

#: Confidence of each stated bound.
CONFIDENCE = 0.99
#: Limits for a run: share of values off by more than the tolerance, of signal events missed, of extra events.
MOST_OFF, MOST_MISSED, MOST_EXTRA = 0.02, 0.02, 0.01
#: Smallest deviation that counts as off, in wanted errors.
TOLERANCE = 3.0
#: Windows of a unit: before the judged ones, judged, after them. An event may come one window early or late.
STRETCHES = {"previous_sample": (2, 1, 1), "last_event": (1, 8, 1)}
#: Largest number of events that is counted in a unit.
_MOST_EVENTS = {"previous_sample": 1, "last_event": 8}
#: Units of pixels that no moving object can come near: this part is rendered again, with a weight of 1 over it.
_STILL_PART = 0.25
#: Quality of the reference, as a part of the quality of the run.
_REFERENCE = 0.5
#: What an audit can see, for the manifest.
_COMPARES_WITH = "the same renderer with other random numbers; a wrong model of scene, lens or sensor stays unseen"
#: Sizes of the first and of the largest batch; after each batch the audit checks whether it has enough units.
_LEAST_BATCH, _MOST_BATCH = 128, 16384
#: Upper limit for the rays of an audit: a part of the run's own rays, or a fixed number if that is more.
_PART, _RAYS = 0.25, 30_000_000
#: Part of these rays after which an audit may give up, because the others would not show what is left to show either.
_TRIED = 0.125


class Audit:
    """Audit of one run.

    Parameters
    ----------
    noted : units noted while the source passed its values on.
    source : source of the run; renders the reference.
    quality : quality that was asked for.
    noise : noise model of the event pixels, None where there are none.
    event_pixel : [n], mosaic indices in the order of the event grid.
    seed : seed of the random choices.
    """

    def __init__(
        self,
        noted: NotedFlux,
        source: AuditableFlux,
        quality: float,
        noise: EvsNoise | None,
        event_pixel: NDArray[np.uint32],
        seed: int,
    ) -> None:
        self._noted, self._source, self._quality, self._noise = noted, source, quality, noise
        #: Places of mosaic indices on the event grid.
        self._place_of = np.zeros(int(event_pixel.max(initial=0)) + 1, np.int64)
        self._place_of[event_pixel] = np.arange(event_pixel.size)
        self._rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, 2]))

    def run(self) -> dict[str, Any]:
        """Run the audit. Returns bounds, estimates, deviations and a verdict, as plain values."""
        own = self._source.rays_traced
        room = max(_PART * own, _RAYS)
        report: dict[str, Any] = {
            "compares_with": _COMPARES_WITH, "confidence": CONFIDENCE, "tolerance_noise": TOLERANCE * self._quality
        }  # fmt: skip
        kinds = [name for name in ("events", "frames") if getattr(self._noted, name)]
        for name in kinds:
            report[name] = self._one(getattr(self._noted, name), name == "events", room / len(kinds))
        report["rays"] = self._source.rays_traced - own
        return report | self._verdict([report[name] for name in kinds])

    def _one(self, noted: list[Units], events: bool, room: float) -> dict[str, Any]:
        """Audit the event pixels, or the frames.

        All units have one random order. In a first part of this order, all units with an event in the run are examined:
        they are few, they estimate the number of events, and only they can have an extra event. In a shorter first
        part, the other units are examined as well, because any of them may have a value that is off or a missed event.
        """
        begin, batches, seen = (
            self._source.rays_traced,
            in_random_order(noted, self._rng, _LEAST_BATCH, _MOST_BATCH),
            list[Batch](),
        )
        tally, result = Tally(sum(units.pixel.size for units in noted)), dict[str, Any]()
        if events:
            for batch in batches:
                seen.append(batch)
                self._look_at(batch, tally, "eventful")
                spent, bounds = self._source.rays_traced - begin, self._event_bounds(tally)
                extra, at_most = bounds["extra"], bounds["extra_at_most"]
                # a bound falls with the number of units at best
                most_left = extra + (at_most - extra) * 2 * spent / room
                is_clear = at_most <= MOST_EXTRA / 2 or most_left > MOST_EXTRA
                if spent > room / 2 or (is_clear and spent > _TRIED * room):
                    break
        left = room - ((start := self._source.rays_traced) - begin)
        for number, batch in enumerate(chain(seen, batches)):
            # a batch is twice as large as the one before it, so the rest of the rays may suffice for a part of it only
            own, all_units = self._source.rays_traced - start, sum(place.size for place, _ in batch)
            if own:
                batch = first_units(batch, tally.looked_at * left / own)
            if events and number >= len(seen):
                self._look_at(batch, tally, "eventful")
            self._look_at(batch, tally, "calm" if events else "frames")
            result = self._bounds(tally, events)
            shares, own = _shares(result), self._source.rays_traced - start
            enough = all(bound <= most for _, bound, most in shares)
            is_cut = sum(place.size for place, _ in batch) < all_units
            if enough or is_cut or own > left or (own > _TRIED * room and is_hopeless(shares, left / own)):
                break
        return result

    def _look_at(self, batch: Batch, tally: Tally, which: str) -> None:
        """Render the reference of some units of a batch and count the results.

        Parameters
        ----------
        which : ``eventful`` (units with events in the run), ``calm`` (the others) or ``frames`` (all).
        """
        for place, units in batch:
            if which == "frames":
                some, still = np.arange(place.size), np.zeros(place.size, np.bool_)
            else:
                has_event = self._has_event(units)
                tally.has_event[place] = has_event
                some = np.flatnonzero(has_event if which == "eventful" else ~has_event)
                still = self._source.still_pixels(units.pixel[some])
                taken = ~still | (self._rng.random(some.size) < _STILL_PART)
                some, still = some[taken], still[taken]
            if some.size:
                self._count(units.at(some), place[some], still, which, tally)
        count = sum(place.size for place, _ in batch)
        if which == "eventful":
            tally.eventful += count
        else:
            tally.looked_at += count

    def _count(
        self, units: Units, place: NDArray[np.int64], still: NDArray[np.bool_], which: str, tally: Tally
    ) -> None:
        events, tolerance = which != "frames", TOLERANCE * self._quality
        # The window that changes are counted from. A comparator with a tick compares with the sample before; an
        # asynchronous one with the level of its last event, for which the first window of the block stands.
        base = max(0, int(np.flatnonzero(units.core)[0]) - 1)
        if events and not self._has_ticks:
            units, base = units.with_base(), 0
        reference, difference = self._reference(units, still, which, base)
        core, weight = units.core, np.where(still, 1 / _STILL_PART, 1.0)
        unit = self._source.noise_unit(units.pixel, reference, events)[core]
        if events:
            log = partial(self._log, units.pixel)
            run, known, noisy = ((flux[core], flux[base][None]) for flux in (units.flux, reference, units.noisy))
            deviation = of_changes(log, run, known, unit)
            # what the stated error of the run does on its own
            by_error = of_changes(log, noisy, run, unit)
        else:
            deviation = of_frames(units.flux[core], reference[core], unit)
            by_error = of_frames(units.difference[core], np.zeros(unit.shape), unit)
        tally.off[place] = weight * np.mean(deviation.is_off(tolerance), axis=0)
        tally.expected[place] = weight * np.mean(by_error.is_off(tolerance), axis=0)
        tally.note(place, deviation, weight)
        if events:
            moving = np.flatnonzero(~still)
            part, other = units.at(moving), reference[:, moving]
            counts = self._compare(part, part.flux, other, base)
            for total, values in zip(vars(tally.events).values(), vars(counts).values(), strict=True):
                total[place[moving]] = values
            # counts that errors as large as those of the run and of the reference cause on their own
            counts = self._compare(part, other + part.difference, other + difference[:, moving], base)
            tally.by_error[place[moving]] = counts.missed + counts.extra + counts.flips

    @property
    def _has_ticks(self) -> bool:
        """True if each sample is compared with the one before it."""
        return self._noise is not None and self._noise.spec.reference == "previous_sample"

    def _reference(
        self, units: Units, still: NDArray[np.bool_], which: str, base: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Flux by other random numbers, and half the difference of its halves, [window, unit], e⁻/s. Windows that are
        not needed change like the run from the window `base` on.
        """
        reference, difference = units.flux.copy(), np.zeros(units.flux.shape)
        first, quality = int(np.flatnonzero(units.core)[0]), _REFERENCE * self._quality
        needed = np.repeat(units.core[:, None], units.pixel.size, axis=1)
        if which == "frames":
            of = units.pixel[np.nonzero(needed)[1]], units.begin_us[needed], units.end_us[needed]
            reference[needed], difference[needed] = self._source.reference_flux(*of, quality, events=False)
            return reference, difference

        def trace(needed: NDArray[np.bool_]) -> None:
            of = units.pixel, units.begin_us, units.end_us, needed, base, quality
            values = self._source.reference_changes(*of)
            reference[needed], difference[needed] = values[:, needed]

        # changes are counted from this window, whatever may move
        needed[base] = True
        if first > 0:
            needed[first - 1] |= ~still
        # a unit without events in the run can only have missed ones: their windows are enough
        if which == "eventful" and not self._has_ticks:
            needed |= ~still
        trace(needed)
        if which == "eventful" and self._has_ticks:
            # where both have the same event in the tick that is judged, its neighbours have nothing to say
            unlike = self._tick_event(units, units.flux, first) != self._tick_event(units, reference, first)
            others = ~needed & ~still & unlike
            trace(others)
            needed |= others
        before = units.flux[base]
        like = reference[base] / np.where(before > 0, before, 1)
        return np.where(needed, reference, units.flux * np.where(before > 0, like, 1)), difference

    def _tick_event(self, units: Units, flux: NDArray[np.float64], window: int) -> NDArray[np.int8]:
        """Polarity of the event of each unit in a window, 0 without one, as in the first window of all."""
        signal, (on, off) = self._log(units.pixel, flux), self._thresholds(units.pixel)
        change = signal[window] - signal[max(0, window - 1)]
        return (change > on).astype(np.int8) - (change < -off).astype(np.int8)

    def _has_event(self, units: Units) -> NDArray[np.bool_]:
        """Units in which the run may have an event, [unit]."""
        assert self._noise is not None
        signal = self._log(units.pixel, units.flux)
        on, off = self._thresholds(units.pixel)
        if self._noise.spec.reference == "previous_sample":
            change = np.diff(signal, axis=0)
            return np.asarray(((change > on) | (change < -off)).any(axis=0))
        # The reference level of the comparator is not known. A range below half a threshold gives no event.
        return np.asarray(np.ptp(signal, axis=0) > 0.5 * np.minimum(on, off))

    def _log(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64]) -> NDArray[np.float64]:
        """ln x of event pixels, [window, unit]."""
        assert self._noise is not None
        return self._noise.log_signal(flux, self._place_of[pixel])

    def _thresholds(self, pixel: NDArray[np.uint32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert self._noise is not None
        shape = self._noise.layout.evs_shape
        maps = self._noise.threshold_on_map, self._noise.threshold_off_map
        on, off = (np.broadcast_to(theta, shape).ravel()[self._place_of[pixel]].astype(np.float64) for theta in maps)
        return on, off

    def _compare(self, units: Units, flux: NDArray[np.float64], reference: NDArray[np.float64], base: int) -> Counted:
        """Compare the events of a flux with those of the reference; both are [window, unit], e⁻/s."""
        assert self._noise is not None
        run, known = self._log(units.pixel, flux), self._log(units.pixel, reference)
        error = self._log(units.pixel, flux + units.error) - run
        # comparators see how far ln x has changed, and nothing of the level
        run = run - run[base] + known[base]
        if self._has_ticks:
            return compare_ticks(run, known, error, self._thresholds(units.pixel), units.core)
        # the window that changes are counted from is none of the stretch
        arguments = run[1:], known[1:], error[1:], self._thresholds(units.pixel), units.core[1:]
        return compare_crossings(*arguments, _MOST_EVENTS["last_event"])

    def _bounds(self, tally: Tally, events: bool) -> dict[str, Any]:
        off, most = tally.off[: tally.looked_at], 1 / _STILL_PART if events else 1.0
        bounds: dict[str, Any] = {
            "units": int(off.size),
            "off": float(off.mean()),
            "off_at_most": min(1.0, most * upper_bound(off / most, CONFIDENCE)),
            "off_wanted_at_most": MOST_OFF,
            "deviation_noise": summary(*tally.deviations()),
            "off_by_stated_error_alone": float(tally.expected[: tally.looked_at].mean()),
        }
        if not events:
            return bounds
        return bounds | {"level_deviation": summary(*tally.deviations(of_levels=True))} | self._event_bounds(tally)

    def _event_bounds(self, tally: Tally) -> dict[str, Any]:
        """Bounds of missed and extra events. Units in which nothing can move have neither."""
        assert self._noise is not None
        most, counted = float(_MOST_EVENTS[self._noise.spec.reference]), tally.events
        each = 1 - (1 - CONFIDENCE) / 2
        eventful = np.flatnonzero(tally.has_event[: tally.eventful])
        known = np.zeros(tally.eventful)
        known[eventful] = np.minimum(counted.true[eventful], most)
        at_least = lower_bound(known / most, each)
        missed = upper_bound(np.minimum(counted.missed[: tally.looked_at], most) / most, each)
        part, whole = (np.minimum(values[eventful], most) for values in (counted.extra, counted.in_run))
        seen = bool(counted.true.any())
        true = tally.rate(counted.true) if seen else np.inf
        in_run = tally.rate(counted.in_run) or np.inf
        return {
            "true_events": float(counted.true.sum()),
            "found_events": float(counted.in_run.sum()),
            "missed": tally.rate(counted.missed) / true,
            "missed_at_most": min(1.0, missed / at_least) if at_least > 0 else 1.0,
            "missed_wanted_at_most": MOST_MISSED,
            "extra": tally.rate(counted.extra) / in_run,
            "extra_at_most": ratio_upper_bound(part, whole, most, CONFIDENCE),
            "extra_wanted_at_most": MOST_EXTRA,
            "flips": tally.rate(counted.flips) / true,
            "flips_by_stated_error": tally.rate(tally.by_error) / true,
        }

    def _verdict(self, parts: list[dict[str, Any]]) -> dict[str, Any]:
        """Verdict: the limits are met with confidence, not met, or neither is shown."""
        shares = [share for part in parts for share in _shares(part)]
        needed = self._quality
        for part in parts:
            needed = min(needed, self._quality * TOLERANCE * self._quality / max(part["deviation_noise"]["p99"], 1e-12))
        failed = any(share > most for share, _, most in shares)
        shown = all(bound <= most for _, bound, most in shares)
        needed = min(needed, 0.7 * self._quality)
        # values that are off by their own stated error already have the most rays that one may have
        short = max((part["off_by_stated_error_alone"] for part in parts), default=0.0)
        capped = failed and needed < FINEST_QUALITY and short > MOST_OFF
        return {
            "verdict": "not met" if failed else "met" if shown else "not shown",
            "quality_needed": _rounded_down(needed) if failed and not capped else None,
            "short_of_rays": short if capped else None,
        }


def _shares(part: dict[str, Any]) -> list[tuple[float, float, float]]:
    """Estimate, bound and limit of each share that a part of an audit can judge.

    Where no event of the reference was seen, no share can be missed; the run can have events that are too many even so.
    """
    names = ["off"]
    names += ["missed"] if part.get("true_events") else []
    names += ["extra"] if part.get("found_events") else []
    return [(part[name], part[f"{name}_at_most"], part[f"{name}_wanted_at_most"]) for name in names]


def _rounded_down(value: float) -> float:
    """Round down to two significant digits."""
    step = 10 ** (np.floor(np.log10(value)) - 1)
    return float(np.floor(value / step + 1e-9) * step)

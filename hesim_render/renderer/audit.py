"""What a run is worth, measured: random pixels over stretches of time are rendered again, with other random numbers.

The audit decides nothing about the picture. Its units are stretches of windows of one pixel (`notes`), drawn evenly over
pixels and time, each independently of the others; of a sensor with a tick one window of a stretch is judged, so that
nothing is counted twice that belongs together. They are rendered with random numbers of their own and so many rays
that their error is a small part of the tolerance. Every bound holds with `CONFIDENCE` for the whole run, at whatever
number of units the audit stops (`confidence`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hesim_render.flux import SampledFlux
from hesim_render.noise.evs import EvsNoise
from hesim_render.renderer.compare import Counted, compare_crossings, compare_ticks
from hesim_render.renderer.confidence import lower_bound, ratio_upper_bound, upper_bound
from hesim_render.renderer.notes import NotedFlux, Units

#: Confidence of each stated bound.
CONFIDENCE = 0.99
#: What a run should have: share of values off by more than the tolerance, of signal events missed, of events too many.
MOST_OFF, MOST_MISSED, MOST_EXTRA = 0.01, 0.02, 0.01
#: Deviation that counts, in wanted errors.
TOLERANCE = 3.0
#: Windows of a unit before those that are judged, these, and after them: an event may come one window early or late.
STRETCHES = {"previous_sample": (2, 1, 1), "last_event": (1, 8, 1)}
#: Events that are counted of a unit at most.
_MOST_EVENTS = {"previous_sample": 1, "last_event": 8}
#: Part of the units of pixels that nothing can come near which is rendered again; they count for more.
_STILL_PART = 0.25
#: Wanted error of the reference over the sensor's noise, as a part of the run's quality.
_REFERENCE = 0.5
#: Units that are looked at before it is asked whether they are enough.
_BATCH = 1024
#: Rays of an audit at most: a part of the run's own, or so many if that is more.
_PART, _RAYS = 0.25, 20_000_000


class AuditableFlux(SampledFlux, Protocol):
    """A source whose values can be found again by other random numbers."""

    @property
    def rays_traced(self) -> int:
        """So far."""
        ...

    def still_pixels(self, pixel: NDArray[np.uint32]) -> NDArray[np.bool_]:
        """Which pixels nothing that moves can come near at any time, [n], as far as that is known."""
        ...

    def reference_flux(
        self, pixel: NDArray[np.uint32], begin_us: NDArray[np.float64], end_us: NDArray[np.float64], quality: float
    ) -> NDArray[np.float64]:
        """Mean Φ of each listed pixel in its own window, e⁻/s, by random numbers that the run has not.

        Parameters
        ----------
        quality : wanted error over the sensor's noise.
        """
        ...

    def noise_unit(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64], events: bool) -> NDArray[np.float64]:
        """What one standard deviation of each pixel's noise is worth at a flux [..., n], e⁻/s."""
        ...


@dataclass
class _Tally:
    """What units were seen to have, lists of arrays with one entry a unit.

    Parameters
    ----------
    weight : for how many units it stands; 0 where it was passed over.
    off : share of values off by more than the tolerance, and `expected`, of those that the error which the run states
        puts there by itself.
    deviation : of every value, absolute, in units of noise; `deviation_weight`, for how many it stands.
    events : what `compare` counted; `flips`, what it counts of the reference with the stated error on top.
    """

    weight: list[NDArray[np.float64]] = field(default_factory=list)
    off: list[NDArray[np.float64]] = field(default_factory=list)
    expected: list[NDArray[np.float64]] = field(default_factory=list)
    deviation: list[NDArray[np.float64]] = field(default_factory=list)
    deviation_weight: list[NDArray[np.float64]] = field(default_factory=list)
    events: list[Counted] = field(default_factory=list)
    flips: list[Counted] = field(default_factory=list)

    def counted(self, name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(one, name) for one in self.events])


class Audit:
    """One run, audited.

    Parameters
    ----------
    noted : what it gave.
    source : rendered it, and renders units again.
    quality : that was asked for.
    noise : of the event pixels, None where there are none.
    event_pixel : mosaic indices in the order of the event grid.
    seed : of the choices.
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
        self._event_pixel = event_pixel
        self._rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, 2]))

    def run(self) -> dict[str, Any]:
        """Bounds, estimates and deviations, and whether they are what they should be; plain values."""
        own = self._source.rays_traced
        room = max(_PART * own, _RAYS)
        found: dict[str, Any] = {"confidence": CONFIDENCE, "tolerance_noise": TOLERANCE * self._quality}
        kinds = [name for name in ("events", "frames") if getattr(self._noted, name)]
        for name in kinds:
            found[name] = self._one(getattr(self._noted, name), name == "events", room / len(kinds))
        found["rays"] = self._source.rays_traced - own
        return found | self._verdict([found[name] for name in kinds])

    def _one(self, noted: list[Units], events: bool, room: float) -> dict[str, Any]:
        """Of the event pixels, or of frames."""
        begin, tally, result = self._source.rays_traced, _Tally(), dict[str, Any]()
        for units in self._shuffled(noted):
            self._look_at(units, events, tally)
            result = self._bounds(tally, events)
            enough = result["off_at_most"] <= MOST_OFF and (
                not result.get("true_events")
                or (result["missed_at_most"] <= MOST_MISSED and result["extra_at_most"] <= MOST_EXTRA)
            )
            if enough or self._source.rays_traced - begin > room:
                break
        return result

    def _shuffled(self, noted: list[Units]) -> Iterator[Units]:
        """All units in a random order, those of equal shape together, some at a time."""
        which = [np.full(units.pixel.size, number) for number, units in enumerate(noted)]
        place = [np.arange(units.pixel.size) for units in noted]
        order = self._rng.permutation(sum(units.pixel.size for units in noted))
        number, inside = np.concatenate(which)[order], np.concatenate(place)[order]
        for first in range(0, order.size, _BATCH):
            chosen, own = number[first : first + _BATCH], inside[first : first + _BATCH]
            by_shape: dict[bytes, list[Units]] = {}
            for one in np.unique(chosen):
                units = noted[one]
                by_shape.setdefault(units.core.tobytes(), []).append(units.at(own[chosen == one]))
            yield from map(Units.joined, by_shape.values())

    def _look_at(self, units: Units, events: bool, tally: _Tally) -> None:
        """Render some units again and count what is found."""
        count, core = units.pixel.size, units.core
        still = self._source.still_pixels(units.pixel) if events else np.zeros(count, np.bool_)
        taken = np.flatnonzero(~still | (self._rng.random(count) < _STILL_PART))
        weight = np.zeros(count)
        weight[taken] = np.where(still[taken], 1 / _STILL_PART, 1.0)
        some = units.at(taken)
        reference = self._reference(some, still[taken], events)
        unit = self._source.noise_unit(some.pixel, reference, events)
        tolerance = TOLERANCE * self._quality
        deviation = np.abs(some.flux - reference)[core] / unit[core]
        off = np.zeros(count)
        off[taken] = np.mean(deviation > tolerance, axis=0)
        tally.weight.append(weight)
        tally.off.append(weight * off)
        tally.deviation.append(deviation.ravel())
        tally.deviation_weight.append(np.broadcast_to(weight[taken], deviation.shape).ravel())
        expected = np.zeros(count)
        expected[taken] = np.mean(np.abs(some.difference[core]) > tolerance * unit[core], axis=0)
        tally.expected.append(weight * expected)
        if events:
            moving = ~still[taken]
            part, other = some.at(moving), reference[:, moving]
            place = taken[moving]
            tally.events.append(_spread_out(self._compare(part, part.flux, other), place, count))
            # what an error like the stated one does to the reference
            tally.flips.append(_spread_out(self._compare(part, other + part.difference, other), place, count))

    def _reference(self, units: Units, still: NDArray[np.bool_], events: bool) -> NDArray[np.float64]:
        """Flux of units by other random numbers, [window, unit]; what is not needed is as the run has it."""
        needed = np.zeros(units.flux.shape, np.bool_)
        core = np.flatnonzero(units.core)
        needed[core] = True
        if events:
            # where the run has no event near by, only missed ones are asked for
            needed[max(0, core[0] - 1)] |= ~still
            needed |= self._has_event(units) & ~still
        reference = units.flux.copy()
        window, place = np.nonzero(needed)
        reference[needed] = self._source.reference_flux(
            units.pixel[place], units.begin_us[needed], units.end_us[needed], _REFERENCE * self._quality
        )
        return reference

    def _has_event(self, units: Units) -> NDArray[np.bool_]:
        """Units in which the run itself may have an event, [unit]."""
        if self._noise is None or self._noise.spec.reference == "last_event":
            return np.ones(units.pixel.size, np.bool_)
        change = np.diff(self._log(units.pixel, units.flux), axis=0)
        on, off = self._thresholds(units.pixel)
        return ((change > on) | (change < -off)).any(axis=0)

    def _log(self, pixel: NDArray[np.uint32], flux: NDArray[np.float64]) -> NDArray[np.float64]:
        """ln x of event pixels, [window, unit]."""
        assert self._noise is not None
        return self._noise.log_signal(flux, self._place(pixel))

    def _thresholds(self, pixel: NDArray[np.uint32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert self._noise is not None
        shape = self._noise.layout.evs_shape
        maps = self._noise.threshold_on_map, self._noise.threshold_off_map
        on, off = (np.broadcast_to(theta, shape).ravel()[self._place(pixel)].astype(np.float64) for theta in maps)
        return on, off

    def _place(self, pixel: NDArray[np.uint32]) -> NDArray[np.int64]:
        """On the event grid."""
        order = np.argsort(self._event_pixel)
        return order[np.searchsorted(self._event_pixel, pixel, sorter=order)]

    def _compare(self, units: Units, flux: NDArray[np.float64], reference: NDArray[np.float64]) -> Counted:
        """Events of a flux of some units against those of the reference, all [window, unit]."""
        assert self._noise is not None
        run = self._log(units.pixel, flux)
        error = self._log(units.pixel, flux + units.error) - run
        arguments = run, self._log(units.pixel, reference), error, self._thresholds(units.pixel), units.core
        if self._noise.spec.reference == "previous_sample":
            return compare_ticks(*arguments)
        return compare_crossings(*arguments, _MOST_EVENTS["last_event"])

    def _bounds(self, tally: _Tally, events: bool) -> dict[str, Any]:
        off, weight = np.concatenate(tally.off), np.concatenate(tally.deviation_weight)
        deviation, most = np.concatenate(tally.deviation), 1 / _STILL_PART if events else 1.0
        order = np.argsort(deviation)
        cumulated = np.cumsum(weight[order])
        parts = {name: deviation[order][np.searchsorted(cumulated, p * cumulated[-1])] for name, p in _PARTS.items()}
        found: dict[str, Any] = {
            "units": int(off.size),
            "off": float(off.mean()),
            "off_at_most": min(1.0, most * upper_bound(off / most, CONFIDENCE)),
            "off_wanted_at_most": MOST_OFF,
            "deviation_noise": {
                "rms": float(np.sqrt(np.sum(weight * deviation**2) / weight.sum())),
                **{name: float(value) for name, value in parts.items()},
                "largest": float(deviation.max()),
            },
        }
        found["off_by_stated_error_alone"] = float(np.concatenate(tally.expected).mean())
        return found | self._event_bounds(tally) if events else found

    def _event_bounds(self, tally: _Tally) -> dict[str, Any]:
        """Of missed and extra events. Units in which nothing can move have neither."""
        assert self._noise is not None
        most = float(_MOST_EVENTS[self._noise.spec.reference])
        true, missed, count, extra = (
            np.minimum(tally.counted(name), most) for name in ("true", "missed", "found", "extra")
        )
        each = 1 - (1 - CONFIDENCE) / 2
        at_least = lower_bound(true / most, each)
        total, others = max(float(true.sum()), 1e-300), max(float(count.sum()), 1e-300)
        return {
            "true_events": float(true.sum()),
            "missed": float(missed.sum()) / total,
            "missed_at_most": min(1.0, upper_bound(missed / most, each) / at_least) if at_least > 0 else 1.0,
            "missed_wanted_at_most": MOST_MISSED,
            "extra": float(extra.sum()) / others,
            "extra_at_most": ratio_upper_bound(extra, count, most, CONFIDENCE),
            "extra_wanted_at_most": MOST_EXTRA,
            "flips": float(tally.counted("flips").sum()) / total,
            "flips_by_stated_error": sum(float((one.missed + one.extra + one.flips).sum()) for one in tally.flips) / total,
        }

    def _verdict(self, parts: list[dict[str, Any]]) -> dict[str, Any]:
        """Whether the run is what it should be: shown with confidence, shown not to be, or neither."""
        shares = [(part[name], part[f"{name}_at_most"], part[f"{name}_wanted_at_most"])
                  for part in parts for name in ("off", "missed", "extra")
                  if name in part and (name == "off" or part["true_events"])]  # fmt: skip
        needed = self._quality
        for part in parts:
            needed = min(needed, self._quality * TOLERANCE * self._quality / max(part["deviation_noise"]["p99"], 1e-12))
        failed = any(share > most for share, _, most in shares)
        shown = all(bound <= most for _, bound, most in shares)
        return {
            "verdict": "not met" if failed else "met" if shown else "not shown",
            "quality_needed": _rounded_down(min(needed, 0.7 * self._quality)) if failed else None,
        }


_PARTS = {"median": 0.5, "p95": 0.95, "p99": 0.99}


def _rounded_down(value: float) -> float:
    """To two digits."""
    step = 10 ** (np.floor(np.log10(value)) - 1)
    return float(np.floor(value / step + 1e-9) * step)


def _spread_out(counted: Counted, place: NDArray[np.int64], count: int) -> Counted:
    """One entry for each of `count` units, 0 for those that are not at one of the places."""
    found = {}
    for name, values in vars(counted).items():
        found[name] = np.zeros(count)
        found[name][place] = values
    return Counted(**found)

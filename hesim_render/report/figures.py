"""All figures of event pixels from the recordings of a bench."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hesim_render.calibrate.estimate import not_identifiable
from hesim_render.calibrate.recordings import still
from hesim_render.calibrate.recordings.short_intervals import dead_time, readout_limit
from hesim_render.core.units import S_PER_US
from hesim_render.report.bench import EventBench, Responses
from hesim_render.report.latency import Answers, answers
from hesim_render.report.limits import DynamicRange, dynamic_range, false_share
from hesim_render.report.modulated import Bandwidth, bandwidth, count_thresholds
from hesim_render.report.s_curves import SCurve, s_curve
from hesim_render.report.steady import Background, background, doubling
from hesim_render.specs.event_bench import Steady

#: Sizes of steps that differ by no more than this part are the same.
_SAME_SIZE = 0.07
#: Lights whose ratio is no larger are the same.
_SAME_LIGHT = 1.3
#: Part of a cycle up to which a dead time is short.
_SHORT_DEAD_TIME = 0.1
#: Contrasts from which recordings of one light are an S-curve.
_LEAST_CONTRASTS = 4
POLARITIES = ("ON", "OFF")


@dataclass(frozen=True)
class Entry:
    """One figure of the report.

    Parameters
    ----------
    key : of its definition, see `definitions`.
    name : what it is of, such as ON.
    value : entry with value, interval and unit, or the reason why there is none.
    lux, contrast, temperature_c : of the recordings, where they have one.
    pixels : number of pixels.
    """

    key: str
    name: str
    value: dict[str, Any]
    lux: float | None
    contrast: float | None
    temperature_c: float | None
    pixels: int


@dataclass(eq=False)
class EventFigures:
    """Figures of event pixels, and what is drawn of them.

    Parameters
    ----------
    bench : the recordings.
    entries : all figures.
    curves : S-curves, ON and OFF of each light.
    backgrounds : of each steady recording.
    latencies : of each polarity, in order of light.
    ranges : dynamic range of each polarity.
    band : bandwidth, or None.
    intervals : [µs], intervals between events of a pixel in all recordings.
    findings : what is odd about the recordings.
    """

    bench: EventBench
    entries: list[Entry] = field(default_factory=list)
    curves: list[tuple[SCurve, SCurve]] = field(default_factory=list)
    backgrounds: list[Background] = field(default_factory=list)
    latencies: tuple[list[Answers], list[Answers]] = ([], [])
    ranges: tuple[DynamicRange | None, DynamicRange | None] = (None, None)
    band: Bandwidth | None = None
    intervals: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    findings: list[str] = field(default_factory=list)

    def add(self, key: str, name: str, value: dict[str, Any], pixels: int | None = None, **of: float | None) -> None:
        """Add an entry; of all pixels, at the temperature of the bench and at no light or contrast, unless given."""
        known = {"lux": None, "contrast": None, "temperature_c": self.bench.spec.temperature_c} | of
        self.entries.append(Entry(key, name, value, pixels=self.bench.pixels if pixels is None else pixels, **known))


def event_figures(bench: EventBench, progress: Callable[[str, float], None] | None = None) -> EventFigures:
    """Evaluate all recordings of a bench.

    Parameters
    ----------
    bench : the recordings.
    progress : called with a text that names the current work and the fraction done.

    Raises
    ------
    SpecError
        If a recording cannot be read, or has no events.
    """
    stated = progress or (lambda what, part: None)
    figures = EventFigures(bench)
    stated("read recordings", 0.05)
    hot, dead = _hot(bench), _dead(bench)
    good = ~(hot | dead[0] | dead[1])
    stated("S-curves", 0.3)
    for light in _lights(bench):
        pair = s_curve(light, 0, good), s_curve(light, 1, good)
        figures.curves.append(pair)
        _add_curves(figures, pair, light)
    stated("latency", 0.5)
    _add_latencies(figures, good)
    stated("short intervals", 0.6)
    dead_us = _add_times(figures)
    stated("dynamic range", 0.7)
    not_reset = any(not one.reset for one in bench.spec.steps) and not _has_ticks(bench)
    _add_ranges(figures, good, _add_count_thresholds(figures, good, dead_us, not_reset))
    stated("background", 0.8)
    _add_background(figures)
    stated("bandwidth", 0.9)
    _add_bandwidth(figures, good, dead_us)
    _add_defects(figures, hot, dead)
    if not_reset:
        figures.findings.append(
            "not all pixels were reset right before each jump: a pixel compares with the level of its last event, up "
            "to a threshold away, which widens S-curves and latencies; thresholds by counts do not have this error"
        )
    return figures


def _add_count_thresholds(
    figures: EventFigures, good: NDArray[np.bool_], dead_us: float | None, not_reset: bool
) -> tuple[float, float] | None:
    """Thresholds from counts; they are returned where those of the S-curves are not to be trusted."""
    *entries, lux = count_thresholds(figures.bench, good, dead_us or 0.0)
    if lux is None and not not_reset:
        return None
    for name, entry in zip(POLARITIES, entries, strict=True):
        figures.add("threshold_by_counts", name, entry, _number(good), lux=lux)
    on, off = (entry["value"] for entry in entries)
    return (on, off) if not_reset and on is not None and off is not None else None


def _add_bandwidth(figures: EventFigures, good: NDArray[np.bool_], dead_us: float | None) -> None:
    band = figures.band = bandwidth(figures.bench, good)
    if band is None:
        figures.add("bandwidth", "", not_identifiable("no recordings of modulated light"), _number(good))
        return
    figures.add("bandwidth", "" if band.in_bursts else POLARITIES[0], band.entry, _number(good), lux=band.lux)
    if not band.in_bursts and dead_us is not None and band.hz.max() * dead_us * S_PER_US > _SHORT_DEAD_TIME:
        figures.findings.append(
            f"bandwidth: the dead time of {dead_us:.4g} µs is not short against a cycle of {band.hz.max():.4g} Hz, so "
            "that a pixel misses parts of the light: modulate in bursts, or set a shorter dead time"
        )


def _number(good: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(good))


def _hot(bench: EventBench) -> NDArray[np.bool_]:
    """Pixels that are hot in all steady recordings; none if there are fewer than two."""
    tallies = [bench.tally(one.file) for one in bench.spec.steady]
    return still.hot_pixels(tallies) if len(tallies) > 1 else np.zeros(bench.pixels, np.bool_)


def _dead(bench: EventBench) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels that answer fewer than half of the largest rises, and of the largest falls."""
    lights = _lights(bench) or ([bench.responses] if bench.responses else [])
    if not lights:
        return np.zeros(bench.pixels, np.bool_), np.zeros(bench.pixels, np.bool_)
    largest = max(lights[0], key=lambda one: one.size)
    shares = [(largest.of(polarity) > 0).mean(axis=0) for polarity in (0, 1)]
    return shares[0] < 0.5, shares[1] < 0.5


def _lights(bench: EventBench) -> list[list[Responses]]:
    """Recordings of steps by light, those with the most contrasts first; only lights that make an S-curve."""
    lights: dict[float, list[Responses]] = {}
    for one in bench.responses:
        lights.setdefault(one.steps.lux, []).append(one)
    curves = [every for every in lights.values() if len({one.size for one in every}) >= _LEAST_CONTRASTS]
    return sorted(curves, key=lambda every: (-len({one.size for one in every}), -every[0].steps.lux))


def _temperature(bench: EventBench, every: list[Responses]) -> float | None:
    stated = {bench.temperature_c(one.steps) for one in every}
    return stated.pop() if len(stated) == 1 else None


def _add_curves(figures: EventFigures, pair: tuple[SCurve, SCurve], light: list[Responses]) -> None:
    celsius = _temperature(figures.bench, light)
    for curve, name in zip(pair, POLARITIES, strict=True):
        for key, value in curve.entries.items():
            figures.add(key, name, value, curve.pixels, lux=curve.lux, temperature_c=celsius)


def _of_size(bench: EventBench, size: float) -> list[Responses]:
    """Recordings of steps of a size, the nearest at each light, in order of light."""
    nearest: dict[float, Responses] = {}
    for one in bench.responses:
        away = abs(one.size / size - 1)
        if away < _SAME_SIZE and (one.steps.lux not in nearest or away < abs(nearest[one.steps.lux].size / size - 1)):
            nearest[one.steps.lux] = one
    return [nearest[lux] for lux in sorted(nearest)]


def _add_latencies(figures: EventFigures, good: NDArray[np.bool_]) -> None:
    """At the size of steps that the most lights have, the largest of them."""
    bench = figures.bench
    sizes = sorted({one.size for one in bench.responses})
    if not sizes:
        for key in ("latency", "jitter"):
            figures.add(key, "ON", not_identifiable("no recordings of steps"), 0, temperature_c=None)
        return
    best = max(sizes, key=lambda size: (len(_of_size(bench, size)), size))
    for polarity, name in enumerate(POLARITIES):
        for one in _of_size(bench, best):
            answer = answers(one, polarity, good, bench.temperature_c(one.steps))
            figures.latencies[polarity].append(answer)
            about = {"lux": answer.lux, "contrast": answer.contrast, "temperature_c": answer.temperature_c}
            for key, value in (("latency", answer.latency), ("jitter", answer.jitter)):
                figures.add(key, name, value, answer.pixels, **about)


def _add_ranges(figures: EventFigures, good: NDArray[np.bool_], thresholds: tuple[float, float] | None) -> None:
    """Dynamic range, at twice the thresholds: those of the S-curve, unless others are given."""
    bench = figures.bench
    ranges: list[DynamicRange | None] = []
    pixels = _number(good)
    keys = ("least_light", "most_light", "dynamic_range")
    for polarity, name in enumerate(POLARITIES):
        theta = figures.curves[0][polarity].theta if figures.curves else float("nan")
        if thresholds is not None:
            theta = thresholds[polarity]
        if not np.isfinite(theta):
            for key in keys:
                figures.add(key, name, not_identifiable("the threshold is not known"), pixels, temperature_c=None)
            ranges.append(None)
            continue
        every, false = [], []
        for one in _of_size(bench, 2 * theta):
            steady = _steady(bench, one.steps.lux)
            chance = np.nan if steady is None else false_share(bench, steady, one.window_us, polarity, good)
            if np.isfinite(chance):
                every.append(answers(one, polarity, good, bench.temperature_c(one.steps)))
                false.append(float(chance))
            else:
                figures.findings.append(
                    f"{one.steps.file}: no steady recording of {one.steps.lux:g} lx that is at least as long as "
                    "the time between two jumps; what chance finds is not known, and this light is left out of the "
                    "dynamic range"
                )
        one_range = dynamic_range(every, false)
        ranges.append(one_range)
        values = one_range.least_lux, one_range.most_lux, one_range.range_db
        for key, value in zip(keys, values, strict=True):
            figures.add(key, name, value, pixels, contrast=float(np.expm1(2 * theta)))
    figures.ranges = ranges[0], ranges[1]


def _steady(bench: EventBench, lux: float) -> Steady | None:
    """The steady recording of a light."""
    near = [one for one in bench.spec.steady if one.lux > 0 and abs(np.log(one.lux / lux)) <= np.log(_SAME_LIGHT)]
    return min(near, key=lambda one: float(abs(np.log(one.lux / lux)))) if near else None


def _add_background(figures: EventFigures) -> None:
    figures.backgrounds = background(figures.bench)
    for one in figures.backgrounds:
        for name, value in zip(POLARITIES, one.rates, strict=True):
            figures.add("background", name, value, one.pixels, lux=one.lux, temperature_c=one.temperature_c)
        if one.finding:
            figures.findings.append(one.finding)
    for polarity, name in enumerate(POLARITIES):
        value = doubling(figures.backgrounds, polarity, figures.bench.spec.simulated)
        figures.add("doubling", name, value, temperature_c=None)


def _add_times(figures: EventFigures) -> float | None:
    """Dead time and read-out limit, from all recordings; returns the dead time, µs."""
    bench = figures.bench
    tallies = [bench.tally(name) for name in bench.names]
    figures.intervals = np.sum([one.intervals for one in tallies], axis=0)
    dead = dead_time(tallies)
    figures.add("dead_time", "", dead)
    figures.add("readout_limit", "", readout_limit(tallies)[0])
    dead_us: float | None = dead["value"]
    return dead_us


def _add_defects(
    figures: EventFigures, hot: NDArray[np.bool_], dead: tuple[NDArray[np.bool_], NDArray[np.bool_]]
) -> None:
    bench = figures.bench
    lacking = "" if len(bench.spec.steady) > 1 else "it takes two steady recordings"
    figures.add("hot", "", not_identifiable(lacking) if lacking else still.share(_number(hot), bench.pixels))
    lacking = "" if bench.responses else "no recordings of steps"
    for name, mask in zip(POLARITIES, dead, strict=True):
        figures.add("dead", name, not_identifiable(lacking) if lacking else still.share(_number(mask), bench.pixels))


def _has_ticks(bench: EventBench) -> bool:
    """Whether all events of the steps have times that are multiples of one time above a µs."""
    common = 0
    for one in bench.spec.steps[:3]:
        for events in bench.stream(one.file):
            common = int(np.gcd(common, np.gcd.reduce(np.diff(events["t_us"]))))
    return common > 1

"""Calibration of event pixels from ordinary recordings, and its file."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hesim_render.calibrate.estimate import not_identifiable
from hesim_render.calibrate.recordings import still, stillness, target
from hesim_render.calibrate.recordings.noise_spread import noise_spread, surest
from hesim_render.calibrate.recordings.rate_spread import rate_spread, regularity
from hesim_render.calibrate.recordings.short_intervals import dead_time, readout_limit
from hesim_render.calibrate.recordings.tally import EventTally, tally
from hesim_render.calibrate.result import plain
from hesim_render.core.errors import RangeError, SpecError
from hesim_render.core.output import free_place, write_whole
from hesim_render.core.yaml_file import yaml_text
from hesim_render.exchange import open_events

#: Thresholds follow from the leak, and the leak from the thresholds.
_ROUNDS = 3


def calibrate_recordings(
    files: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    lux: Sequence[float] | None = None,
    target_file: str | Path | None = None,
    target_contrast: float | None = None,
    target_hz: float | None = None,
    shape: tuple[int, int] | None = None,
    first: tuple[int, int] = (0, 0),
    overwrite: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """Figures of event pixels from recordings of still scenes and, where given, of a moving target.

    Parameters
    ----------
    files : recordings of still scenes, one for each light, of any format that `open_events` reads.
    out : YAML file to write; None writes none.
    lux : illuminance on the sensor of each, lx; None where it is not known.
    target_file : recording of a target of two grey levels that moves through the whole picture.
    target_contrast : light of its bright parts over that of its dark ones.
    target_hz : bright–dark cycles that a pixel sees per second; None: read from the recording.
    shape : rows and columns of the sensor, px, where a file does not state them.
    first : row and column on the sensor of the recordings' first pixel: odd rows of a crop may be even ones there.
    overwrite : replace `out`.
    progress : called with what is being done, and the part that is done.

    Returns
    -------
    ``recordings`` (one entry a file), common figures, and ``findings``: signs that a recording is not what is needed. A
    figure has ``value``, ``standard_error``, ``interval_95`` and ``unit``, or ``value: None`` and the ``reason``.

    Raises
    ------
    RangeError
        If the numbers of files and illuminances differ, or a number is out of its range.
    SpecError
        If a file cannot be read, has no events, is of another sensor than the first, or is limited by the read-out.
    """
    names = [str(file) for file in files]
    _check_scenes(names, lux)
    _check_target(target_file is not None, target_contrast, target_hz)
    path = None if out is None else free_place(out, overwrite, (".yaml", ".yml"))
    report = progress or (lambda what, part: None)
    tallies: list[EventTally] = []
    every = [*names, *([str(target_file)] if target_file is not None else [])]
    for k, name in enumerate(every):
        report(f"read {Path(name).name}", k / (len(every) + 1))
        stream = open_events(name, shape=shape, keep_stated=True)
        if tallies and stream.shape != tallies[0].shape:
            (rows, cols), (first_rows, first_cols) = stream.shape, tallies[0].shape
            raise SpecError(f"is of {cols}x{rows} px; expected {first_cols}x{first_rows}, as {names[0]}", file=name)
        if any(first) and shape not in (None, stream.shape):
            problem = f"is of {stream.shape[1]}x{stream.shape[0]} px, not of the crop's {shape[1]}x{shape[0]}"
            raise SpecError(f"{problem}; where it counts the pixels of the whole sensor, leave out the crop", file=name)
        tallies.append(tally(stream))
    if target_file is not None:
        tallies[-1] = target.of_whole_cycles(stream, tallies[-1], target_hz)
    report("fit", len(every) / (len(every) + 1))
    moving = tallies.pop() if target_file is not None else None
    result = figures(
        tallies, moving, None if lux is None else [float(level) for level in lux], target_contrast, target_hz, first
    )
    if path is not None:
        write_whole(Path(path), yaml_text(plain(result), width=120))
    return result


def _check_scenes(names: list[str], lux: Sequence[float] | None) -> None:
    if not names:
        raise RangeError("files", names, "a recording of a still scene at least")
    if lux is not None and len(lux) != len(names):
        raise RangeError("lux", list(lux), f"one illuminance for each of the {len(names)} recordings")
    if lux is not None and not all(np.isfinite(level) and level >= 0 for level in lux):
        raise RangeError("lux", list(lux), "illuminances of 0 or more")


def _check_target(is_given: bool, contrast: float | None, cycles_hz: float | None) -> None:
    if is_given != (contrast is not None):
        raise RangeError("target_contrast", contrast, "the contrast of the target where one is given, and only there")
    if contrast is not None and not (np.isfinite(contrast) and 1 < contrast < 1e4):
        raise RangeError("target_contrast", contrast, "bright over dark, from 1 to 10000")
    if cycles_hz is not None and not (is_given and cycles_hz > 0):
        raise RangeError("target_hz", cycles_hz, "cycles per second of a moving target, above 0")


def figures(
    tallies: Sequence[EventTally],
    moving: EventTally | None,
    lux: Sequence[float] | None,
    contrast: float | None,
    cycles_hz: float | None,
    first: tuple[int, int] = (0, 0),
) -> dict[str, Any]:
    """The result of `calibrate_recordings` for tallies of still scenes and of a moving target, if there is one."""
    every = [*tallies, *([moving] if moving is not None else [])]
    limit, limited = readout_limit(every)
    for one in limited:
        raise SpecError(
            f"is saturated: the read-out, of {limit['value']:.4g} events/s, limits it for more than a tenth of its "
            "time; expected a recording of all events: less light, a smaller part of the sensor, or less contrast",
            file=one.source,
        )
    if len(tallies) > 1:
        hot = still.hot_pixels(tallies)
        for one in every:
            one.used &= ~hot
    of_target = target.unknown("it takes a recording of a moving target (--target)")
    # levels are balanced where the light and the camera are steady
    steady = [k for k, one in enumerate(tallies) if not stillness.changes(one)]
    calm, calm_lux = [tallies[k] for k in steady], None if lux is None else [lux[k] for k in steady]
    result = still.balance(calm, calm_lux)
    if moving is not None and contrast is not None:
        leak_hz = 0.0
        for _ in range(_ROUNDS):
            of_target = target.thresholds(moving, contrast, cycles_hz, leak_hz)
            if of_target.ratio["value"] is None:
                break
            result = still.balance_with_target(calm, calm_lux, moving, of_target.ratio, leak_hz)
            known = [leak["value"] for leak in result.leaks if leak["value"] is not None]
            if not known:
                break
            leak_hz = max(float(np.mean(known)), 0.0)
    entries, findings = [], []
    leaks, changes = dict(zip(steady, result.leaks, strict=True)), not_identifiable("its rate changes (findings)")
    for k, one in enumerate(tallies):
        rates = still.group_rates(one)
        entries.append({
            "file": Path(one.source).name, "lux": None if lux is None else lux[k], "seconds": one.seconds,
            "events": int(one.counts.sum()), "on_rate_hz": still.rate(rates, 0), "off_rate_hz": still.rate(rates, 1),
            "on_rate_spread_rel": rate_spread(one, 0), "off_rate_spread_rel": rate_spread(one, 1),
            "on_local_variation": regularity(one), "leak_rate_hz": leaks.get(k, changes),
        })  # fmt: skip
        if problem := stillness.not_still(one):
            findings.append({"file": Path(one.source).name, "text": problem})
    return {
        "sensor": {
            "rows": tallies[0].shape[0], "cols": tallies[0].shape[1], "first_row": first[0], "first_col": first[1],
        },
        "recordings": entries, "threshold_ratio": result.ratio, **of_target.entries, "leak_dark_hz": result.dark,
        "leak_growth_hz_per_lux": result.growth, "noise_spread": surest([noise_spread(one, first) for one in calm]),
        "hot_share": still.hot_share(tallies), "silent_share": still.silent_share(tallies),
        "dead_time_us": _dead_time(tallies, moving), "readout_limit_events_per_s": limit, "findings": findings,
    }  # fmt: skip


def _dead_time(tallies: Sequence[EventTally], moving: EventTally | None) -> dict[str, Any]:
    """Dead time from the still scenes, whose noise comes at any time. A target that moves has a shortest time between
    two events of its own, which the dead time does not exceed.
    """
    steady = [one for one in tallies if stillness.of_a_lamp(one) is None]
    if not steady:
        return not_identifiable("the lamp flickers in every recording, which gives the intervals steps of its own")
    own = dead_time(steady)
    if own["value"] is not None or moving is None:
        return own
    most = dead_time([*steady, moving])
    if most["value"] is None:
        return own
    return not_identifiable(
        f"at most {most['interval_95'][1]:.4g} µs, the shortest intervals of the moving target; the light between them "
        f"may not change faster, and in the still scenes {own['reason']}"
    )

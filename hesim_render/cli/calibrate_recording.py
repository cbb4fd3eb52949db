"""Event pixels from ordinary recordings: ``calibrate recording``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from hesim_render.cli.console import Console, Json, Quiet
from hesim_render.cli.options import HelpAll
from hesim_render.cli.terminal import parse_size
from hesim_render.core.errors import RangeError

#: Figures of a recording and of all together, as the command prints them.
_OF_ONE = {
    "on_rate_hz": "ON events", "off_rate_hz": "OFF events", "leak_rate_hz": "leak",
    "on_rate_spread": "spread of ON rates", "off_rate_spread": "spread of OFF rates",
    "on_local_variation": "local variation",
}  # fmt: skip
_OF_ALL = {
    "theta_on": "θ₊", "theta_off": "θ₋", "threshold_ratio": "θ₋/θ₊", "threshold_mismatch": "threshold mismatch",
    "leak_dark_hz": "leak in the dark", "leak_growth_hz_per_lux": "growth of the leak", "hot_share": "hot pixels",
    "silent_share": "silent pixels", "dead_time_us": "dead time", "readout_limit_events_per_s": "read-out limit",
}  # fmt: skip


def recording(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="recordings of still scenes, one for each light")
    ],
    out: Annotated[Path | None, typer.Option(help="YAML file of the figures")] = None,
    lux: Annotated[
        str | None, typer.Option(help="illuminance on the sensor of each recording, lx, such as 0.1,161,3000")
    ] = None,
    target: Annotated[
        Path | None, typer.Option(help="recording of a target of two grey levels that moves through the picture")
    ] = None,
    contrast: Annotated[
        float | None, typer.Option(help="light of the target's bright parts over that of its dark ones")
    ] = None,
    target_hz: Annotated[
        float | None, typer.Option(help="bright-dark cycles a pixel sees per second; default as recorded", hidden=True)
    ] = None,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the sensor, if files do not state it")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file of figures")] = False,
    json_: Json = False,
    quiet: Quiet = False,
    help_all: HelpAll = False,
) -> None:
    """Noise and thresholds of event pixels from recordings.

    Still scenes at two lights or more and, for the thresholds, a moving target of known contrast.
    """
    from hesim_render.calibrate.recordings import calibrate_recordings

    shape, levels = None if size is None else parse_size(size), None if lux is None else _levels(lux)
    console = Console(json_, quiet)
    with console.progress("calibrate recording") as move:
        found = calibrate_recordings(
            files, out, lux=levels, target_file=target, target_contrast=contrast, target_hz=target_hz, shape=shape,
            overwrite=overwrite, progress=lambda what, part: move(part, 1.0, what),
        )  # fmt: skip
    lines = []
    for one in found["recordings"]:
        light = "" if one["lux"] is None else f", {one['lux']:g} lx"
        lines.append(f"{one['file']}{light}: {one['events']} events in {one['seconds']:.4g} s")
        lines += [f"  {_line(text, one[name])}" for name, text in _OF_ONE.items()]
    lines += [_line(text, found[name]) for name, text in _OF_ALL.items()]
    lines += [f"look at: {finding['file']}: {finding['text']}" for finding in found["findings"]]
    lines += [] if out is None else [f"in {out}"]
    console.result("\n".join(lines), {"calibration": out, **found})


def _levels(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise RangeError("--lux", text, "numbers with commas, such as 0.1,161,3000") from None


def _line(text: str, item: Mapping[str, Any]) -> str:
    if item["value"] is None:
        return f"{text:<20} not identifiable: {item['reason']}"
    interval, limit = item.get("interval_95"), item.get("upper_limit")
    between = f" ({interval[0]:.5g} to {interval[1]:.5g})" if interval else f" (below {limit:.5g})" if limit else ""
    return " ".join([f"{text:<20} {item['value']:.5g}{between}", item.get("unit", ""), item.get("note", "")]).rstrip()

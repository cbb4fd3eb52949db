"""Terminal input and output of commands: parsing of values, lines of text, a summary."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hesim_render.core.errors import RangeError
from hesim_render.core.guard import printable

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording


#: Runs of many that are named as worse than asked for.
_MOST_NAMED = 5


def split_overrides(texts: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """``--set`` items for the scene file and for the sensor file (those that begin with ``sensor.``)."""
    from hesim_render.specs.files import parse_override

    scene: dict[str, Any] = {}
    sensor: dict[str, Any] = {}
    for key, value in map(parse_override, texts):
        if key.startswith("sensor."):
            sensor[key.removeprefix("sensor.")] = value
        else:
            scene[key] = value
    return scene, sensor


def parse_size(text: str) -> tuple[int, int]:
    """Rows and columns of ``1280x720``, which has the width first."""
    match = re.fullmatch(r"([1-9][0-9]{0,4})[xX]([1-9][0-9]{0,4})", text)
    if match is None:
        raise RangeError("--size", text, "WIDTHxHEIGHT, such as 1280x720")
    return int(match[2]), int(match[1])


def parse_exposures(text: str) -> list[int]:
    """Exposures in µs of ``1,5,20``, in ms."""
    try:
        return [round(1000 * float(part)) for part in text.split(",")]
    except (ValueError, OverflowError):
        raise RangeError("exposures", text, "times in ms, such as 1,5,20") from None


def say(text: str) -> None:
    """Print a line on stdout. If the reader is gone, the run continues, because its result is not the text."""
    import typer

    try:
        typer.echo(text)
    except BrokenPipeError:
        silence_stdout()


def silence_stdout() -> None:
    """Discard all further stdout, including text that Python still has to flush at its end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def complain(*lines: str) -> None:
    """Print lines on stderr, each with the program's name; errors are ignored if stderr is closed."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        for line in lines:
            sys.stderr.write(f"hesim-render: {printable(' '.join(line.split()))}\n")
        sys.stderr.flush()


def summary(recording: Recording) -> str:
    """Content and place of a recording, in a few lines."""
    from hesim_render.recording.outline import scene_name

    manifest = recording.manifest
    counts, roi, grid = manifest["counts"], manifest["roi"], manifest["event_grid"]
    seen = f"{scene_name(recording)} seen by {manifest['sensor']['name']}, {recording.duration_us / 1e6:g} s"
    lines = [seen if "imported" in manifest["settings"] else f"{seen}, seed {manifest['seed']}"]
    if any(any(row) for row in recording.mosaic.tile_aps):
        size, bits = f"{roi['width_px']}x{roi['height_px']} px", f"{recording.mosaic.bit_depth} bit"
        none = " (no frame's last row is fully exposed in this time)" if counts["frames"] == 0 else ""
        lines.append(f"  RAW frames: {counts['frames']} of {size}, {bits}{none}")
    if grid["width"]:
        lines.append(
            f"  events: {counts['events']} ({counts['events_on']} ON, {counts['events_off']} OFF) "
            f"on {grid['width']}x{grid['height']} px"
        )
    if counts.get("events_dropped"):
        lines.append(f"  {counts['events_dropped']} more events were lost in the sensor's read-out")
    lines += render_lines(manifest["settings"].get("render"))
    if recording.path is not None:
        pictures = ", ".join(sorted(path.name for path in recording.path.glob("preview.*")))
        lines += [f"  in {recording.path}", f"  pictures: {pictures}"]
    return "\n".join(map(printable, lines))


def render_lines(render: dict[str, Any] | None) -> list[str]:
    """Lines about the error that a render has reached."""
    if render is None:
        return []
    wanted = f", asked for {render['quality']:g}" if "quality" in render else ""
    lines = []
    for name, error in render["error_noise"].items():
        if error is not None:
            lines.append(
                f"  render, {name}: stated error {_short(error['rms'])} of the sensor's noise (rms{wanted}); "
                f"95 % of values below {_short(error['p95'])}, 99 % below {_short(error['p99'])}"
            )
    audit = render.get("audit", {})
    for name in ("events", "frames"):
        part = audit.get(name)
        if part is None:
            continue
        line = (
            f"  audit, {name}: true deviation rms {_short(part['deviation_noise']['rms'])}; "
            f"{_percent(part['off'])} of values are off by more than {audit['tolerance_noise']:g} of the noise, "
            f"with 99 % confidence at most {_percent(part['off_at_most'])}"
        )
        if part.get("true_events") or part.get("found_events"):
            line += (
                f"; missed {_percent(part['missed'])} of signal events, at most {_percent(part['missed_at_most'])}; "
                f"too many {_percent(part['extra'])}, at most {_percent(part['extra_at_most'])}"
            )
        lines.append(line)
    return lines + _verdict(audit)


def _verdict(audit: dict[str, Any]) -> list[str]:
    """A line if the run misses its quality, or if the audit could not show that it reaches it."""
    if not is_short_of_wish(audit):
        if audit.get("verdict") == "not shown":
            return ["  audit: too little was looked at again to confirm this run's quality; nothing speaks against it"]
        return []
    if audit.get("samples_needed"):
        off = max(audit.get(f"{name}_off", 0.0) for name in ("events", "frames"))
        return [
            f"  NOT MET: by their stated error {_percent(off)} of the values are off by more than "
            f"{audit['tolerance_noise']:g} of the sensor's noise; --samples {audit['samples_needed']} would do"
        ]
    return [f"  NOT MET: this run is worse than asked for; --quality {audit['quality_needed']:g} would do"]


def verdict_lines(audits: Mapping[str, dict[str, Any] | None], noun: str) -> list[str]:
    """Lines about the audits of many runs, in the words for one: those that miss their quality, those not shown.

    Parameters
    ----------
    audits : what the audit of each run found, by the run's name; None where there was none.
    noun : what a run is called, in the plural.
    """
    short = {name: audit for name, audit in audits.items() if audit is not None and is_short_of_wish(audit)}
    open_ = sum(audit is not None and audit.get("verdict") == "not shown" for audit in audits.values())
    lines = []
    if short:
        needed = [audit["quality_needed"] for audit in short.values() if audit.get("quality_needed") is not None]
        told = ", ".join(list(short)[:_MOST_NAMED]) + (", …" if len(short) > _MOST_NAMED else "")
        would_do = f"; quality {min(needed):g} would do" if needed else ""
        lines.append(f"  NOT MET: {len(short)} of {len(audits)} {noun} are worse than asked for ({told}){would_do}")
    if open_:
        lines.append(
            f"  audit: too little was looked at again to confirm the quality of {open_} of {len(audits)} {noun}; "
            "nothing speaks against it"
        )
    return lines


def is_short_of_wish(audit: dict[str, Any] | None) -> bool:
    """True if an audit found that a run misses the requested quality."""
    return audit is not None and audit.get("verdict") == "not met"


def _short(value: float) -> str:
    return f"{value:.2g}"


def _percent(share: float) -> str:
    percent = 100 * share
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"

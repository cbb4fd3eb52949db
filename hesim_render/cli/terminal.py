"""Terminal input and output of commands: parsing of values, lines of text, a summary."""

import contextlib
import os
import re
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO

from hesim_render.core.errors import RangeError
from hesim_render.core.guard import printable

if TYPE_CHECKING:
    from hesim_render.recording.recording import Recording


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
    _silence(sys.stdout)


def _silence(stream: TextIO) -> None:
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def complain(*lines: str) -> None:
    """Print lines on stderr, each with the program's name; errors are ignored where it is closed or full."""
    with contextlib.suppress(ValueError, AttributeError):
        try:
            for line in lines:
                sys.stderr.write(f"hesim-render: {printable(' '.join(line.split()))}\n")
            sys.stderr.flush()
        except OSError:
            # what Python would flush at its end would change the exit status
            _silence(sys.stderr)


def summary(recording: "Recording") -> str:
    """Content and place of a recording, in a few lines."""
    from hesim_render.recording.outline import scene_name
    from hesim_render.recording.quality import render_lines

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
    lines += [f"  {line}" for line in render_lines(manifest["settings"].get("render"))]
    if recording.path is not None:
        pictures = ", ".join(sorted(path.name for path in recording.path.glob("preview.*")))
        lines += [f"  in {recording.path}", f"  pictures: {pictures}"]
    return "\n".join(map(printable, lines))

"""What commands read from and write to a terminal: texts into values, a progress bar, a summary, interrupts."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hesim_render.errors import RangeError
from hesim_render.guard import printable

if TYPE_CHECKING:
    from hesim_render.recording import Recording


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


def parse_roi(text: str) -> tuple[int, int, int | None, int | None]:
    """Width, height and optional first column and row of ``512x384`` or ``512x384+100+200``."""
    size, *offset = text.lower().split("+")
    try:
        width, height = (int(part) for part in size.split("x"))
        x, y = (int(part) for part in offset) if offset else (None, None)
    except ValueError:
        raise RangeError("--roi", text, "WIDTHxHEIGHT or WIDTHxHEIGHT+X+Y, such as 512x384") from None
    return width, height, x, y


def parse_exposures(text: str) -> list[int]:
    """Exposures in µs of ``1,5,20``, in ms."""
    try:
        return [round(1000 * float(part)) for part in text.split(",")]
    except (ValueError, OverflowError):
        raise RangeError("exposures", text, "times in ms, such as 1,5,20") from None


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Any]:
    """A callback (done, total, what) that moves a bar on a terminal; silent elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        title = printable(title)
        task = bar.add_task(title, total=None)

        def move(done: float, total: float, what: str) -> None:
            bar.update(task, completed=done, total=total, description=f"{title}: {what}")

        yield move


def summary(recording: Recording) -> str:
    """What a recording holds and where, in a few lines."""
    manifest = recording.manifest
    counts, roi, grid = manifest["counts"], manifest["roi"], manifest["event_grid"]
    video = manifest["settings"].get("video")
    scene = Path(video["source"]).name if video else (manifest.get("scene") or {}).get("name", "no scene file")
    size, bits = f"{roi['width_px']}x{roi['height_px']} px", f"{recording.mosaic.bit_depth} bit"
    lines = [
        f"{scene} seen by {manifest['sensor']['name']}, {recording.duration_us / 1e6:g} s, seed {manifest['seed']}",
        f"  RAW frames: {counts['frames']} of {size}, {bits}",
    ]
    if counts["frames"] == 0:
        lines[1] += " (no frame's last row is fully exposed in this time)"
    if grid["width"]:
        lines.append(
            f"  events: {counts['events']} ({counts['events_on']} ON, {counts['events_off']} OFF) "
            f"on {grid['width']}x{grid['height']} px"
        )
    if counts.get("events_dropped"):
        lines.append(f"  {counts['events_dropped']} more events were lost in the sensor's read-out")
    lines += _reached(manifest["settings"].get("render"))
    if recording.path is not None:
        pictures = ", ".join(sorted(path.name for path in recording.path.glob("preview.*")))
        lines += [f"  in {recording.path}", f"  pictures: {pictures}"]
    return "\n".join(map(printable, lines))


def _reached(render: dict[str, Any] | None) -> list[str]:
    """What a render of a wanted quality has come to."""
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
            f"  audit, {name}: {_percent(part['off'])} of values are off by more than {audit['tolerance_noise']:g} of "
            f"the noise, with 99 % confidence at most {_percent(part['off_at_most'])}"
        )
        if part.get("true_events"):
            line += (
                f"; missed {_percent(part['missed'])} of signal events, at most {_percent(part['missed_at_most'])}; "
                f"too many {_percent(part['extra'])}, at most {_percent(part['extra_at_most'])}"
            )
        lines.append(line)
    return lines + _verdict(audit)


def _verdict(audit: dict[str, Any]) -> list[str]:
    """The line that says so if a run is not what it should be, or not shown to be."""
    if not is_short_of_wish(audit):
        if audit.get("verdict") == "not shown":
            return ["  audit: too little was looked at again to confirm this run's quality; nothing speaks against it"]
        return []
    return [f"  NOT MET: this run is worse than asked for; --quality {audit['quality_needed']:g} would do"]


def is_short_of_wish(audit: dict[str, Any] | None) -> bool:
    """Whether an audit has found that a run is not what was asked for."""
    return audit is not None and audit.get("verdict") == "not met"


def _short(value: float) -> str:
    return f"{value:.2g}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


class Interrupts:
    """SIGINT and SIGTERM end a run alike; and are remembered, for a library may turn the exception into its own."""

    def __init__(self) -> None:
        self.happened = False
        self._before: dict[int, Any] = {}

    def _note(self, *_: Any) -> None:
        self.happened = True
        raise KeyboardInterrupt

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

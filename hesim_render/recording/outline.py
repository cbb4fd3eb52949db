"""What a recording holds, in short: as pairs of names and texts, as a line, and as tables for notebooks."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hesim_render.core.guard import printable
from hesim_render.core.html import inline_picture, table
from hesim_render.core.progress import counted
from hesim_render.core.units import US_PER_S

if TYPE_CHECKING:
    from hesim_render.recording.recorded import Recorded

#: Longer side of the picture of a frame, px.
_THUMBNAIL_PX = 480


def parameters(recording: "Recorded") -> list[tuple[str, str]]:
    """What a recording holds, as pairs of a name and a text."""
    manifest = recording.manifest
    roi, grid, counts = manifest["roi"], manifest["event_grid"], manifest["counts"]
    begin_us = manifest["time"]["begin_us"]
    rows = [
        ("scene", scene_name(recording)),
        ("sensor", manifest["sensor"]["name"]),
        ("time", f"{recording.duration_us / US_PER_S:g} s" + (f" from {begin_us / US_PER_S} s on" if begin_us else "")),
        ("seed", str(manifest["seed"])),
        ("region", f"{roi['width_px']}×{roi['height_px']} px at column {roi['x']}, row {roi['y']}"),
    ]
    if counts["frames"]:
        rows.append(("frames", f"{counts['frames']}, {recording.mosaic.bit_depth} bit"))
    if grid["width"]:
        rows.append(("event grid", f"{grid['width']}×{grid['height']} px"))
        rows.append(("events", f"{counts['events']} ({counts['events_on']} ON, {counts['events_off']} OFF)"))
    if counts.get("events_dropped"):
        rows.append(("events lost in the read-out", str(counts["events_dropped"])))
    return [(name, printable(text)) for name, text in rows]


def scene_name(recording: "Recorded") -> str:
    """Name of the scene, or of the file that stands for it: a video, a cube, or the first one of a capture."""
    settings, scene = recording.manifest["settings"], recording.manifest.get("scene")
    if "video" in settings:
        return Path(settings["video"]["source"]).name
    if "cube" in settings:
        return str(settings["cube"]["file"])
    if "imported" in settings:
        given = settings["imported"]
        return str(given.get("events") or next(iter(given.get("frames") or ()), "no file"))
    return str((scene or {}).get("name", "no scene file"))


def text_summary(recording: "Recorded") -> str:
    """`Recording.__repr__`."""
    counts, roi, grid = (recording.manifest[key] for key in ("counts", "roi", "event_grid"))
    parts = [f"{recording.duration_us / US_PER_S:g} s"]
    if counts["frames"]:
        parts.append(f"{counted(counts['frames'], 'frame')} of {roi['width_px']}x{roi['height_px']} px")
    if grid["width"]:
        parts.append(f"{counts['events']} events on {grid['width']}x{grid['height']} px")
    if recording.path is not None:
        parts.append(str(recording.path))
    return printable(
        f"<Recording of {scene_name(recording)!r} by {recording.manifest['sensor']['name']!r}: {'; '.join(parts)}>"
    )


def frame_summary(raw: np.ndarray, rows: list[tuple[str, str]]) -> str:
    """A table and a grey picture of RAW values, dark to bright."""
    step = max(1, -(-max(raw.shape) // _THUMBNAIL_PX))
    some = raw[::step, ::step].astype(np.float64)
    low, high = np.quantile(some, [0.005, 0.995]) if some.size else (0.0, 1.0)
    grey = np.clip(255 * (some - low) / max(high - low, 1.0), 0, 255).astype(np.uint8)
    return table(("", ""), rows) + inline_picture(grey, "RAW values")

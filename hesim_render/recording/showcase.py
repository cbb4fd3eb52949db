"""The previews of a recording: a contact sheet, a 2×2 DNG of a quad mosaic, and an animation of a moving scene.

RAW developers know 2×2 patterns of three colours. A quad mosaic is binned into one, as quad sensors do. Any other tile,
of four colours say, becomes linear sRGB with a pixel for each tile.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hesim_render.core.guard import printable
from hesim_render.core.output import replacing
from hesim_render.core.progress import counted
from hesim_render.mosaic.description import Mosaic
from hesim_render.pixels.evs.events import no_events
from hesim_render.recording import preview
from hesim_render.recording.colour_view import (
    Picture,
    black_picture,
    colour_picture,
    events_picture,
    linear_view,
    thumbnail,
)
from hesim_render.recording.dng import write_dng, write_linear_dng
from hesim_render.recording.frame import Frame
from hesim_render.recording.preview import Panel
from hesim_render.recording.recorded import Recorded

#: Length of the window of events that is shown for a moving scene, µs.
WINDOW_US = 10_000
_ANIMATION_STEPS = 30
_ANIMATION_WIDTH_PX = 640
_ZOOM = 8
#: Colour codes red, green and blue.
_THREE = 3


def write_previews(recording: Recorded, folder: Path) -> list[Path]:
    """Write ``preview.png`` and, where they apply, ``preview.dng`` and ``preview.gif``; returns their paths.

    Each file replaces an earlier one in one step. A link with its name is replaced, not followed.
    """
    written = [folder / "preview.png"]
    with replacing(written[0]) as temporary:
        contact_sheet(recording).save(temporary, format="PNG")
    if len(recording.frames) and needs_preview(recording.mosaic):
        written.append(folder / "preview.dng")
        with replacing(written[-1]) as temporary:
            write_preview_dng(temporary, _middle(recording), recording.mosaic)
    pictures = animation(recording) if moves(recording) else []
    if len(pictures) > 1:
        written.append(folder / "preview.gif")
        with replacing(written[-1]) as temporary:
            preview.save_animation(str(temporary), pictures)
    return written


def moves(recording: Recorded) -> bool:
    """True if the scene of a recording has motion; videos and captures of real sensors count as moving."""
    if recording.manifest["settings"].keys() & {"video", "imported"}:
        return True
    scene = recording.manifest.get("scene") or {}
    return bool(scene.get("spec", {}).get("motion"))


def _middle(recording: Recorded) -> Frame:
    return recording.frames[len(recording.frames) // 2]


def middle_views(recording: Recorded) -> list[Panel]:
    """Colour view of the middle frame and the events around it; empty where there are neither."""
    panels: list[Panel] = []
    mosaic = recording.mosaic
    begin_us, end_us = recording.manifest["time"]["begin_us"], recording.manifest["time"]["end_us"]
    middle_us = (begin_us + end_us) // 2
    if len(recording.frames):
        frame = _middle(recording)
        colour = colour_picture(frame.raw, mosaic)
        middle_us = frame.exposure_start_us + frame.exposure_us // 2
        label = "Grey view" if len(mosaic.channels) == 1 else "Colour view"
        panels.append(Panel(colour, f"{label} of frame {frame.index}, {_ms(frame.exposure_us)} exposure"))
    else:
        colour = black_picture(recording)
    if min(recording.event_shape) > 0:
        # a static scene gives only noise events: show all of them
        window_us = WINDOW_US if moves(recording) else end_us - begin_us
        first = max(begin_us, min(middle_us - window_us // 2, end_us - window_us))
        last = min(first + window_us, end_us)
        events = recording.event_slice(first, last + 1)
        picture = events_picture(colour, events, recording.event_shape)
        panels.append(Panel(picture, f"{counted(events.size, 'event')} in {_ms(last - first)}: ON orange, OFF blue"))
    return panels


def contact_sheet(recording: Recorded) -> Image.Image:
    """Colour view, events over it, the RAW mosaic whole and magnified, with captions."""
    panels, mosaic = middle_views(recording), recording.mosaic
    roi = recording.manifest["roi"]
    width_px, step = preview.panel_width(roi["width_px"], mosaic.tile_shape[1])
    if len(recording.frames):
        panels += _mosaic_panels(_middle(recording), recording, panels[0].picture, width_px, step)
    if not panels:
        panels.append(Panel(black_picture(recording), "no frames and no event pixels"))
    counts = recording.manifest["counts"]
    scene = (recording.manifest.get("scene") or {}).get("name", "")
    title = "  ·  ".join(
        part
        for part in (
            scene, mosaic.sensor, f"{roi['width_px']}x{roi['height_px']} px", _ms(recording.duration_us),
            counted(counts["frames"], "frame"), counted(counts["events"], "event"),
            f"seed {recording.manifest['seed']}",
        )
        if part
    )  # fmt: skip
    return preview.panel_sheet(panels, printable(title), width_px)


def _mosaic_panels(frame: Frame, recording: Recorded, colour: Picture, width_px: int, step: int) -> list[Panel]:
    """The RAW mosaic in the tints of its filters, and its part with the most contrast magnified."""
    mosaic = recording.mosaic
    rows, cols = frame.raw.shape
    tile_rows, tile_cols = mosaic.tile_shape
    width = min(cols, max(1, width_px // _ZOOM // tile_cols) * tile_cols)
    height = min(rows, max(1, width * rows // cols // tile_rows) * tile_rows)
    row, col = preview.busiest_window(colour, width / cols) if cols > width else (0.0, 0.0)
    top = min(int(row * rows), rows - height) // tile_rows * tile_rows
    left = min(int(col * cols), cols - width) // tile_cols * tile_cols
    part = preview.mosaic_picture(frame.raw[top : top + height, left : left + width], mosaic, _ZOOM)
    note = "" if frame.valid.all() else "; dots: event pixels"
    zoomed = Panel(part, f"RAW at row {top}, column {left}, magnified {_ZOOM} times{note}")
    if mosaic.is_mono:
        return [zoomed]
    whole = preview.mosaic_picture(preview.every_tile(frame.raw, mosaic, step), mosaic)
    shown = "" if step == 1 else f"; 1 of {step}x{step} tiles shown"
    return [Panel(whole, f"RAW mosaic in the tints of its filters{shown}"), zoomed]


def animation(recording: Recorded) -> list[Picture]:
    """Events over the latest frame, step by step through the recording."""
    if min(recording.event_shape) == 0:
        frames = recording.frames
        if not frames:
            return []
        chosen = np.unique(np.linspace(0, len(frames) - 1, _ANIMATION_STEPS).round().astype(int))
        return [colour_picture(frames[k].raw, recording.mosaic, _ANIMATION_WIDTH_PX) for k in chosen]
    begin_us, end_us = recording.manifest["time"]["begin_us"], recording.manifest["time"]["end_us"]
    edges = np.linspace(begin_us, end_us + 1, _ANIMATION_STEPS + 1).astype(int)
    shown_at = [entry["t_us"] for entry in recording.manifest["frames"]]
    pictures: list[Picture] = []
    background, shown = black_picture(recording), -1
    for first, last in zip(edges[:-1], edges[1:], strict=True):
        latest = max(0, int(np.searchsorted(shown_at, last, side="right")) - 1)
        if shown_at and latest != shown:
            raw = recording.frames[latest].raw
            background, shown = colour_picture(raw, recording.mosaic, _ANIMATION_WIDTH_PX), latest
        events = recording.event_slice(int(first), int(last)) if last > first else no_events()
        pictures.append(events_picture(background, events, recording.event_shape))
    return pictures


def _ms(microseconds: int) -> str:
    return f"{microseconds / 1000:g} ms"


def write_preview_dng(path: Path, frame: Frame, mosaic: Mosaic) -> None:
    """Write the file of a frame whose own DNG developers do not open (`needs_preview`)."""
    smaller = binned(frame.raw, mosaic)
    if smaller is not None and smaller[1].tile_code.max() < _THREE:
        raw, own = smaller
        small = thumbnail(raw, own)
        write_dng(path, raw, own, exposure_us=frame.exposure_us, description=frame.times, thumbnail=small)
    else:
        linear = linear_view(frame.raw, mosaic)
        write_linear_dng(path, linear, mosaic, exposure_us=frame.exposure_us, description=frame.times)


def needs_preview(mosaic: Mosaic) -> bool:
    """True for tiles other than one filter, or 2×2 of red, green and blue."""
    return not mosaic.is_mono and (mosaic.tile_shape != (2, 2) or int(mosaic.tile_code.max()) >= _THREE)


def binned(raw: NDArray[np.uint16], mosaic: Mosaic) -> tuple[NDArray[np.uint16], Mosaic] | None:
    """A quad mosaic as a 2×2 mosaic at half size: each colour cell becomes the mean of its frame pixels.

    Quad sensors bin in the same way. Event pixels do not take part. The result is None if the
    tile is not made of 2×2 cells of one filter.
    """
    channel = mosaic.tile_channel
    rows, cols = channel.shape
    if rows % 2 or cols % 2 or (rows, cols) == (2, 2):
        return None
    cells = channel.reshape(rows // 2, 2, cols // 2, 2).transpose(0, 2, 1, 3).reshape(rows // 2, cols // 2, 4)
    first = cells.max(axis=2)
    if (first < 0).any() or not ((cells == first[..., None]) | (cells < 0)).all():
        return None
    blocks = (raw.shape[0] // 2, 2, raw.shape[1] // 2, 2)
    valid = mosaic.tiled(channel >= 0, raw.shape).reshape(blocks)
    mean = np.where(valid, raw.reshape(blocks), 0).sum(axis=(1, 3), dtype=np.uint32) / valid.sum(axis=(1, 3))
    tile_filter = [[mosaic.channels[number] for number in row] for row in first]
    flags = [[True] * len(row) for row in tile_filter]
    noise, shares = mosaic.noise_profile, float(np.mean(1 / (cells >= 0).sum(axis=2)))
    smaller = mosaic.model_copy(
        update={
            "pitch_um": None if mosaic.pitch_um is None else 2 * mosaic.pitch_um,
            "noise_profile": None if noise is None else (noise[0] * shares, noise[1] * shares),
            "tile_filter": tile_filter,
            "tile_aps": flags,
            "tile_evs": [[False] * len(row) for row in tile_filter],
            "cfa_code": {name: mosaic.cfa_code[name] for name in mosaic.channels},
        }
    )
    return np.rint(mean).astype(np.uint16), smaller

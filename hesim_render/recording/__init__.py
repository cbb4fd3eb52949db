"""The result of a run: frames, events, their truth and a manifest.

Every folder gets its previews, and every export its videos, through this module. A recording does not import them, and
the code that draws them is loaded when the first one is drawn.
"""

from functools import partial
from pathlib import Path

from hesim_render.recording.exports import DRAWN
from hesim_render.recording.folder import DRAWERS
from hesim_render.recording.recording import Recording
from hesim_render.recording.writer import RecordingWriter

__all__ = ["Recording", "RecordingWriter"]


def _draw(folder: Path) -> None:
    from hesim_render.recording.showcase import write_previews

    write_previews(Recording.load(folder), folder)


def _movie(recording: Recording, path: Path, kind: str) -> None:
    from hesim_render.recording.movie import write_movie

    write_movie(recording, path, kind)


DRAWERS.append(_draw)
DRAWN.update({kind: partial(_movie, kind=kind) for kind in ("mp4", "mp4-colour", "mp4-events")})

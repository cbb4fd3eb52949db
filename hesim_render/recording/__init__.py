"""What a run leaves: frames, events, their truth and a manifest.

Every folder gets its previews here: a recording does not know them, and they are loaded when the first one is drawn.
"""

from pathlib import Path

from hesim_render.recording.folder import DRAWERS
from hesim_render.recording.recording import Recording
from hesim_render.recording.writer import RecordingWriter

__all__ = ["Recording", "RecordingWriter"]


def _draw(folder: Path) -> None:
    from hesim_render.recording.showcase import write_previews

    write_previews(Recording.load(folder), folder)


DRAWERS.append(_draw)

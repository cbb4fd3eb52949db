"""The result of a run: frames, events, their truth and a manifest.

Every folder gets its previews through this module. A recording does not import them, and the code that draws them is
loaded when the first one is drawn.
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

"""The result of a run: frames, events, their truth and a manifest; and what can be made of it."""

from hesim_render.recording.recording import Recording
from hesim_render.recording.writer import RecordingWriter

__all__ = ["Recording", "RecordingWriter"]

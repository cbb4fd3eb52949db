"""What a run leaves: frames, events, their truth and a manifest."""

from hesim_render.recording.recording import Recording, RecordingWriter

__all__ = ["Recording", "RecordingWriter"]

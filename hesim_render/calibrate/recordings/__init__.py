"""Event pixels from ordinary recordings: still scenes and, where given, a moving target."""

from hesim_render.calibrate.recordings.calibration import calibrate_recordings

__all__ = ["calibrate_recordings"]

"""The capture: from a source of flux and a sensor to frames and events."""

from hesim_render.capture.loop import Capture
from hesim_render.capture.run_settings import noise_models

__all__ = ["Capture", "noise_models"]

"""One run: a source of flux and a sensor in, frames and events out."""

from hesim_render.capture.loop import Capture, noise_models

__all__ = ["Capture", "noise_models"]

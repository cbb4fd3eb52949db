"""Validated models of the files users write: sensors, scenes and the spectra inside them."""

from hesim_render.specs.scene import SceneSpec, read_scene
from hesim_render.specs.sensor import SensorSpec

__all__ = ["SceneSpec", "SensorSpec", "read_scene"]

"""A sensor ready to use: its file, the region read out, its lens and its pixel models."""

from hesim_render.sensor.sensor import Sensor, load_sensor

__all__ = ["Sensor", "load_sensor"]

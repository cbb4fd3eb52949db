"""A sensor ready to use: its specification, read-out region, lens and pixel models."""

from hesim_render.sensor.sensor import Sensor, load_sensor

__all__ = ["Sensor", "load_sensor"]

"""Calibration targets: exact geometry, reflectances, and the places of their points."""

from hesim_render.targets.points import target_points

__all__ = ["target_points"]

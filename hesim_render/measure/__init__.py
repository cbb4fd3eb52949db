"""Measurements on frames: the spatial frequency response on a slanted edge."""

from hesim_render.measure.recorded_edge import Signal, measure_mtf
from hesim_render.measure.slanted_edge import EdgeResponse, edge_response

__all__ = ["EdgeResponse", "Signal", "edge_response", "measure_mtf"]

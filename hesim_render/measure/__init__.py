"""Measurements on frames: the spatial frequency response on a slanted edge."""

from hesim_render.measure.slanted_edge import EdgeResponse, Signal, edge_response, measure_mtf

__all__ = ["EdgeResponse", "Signal", "edge_response", "measure_mtf"]

"""Hyperspectral cubes as a source of flux, still or moving."""

from hesim_render.sources.cube.flux import CubeFlux, CubeOptions

__all__ = ["CubeFlux", "CubeOptions"]

"""Hyperspectral cubes as a source of flux, still or moving."""

from hesim_render.sources.cube.flux import CubeFlux
from hesim_render.sources.cube.options import CubeOptions

__all__ = ["CubeFlux", "CubeOptions"]

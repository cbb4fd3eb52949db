"""The renderer: spectral radiance of an animated scene through each mosaic pixel's own filter (Mitsuba 3).

Nothing outside this package imports mitsuba.
"""

from hesim_render.sources.render.camera import View, place_camera
from hesim_render.sources.render.cube import read_spectral_exr, render_cube, write_spectral_exr
from hesim_render.sources.render.exact import RenderedFlux
from hesim_render.sources.render.scene.trajectory import Trajectory

__all__ = [
    "RenderedFlux",
    "Trajectory",
    "View",
    "place_camera",
    "read_spectral_exr",
    "render_cube",
    "write_spectral_exr",
]

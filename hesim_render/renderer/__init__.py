"""The renderer: spectral radiance of an animated scene through each mosaic pixel's own filter (Mitsuba 3).

Nothing outside this package imports mitsuba.
"""

from hesim_render.renderer.camera import View, place_camera
from hesim_render.renderer.cube import read_spectral_exr, render_cube, write_spectral_exr
from hesim_render.renderer.flux import RenderedFlux
from hesim_render.renderer.reference import reference_windows
from hesim_render.renderer.specfilm import reference_flux
from hesim_render.renderer.trajectory import Trajectory

__all__ = [
    "RenderedFlux",
    "Trajectory",
    "View",
    "place_camera",
    "read_spectral_exr",
    "reference_flux",
    "reference_windows",
    "render_cube",
    "write_spectral_exr",
]

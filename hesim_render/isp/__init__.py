"""From RAW frames to pictures: plain functions, one per step, and a pipeline that is a list of steps.

The package does not use the renderer, so it works on frames of real sensors too. Dr.Jit is used only to draw the maps
of a simulated device again, for the noise reduction of its recordings.
"""

from hesim_render.isp.demosaicing import demosaic, remosaic
from hesim_render.isp.develop import develop_recording
from hesim_render.isp.frame_noise import FrameNoise
from hesim_render.isp.pipeline import DEFAULT, DENOISED_PICTURE, PICTURE, Pipeline, develop, load_pipeline, process
from hesim_render.mosaic.colour_profile import Camera, load_camera

__all__ = [
    "DEFAULT",
    "DENOISED_PICTURE",
    "PICTURE",
    "Camera",
    "FrameNoise",
    "Pipeline",
    "demosaic",
    "develop",
    "develop_recording",
    "load_camera",
    "load_pipeline",
    "process",
    "remosaic",
]

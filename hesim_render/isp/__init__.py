"""From RAW frames to pictures: plain functions, one per step, and a pipeline that is a list of steps.

Uses neither the renderer nor Dr.Jit, so that it works on frames of real sensors too.
"""

from hesim_render.camera import Camera, load_camera
from hesim_render.isp.demosaicing import demosaic, remosaic
from hesim_render.isp.develop import develop_recording
from hesim_render.isp.pipeline import DEFAULT, PICTURE, Pipeline, develop, load_pipeline, process

__all__ = [
    "DEFAULT",
    "PICTURE",
    "Camera",
    "Pipeline",
    "demosaic",
    "develop",
    "develop_recording",
    "load_camera",
    "load_pipeline",
    "process",
    "remosaic",
]

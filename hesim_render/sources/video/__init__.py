"""Video instead of a rendered scene: files, folders of pictures and arrays as a source of flux."""

from hesim_render.sources.video.flux import VideoFlux, open_video
from hesim_render.sources.video.options import VideoOptions

__all__ = ["VideoFlux", "VideoOptions", "open_video"]

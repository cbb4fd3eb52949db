"""A calibrated sensor beside the captures that it was not fitted on."""

from hesim_render.twin.run import make_twin

__all__ = ["make_twin"]

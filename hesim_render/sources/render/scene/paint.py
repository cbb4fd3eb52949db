"""Paint of diffuse shapes."""

from __future__ import annotations

from dataclasses import dataclass

from hesim_render.spectral.spectrum import Spectrum


@dataclass(frozen=True)
class Paint:
    """Paint of a shape: one diffuse colour, or a checkerboard of two.

    Parameters
    ----------
    shape : id of the shape in the Mitsuba scene.
    colours : one or two reflectances.
    scale : factors on (u, v) of the shape; the squares of the checkerboard then have a side of one half.
    two_sided : True if the back is painted as well; otherwise the back is black.
    """

    shape: str
    colours: tuple[Spectrum, ...]
    scale: tuple[float, float] = (1.0, 1.0)
    two_sided: bool = False

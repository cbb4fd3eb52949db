"""What matt shapes are painted with."""

from __future__ import annotations

from dataclasses import dataclass

from hesim_render.spectral.spectrum import Spectrum


@dataclass(frozen=True)
class Paint:
    """What a shape is painted with: one matt colour, or checks of two.

    Parameters
    ----------
    shape : id of the shape in the Mitsuba scene.
    colours : one or two reflectances.
    scale : what (u, v) of the shape are multiplied by before checks of half a unit are laid on them.
    two_sided : whether the back is painted as well; else it is black.
    """

    shape: str
    colours: tuple[Spectrum, ...]
    scale: tuple[float, float] = (1.0, 1.0)
    two_sided: bool = False
